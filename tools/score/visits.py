"""Scores what `perception update` says of a second visit with exact truth, beside two maps made apart.

python tools score.visits VISIT1 VISIT2 WORK [--masks labels|labels_sam|builtin] [--alone] [--set KEY=VALUE ...]

VISIT1 and VISIT2 are truth folders, as `worlds.visits` writes them; VISIT2 holds changes.json. The maps of both are
made in WORK, and kept. Two tables: `update` of the first map; and the naive way, in which instances of the two maps are
matched by place and size. An instance is the thing that it shares an IoU > .5 of true points with. A thing of which the
second visit sees under 5 % is unseen; under 25 %, both its state and unseen are right. Of a thing that went and one of
the same name that came ("cactus", "cactus 25") nobody can tell that it did not move: that is right for both. Then how
far renders of what no photo of the second visit sees changed, as the update trains colours.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from perception.changes.evidence import AGREE, ROUGH, sight
from perception.config import MapConfig, load_config
from perception.gaussians.model import as_gaussians
from perception.gaussians.views import expected_depth, render, unprojected
from perception.io.cloud import read_cloud
from perception.map.history import changes_of, visits_of
from perception.map.write import Map, read_map
from perception.photos.decode import scaled_K, scaled_size
from perception.pipeline.mapping import build_map
from perception.progress import Progress
from perception.visits.scene import update_settings
from perception.visits.update import update_map

STATES = ("unchanged", "moved", "removed", "unseen", "added")
CHANGED = ("moved", "removed", "added")
UNSEEN, PARTLY = 0.05, 0.25
NEAR = 0.05
"""Metres between the centres of two instances of one thing, in the naive way; sizes within a factor of 1.5."""


@dataclass
class Truth:
    """points [P, 3] and ids [P] of each visit; entries of changes.json by id, things alone."""

    points: tuple[np.ndarray, np.ndarray]
    ids: tuple[np.ndarray, np.ndarray]
    entries: dict[int, dict[str, Any]]

    @classmethod
    def read(cls, first: Path, second: Path) -> Truth:
        clouds = [read_cloud(folder / "gt_points.ply") for folder in (first, second)]
        listed = json.loads((second / "changes.json").read_text(encoding="utf-8"))["instances"]
        entries = {entry["id"]: entry for entry in listed if not entry["is_stuff"]}
        points, ids = ([cloud.points for cloud in clouds], [cloud.labels["instance_id"] for cloud in clouds])
        return cls((points[0], points[1]), (ids[0], ids[1]), entries)

    def look_alikes(self) -> list[tuple[int, int]]:
        """(one that came, one that went) of the same name, but for the number that `worlds.visits` adds."""
        kinds = {i: re.sub(r" \d+$", "", entry["name"]) for i, entry in self.entries.items()}
        states = {state: [i for i, e in self.entries.items() if e["state"] == state] for state in ("added", "removed")}
        return [(new, old) for new in states["added"] for old in states["removed"] if kinds[new] == kinds[old]]

    def right(self, thing: int) -> tuple[str, set[str]]:
        """The true state of a thing, and all states that are right."""
        entry = self.entries[thing]
        state = {"replaced": "removed"}.get(entry["state"], entry["state"])
        seen, old = entry["seen_in_visit2"], entry.get("old_place_seen_in_visit2", 0.0)
        if state == "moved" and seen < UNSEEN:
            return ("unseen", {"unseen"}) if old < UNSEEN else ("removed", {"removed", "moved"})
        if seen < UNSEEN and state != "added":
            return "unseen", {"unseen"}
        return state, {state, "unseen"} if seen < PARTLY and state != "added" else {state}


def owners(gmap: Map, points: np.ndarray, true: np.ndarray) -> tuple[dict[int, int], dict[int, int]]:
    """By thing: the instance of the map with an IoU > .5 on the true points. By instance: the thing that most of its
    points are of."""
    from scipy.spatial import cKDTree

    held = gmap.instance_ids >= 0
    distance, nearest = cKDTree(gmap.means[held]).query(points)
    label = np.where(distance < 4 * np.median(distance), gmap.instance_ids[held][nearest], -1)
    found, most = {}, {}
    for instance in np.unique(label[label >= 0]).tolist():
        mine = label == instance
        things, counts = np.unique(true[mine], return_counts=True)
        thing, both = int(things[counts.argmax()]), int(counts.max())
        most[instance] = thing
        if both > 0.5 * (mine.sum() + (true == thing).sum() - both):
            found[thing] = instance
    return found, most


def kept(before: Map, after: Map) -> np.ndarray:
    """[N] bool: Gaussians of a map that an update left where they were."""
    means = {mean.tobytes() for mean in after.means}
    return np.array([mean.tobytes() in means for mean in before.means], bool)


def unseen_changes(before: Map, after: Map, most: int = 90) -> np.ndarray:
    """[P] grey levels by which pixels of the map's views changed with the colours of `after`, the largest of three
    channels each: those of which no photo of the last visit sees the surface, nor of their neighbours."""
    rows, gaussians = {mean.tobytes(): i for i, mean in enumerate(after.means)}, as_gaussians(before)
    same = np.array([rows.get(mean.tobytes(), -1) for mean in before.means])
    sh = np.where((same < 0)[:, None, None], before.sh, after.sh[same])
    today, visit = replace(gaussians, sh=torch.from_numpy(sh)), max(view.visit for view in after.views)
    views, found = before.views[:: 1 + len(before.views) // most], []
    for view in views:
        width, height = scaled_size(view, ROUGH)
        K, pose = scaled_K(view, width, height), view.camera_from_world
        camera = torch.from_numpy(pose.astype(np.float32)), torch.from_numpy(K.astype(np.float32)), width, height
        outs = [render(each, *camera, harmonics=True) for each in (gaussians, today)]
        images = [out.colors[0].clamp(0, 1).numpy() for out in outs]
        depth, (y, x) = expected_depth(outs[0]).numpy(), np.mgrid[:height, :width] + 0.5
        found.append((unprojected(K, pose, x, y, depth), depth > 0, 255 * np.abs(images[0] - images[1]).max(axis=2)))
    points, known, change = map(np.array, zip(*found, strict=True))
    flat, seen = points.reshape(-1, 3), ~known.ravel()
    for view in (view for view in after.views if view.visit == visit):
        inside, z, mapped = sight(gaussians, view, flat)
        seen[inside] |= (mapped == 0) | (z < (1 + AGREE) * mapped)
    near = [cv2.dilate(each.astype(np.uint8), np.ones((3, 3))) for each in seen.reshape(known.shape)]
    return np.asarray(change[np.array(near) == 0])


def as_cut(before: Map, after: Map) -> Map:
    """A map with its instances as an update found them: it makes two of one of which a part went."""
    pairs, past = [(after.means, after.instance_ids)], after.past
    if past:
        left = past["until"] == after.newest_visit - 1
        pairs.append((past["means"][left], past["ids"][left]))
    ids = {mean.tobytes(): i for pair in pairs for mean, i in zip(*pair, strict=True)}
    own = zip(before.means, before.instance_ids, strict=True)
    cut = [i if i < 0 else ids.get(mean.tobytes(), i) for mean, i in own]
    return replace(before, instance_ids=np.array(cut, np.int32))


def scores(changes: list[dict[str, Any]], first: Map, second: Map, truth: Truth) -> dict[str, Any]:
    """Precision, recall and F1 of each state; false alarms, unseen things called removed, errors of motions, ids."""
    before, most_before = owners(first, truth.points[0], truth.ids[0])
    after, most_after = owners(second, truth.points[1], truth.ids[1])
    said = {change["instance_id"]: change for change in changes if change["state"] != "added"}
    added = {change["instance_id"] for change in changes if change["state"] == "added"}
    right, wrong, true = (dict.fromkeys(STATES, 0) for _ in range(3))
    alarms, lost, errors, kept, unchanged, unseen, blind = 0, 0, [], [], 0, 0, 0
    came, errant = [], []  # confidence and truth of what was told; what is wrong, in words
    twins = {}  # of things that came, those that went and look the same, if they are said to stand there
    for new, old in truth.look_alikes():
        moved = said.get(before.get(old, -1), {}).get("state") == "moved"
        if moved and before[old] == after.get(new) and old not in twins.values():
            twins[new] = old
    for thing in truth.entries:
        state, allowed = truth.right(thing)
        if state == "added":
            if truth.entries[thing]["seen_in_visit2"] >= UNSEEN and (truth.ids[1] == thing).any():
                true["added"] += 1
                found = after.get(thing) in added or thing in twins
                right["added"] += found
                errant += [] if found else [f"{truth.entries[thing]['name']}: added, not said"]
            continue
        if not (truth.ids[0] == thing).any():
            continue
        told = said.get(before.get(thing, -1), {"state": None})
        if thing in twins.values():
            told = {**told, "state": state}
        new_alarm = after.get(thing) in added
        wrong["added"] += new_alarm
        true[state] += not (told["state"] in allowed and told["state"] != state)
        if told["state"] not in allowed or new_alarm:
            errant.append(f"{truth.entries[thing]['name']}: {state}, said {told['state']}{', added' * new_alarm}")
        if told["state"] not in (None, "unseen") and told.get("confidence") is not None:
            came.append((told["confidence"], float(told["state"] in allowed)))
        if told["state"] == state:
            right[state] += 1
        elif told["state"] is not None and told["state"] not in allowed:
            wrong[told["state"]] += 1
        if state == "unchanged" and thing in before:
            unchanged += 1
            alarms += told["state"] in ("moved", "removed") or new_alarm
            kept += [before[thing] == after[thing]] if thing in after else []
        if state == "unseen" and thing in before:
            unseen += 1
            lost += told["state"] == "removed"
        if told["state"] == "moved" and told.get("transform") and truth.entries[thing]["transform"]:
            error = _error(np.array(told["transform"]), np.array(truth.entries[thing]["transform"]), thing, truth)
            unknown = told.get("axis") is not None or told.get("ambiguous", False)
            blind += unknown
            errors.append((*error[:2], np.nan if unknown else error[2]))
    for change in changes:  # of instances that are no thing: those on stuff do not count
        new, instance = change["state"] == "added", change["instance_id"]
        if instance not in (after if new else before).values():
            most = (most_after if new else most_before).get(instance)
            stuff = most is not None and most not in truth.entries
            wrong[change["state"]] += not stuff and (most is None or change["state"] not in truth.right(most)[1])
    table = {
        state: {
            "precision": right[state] / max(1, right[state] + wrong[state]),
            "recall": right[state] / max(1, true[state]),
            "f1": 2 * right[state] / max(1, right[state] + wrong[state] + true[state]),
            "true": true[state],
        }
        for state in STATES
    }
    known = [table[state]["f1"] for state in CHANGED if table[state]["true"]]
    median = [_median(column) for column in np.array(errors).reshape(-1, 3).T]
    return {
        "states": table,
        "f1": float(np.mean(known)) if known else None,
        "false_alarms": alarms / max(1, unchanged), "unseen_called_removed": lost / max(1, unseen),
        "motion_cm": median[0], "nearest_cm": median[1], "motion_degrees": median[2], "turns_unknown": blind,
        "ids_kept": float(np.mean(kept)) if kept else None, "told": came, "wrong": errant,
    }  # fmt: skip


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _error(found: np.ndarray, true: np.ndarray, thing: int, truth: Truth) -> tuple[float, float, float]:
    """Centimetres at the thing's centre; from its points to the nearest ones as they truly lie, in the mean, which
    is blind to turns that change nothing; degrees."""
    from scipy.spatial import cKDTree

    points = truth.points[0][truth.ids[0] == thing]
    centre = points.mean(axis=0)
    placed, right = (points @ motion[:3, :3].T + motion[:3, 3] for motion in (found, true))
    nearest = float(cKDTree(right).query(placed)[0].mean())
    shift = (found - true)[:3, :3] @ centre + (found - true)[:3, 3]
    cosine = (np.trace(found[:3, :3] @ true[:3, :3].T) - 1) / 2
    return 100 * float(np.linalg.norm(shift)), 100 * nearest, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def naive(first: Map, second: Map) -> list[dict[str, Any]]:
    """Changes between two maps made apart, whose instances are the same where place and size agree."""
    from scipy.optimize import linear_sum_assignment

    def facts(gmap: Map) -> tuple[np.ndarray, np.ndarray]:
        centres = np.array([entry["centroid"] for entry in gmap.instances]).reshape(-1, 3)
        return centres, np.array([np.linalg.norm(entry["obb"]["extent"]) for entry in gmap.instances])

    (a, size_a), (b, size_b) = facts(first), facts(second)
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    alike = np.abs(np.log(size_a[:, None] / size_b[None])) < np.log(1.5)
    changes, free_a, free_b = [], set(range(len(a))), set(range(len(b)))
    for reach, state in ((NEAR, "unchanged"), (np.inf, "moved")):
        cost = np.where(alike & (distance < reach), distance, 1e6)
        cost[sorted(set(range(len(a))) - free_a)] = cost[:, sorted(set(range(len(b))) - free_b)] = 1e6
        for i, j in zip(*linear_sum_assignment(cost), strict=True):
            if cost[i, j] < 1e6:
                free_a, free_b = free_a - {i}, free_b - {j}
                changes.append({"state": state, "instance_id": first.instances[i]["id"], "new_centroid": b[j].tolist()})
    changes += [{"state": "removed", "instance_id": first.instances[i]["id"]} for i in sorted(free_a)]
    return changes + [{"state": "added", "instance_id": second.instances[j]["id"]} for j in sorted(free_b)]


def show(name: str, result: dict[str, Any]) -> None:
    print(f"{name}: mean F1 of moved, removed and added {result['f1'] or float('nan'):.3f}")
    for state, row in result["states"].items():
        print(f"  {state:10s} P {row['precision']:.2f}  R {row['recall']:.2f}  F1 {row['f1']:.2f}  of {row['true']}")
    rest = {key: value for key, value in result.items() if key not in ("states", "f1", "told", "wrong")}
    print("  " + ", ".join(f"{key} {value:.3f}" if value is not None else f"{key} –" for key, value in rest.items()))
    print("  wrong: " + "; ".join(result["wrong"]))


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("first", "second", "work"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--masks", choices=("labels", "labels_sam", "builtin"), default="labels")
    parser.add_argument("--alone", action="store_true", help="the photos of VISIT2 without their poses")
    parser.add_argument("--set", action="append", default=[], dest="pairs")
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    seconds: dict[str, float] = {}

    def masks(folder: Path) -> str:
        return "masks=builtin" if given.masks == "builtin" else f"masks=labels:{folder / given.masks}"

    def mapped(folder: Path, output: Path) -> Map:
        config: MapConfig = load_config(None, [*given.pairs, masks(folder)])
        start = time.monotonic()
        made = read_map(output) if output.exists() else build_map(folder, output, config, progress=Progress())
        seconds[output.stem] = round(time.monotonic() - start, 1)
        return made

    first, apart = (
        mapped(folder, given.work / f"{name}.gsmap")
        for folder, name in ((given.first, "first"), (given.second, "apart"))
    )
    source = given.second / "images" if given.alone else given.second
    output, start = given.work / ("alone.gsmap" if given.alone else "today.gsmap"), time.monotonic()
    if not output.exists():
        config = update_settings(given.work / "first.gsmap", None, [masks(given.second)])
        update_map(given.work / "first.gsmap", source, output, config, progress=Progress())
    today = read_map(output)
    seconds["today"] = round(time.monotonic() - start, 1)
    truth = Truth.read(given.first, given.second)
    told = changes_of(visits_of(today.info, len(today.views)), today.instances, 0)
    show("update", scores(told, as_cut(first, today), today, truth))
    show("two maps made apart", scores(naive(first, apart), first, apart, truth))
    change = unseen_changes(first, today)
    if len(change):
        most, mean = change.max(), change.mean()
        print(f"renders of what the visit does not see change by up to {most:.1f} of 255, {mean:.3f} in the mean")
    figures = [(name, gmap.info["quality"].get("psnr")) for name, gmap in (("update", today), ("new map", apart))]
    print("held-out PSNR: " + ", ".join(f"{name} {psnr:.2f} dB" for name, psnr in figures if psnr is not None))
    print(f"seconds: {seconds}")


if __name__ == "__main__":
    main()
