"""Camera models: conversion from and to pycolmap, the pinhole camera of the undistorted image, and the warp to it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.documents import refusing
from perception.types import Lens

MOST_PIXELS, MOST_SIDE = 1e9, 1 << 20
LEAST_FOCAL = 0.02
"""Least focal length as a share of the photo's long side, a view of 175°: shorter ones are not in pixels."""
_ASPECT = 0.02
"""Largest relative difference between aspect ratios that count as the same: sizes are whole pixels."""
_OFF_CENTRE = 0.25
"""Share of the photo's side from its middle beyond which a principal point is told."""
_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE = ("k1", "k2", "k3", "k4")
"""Names of OpenCV's coefficients of distortion, in the order of OpenCV and COLMAP."""


def load_pycolmap() -> Any:
    """Imports pycolmap without log output. All code gets pycolmap from here.

    PIL's compiled module is loaded first: the wheel of pycolmap 4.2 exports its own zlib, and PIL loaded after it
    crashes when it writes a PNG. The log is silenced unless GLOG_minloglevel is set. glog replaces the SIGTERM handler
    to print a native stack trace; Python's handler is restored.
    """
    from PIL import _imaging  # type: ignore[attr-defined]  # noqa: F401

    import pycolmap  # isort: skip

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    if "GLOG_minloglevel" not in os.environ:
        pycolmap.logging.minloglevel = 3
    return pycolmap


def opencv_lens(pinhole: tuple[float, ...], k: Sequence[float], width: int, height: int, fisheye: bool = False) -> Lens:
    """The simplest COLMAP model that holds OpenCV's coefficients k (see PERSPECTIVE, FISHEYE). pinhole: fx fy cx cy."""
    if fisheye:
        return Lens("OPENCV_FISHEYE", (*pinhole, *k), width, height)
    if any(k[4:]):
        return Lens("FULL_OPENCV", (*pinhole, *(*k, 0.0, 0.0, 0.0)[:8]), width, height)
    return Lens("OPENCV", (*pinhole, *k[:4]), width, height) if any(k) else Lens("PINHOLE", pinhole, width, height)


def lens_from_camera(camera: Any) -> Lens:
    """The lens of a pycolmap camera."""
    return Lens(camera.model_name, tuple(float(x) for x in camera.params), int(camera.width), int(camera.height))


def lens_text(lens: Lens) -> str:
    """Model, size and parameters on one line, for reports."""
    return f"{lens.model} {lens.width}×{lens.height} " + " ".join(f"{value:.6g}" for value in lens.params)


def camera_from_lens(lens: Lens, camera_id: int = 1) -> Any:
    """The pycolmap camera of a lens."""
    pycolmap = load_pycolmap()
    size, params = {"width": lens.width, "height": lens.height}, list(lens.params)
    with refusing(f"camera model {lens.model} is not known to pycolmap, or its parameters do not fit"):
        camera = pycolmap.Camera(model=lens.model, params=params, camera_id=camera_id, **size)
        valid = camera.verify_params() and np.isfinite(params).all()
    if not valid or camera.mean_focal_length() <= 0:
        raise InputError(f"camera {lens.model}: the parameters {params} are not valid")
    return camera


def rescale_lens(lens: Lens, width: int, height: int) -> Lens:
    """The lens for photos resized to width × height; parameters are scaled by the exact ratio of each axis."""
    camera = camera_from_lens(lens)
    camera.rescale(width, height)
    return lens_from_camera(camera)


@lru_cache(maxsize=256)
def pinhole_from_lens(lens: Lens) -> tuple[tuple[float, float, float, float], int, int]:
    """(fx, fy, cx, cy), width, height of the pinhole image that `lens` undistorts to.
    As COLMAP's default: focal lengths are kept, the size is chosen so that no pixel is blank (0.2 to 2 times that of
    the photo). Values of a lens without distortion are returned unchanged. InputError where undistortion fails, and for
    a principal point in the first pixel of the photo: it is not in pixels."""
    ideal, plain, pycolmap = camera_from_lens(lens), is_pinhole(lens), load_pycolmap()
    x, y = float(ideal.principal_point_x), float(ideal.principal_point_y)
    with refusing(f"camera model {lens.model} cannot be undistorted to a pinhole"):
        ideal = ideal if plain else pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), ideal)
    fx, fy = float(ideal.focal_length_x), float(ideal.focal_length_y)
    cx, cy = float(ideal.principal_point_x), float(ideal.principal_point_y)
    least = LEAST_FOCAL * max(lens.width, lens.height)
    # Beyond the range of real cameras, float32 cannot resolve the rays of pixels.
    if not (min(fx, fy) >= least and max(fx, fy) <= MOST_PIXELS and max(abs(cx), abs(cy)) <= MOST_PIXELS):
        raise InputError(
            f"camera {lens.model} {list(lens.params)}: seen as a pinhole of focal lengths {fx:g}, {fy:g} "
            f"and centre {cx:g}, {cy:g}; expected {least:g} to {MOST_PIXELS:g} and at most {MOST_PIXELS:g} pixels"
        )
    if min(x, y) >= 0 and max(x, y) <= min(1, lens.width / 8, lens.height / 8):
        found = f"camera {lens.model} {list(lens.params)}: its principal point is ({x:g}, {y:g})"
        raise InputError(f"{found}, expected pixels, about ({lens.width / 2:g}, {lens.height / 2:g})")
    width, height = int(ideal.width), int(ideal.height)
    if min(width, height) < (1 if plain else 2) or max(width, height) > MOST_SIDE:
        raise InputError(f"camera {lens.model}: {width}×{height} pixels, expected sides of 1 to {MOST_SIDE}")
    return (fx, fy, cx, cy), width, height


def same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether two sizes (width, height) are of one aspect ratio, as those of a photo and of its depth or its mask."""
    return abs(a[0] * b[1] / (a[1] * b[0]) - 1) <= _ASPECT


def resized(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether a photo of size b (width, height) may be one of size a, resized: by one ratio, to less than a pixel of
    the smaller one, as programs round up or down."""
    (small_w, small_h), (large_w, large_h) = sorted((a, b))
    low = max((small_w - 1) / large_w, (small_h - 1) / large_h)
    high = min((small_w + 1) / large_w, (small_h + 1) / large_h)
    return low < high and small_h <= large_h


def is_pinhole(lens: Lens) -> bool:
    """True when photos of this lens need no undistortion."""
    if lens.model in _PINHOLES:
        return True
    if lens.model == "EQUIRECTANGULAR" or "FISHEYE" in lens.model or lens.model == "FOV":
        return False
    camera = camera_from_lens(lens)
    return not any(camera.params[index] for index in camera.extra_params_idxs())


@lru_cache(maxsize=256)
def lens_warnings(lens: Lens) -> list[str]:
    """A line on a principal point far from the middle, as of a camera for another size of photo, and one on distortion
    that folds: from the centre out, undistorted photos show what they have shown before."""
    camera, told = camera_from_lens(lens), f"camera {lens_text(lens)}"
    centre, warnings = np.array([camera.principal_point_x, camera.principal_point_y]), list[str]()
    if (np.abs(centre / (lens.width, lens.height) - 0.5) > _OFF_CENTRE).any():
        where = f"its principal point ({centre[0]:.6g}, {centre[1]:.6g}) lies far from the middle of the photo"
        warnings.append(f"{told}: {where}; unless the photos are cut so, give it in pixels of photos of this size")
    if is_pinhole(lens):
        return warnings
    (fx, fy, cx, cy), width, height = pinhole_from_lens(lens)
    border = np.array([(x, y) for x in (0, 0.5, 1) for y in (0, 0.5, 1) if (x, y) != (0.5, 0.5)]) * (width, height)
    out = (border - (cx, cy))[:, None] / (fx, fy) * np.linspace(0, 1, 65)[:, None]  # x/z, y/z [8, 65, 2]
    rays = np.concatenate([out, np.ones((*out.shape[:2], 1))], axis=2).reshape(-1, 3)
    pixels = np.asarray(camera.img_from_cam(rays), np.float64).reshape(out.shape)
    steps = np.diff(np.linalg.norm(pixels - pixels[:, :1], axis=2), axis=1)
    inside = np.all((pixels > 0) & (pixels < (lens.width, lens.height)), axis=2)
    if (inside[:, 1:] & (steps <= 0)).any():
        folded = "its distortion folds the picture, so that undistorted photos show things twice towards the border"
        warnings.append(f"{told}: {folded}; calibrate it again, or give undistorted photos")
    return warnings


@lru_cache(maxsize=4)
def warp_grid(
    lens: Lens, pinhole: tuple[float, float, float, float], width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Photo coordinates x, y [height, width] float32 (pixel centres at +0.5) that each pinhole pixel centre maps to."""
    fx, fy, cx, cy = pinhole
    camera = camera_from_lens(lens)
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(width * height)], axis=1)
    pixels = np.asarray(camera.img_from_cam(rays), dtype=np.float32).reshape(height, width, 2)
    grid = np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
    for part in grid:
        part.setflags(write=False)
    return grid
