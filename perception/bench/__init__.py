"""Measurements that anyone can rerun: `perception bench NAME`. Each module has `main(arguments)`."""

BENCHES = (
    "rasterizer",
    "map",
    "scaling",
    "clouds",
    "query",
    "instances",
    "queries",
    "lerf-mask",
    "lerf-ovs",
    "scannetpp",
)
"""Names on the command line; a dash in a name is an underscore in its module's."""
