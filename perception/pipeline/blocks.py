"""Large scenes: cut into overlapping blocks by what the cameras see, optimised block by block, joined to one model.

A block owns a box of space; the boxes tile the space. It is trained on all photos that see enough of its box or were
taken in it, from nothing but these, so it comes out the same wherever it runs. The joined model takes from each block
the Gaussians in its box. Instances are found afterwards, from the masks of all photos, so a thing on a seam is one
instance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.device import choose_device
from perception.gaussians.model import Gaussians, Nearby
from perception.gaussians.state import TrainRecord, sized
from perception.gaussians.stereo import visible_points
from perception.gaussians.views import surface_depth
from perception.geometry import camera_centres, nearest, rotations
from perception.machine import blas_on_one_thread, memory_limit
from perception.map.replace import writing
from perception.masks import MaskSource, make_source
from perception.pipeline.checkpoint import BEFORE_MASKS, CHECKPOINT, digest, load_checkpoint, save_checkpoint
from perception.pipeline.estimate import largest_budget
from perception.pipeline.optimise import Optimised, Photos, Run, label_photos, optimise
from perception.progress import QUIET, Progress
from perception.tasks.folder import has_task, read_facts, read_task, renew_task
from perception.types import Scene, View

SAMPLE = 20_000  # sparse points by which the scene is cut
SEEN = 0.15  # least share of a photo's points in a block's box for which the block is trained on a photo from outside
LEAST_GAIN = 0.85  # largest share of a block's photos in either half: a scene that all photos see is not cut
APART = 4.0  # distance between the features of two blocks, which are not comparable: more than the loss's margin of 1
ONES = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.uint8)
"""Number of bits of a byte that are 1."""
RESULT = "result.pt"


@dataclass(frozen=True)
class Block:
    """low, high: [3] corners of the box of space it owns, infinite at the outside; views [n] indices of its photos."""

    low: np.ndarray
    high: np.ndarray
    views: np.ndarray

    def owns(self, points: np.ndarray) -> np.ndarray:
        """[P] bool of points [P, 3]."""
        return np.asarray(((points >= self.low) & (points < self.high)).all(axis=1))

    def adds(self, gaussians: Gaussians, centres: np.ndarray) -> np.ndarray:
        """[N] bool: of the Gaussians that were trained on photos from centres [C, 3], those whose mean the block owns.
        Not one that leaves the box and is longer (standard deviation) than its distance to the nearest camera: it has
        no place that a linear projection could draw, and only this block's photos saw to it that it hides nothing."""
        means = gaussians.means.numpy()
        adds = self.owns(means)
        length, longest = (each.numpy() for each in gaussians.scales.max(dim=1))
        rows = np.flatnonzero(adds)
        long = rows[length[rows] > nearest(cKDTree(centres), means[rows], [1])[0][:, 0]]
        half = length[long, None] * rotations(gaussians.quats.numpy()[long])[np.arange(len(long)), :, longest[long]]
        adds[long] = self.owns(means[long] - half) & self.owns(means[long] + half)
        return adds


def cut(scene: Scene, most: int) -> list[Block]:
    """Blocks of at most about `most` photos each, together all photos; one block where that is enough, with most = 0,
    and where what the cameras see cannot be divided.

    A block is halved at the plane, of those at several quantiles of its points along each axis, for which the larger
    half has the fewest photos, if that is at most LEAST_GAIN of the block's.
    """
    count = len(scene.views)
    everything = Block(np.full(3, -np.inf), np.full(3, np.inf), np.arange(count))
    if most == 0 or count <= most or len(scene.points) == 0 or scene.report.get("points_from") == "random":
        return [everything]
    points = _sample(scene.points)
    seen = np.stack([np.packbits(visible_points(view, points)) for view in scene.views])
    centres = camera_centres(np.stack([view.camera_from_world for view in scene.views]))
    return _halved(everything, points, seen, centres, most)


def _sample(points: np.ndarray) -> np.ndarray:
    return points[:: -(-len(points) // SAMPLE)]


def _halved(block: Block, points: np.ndarray, seen: np.ndarray, centres: np.ndarray, most: int) -> list[Block]:
    """seen [V, P / 8] uint8: a bit for each photo and point, 1 where the photo sees the point."""
    if len(block.views) <= most:
        return [block]
    own = seen[block.views]
    inside = points[block.owns(points) & np.unpackbits(np.bitwise_or.reduce(own), count=len(points)).astype(bool)]
    counts = np.maximum(ONES[own].sum(axis=1), 1)

    def share(half: Block) -> np.ndarray:
        return np.asarray(ONES[own & np.packbits(half.owns(points))].sum(axis=1) / counts)

    best, fewest = None, (np.inf, np.inf)
    for axis in range(3) if len(inside) else ():
        for plane in np.quantile(inside[:, axis], np.arange(0.2, 0.81, 0.1)):
            halves = _divided(block, axis, float(plane), share, centres)
            sizes = [len(half.views) for half in halves]
            if min(sizes) > 0 and max(sizes) <= LEAST_GAIN * len(block.views) and (max(sizes), sum(sizes)) < fewest:
                best, fewest = halves, (max(sizes), sum(sizes))
    if best is None:
        return [block]
    return [part for half in best for part in _halved(half, points, seen, centres, most)]


def _divided(
    block: Block, axis: int, plane: float, share: Callable[[Block], np.ndarray], centres: np.ndarray
) -> list[Block]:
    """The block's halves below and above `plane` on `axis`, with the photos that see enough of them or were taken in
    them: these look through the space before them, where Gaussians would float that no other photo sees. share: of the
    points that each of the block's photos sees, those in a box."""
    corner = np.where(np.arange(3) == axis, plane, np.nan)
    below = centres[block.views, axis] < plane
    lower = replace(block, high=np.fmin(block.high, corner))
    upper = replace(block, low=np.fmax(block.low, corner))
    return [
        replace(half, views=block.views[(share(half) >= SEEN) | inside])
        for half, inside in ((lower, below), (upper, ~below))
    ]


def optimise_blocks(
    blocks: list[Block], run: Run, scene: Scene, training: list[View], held_out: list[View], source: MaskSource
) -> Optimised:
    """Trains all blocks, joins their Gaussians, and labels all photos.

    Each block is a task of the engine, in its own folder below `run.work`. A task that is finished is not run again,
    unless the masks or the time limit are others now. A block makes masks of its own where they need depth; others are
    made once per photo.
    """
    held = {view.name for view in held_out}
    total = sum(len(block.views) for block in blocks)
    configs = [run.config.part(len(block.views) / total) for block in blocks]
    each = zip(blocks, configs, strict=True)
    folders = [_task(run, scene, block, config, held, source) for block, config in each]
    with run.stage("train"):
        run.engine.run(optimise_block, [str(folder.resolve()) for folder in folders], "block", run.progress)
    parts, records, reports = [], [], []
    for folder, block in zip(folders, blocks, strict=True):
        state = load_checkpoint(folder / RESULT, folder.name)
        if state is None:
            raise InputError(f"{folder}: has no {RESULT} after its task; workers must share the output's folder")
        gaussians, record = Gaussians(**state["gaussians"]), TrainRecord(**state["record"])
        centres = camera_centres(np.stack([scene.views[i].camera_from_world for i in block.views]))
        own = torch.from_numpy(np.flatnonzero(block.adds(gaussians, centres)))
        parts.append(gaussians.rows(own))
        records.append(record)
        box = [[float(x) if np.isfinite(x) else None for x in corner] for corner in (block.low, block.high)]
        counts = {"photos": len(block.views), "gaussians": len(own), "trained": len(gaussians)}
        reports.append({**counts, "iterations": record.iterations, "box": box})
    rows = nearby_rows(scene, blocks, [len(part) for part in parts])
    nearby = Nearby(joined(parts).to(run.device), rows)
    photos = Photos.load(run, training, held_out)
    photos, masks = label_photos(run, photos, source, lambda view: surface_depth(nearby.of(view.name)[0], view))
    return Optimised(nearby, photos, TrainRecord.joined(records), masks, reports)


def nearby_rows(scene: Scene, blocks: Sequence[Block], counts: Sequence[int]) -> dict[str, list[np.ndarray]]:
    """By photo, the rows of the joined Gaussians of each block that it was used for or of which it sees a point: arrays
    that all photos share. counts: Gaussians of each block, in order."""
    of_block = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
    points = _sample(scene.points)
    owned = np.stack([block.owns(points) for block in blocks])
    holds = np.stack([owned[:, visible_points(view, points)].any(axis=1) for view in scene.views])
    for number, block in enumerate(blocks):
        holds[block.views, number] = True
    sets: dict[bytes, list[np.ndarray]] = {}
    return {
        view.name: sets.setdefault(held.tobytes(), [of_block[number] for number in held.nonzero()[0]])
        for view, held in zip(scene.views, holds, strict=True)
    }


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of the blocks. Features of different blocks are APART, as they are not comparable."""
    count = max(part.sh.shape[1] for part in parts)
    padded = []
    for number, part in enumerate(parts):
        features = part.features.clone()
        features[:, 0] += APART * number
        padded.append(replace(part, features=features).with_coefficients(count))
    return Gaussians.concatenate(padded)


def _task(run: Run, scene: Scene, block: Block, config: MapConfig, held: set[str], source: MaskSource) -> Path:
    """Writes the task of a block: the part of the scene that it is trained on, unless it is there, and the settings of
    this run, in sizes of the first one. Returns its folder."""
    views = [scene.views[i] for i in block.views]
    names = [view.name for view in views]
    box = [block.low.tolist(), block.high.tolist()]
    folder, part = run.work / f"block-{digest(run.mark, names, box)}", None
    if has_task(folder):
        began = read_facts(folder)["config"]["train"]
        sizes = {name: began[name] for name in ("iterations", "budget")}
        config = config.model_copy(update={"train": config.train.model_copy(update=sizes)})
    else:
        config = sized(config, len(set(names) - held), largest_budget(memory_limit()))  # the driver's memory
        seen = np.zeros(len(scene.points), bool)
        for view in views:
            seen |= visible_points(view, scene.points)
        part = replace(scene, views=views, points=scene.points[seen], point_colors=scene.point_colors[seen])
    renew_task(
        folder,
        part,
        source=str(run.source.resolve()),
        config=config.to_json(),
        held_out=sorted(held & set(names)),
        box=box,
        masks=str((folder / "masks" if source.needs_depth else run.masks).resolve()),
        trained_by={"masks": source.identity, "time_limit": config.train.time_limit},
    )
    return folder


@blas_on_one_thread()
def optimise_block(folder: str, progress: Progress = QUIET) -> None:
    """Trains the block whose task lies in `folder`, and writes RESULT there. Goes on from its checkpoint, if any."""
    work = Path(folder)
    by = read_facts(work)["trained_by"]
    made = load_checkpoint(work / RESULT, work.name)
    was = by if made is None else made.get("by", by)
    can_go_on = (work / CHECKPOINT).exists() and was["time_limit"] != by["time_limit"]
    if made is not None and was["masks"] == by["masks"] and not can_go_on:
        return
    scene, facts = read_task(work)
    config = MapConfig.model_validate(facts["config"])
    with writing(work / RESULT):
        device = choose_device(config.device)[0]
        run = Run(Path(facts["source"]), config, work, Path(facts["masks"]), device, progress)
        held = set(facts["held_out"])
        training = [view for view in scene.views if view.name not in held]
        held_out = [view for view in scene.views if view.name in held]
        source, box = make_source(config.masks, config.sam), np.array(facts["box"])
        optimised = optimise(run, scene, training, held_out, source, box)
        gaussians = optimised.nearby.gaussians.to("cpu")
        state = {name: tensor.contiguous() for name, tensor in gaussians.named().items()}
        result = {"gaussians": state, "record": asdict(optimised.record), "by": by}
        save_checkpoint(work / RESULT, result, work.name)
        if by["time_limit"] is None:  # else more time may be given
            for name in (CHECKPOINT, BEFORE_MASKS):
                (work / name).unlink(missing_ok=True)
