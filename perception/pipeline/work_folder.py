"""Work folder of an unfinished run: creation, locking, and removal at the end."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from perception.errors import InputError
from perception.io.atomic import writing
from perception.io.inputs import EXPECTED
from perception.pipeline.checkpoint import CHECKPOINT

WORK_SUFFIX = ".work"
LEAST_DISK = 256 << 20
"""Least free disk space in bytes, as a small run needs it for features, masks, checkpoint and map."""


def work_folder(output: Path) -> Path:
    """Path of the work folder, a sibling of the map."""
    return output.with_name(output.name + WORK_SUFFIX)


def frames_folder(output: Path) -> Path:
    """Folder for the frames of a video, a sibling of the map; it is kept, as the frames are the map's photos."""
    return output.with_suffix(".frames")


@contextmanager
def working(source: Path, output: Path, resume: bool) -> Iterator[Path]:
    """Yields the work folder of a run that makes `output`, locked; it is deleted when the block ends without an error.

    After an error it is kept for `--resume`, except for an InputError before training. InputError for a missing source,
    an output or unfinished run that already exists, and a full disk.
    """
    fresh, had_frames = not work_folder(output).exists(), frames_folder(output).exists()
    work = _prepare(source, output, resume)
    with writing(output):
        try:
            yield work
            shutil.rmtree(work, ignore_errors=True)
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            raise InputError(f"{work}: the disk is full; free some space and go on with --resume") from error
        except InputError:
            if fresh and not (work / CHECKPOINT).exists():
                shutil.rmtree(work, ignore_errors=True)
                if not had_frames:
                    shutil.rmtree(frames_folder(output), ignore_errors=True)
            raise


def clear_work(output: Path) -> None:
    """Removes the lock and the work folder of a run that was killed after it had written its map."""
    with writing(output):
        shutil.rmtree(work_folder(output), ignore_errors=True)


def _prepare(source: Path, output: Path, resume: bool) -> Path:
    if not source.exists():
        raise InputError(f"{source}: does not exist; give {EXPECTED}")
    if output.exists():
        raise InputError(f"{output}: exists already; choose another -o or remove it first")
    work = work_folder(output)
    if work.exists() and not resume:
        raise InputError(f"{work}: an unfinished run lies there; go on with --resume or remove the folder")
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{work}: cannot be made ({error.strerror}); choose a writable -o") from error
    # Checked first, because libraries abort the process when the disk becomes full.
    free = shutil.disk_usage(work).free
    if free < LEAST_DISK:
        if not any(work.iterdir()):
            work.rmdir()
        raise InputError(
            f"{output}: the disk has {free >> 20} MiB free, at least {LEAST_DISK >> 20} are needed; free some"
        )
    return work
