"""Data types shared by all layers. Transforms are named a_from_b; pixel centres lie at +0.5; quaternions are wxyz."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Lens:
    """The camera that took a photo, as COLMAP names it: model (e.g. "OPENCV"), params in COLMAP's order. width, height:
    size in pixels of the photo as its view uses it (see `View.as_stored`)."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int


@dataclass(frozen=True)
class DepthImage:
    """The depth that a sensor measured for a photo: an image of distances along the optical axis.
    path: PNG or TIFF of one channel, or NumPy .npy, [h, w]; 0 = nothing measured. scale: scene units per stored unit.
    lens: camera that took it, at the photo's pose; None when it shows what the photo shows, at any resolution."""

    path: Path
    scale: float
    lens: Lens | None = None


@dataclass(frozen=True)
class View:
    """One posed photo, seen through an ideal pinhole camera (K, width, height) obtained by undistorting `lens`.

    name: file name of the photo relative to its folder, unique in the scene ("a/0001.jpg").
    photo: path of the photo. lens: None when the photo is already a pinhole image of size width × height.
    K: [3, 3] float64, pixels. camera_from_world: [4, 4] float64, OpenCV axes (x right, y down, z forward).
    held_out: whether the view was used for evaluation of a finished map and not for training; of an input: whether it
    keeps the photo for that. depth: None without a depth sensor. mask: image of pixels to ignore (black), of the
    photo's shape at any resolution; None uses all. gain: colours of the photo over those of the scene, RGB, where
    exposure or white balance vary; None = 1. as_stored: whether the photo's pixels are used without EXIF rotation, as
    tools that know poses use them.
    """

    name: str
    photo: Path
    K: np.ndarray
    width: int
    height: int
    camera_from_world: np.ndarray
    lens: Lens | None = None
    held_out: bool = False
    depth: DepthImage | None = None
    mask: Path | None = None
    gain: tuple[float, float, float] | None = None
    as_stored: bool = False

    @property
    def photo_size(self) -> tuple[int, int]:
        """(width, height) of the photo in pixels, before it is undistorted."""
        return (self.width, self.height) if self.lens is None else (self.lens.width, self.lens.height)


@dataclass
class Scene:
    """Input of mapping: posed views (sorted by name) and a sparse cloud.

    points: [P, 3] float64 in the world frame; point_colors: [P, 3] uint8; both may be empty. metric: whether the unit
    is known to be the metre. report: JSON-able facts about the reconstruction (registered and left-out photos, errors,
    warnings, seconds by stage).
    """

    views: list[View]
    points: np.ndarray
    point_colors: np.ndarray
    metric: bool = False
    frame: str = "map"
    report: dict[str, Any] = field(default_factory=dict)


_UNIT_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


@dataclass(frozen=True)
class OrientedBox:
    """center [3], rotation [3, 3] (rows are the box axes in the map frame), extent [3] full side lengths."""

    center: np.ndarray
    rotation: np.ndarray
    extent: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """[8, 3], by the bits of their number: 4 is the far side of the first axis, 1 that of the last."""
        return self.center + (_UNIT_CORNERS * self.extent) @ self.rotation

    def to_json(self) -> dict[str, Any]:
        return {
            "center": [float(x) for x in self.center],
            "rotation": [[float(x) for x in row] for row in self.rotation],
            "extent": [float(x) for x in self.extent],
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> OrientedBox:
        """The box that `to_json` wrote."""
        return cls(*(np.array(data[key], np.float64) for key in ("center", "rotation", "extent")))


@dataclass
class PointCloud:
    """Points as read, order kept. points [P, 3] float32 or float64; colors [P, 3] uint8, normals [P, 3] float32, faces
    [F, 3] int32 (mesh), labels: further columns [P] of numbers by name, in the type that the file has."""

    points: np.ndarray
    colors: np.ndarray | None = None
    normals: np.ndarray | None = None
    faces: np.ndarray | None = None
    labels: dict[str, np.ndarray] = field(default_factory=dict)
