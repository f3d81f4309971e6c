"""Benchmarks: `perception bench rasterizer`, and what it and those of a checkout share."""
