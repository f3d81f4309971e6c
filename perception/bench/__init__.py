"""Benchmarks: `perception bench NAME`."""

BENCHES = {
    "rasterizer": "rasterizer:main",
}
"""Name on the command line -> module of this package and function in it, which takes the arguments."""
