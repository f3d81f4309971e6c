"""Says where the built-in masks lose things: in patches, in the order of merges, or in the cut.

python tools score.segments [--depth] SCENE...

Scenes are those of docs/benchmarks.md, read by stereo as in `training.masks`, without training a map. A thing is found
where a union of patches, a region of the tree, a region of the cut, or a segment has an IoU above 0.5 with it, in
voxels; "averaged": a segment on which three grids of voxels agree, with which the photos are labelled. Two things are
joined where one segment holds more than half of each: by patches, if more than half of the smaller one lies in patches
that are mostly of other things; else by the networks, if the first region with half of each comes from a merge of odds
above even; else by the cut. Last, the share of THRESHOLDS of IoU that the best label of each thing passes, pixels of
all photos together: of labels as their voxels are, and as their borders moved to the photos'.
--depth: depth as of a camera.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.output import Column, table
from perception.masks.builtin import labels_of, segmented
from perception.masks.cues import filled
from perception.masks.merging import REGION_COLUMNS, MergeTree, divided, read_model, tree_by
from perception.masks.surface import FOOTPRINTS
from score.instances import read_scene as read_truth
from support.mask_scores import leaf_sums
from training.masks import LEAST, Reading, World, read_scene, world_of

FOUND, THRESHOLDS, LEAST_PIXELS = 0.5, np.arange(0.5, 1, 0.05), 500
STAGES, CAUSES = ("patches", "tree", "cut", "segments", "averaged"), ("patches", "network", "cut")
COLUMNS: tuple[Column, ...] = (
    ("things", "things", "d"),
    *((name, f"in_{name}", "d") for name in STAGES),
    *((f"joined by {name}", f"by_{name}", "d") for name in CAUSES),
    ("voxel labels", "voxels", ".3f"),
    ("labels", "labels", ".3f"),
)


def best_iou(shared: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """[T] the best IoU of each thing with some set. shared: [N, T] voxels of the sets by thing; sizes: [T]."""
    return np.asarray((shared / (shared.sum(axis=1, keepdims=True) + sizes - shared).clip(min=1)).max(axis=0))


def union_iou(votes: np.ndarray) -> np.ndarray:
    """[T] IoU of each thing with the union of the patches that are mostly of it. votes: [R, T]."""
    own = votes.argmax(axis=1)
    unions = np.zeros((votes.shape[1], votes.shape[1]))
    np.add.at(unions, own, votes)
    hits = np.diagonal(unions)
    return np.asarray(hits / (unions.sum(axis=1) + votes.sum(axis=0) - hits).clip(min=1))


def joined_by(votes: np.ndarray, tree: MergeTree, segments: np.ndarray, things: Sequence[int]) -> dict[str, int]:
    """Number of pairs of things that each of CAUSES joined. votes: [R, T]; segments: [S, T] voxels by thing."""
    sizes, regions = votes.sum(axis=0), leaf_sums(tree, votes)
    odds = tree.features[:, REGION_COLUMNS.index("last_odds")]
    own, counts = votes.argmax(axis=1), dict.fromkeys(CAUSES, 0)
    for k, one in enumerate(things):
        for two in things[k + 1 :]:
            if not (segments[:, [one, two]] > sizes[[one, two]] / 2).all(axis=1).any():
                continue
            smaller = min(one, two, key=lambda thing: float(sizes[thing]))
            both = np.flatnonzero((regions[:, [one, two]] > sizes[[one, two]] / 2).all(axis=1))
            if votes[own != smaller, smaller].sum() > sizes[smaller] / 2 or (len(both) and both[0] < tree.leaves):
                counts["patches"] += 1
            else:
                counts["network" if len(both) and odds[both[0]] > 0 else "cut"] += 1
    return counts


def share_passed(reading: Reading, images: Sequence[np.ndarray]) -> float:
    """Share of THRESHOLDS that the best label of each thing of LEAST_PIXELS passes. images: [h, w] labels of the views,
    0 = none."""
    shared = np.zeros((max(int(image.max()) for image in images) + 1, max(int(ids.max()) for ids in reading.ids) + 1))
    for image, ids in zip(images, reading.ids, strict=True):
        np.add.at(shared, (image, ids), 1)
    sizes, shared[0], shared[:, 0] = shared.sum(axis=0), 0, 0
    things = np.flatnonzero(sizes[1:] >= LEAST_PIXELS) + 1
    return float((best_iou(shared, sizes)[things, None] > THRESHOLDS).mean())


def of_voxels(voxel: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """[h, w] segment of each pixel's voxel, of the nearest pixel that has one where there is none."""
    labels = np.where(voxel >= 0, segment[voxel], 0)
    return filled(labels, labels > 0) if labels.any() else labels


def by_thing(segment: np.ndarray, world: World) -> np.ndarray:
    """[S + 1, T] voxels of each segment by thing; none of segment 0, small patches without neighbours."""
    shared = np.zeros((int(segment.max()) + 1, world.votes.shape[1]))
    np.add.at(shared, (segment, world.truth), 1)
    shared[0] = 0
    return shared


def row_of(folder: Path, stereo: bool) -> dict[str, Any]:
    """The line of one scene."""
    reading = read_scene(folder, stereo, side=FOOTPRINTS)
    world, model = world_of(reading), read_model()
    tree = tree_by(model, world.graph)
    segment, _ = divided(world.graph, tree, model)
    cuts = segmented(reading.views, reading.side)
    assert cuts is not None  # for the type checker
    segments, mean = (by_thing(of, world) for of in (segment, cuts.segment))
    votes, regions = world.votes, leaf_sums(tree, world.votes)
    sizes, cut = votes.sum(axis=0), np.unique(tree.cut(model.probabilities(tree)[0] - model.cost))
    ids = [int(entry["id"]) for entry in read_truth(folder)["instances"] if not entry["is_stuff"]]
    things = [thing for thing in ids if thing < len(sizes) and sizes[thing] >= LEAST]
    ious = (union_iou(votes), *(best_iou(sets, sizes) for sets in (regions, regions[cut], segments, mean)))
    return {
        "place": folder.name,
        "things": len(things),
        **{f"in_{name}": int((iou[things] > FOUND).sum()) for name, iou in zip(STAGES, ious, strict=True)},
        **{f"by_{name}": count for name, count in joined_by(votes, tree, segments, things).items()},
        "voxels": share_passed(reading, [of_voxels(view.voxel, cuts.segment) for view in reading.views]),
        "labels": share_passed(reading, [labels_of(view, cuts.segment) for view in reading.views]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--depth", action="store_true", help="depth as of a camera, not by stereo")
    options = parser.parse_args()
    rows = [row_of(folder, stereo=not options.depth) for folder in options.scenes]
    sums = {key: sum(row[key] for row in rows) for _, key, _ in COLUMNS}
    rows.append({"place": "all", **sums, **{key: sums[key] / len(rows) for key in ("voxels", "labels")}})
    print(table(rows, COLUMNS, ("place",)))


if __name__ == "__main__":
    main()
