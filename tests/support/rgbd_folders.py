"""RGB-D recordings of a slanted textured wall in every layout, with poses and depth in closed form.

World: the plane z = 2 + 0.3 x. Camera i has moved STEP i along x and turned TURN i about y.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

COUNT, STEP, TURN, SLOPE = 12, 0.05, 0.04, 0.3
SIZE = (160, 120)
_UNITS = {"tum": 5000, "3rscan": 2000}  # per metre
NAMED = {  # (fx, fy, cx, cy) of photos of SIZE, pixel centres at whole numbers, and the same of depth
    "tum": ((133.85, 134.8, 79.65, 61.525), None),  # freiburg3, 640 × 480, at a quarter
    "scannet": ((140.0, 141.0, 79.0, 60.5), (120.0, 119.0, 78.5, 58.0)),
    "7scenes": ((131.25, 131.25, 79.625, 59.625), (146.25, 146.25, 79.625, 59.625)),  # 525 and 585 at a quarter
    "3dmatch": ((140.0, 141.0, 79.0, 60.5), None),
    "redwood": ((140.0, 141.0, 79.0, 60.5), None),
    "3rscan": ((140.0, 141.0, 79.0, 60.5), (120.0, 119.0, 78.5, 58.0)),
}


def pose(index: float) -> np.ndarray:
    """world_from_camera [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("y", TURN * index).as_matrix()
    matrix[0, 3] = STEP * index
    return matrix


def wall_depth(K: np.ndarray, world_from_camera: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth [height, width] in metres at pixel centres (+0.5) of pinhole K [3, 3], and the points hit [h, w, 3]."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    rays, eye = rays @ world_from_camera[:3, :3].T, world_from_camera[:3, 3]
    normal = np.array([-SLOPE, 0.0, 1.0])
    depth = (2.0 - eye @ normal) / (rays @ normal)
    return depth, eye + depth[..., None] * rays


def matrix(values: tuple[float, ...], centre: float = 0.5) -> np.ndarray:
    fx, fy, cx, cy = values
    return np.array([[fx, 0, cx + centre], [0, fy, cy + centre], [0, 0, 1.0]])


def picture(points: np.ndarray) -> np.ndarray:
    texture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    x, y = ((points[..., axis] * 12 + 32).astype(np.float32) % 63 for axis in (0, 1))
    return np.asarray(cv2.remap(texture, x, y, cv2.INTER_LINEAR))


@cache
def _frames_of(layout: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Photos and depth images as stored; of depth, four rows are 0 and four saturated."""
    photo_lens, depth_lens = NAMED[layout]
    units, frames = _UNITS.get(layout, 1000), []
    for index in range(COUNT):
        _, points = wall_depth(matrix(photo_lens), pose(index), *SIZE)
        depth, _ = wall_depth(matrix(depth_lens or photo_lens), pose(index), *SIZE)
        depth[:4], depth[4:8] = 0, 65535 / units
        frames.append((picture(points), np.round(depth * units).astype(np.uint16)))
    return frames


def write_recording(folder: Path, layout: str) -> Path:
    """Writes the recording of COUNT frames; returns the folder to map."""
    source = folder / ("rgbd_dataset_freiburg3_wall" if layout == "tum" else layout)
    write = {"tum": _tum, "scannet": _scannet, "redwood": _redwood, "3rscan": _sensor}.get(layout, _frames)
    write(source, _frames_of(layout))
    if layout == "3dmatch":
        np.savetxt(source / "camera-intrinsics.txt", matrix(NAMED[layout][0], 0.0))
    return source


def _save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def _tum(source: Path, frames: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Photos every 0.1 s, depth 10 ms later, poses 30 ms before and after each photo."""
    lines: dict[str, list[str]] = {
        "rgb": ["# a comment"],
        "depth": [],
        "groundtruth": ["# timestamp tx ty tz qx qy qz qw"],
    }
    for index, (photo, depth) in enumerate(frames):
        time = 100 + 0.1 * index
        for name, image, at in (("rgb", photo, time), ("depth", depth, time + 0.01)):
            _save(source / name / f"{at:.6f}.png", image)
            lines[name].append(f"{at:.6f} {name}/{at:.6f}.png")
        for apart in (-0.03, 0.03):
            there = pose(index + 10 * apart)
            values = [time + apart, *there[:3, 3], *Rotation.from_matrix(there[:3, :3]).as_quat()]
            lines["groundtruth"].append(" ".join(f"{value:.9f}" for value in values))
    for name, rows in lines.items():
        (source / f"{name}.txt").write_text("\n".join(rows) + "\n")


def _scannet(source: Path, frames: list[tuple[np.ndarray, np.ndarray]]) -> None:
    for name in ("pose", "intrinsic"):
        (source / name).mkdir(parents=True)
    for index, (photo, depth) in enumerate(frames):
        _save(source / "color" / f"{index}.png", photo)
        _save(source / "depth" / f"{index}.png", depth)
        lost = np.full((4, 4), -np.inf)
        np.savetxt(source / "pose" / f"{index}.txt", lost if index == 5 else pose(index))
    for name, lens in zip(("color", "depth"), NAMED["scannet"], strict=True):
        K = np.eye(4)
        K[:3, :3] = matrix(lens, 0.0)  # type: ignore[arg-type]
        np.savetxt(source / "intrinsic" / f"intrinsic_{name}.txt", K)


def _frames(source: Path, frames: list[tuple[np.ndarray, np.ndarray]]) -> None:
    for index, (photo, depth) in enumerate(frames):
        stem = source / "seq-01" / f"frame-{index:06d}"
        _save(stem.with_suffix(".color.png"), photo)
        _save(stem.with_suffix(".depth.png"), depth)
        np.savetxt(stem.with_suffix(".pose.txt"), pose(index))


def _sensor(source: Path, frames: list[tuple[np.ndarray, np.ndarray]]) -> None:
    _frames(source, frames)
    for file in (source / "seq-01").iterdir():
        depth = file.name.endswith(".depth.png")
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) if depth else None
        file = file.rename(source / file.name)
        if image is not None:
            cv2.imwrite(str(file.with_suffix(".pgm")), image)
            file.unlink()
    lines = ["m_versionNumber = 4", "m_sensorName = Tango", f"m_depthShift = {_UNITS['3rscan']}"]
    for name, lens in zip(("Color", "Depth"), NAMED["3rscan"], strict=True):
        K = np.eye(4)
        K[:3, :3] = matrix(lens, 0.0)  # type: ignore[arg-type]
        lines += [f"m_{name.lower()}{side} = {n}" for side, n in zip(("Width", "Height"), SIZE, strict=True)]
        lines.append(f"m_calibration{name}Intrinsic = " + " ".join(f"{value:g}" for value in K.ravel()))
    (source / "_info.txt").write_text("\n".join(lines) + "\n")


def _redwood(source: Path, frames: list[tuple[np.ndarray, np.ndarray]]) -> None:
    rows = []
    for index, (photo, depth) in enumerate(frames):
        _save(source / "image" / f"{index + 1:06d}.png", photo)
        _save(source / "depth" / f"{index + 1:06d}.png", depth)
        rows += [f"{index} {index} {index + 1}", *(" ".join(f"{v:.9f}" for v in row) for row in pose(index))]
    (source / "wall.log").write_text("\n".join(rows) + "\n")
    camera = {"width": SIZE[0], "height": SIZE[1]}
    K = matrix(NAMED["redwood"][0], 0.0)
    (source / "camera_intrinsic.json").write_text(json.dumps({**camera, "intrinsic_matrix": K.T.ravel().tolist()}))
