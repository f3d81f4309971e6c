"""Scores the relations of the scene graph on generated scenes, whose placements are known.

    python tools score.relations [--scenes 20] [--first 100]

Instances are the points of the truth that two photos see, without training. "on" is what the generator placed on what;
"next to" is `LevelBoxes`' measure on the true boxes, of things that stand on the same; "in" is a fruit in an open box
that the script puts among the things.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from perception.io.cloud import read_cloud
from perception.query.relations import LevelBoxes
from perception.query.scene_graph import MATCH, holders
from worlds import make_photos

LEAST = 30  # points of an instance that is asked about


def scored(folder: Path, rng: np.random.Generator) -> Counter[str]:
    """Counts "on true", "on found", "on right" and so on for one scene."""
    entries = json.loads((folder / "scene.json").read_text())["instances"]
    cloud = read_cloud(folder / "gt_points.ply")
    assert cloud.labels is not None
    points = {e["id"]: cloud.points[cloud.labels["instance_id"] == e["id"]].astype(np.float64) for e in entries}
    entries = [entry for entry in entries if len(points[entry["id"]]) >= LEAST]
    ids = [entry["id"] for entry in entries]
    table = next(entry for entry in entries if "table" in entry["name"])
    box, fruit = _boxed(points[table["id"]], [points[i] for i in ids if i != table["id"]], rng)
    clouds = [points[i] for i in ids] + [box, fruit]
    noisy = [c + rng.normal(0, 0.003, c.shape) for c in clouds]
    places, true_places = (_places(c) for c in (noisy, clouds))
    held = holders(noisy, places)
    position = {i: n for n, i in enumerate(ids)}
    on = {(n, position[e["on"]]) for n, e in enumerate(entries) if e["on"] in position}
    on.add((len(ids), position[table["id"]]))
    within = {(len(ids) + 1, len(ids))}
    support = dict(on)
    near = true_places.match("beside") >= MATCH
    beside = {(a, b) for a in support for b in support if a < b and near[a, b] and support[a] == support[b]}
    found = {(n, h.position, h.relation) for n, h in enumerate(held) if h is not None}
    near = places.match("beside") >= MATCH
    holder = {n: h.position for n, h in enumerate(held) if h is not None and h.relation == "on"}
    found_beside = {(a, b) for a in holder for b in holder if a < b and near[a, b] and holder[a] == holder[b]}
    counts: Counter[str] = Counter()
    for name, truth, got in (
        ("on", on, {(a, b) for a, b, r in found if r == "on"}),
        ("in", within, {(a, b) for a, b, r in found if r == "in"}),
        ("next to", beside, found_beside),
    ):
        counts.update({f"{name} true": len(truth), f"{name} found": len(got), f"{name} right": len(truth & got)})
        names = [e["name"] for e in entries] + ["open box", "fruit in it"]
        for a, b in sorted(truth ^ got):
            print(f"  {folder.name}: {names[a]} {name} {names[b]}: {'missed' if (a, b) in truth else 'wrong'}")
    return counts


def _boxed(table: np.ndarray, others: list[np.ndarray], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """An open box on the table where it is freest, and a fruit in it."""
    top = float(np.quantile(table[:, 2], 0.95))
    plane = table[table[:, 2] > top - 0.02]
    taken = np.concatenate([o[(o[:, 2] > top) & (o[:, 2] < top + 0.5)] for o in others])[:, :2]
    low, high = plane[:, :2].min(axis=0) + 0.08, plane[:, :2].max(axis=0) - 0.08
    spots = rng.uniform(low, high, (400, 2))
    free = np.array([np.abs(taken - spot).max(axis=1).min(initial=1.0) for spot in spots])
    spot, half, tall = spots[free.argmax()], float(min(0.09, 0.8 * free.max())), 0.08
    side = rng.uniform(-half, half, 1500)
    wall, axis = rng.choice([-half, half], 1500), rng.integers(2, size=1500)
    box = np.stack([np.where(axis, side, wall), np.where(axis, wall, side), rng.uniform(0, tall, 1500)], axis=1)
    base = np.c_[rng.uniform(-half, half, (400, 2)), np.full(400, 0.004)]
    direction = rng.normal(size=(500, 3))
    direction[:, 2] = np.abs(direction[:, 2])  # the upper half is seen
    fruit = direction / np.linalg.norm(direction, axis=1, keepdims=True) * 0.45 * half + [0, 0, 0.45 * half + 0.004]
    at = np.array([*spot, top])
    return np.concatenate([box, base]) + at, fruit + at


def _places(clouds: list[np.ndarray]) -> LevelBoxes:
    boxes = np.array([np.quantile(cloud, [0.02, 0.98], axis=0) for cloud in clouds])
    return LevelBoxes(boxes[:, 0], boxes[:, 1], np.empty((0, 4, 4)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20, help="of each kind")
    parser.add_argument("--first", type=int, default=100, help="seed of the first")
    args = parser.parse_args()
    for kind in ("tabletop", "room"):
        total: Counter[str] = Counter()
        for seed in range(args.first, args.first + args.scenes):
            with tempfile.TemporaryDirectory() as name:
                home = Path(name) / f"{kind}_{seed}"
                size = {"views": 24, "width": 160, "height": 120, "light_samples": 2}
                make_photos(home / "images", scene=kind, seed=seed, truth_folder=home, **size)
                total += scored(home, np.random.default_rng(seed))
        for what in ("on", "next to", "in"):
            true, found, right = (total[f"{what} {word}"] for word in ("true", "found", "right"))
            print(f"{kind} {what}: precision {right / max(found, 1):.3f}, recall {right / max(true, 1):.3f} of {true}")
