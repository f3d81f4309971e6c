"""Calibration against cameras that are known exactly, and what it is worth to structure from motion: `bench calibrate`.

Boards are rendered as a pinhole camera with plumb_bob distortion and as an equidistant fisheye would take them, then
calibrated; printed are each parameter's error and the uncertainty claimed for it. With --sfm SCENE (photos and exact
poses: transforms.json, pinhole) the same lenses are also put over every --every-th photo of the scene, and structure
from motion runs on them with the calibration just made and without: errors of the camera positions, in thousandths of
the scene's unit, after a similarity.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.calibration.board import Board
from perception.calibration.run import run_calibration
from perception.calibration.solve import NAMES
from perception.calibration.synthetic import KnownCamera, board_views, render_board
from perception.errors import InputError
from perception.geometry import align_similarity, rotation_angle

LENSES = {
    "pinhole": (0.95, 0.96, 0.515, 0.475, -0.18, 0.06, 0.0008, -0.0006, 0.0),
    "fisheye": (0.78, 0.785, 0.49, 0.512, -0.04, 0.01, -0.004, 0.0006),
}
"""Focal lengths as shares of the width, principal point of width and height, then the distortion."""


def known_camera(model: str, size: tuple[int, int], within: np.ndarray | None = None) -> KnownCamera:
    """One of LENSES for pictures of (width, height) pixels.

    within [2]: the lens is made longer until it sees no x / z, y / z beyond these.
    """
    scale = 1.0
    while True:
        values = np.array(LENSES[model])
        values[:4] *= [scale * size[0], scale * size[0], size[0], size[1]]
        camera = KnownCamera(model, values, size)
        if within is None or (np.abs(camera.rays).reshape(-1, 2).max(axis=0) <= within).all():
            return camera
        scale *= 1.03


def seen_by(scene: Path) -> np.ndarray:
    """The largest |x / z|, |y / z| that all sides of a pinhole scene's photos show."""
    from perception.io.transforms import read_frames

    lens = read_frames(scene / "transforms.json")[0][2]
    fx, fy, cx, cy = lens.params[:4]
    return np.array([min(cx, lens.width - cx) / fx, min(cy, lens.height - cy) / fy])


def make_boards(folder: Path, board: Board, camera: KnownCamera, count: int, noise: float) -> None:
    """Pictures of the board in `folder`."""
    folder.mkdir(parents=True)
    reach = 0.8 if board.kind == "charuco" else 0.4
    for number, pose in enumerate(board_views(board, camera, count, reach=reach)):
        cv2.imwrite(str(folder / f"{number:03d}.png"), render_board(board, camera, pose, number, noise))


def calibrate_known(work: Path, board: Board, camera: KnownCamera, args: argparse.Namespace) -> dict[str, Any]:
    """One rendered set calibrated: rows of every parameter, and the camera file's path."""
    make_boards(work / "boards", board, camera, args.views, args.noise)
    began = time.process_time()
    result, _ = run_calibration(work / "boards", work / "camera.yaml", board, "auto", work / "detections")
    found = result["parameters"]
    rows = {
        name: {"true": float(true), **found.get(name, {"value": 0.0, "sigma": 0.0})}
        for name, true in zip(NAMES[camera.model], camera.values, strict=True)
    }
    for row in rows.values():
        row["error"] = row["value"] - row["true"]
    return {
        "model": camera.model,
        "found_model": result["model"],
        "board": str(board),
        "views": len(result["views"]),
        "reprojection_error_px": result["reprojection_error_px"],
        "coverage": result["coverage"],
        "cpu_seconds": time.process_time() - began,
        "parameters": rows,
        "camera": str(work / "camera.yaml"),
    }


def warp_photos(scene: Path, folder: Path, camera: KnownCamera, every: int) -> dict[str, np.ndarray]:
    """Every n-th photo of a pinhole scene as `camera` would have taken it; returns camera_from_world by name."""
    from perception.io.transforms import read_frames

    folder.mkdir(parents=True)
    poses = {}
    steps = camera.rays.shape[0] // camera.size[1]
    rays = camera.rays.reshape(camera.size[1], steps, camera.size[0], steps, 2).mean(axis=(1, 3))
    for name, camera_from_world, lens in read_frames(scene / "transforms.json")[::every]:
        if lens.model != "PINHOLE" or (lens.width, lens.height) != camera.size:
            raise InputError(f"{scene}: --sfm needs pinhole photos of {camera.size[0]}x{camera.size[1]} pixels")
        fx, fy, cx, cy = lens.params
        where = (rays * [fx, fy] + [cx - 0.5, cy - 0.5]).astype(np.float32)
        photo = cv2.imread(str(scene / name))
        if photo is None:
            raise InputError(f"{scene / name}: is no readable photo")
        warped = cv2.remap(photo, where[..., 0], where[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
        out = f"{Path(name).stem}.png"
        cv2.imwrite(str(folder / out), warped)
        poses[out] = camera_from_world
    return poses


def pose_errors(photos: Path, truth: dict[str, np.ndarray], camera_file: Path | None, work: Path) -> dict[str, Any]:
    """Structure from motion of a folder of photos against exact poses."""
    from perception.io.inputs import load_scene

    began = time.process_time()
    scene = load_scene(photos, work, camera_file=camera_file)
    views = {view.name: view.camera_from_world for view in scene.views}
    names = sorted(views)
    centers = [
        np.stack([-p[:3, :3].T @ p[:3, 3] for p in poses])
        for poses in ([truth[n] for n in names], [views[n] for n in names])
    ]
    scale, rotation, shift = align_similarity(*centers)
    moved = scale * centers[1] @ rotation.T + shift
    distance = np.linalg.norm(moved - centers[0], axis=1)
    turned = np.stack([truth[n][:3, :3] @ rotation @ views[n][:3, :3].T for n in names])
    return {
        "registered": f"{len(names)} of {len(truth)}",
        "position_rms": float(1000 * np.sqrt((distance**2).mean())),
        "position_max": float(1000 * distance.max()),
        "rotation_median_degrees": float(np.median(rotation_angle(turned))),
        "reprojection_error_px": scene.report.get("mean_reprojection_error_px"),
        "cpu_seconds": time.process_time() - began,
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Prints tables, or one JSON object with --json."""
    parser = argparse.ArgumentParser(prog="perception bench calibrate", description=__doc__)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--noise", type=float, default=2.0, help="grey levels")
    parser.add_argument("--boards", default="charuco", help="charuco, checkerboard or both, by comma")
    parser.add_argument("--models", default="pinhole,fisheye")
    parser.add_argument("--sfm", type=Path, metavar="SCENE")
    parser.add_argument("--every", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    width, height = (int(word) for word in args.size.split("x"))
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for kind in args.boards.split(","):
            for model in args.models.split(","):
                work = Path(folder) / f"{kind}_{model}"
                camera = known_camera(model, (width, height), seen_by(args.sfm) if args.sfm else None)
                result = calibrate_known(work, Board(kind, (8, 11), 0.02, 0.015), camera, args)
                if args.sfm is not None:
                    truth = warp_photos(args.sfm, work / "photos", camera, args.every)
                    for name, file in (("with", Path(result["camera"])), ("without", None)):
                        result[f"sfm_{name}"] = pose_errors(work / "photos", truth, file, work / f"sfm_{name}")
                results.append(result)
                if not args.json:
                    print(_table(result), flush=True)
    if args.json:
        print(json.dumps({"arguments": {k: str(v) for k, v in vars(args).items()}, "results": results}))


def _table(result: dict[str, Any]) -> str:
    lines = [
        f"{result['model']} (found: {result['found_model']}), {result['board']}, {result['views']} views, "
        f"{result['reprojection_error_px']:.3f} px, corners cover {result['coverage']:.0%}, "
        f"{result['cpu_seconds']:.1f} CPU s",
        f"{'':6}{'true':>12}{'error':>12}{'sigma':>12}{'error/sigma':>12}",
    ]
    for name, row in result["parameters"].items():
        ratio = f"{row['error'] / row['sigma']:>12.1f}" if row["sigma"] else f"{'fixed':>12}"
        lines.append(f"{name:6}{row['true']:>12.5f}{row['error']:>+12.5f}{row['sigma']:>12.5f}{ratio}")
    for name in ("with", "without"):
        if f"sfm_{name}" in result:
            sfm = result[f"sfm_{name}"]
            lines.append(
                f"SfM {name:8} calibration: {sfm['registered']} photos, positions rms {sfm['position_rms']:.2f} max "
                f"{sfm['position_max']:.2f} (thousandths), rotations {sfm['rotation_median_degrees']:.3f} deg, "
                f"{sfm['reprojection_error_px'] or float('nan'):.3f} px, {sfm['cpu_seconds']:.0f} CPU s"
            )
    return "\n".join(lines)
