"""Point clouds in text formats: XYZ tables and Wavefront OBJ."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.io.atomic import replacing
from perception.types import PointCloud


def read_xyz(path: Path) -> PointCloud:
    """Rows of x y z, then optionally r g b (all whole numbers in 0..255) and/or a normal; separators: blank , ;

    Lines starting with # or // and a leading count line (.pts) are skipped. points [P, 3] float64.
    """
    rows = _table(path)
    if rows.size == 0:
        return PointCloud(np.empty((0, 3)))
    if rows.shape[1] < 3:
        raise InputError(f"{path}: rows have {rows.shape[1]} columns; expected x y z at least")
    cloud = PointCloud(np.ascontiguousarray(rows[:, :3]))
    rest = rows[:, 3:]
    if rest.shape[1] in (4, 7):  # an intensity column precedes the colour
        rest = rest[:, 1:]
    while rest.shape[1] >= 3:
        triple, rest = rest[:, :3], rest[:, 3:]
        if cloud.colors is None and _looks_like_color(triple):
            cloud.colors = triple.astype(np.uint8)
        elif cloud.normals is None:
            cloud.normals = triple.astype(np.float32)
    return cloud


def _table(path: Path) -> np.ndarray:
    """The numbers of a text table as [rows, columns] float64."""
    data = path.read_bytes().replace(b",", b" ").replace(b";", b" ")
    if b"#" in data or b"//" in data:
        kept = [line for line in data.splitlines() if not line.lstrip().startswith((b"#", b"//"))]
        data = b"\n".join(kept)
    lines = data.lstrip().split(b"\n", 2)
    if len(lines) > 1 and len(lines[0].split()) == 1 < len(lines[1].split()):
        data = data.lstrip().split(b"\n", 1)[1]  # a .pts file begins with the number of points
    width = len(data.lstrip().split(b"\n", 1)[0].split())
    if width == 0:
        return np.empty((0, 3))
    try:
        numbers = np.fromstring(data, dtype=np.float64, sep=" ")
    except ValueError as error:
        raise InputError(f"{path}: holds text where numbers are expected ({error})") from error
    stripped = data.strip()
    if len(numbers) != width * (stripped.count(b"\n") + 1):  # blank or uneven lines
        rows = [len(line.split()) for line in stripped.splitlines() if line.strip()]
        uneven = [i for i, n in enumerate(rows) if n != width]
        if uneven:
            raise InputError(f"{path}: row {uneven[0] + 1} has {rows[uneven[0]]} numbers; expected {width} as before")
        if len(numbers) != width * len(rows):
            raise InputError(f"{path}: holds text where numbers are expected (the first {len(numbers)} are numbers)")
    return numbers.reshape(-1, width)


def _looks_like_color(triple: np.ndarray) -> bool:
    whole = bool((triple == np.floor(triple)).all())
    return whole and triple.min() >= 0 and 1 < triple.max() <= 255


def write_xyz(path: Path, cloud: PointCloud) -> None:
    """Writes x y z, then r g b and nx ny nz where known; labels are not written."""
    with replacing(path) as file:
        columns = [cloud.points.astype(np.float64)]
        formats = ["%.9g" if cloud.points.dtype == np.float32 else "%.17g"] * 3
        if cloud.colors is not None:
            columns.append(cloud.colors.astype(np.float64))
            formats += ["%d"] * 3
        if cloud.normals is not None:
            columns.append(cloud.normals.astype(np.float64))
            formats += ["%.9g"] * 3
        np.savetxt(file, np.concatenate(columns, axis=1), fmt=formats)


def read_obj(path: Path) -> PointCloud:
    """Vertices (with r g b after x y z where given) and faces of an OBJ file; texture and normal indices are ignored.

    points [P, 3] float64. Faces are split into fans; negative indices count back from the last vertex read.
    """
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    number = 0
    try:
        with path.open("r", encoding="utf-8", errors="replace") as file:
            for line in file:
                number += 1
                if line.startswith("v "):
                    vertices.append([float(word) for word in line.split()[1:7]])
                elif line.startswith("f "):
                    corners = [int(word.split("/")[0]) for word in line.split()[1:]]
                    corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
                    faces += [(corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1)]
        widths = {len(v) for v in vertices}
        table = np.array(vertices, np.float64) if vertices else np.empty((0, 3))
        triangles = np.array(faces, np.int32).reshape(-1, 3)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: line {number} cannot be understood as OBJ ({error})") from error
    if table.ndim != 2 or table.shape[1] < 3:
        raise InputError(f"{path}: vertices have {sorted(widths)} numbers; expected x y z or x y z r g b")
    cloud = PointCloud(np.ascontiguousarray(table[:, :3]))
    if table.shape[1] == 6:
        scale = 255.0 if table[:, 3:].max(initial=0) <= 1 else 1.0
        cloud.colors = np.clip(np.round(table[:, 3:] * scale), 0, 255).astype(np.uint8)
    if faces:
        cloud.faces = triangles
    return cloud
