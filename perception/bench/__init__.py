"""Benchmarks: `perception bench NAME`. Each module has `main(arguments)`."""

BENCHES = ("rasterizer", "map", "instances", "queries", "lerf-mask", "lerf-ovs", "scannetpp")
"""Benchmark names on the command line. A dash in a name is an underscore in the module name."""
