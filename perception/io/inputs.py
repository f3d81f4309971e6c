"""Reading any input as a Scene: a transforms.json, a COLMAP workspace or a folder of photos."""

from __future__ import annotations

import time
from pathlib import Path

from perception.errors import InputError
from perception.io.features import Progress
from perception.types import Lens, Scene


def load_scene(
    source: Path,
    workdir: Path,
    *,
    camera_file: Path | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> Scene:
    """Read `source` as what it is and return posed views, sorted by name, with a sparse cloud.

    A folder that is a COLMAP workspace is read as one even if it holds more; then a folder with a transforms.json; any
    other folder is photos, posed by structure from motion. `workdir` keeps features and models so that a second call
    is quick. camera_file: ROS camera_info with the intrinsics of all photos, for a folder of photos only.
    progress(stage, fraction) is called as stages advance ("features", "matching", "mapping").
    """
    from perception.io.colmap import is_workspace, read_workspace
    from perception.io.sfm import reconstruct
    from perception.io.transforms import read_transforms

    source, workdir = Path(source), Path(workdir)
    tell = progress or _silent
    started = time.perf_counter()
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; expected photos, a COLMAP workspace or transforms.json")
    file = source / "transforms.json" if source.is_dir() else source
    photos_only = source.is_dir() and not is_workspace(source) and not file.is_file()
    if camera_file is not None and not photos_only:
        raise InputError(f"{camera_file}: a camera file goes with a folder of photos; {source} brings its own cameras")
    workdir.mkdir(parents=True, exist_ok=True)
    if photos_only:
        scene = reconstruct(source, workdir, _lens(camera_file), seed, tell)
    elif source.is_dir() and is_workspace(source):
        scene = read_workspace(source, workdir, seed, tell)
    elif file.suffix.lower() == ".json":
        scene = read_transforms(file, workdir, seed, tell)
    else:
        raise InputError(f"{source}: expected a folder of photos, a COLMAP workspace or a transforms.json")
    scene.report["seconds"]["total"] = time.perf_counter() - started
    return scene


def _lens(camera_file: Path | None) -> Lens | None:
    from perception.io.camera_file import read_camera

    return None if camera_file is None else read_camera(camera_file)


def _silent(stage: str, fraction: float) -> None:
    """Reports to nobody."""
