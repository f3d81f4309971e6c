"""Writes copies of a map's Gaussians side by side as one finished splat: a building of any size.

python tools worlds.copies MAP OUT.ply [--across 9] [--deep 3]

The map's up is z. Copies stand in a grid of the size of its box, without the outer hundredth of the Gaussians on each
side.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from perception.io.ply import map_ply, write_ply


def write_copies(source: Path, output: Path, across: int, deep: int) -> int:
    """Writes across × deep copies of the Gaussians of the map `source` to `output`; their number."""
    rows = map_ply(source / "gaussians.ply", "vertex")
    low, high = (np.array([np.quantile(rows[axis], share) for axis in "xy"]) for share in (0.01, 0.99))
    inside = np.all([(rows[axis] >= low[n]) & (rows[axis] <= high[n]) for n, axis in enumerate("xy")], axis=0)
    rows, count = rows[inside], across * deep
    columns = {name: np.tile(rows[name], count) for name in rows.dtype.names or ()}
    for axis, place in zip("xy", divmod(np.arange(count), deep), strict=True):
        step = high["xy".index(axis)] - low["xy".index(axis)]
        columns[axis] = (columns[axis] + np.repeat(place * step, len(rows))).astype(np.float32)
    write_ply(output, {"vertex": columns})
    return len(rows) * count


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("output", type=Path, metavar="OUT.ply")
    parser.add_argument("--across", type=int, default=9)
    parser.add_argument("--deep", type=int, default=3)
    given = parser.parse_args()
    print(f"{given.output}: {write_copies(given.map, given.output, given.across, given.deep)} Gaussians")
