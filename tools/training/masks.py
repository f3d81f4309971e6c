"""Trains the networks of the built-in masks on rendered worlds.

python tools training.masks WORK

Worlds are clutter, rooms, tabletops and patchwork by seed, and the path-traced ones that `blender_worlds` has written
into WORK, in sets of eight: 24 sets train, two choose the cost and the calibration, two are for testing. Each world is
read twice, as maps with and without depth images see its surface. A network of object borders is trained first, then
what tells pairs of patches and regions. Pairs are gathered along merges that the truth permits, in the order of a plain
rule, then of the model so far (Nunez-Iglesias et al. 2013). WORK keeps the worlds and the first network, so that a run
that was stopped goes on. On two cores, the worlds take 30 min, the first network 38 min (of one), and learning
11 min. Equal seeds give equal weights. The packaged ones are those of this command.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import shutil
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise, product, repeat
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.output import Column, table
from perception.masks.boundaries import WEIGHTS as BORDERS
from perception.masks.boundaries import inputs_of
from perception.masks.merge_features import PAIR_FEATURES, pair_features
from perception.masks.merging import (
    REGION_COLUMNS,
    SMALLEST,
    WEIGHTS,
    MergeModel,
    MergeTree,
    Network,
    divided,
    merge_tree,
    read_model,
    tree_by,
)
from perception.masks.stereo import StereoView
from perception.masks.surface import FOOTPRINTS
from perception.masks.surface_graph import SurfaceGraph
from support.mask_scores import leaf_sums
from training import boundaries, clutter, furnished, patchwork
from worlds import scene as scenes

scenes.SCENES |= {"clutter": clutter, "patchwork": patchwork}
PATCHWORK = (("patchwork", 4000, 2), ("patchwork", 4001, 2))  # first seed, step
FURNISHED = (("furnished", 5000, 2), ("furnished", 5001, 2))
SCENES = (("clutter", 3100, 2), ("clutter", 3101, 2), ("room", 2000, 1), ("tabletop", 1000, 1), *PATCHWORK, *FURNISHED)
KEPT = {"validation": (8, 18), "test": (9, 19)}  # numbers of sets that are not trained on
PAIRS, LEAST = 8000, 20  # pairs of one world and round; voxels of a region that is learned from
VIEWS = 9  # of a reading that borders are learned from
MEMBERS = 3  # networks of an ensemble for pairs; twice as many for regions, of which there are fewer
COSTS = (0.01, 0.02, 0.05, 0.1, 0.15)  # higher ones join things in scenes unlike the worlds
NOISE, NEARER = 0.1, 0.3  # standard deviations: of inputs, relative to theirs; of the logarithm of the size of things
EXTENTS = ("thickness", "width", "length")
# Power of that size in each feature of pairs
PAIR_SIZE = {"smaller_area": 2, "larger_area": 2, "contact": 1}
PAIR_SIZE |= {f"{which}_{name}": 1 for which in ("larger", "smaller") for name in EXTENTS}
REGION_SIZE = {"area": 2, **dict.fromkeys(EXTENTS, 1)}  # and of regions
RENDERED, SENSED = 0.1, 0.025  # relative errors of depth; the latter make flat patches as thick as a Kinect's are
POSES = 0.005  # errors of poses: radians, and relative to the median depth
SIDES = (2.5, 5.0)  # of voxels, in pixel footprints
GOALS = ("AP", "AP50", "AP25", "reach")
COLUMNS: tuple[Column, ...] = tuple((name, name.lower(), ".3f") for name in (*GOALS, "ECE"))
Samples = tuple[np.ndarray, ...]  # inputs [P, F], targets [P, O], weights [P]


@dataclass
class World:
    """graph: of R patches; truth: [V] id of each voxel, 0 = unknown; votes: [R, T] voxels of each patch by id."""

    graph: SurfaceGraph
    truth: np.ndarray

    def __post_init__(self) -> None:
        self.votes = np.zeros((self.graph.count, int(self.truth.max()) + 1))
        np.add.at(self.votes, (self.graph.patch, self.truth), 1)


@dataclass
class Reading:
    """A scene as a map sees it. views: with depth; ids: [h, w] int64 of each view, true; side: of a voxel, in pixel
    footprints; stuff: ids of floors, walls and tables; walls: an id of three walls in one."""

    views: list[StereoView]
    ids: list[np.ndarray]
    side: float
    stuff: list[int]
    walls: list[int] = field(default_factory=list)


def read_scene(folder: Path, stereo: bool, seed: int = 0, skip: int = -1, side: float = 0) -> Reading:
    """A scene in the format of docs/benchmarks.md, as a map with depth images or, `stereo`, without sees its surface.
    seed: of the noise. skip: a photo to leave out. side: of a voxel, in pixel footprints; 0: drawn from SIDES."""
    import cv2
    from scipy.spatial.transform import Rotation

    from perception.masks.stereo import make_stereo_view, measure_depths
    from perception.photos.decode import read_photo
    from perception.types import View

    about = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    K = np.array([[about["fl_x"], 0, about["cx"]], [0, about["fl_y"], about["cy"]], [0, 0, 1]])
    rng = np.random.default_rng([seed, *folder.name.encode()])
    share, drawn = rng.uniform(0, 1), rng.uniform(*SIDES)
    views, ids = [], []
    for k, frame in enumerate(about["frames"]):
        photo = folder / frame["file_path"]
        files = (str(folder / kind / f"{photo.stem}.png") for kind in ("depth", "masks_gt"))
        depth, truth = (np.asarray(cv2.imread(file, cv2.IMREAD_UNCHANGED)) for file in files)
        depth = depth.astype(np.float32) / 1000
        pose = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1]))
        noisy = _noisy(depth, stereo, share, rng)
        if not stereo:
            pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, POSES * share, 3)).as_matrix() @ pose[:3, :3]
            pose[:3, 3] += rng.normal(0, POSES * share * np.median(depth[depth > 0]), 3)
        view = View(photo.stem, photo, K, depth.shape[1], depth.shape[0], pose)
        made = make_stereo_view(view, read_photo(photo), noisy)
        if made is not None and k != skip:
            made.measured = not stereo
            views.append(made)
            shown = cv2.resize(truth, made.grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
            ids.append(shown.astype(np.int64))
    measure_depths(views)
    named = json.loads((folder / "scene.json").read_text(encoding="utf-8"))["instances"]
    walls = [entry["id"] for entry in named if entry["name"] == "wall"]
    walls = walls if len(walls) == 1 else []  # a demo tabletop's three are one body
    return Reading(views, ids, side or drawn, [entry["id"] for entry in named if entry["is_stuff"]], walls)


def world_of(reading: Reading, borders: Path = BORDERS) -> World:
    """The surface graph of a reading, with the truth. The tabletop's three walls count as three. borders: weights."""
    from perception.masks.builtin import fuse, surface_graphs

    (surface,) = fuse(reading.views, reading.side, borders)
    (graph,) = surface_graphs(reading.views, [surface])
    votes = np.zeros((len(surface), int(max(image.max() for image in reading.ids)) + 1), np.int32)
    for shown_by, image in zip(reading.views, reading.ids, strict=True):
        on_surface = shown_by.voxel >= 0
        np.add.at(votes, (shown_by.voxel[on_surface], image[on_surface]), 1)
    truth = votes.argmax(axis=1)
    for wall in reading.walls:
        across = surface.points[:, 0] * (truth == wall)
        truth += votes.shape[1] * ((np.abs(across) > 1.5) + (across > 1.5).astype(int))
    return World(graph, truth)


def _noisy(depth: np.ndarray, stereo: bool, share: float, rng: np.random.Generator) -> np.ndarray:
    """Depth [h, w] as a map in training renders it, smooth and wrong by 5 to 6 % in the median; or as a depth camera
    measures it: noise grows with the square of the depth (Khoshelham & Elberink 2012), and most pixels at steps are
    unknown. Both are wrong in waves. share: in [0, 1], of the largest errors."""
    import cv2

    from perception.photos.depth import without_edges

    def waves(spread: float) -> np.ndarray:
        knots = rng.normal(0, spread, (5, 7))
        return np.asarray(np.exp(cv2.resize(knots, depth.shape[::-1], interpolation=cv2.INTER_CUBIC)))

    if stereo:
        smooth = cv2.GaussianBlur(depth, (0, 0), depth.shape[1] / 40)
        return np.where(depth > 0, smooth * waves(RENDERED * (0.5 + share)), 0)
    noise = cv2.GaussianBlur(rng.normal(0, 1, depth.shape), (0, 0), 0.8)
    kernel = np.ones((5, 5), np.uint8)
    step = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) > 0.04 * depth
    unknown = (depth == 0) | step & (rng.random(depth.shape) < 0.7)
    noisy = depth + (0.5 + 2 * share) * (0.0024 + 0.0038 * (depth - 0.4) ** 2) * noise
    return without_edges(np.where(unknown, 0, noisy * waves(SENSED * share)).astype(np.float32))


def make_reading(folder: Path, stereo: bool) -> Reading:
    """The scene SCENE_SEED, rendered and read unless it is there."""
    file = folder.with_suffix(".stereo" if stereo else ".sensor")
    if not file.is_file():
        scene, seed = folder.name.split("_")
        if not (folder / "scene.json").is_file():
            if scene == "furnished":
                furnished.finish(folder)
            else:
                size = {"width": 320, "height": 240, "views": 26 if scene == "room" else 20, "light_samples": 6}
                scenes.make_photos(folder / "images", scene=scene, seed=int(seed), truth_folder=folder, **size)
        file.with_suffix(".part").write_bytes(pickle.dumps(tuple(vars(read_scene(folder, stereo)).values())))
        file.with_suffix(".part").replace(file)
    return Reading(*pickle.loads(file.read_bytes()))


def border_samples(folder: Path, stereo: bool) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and targets of the network of borders, from some views."""
    reading = make_reading(folder, stereo)
    some = np.random.default_rng(0).permutation(len(reading.views))[:VIEWS]
    inputs = [inputs_of(*reading.views[k].cues()) for k in some]
    return np.stack(inputs), np.stack([boundaries.targets_of(reading.ids[k], reading.stuff) for k in some])


def make_world(folder: Path, stereo: bool, borders: Path = BORDERS) -> World:
    """The surface graph of the scene SCENE_SEED, with the truth."""
    return world_of(make_reading(folder, stereo), borders)


def plain_rule(features: np.ndarray) -> np.ndarray:
    """Alike in colour, without an edge, on one plane: the order of the merges that are first learned from."""
    unlike = features[:, [PAIR_FEATURES.index(name) for name in ("edge", "colour", "turn")]]
    same_plane = features[:, PAIR_FEATURES.index("same_plane"), None]
    return np.asarray(2 - unlike.sum(axis=1, keepdims=True) + 2 * same_plane)


def pairs_of(world: World, policy: Callable[[np.ndarray], np.ndarray], seed: int) -> Samples:
    """Pairs along merges in the policy's order, and whether they are one object. Patches of different objects never
    merge, and impure ones are not learned from."""
    graph = world.graph.copy()
    columns = graph.sums.shape[1]
    graph.sums = np.concatenate([graph.sums, world.votes], axis=1)  # so that `merge` adds up the votes too
    found: list[Samples] = []

    def score(state: SurfaceGraph, pairs: np.ndarray) -> np.ndarray:
        features = pair_features(state, pairs)
        votes = state.sums[pairs, columns:]
        size, top = votes.sum(axis=-1), votes.argmax(axis=-1)
        sure = (votes[..., 1:].sum(axis=-1) > 10) & (votes.max(axis=-1) > 0.7 * size)
        same, use = top[:, 0] == top[:, 1], sure.all(axis=1)
        found.append((features[use], same[use, None], np.log1p(size.min(axis=1))[use]))
        small = [min(state.area(a), state.area(b)) < SMALLEST for a, b in pairs.tolist()]
        return np.where(same | small, policy(features)[:, 0], -np.inf)

    merge_tree(graph, score)
    some = np.random.default_rng(seed).permutation(sum(len(part[0]) for part in found))[:PAIRS]
    return tuple(np.concatenate(column)[some] for column in zip(*found, strict=True))


def regions_of(world: World, pair: Network) -> Samples:
    """Regions of a tree, and whether their IoU with an object exceeds 0.5 and 0.75."""
    tree = tree_by(MergeModel(pair, pair, 0), world.graph)
    votes = leaf_sums(tree, world.votes)
    size = votes.sum(axis=1)
    best = (votes / (size[:, None] + world.votes.sum(axis=0) - votes))[:, 1:].max(axis=1)[size >= LEAST]
    return tree.features[size >= LEAST], np.stack([best > 0.5, best > 0.75], axis=1), np.ones(len(best))


def fit(
    samples: list[Samples], size: np.ndarray, epochs: int, seed: int, members: int = MEMBERS,
    hidden: tuple[int, int] = (24, 12),
) -> Network:  # fmt: skip
    """Networks with two layers of `hidden` units, by AdamW on the weighted cross entropy. size: [F] power of the
    size of things in each feature. Inputs are varied by other sizes and by noise, for stability."""
    import torch

    torch.manual_seed(seed)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums of one order
    x, y, weight = (np.concatenate(column) for column in zip(*samples, strict=True))
    mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-3)
    inputs = torch.from_numpy(np.clip((x - mean) / scale, -5, 5).astype(np.float32))
    target, weights = (torch.from_numpy(a.astype(np.float32)) for a in (y, weight[:, None] / weight.mean()))
    nearer = torch.tensor([NEARER * power / float(scale[k]) for k, power in enumerate(size.tolist())])
    sizes = [x.shape[1], *hidden, y.shape[1]]
    layers = [(torch.randn(members, b, a) * (2 / a) ** 0.5).requires_grad_() for a, b in pairwise(sizes)]
    offsets = [torch.zeros(members, 1, b, requires_grad=True) for b in sizes[1:]]
    steps = epochs * len(x) // 1024
    optimiser = torch.optim.AdamW([*layers, *offsets], lr=4e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        some = torch.randint(len(x), (members, 1024))
        h = inputs[some] + NOISE * torch.randn(members, 1024, x.shape[1]) + torch.randn(members, 1024, 1) * nearer
        for k, (layer, offset) in enumerate(zip(layers, offsets, strict=True)):
            h = torch.baddbmm(offset, h.relu() if k else h, layer.transpose(1, 2))
        optimiser.zero_grad()
        torch.nn.functional.binary_cross_entropy_with_logits(h, target[some], weights[some]).backward()
        optimiser.step()
        schedule.step()
    torch.set_num_threads(threads)
    learned = (part.detach().numpy() for pair in zip(layers, offsets, strict=True) for part in pair)
    return Network((mean.astype(np.float32), scale.astype(np.float32), *learned))


def learn(worlds: list[World], seed: int = 0, each: Callable[..., Iterable[Samples]] = map) -> MergeModel:
    """Both networks, with a cost and a calibration yet to be tuned. each: `map`, or that of a pool."""
    samples = list(each(pairs_of, worlds, repeat(plain_rule), repeat(seed)))
    size = np.array([PAIR_SIZE.get(name, 0) for name in PAIR_FEATURES])
    first = fit(samples, size, 6, seed)
    pair = fit(samples + list(each(pairs_of, worlds, repeat(first), repeat(seed + 1))), size, 6, seed)
    regions = list(each(regions_of, worlds, repeat(pair)))
    size = np.zeros(regions[0][0].shape[1], int)
    size[: len(REGION_COLUMNS)] = [REGION_SIZE.get(name, 0) for name in REGION_COLUMNS]  # the rest are differences
    region = fit(regions, size, 20, seed, 2 * MEMBERS, (32, 16))
    return MergeModel(pair, region, COSTS[0])


def scores(world: World, tree: MergeTree, model: MergeModel) -> dict[str, Any]:
    """AP of all instances of a world; reach, the share of them with a segment that lies in it by half and covers a
    quarter of it; and of each segment of ≥ 100 voxels its probability and whether it is right."""
    from perception.evaluate.instances import evaluate

    labels, probability = divided(world.graph, tree, model)
    both = np.zeros((len(probability), world.votes.shape[1]))
    np.add.at(both, (labels, world.truth), 1)
    sizes = both.sum(axis=1)
    best = (both / (sizes[:, None] + both.sum(axis=0) - both + 1e-9))[:, 1:].max(axis=1)
    large = (sizes >= 100) & (np.arange(len(best)) > 0)
    whole = both.sum(axis=0)
    held = ((both >= 0.5 * sizes[:, None]) & (both >= 0.25 * whole))[1:, 1:].any(axis=0)[whole[1:] >= LEAST]
    result = evaluate(labels - 1, dict(enumerate(probability[1:])), world.truth)
    return result | {"reach": held.mean(), "p": probability[large], "right": best[large] > 0.5}


def _mean(model: MergeModel, cases: list[tuple[World, MergeTree]]) -> dict[str, Any]:
    """Means of GOALS; p and right of all segments; expected calibration error in ten bins (Guo et al. 2017)."""
    found = [scores(*case, model) for case in cases]
    p, right = (np.concatenate([row[key] for row in found]) for key in ("p", "right"))
    error = np.abs(np.bincount(np.minimum((p * 10).astype(int), 9), p - right)).sum() / len(p)
    return {k: float(np.mean([row[k] for row in found])) for k in map(str.lower, GOALS)} | {
        "p": p, "right": right, "ece": error}  # fmt: skip


def tuned(model: MergeModel, worlds: list[World]) -> MergeModel:
    """The cost with the best mean of GOALS, and the calibration of the segments found with it."""
    from scipy.optimize import minimize

    cases = [(world, tree_by(model, world.graph)) for world in worlds]
    runs = {cost: _mean(replace(model, cost=cost), cases) for cost in COSTS}
    cost = max(COSTS, key=lambda c: sum(runs[c][goal.lower()] for goal in GOALS))
    p, sign = runs[cost]["p"].clip(1e-6, 1 - 1e-6), np.where(runs[cost]["right"], -1, 1)
    odds = np.log(p / (1 - p))
    found = minimize(lambda ab: np.logaddexp(0, sign * (ab[0] * odds + ab[1])).mean(), [1.0, 0.0])
    return replace(model, cost=cost, calibration=tuple(found.x.tolist()))


def report(model: MergeModel, groups: dict[str, list[World]]) -> str:
    """One row for each group of worlds."""
    rows = []
    for name, worlds in groups.items():
        cases = [(world, tree_by(model, world.graph)) for world in worlds]
        rows.append({"worlds": f"{name} ({len(worlds)})", **_mean(model, cases)})
    return table(rows, COLUMNS, ("worlds",))


def spread(model: MergeModel, worlds: list[World]) -> str:
    """Mean and standard deviation of the figures of readings of one scene."""
    found = [scores(world, tree_by(model, world.graph), model) for world in worlds]
    rows = {goal: [row[goal.lower()] for row in found] for goal in GOALS}
    return ", ".join(f"{goal} {np.mean(row):.3f} ± {np.std(row, ddof=1):.3f}" for goal, row in rows.items())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path, metavar="WORK", help="folder of the worlds")
    parser.add_argument("--worlds", type=int, default=24, metavar="N", help="sets of eight to train on (default 24)")
    parser.add_argument("--scenes", type=Path, nargs="*", default=[], metavar="SCENE", help="more scenes to test on")
    parser.add_argument(
        "--spread", type=int, default=1, metavar="N", help="read them N times, one photo less each time"
    )
    parser.add_argument("--weights", type=Path, metavar="DIR", help="test the weights of DIR and learn nothing")
    parser.add_argument("-o", "--output", type=Path, default=WEIGHTS.parent, metavar="DIR", help="default: the package")
    options = parser.parse_args(arguments)
    options.work.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(os.cpu_count(), initializer=_one_thread) as pool:
        if options.weights is None:
            train(options.work, options.worlds, options.output, pool)
        weights = options.weights or options.output
        model, borders = read_model(weights / WEIGHTS.name), weights / BORDERS.name
        groups: dict[str, list[World]] = {}
        jobs = jobs_of(options.work, KEPT["test"])
        for (folder, stereo), world in zip(jobs, made_worlds(jobs, borders, pool), strict=True):
            scene = folder.name.partition("_")[0]
            kind = scene if scene in ("patchwork", "furnished") else "test"
            groups.setdefault(f"{kind}, {'stereo' if stereo else 'sensor'}", []).append(world)
        groups["all of them"] = list(chain(*groups.values()))
        for scene, stereo in product(options.scenes, (False, True)):
            name = f"{scene.name}, {'stereo' if stereo else 'sensor'}"
            groups[name] = [world_of(read_scene(scene, stereo, side=FOOTPRINTS), borders)]
            if options.spread > 1:
                turns = range(options.spread)
                worlds = [world_of(read_scene(scene, stereo, k, k, FOOTPRINTS), borders) for k in turns]
                print(f"{name}, {options.spread} readings: {spread(model, worlds)}")
    print(report(model, groups))


def train(work: Path, sets: int, output: Path, pool: ProcessPoolExecutor) -> None:
    """Makes the weights from that many sets, and tunes them on those of validation."""
    numbers = [k for k in range(2 * sets) if k % 10 < 8][:sets]
    jobs, borders = jobs_of(work, numbers), work / BORDERS.name
    if not borders.is_file():
        inputs, targets = zip(*pool.map(border_samples, *zip(*jobs, strict=True)), strict=True)
        layers = boundaries.train(np.concatenate(inputs), np.concatenate(targets), seed=0)
        aside = work / f"part_{BORDERS.name}"
        np.savez_compressed(aside, *(part.numpy().astype(np.float16) for layer in layers for part in layer))
        aside.replace(borders)
    worlds, kept = (made_worlds(some, borders, pool) for some in (jobs, jobs_of(work, KEPT["validation"])))
    model = tuned(learn(worlds, each=pool.map), kept)
    settings = np.array([model.cost, *model.calibration])
    np.savez_compressed(output / WEIGHTS.name, settings, *model.pair.parts, *model.region.parts)
    shutil.copyfile(borders, output / BORDERS.name)


def jobs_of(work: Path, sets: Iterable[int], kept: Sequence[tuple[str, int, int]] = SCENES) -> list[tuple[Path, bool]]:
    """Folder of each world of the sets, read as by a sensor and by stereo."""
    kinds = [(f"{scene}_{first + step * k}", stereo) for k in sets for scene, first, step in kept for stereo in (0, 1)]
    return [(work / name, bool(stereo)) for name, stereo in kinds]


def made_worlds(jobs: list[tuple[Path, bool]], borders: Path, pool: ProcessPoolExecutor) -> list[World]:
    return list(pool.map(make_world, *zip(*jobs, strict=True), repeat(borders), chunksize=2))


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


if __name__ == "__main__":
    main()
