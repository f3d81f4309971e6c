"""Tasks in folders that every worker of an engine reaches: a part of the scene, and what else a task must know."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.io.inputs import load_saved_scene, save_scene
from perception.pipeline.record import versions
from perception.types import Scene

TASK, SCENE = "task.json", "scene"


def write_task(folder: Path, scene: Scene, **facts: Any) -> None:
    """Writes a task with JSON-able facts to `folder`."""
    save_scene(folder / SCENE, scene)
    with atomic_file(folder / TASK) as aside:
        aside.write_text(json.dumps({**facts, "versions": versions()}), encoding="utf-8")


def has_task(folder: Path) -> bool:
    """Whether a whole task lies in `folder`."""
    return (folder / TASK).is_file()


def read_task(folder: Path) -> tuple[Scene, dict[str, Any]]:
    """The scene and the facts. InputError where the task was written by another version of the program."""
    facts = json.loads((folder / TASK).read_text(encoding="utf-8"))
    own, theirs = versions(), facts["versions"]
    for name in sorted({*own, *theirs}):
        if own.get(name) != theirs.get(name):
            found = f"this worker has {name} {own.get(name)}, the run {theirs.get(name)}"
            raise InputError(f"{folder}: {found}; install the same")
    scene = load_saved_scene(folder / SCENE)
    if scene is None:
        raise InputError(f"{folder}: the part of the scene is missing; delete the folder and run again")
    return scene, facts
