"""Measures the peak memory of reading meshes and clouds against the size of their files.

python tools speed.readers [--points 10_000_000] [--formats binary mixed lists text pcd npz]

Each file is read in a process of its own: the peak is what it has beyond its imports, the file's bytes included.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

PIECE = 1_000_000
"""Rows that are made at a time."""


def header(order: str, points: int, faces: int, lists: bool = False) -> bytes:
    lines = ["ply", f"format {order} 1.0", f"element vertex {points}", *(f"property float {a}" for a in "xyz")]
    lines += [f"property uchar {c}" for c in ("red", "green", "blue")]
    lines += ["property list uchar uint view_indices", "property list uchar float view_weights"] * lists
    lines += [f"element face {faces}", "property list uchar int vertex_indices"] * (faces > 0)
    return "\n".join([*lines, "end_header", ""]).encode()


def make(path: Path, kind: str, points: int) -> None:
    """Writes a mesh of `points` vertices and twice as many triangles, in mixed ones every tenth face a quad. lists: a
    cloud whose vertices have lists of 2 to 5 views, as OpenMVS writes them."""
    from perception.io.cloud import write_cloud
    from perception.types import PointCloud

    rng = np.random.default_rng(0)
    if kind in ("pcd", "npz"):
        xyz, rgb = rng.normal(size=(points, 3)).astype(np.float32), rng.integers(0, 256, (points, 3), np.uint8)
        write_cloud(path, PointCloud(xyz, rgb))
        return
    faces = 0 if kind == "lists" else 2 * points
    vertex = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    with path.open("wb") as file:
        file.write(header("ascii" if kind == "text" else "binary_little_endian", points, faces, kind == "lists"))
        for n in (min(PIECE, points - at) for at in range(0, points, PIECE)):
            rows = np.zeros(n, vertex)
            rows["xyz"], rows["rgb"] = rng.normal(size=(n, 3)), rng.integers(0, 256, (n, 3))
            if kind == "text":
                np.savetxt(file, np.hstack([rows["xyz"], rows["rgb"]]), "%.6f %.6f %.6f %d %d %d")
            elif kind == "lists":
                counts = rng.integers(2, 6, n)
                tails = [bytes([k]) + bytes(4 * k) + bytes([k]) + bytes(4 * k) for k in range(6)]
                file.write(b"".join(row.tobytes() + tails[k] for row, k in zip(rows, counts, strict=True)))
            else:
                rows.tofile(file)
        for n in (min(PIECE, faces - at) for at in range(0, faces, PIECE)):
            corners = rng.integers(0, points, (n, 3)).astype("<i4")
            if kind == "text":
                np.savetxt(file, corners, "3 %d %d %d")
                continue
            rows = np.empty(n, np.dtype([("n", "u1"), ("corners", "<i4", 3)]))
            rows["n"], rows["corners"] = 3, corners
            quad = b"\4" + np.arange(4, dtype="<i4").tobytes()
            if kind == "mixed":
                file.write(b"".join(rows[i : i + 9].tobytes() + quad for i in range(0, n, 10)))
            else:
                rows.tofile(file)


def peak() -> int:
    """Most bytes of memory that this process has had (Linux). `ru_maxrss` would begin with those of its parent."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def read(path: Path) -> None:
    from perception.io.cloud import read_cloud

    before, start = peak(), time.process_time()
    cloud = read_cloud(path)
    more, size = peak() - before, path.stat().st_size
    faces = 0 if cloud.faces is None else len(cloud.faces)
    print(
        f"{path.name}: {len(cloud.points)} points, {faces} triangles, {size / 1e6:.0f} MB: peak {more / 1e6:.0f} MB, "
        f"{more / size:.2f} times the file, {time.process_time() - start:.1f} s",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--formats", nargs="+", default=["binary", "mixed", "lists", "text", "pcd", "npz"])
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.read is not None:
        return read(options.read)
    with tempfile.TemporaryDirectory() as folder:
        for kind in options.formats:
            path = Path(folder) / f"{kind}.{kind if kind in ('pcd', 'npz') else 'ply'}"
            make(path, kind, options.points)
            subprocess.run([sys.executable, __file__, "--read", str(path)], check=True)
            path.unlink()


if __name__ == "__main__":
    main()
