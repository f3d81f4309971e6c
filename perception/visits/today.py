"""What stands where today: the map's instances judged, new ones added, and those that moved recognised."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from perception.gaussians.model import Gaussians, Nearby, as_gaussians
from perception.gaussians.state import TrainRecord
from perception.instances.group import Grouping
from perception.instances.votes import mask_votes
from perception.map.history import is_removed
from perception.visits.colours import LOOKS, in_grey, looks_alike
from perception.visits.evidence import Signs, in_free_space, looked_at, seen_rows, signs_of
from perception.visits.growth import (
    GROWING,
    SETTLING,
    SPARE,
    grouped,
    joined_instances,
    new_surface,
    trained,
    update_config,
)
from perception.visits.look import Look
from perception.visits.motion import (
    ALIKE,
    CERTAIN,
    CLOSE,
    HOPELESS,
    TWINS,
    Motion,
    assigned,
    motions_of,
    settled,
)
from perception.visits.registration import REACH, Points, carried
from perception.visits.visit import Visit, gaussians_of

UP = (0.0, 0.0, 1.0)
"""Of a map that does not record gravity."""
GONE = -0.5
"""Log-odds of standing where it stood, times the score, below which a thing does not. Of 126 things of made scenes that
went one lies between this and 0, but floors and walls of which little was measured do, and what is hardly a thing."""
BUILDING = 0.6
"""Of what a visit may see, the share from which a thing is a wall or a floor: it stays, and only what of its Gaussians
the photos see through goes."""
INSTEAD = 0.3
"""Share of a new thing's pixels where the old map showed things that are gone, from which it was not there before."""
FRAGMENT = 0.3, 3
"""A new group of a score below, and of less than this many times the least Gaussians of a group, is a piece of what
stands beside it, no thing; most things score .8 and more."""

ALONG = 0.75, 0.25
"""Share of the Gaussians of a piece that lie within this many radii of the thing that it is of."""
PHOTOS, GREW = 2, 1.0
"""Least photos of a new thing, and log-odds that they show it as it grew: of 47 in made scenes true ones have 2 and
more, errors at walls and in the air up to .6."""
LEAST_SCORE = 0.5
"""Of a new thing. Of 21 in ten made scenes none has less than .55; two of three in real scenes where nothing changed
have .33 and .37."""
OUTLINED = 0.5
"""Least IoU of a new thing with masks of the photos, relative to the median of those that stand where they stood."""


LOOKED_AT = 0.3
"""Share of a new thing's place from which earlier photos looked there: of 24 things that came in made scenes .7 and
more."""

New = Literal["added", "known", "hidden"]
"""Of what the map has no instance: it came, the map showed it and did not know it as a thing, or no photo looked there
before."""


@dataclass
class Today:
    """What stands where today: the Gaussians, of which the first rows are the rows `kept` [H] of the map; ids [N] int32
    instance, `membership` [N], part_ids [N]; signs of the map's instances, in their order; `gone`: ids of those that do
    not stand where they stood; motions by id; `added`: of the new ones, by id, the score and how it is new."""

    gaussians: Gaussians
    kept: np.ndarray
    ids: np.ndarray
    membership: np.ndarray
    part_ids: np.ndarray
    signs: list[Signs]
    gone: list[int]
    motions: dict[int, Motion]
    added: dict[int, tuple[float, New]]
    record: TrainRecord


def seen_today(visit: Visit) -> Today:
    """Judges the map's instances, adds what is new, and finds out what moved."""
    run, progress = visit.run, visit.run.progress
    with run.stage("evidence"):
        before = visit.looks(visit.gaussians, visit.ids)
        signs = _signs(visit, before)
    gone, haze = _gone(visit, before, signs)
    stays = np.flatnonzero(~np.isin(visit.ids, gone) & ~haze)
    held, ids, kept = visit.gaussians.rows(torch.from_numpy(stays)), visit.ids[stays], visit.rows[stays]
    with run.stage("look"):
        looks = visit.looks(held, ids)
    new = new_surface(looks, held, run.config.train.budget or len(visit.gaussians), run.config.seed)
    progress.log(f"{len(gone)} things do not stand where they stood; {len(new)} points of new surface")
    config = update_config(run.config, len(visit.photos.views), GROWING, len(held) + SPARE * len(new))
    grown, record = held, TrainRecord()
    if len(new):
        both, mark = Gaussians.concatenate([held, new]), visit.masks["identity"]
        memory = visit.rehearsed(held, Gaussians.concatenate([visit.part(np.isin(visit.ids, gone)), new]))
        grown, record = trained(run, "grow", visit.mark, mark, both, len(held), visit.photos, memory, config)

    with run.stage("instances"):
        rows = np.arange(len(held), len(grown))
        votes = mask_votes(Nearby(grown), visit.photos.views, half_resolution=run.config.losses.half_resolution)
        ids = np.concatenate([ids, np.full(len(rows), -1, np.int32)])
        known, number = np.unique(ids[ids >= 0], return_inverse=True)
        dense = np.full(len(ids), -1, np.int32)
        dense[ids >= 0] = number
        joined = joined_instances(votes, dense, rows)
        ids[rows] = np.append(known, -1)[joined]
        free = rows[joined < 0]
        made = _without_fragments(grouped(grown, votes, free, run.config), run.config.instances.min_cluster_size)
    things = [(free[made.ids == n], float(made.scores[n])) for n in range(made.count) if (made.ids == n).any()]
    with run.stage("evidence"):
        old, ground = _shown_before(visit, before, signs, grown, things, gone)
        made = replace(made, ids=np.where(np.isin(free, _rows(things, ground)), -1, made.ids))
        stands = [j for j in range(len(things)) if j not in ground]
        things, old = [things[j] for j in stands], {n for n, j in enumerate(stands) if j in old}
    with run.stage("motion"):
        pairs = _moved(visit, grown, things, gone)
    whole = {j: carried(visit.thing(i), motion.new_from_old) for i, (j, motion) in pairs.items()}
    things = _apart(things, grown.means.double().numpy(), whole, run.config.instances.min_cluster_size)
    with run.stage("motion"):
        pieces = _pieces(visit, grown, things, whole)
    pairs = {i: (j, motion) for i, (j, motion) in pairs.items() if j not in pieces}
    return _settled(visit, grown, kept, ids, made, free, signs, gone, things, old, pairs, pieces, record)


def _rows(things: list[tuple[np.ndarray, float]], numbers: set[int]) -> np.ndarray:
    """The rows of the things with these numbers."""
    return np.concatenate([np.zeros(0, np.int64), *(things[j][0] for j in sorted(numbers))])


def _without_fragments(made: Grouping, least: int) -> Grouping:
    """The grouping without what is small and in hardly any mask. least: Gaussians of a group."""
    sizes = np.bincount(made.ids[made.ids >= 0], minlength=made.count)
    fragments = np.flatnonzero((np.asarray(made.scores) < FRAGMENT[0]) & (sizes < FRAGMENT[1] * least))
    return replace(made, ids=np.where(np.isin(made.ids, fragments), -1, made.ids))


def _signs(visit: Visit, looks: list[Look]) -> list[Signs]:
    gmap, entries = visit.gmap, visit.gmap.instances
    seen = seen_rows(looks, visit.gaussians.means.double().numpy(), visit.gaussians.scales.max(dim=1).values.numpy())
    ids = [entry["id"] for entry in entries]
    shares = np.array([np.sum(seen & (visit.ids == i)) / max(1, np.sum(gmap.instance_ids == i)) for i in ids])
    signs = signs_of(looks, ids, shares, np.array([min(entry["obb"]["extent"]) for entry in entries]))
    return [replace(each, score=float(entry["score"])) for each, entry in zip(signs, entries, strict=True)]


def _gone(visit: Visit, looks: list[Look], signs: list[Signs]) -> tuple[list[int], np.ndarray]:
    """Ids of the instances that do not stand where they stood; [R] bool: what the photos see through of walls and
    floors, which stay unless all of one is seen through. signs: of the map's instances."""
    gmap, means = visit.gmap, visit.gaussians.means.double().numpy()
    judged = [(e, s) for e, s in zip(gmap.instances, signs, strict=True) if s.seen and not is_removed(e)]
    gone = [entry for entry, s in judged if s.score * s.log_odds < GONE]
    span = np.ptp(np.quantile(means, [0.02, 0.98], axis=0), axis=0).max() if len(means) else 0.0
    large = [entry["id"] for entry in gone if max(entry["obb"]["extent"]) > BUILDING * span]
    haze = np.isin(visit.ids, large) & in_free_space(looks, means)
    stays = [i for i in large if np.sum(gmap.instance_ids == i) > np.sum(haze & (visit.ids == i))]
    return [entry["id"] for entry in gone if entry["id"] not in stays], haze


def _shown_before(
    visit: Visit,
    before: list[Look],
    known: list[Signs],
    grown: Gaussians,
    things: list[tuple[np.ndarray, float]],
    gone: list[int],
) -> tuple[set[int], set[int]]:
    """Numbers of the things that the old map shows as the photos do, `before`: it only did not know them as things.
    A thing in front of one that is `gone`, or in its place, is none of these. Numbers of those that no two photos show
    as they grew, or that have the outline of no mask: they are ground that was hidden until now, or errors. known:
    signs of the map's instances."""
    ids = np.full(len(grown), -1, np.int32)
    for j, (rows, _) in enumerate(things):
        ids[rows] = j
    after = visit.looks(grown, ids)
    looks = [replace(old, ids=new.ids) for old, new in zip(before, after, strict=True)]
    pixels, instead = np.zeros(len(things)), np.zeros(len(things))
    for old, new in zip(before, looks, strict=True):
        for mask, count in ((new.ids >= 0, pixels), ((new.ids >= 0) & np.isin(old.ids, gone), instead)):
            count += np.bincount(new.ids[mask], minlength=len(things))
    numbers, shares = range(len(things)), np.ones(len(things))
    signs = signs_of(looks, numbers, shares, shares * np.inf)  # what is in front of the old surface counts, too
    grew = signs_of(after, numbers, shares, shares * 0)
    fresh = instead > INSTEAD * pixels
    stood = {j for j, each in enumerate(signs) if each.photos and each.alike > 0 and not fresh[j]}
    usual = [each.outline for each in known if each.log_odds > 0 and np.isfinite(each.outline)]
    least = OUTLINED * float(np.median(usual or 1.0))
    true = [
        new.photos >= PHOTOS and new.alike >= GREW and not old.outline < least
        for old, new in zip(signs, grew, strict=True)
    ]
    return stood, {j for j, each in enumerate(true) if not each}


def _moved(
    visit: Visit, grown: Gaussians, things: list[tuple[np.ndarray, float]], gone: list[int]
) -> dict[int, tuple[int, Motion]]:
    """By id of an instance that is gone, or was already at an earlier visit: the number of the new thing that it is,
    and its motion."""
    lost = [*gone, *visit.away]
    if not lost or not things:
        return {}
    olds = {i: visit.thing(i) for i in lost}
    depth = {entry["id"]: min(entry["obb"]["extent"]) for entry in visit.gmap.instances}
    gravity = visit.gmap.info.get("gravity")
    up = np.array(UP) if gravity is None else -np.array(gravity["direction"], np.float64)
    frames, seen = visit.frames, {i: visit.seen_from(i) for i in lost}
    odds, motions = np.full((len(lost), len(things)), -np.inf), dict[tuple[int, int], Motion]()
    for j, (own, _) in enumerate(things):
        new = grown.rows(torch.from_numpy(own))
        rest = grown.rows(torch.from_numpy(np.setdiff1d(np.arange(len(grown)), own)))
        alike = [looks_alike(olds[i], new) for i in lost]
        falling = np.argsort(alike, kind="stable")[::-1].tolist()
        kinds = ([a for a in falling if (lost[a] in visit.away) is away] for away in (False, True))
        likely = sorted((a for kind in kinds for a in kind[:ALIKE]), key=falling.index)
        for a in likely:
            if odds[:, j].max() > CERTAIN and alike[a] < alike[likely[0]] - TWINS:
                break
            found, cuts = motions_of(olds[lost[a]], new, frames, rest, up, depth[lost[a]])
            if not found or found[0][0].same + LOOKS[0] * (alike[a] - LOOKS[1]) < HOPELESS:
                continue
            motion = settled(olds[lost[a]], found, cuts, up, depth[lost[a]], alike[a], seen[lost[a]])
            if motion is not None:
                odds[a, j], motions[a, j] = motion.odds, motion
        visit.run.progress.update("motions", j + 1, len(things))
    pairs = {}
    for a, j in assigned(odds):
        rivals = np.concatenate([np.delete(odds[:, j], a), np.delete(odds[a], j)])
        unsure = rivals.max(initial=-np.inf) > odds[a, j] - CLOSE
        pairs[lost[a]] = (j, replace(motions[a, j], ambiguous=motions[a, j].ambiguous or bool(unsure)))
    return pairs


def _apart(
    things: list[tuple[np.ndarray, float]], means: np.ndarray, whole: dict[int, Gaussians], least: int
) -> list[tuple[np.ndarray, float]]:
    """The things; of those that are moved ones, as these stand now (`whole`, by number), what is out of their reach is
    a thing of its own, as masks may join two. means [N, 3] of all Gaussians; least: of a thing."""
    result = list(things)
    for j, gaussians in whole.items():
        (rows, score), points = things[j], Points.of(gaussians)
        far = np.linalg.norm(means[rows] - np.median(points.points, axis=0), axis=1) > REACH * points.radius
        if far.sum() >= least:
            result[j] = rows[~far], score
            result.append((rows[far], score))
    return result


def _pieces(
    visit: Visit, grown: Gaussians, things: list[tuple[np.ndarray, float]], whole: dict[int, Gaussians]
) -> set[int]:
    """Numbers of the things that are pieces of another that moved, as masks may cut the legs off a chair: they lie
    along it as it stands now (`whole`, by number), and the photos show as well without them what they show."""
    from scipy.spatial import cKDTree

    means, stays = grown.means.double().numpy(), np.setdiff1d(np.arange(len(grown)), _rows(things, set(whole)))
    found = set[int]()
    for j, (rows, _) in enumerate(things):
        others = [thing for k, thing in whole.items() if k != j and k not in found]
        reach = [(cKDTree(p.points).query(means[rows])[0], p.radius) for p in map(Points.of, others)]
        if all(np.quantile(away, ALONG[0]) > ALONG[1] * radius for away, radius in reach):
            continue
        ids = np.full(len(grown), -1, np.int32)
        ids[rows] = j
        shown = visit.looks(grown, ids)
        without = Gaussians.concatenate([grown.rows(torch.from_numpy(np.setdiff1d(stays, rows))), *others])
        looks = visit.looks(without, np.full(len(without), -1, np.int32))
        looks = [replace(look, ids=with_it.ids) for look, with_it in zip(looks, shown, strict=True)]
        (signs,) = signs_of(looks, [j], np.ones(1), np.full(1, np.inf))
        if signs.photos and signs.alike > 0:
            found.add(j)
    return found


def _settled(
    visit: Visit,
    grown: Gaussians,
    kept: np.ndarray,
    ids: np.ndarray,
    made: Grouping,
    free: np.ndarray,
    signs: list[Signs],
    gone: list[int],
    things: list[tuple[np.ndarray, float]],
    old: set[int],
    pairs: dict[int, tuple[int, Motion]],
    pieces: set[int],
    record: TrainRecord,
) -> Today:
    """Puts the Gaussians of moved things where the new ones grew, leaves out `pieces` of them and new surface through
    which earlier photos saw, unless it is of a thing, and trains the colours of all that was looked at."""
    gmap, run = visit.gmap, visit.run
    membership = np.concatenate([gmap.membership[kept], np.ones(len(grown) - len(kept), np.float32)])
    membership[free] = np.where(made.ids >= 0, made.membership, 0)
    parts = gmap.parts["ids"] if "ids" in gmap.parts else np.full(len(gmap), -1, np.int32)
    part_ids = np.concatenate([parts[kept], np.full(len(grown) - len(kept), -1, np.int32)])
    taken = {j for j, _ in pairs.values()} | pieces
    following, added = gmap.next_id, dict[int, tuple[float, New]]()
    fresh = np.arange(len(kept), len(grown))
    looked, through = looked_at(as_gaussians(gmap), gmap.views, grown.means[fresh].double().numpy())
    for j, (rows, score) in enumerate(things):
        if j not in taken and score >= LEAST_SCORE:
            hidden = bool(gmap.views) and looked[rows - len(kept)].mean() < LOOKED_AT
            ids[rows], added[following] = following, (score, "known" if j in old else "hidden" if hidden else "added")
            following += 1
    own = np.isin(fresh, _rows(things, set(range(len(things)))))  # other new surface stands where nothing did: an error
    stays = np.setdiff1d(np.arange(len(grown)), np.append(_rows(things, taken), fresh[through & ~own]))
    came = [np.isin(stays, fresh[own])]
    placed, names, members, owned = (
        [grown.rows(torch.from_numpy(stays))],
        [ids[stays]],
        [membership[stays]],
        [part_ids[stays]],
    )
    hues = [visit.hues(gaussians_of(gmap, kept)), torch.zeros(len(stays) - len(kept), 3)]
    for i, (_, motion) in pairs.items():
        own = visit.rows_of(i)
        hues.append(visit.hues(visit.own(i)))
        placed.append(carried(visit.thing(i), motion.new_from_old))
        names.append(np.full(len(placed[-1]), i, np.int32))
        came.append(np.ones(len(placed[-1]), bool))
        back = i in visit.away  # without rows in the map
        members.append(np.ones(len(names[-1]), np.float32) if back else gmap.membership[own])
        owned.append(np.full(len(names[-1]), -1, np.int32) if back else parts[own])
    together = Gaussians.concatenate(placed)
    config = update_config(run.config, len(visit.photos.views), SETTLING, len(together), alone=not record.iterations)
    start = together.sh.clone()
    new = together.rows(torch.from_numpy(np.flatnonzero(np.concatenate(came))))
    others = Gaussians.concatenate([visit.part(np.isin(visit.ids, gone)), new])
    memory = visit.rehearsed(visit.part(np.isin(visit.rows, kept)), others)
    final, last = trained(
        run, "settle", visit.mark, visit.masks["identity"], together, len(together), visit.photos, memory, config
    )
    unseen = (final.sh[: len(kept)] == start[: len(kept)]).flatten(1).all(dim=1)
    final = in_grey(final) if visit.grey else final
    final.sh[:, 0] += torch.cat(hues)
    original = torch.from_numpy(gmap.sh[kept])
    final.sh[: len(kept)] = torch.where(unseen[:, None, None], original, final.sh[: len(kept)])
    rest = np.setdiff1d(np.flatnonzero(~np.isin(gmap.instance_ids, gone)), visit.rows)  # no photo may show these
    together = Gaussians.concatenate([gaussians_of(gmap, rest), final])
    names, members, owned = [gmap.instance_ids[rest], *names], [gmap.membership[rest], *members], [parts[rest], *owned]
    arrays = (np.concatenate(names).astype(np.int32), np.concatenate(members), np.concatenate(owned).astype(np.int32))
    motions = {i: motion for i, (_, motion) in pairs.items()}
    record = TrainRecord.joined([record, last], "leg")
    return Today(together, np.concatenate([rest, kept]), *arrays, signs, gone, motions, added, record)
