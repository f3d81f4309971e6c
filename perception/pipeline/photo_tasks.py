"""Votes and silhouettes of the photos of a large scene, made by tasks on other machines: the same as made here.

The parts of the joined model lie once in the work folder. A task has some photos, and the numbers of the parts that
each may show.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import sparse

from perception.config import MapConfig
from perception.gaussians.device import choose_device
from perception.gaussians.model import Gaussians, Nearby
from perception.gaussians.photos import training_view, with_labels
from perception.gaussians.views import TrainingView
from perception.instances.silhouettes import Silhouettes, view_silhouettes
from perception.instances.votes import ViewVotes, view_votes
from perception.io.arrays import read_npz
from perception.io.atomic import atomic_directory
from perception.pipeline.checkpoint import digest
from perception.pipeline.optimise import Optimised, Run
from perception.progress import Progress
from perception.tasks.folder import leaves_result, read_task, renew_task, run_tasks
from perception.types import Scene

PHOTOS_A_TASK = 64
ROWS, LEVELS = "rows", "levels"  # arrays of a part beside its Gaussians: rows in the model [N], ids [N, L]
LEVEL = ("packed", "shape", "shown", "pixels", "visible")  # fields of Silhouettes
Arrays = dict[str, np.ndarray]


def by_tasks(run: Run, optimised: Optimised) -> bool:
    """Whether there are other machines, and the scene is so large that it was trained in blocks."""
    return run.engine.kind != "local" and bool(optimised.blocks)


def votes_by_tasks(run: Run, optimised: Optimised) -> Iterator[ViewVotes | None]:
    """`view_votes` of all photos, in order."""
    count = len(optimised.nearby.gaussians)
    for found in _by_tasks(run, optimised, "votes", vote_task):
        if not found:
            yield None
            continue
        columns = found["data"], found["indices"], found["indptr"]
        weights = sparse.csc_matrix(columns, shape=(count, len(found["labels"])))
        yield ViewVotes(weights, found["labels"], found["areas"])


def silhouettes_by_tasks(run: Run, optimised: Optimised, levels: Sequence[np.ndarray]) -> Iterator[list[Silhouettes]]:
    """`view_silhouettes` of all photos, in order."""
    for found in _by_tasks(run, optimised, "silhouettes", silhouette_task, levels):
        rows = [[found[f"{name} {level}"] for name in LEVEL] for level in range(len(levels))]
        yield [Silhouettes(packed.tobytes(), tuple(shape.tolist()), *rest) for packed, shape, *rest in rows]


@leaves_result
def vote_task(folder: Path, facts: dict[str, Any], new: Path, progress: Progress) -> None:
    """Votes of some photos."""
    _of_photos(_votes, folder, new, progress)


@leaves_result
def silhouette_task(folder: Path, facts: dict[str, Any], new: Path, progress: Progress) -> None:
    """Silhouettes of some photos."""
    _of_photos(_silhouettes, folder, new, progress)


def _votes(nearby: Nearby, beside: Arrays, view: TrainingView, config: MapConfig) -> Arrays:
    found = view_votes(nearby, view, config.losses.half_resolution)
    if found is None:
        return {}
    weights = found.weights
    columns = {"data": weights.data, "indices": beside[ROWS][weights.indices], "indptr": weights.indptr}
    return {**columns, "labels": found.labels, "areas": found.areas}


def _silhouettes(nearby: Nearby, beside: Arrays, view: TrainingView, config: MapConfig) -> Arrays:
    found: Arrays = {}
    for level, seen in enumerate(view_silhouettes(nearby, list(beside[LEVELS].T), view)):
        packed = np.frombuffer(seen.packed, np.uint8)
        columns = packed, np.array(seen.shape), seen.shown, seen.pixels, seen.visible
        found |= {f"{name} {level}": column for name, column in zip(LEVEL, columns, strict=True)}
    return found


def _by_tasks(
    run: Run, optimised: Optimised, what: str, task: Callable[..., None], levels: Sequence[np.ndarray] = ()
) -> Iterator[Arrays]:
    """What the tasks find of each photo. levels: ids [N] of all Gaussians."""
    views, gaussians = optimised.photos.training, optimised.nearby.gaussians.to("cpu")
    parts, shown = optimised.nearby.parts([view.name for view in views])
    tensors = {name: tensor.detach().numpy() for name, tensor in gaussians.named().items()}
    folders = [_write_parts(run, "model", {**tensors, ROWS: np.arange(len(gaussians))}, parts)]
    if levels:
        folders.append(_write_parts(run, "levels", {LEVELS: np.stack(levels, axis=1)}, parts))
    name, tasks = f"{what}-{digest([folder.name for folder in folders])}", []
    for first in range(0, len(views), PHOTOS_A_TASK):
        some = slice(first, first + PHOTOS_A_TASK)
        tasks.append(run.work / f"{name}-{first}")
        scene = Scene(views[some], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        paths = {"arrays": [str(folder.resolve()) for folder in folders], "masks": str(run.masks.resolve())}
        renew_task(tasks[-1], scene, config=run.config.to_json(), parts=shown[some], **paths)
    results = run_tasks(run.engine, task, tasks, "photo set", run.progress)
    for file in (file for result in results for file in sorted(result.iterdir())):
        yield read_npz(file, file, f"delete {file.parents[1]} and run again")


def _write_parts(run: Run, what: str, arrays: Arrays, parts: Sequence[np.ndarray]) -> Path:
    """A folder of the work folder, named by its content, with the rows of each part of `arrays` [N, ...]."""
    content = hashlib.sha256(run.mark.encode())
    for array in [*arrays.values(), *parts]:
        content.update(np.ascontiguousarray(array).tobytes())
    folder = run.work / f"{what}-{content.hexdigest()[:16]}"
    if not folder.is_dir():
        with atomic_directory(folder) as new:
            for number, rows in enumerate(parts):
                chosen = {name: array[rows] for name, array in arrays.items()}
                np.savez(new / f"{number}.npz", **chosen)  # type: ignore[arg-type]
    return folder


def _of_photos(
    work: Callable[[Nearby, Arrays, TrainingView, MapConfig], Arrays], folder: Path, new: Path, progress: Progress
) -> None:
    """Writes into `new` what `work` finds of each photo of the task in `folder`."""
    scene, facts = read_task(folder)
    config, needed = MapConfig.model_validate(facts["config"]), sorted(set().union(*facts["parts"]))

    def stored(number: int) -> Arrays:
        files = [Path(held) / f"{number}.npz" for held in facts["arrays"]]
        return {k: v for file in files for k, v in read_npz(file, file, f"delete {file.parent} and run again").items()}

    each = [stored(number) for number in needed]
    whole = {name: np.concatenate([part[name] for part in each]) for name in each[0]}
    ends = np.cumsum([len(part[ROWS]) for part in each])
    del each
    beside = {name: whole.pop(name) for name in (ROWS, LEVELS) if name in whole}
    own = dict(zip(needed, np.split(np.arange(ends[-1]), ends[:-1]), strict=True))
    sets: dict[tuple[int, ...], list[np.ndarray]] = {}
    shown = [sets.setdefault(tuple(numbers), [own[n] for n in numbers]) for numbers in facts["parts"]]
    device = choose_device(config.device)[0]
    gaussians = Gaussians(**{name: torch.from_numpy(array) for name, array in whole.items()}).to(device)
    nearby = Nearby(gaussians, dict(zip([view.name for view in scene.views], shown, strict=True)))
    for done, view in enumerate(scene.views):
        decoded = with_labels(training_view(view, config.photos.max_side), view, Path(facts["masks"]))
        np.savez(new / f"{done:04}.npz", **work(nearby, beside, decoded, config))  # type: ignore[arg-type]
        progress.update("photos", done + 1, len(scene.views))
