"""What stands where today, from the photos of a visit beside the map, in this order:

gone       what of the map the photos contradict: instances, and Gaussians of none   `_signs`, `_gone`, `ghosts`
grown      what stays, and new Gaussians where the photos show another surface       `_grown`
things     of the new ones those in no instance's masks, grouped                     `_grouped`, `_true`
pairs      which thing is which gone one, and how it moved (`pairing`); pieces       `_apart`, `_pieces`
added      ids of the things that are left                                           `_added`
settled    moved things with their own Gaussians; colours of all that was looked at  `_settled`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from perception.changes.colours import in_grey
from perception.changes.evidence import AGREE, GONE, Signs, in_free_space, looked_at, seen_rows, signs_of
from perception.changes.look import Look
from perception.changes.motion import Motion
from perception.changes.registration import REACH, Points, carried
from perception.gaussians.model import Gaussians, Nearby
from perception.gaussians.state import TrainRecord
from perception.instances.group import Grouping
from perception.instances.votes import mask_votes
from perception.map.history import is_removed
from perception.map.map import Map
from perception.visits.ghosts import ghosts
from perception.visits.growth import GROWING, SETTLING, grouped, joined_instances, new_surface, trained
from perception.visits.pairing import Pairs, Thing, moved
from perception.visits.rows import told_rows
from perception.visits.visit import Owned, Visit, gaussians_of

BUILDING = 0.6
"""Of what a visit may see, the share from which a thing is a wall or a floor."""
INSTEAD = 0.3
"""Share of a new thing's pixels where the old map showed things that are gone, from which it was not there before."""
FRAGMENT = 0.3, 3
"""A new group of a lower score, and of less than this many times the least Gaussians of a group, is a piece of what
stands beside it; most things score .8 and more."""
ALONG = 0.75, 0.25
"""Share of the Gaussians of a piece that lie within this many radii of the thing that it is of."""
PHOTOS, GREW = 2, 1.0
"""Least photos of a new thing, and log-odds that they show it as it grew: of 47 in made scenes true ones have 2 and
more, errors at walls and in the air up to .6."""
LEAST_SCORE = 0.5
"""Of a new thing: of 21 in ten made scenes none has less than .55; two of three errors in real scenes have less."""
OUTLINED, UNCOVERED = 0.5, 0.75
"""Least IoU of a new thing with masks of the photos, relative to the median of those that stand where they stood; the
same where it stands in place of what is gone and not in front of it, as does ground that this hid: a sofa, a rug
.54 and less, a bottle that took a carton's place 1.03."""
LOOKED_AT = 0.3
"""Share of a new thing's place from which earlier photos looked there: of 24 things that came in made scenes .7 and
more."""

New = Literal["added", "known", "hidden"]
"""Of what the map has no instance: it came, the map showed it and did not know it as a thing, or no photo looked there
before."""


@dataclass
class Today:
    """What stands where today. rest [Q]: rows of the map that stay and no photo shows; owned: all other Gaussians, of
    which the first are the rows `kept` [H] of the map; signs of the map's instances, in their order; `gone`: ids of
    those that do not stand where they stood; motions by id; `added`: of the new ones, by id, the score and how it is
    new."""

    rest: np.ndarray
    owned: Owned
    kept: np.ndarray
    signs: list[Signs]
    gone: list[int]
    motions: dict[int, Motion]
    added: dict[int, tuple[float, New]]
    record: TrainRecord


def seen_today(visit: Visit) -> Today:
    """Judges the map's instances, adds what is new, and finds out what moved."""
    gmap, run = visit.gmap, visit.run
    with run.stage("evidence"):
        before = visit.before
        signs = _signs(visit, before)
        gone, haze = _gone(visit, before, signs)
        leaves = np.isin(gmap.instance_ids, gone)
        leaves[visit.rows[haze]] = True
        ghost = visit.rows[ghosts(visit, before, ~leaves[visit.rows])]
        visit = visit.without(leaves)
    stays = ~leaves[visit.rows]
    grown, record = _grown(visit, stays, gone)
    with run.stage("instances"):
        owned, things = _grouped(visit, grown, visit.rows[stays])
    with run.stage("evidence"):
        things, known, surface = _true(visit, before, signs, grown, things, gone)
    with run.stage("motion"):
        pairs = moved(visit, grown, things, gone)
        stands = [(j, carried(visit.thing(i), motion.new_from_old)) for i, (j, motion) in pairs.items()]
        whole = {j: Gaussians.concatenate([part for k, part in stands if k == j]) for j, _ in stands}
        things = _apart(things, grown.means.double().numpy(), whole, run.config.instances.min_cluster_size)
        pieces = _pieces(visit, grown, things, whole)
        pairs = {i: pair for i, pair in pairs.items() if pair[0] not in pieces}
        taken = {j for j, _ in pairs.values()} | pieces
    start = np.count_nonzero(stays)
    fresh = np.arange(start, len(grown))
    looked, through = looked_at(visit.whole, visit.near, grown.means[fresh].double().numpy())
    added = _added(gmap, things, known, taken, np.append(np.ones(start, bool), looked))
    for i, (j, _) in added.items():
        owned.ids[things[j][0]] = i
    own = np.isin(fresh, _rows(things))
    owned.membership[fresh[~own & (owned.ids[fresh] < 0)]] = 0
    # Other new surface through which earlier photos saw stands where nothing did: an error, unless masks outline it.
    wrong = np.append(_rows([things[j] for j in taken]), fresh[through & ~own & ~np.isin(fresh, surface)])
    kept, rest = visit.rows[stays], np.setdiff1d(np.flatnonzero(~leaves), visit.rows)
    stood = ~np.isin(kept, ghost)  # ghosts go last: what grows beside them tells better what moved
    shift, kept, owned = np.sum(~stood), kept[stood], owned.rows(np.append(np.flatnonzero(stood), fresh))
    final, last = _settled(visit, owned, kept, wrong - shift, fresh[own] - shift, pairs, gone, not record.iterations)
    scores: dict[int, tuple[float, New]] = {i: (things[j][1], new) for i, (j, new) in added.items()}
    motions = {i: motion for i, (_, motion) in pairs.items()}
    return Today(rest, final, kept, signs, gone, motions, scores, TrainRecord.joined([record, last], "leg"))


def _rows(things: Sequence[Thing]) -> np.ndarray:
    """The rows of the things."""
    return np.concatenate([np.zeros(0, np.int64), *(rows for rows, _ in things)])


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


def _grown(visit: Visit, stays: np.ndarray, gone: list[int]) -> tuple[Gaussians, TrainRecord]:
    """The Gaussians that stay, `stays` [R] bool, then new ones on the surface that these do not explain, trained."""
    run, held = visit.run, visit.part(stays)
    with run.stage("look"):
        looks = visit.looks(held, visit.ids[stays])
    new = new_surface(looks, held, run.config.train.budget or len(visit.gaussians), run.config.seed)
    run.progress.log(f"{len(gone)} things do not stand where they stood; {len(new)} points of new surface")
    if not len(new):
        return held, TrainRecord()
    memory = visit.rehearsed(held, Gaussians.concatenate([visit.part(~stays), new]))
    return trained(visit, "grow", GROWING, Gaussians.concatenate([held, new]), len(held), memory)


def _grouped(visit: Visit, grown: Gaussians, kept: np.ndarray) -> tuple[Owned, list[Thing]]:
    """What has grown, of which the first are the rows `kept` [H] of the map. New Gaussians belong to the instances in
    whose masks they lie; the others are grouped to things."""
    config, fresh = visit.run.config, np.arange(len(kept), len(grown))
    none, old = np.full(len(fresh), -1, np.int32), visit.owned(kept)
    votes = mask_votes(Nearby(grown), visit.photos.views, half_resolution=config.losses.half_resolution)
    joined = joined_instances(votes, np.append(old.ids, none), fresh)
    free = fresh[joined < 0]
    made = _without_fragments(grouped(grown, votes, free, config), config.instances.min_cluster_size)
    sure = np.ones(len(fresh), np.float32)
    sure[joined < 0] = made.membership
    pairs = (old.ids, joined), (old.membership, sure), (old.part_ids, none)
    things = ((free[made.ids == n], float(made.scores[n])) for n in range(made.count))
    return Owned(grown, *map(np.concatenate, pairs)), [thing for thing in things if len(thing[0])]


def _without_fragments(made: Grouping, least: int) -> Grouping:
    """The grouping without what is small and in hardly any mask. least: Gaussians of a group."""
    sizes = np.bincount(made.ids[made.ids >= 0], minlength=made.count)
    fragments = np.flatnonzero((np.asarray(made.scores) < FRAGMENT[0]) & (sizes < FRAGMENT[1] * least))
    return replace(made, ids=np.where(np.isin(made.ids, fragments), -1, made.ids))


def _true(
    visit: Visit, before: list[Look], known: list[Signs], grown: Gaussians, things: list[Thing], gone: list[int]
) -> tuple[list[Thing], set[int], np.ndarray]:
    """The things that photos show as they grew, with the outline of a mask: the others are ground that was hidden until
    now, or errors. Then the numbers of those that the old map shows as the photos do, `before`: it only did not know
    them as things. What stands in front of a thing that is `gone`, or in its place, is none of these. Then the rows of
    the others that masks of several photos outline: surface, if too coarse to tell. known: signs of the map's
    instances."""
    after = visit.looks(grown, _numbered(len(grown), things))
    looks = [replace(old, ids=new.ids) for old, new in zip(before, after, strict=True)]
    pixels, instead, within = np.zeros((3, len(things)))
    for old, new in zip(before, after, strict=True):
        own = new.ids >= 0
        behind = (old.mapped > 0) & (new.mapped >= old.mapped * (1 - AGREE))
        for mask, count in ((own, pixels), (own & np.isin(old.ids, gone), instead), (own & behind, within)):
            count += np.bincount(new.ids[mask], minlength=len(things))
    numbers, shares = range(len(things)), np.ones(len(things))
    signs = signs_of(looks, numbers, shares, shares * np.inf)  # what is in front of the old surface counts, too
    grew = signs_of(after, numbers, shares, shares * 0)
    usual = [each.outline for each in known if each.log_odds > 0 and np.isfinite(each.outline)]
    replaces = instead > INSTEAD * pixels
    least = float(np.median(usual or 1.0)) * np.where(replaces & (within > 0.5 * pixels), UNCOVERED, OUTLINED)
    shown = [j for j, new in enumerate(grew) if new.photos >= PHOTOS]
    true = [j for j in shown if grew[j].alike >= GREW and not signs[j].outline < least[j]]
    stood = (signs[j].photos and signs[j].alike > 0 and not replaces[j] for j in true)
    surface = _rows([things[j] for j in shown if j not in true and things[j][1] >= LEAST_SCORE])
    return [things[j] for j in true], {n for n, each in enumerate(stood) if each}, surface


def _numbered(count: int, things: Sequence[Thing]) -> np.ndarray:
    """[N] int32 number of the thing that each of `count` Gaussians belongs to, −1 = none."""
    ids = np.full(count, -1, np.int32)
    for j, (rows, _) in enumerate(things):
        ids[rows] = j
    return ids


def _apart(things: list[Thing], means: np.ndarray, whole: dict[int, Gaussians], least: int) -> list[Thing]:
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


def _pieces(visit: Visit, grown: Gaussians, things: list[Thing], whole: dict[int, Gaussians]) -> set[int]:
    """Numbers of the things that are pieces of another that moved, as masks may cut the legs off a chair: they lie
    along it as it stands now (`whole`, by number), and the photos show as well without them what they show."""
    from scipy.spatial import cKDTree

    means, found = grown.means.double().numpy(), set[int]()
    stays = np.setdiff1d(np.arange(len(grown)), _rows([things[j] for j in whole]))
    for j, (rows, _) in enumerate(things):
        others = [thing for k, thing in whole.items() if k != j and k not in found]
        reach = [(cKDTree(p.points).query(means[rows])[0], p.radius) for p in map(Points.of, others)]
        if not len(rows) or all(np.quantile(away, ALONG[0]) > ALONG[1] * radius for away, radius in reach):
            continue
        shown = visit.looks(grown, _numbered(len(grown), [things[j]]))
        without = Gaussians.concatenate([grown.rows(torch.from_numpy(np.setdiff1d(stays, rows))), *others])
        looks = visit.looks(without, np.full(len(without), -1, np.int32))
        looks = [replace(look, ids=with_it.ids) for look, with_it in zip(looks, shown, strict=True)]
        (signs,) = signs_of(looks, [0], np.ones(1), np.full(1, np.inf))
        if signs.photos and signs.alike > 0:
            found.add(j)
    return found


def _added(
    gmap: Map, things: list[Thing], known: set[int], taken: set[int], looked: np.ndarray
) -> dict[int, tuple[int, New]]:
    """By its new id: the number of each thing that is none of the `taken`, and how it is new. looked [N] bool: of all
    Gaussians, those at whose place earlier photos looked."""
    numbers = [j for j, (_, score) in enumerate(things) if j not in taken and score >= LEAST_SCORE]

    def how(j: int) -> New:
        hidden = bool(gmap.views) and looked[things[j][0]].mean() < LOOKED_AT
        return "known" if j in known else "hidden" if hidden else "added"

    return {i: (j, how(j)) for i, j in enumerate(numbers, gmap.next_id)}


def _settled(
    visit: Visit,
    owned: Owned,
    kept: np.ndarray,
    leaves: np.ndarray,
    new: np.ndarray,
    pairs: Pairs,
    gone: list[int],
    alone: bool,
) -> tuple[Owned, TrainRecord]:
    """The Gaussians of today that photos show: what stays of `owned`, whose first rows are the rows `kept` [H] of the
    map, without the rows `leaves`, and the moved things with their own Gaussians. Colours are trained, of the map's
    rows those that photos tell (`told_rows`). new: rows of the new things; alone: whether this is the only training."""
    gmap = visit.gmap
    stays = np.setdiff1d(np.arange(len(owned.gaussians)), leaves)
    parts = [owned.rows(stays)]
    hues = [visit.hues(gaussians_of(gmap, kept)), torch.zeros(len(stays) - len(kept), 3)]
    for i, (_, motion) in pairs.items():
        own = visit.own(i)
        parts.append(replace(own, gaussians=carried(visit.seen(own.gaussians), motion.new_from_old)))
        hues.append(visit.hues(own.gaussians))
    today = Owned.concatenate(parts)
    together = today.gaussians
    with visit.run.stage("look"):
        fixed = ~told_rows(together, [view for view, _ in visit.frames])
    fixed[len(kept) :] = False
    rows = np.flatnonzero(fixed)
    together.sh[torch.from_numpy(rows)] = visit.seen(gaussians_of(gmap, kept[rows])).sh
    came = np.append(np.isin(stays, new), np.ones(len(together) - len(stays), bool))
    stood = np.isin(visit.rows, kept)
    others = [visit.part(~stood), together.rows(torch.from_numpy(np.flatnonzero(came)))]
    memory = visit.rehearsed(visit.part(stood), Gaussians.concatenate(others))
    final, record = trained(visit, "settle", SETTLING, together, len(together), memory, alone, fixed)
    final = in_grey(final) if visit.grey else final
    final.sh[:, 0] += torch.cat(hues)
    final.sh[torch.from_numpy(rows)] = torch.from_numpy(gmap.sh[kept[rows]])
    return replace(today, gaussians=final), record
