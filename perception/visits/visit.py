"""The photos of a visit, exposed, with depth and masks, beside the part of the map that they may show."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.changes.colours import grey_photo, in_grey, in_light, without_colours
from perception.changes.evidence import seen_rows
from perception.changes.look import (
    Look,
    compared,
    depth_at,
    look,
    seen_from,
    stereo_of,
    with_exposure,
)
from perception.changes.registration import compact
from perception.gaussians.model import STORED, Gaussians
from perception.gaussians.photos import split_scene
from perception.gaussians.views import TrainingView
from perception.map.history import is_removed, stood
from perception.map.map import Map
from perception.masks import MaskSource
from perception.masks.stereo import StereoView
from perception.pipeline.checkpoint import digest, training_mark
from perception.pipeline.optimise import Photos, Run, label_photos
from perception.types import View
from perception.visits.placing import checked_poses
from perception.visits.record import as_it_was
from perception.visits.rehearsal import rehearsed, showing, to_rehearse
from perception.visits.rows import shape_of, shown_rows
from perception.visits.scene import foreign_photos, refuse_older, visit_scene

FAR = 0.98
"""Quantile of the depths of a photo that tells how far it sees."""


def gaussians_of(gmap: Map, rows: np.ndarray) -> Gaussians:
    """The Gaussians `rows` [R] of a map."""
    return Gaussians(**{name: torch.from_numpy(getattr(gmap, name)[rows]) for name in STORED.values()})


@dataclass
class Owned:
    """N Gaussians with the instance that each belongs to, ids [N] int32, −1 = none, how surely, membership [N] float32,
    and the part of it, part_ids [N] int32."""

    gaussians: Gaussians
    ids: np.ndarray
    membership: np.ndarray
    part_ids: np.ndarray

    def rows(self, index: np.ndarray) -> Owned:
        """Copies of the rows `index` [M] int64."""
        arrays = self.ids[index], self.membership[index], self.part_ids[index]
        return Owned(self.gaussians.rows(torch.from_numpy(index)), *arrays)

    @staticmethod
    def concatenate(parts: Sequence[Owned]) -> Owned:
        """All rows of `parts`, in order."""
        arrays = zip(*((part.ids, part.membership, part.part_ids) for part in parts), strict=True)
        return Owned(Gaussians.concatenate([part.gaussians for part in parts]), *map(np.concatenate, arrays))


@dataclass
class Visit:
    """The photos of a visit against the map. number: of the visit; whole: the map's Gaussians, without features and
    colours; rows [R]: those of them that a photo shows (`shown_rows`); gaussians: these as the visit sees them
    (`seen`); light [3]: its colours over the map's; grey: whether brightness alone is compared, as the photos or the
    map have no colours; photos: exposed and labelled; stereo: depths of the training photos; near: views of earlier
    visits that show something of what these see; earlier: those to be rehearsed; beside [E]: rows that these show and
    no photo does; masks: report; mark: of its training; left_out: names of photos that are not used, and why."""

    run: Run
    gmap: Map
    number: int
    whole: Gaussians
    rows: np.ndarray
    gaussians: Gaussians
    light: np.ndarray
    grey: bool
    photos: Photos
    stereo: list[StereoView | None]
    near: list[View]
    earlier: list[TrainingView]
    beside: np.ndarray
    masks: dict[str, Any]
    mark: str
    left_out: list[dict[str, str]]

    @property
    def ids(self) -> np.ndarray:
        """[R] int32 instance of each of `gaussians`, −1 = none."""
        return self.gmap.instance_ids[self.rows]

    def part(self, chosen: np.ndarray) -> Gaussians:
        """The rows of `gaussians` for which `chosen` [R] bool holds."""
        return self.gaussians.rows(torch.from_numpy(np.flatnonzero(chosen)))

    def rehearsed(self, stays: Gaussians, others: Gaussians) -> list[TrainingView]:
        """Renders of what earlier visits saw, see `rehearsal.rehearsed`, where nothing is that only they show."""
        beside = gaussians_of(self.gmap, np.setdiff1d(self.beside, self.rows))
        return rehearsed(self.earlier, stays, Gaussians.concatenate([others, beside]), self.run.new_keep())

    def without(self, leaves: np.ndarray) -> Visit:
        """The visit with what its photos show where the map's Gaussians `leaves` [N] bool do not stand, as well."""
        if not leaves.any():
            return self
        stays = np.flatnonzero(~leaves)
        left = self.whole.rows(torch.from_numpy(stays))
        rows = np.union1d(self.rows, stays[shown_rows(left, [*self.photos.views, *self.photos.held])])
        return replace(self, rows=rows, gaussians=self.seen(gaussians_of(self.gmap, rows)))

    def owned(self, rows: np.ndarray) -> Owned:
        """The rows [R] of the map, as it has them."""
        gmap, none = self.gmap, np.full(len(rows), -1, np.int32)
        parts = gmap.parts["ids"][rows] if "ids" in gmap.parts else none
        return Owned(gaussians_of(gmap, rows), gmap.instance_ids[rows], gmap.membership[rows], parts)

    def own(self, instance: int) -> Owned:
        """The Gaussians of an instance that are no strays, as the map has them; of a removed one as it was."""
        if instance in self.away:
            count = len(self.away[instance])
            ids, none = np.full(count, instance, np.int32), np.full(count, -1, np.int32)
            return Owned(self.away[instance], ids, np.ones(count, np.float32), none)
        rows = np.flatnonzero(self.gmap.instance_ids == instance)
        own = self.owned(rows[compact(self.gmap.means[rows].astype(np.float64))])
        entry = next(entry for entry in self.gmap.instances if entry["id"] == instance)
        own.part_ids[~np.isin(own.part_ids, [part["id"] for part in entry.get("parts", ())])] = -1
        return own

    def seen(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the map in the light of the visit, without colours if it is compared in grey."""
        return in_light(in_grey(gaussians) if self.grey else gaussians, self.light)

    def hues(self, gaussians: Gaussians) -> torch.Tensor:
        """[N, 3] what `seen` takes from the constant colour coefficients of Gaussians of the map besides the light."""
        return in_light(gaussians, self.light).sh[:, 0] - self.seen(gaussians).sh[:, 0]

    def thing(self, instance: int) -> Gaussians:
        """The Gaussians of an instance as the visit sees them."""
        return self.seen(self.own(instance).gaussians)

    @cached_property
    def away(self) -> dict[int, Gaussians]:
        """The removed instances of which the map knows what they looked like, by id."""
        found = {}
        for entry in filter(is_removed, self.gmap.instances):
            if (thing := as_it_was(self.gmap, entry)) is not None:
                kept = np.flatnonzero(compact(thing.means.double().numpy()))
                found[entry["id"]] = thing.rows(torch.from_numpy(kept))
        return found

    def seen_from(self, instance: int) -> np.ndarray:
        """[V, 3] directions to an instance where it stands, or stood last, from the map's views of that time, see
        `look`."""
        entry = next(entry for entry in self.gmap.instances if entry["id"] == instance)
        spot = entry["past"][-1] if is_removed(entry) else entry
        views = [view for view in self.gmap.views if stood(entry, getattr(view, "visit", 0)) is spot]
        return seen_from(views, self.thing(instance).means.double().numpy())

    @cached_property
    def frames(self) -> list[tuple[TrainingView, np.ndarray]]:
        """The training photos at the size at which they are compared, and what was measured in them."""
        pairs = zip(map(compared, self.photos.views), self.stereo, strict=True)
        return [(view, depth_at(stereo, view.photo.shape)) for view, stereo in pairs]

    @cached_property
    def before(self) -> list[Look]:
        """The training photos beside the map."""
        return self.looks(self.gaussians, self.ids)

    def looks(self, gaussians: Gaussians, ids: np.ndarray) -> list[Look]:
        """The training photos beside the Gaussians with instances ids [N]."""
        return [look(gaussians, ids, view, measured) for view, measured in self.frames]


def open_visit(run: Run, gmap: Map, source: MaskSource, output: Path) -> Visit:
    """The photos of the visit, with exposure, stereo depth and masks."""
    with run.stage("poses"):
        scene = visit_scene(run, gmap, output)
        refuse_older(gmap, scene.views)
    left_out = _told(run, scene.report.get("left_out", []))
    scene, training, held_out = split_scene(scene, run.config.photos)
    for line in [*scene.report.get("notes", []), *map("warning: {}".format, scene.report.get("warnings", []))]:
        run.progress.log(line)
    photos = Photos.load(run, training, held_out)
    if scene.report.get("input") != "photos":
        with run.stage("poses"):
            photos = checked_poses(run, gmap, photos)
    with run.stage("look"):
        whole = shape_of(gmap)
        rows = np.flatnonzero(shown_rows(whole, [*photos.views, *photos.held]))
    old, ids = gaussians_of(gmap, rows), gmap.instance_ids[rows]
    if grey := without_colours(old, photos.views):
        run.progress.log("the photos or the map have no colours: brightness alone is compared")
        photos = replace(photos, views=[*map(grey_photo, photos.views)], held=[*map(grey_photo, photos.held)])
        old = in_grey(old)
    with run.stage("look"):
        photos, light = _exposed(old, photos)
        lit = in_light(old, light)
        photos, shown, foreign = _of_this_place(run.source, gmap, photos, lit, ids)
        why = "does not show what the map holds there"
        left_out += _told(run, [{"name": name, "why": why} for name in foreign])
        run.progress.log(f"{len(photos.views)} photos of the visit; light {', '.join(f'{x:.2f}' for x in light)}")
        run.progress.log(f"{len(rows)} of {len(gmap)} Gaussians are in the photos")
        stereo = stereo_of(photos.training, photos.views, shown, run.progress)
        seen = seen_rows(shown, lit.means.double().numpy(), lit.scales.max(dim=1).values.numpy())
        seen = np.isin(np.arange(len(gmap)), rows[seen])
        near = showing(gmap.views, whole, seen, max(float(np.quantile(each.mapped, FAR)) for each in shown))
        earlier = to_rehearse(near, run.config.photos.max_side, len(photos.views))
        beside = np.setdiff1d(np.flatnonzero(shown_rows(whole, earlier)), rows)
    depths = {view.name: each for view, each in zip(photos.training, stereo, strict=True)}
    photos, masks = label_photos(
        run, photos, source, lambda view: depth_at(depths[view.name], view.photo.shape, confirmed=False)
    )
    mark = digest(gmap.map_id, training_mark(run.source, run.config), source.identity)
    facts = rows, lit, light, grey, photos, stereo, [view for view, _ in near], earlier, beside, masks, mark, left_out
    return Visit(run, gmap, gmap.newest_visit + 1, whole, *facts)


def _told(run: Run, left_out: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    """Logs the photos that are not used."""
    for entry in left_out:
        run.progress.log(f"left out: {entry['name']} ({entry['why']})")
    return list(left_out)


def _exposed(old: Gaussians, photos: Photos) -> tuple[Photos, np.ndarray]:
    """The photos with their gains; those held out as the two nearest by name."""
    views, light = with_exposure(old, photos.views)
    names, held = [view.name for view in views], []
    for view in photos.held:
        near = max(min(bisect(names, view.name) - 1, len(views) - 2), 0)
        gains = [other.gain for other in views[near : near + 2] if other.gain is not None]
        held.append(replace(view, gain=torch.stack(gains).log().mean(dim=0).exp() if gains else None))
    return replace(photos, views=views, held=held), light


def _of_this_place(
    source: Path, gmap: Map, photos: Photos, lit: Gaussians, ids: np.ndarray
) -> tuple[Photos, list[Look], list[str]]:
    """The photos that show the map, those held out as well; the training ones beside it, without measured depth; and
    the names of the others, see `scene.foreign_photos`."""
    views = [compared(view) for view in (*photos.views, *photos.held)]
    looks = [look(lit, ids, view, np.zeros(view.photo.shape[:2])) for view in views]
    foreign = foreign_photos(source, gmap, looks)
    shown = [each for each in looks[: len(photos.views)] if each.view.name not in foreign]
    training, held_out = ([v for v in part if v.name not in foreign] for part in (photos.training, photos.held_out))
    decoded, held = ([v for v in part if v.name not in foreign] for part in (photos.views, photos.held))
    return Photos(training, held_out, decoded, held), shown, foreign
