"""LAS and LAZ through the optional package `laspy`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.types import PointCloud


def read_las(path: Path) -> PointCloud:
    """points [P, 3] float64 (scale and offset applied); 16-bit colours become 8-bit; `classification` is a label."""
    try:
        import laspy
    except ImportError as error:
        raise InputError(f"{path}: LAS and LAZ need the package 'laspy'; run: pip install 'laspy[lazrs]'") from error
    try:
        las = laspy.read(path)
    except (laspy.errors.LaspyException, ValueError, OSError) as error:
        raise InputError(f"{path}: is not a readable LAS/LAZ file ({error})") from error
    cloud = PointCloud(np.ascontiguousarray(las.xyz, dtype=np.float64))
    names = set(las.point_format.dimension_names)
    if {"red", "green", "blue"} <= names:
        wide = np.stack([np.asarray(las.red), np.asarray(las.green), np.asarray(las.blue)], axis=1)
        # The standard asks for 16 bits, but many writers leave 8-bit values unscaled.
        cloud.colors = (wide >> 8 if wide.max(initial=0) > 255 else wide).astype(np.uint8)
    for name in ("classification", "instance_id", "semantic_id"):
        if name in names:
            cloud.labels[name] = np.asarray(las[name]).astype(np.int32)
    return cloud
