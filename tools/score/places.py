"""Maps many places with several seeds, and scores their instances: mean, spread, worst tenth.

python tools score.places WORK [--places …] [--seeds N] [--masks SOURCE] [--name NAME] [--against FILE] [--splats NAME]

Places are made scenes of seeds that no training uses, and those of PERCEPTION_DATA. WORK/places keeps the made ones,
WORK/NAME the maps and WORK/NAME.json the figures, so that a run that was stopped goes on; another NAME for a changed
program. AP is class-agnostic by ScanNet's rules. Where only things are known (kitchen, shelf) `own` is the share of
the things that some instance finds, or the mean of their IoU in the photos. --splats NAME maps the Gaussians alone of
WORK/NAME's maps again, as finished splats, scored in these maps' frame; --against WORK/NAME.json is then what is lost.
--fit prints the scores that the instances of these maps and of those --against would have by their own share right: a
second row for `confidence.CALIBRATION`. Spread: standard deviation over the seeds; over all places, its root mean
square. Worst: mean of the lowest tenth of the maps, at least of one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.output import Column, table
from perception.boxes import oriented_box
from perception.config import MapConfig, load_config
from perception.errors import InputError
from perception.instances.confidence import CALIBRATION
from perception.io.atomic import atomic_file
from perception.io.documents import read_json
from perception.map.map import Map
from perception.masks.label_folder import LabelFolder
from perception.pipeline.mapping import build_map
from perception.progress import Progress
from score.instances import MIN_POINTS, read_scene, read_truth_cloud
from score.photos import overlaps
from score.reliability import draw, fitted, reliability
from training import clutter, patchwork
from worlds import scene as scenes

scenes.SCENES |= {"clutter": clutter, "patchwork": patchwork}
MADE = {"tabletop": 4, "room": 4, "clutter": 3, "patchwork": 2, "trifles": 2}  # number of places of each kind
FIRST_SEED = 71  # of every kind; training uses 1000 and more, the demo 0
SIZE = {"width": 320, "height": 240, "light_samples": 8}  # trifles are made twice as wide: their things are tiny
REAL = {"tabletop_a": "", "room_a": "", "kitchen_rgbd": "transforms.json", "shelf_a": "transforms.json"}
SHORT = ("photos.max_side=320", "train.iterations=800", "train.budget=40000", "language.encoder=none")
GROWN, INSIDE, COVERED, NEAR = 0.05, 0.5, 0.25, 0.03
"""A thing with a hand-made box is found by an instance with INSIDE of its points in the box, grown by GROWN metres, and
within NEAR of COVERED of the thing's points."""
OFF = 1.5
FIGURES = ("ap", "ap50", "ap25", "own")
HEADS = ("AP", "AP50", "AP25", "own")


@dataclass(frozen=True)
class Place:
    """folder: of the scene; source: what is mapped; kind and seed: of a made one."""

    name: str
    folder: Path
    source: Path
    kind: str = ""
    seed: int = 0

    def make(self) -> None:
        """Renders a made place, unless it is there."""
        if self.kind and not self.folder.is_dir():
            size = SIZE | ({"width": 640, "height": 480} if self.kind == "trifles" else {})
            part = self.folder.with_suffix(".part")
            shutil.rmtree(part, ignore_errors=True)
            scenes.make_photos(part / "images", scene=self.kind, seed=self.seed, truth_folder=part, **size)
            part.rename(self.folder)

    def has(self, masks: str) -> bool:
        """Whether it has such masks."""
        return masks.startswith("builtin") or bool(self.kind) or (self.folder / masks).is_dir()


def places(work: Path, names: Iterable[str] = ()) -> list[Place]:
    """The places, or those of these names. InputError for a name that is none."""
    made = [(kind, FIRST_SEED + n) for kind, count in MADE.items() for n in range(count)]
    folders = {f"{kind}-{seed}": work / "places" / f"{kind}-{seed}" for kind, seed in made}
    found = [Place(name, folders[name], folders[name], *made[n]) for n, name in enumerate(folders)]
    if data := os.environ.get("PERCEPTION_DATA"):
        found += [Place(name, Path(data) / name, Path(data) / name / file) for name, file in REAL.items()]
    known = {place.name: place for place in found}
    if unknown := sorted(set(names) - set(known)):
        raise InputError(f"--places: found {unknown[0]}, expected some of {', '.join(known)}")
    return [known[name] for name in names] or found


def config_of(place: Place, seed: int, masks: str, pairs: Iterable[str]) -> MapConfig:
    """The settings of one map; masks: as of `map`, or labels or labels_sam, those of the place."""
    source = masks if masks.startswith("builtin") else f"labels:{place.folder / masks}"
    sides = ["photos.max_side=480"] if place.kind == "trifles" else []
    return load_config(None, [*SHORT, *sides, *pairs, f"masks={source}", f"seed={seed}"])


def score(gmap: Map, folder: Path, frame: Map | None = None) -> dict[str, Any]:
    """FIGURES that the scene's truth gives, in the frame of another map if one is given, and (score, right) of the
    instances where each point's truth is known: `scored` of those of MIN_POINTS or more, `every` of all."""
    about = read_scene(folder)
    if "things" in about:
        truths, things = LabelFolder(folder / "masks_gt"), [int(thing) for thing in about["things"]]
        return {"own": float(overlaps(gmap, gmap.instance_ids, truths, things).max(axis=1).mean())}
    if (folder / "points.npz").is_file():
        return {"own": share_found(gmap, folder, frame)}
    from perception.evaluate.instances import evaluate, overlap_of_ids, read_truth
    from perception.export.export_map import export_labels

    cloud = read_truth_cloud(folder, frame or gmap)
    truth = cloud.labels["instance_id"]
    labels = export_labels(gmap.means, gmap.instance_ids, cloud)
    confidence = {entry["id"]: float(entry["score"]) for entry in gmap.instances}
    found = evaluate(labels, confidence, truth)
    true, names = read_truth(truth), {entry["id"]: entry["name"] for entry in about["instances"]}
    overlap = overlap_of_ids(labels, confidence, true)
    right = np.stack([overlap.pred_scores, overlap.iou.max(axis=1, initial=0) > 0.5], axis=1)
    without = sorted(set(confidence) - set(np.unique(labels).tolist()))
    return {
        **{name: float(found[name]) for name in ("ap", "ap50", "ap25")},
        "scored": right[overlap.pred_sizes >= MIN_POINTS].tolist(),
        "every": right.tolist() + [[confidence[one], 0.0] for one in without],
        "boxes": box_ratios(gmap, cloud.points[truth >= 0], truth[truth >= 0], labels[truth >= 0]),
        "missed": [names[i] for i, iou in zip(true.ids, overlap.iou.max(axis=0, initial=0), strict=True) if iou <= 0.5],
    }


def box_ratios(gmap: Map, points: np.ndarray, truth: np.ndarray, labels: np.ndarray) -> list[float]:
    """Of each thing that an instance finds with IoU > 0.5, the diagonal of the instance's box over that of the box of
    the thing's points. points [P, 3]; truth, labels [P]: ids, the latter −1 = none."""
    diagonal = {entry["id"]: float(np.linalg.norm(entry["obb"]["extent"])) for entry in gmap.instances}
    ratios = []
    for thing in np.unique(truth):
        own = truth == thing
        best = np.bincount(labels[own & (labels >= 0)], minlength=1).argmax()
        if (own & (labels == best)).sum() > 0.5 * (own | (labels == best)).sum():
            ratios.append(diagonal[int(best)] / float(np.linalg.norm(oriented_box(points[own]).extent)))
    return ratios


def share_found(gmap: Map, folder: Path, frame: Map | None = None) -> float:
    """Share of the things of scene.json, which have boxes and points, that some instance finds; frame: see `score`."""
    from scipy.spatial import cKDTree

    things = [entry for entry in read_scene(folder)["instances"] if not entry["is_stuff"]]
    with np.load(folder / "points.npz") as stored:
        points, owners = stored["points"].astype(np.float64), stored["instance"]
    origin = np.asarray((frame or gmap).info.get("scene", {}).get("origin", (0, 0, 0)), np.float64)
    found = np.zeros(len(things), bool)
    for entry in gmap.instances:
        mine = gmap.means[gmap.instance_ids == entry["id"]].astype(np.float64) + origin
        tree = cKDTree(mine) if len(mine) else None
        for n, thing in enumerate(things):
            box, half = thing["obb"], np.array(thing["obb"]["half"]) + GROWN
            inside = (np.abs((mine - box["center"]) @ np.array(box["axes"]).T) <= half).all(axis=1)
            if tree is not None and not found[n] and inside.mean() >= INSIDE:
                gap = tree.query(points[owners == thing["id"]], distance_upper_bound=NEAR)[0]
                found[n] = np.isfinite(gap).mean() >= COVERED
    return float(found.mean())


def summary(values: list[float]) -> dict[str, float]:
    """mean, spread (0 for a single value) and worst of the values of one place's maps, or of all."""
    low = np.sort(values)[: max(1, len(values) // 10)]
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return {"mean": float(np.mean(values)), "spread": spread, "worst": float(low.mean())}


def rows_of(maps: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each place, and the last for all: FIGURES' mean, spread and worst, as NAME_mean and so on."""
    rows: list[dict[str, Any]] = []
    for place in dict.fromkeys(one["place"] for one in maps):
        mine = [one for one in maps if one["place"] == place]
        rows.append({"place": place, "maps": len(mine), **_cells(mine), **_mean_cost(mine)})
    total = {"place": "all", "maps": len(maps), **_cells(maps), **_mean_cost(maps)}
    for name in FIGURES:
        spreads = [row[f"{name}_spread"] for row in rows if row.get(f"{name}_spread") is not None]
        if spreads:
            total[f"{name}_spread"] = float(np.sqrt(np.mean(np.square(spreads))))
    return [*rows, total]


def _cells(maps: list[dict[str, Any]]) -> dict[str, float]:
    cells = {}
    for name in FIGURES:
        values = [one[name] for one in maps if name in one]
        cells |= {f"{name}_{key}": value for key, value in summary(values).items()} if values else {}
    return cells


def _mean_cost(maps: list[dict[str, Any]]) -> dict[str, float]:
    return {key: float(np.mean([one[key] for one in maps])) for key in ("instances", "cpu_seconds")}


def text_of(maps: list[dict[str, Any]], against: list[dict[str, Any]]) -> str:
    """The table; with `against`, the maps of another run, the difference of each figure's mean in the maps of both."""
    columns: list[Column] = [("maps", "maps", "d"), ("instances", "instances", ".0f"), ("CPU s", "cpu_seconds", ".0f")]
    for name, head in zip(FIGURES, HEADS, strict=True):
        columns += [(head, f"{name}_mean", ".3f"), ("±", f"{name}_spread", ".3f"), ("worst", f"{name}_worst", ".3f")]
    lines = [table(rows_of(maps), columns, ("place",))]
    for kind, what in (("scored", f"instances of {MIN_POINTS} points or more"), ("every", "all instances")):
        if pairs := [pair for one in maps for pair in one.get(kind, [])]:
            found = reliability(*np.array(pairs).T)
            lines.append(f"scores of {what}: expected calibration error {found['ece']:.3f} over {found['count']}")
    ratios = np.array([ratio for one in maps for ratio in one.get("boxes", [])])
    if len(ratios):
        wrong = np.mean((ratios > OFF) | (ratios < 1 / OFF))
        lines.append(
            f"boxes of things found: {wrong:.1%} of {len(ratios)} are more than {OFF} times too large or small"
        )
    if against:
        both = {_key(one) for one in maps} & {_key(one) for one in against}
        now, then = ({r["place"]: r for r in rows_of([m for m in run if _key(m) in both])} for run in (maps, against))
        means = [f"{name}_mean" for name in FIGURES]
        changed = [
            {"place": place, "maps": row["maps"], **{m: row[m] - then[place][m] for m in means if m in row}}
            for place, row in now.items()
        ]
        heads: list[Column] = [("maps", "maps", "d"), *((h, m, "+.3f") for h, m in zip(HEADS, means, strict=True))]
        lines += ["", "less the other run's:", table(changed, heads, ("place",))]
    return "\n".join(lines)


def _key(one: dict[str, Any]) -> tuple[str, int]:
    return one["place"], one["seed"]


def main() -> None:
    """Maps what the report lacks, seed by seed, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--places", nargs="+", default=[], metavar="NAME", help="some of them (all)")
    parser.add_argument("--seeds", type=int, default=3, help="maps of each place (3)")
    parser.add_argument("--masks", default="builtin", choices=("builtin", "labels", "labels_sam"))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    parser.add_argument("--name", help="of the folder of maps and the JSON (that of the masks)")
    parser.add_argument("--against", type=Path, metavar="FILE", help="JSON of another run to compare with")
    parser.add_argument("--splats", metavar="NAME", help="maps the splats of the maps in WORK/NAME again")
    parser.add_argument("--fit", action="store_true", help="scores by the share right, for masks labels, labels_sam")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draws the reliability of scores (matplotlib)")
    parser.add_argument("--cpu-minutes", type=float, default=120, help="after which no other map is begun (120)")
    options = parser.parse_args()
    folder, begun, left = options.work / (options.name or options.masks), time.process_time(), []
    report = folder.with_suffix(".json")
    chosen = [place for place in places(options.work, options.places) if place.has(options.masks)]
    known = {_key(one): one for one in read_json(report)["maps"]} if report.is_file() else {}
    wanted = [(place, seed) for seed in range(options.seeds) for place in chosen]
    for place, seed in wanted:
        if known.get((place.name, seed), {}).get("set") == options.pairs:
            continue
        if time.process_time() - begun > 60 * options.cpu_minutes:
            left.append(f"{place.name} {seed}")
            continue
        one = known[place.name, seed] = map_and_score(place, seed, options, folder)
        with atomic_file(report, parents=True) as aside:
            aside.write_text(json.dumps({"maps": list(known.values())}, indent=1) + "\n", encoding="utf-8")
        figures = "/".join(f"{one[name]:.3f}" for name in FIGURES if name in one)
        print(f"{place.name} {seed}: {figures}, {one['cpu_seconds']:.0f} CPU s", flush=True)
    maps = [known[place.name, seed] for place, seed in wanted if (place.name, seed) in known]
    against = read_json(options.against)["maps"] if options.against else []
    print(text_of(maps, against))
    if options.fit:
        raw, score = CALIBRATION
        p, right = np.array([pair for one in maps + against for pair in one.get("every", [])]).T
        print(np.round(fitted(np.interp(p, score, raw), right > 0, raw), 3).tolist())
    if options.plot:
        scored = np.array([pair for one in maps for pair in one.get("scored", [])])
        draw(reliability(*scored.T), "instances", options.plot)
    if left:
        print(f"left out, as {options.cpu_minutes:g} CPU minutes are spent: {', '.join(left)}")


def map_and_score(place: Place, seed: int, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Maps a place with one seed, or takes the finished map, and returns its line of the report."""
    place.make()
    folder.mkdir(parents=True, exist_ok=True)
    config, started = config_of(place, seed, options.masks, options.pairs), time.process_time()
    path = folder / f"{place.name}-{seed}.gsmap"
    given = options.work / options.splats / path.name if options.splats else None
    source, frame = (given / "gaussians.ply", Map.open(given)) if given else (place.source, None)
    gmap = build_map(source, path, config, resume=path.is_dir(), progress=Progress(quiet=True))
    spent = time.process_time() - started
    facts = {"place": place.name, "seed": seed, "set": options.pairs, "masks": options.masks}
    return {**facts, "instances": len(gmap.instances), "cpu_seconds": spent, **score(gmap, place.folder, frame)}


if __name__ == "__main__":
    main()
