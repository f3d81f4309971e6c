"""Scores `perception update` over visits of made scenes of several seeds, in a row.

python tools score.made_visits tabletop|room WORK --seeds N ... [--visits N] [--side PX] [--views N]
    [--share KIND=X ...] [--corner SHARE] [--masks labels|labels_sam|builtin] [--alone] [--apart] [--back]
    [--grey] [--unlabelled] [--set KEY=VALUE ...]

Makes the visits of `worlds.visits` (400 × 300 pixels, 36 or 56 photos), the map of the first one (1000 iterations,
without language), and updates it visit after visit. A row for each visit, then mean, spread and range over all of them,
and what came true of the states, by confidence. Given poses, unless --alone. --share: of the things, by kind of change
(moved, turned, removed, added, swapped); none=0: only the light changes. --corner: later visits use that share of their
photos, the first ones by name. --grey: their photos have no colours. --apart: also a new map of every visit, for its
PSNR and its CPU seconds. --back: then a visit that finds the place as the first one did; `back` is the share of the
things said to be removed that have their ids again where they stood. --unlabelled: label images of the first visit lack
all things that go or move, and every other one that stays: `ghosts` is the share left of the Gaussians of what went,
`lost` the share that went of those of what stands.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from PIL import Image

from perception.config import load_config
from perception.map.history import changes_of, is_removed, visits_of
from perception.map.write import Map, read_map
from perception.pipeline.mapping import build_map
from perception.visits.scene import update_settings
from perception.visits.update import update_map
from score.visits import Truth, as_cut, kept, owners, scores
from worlds.visits import SHARE, make_visits

VIEWS = {"tabletop": 36, "room": 56}
SETTINGS = ("train.iterations=1000", "language.encoder=none", "language.texts=off")
BINS = (0.0, 0.6, 0.8, 0.9, 0.97, 1.0)
"""Of confidence."""
COLUMNS = ("f1", "false_alarms", "unseen_called_removed", "motion_cm", "nearest_cm", "motion_degrees", "turns_unknown",
           "ids_kept", "back", "ghosts", "lost", "off_cm", "gaussians", "psnr", "new_psnr", "cpu",
           "new_cpu")  # fmt: skip
NEAR = 0.05
"""Metres from where a thing stood within which it is back."""
BESIDE = 0.03
"""Metres from a true point within which a Gaussian is of its thing."""
T = TypeVar("T")


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What `work` returns, and its CPU seconds."""
    start = time.process_time()
    return work(), time.process_time() - start


def off_cm(gmap: Map, truth: Truth) -> float:
    """Centimetres from the true points of things to the nearest Gaussian of their instance: median of the means."""
    from scipy.spatial import cKDTree

    points, ids = truth.points[1], truth.ids[1]
    found = owners(gmap, points, ids)[0]
    each = [cKDTree(gmap.means[gmap.instance_ids == i]).query(points[ids == t])[0].mean() for t, i in found.items()]
    return 100 * float(np.median(each)) if each else float("nan")


def cornered(folder: Path, share: float) -> Path:
    """The visit with the first photos alone, as a posed input beside it."""
    file = folder / "corner.json"
    known = json.loads((folder / "transforms.json").read_text())
    frames = sorted(known["frames"], key=lambda frame: str(frame["file_path"]))
    file.write_text(json.dumps({**known, "frames": frames[: max(3, round(share * len(frames)))]}))
    return file


def grey(folder: Path) -> Path:
    """A copy of the visit, beside it, whose photos have no colours."""
    copy = folder.with_name(f"{folder.name}-grey")
    if not copy.exists():
        shutil.copytree(folder, copy, copy_function=shutil.copyfile)  # newer photos
        for file in sorted((copy / "images").iterdir()):
            with Image.open(file) as photo:
                photo.convert("L").save(file)
    return copy


def unlabelled(folder: Path, masks: str) -> Path:
    """Label images of visit 0 without the things that go or move, and without every other one that stays."""
    entries = Truth.read(folder / "visit0", folder / "visit1").entries
    stays = [i for i, entry in entries.items() if entry["state"] == "unchanged"]
    unknown, made = sorted(set(entries) - set(stays[1::2])), folder / f"{masks}-unlabelled"
    made.mkdir(exist_ok=True)
    for file in sorted((folder / "visit0" / masks).iterdir()):
        with Image.open(file) as image, Image.open(folder / "visit0" / "masks_gt" / file.name) as true:
            labels, ids = np.array(image), np.array(true)
        Image.fromarray(np.where(np.isin(ids, unknown), 0, labels).astype(np.uint16)).save(made / file.name)
    return made


def left(before: Map, today: Map, truth: Truth) -> dict[str, float]:
    """Of the Gaussians of no instance that is said to be gone: the share left, `ghosts`, of those of things that went,
    where nothing stands now; the share that went, `lost`, of those of what stands."""
    from scipy.spatial import cKDTree

    went = [i for i, entry in truth.entries.items() if entry["state"] in ("moved", "removed", "replaced")]
    away, nearest = cKDTree(truth.points[0]).query(before.means)
    now = cKDTree(truth.points[1]).query(before.means)[0]
    gone = [entry["id"] for entry in today.instances if entry.get("state") in ("moved", "removed")]
    stays, held = kept(before, today), ~np.isin(before.instance_ids, gone) & (away < BESIDE)
    other = np.isin(truth.ids[0][nearest], went)
    ghost, stood = held & other & (now > NEAR), held & ~other & (now < BESIDE)
    return {"ghosts": float(stays[ghost].mean()), "lost": 1 - float(stays[stood].mean())}


def scored(folder: Path, given: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each visit but the first."""
    pairs = [*SETTINGS, *given.pairs]

    def masks(visit: Path) -> str:
        if given.unlabelled and visit.name == "visit0":
            return f"masks=labels:{unlabelled(folder, given.masks)}"
        return "masks=builtin" if given.masks == "builtin" else f"masks=labels:{visit / given.masks}"

    def new_map(visit: Path, output: Path) -> tuple[Map, float]:
        return timed(partial(build_map, visit, output, load_config(None, [*pairs, masks(visit)])))

    known = f"{given.masks}{'-unlabelled' if given.unlabelled else ''}"
    name, rows = f"{known}{'-alone' if given.alone else ''}", []
    path = folder / f"map-{known}.gsmap"
    start = (read_map(path), float("nan")) if path.exists() else new_map(folder / "visit0", path)
    for number in range(1, given.visits):
        before, visit = read_map(path), folder / f"visit{number}"
        visit = grey(visit) if given.grey else visit
        source = visit / "images" if given.alone else cornered(visit, given.corner) if given.corner < 1 else visit
        old, path = path, folder / f"{name}-{number}.gsmap"
        shutil.rmtree(path, ignore_errors=True)
        today, seconds = timed(partial(update_map, old, source, path, update_settings(old, None, [masks(visit)])))
        truth = Truth.read(folder / f"visit{number - 1}", visit)
        told = changes_of(visits_of(today.info, len(today.views)), today.instances, number - 1)
        row = scores(told, as_cut(before, today), today, truth)
        row |= {"gaussians": len(today), "off_cm": off_cm(today, truth), "psnr": today.info["quality"].get("psnr")}
        row |= {"cpu": seconds, "new_cpu": start[1], "parts": today.info["seconds"]}
        row |= left(before, today, truth) if given.unlabelled else {}
        if given.apart:
            apart, row["new_cpu"] = new_map(visit, folder / f"apart-{given.masks}-{number}.gsmap")
            row["new_psnr"] = apart.info["quality"].get("psnr")
        if given.back and number == given.visits - 1:
            row["back"] = came_back(folder, folder / f"map-{known}.gsmap", path, masks)
        rows.append(row)
        show(f"{folder.name}, visit {number}", row)
    return rows


def came_back(folder: Path, first: Path, path: Path, masks: Callable[[Path], str]) -> float:
    """Share of the things that the map at `path` says are removed that stand where they stood, under their ids, after a
    visit that finds the place as visit 0 did; NaN without any."""
    again, output = folder / "again", folder / "back.gsmap"
    for made in (again, output):
        shutil.rmtree(made, ignore_errors=True)
    shutil.copytree(folder / "visit0", again, copy_function=shutil.copyfile)  # newer photos
    truth = Truth.read(folder / "visit0", folder / "visit1")
    found = owners(read_map(first), truth.points[0], truth.ids[0])[0]
    things = {instance for thing, instance in found.items() if thing in truth.entries}
    gone = {e["id"]: e["centroid"] for e in read_map(path).instances if is_removed(e) and e["id"] in things}
    today = update_map(path, again, output, update_settings(path, None, [masks(again)]))
    spots = {e["id"]: e["centroid"] for e in today.instances if not is_removed(e)}
    right = [i in spots and np.linalg.norm(np.subtract(spots[i], spot)) < NEAR for i, spot in gone.items()]
    return float(np.mean(right)) if right else float("nan")


def show(name: str, row: dict[str, Any]) -> None:
    """One line."""
    cells = [f"{column} {row[column]:.3g}" for column in COLUMNS if row.get(column) is not None]
    states = ", ".join(
        f"{state} {values['f1']:.2f} of {values['true']}" for state, values in row["states"].items() if values["true"]
    )
    print(f"{name}: {', '.join(cells)}; F1 of {states}; wrong: {'; '.join(row['wrong'])}", flush=True)


def summary(rows: list[dict[str, Any]]) -> None:
    """Mean, standard deviation and range of each figure, and what came true by confidence."""
    for column in COLUMNS:
        values = np.array([row[column] for row in rows if row.get(column) is not None], float)
        values = values[np.isfinite(values)]
        if len(values):
            low, high = values.min(), values.max()
            print(f"{column:22s} {values.mean():8.3g} ± {values.std():.2g}, {low:.3g} to {high:.3g}, of {len(values)}")
    told = np.array([pair for row in rows for pair in row["told"]]).reshape(-1, 2)
    for low, high in pairwise(BINS):
        inside = told[(told[:, 0] >= low) & ((told[:, 0] < high) | (high == BINS[-1]))]
        if len(inside):
            said, true = inside.mean(axis=0)
            print(f"confidence {low} to {high}: {len(inside)} states, said {said:.3f}, true {true:.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(prog="score.made_visits", description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("scene", choices=sorted(VIEWS))
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    for name, number in (("visits", 2), ("side", 400), ("views", 0)):
        parser.add_argument(f"--{name}", type=int, default=number)
    parser.add_argument("--share", nargs="+", default=[])
    parser.add_argument("--corner", type=float, default=1.0)
    parser.add_argument("--masks", choices=("labels", "labels_sam", "builtin"), default="labels")
    for flag in ("--alone", "--apart", "--back", "--grey", "--unlabelled"):
        parser.add_argument(flag, action="store_true")
    parser.add_argument("--set", action="append", default=[], dest="pairs")
    given = parser.parse_args()
    share = {kind: float(part) for kind, _, part in (pair.partition("=") for pair in given.share)} or SHARE
    rows = []
    for seed in given.seeds:
        folder = given.work / f"{given.scene}-{seed}"
        if not (folder / f"visit{given.visits - 1}" / "gt_points.ply").exists():
            size = {"views": given.views or VIEWS[given.scene], "width": given.side, "height": given.side * 3 // 4}
            make_visits(folder, given.scene, visits=given.visits, seed=seed, share=share, light_samples=6, **size)
        rows += scored(folder, given)
    summary(rows)


if __name__ == "__main__":
    main()
