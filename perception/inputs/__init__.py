"""Readers of inputs: photos, COLMAP, transforms.json, RGB-D recordings."""
