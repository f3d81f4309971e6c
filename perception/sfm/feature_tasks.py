"""Features and matches made by tasks: the same database as `features.extract` and `match` make.

A task has a folder with a part of the photos or pairs, and leaves a COLMAP database there, whose rows are copied.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.machine import cores, refuse_full_disk
from perception.photos.ignore_masks import stage_masks
from perception.photos.lens import load_pycolmap
from perception.progress import Progress
from perception.sfm.features import extract, import_photos, match
from perception.sfm.staging import stage_photos
from perception.tasks.engine import Engine, run_in_processes
from perception.tasks.folder import RESULT, has_task, leaves_result, run_tasks, write_task

PHOTOS_A_TASK, PAIRS_A_TASK = 64, 2000
"""About half a minute on two cores each."""
LEAST_PAIRS = 200
"""Of a task on this machine; to start it takes as long as 60 pairs."""
DATABASE = "database.db"
_IMAGES = ("rigs", "rig_sensors", "cameras", "frames", "frame_data", "images")
_FEATURES, _MATCHES = ("keypoints", "descriptors"), ("matches", "two_view_geometries")
_PAIR = 2147483647
"""COLMAP's id of a pair is _PAIR × the smaller image id + the larger."""


@dataclass(frozen=True)
class FeatureTasks:
    """Runs the tasks of one set of photos. folder: of the tasks, which every worker reaches under the same path."""

    folder: Path
    engine: Engine
    progress: Progress

    def extract(
        self,
        database: Path,
        photos: Sequence[Path],
        masks: Sequence[Path | None] | None,
        as_stored: Sequence[bool] | None = None,
    ) -> None:
        """Fills the database of imported photos with their features."""
        folders = []
        for first in range(0, len(photos), PHOTOS_A_TASK):
            some = slice(first, first + PHOTOS_A_TASK)
            folders.append(self.folder / f"photos-{first}")
            if not has_task(folders[-1]):
                paths = [str(photo.resolve()) for photo in photos[some]]
                covered = None if masks is None else [mask and str(mask.resolve()) for mask in masks[some]]
                write_task(folders[-1], photos=paths, masks=covered, as_stored=as_stored and list(as_stored[some]))
        results = run_tasks(self.engine, extract_task, folders, "feature set", self.progress)
        with closing(sqlite3.connect(database)) as own, own:
            ids = iter(_images(own).values())
            for result in results:
                with closing(sqlite3.connect(result / DATABASE)) as theirs:
                    own_id = {image: next(ids) for image in _images(theirs).values()}
                    for table in _FEATURES:
                        for image, *row in theirs.execute(f"SELECT * FROM {table}"):
                            values = ", ".join("?" * (1 + len(row)))
                            own.execute(f"INSERT INTO {table} VALUES ({values})", (own_id[image], *row))

    def match(self, database: Path, chosen: Sequence[tuple[str, str]], seed: int) -> None:
        """Adds the matches of the chosen pairs to a database with features; here by a process for each core."""
        here, folders, size = self.engine.kind == "local", [], PAIRS_A_TASK
        if here:
            rounds = -(-len(chosen) // (PAIRS_A_TASK * cores()))
            size = max(LEAST_PAIRS, -(-len(chosen) // max(1, rounds * cores())))
            if size >= len(chosen):
                match(database, chosen, seed, self.progress)
                return
            refuse_full_disk(self.folder.parent, cores() * database.stat().st_size)  # of which each task has a copy
        for first in range(0, len(chosen), size):
            some = chosen[first : first + size]
            folders.append(self.folder / f"pairs-{first}-{size}")
            if here or not has_task(folders[-1]):  # an interrupted run's database is gone
                folders[-1].mkdir(parents=True, exist_ok=True)
                if not here:
                    with closing(sqlite3.connect(database)) as tables:
                        ids = _images(tables)
                    write_part(database, [ids[name] for pair in some for name in pair], folders[-1] / DATABASE)
                write_task(folders[-1], pairs=some, seed=seed, database=str(database.resolve()) if here else None)
        if here:
            paths = [str(folder.resolve()) for folder in folders]
            run_in_processes(match_task, paths, "poses: matching", self.progress)
            results = [folder / RESULT for folder in folders]
        else:
            results = run_tasks(self.engine, match_task, folders, "pair set", self.progress)
        with closing(sqlite3.connect(database, isolation_level=None)) as own:  # ATTACH is none of a transaction
            for result in results:
                own.execute("ATTACH DATABASE ? AS source", (str(result / DATABASE),))
                for table in _MATCHES:
                    own.execute(f"INSERT INTO {table} SELECT * FROM source.{table}")
                own.execute("DETACH DATABASE source")


@leaves_result
def extract_task(folder: Path, facts: dict[str, Any], new: Path, progress: Progress) -> None:
    """Extracts the features of some photos."""
    photos, masks, as_stored = [Path(photo) for photo in facts["photos"]], facts["masks"], facts["as_stored"]
    names = stage_photos(new / "photos", photos, progress, as_stored)
    if masks is not None:
        stage_masks(new / "masks", photos, names, [mask and Path(mask) for mask in masks], as_stored)
    groups = import_photos(new / DATABASE, new / "photos", photos, names, [None] * len(photos))
    extract(new / DATABASE, new / "photos", groups, progress)


@leaves_result
def match_task(folder: Path, facts: dict[str, Any], new: Path, progress: Progress) -> None:
    """Matches some pairs, of the photos in its own database or in that of this machine."""
    source = facts["database"] or folder / DATABASE
    with closing(sqlite3.connect(source)) as given, closing(sqlite3.connect(new / DATABASE)) as copy:
        given.backup(copy)
    match(new / DATABASE, facts["pairs"], facts["seed"], progress)
    with closing(sqlite3.connect(new / DATABASE, isolation_level=None)) as copy:
        for table in _FEATURES:  # 0.3 MB a photo, in the copy of every task
            copy.execute(f"DELETE FROM {table}")
        copy.execute("VACUUM")


def _images(database: sqlite3.Connection) -> dict[str, int]:
    """Ids of the images by name, in the order of their names, which are numbers of photos."""
    return dict(database.execute("SELECT name, image_id FROM images ORDER BY name"))


def write_part(
    database: Path, images: Sequence[int], target: Path, tables: Sequence[str] = _FEATURES, matched: bool = False
) -> None:
    """Writes the database of some photos, under the same ids, with their rows of `tables`; matched: and the verified
    matches between them."""
    target.unlink(missing_ok=True)
    load_pycolmap().Database.open(target).close()  # creates its tables
    with closing(sqlite3.connect(target)) as part, part:
        part.execute("ATTACH DATABASE ? AS source", (bytes(database),))
        for table in _IMAGES:
            part.execute(f"INSERT INTO {table} SELECT * FROM source.{table}")
        part.execute("CREATE TEMP TABLE wanted (id INTEGER PRIMARY KEY)")
        part.executemany("INSERT INTO wanted VALUES (?)", [(image,) for image in sorted(set(images))])
        for table in tables:
            part.execute(f"INSERT INTO {table} SELECT * FROM source.{table} WHERE image_id IN wanted")
        if matched:
            both = " AND ".join(f"{image} IN wanted" for image in (f"pair_id / {_PAIR}", f"pair_id % {_PAIR}"))
            part.execute(f"INSERT INTO two_view_geometries SELECT * FROM source.two_view_geometries WHERE {both}")
