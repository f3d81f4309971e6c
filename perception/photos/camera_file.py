"""Camera calibrations in ROS camera_info YAML, the format of the ROS package camera_calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import write_file
from perception.io.documents import brief, read_yaml
from perception.photos.lens import FISHEYE, MOST_SIDE, PERSPECTIVE, opencv_lens
from perception.types import Lens

_NAMES: dict[str, tuple[str, ...]]
_NAMES = dict.fromkeys(("plumb_bob", "rational_polynomial", "radtan", "brown_conrady"), PERSPECTIVE)
_NAMES |= dict.fromkeys(("equidistant", "fisheye", "kannala_brandt4"), FISHEYE)
_NAMES |= dict.fromkeys(("none", "inverse_brown_conrady", "modified_brown_conrady"), ())
"""The coefficients of distortion models of ROS, Kalibr and librealsense that may differ from zero."""
_SKEW = 1e-3
"""Largest number relative to fx where a camera matrix without skew has 0; matrices by columns have cx there."""
_COUNTS = (0, 4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV reads; a driver may write zeros behind those of its model."""


def read_camera(path: Path) -> Lens:
    """The lens in a camera_info file, in pixels; InputError as `lens_of`."""
    return lens_of(read_yaml(path, "ROS camera_info"), path)


def lens_of(data: Any, where: object) -> Lens:
    """The lens of a camera_info; distortion models: see _NAMES; without a name plumb_bob.
    The centre of the first pixel is (0, 0) in ROS and OpenCV and (0.5, 0.5) in COLMAP and this project, so 0.5 is added
    to the principal point. InputError that names `where` for values that are missing or describe no camera."""
    if not isinstance(data, dict):
        raise InputError(f"{where}: expected a ROS camera_info mapping with image_width, image_height, camera_matrix")
    width, height = (int(_numbers(data.get(key), 1, where, key)[0]) for key in ("image_width", "image_height"))
    matrix = _numbers(_data(data, "camera_matrix"), 9, where, "camera_matrix.data").reshape(3, 3)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    if min(width, height) < 1 or max(width, height) > MOST_SIDE or min(fx, fy) <= 0:
        sides = f"{width:.6g}×{height:.6g}, {fx:g}, {fy:g}"
        raise InputError(f"{where}: image sides must be 1 to {MOST_SIDE} pixels, focal lengths positive; found {sides}")
    if np.abs(matrix[[0, 1, 2, 2], [1, 0, 0, 1]]).max() > _SKEW * fx:
        row = " ".join(f"{value:g}" for value in matrix.ravel())
        raise InputError(f"{where}: camera_matrix must be fx 0 cx 0 fy cy 0 0 1, row by row, found {row}")
    name = data.get("distortion_model") or "plumb_bob"
    names = _NAMES.get(name.lower().replace(" ", "_")) if isinstance(name, str) else None
    if names is None:
        raise InputError(f"{where}: distortion_model {brief(name)} is not known; expected one of {', '.join(_NAMES)}")
    values = _data(data, "distortion_coefficients")
    found = len(values) if isinstance(values, (list, tuple)) else -1
    if found not in _COUNTS:
        expected, counted = ", ".join(map(str, _COUNTS)), found if found >= 0 else "no list of them"
        raise InputError(f"{where}: expected {expected} distortion_coefficients, found {counted}")
    k = _numbers(values, found, where, "distortion_coefficients.data").tolist()
    if any(k[len(names) :]):
        known = f"the first {len(names)} coefficients of {name} may differ from 0"
        raise InputError(f"{where}: {known}, found {k}; undistort the photos, or calibrate with another model")
    k = [*k, *[0.0] * len(names)][: len(names)]
    return opencv_lens((float(fx), float(fy), float(cx), float(cy)), k, width, height, names == FISHEYE)


def camera_info(message: Any, rectified: bool = False) -> dict[str, Any]:
    """The camera_info of a ROS CameraInfo message (ROS 1 or 2), of its region of interest if the images are cut to one.
    rectified: by its projection matrix P, or by K where P is not set and there is no distortion; InputError where
    there is."""

    def field(name: str) -> list[float]:
        values = getattr(message, name.lower(), None)
        return [float(v) for v in (getattr(message, name.upper()) if values is None else values)]

    size, kind = (int(message.width), int(message.height)), str(message.distortion_model) or "plumb_bob"
    K, P, distortion = field("k"), field("p"), field("d")
    roi, binned = getattr(message, "roi", None), getattr(message, "binning_x", 0) > 1  # stated as a region, too
    if roi is not None and not binned and roi.width and roi.height and (roi.width, roi.height) != size:
        size, x, y = (int(roi.width), int(roi.height)), roi.x_offset, roi.y_offset
        K = np.subtract(K, [0, 0, x, 0, 0, y, 0, 0, 0]).tolist()
        P = np.subtract(P, [0, 0, x, 0, 0, 0, y, 0, 0, 0, 0, 0]).tolist()
    unset = len(P) < 12 or not np.isfinite(P).all() or min(P[0], P[5]) <= 0
    if rectified and unset and any(distortion):
        raise InputError("the camera_info of rectified images has distortion, and no projection matrix P")
    if rectified and not unset:
        return camera_data("camera", size, "plumb_bob", [*P[0:3], *P[4:7], *P[8:11]], [0.0] * 5)
    return camera_data("camera", size, kind, K, distortion)


def camera_data(name: str, size: tuple[int, int], kind: str, K: list[float], distortion: list[float]) -> dict[str, Any]:
    """The camera_info of intrinsics K, row by row, in the convention of OpenCV and ROS: the centre of the first pixel
    is (0, 0). size: (width, height). kind: of the distortion. The rectified camera is the same camera."""
    blocks = {
        "camera_matrix": (3, 3, K),
        "distortion_coefficients": (1, len(distortion), distortion),
        "rectification_matrix": (3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        "projection_matrix": (3, 4, [*K[0:3], 0.0, *K[3:6], 0.0, *K[6:9], 0.0]),
    }
    data = {"image_width": size[0], "image_height": size[1], "camera_name": name, "distortion_model": kind}
    return data | {key: {"rows": r, "cols": c, "data": numbers} for key, (r, c, numbers) in blocks.items()}


def write_camera(path: Path, data: dict[str, Any]) -> None:
    """Writes a camera_info as YAML."""
    import yaml

    write_file(path, yaml.safe_dump(data, sort_keys=False, default_flow_style=None))


def _data(data: dict[str, Any], key: str) -> Any:
    block = data.get(key)
    return block.get("data") if isinstance(block, dict) else block


def _numbers(value: Any, count: int, where: object, key: str) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.size != count or not np.isfinite(array).all():
        raise InputError(f"{where}: {key} must hold {count} finite number(s), found {brief(value)}")
    return array
