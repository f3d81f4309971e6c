"""Which new thing of a visit is which instance that is gone, or of which it is a part.

Each new thing is compared with those most alike in colour (`motion`). As masks may split a thing, the old one that fits
best is also tried together with those that touched it and are gone, one after the other, as long as that fits better.
What was beside a surely moved one, and which photos show after the same motion, too, moved with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from perception.changes.colours import looks_alike
from perception.changes.motion import ALIKE, CERTAIN, CLOSE, TWINS, Motion, assigned, motion_between, stands_after
from perception.changes.registration import Points, touching
from perception.gaussians.model import Gaussians
from perception.visits.visit import Visit

UP = (0.0, 0.0, 1.0)
"""Of a map that does not record gravity."""
ALONGSIDE = 0.5
"""Radii of the smaller one within which FRINGE of the points lie of two things that may have moved as one: parts of a
teddy bear .2 to .28. Photos tell, as the motion is known: of its parts 2.6 to 3.5, of others -.6 and less."""

Thing = tuple[np.ndarray, float]
"""The rows of new Gaussians that are one thing, and its score."""
Pairs = dict[int, tuple[int, Motion]]
"""By id of an instance that was gone: the number of the thing that it is, or is a part of, and its motion."""
Parts = tuple[int, ...]
"""Numbers of old things that are taken for one."""
Motions = dict[tuple[Parts, int], Motion]
"""By old things and the number of a new one."""
Tried = Callable[[Parts], float]
"""Log-odds of old things, together, being a new one."""


def moved(visit: Visit, grown: Gaussians, things: list[Thing], gone: list[int]) -> Pairs:
    """Which thing is which instance that is `gone`, or was already at an earlier visit. grown: all Gaussians."""
    lost = [*gone, *visit.away]
    if not lost or not things:
        return {}
    olds, seen = [visit.thing(i) for i in lost], [visit.seen_from(i) for i in lost]
    points = [Points.of(old) for old in olds[: len(gone)]]
    near = touching(points)
    depths = {entry["id"]: min(entry["obb"]["extent"]) for entry in visit.gmap.instances}
    gravity = visit.gmap.info.get("gravity")
    up = np.array(UP) if gravity is None else -np.array(gravity["direction"], np.float64)
    motions: Motions = {}

    def compare(j: int) -> None:
        own = things[j][0]
        new = grown.rows(torch.from_numpy(own))
        rest = grown.rows(torch.from_numpy(np.setdiff1d(np.arange(len(grown)), own)))
        alike = np.array([looks_alike(old, new) for old in olds])

        def tried(parts: Parts) -> float:
            old = olds[parts[0]] if len(parts) == 1 else Gaussians.concatenate([olds[a] for a in parts])
            depth, views = max(depths[lost[a]] for a in parts), np.concatenate([seen[a] for a in parts])
            motion = motion_between(old, new, visit.frames, rest, up, depth, looks_alike(old, new), views)
            if motion is not None:
                motions[parts, j] = motion
            return -np.inf if motion is None else motion.odds

        whole(*likeliest_of(alike, len(gone), tried), near, tried)

    for j in range(len(things)):
        compare(j)
        visit.run.progress.update("motions", j + 1, len(things))
    pairs = _paired(lost, motions, len(things))
    stays = np.setdiff1d(np.arange(len(grown)), np.concatenate([rows for rows, _ in things]))
    scene, beside = grown.rows(torch.from_numpy(stays)), touching(points, ALONGSIDE)

    def stands(a: int, pose: np.ndarray) -> float:
        return stands_after(olds[a], pose, visit.frames, scene, depths[gone[a]])

    return pairs | along(gone, pairs, beside, stands)


def along(gone: list[int], pairs: Pairs, near: np.ndarray, stands: Callable[[int, np.ndarray], float]) -> Pairs:
    """Pairs of instances that moved together with a neighbour whose motion is surer: masks may cut a chair in pieces.

    gone: G instances that left. pairs: those of them that are known to have moved. near: [G, G] bool, which were
    neighbours. stands: log-odds that photos show the a-th of `gone` after a motion [4, 4]."""
    found: Pairs = {}
    for a, i in enumerate(gone):
        own, least = pairs[i] if i in pairs else (None, Motion(np.eye(4), -np.inf))
        beside = [pairs[k] for b, k in enumerate(gone) if near[a, b] and k in pairs and pairs[k][1].odds > least.odds]
        tried = [(stands(a, motion.new_from_old), j, motion) for j, motion in beside]
        odds, j, motion = max(tried, key=lambda each: each[0], default=(0.0, 0, least))
        if odds > 0:
            found[i] = j if own is None else own, replace(motion, odds=min(odds, motion.odds))
    return found


def likeliest_of(alike: np.ndarray, gone: int, tried: Tried) -> tuple[int, float]:
    """The number and the log-odds of the old thing that a new one is most likely, of those most `alike` [O]: of the
    first `gone`, and of those of earlier visits."""
    falling = np.argsort(alike, kind="stable")[::-1].tolist()
    kinds = ([a for a in falling if (a >= gone) is away] for away in (False, True))
    likely = sorted((a for kind in kinds for a in kind[:ALIKE]), key=falling.index)
    best, most = likely[0], -np.inf
    for a in likely:
        if most > CERTAIN and alike[a] < alike[likely[0]] - TWINS:
            break
        if (odds := tried((a,))) > most:
            best, most = a, odds
    return best, most


def whole(part: int, most: float, near: np.ndarray, tried: Tried) -> Parts:
    """The old things that are one with `part`: of those that touched it or each other, near [G, G] bool, the ones that
    raise the log-odds, `most` of the part alone."""
    parts: Parts = (part,)
    seen = {part}
    while beside := [a for a in range(len(near)) if a not in seen and any(near[a, b] for b in parts if b < len(near))]:
        seen.add(beside[0])
        if (odds := tried((*parts, beside[0]))) > most:
            parts, most = (*parts, beside[0]), odds
    return parts


def _paired(lost: list[int], motions: Motions, count: int) -> Pairs:
    """The pairs of the `lost` instances, numbered in `motions`, and of the `count` things: the most likely one of the
    joint assignment (`motion.assigned`), then the same without all that it takes, as instances are in many rows."""
    rows = sorted({parts for parts, _ in motions})
    odds = np.full((len(rows), count), -np.inf)
    for (parts, j), motion in motions.items():
        odds[rows.index(parts), j] = motion.odds
    pairs, left = Pairs(), odds.copy()
    while found := assigned(left):
        n, j = max(found, key=lambda pair: left[pair])
        apart = np.array([set(rows[n]).isdisjoint(parts) for parts in rows])
        left[~apart], left[:, j] = -np.inf, -np.inf
        rivals = np.concatenate([odds[apart, j], np.delete(odds[n], j)])
        motion = motions[rows[n], j]
        motion = replace(motion, ambiguous=motion.ambiguous or bool(rivals.max(initial=-np.inf) > motion.odds - CLOSE))
        pairs |= {lost[a]: (j, motion) for a in rows[n]}
    return {i: pairs[i] for i in lost if i in pairs}
