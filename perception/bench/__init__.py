"""Measurements anyone can rerun: `perception bench NAME`. Each module has `main(arguments)`."""

BENCHES = (
    "rasterizer",
    "training",
    "masks",
    "mask-speed",
    "language",
    "query",
    "view",
    "lerf-mask",
    "lerf-ovs",
    "scannetpp",
    "clouds",
    "smoothing",
    "calibrate",
    "queries",
    "sam",
    "map",
    "switches",
    "scaling",
    "ablation",
    "export",
    "instances",
    "collisions",
    "clustering",
    "section",
)
"""Names on the command line; a dash in a name is an underscore in its module's."""
