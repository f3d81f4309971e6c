"""Benchmarks: `perception bench NAME`."""

BENCHES = {
    "rasterizer": "rasterizer:main",
    "lerf-mask": "lerf:LerfMask.main",
    "lerf-ovs": "lerf:LerfOvs.main",
    "scannetpp": "scannetpp:ScanNetPP.main",
}
"""Name on the command line -> module of this package and function in it, which takes the arguments."""
