"""Scenes on disk: a resumed run, and the tasks of a run, start from the same poses and points."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.io.arrays import read_npz
from perception.io.atomic import atomic_directory
from perception.photos.view_json import view_from_json, view_json
from perception.types import Scene, View


def save_scene(folder: Path, scene: Scene) -> None:
    """Writes `scene` to `folder` atomically; photos are not copied."""
    views = [view_json(view) for view in scene.views]
    facts = {"views": views, "metric": scene.metric, "frame": scene.frame, "report": scene.report}
    with atomic_directory(folder) as aside:
        (aside / "scene.json").write_text(json.dumps(facts, default=str), encoding="utf-8")
        np.savez(aside / "points.npz", points=scene.points, colors=scene.point_colors)


def load_saved_scene(folder: Path) -> Scene | None:
    """The scene saved in `folder`; None when there is none. InputError when it is damaged."""
    if not (folder / "scene.json").is_file():
        return None
    try:
        facts = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
        arrays = read_npz(folder / "points.npz", folder / "points.npz", "")
        points, colors = arrays["points"], arrays["colors"]
        views: list[View] = [view_from_json(entry) for entry in facts["views"]]
        return Scene(views, points, colors, facts["metric"], facts["frame"], facts["report"])
    except Exception as error:  # damaged files raise errors of many classes
        raise InputError(f"{folder}: the kept poses are damaged; delete {folder.parent} to start over") from error
