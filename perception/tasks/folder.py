"""Task folders, which every worker of an engine reaches: what a task must know, part of the scene, its result."""

from __future__ import annotations

import functools
import json
import platform
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from perception.errors import InputError
from perception.io.atomic import atomic_directory, write_file
from perception.machine import blas_on_one_thread
from perception.photos.scene_file import load_saved_scene, save_scene
from perception.progress import QUIET, Progress
from perception.tasks.engine import Engine
from perception.types import Scene

TASK, SCENE, RESULT = "task.json", "scene", "result"
Work = Callable[[Path, dict[str, Any], Path, Progress], None]
"""Of a task: its folder, its facts, the new folder for what it makes."""


def write_task(folder: Path, scene: Scene | None = None, **facts: Any) -> None:
    """Writes a task with JSON-able facts to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    if scene is not None:
        save_scene(folder / SCENE, scene)
    write_file(folder / TASK, json.dumps({**facts, "versions": versions()}))


def renew_task(folder: Path, scene: Scene | None, **facts: Any) -> None:
    """`write_task`, or only other facts where a task lies in `folder`. InputError as `read_facts`."""
    if has_task(folder):
        read_facts(folder)
        scene = None
    write_task(folder, scene, **facts)


def has_task(folder: Path) -> bool:
    """Whether a complete task lies in `folder`."""
    return (folder / TASK).is_file()


def read_facts(folder: Path) -> dict[str, Any]:
    """The facts of a task. InputError where it was written by another version of the program."""
    facts: dict[str, Any] = json.loads((folder / TASK).read_text(encoding="utf-8"))
    own, theirs = versions(), facts["versions"]
    for name in sorted({*own, *theirs}):
        if own.get(name) != theirs.get(name):
            found = f"this worker has {name} {own.get(name)}, the run {theirs.get(name)}"
            raise InputError(f"{folder}: {found}; install the same")
    return facts


def read_task(folder: Path) -> tuple[Scene, dict[str, Any]]:
    """The scene and the facts of a task. InputError as `read_facts`."""
    facts = read_facts(folder)
    scene = load_saved_scene(folder / SCENE)
    if scene is None:
        raise InputError(f"{folder}: the part of the scene is missing; delete the folder and run again")
    return scene, facts


def leaves_result(work: Work) -> Callable[..., None]:
    """The task (folder, progress) of `run_tasks` that does `work` and leaves RESULT; nothing where that is there."""

    def task(folder: str, progress: Progress = QUIET) -> None:
        facts, result = read_facts(Path(folder)), Path(folder) / RESULT
        if not result.is_dir():
            with blas_on_one_thread(), atomic_directory(result) as new:
                work(Path(folder), facts, new, progress)

    functools.update_wrapper(task, work)
    del task.__dict__["__wrapped__"]  # by it, Ray asks for the arguments of `work`
    return task


def run_tasks(
    engine: Engine,
    task: Callable[..., Any],
    folders: Sequence[Path],
    what: str,
    progress: Progress,
    each_core: bool = False,
) -> list[Path]:
    """Runs a task of `leaves_result` in each folder (see `Engine.run`); returns the results."""
    engine.run(task, [str(folder.resolve()) for folder in folders], what, progress, each_core)
    for folder in folders:
        if not (folder / RESULT).is_dir():
            raise InputError(f"{folder}: has no {RESULT} after its task; workers must share the output's folder")
    return [folder / RESULT for folder in folders]


def versions() -> dict[str, str]:
    """Versions of this program, Python, and the libraries that can affect a map."""
    from perception import __version__

    found = {"perception": __version__, "python": platform.python_version(), "machine": platform.machine()}
    for name in ("torch", "numpy", "pycolmap", "hdbscan", "onnxruntime", "opencv-contrib-python-headless"):
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found
