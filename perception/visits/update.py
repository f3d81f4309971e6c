"""`perception update`: a map of today from a map and a new visit.

poses      of the visit in the map's frame, given or localised                        `scene`
look       exposure of the visits, stereo depth, masks; the map beside the photos     `look`
evidence   what still stands where it stood, what does not, what nobody looked at     `evidence`
grow       new Gaussians where the photos show another surface, the rest held         `growth`
motion     which new thing is which one that is gone, and how it moved                `motion`
settle     colours of all that was looked at; a moved thing keeps its own Gaussians   `growth`
record     states, confidences and past places of all instances                       `record`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.device import choose_device
from perception.gaussians.model import Gaussians, Nearby
from perception.gaussians.photos import split_scene
from perception.gaussians.state import TrainRecord
from perception.instances.group import Grouping
from perception.instances.votes import mask_votes
from perception.language.base import Encoder
from perception.language.ocr import make_reader
from perception.map.checksums import is_map
from perception.map.files import read_info
from perception.map.history import is_removed
from perception.map.write import Map, read_map, write_map
from perception.masks import make_source
from perception.masks.stereo import StereoView
from perception.photos.view_json import moved_record, stored_view
from perception.pipeline.changes import hold_inputs
from perception.pipeline.checkpoint import check_name, clear_work, digest, fingerprint, training_mark, working
from perception.pipeline.instances import DescribedInstances, describe
from perception.pipeline.optimise import Optimised, Photos, Run, label_photos
from perception.pipeline.record import finite, score_views
from perception.progress import QUIET, Progress
from perception.visits.evidence import Signs, seen_rows, signs_of
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
from perception.visits.look import Look, compared, depth_at, in_light, look, stereo_of, with_exposure
from perception.visits.motion import (
    ALIKE,
    HOPELESS,
    Motion,
    assigned,
    carried,
    cuts_of,
    looks_alike,
    motions_of,
    settled,
)
from perception.visits.record import joined_language, kept_parts, past_with, recorded, visits_with, with_geometry
from perception.visits.scene import foreign_photos, refuse_older, visit_scene

TENSORS = ("means", "quats", "log_scales", "opacity_logits", "sh", "features")
UP = np.array([0.0, 0.0, 1.0])


@dataclass
class Visit:
    """The photos of a visit against the map. number: of the visit; gaussians: of the map, in the light of the visit;
    photos: exposed and labelled; stereo: depths of the training photos."""

    run: Run
    gmap: Map
    number: int
    gaussians: Gaussians
    photos: Photos
    stereo: list[StereoView | None]
    masks: dict[str, Any]
    mark: str

    def looks(self, gaussians: Gaussians, ids: np.ndarray) -> list[Look]:
        """The training photos beside the Gaussians with instances ids [N]."""
        small = map(compared, self.photos.views)
        pairs = zip(small, self.stereo, strict=True)
        return [look(gaussians, ids, view, depth_at(stereo, view.photo.shape)) for view, stereo in pairs]


@dataclass
class Today:
    """What stands there today: the Gaussians, of which the first rows are `kept` rows [H] of the map; ids [N] int32
    instance, `membership` [N]; signs and motions of the map's instances, in their order; `added`: ids of new ones and
    their scores."""

    gaussians: Gaussians
    kept: np.ndarray
    ids: np.ndarray
    membership: np.ndarray
    part_ids: np.ndarray
    signs: list[Signs]
    gone: list[int]
    motions: dict[int, Motion]
    added: dict[int, float]
    record: TrainRecord


def update_map(
    path: Path,
    source: Path,
    output: Path,
    config: MapConfig,
    *,
    resume: bool = False,
    progress: Progress = QUIET,
) -> Map:
    """Writes the map of today to `output`: the map at `path`, changed as the photos of `source` show.

    config: settings, usually those of the map (`update_settings`). Gaussians that no photo looked at stay as they are,
    bit for bit; of the others that stay, colours alone are trained. Ids, names and the frame are kept. What a run has
    made is kept beside `output` until the map is written; `resume` goes on from there. InputError for bad input: another
    scene, another unit, photos older than the map, masks of another kind. The map at `path` is only read.
    """
    check_name(output)
    gmap = read_map(path)
    mark = digest(gmap.map_id, fingerprint(source, config))
    if resume and is_map(output) and read_info(output).get("fingerprint") == mark:
        progress.log(f"{output}: this run is finished")
        clear_work(output)
        return read_map(output)
    with working(source, output, resume) as work:
        hold_inputs(work, source, config, output)
        device, notice = choose_device(config.device)
        if notice is not None:
            progress.log(notice)
        run = Run(source, config, work, work / "masks", device, progress)
        masks = make_source(config.masks, config.sam)
        _refuse_other_masks(gmap, masks.name)
        encoder = _encoder_of(gmap)
        visit = open_visit(run, gmap, masks, output)
        today = seen_today(visit)
        described = _described(visit, today, encoder)
        made = assembled(visit, today, described, output, mark)
        run.inputs = hold_inputs(work, source, config, output)
        made.info["inputs"] = run.inputs
        write_map(output, made, fresh=True)
    _log_result(made, output, progress)
    return made


def _refuse_other_masks(gmap: Map, name: str) -> None:
    before = gmap.info.get("masks", {}).get("source")
    if before is not None and before != name:
        what = f"the masks of {gmap.path} come from {before}, those of the visit from {name}"
        raise InputError(f"--masks: {what}, and these cut things otherwise; give masks from {before}")


def _encoder_of(gmap: Map) -> Encoder | None:
    """The encoder that described the map's instances; None for a map without language."""
    if not gmap.language:
        return None
    from perception.language.description import check_encoder
    from perception.language.encoders import make_encoder

    spec = gmap.setting("language", "encoder", "auto")
    encoder = make_encoder("conse" if spec == "auto" else spec)
    assert encoder is not None
    check_encoder(str(gmap.language["encoder"]), encoder.identity)
    return encoder


# ----------------------------------------------------------------------- look


def open_visit(run: Run, gmap: Map, source: Any, output: Path) -> Visit:
    """The photos of the visit, with exposure, stereo depth and masks."""
    with run.stage("poses"):
        scene = visit_scene(run, gmap, output)
        refuse_older(gmap, scene.views)
    for entry in scene.report.get("left_out", []):
        run.progress.log(f"left out: {entry['name']} ({entry['why']})")
    scene, training, held_out = split_scene(scene, run.config.photos)
    photos = Photos.load(run, training, held_out)
    old = Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(getattr(gmap, name))) for name in TENSORS})
    with run.stage("look"):
        photos, light = _exposed(old, photos)
        lit = in_light(old, light)
        shown = [look(lit, gmap.instance_ids, compared(v), np.zeros(compared(v).photo.shape[:2])) for v in photos.views]
        foreign = foreign_photos(run.source, gmap, shown)
        photos = _without(photos, foreign)
        for name in foreign:
            run.progress.log(f"left out: {name} (does not show what the map holds there)")
        run.progress.log(f"{len(photos.views)} photos of the visit; light {', '.join(f'{x:.2f}' for x in light)}")
        stereo = stereo_of(old, photos.training, photos.views, run.progress)
    depths = {view.name: each for view, each in zip(photos.training, stereo, strict=True)}
    photos, masks = label_photos(
        run, photos, source, lambda view: depth_at(depths[view.name], view.photo.shape, confirmed=False)
    )
    number = len(gmap.info.get("visits") or [0])
    mark = digest(gmap.map_id, training_mark(run.source, run.config), source.identity)
    return Visit(run, gmap, number, lit, photos, stereo, masks, mark)


def _exposed(old: Gaussians, photos: Photos) -> tuple[Photos, np.ndarray]:
    """The photos with their gains; those held out as their neighbours."""
    views, light = with_exposure(old, photos.views)
    held = []
    for view in photos.held:
        near = sorted(views, key=lambda other: abs(_number(view.name, other.name, views)))[:2]
        gains = [other.gain for other in near if other.gain is not None]
        held.append(replace(view, gain=torch.stack(gains).log().mean(dim=0).exp() if gains else None))
    return replace(photos, views=views, held=held), light


def _number(name: str, other: str, views: Sequence[Any]) -> int:
    """Photos between two names, in the order of names."""
    names = sorted({view.name for view in views} | {name})
    return names.index(other) - names.index(name)


def _without(photos: Photos, names: Sequence[str]) -> Photos:
    kept = [n for n, view in enumerate(photos.training) if view.name not in names]
    return replace(photos, training=[photos.training[n] for n in kept], views=[photos.views[n] for n in kept])


# ----------------------------------------------------------------------- evidence, growth, motion


def seen_today(visit: Visit) -> Today:
    """Judges the map's instances, adds what is new, and finds out what moved."""
    gmap, run, progress = visit.gmap, visit.run, visit.run.progress
    with run.stage("evidence"):
        signs = _signs(visit)
    entries = gmap.instances
    gone = [e["id"] for e, s in zip(entries, signs, strict=True) if not is_removed(e) and s.seen and s.log_odds < 0]
    kept = np.flatnonzero(~np.isin(gmap.instance_ids, gone))
    held, ids = visit.gaussians.rows(torch.from_numpy(kept)), gmap.instance_ids[kept]
    with run.stage("look"):
        looks = visit.looks(held, ids)
    new = new_surface(looks, held, run.config.train.budget or len(visit.gaussians), run.config.seed)
    progress.log(f"{len(gone)} things do not stand where they stood; {len(new)} points of new surface")
    config = update_config(run.config, len(visit.photos.views), GROWING, len(held) + SPARE * len(new))
    together = Gaussians.concatenate([held, new])
    grown, record = trained(run, "grow", visit.mark, visit.masks["identity"], together, len(held), visit.photos, config)

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
        made = grouped(grown, votes, free, run.config)
    things = [(free[made.ids == n], float(made.scores[n])) for n in range(made.count)]
    with run.stage("motion"):
        looks = visit.looks(grown, ids)
        pairs = _moved(visit, grown, things, gone, looks)
    return _settled(visit, grown, kept, ids, made, free, signs, gone, things, pairs, record)


def _signs(visit: Visit) -> list[Signs]:
    gmap, entries = visit.gmap, visit.gmap.instances
    looks = visit.looks(visit.gaussians, gmap.instance_ids)
    seen = seen_rows(looks, gmap.means.astype(np.float64), gmap.scales.max(axis=1))
    ids = [entry["id"] for entry in entries]
    order = np.argsort(ids)
    position = (
        order[np.clip(np.searchsorted(np.array(ids)[order], gmap.instance_ids), 0, len(ids) - 1)] if ids else None
    )
    shares = np.zeros(len(ids))
    if position is not None:
        owned = gmap.instance_ids >= 0
        total = np.bincount(position[owned], minlength=len(ids))
        shares = np.bincount(position[owned & seen], minlength=len(ids)) / np.maximum(total, 1)
    return signs_of(looks, ids, shares, np.array([min(entry["obb"]["extent"]) for entry in entries]))


def _moved(
    visit: Visit, grown: Gaussians, things: list[tuple[np.ndarray, float]], gone: list[int], looks: list[Look]
) -> dict[int, tuple[int, Motion]]:
    """By id of an instance that is gone: the number of the new thing that it is, and its motion."""
    if not gone or not things:
        return {}
    rows = {i: torch.from_numpy(np.flatnonzero(visit.gmap.instance_ids == i)) for i in gone}
    olds = {i: visit.gaussians.rows(rows[i]) for i in gone}
    depth = {entry["id"]: min(entry["obb"]["extent"]) for entry in visit.gmap.instances}
    odds, found, cuts = np.full((len(gone), len(things)), -np.inf), {}, []
    for j, (own, _) in enumerate(things):
        new = grown.rows(torch.from_numpy(own))
        rest = np.setdiff1d(np.arange(len(grown)), own)
        cuts.append(cuts_of(looks, new, grown.rows(torch.from_numpy(rest))))
        alike = [looks_alike(olds[i], new) for i in gone]
        for a in np.argsort(alike, kind="stable")[::-1][:ALIKE]:
            motions = motions_of(olds[gone[a]], new, cuts[j], UP, depth[gone[a]])
            if motions:
                odds[a, j], found[a, j] = motions[0][0].log_odds, motions
        visit.run.progress.update("motions", j + 1, len(things))
    pairs = {}
    for a, j in assigned(odds, HOPELESS):
        motion = settled(olds[gone[a]], found[a, j], cuts[j], depth[gone[a]])
        rival = max((odds[b, j] for b in range(len(gone)) if b != a), default=-np.inf)
        if motion.signs.log_odds > 0:
            pairs[gone[a]] = (j, replace(motion, ambiguous=motion.ambiguous or rival > motion.signs.log_odds))
    return pairs


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
    pairs: dict[int, tuple[int, Motion]],
    record: TrainRecord,
) -> Today:
    """Puts the Gaussians of moved things where the new ones grew, and trains the colours of all that was looked at."""
    gmap, run = visit.gmap, visit.run
    membership = np.concatenate([gmap.membership[kept], np.ones(len(grown) - len(kept), np.float32)])
    membership[free] = np.where(made.ids >= 0, made.membership, 0)
    parts = gmap.parts["ids"] if "ids" in gmap.parts else np.full(len(gmap), -1, np.int32)
    part_ids = np.concatenate([parts[kept], np.full(len(grown) - len(kept), -1, np.int32)])
    taken = {j for j, _ in pairs.values()}
    used = [entry["id"] for entry in gmap.instances] + [p["id"] for e in gmap.instances for p in e.get("parts", ())]
    following, added = max(used, default=-1) + 1, dict[int, float]()
    for j, (rows, score) in enumerate(things):
        if j not in taken:
            ids[rows], added[following] = following, score
            following += 1
    replaced = np.concatenate([np.zeros(0, np.int64), *(things[j][0] for j in taken)])
    stays = np.setdiff1d(np.arange(len(grown)), replaced)
    pieces, names, members, owned = (
        [grown.rows(torch.from_numpy(stays))],
        [ids[stays]],
        [membership[stays]],
        [part_ids[stays]],
    )
    for i, (_, motion) in pairs.items():
        old = np.flatnonzero(gmap.instance_ids == i)
        pieces.append(carried(visit.gaussians.rows(torch.from_numpy(old)), motion.new_from_old))
        names.append(np.full(len(old), i, np.int32))
        members.append(gmap.membership[old])
        owned.append(parts[old])
    together = Gaussians.concatenate(pieces)
    config = update_config(run.config, len(visit.photos.views), SETTLING, len(together))
    start = together.sh.clone()
    final, last = trained(
        run, "settle", visit.mark, visit.masks["identity"], together, len(together), visit.photos, config
    )
    unseen = (final.sh[: len(kept)] == start[: len(kept)]).flatten(1).all(dim=1)
    original = torch.from_numpy(gmap.sh[kept])
    final.sh[: len(kept)] = torch.where(unseen[:, None, None], original, final.sh[: len(kept)])
    motions = {i: motion for i, (_, motion) in pairs.items()}
    arrays = (np.concatenate(names).astype(np.int32), np.concatenate(members), np.concatenate(owned).astype(np.int32))
    return Today(final, kept, *arrays, signs, gone, motions, added, TrainRecord.joined([record, last]))


# ----------------------------------------------------------------------- record


def _described(visit: Visit, today: Today, encoder: Encoder | None) -> DescribedInstances:
    """Entries and embeddings of the added instances, in their order."""
    ids = np.full(len(today.ids), -1, np.int32)
    for n, i in enumerate(today.added):
        ids[today.ids == i] = n
    none = np.full(len(ids), -1, np.int32)
    grouping = Grouping(
        ids,
        today.membership,
        np.array(list(today.added.values())),
        none,
        groups=np.full(len(today.added), -1, np.int32),
    )
    optimised = Optimised(Nearby(today.gaussians), visit.photos, today.record, visit.masks)
    reader = make_reader(visit.run.config.language.texts) if today.added else None
    with visit.run.stage("instances"):
        return describe(optimised, grouping, visit.run, encoder if today.added else None, reader)


def assembled(visit: Visit, today: Today, described: DescribedInstances, output: Path, mark: str) -> Map:
    """The map of today."""
    gmap, run, number = visit.gmap, visit.run, visit.number
    gaussians = today.gaussians
    instances = []
    for entry, signs in zip(gmap.instances, today.signs, strict=True):
        motion, rows = today.motions.get(entry["id"]), np.flatnonzero(today.ids == entry["id"])
        entry = recorded(entry, number, signs, motion, entry["id"] in today.gone)
        if not is_removed(entry) and (motion is not None or len(rows) != entry["num_gaussians"]):
            entry = with_geometry(entry, gaussians, rows)
        instances.append(entry)
    for i, entry in zip(today.added, described.instances, strict=True):
        seen = {"first_seen": number, "last_seen": number, "last_looked_for": number}
        instances.append({**entry, "id": i, "state": "added", "confidence": round(entry["score"], 3), **seen})
    with run.stage("score"):
        quality = score_views(gaussians, visit.photos.held, gmap.metric)
    arrays = {name: getattr(gaussians, name).numpy() for name in TENSORS}
    fresh = slice(len(today.kept), None)
    norm = np.linalg.norm(arrays["quats"][fresh], axis=1, keepdims=True)
    arrays["quats"][fresh] = arrays["quats"][fresh] / np.maximum(norm, 1e-12)
    groups = dict(gmap.groups)
    if groups:
        groups["of"] = np.append(groups["of"], np.full(len(today.added), -1)).astype(np.int32)
    views = [moved_record(view, gmap.path, output) for view in gmap.views] + _views(visit, output)
    info = {**gmap.info, "visits": visits_with(gmap, run.source, [v.photo for v in views if v.visit == number])}
    info |= {"quality": quality, "config": run.config.to_json(), "fingerprint": mark, "seconds": dict(run.seconds)}
    info |= {"training": asdict(today.record), "masks": visit.masks}
    return Map(
        **arrays,
        instance_ids=today.ids,
        membership=today.membership,
        instances=finite(instances),
        info=finite(info),
        views=views,
        language=joined_language(gmap.language, _renamed(described.language, number)),
        parts=kept_parts(gmap.parts, today.part_ids, instances),
        groups=groups,
        past=past_with(gmap, today.gone, number - 1),
    )


def _views(visit: Visit, output: Path) -> list[Any]:
    """The views of the visit as the map records them; the visit is part of their names, which are unique."""
    photos, made = visit.photos, []
    decoded = {view.name: view for view in (*photos.views, *photos.held)}
    held = {view.name for view in photos.held}
    for view in sorted([*photos.training, *photos.held_out], key=lambda view: view.name):
        gain = decoded[view.name].gain
        view = replace(view, gain=None if gain is None else tuple(gain.double().tolist()))
        record = stored_view(view, output, view.name in held, visit.number)
        made.append(replace(record, name=_name(view.name, visit.number)))
    return made


def _name(photo: str, number: int) -> str:
    return f"visit{number}/{photo}"


def _renamed(language: dict[str, np.ndarray], number: int) -> dict[str, np.ndarray]:
    if not language:
        return {}
    names = np.array([_name(str(name), number) for name in language["view_names"]], dtype=np.str_)
    return {**language, "view_names": names}


def _log_result(gmap: Map, output: Path, progress: Progress) -> None:
    states = [entry.get("state") for entry in gmap.instances]
    counts = ", ".join(f"{states.count(s)} {s}" for s in ("moved", "removed", "added", "unchanged", "unseen"))
    psnr = gmap.info["quality"].get("psnr")
    scored = f", held-out PSNR {psnr:.2f} dB" if psnr else ""
    progress.log(f"{output}: {len(gmap)} Gaussians; {counts}{scored}")
