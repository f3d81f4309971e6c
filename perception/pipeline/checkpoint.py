"""The work folder of an unfinished run, its checkpoints, and the dependencies of each stage, by which `--resume`
repeats only what has changed.

    stage      depends on                                                 kept in the work folder as
    poses      input, photos.camera, strict, poses, ignore_masks,
               ignore_still and init_points, frame.*, seed                              poses-MARK/
    masks      source of masks, photo, size (and the map's depth)         masks/, a key in each PNG
    optimise   poses, photos.*, train.*, densify.*, losses.*; and masks   before_masks.pt, checkpoint.pt
    group      optimise, instances.*                                      nothing: it takes seconds
    describe   group, language.*                                          nothing

A run goes on only with the files that it began with (`pipeline.changes`). A stopped run can be continued with more
train.time_limit. If other optimisation settings have changed, the checkpoint is an error and not discarded, as it may
be hours of work. With other masks (another labels:DIR), training restarts at the point where masks are first used.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch

from perception.config import MapConfig
from perception.errors import FullDisk, InputError
from perception.gaussians.train import Trainer
from perception.inputs.readers import EXPECTED, is_splat
from perception.io.atomic import atomic_file, delete, is_full, write_file
from perception.io.documents import brief, refusing
from perception.machine import peak_memory_mib, refuse_full_disk
from perception.map.checksums import is_map
from perception.map.replace import writing
from perception.photos.folder import list_photos
from perception.photos.video import FRAMES_RECORD
from perception.progress import Progress

CHECKPOINT = "checkpoint.pt"
BEFORE_MASKS = "before_masks.pt"
CHECKPOINT_SECONDS = 20.0  # interval between two checkpoints; an interruption loses at most this much work
DRAWN_SECONDS = 0.5
LATER = ("masks", "instances", "language")  # settings that the optimisation does not depend on, but for masks


def fingerprint(source: Path, config: MapConfig) -> str:
    """Hash of the input path and all settings that change the map, without memory, time_limit and device."""
    settings = config.to_json() | {"device": "auto"}
    del settings["photos"]["memory"], settings["train"]["time_limit"]
    return digest(os.path.realpath(source), settings)


def poses_mark(source: Path, config: MapConfig) -> str:
    """Hash of the input path and the settings that change the poses and the sparse cloud."""
    photos = config.photos
    masks = (photos.ignore_masks, photos.ignore_still)
    chosen: tuple[Any, ...] = (photos.camera, photos.strict, photos.poses, *masks, photos.init_points)
    chosen += (config.splat.model_dump(), config.photos.max_side) if is_splat(source) else ()
    return digest(os.path.realpath(source), *chosen, config.frame.model_dump(), config.seed)


def training_mark(source: Path, config: MapConfig) -> str:
    """Hash of the input path and the settings of the optimisation, without the groups in LATER."""
    usual = MapConfig()
    return fingerprint(source, config.model_copy(update={name: getattr(usual, name) for name in LATER}))


def digest(*parts: Any) -> str:
    """Hash of JSON-able values, as 16 digits."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


class TrainingObserver:
    """Displays the progress of one training run, and writes checkpoints to folder `work`.

    mark: see `training_mark`. masks: identity of the masks' source. masks_enter: progress up to which the state does
    not depend on masks; the state at that point has its own checkpoint.
    """

    def __init__(self, work: Path, mark: str, masks: str, masks_enter: float, progress: Progress):
        self.work, self.mark, self.masks, self.masks_enter, self.progress = work, mark, masks, masks_enter, progress
        self.entered = False
        self.saved = self.drawn = time.monotonic()
        self.loss: float | None = None
        self.first: tuple[float, int] | None = None
        """Time and iteration of the first step."""

    def take_up(self, trainer: Trainer) -> None:
        """Loads the latest valid checkpoint into `trainer`, if any. InputError when it was made with other settings."""
        for name in (CHECKPOINT, BEFORE_MASKS):
            state = load_checkpoint(self.work / name, self.mark)
            if state is None:
                continue
            if state["masks"] == self.masks or (state["masks"] is None and state["masks_enter"] <= self.masks_enter):
                try:
                    trainer.load(state["trainer"])
                except (KeyError, TypeError) as error:  # fields that are others
                    found = f"is of another version ({brief(error)})"
                    raise InputError(f"{self.work / name}: {found}; delete {self.work} to start over") from error
                self.entered = state["masks"] is not None  # a longer time limit lowers the progress; the masks stay
                self.progress.log(f"resuming at iteration {trainer.iteration}")
                break
            self.progress.log(f"{self.work / name}: was trained on other masks, which enter again")
        self.entered = self.entered or trainer.progress >= self.masks_enter

    def after_step(self, trainer: Trainer, loss: float) -> None:
        now = time.monotonic()
        self.loss = loss if self.loss is None else 0.95 * self.loss + 0.05 * loss
        self.first = self.first or (now, trainer.iteration)
        timed = trainer.iteration > self.first[1]  # the first iteration alone gives no rate
        if (timed and now - self.drawn > DRAWN_SECONDS) or trainer.progress >= 1:
            self.drawn = now
            self._draw(trainer, *self.first)
        if not self.entered and trainer.progress >= self.masks_enter:
            self._save(trainer, BEFORE_MASKS)
            self.entered = True
        if now - self.saved > CHECKPOINT_SECONDS:
            self._save(trainer, CHECKPOINT)
            self.saved = time.monotonic()

    def after_leg(self, trainer: Trainer) -> None:
        self._save(trainer, CHECKPOINT)

    def _save(self, trainer: Trainer, name: str) -> None:
        masks = self.masks if self.entered else None
        state = {"masks": masks, "masks_enter": self.masks_enter, "trainer": trainer.state(copy=False)}
        save_checkpoint(self.work / name, state, self.mark)

    def _draw(self, trainer: Trainer, since: float, first: int) -> None:
        speed = (trainer.iteration - first) / max(self.drawn - since, 1e-6)
        total, curve = trainer.expected_iterations, trainer.record.curve
        self.progress.update(
            "train",
            trainer.iteration,
            total,
            f"loss {self.loss:.3f}",
            f"{curve[-1]['psnr']:.1f} dB" if curve else "- dB",
            f"{len(trainer.gaussians) / 1000:.3g}k Gaussians",
            f"{speed:.1f} it/s",
            f"{round((total - trainer.iteration) / max(speed, 1e-6))} s left",
            f"{round(peak_memory_mib())} MiB",
        )


class FeatureCheckpoints:
    """The checkpoints in folder `work` of a training of features alone (see `splats.features.Checkpoints`).

    mark: see `training_mark`. masks: identity of the masks' source; with others, features are trained anew.
    """

    def __init__(self, work: Path, mark: str, masks: str):
        self.file, self.mark, self.masks = work / CHECKPOINT, mark, masks
        self.saved = time.monotonic()

    def load(self) -> dict[str, Any] | None:
        held = load_checkpoint(self.file, self.mark)
        return None if held is None or held["masks"] != self.masks else held["features"]

    def save(self, state: dict[str, Any], at_once: bool = False) -> None:
        if at_once or time.monotonic() - self.saved > CHECKPOINT_SECONDS:
            save_checkpoint(self.file, {"masks": self.masks, "features": state}, self.mark)
            self.saved = time.monotonic()


def save_checkpoint(path: Path, state: dict[str, Any], mark: str) -> None:
    """Writes `state` with the fingerprint `mark` of its settings, atomically."""
    with atomic_file(path, parents=False) as aside, aside.open("wb") as file:
        writer = _Writer(file)
        torch.save({"mark": mark, "state": state}, cast(BinaryIO, writer))
        if writer.error is not None:
            raise writer.error


class _Writer:
    """A file as torch writes to one, but for errors: those are kept, as torch aborts the process at a full disk."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        if self.error is None:
            try:
                self.file.write(data)
            except OSError as error:
                self.error = error
        return memoryview(data).nbytes

    def flush(self) -> None:
        """Nothing: the file is flushed when it is closed, where errors can be raised."""


def load_checkpoint(path: Path, mark: str) -> dict[str, Any] | None:
    """The state saved at `path`; None when there is none. InputError when it is damaged or of other settings."""
    if not path.is_file():
        return None
    with refusing(f"{path}: the checkpoint is damaged; delete {path.parent} to start over"):
        held = torch.load(path, weights_only=True)
        found, state = held["mark"], held["state"]
    if found != mark:
        todo = f"repeat the first command with --resume, or delete {path.parent} to start over"
        raise InputError(f"{path}: was made with other settings or another input; {todo}")
    return state


INPUTS = "inputs.json"  # name of the list of input files in a work folder; every run writes it first
TASKS = ("block-*", "labels-*", "model-*", "levels-*", "votes-*", "silhouettes-*", "leg-*")
OWN = ("*.pt", "masks", "sfm", "poses-*", *TASKS, ".*.new-*", ".*.old-*", ".*.lock", INPUTS)
"""Names of all that a run writes in its work folder."""


def check_name(output: Path) -> None:
    """InputError where no map can lie at `output`: its name is too long, or it is a link to itself."""
    try:
        with contextlib.suppress(FileNotFoundError):
            output.stat()
        work_folder(output).exists()
    except OSError as error:
        raise InputError(f"{output}: no map can lie there ({error.strerror}); choose another -o") from error


def work_folder(output: Path) -> Path:
    """Path of the work folder, a sibling of the map."""
    return output.with_name(f"{output.name}.work")


def frames_folder(output: Path) -> Path:
    """Folder for the frames of a video, a sibling of the map; it is kept, as the frames are the map's photos."""
    return output.with_name(f"{output.name}.frames")


@contextmanager
def working(source: Path, output: Path, resume: bool) -> Iterator[Path]:
    """Yields the work folder of a run that makes `output`, locked; it is deleted when the block ends without an error.

    After an error it is kept for `--resume`, except for an InputError before training other than FullDisk, unless poses
    were found by then.
    InputError for a missing source, an output or unfinished run that already exists, and a full disk.
    """
    fresh, had_frames = not work_folder(output).exists(), frames_folder(output).exists()
    work = _prepare(source, output, resume)
    with writing(output):
        try:
            yield work
            _remove(work)
        except FullDisk as error:
            raise FullDisk(f"{error}, and go on with --resume") from error
        except InputError as error:
            trained = any(work.rglob("*.pt"))  # also of a block
            if not trained and any(work.glob("sfm/**/model/report.json")):
                _forget_masks(work)
                if fresh:
                    raise InputError(f"{error}; the poses that were found are kept: go on with --resume") from error
            elif fresh and not trained:
                _remove(work)
                if not had_frames and (frames_folder(output) / FRAMES_RECORD).is_file():
                    shutil.rmtree(frames_folder(output), ignore_errors=True)
            raise
        except Exception as error:
            if not is_full(error):
                raise
            raise FullDisk(f"{work}: the disk is full; free some space, and go on with --resume") from error


def _forget_masks(work: Path) -> None:
    """Takes label images off the list of input files: they may be mended, as no training has used them."""
    file = work / INPUTS
    with contextlib.suppress(OSError, ValueError, AttributeError):  # the list is damaged: `hold_inputs` reports it
        kept = {key: files for key, files in json.loads(file.read_bytes()).items() if not key.startswith("masks=")}
        write_file(file, json.dumps(kept))


def clear_work(output: Path) -> None:
    """Removes the lock and the work folder of a run that was killed after it had written its map."""
    with writing(output):
        _remove(work_folder(output))


def _remove(work: Path) -> None:
    """Deletes what a run wrote in its work folder, and the folder unless other files lie there."""
    if (work / INPUTS).is_file():
        for file in (file for pattern in OWN for file in work.glob(pattern)):
            delete(file)
    with contextlib.suppress(OSError):  # it holds other files, or is not there
        work.rmdir()


def _prepare(source: Path, output: Path, resume: bool) -> Path:
    if not source.exists():
        raise InputError(f"{source}: does not exist; give {EXPECTED}")
    if is_map(source) and not list_photos(source):
        raise InputError(f"{source}: is a map; give {EXPECTED}")
    if output.exists():
        raise InputError(f"{output}: exists already; choose another -o or remove it first")
    work = work_folder(output)
    if work.exists() and not resume:
        with writing(output):  # InputError where another run works there now
            pass
        raise InputError(f"{work}: an unfinished run lies there; go on with --resume or remove the folder")
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{work}: cannot be made ({error.strerror}); choose a writable -o") from error
    try:
        refuse_full_disk(work)
    except InputError:
        if not any(work.iterdir()):
            work.rmdir()
        raise
    return work
