"""Photos of noise with exact poses, as COLMAP models and JSON with frames, and their scenes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from perception.geometry import inverse_se3
from perception.inputs.load import load_scene
from perception.io.cloud import write_cloud
from perception.photos.lens import load_pycolmap
from perception.sfm.options import ReadOptions
from perception.types import PointCloud, Scene
from support.aimed import look_at

SIZE = (64, 48)
CAMERA = "1 PINHOLE 64 48 60 61 32 24"
NAMES = [f"{index}.png" for index in range(8)]


def pose(index: int) -> np.ndarray:
    """camera_from_world [4, 4] of photo `index`: cameras in a row that look at the origin."""
    return look_at(np.array([0.3 * index - 1, -3.0, 1.0]), np.zeros(3), np.array([0, 0, 1.0]))


def photo(path: Path, index: int = 0, size: tuple[int, int] = SIZE, **options: Any) -> np.ndarray:
    pixels = np.random.default_rng(index).integers(0, 255, (*size[::-1], 3), dtype=np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return pixels


def write_model(folder: Path, names: list[str] = NAMES, cameras: str = CAMERA, points: int = 60) -> Path:
    """A text model with the exact poses of `pose`, and points without tracks."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(f"# Camera list\n#   CAMERA_ID, MODEL, WIDTH\n{cameras}\n")
    lines = ["# Image list, two lines each"]
    for index, name in enumerate(names):
        lines += [f"{index + 1} {numbers(pose(index))} 1 {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    xyz = np.random.default_rng(0).normal(0, 0.5, (points, 3))
    rows = [f"{i + 1} {x:.6f} {y:.6f} {z:.6f} 10 20 30 0.5" for i, (x, y, z) in enumerate(xyz)]
    (folder / "points3D.txt").write_text("# 3D point list, with commas, in its head\n" + "\n".join(rows) + "\n")
    return folder


def numbers(matrix: np.ndarray) -> str:
    rotation = load_pycolmap().Rotation3d(matrix[:3, :3])
    x, y, z, w = rotation.quat
    return " ".join(f"{value:.17g}" for value in (w, x, y, z, *matrix[:3, 3]))


def workspace(
    folder: Path, model: str = "sparse/0", photos: str = "images", names: list[str] = NAMES, **kw: Any
) -> Path:
    for index, name in enumerate(names):
        photo(folder / photos / name, index)
    write_model(folder / model, names, **kw)
    return folder


def frames_of(prefix: str = "images/", count: int = 8) -> list[dict[str, Any]]:
    worlds = [inverse_se3(pose(index)) @ np.diag([1, -1, -1, 1]) for index in range(count)]
    return [
        {"file_path": f"{prefix}{name}", "transform_matrix": w.tolist()} for name, w in zip(NAMES, worlds, strict=False)
    ]


def transforms(folder: Path, prefix: str = "images/", **changes: Any) -> dict[str, Any]:
    for index, name in enumerate(NAMES):
        photo(folder / "images" / name, index)
    write_cloud(folder / "c.ply", PointCloud(np.random.default_rng(0).normal(0, 0.5, (60, 3))))
    data = {"w": 64, "h": 48, "fl_x": 60, "fl_y": 61, "cx": 32, "cy": 24, "ply_file_path": "c.ply"}
    data |= {"frames": frames_of(prefix), **changes}
    (folder / "transforms.json").write_text(json.dumps(data))
    return data


def loaded(source: Path, strict: bool = False, masks: Path | None = None) -> Scene:
    work = source.parent / f"work{strict}" if source.is_file() else source.parent / f"{source.name}.gsmap.work{strict}"
    return load_scene(source, ReadOptions(work, poses="keep", strict=strict, masks=masks))


def check_poses(scene: Scene, kept: list[int] | None = None) -> None:
    """The views are the photos `kept` (None: all), with the poses that were written."""
    numbered = list(range(8)) if kept is None else kept
    assert [view.photo.stem for view in scene.views] == [str(index) for index in numbered]
    for view, index in zip(scene.views, numbered, strict=True):
        np.testing.assert_allclose(view.camera_from_world, pose(index), atol=1e-9)
        assert view.K[0, 0] == 60 and view.K[1, 1] == 61
