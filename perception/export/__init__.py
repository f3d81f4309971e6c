"""Transfers instance labels of a map to point clouds and meshes, and writes them in formats of other programs."""
