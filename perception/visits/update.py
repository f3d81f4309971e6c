"""`perception update`: a map of today from a map and a new visit.

poses      of the photos in the map's frame, given or localised                           `scene`, `placing`
look       exposure, stereo depth and masks of the photos; the map's render beside them   `visit`, `look`
evidence   from both: things that stand where they stood, do not, or are in no photo      `evidence`, `ghosts`;
           an instance of which a part went becomes two before                            `parted`, `parting`
grow       from what stays: new Gaussians where the photos show another surface           `growth`, `carving`
motion     from what grew: which new thing is which one that is gone, and how it moved    `motion`, `registration`
settle     colours of all that was looked at; a moved thing keeps its own Gaussians       `growth`, `rehearsal`
record     states, confidences and past places of all instances                           `record`

`today` puts evidence to settle together.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.changes.colours import in_grey
from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.model import Nearby
from perception.inputs.load import photo_sizes
from perception.instances.group import Grouping
from perception.language.base import Encoder
from perception.language.ocr import make_reader
from perception.machine import blas_on_one_thread, peak_memory_mib
from perception.map.history import is_removed
from perception.map.map import MAX_SIDE
from perception.map.write import Map, read_map, write_map
from perception.masks import make_source
from perception.photos.decode import scaled_size
from perception.photos.view_json import StoredView, moved_record, stored_view
from perception.pipeline.changes import finished, hold_inputs, refuse_unnamed
from perception.pipeline.checkpoint import check_name, digest, fingerprint, working
from perception.pipeline.estimate import check_size
from perception.pipeline.instances import DescribedInstances, describe
from perception.pipeline.optimise import Optimised, Run
from perception.pipeline.record import finite, score_views
from perception.progress import QUIET, Progress
from perception.types import View
from perception.visits.parted import parted
from perception.visits.record import (
    joined_language,
    kept_parts,
    past_with,
    recorded,
    visits_with,
    with_geometry,
    with_parts,
)
from perception.visits.today import Today, seen_today
from perception.visits.visit import Owned, Visit, open_visit


@blas_on_one_thread()
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

    config: settings, usually those of the map (`update_settings`). Gaussians that no photo shows stay as they are, bit
    for bit; of the others that stay, colours alone are trained, on the photos and on renders of what earlier visits saw
    (`rehearsal`). Ids, names and the frame are kept. What a run has made is kept beside `output` until the map is
    written; `resume` goes on from there. InputError for bad input: another scene, another unit, photos older than the
    map, masks of another kind. The map at `path` is only read.
    """
    check_name(output)
    gmap = read_map(path)
    mark = digest(gmap.map_id, fingerprint(source, config))
    if resume and (made := finished(source, output, config, mark, progress)) is not None:
        return made
    with working(source, output, resume) as work:
        refuse_unnamed(hold_inputs(work, source, config, output), config)
        run = Run.begun(source, config, work, progress)
        masks = make_source(config.masks, config.sam)
        _refuse_other_masks(gmap, masks.name)
        encoder = _encoder_of(gmap, config.language.encoder)
        check_size(photo_sizes(source), config.photos.max_side)
        visit = open_visit(run, gmap, masks, output)
        with run.stage("evidence"):
            visit = parted(visit)
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


def _encoder_of(gmap: Map, spec: str) -> Encoder | None:
    """The encoder `spec` of the settings, which describes what is new; None for instances that none describes.
    InputError unless it is the one that described the map's."""
    from perception.language.encoders import make_encoder

    if gmap.instances and not gmap.language and spec == gmap.setting("language", "encoder", "auto"):
        return None
    encoder = make_encoder(spec)
    before, now = str(gmap.language.get("encoder", "none")), "none" if encoder is None else encoder.identity
    if gmap.instances and before != now:
        todo = "leave it out" if "none" in (before, now) else "give the first, or run: perception upgrade MAP"
        raise InputError(f"language.encoder: that of {gmap.path} is {before}, that of the visit {now}; {todo}")
    return encoder


def _described(visit: Visit, today: Today, encoder: Encoder | None) -> DescribedInstances:
    """Entries and embeddings of the added instances, in their order."""
    owned, added = today.owned, today.added
    ids, none = np.full((2, len(owned.ids)), -1, np.int32)
    for n, i in enumerate(added):
        ids[owned.ids == i] = n
    scores, groups = np.array([score for score, _ in added.values()]), np.full(len(added), -1, np.int32)
    grouping = Grouping(ids, owned.membership, scores, none, groups=groups)
    optimised = Optimised(Nearby(owned.gaussians), visit.photos, today.record, visit.masks)
    reader = make_reader(visit.run.config.language.texts) if added else None
    with visit.run.stage("instances"):
        return describe(optimised, grouping, visit.run, encoder if added else None, reader)


def assembled(visit: Visit, today: Today, described: DescribedInstances, output: Path, mark: str) -> Map:
    """The map of today."""
    gmap, run, number, prefix = visit.gmap, visit.run, visit.number, _prefix(visit)
    with run.stage("score"):
        seen = in_grey(today.owned.gaussians) if visit.grey else today.owned.gaussians
        quality = score_views(seen, visit.photos.held, gmap.metric)
        quality["views"] = {prefix + name: figures for name, figures in quality["views"].items()}
    owned = Owned.concatenate([visit.owned(today.rest), today.owned])
    instances = _entries(visit, today, owned, described)
    arrays: dict[str, Any] = {name: tensor.numpy() for name, tensor in owned.gaussians.named().items()}
    fresh = slice(len(today.rest) + len(today.kept), None)
    norm = np.linalg.norm(arrays["quats"][fresh], axis=1, keepdims=True)
    arrays["quats"][fresh] = arrays["quats"][fresh] / np.maximum(norm, 1e-12)
    groups = dict(gmap.groups)
    if groups:
        groups["of"] = np.append(groups["of"], np.full(len(today.added), -1)).astype(np.int32)
    side = gmap.setting("photos", "max_side", MAX_SIDE)  # at which boxes of all views are
    language = renamed(described.language, prefix, visit.photos.training, run.config.photos.max_side, side)
    config = run.config.to_json()
    config["photos"]["max_side"] = side
    assert gmap.path is not None
    old, new = [view for view in gmap.views if isinstance(view, StoredView)], _views(visit, output, prefix)
    scene, left_out = gmap.info.get("scene", {}), [{**e, "name": prefix + e["name"]} for e in visit.left_out]
    info = {
        **gmap.info,
        "visits": visits_with(gmap, run.source, [view.photo for view in new]),
        "quality": quality,
        "config": config,
        "fingerprint": mark,
        "seconds": {**run.seconds, "total": time.monotonic() - run.started},
        "instances": {**gmap.info.get("instances", {}), "count": len(instances)},
        "next_id": max([gmap.next_id, *(i + 1 for i in today.added)]),
        "training": asdict(today.record),
        "masks": visit.masks,
        "peak_memory_mib": peak_memory_mib(),
        "scene": {**scene, "left_out": [*scene.get("left_out", []), *left_out]},
    }
    return Map(
        **arrays,
        instance_ids=owned.ids,
        membership=owned.membership,
        instances=finite(instances),
        info=finite(info),
        views=[*(moved_record(view, gmap.path, output) for view in old), *new],
        language=joined_language(gmap.language, language),
        parts=kept_parts(gmap.parts, owned.part_ids, instances),
        groups=groups,
        past=past_with(gmap, today.gone, number - 1, visit.light),
    )


def _entries(visit: Visit, today: Today, owned: Owned, described: DescribedInstances) -> list[dict[str, Any]]:
    """The entries of the map's instances after the visit, then those of the new ones. owned: all Gaussians."""
    number, made = visit.number, []
    for entry, signs in zip(visit.gmap.instances, today.signs, strict=True):
        motion, rows = today.motions.get(entry["id"]), np.flatnonzero(owned.ids == entry["id"])
        entry = recorded(entry, number, signs, motion, entry["id"] in today.gone)
        if not is_removed(entry) and (motion is not None or len(rows) != entry["num_gaussians"]):
            entry = with_parts(with_geometry(entry, owned.gaussians, rows), owned.gaussians, owned.part_ids)
        made.append(entry)
    for (i, (_, new)), entry in zip(today.added.items(), described.instances, strict=True):
        seen = {"first_seen": 0 if new == "known" else number, "last_seen": number, "last_looked_for": number}
        seen |= {"hidden_before": True} if new == "hidden" else {}
        state = {"state": "added" if new == "added" else "unchanged", "confidence": round(entry["score"], 3)}
        made.append({**entry, "id": i, **state, **seen})
    return made


def _prefix(visit: Visit) -> str:
    """Of the names of the visit's views in the map, so that none of its other views has such a name."""
    prefix = f"visit{visit.number}"
    while any(view.name.startswith(f"{prefix}/") for view in visit.gmap.views):
        prefix += "-again"
    return f"{prefix}/"


def _views(visit: Visit, output: Path, prefix: str) -> list[StoredView]:
    """The views of the visit as the map records them, by name."""
    photos, made = visit.photos, []
    for posed, decoded, held in ((photos.training, photos.views, False), (photos.held_out, photos.held, True)):
        for view, gain in ((view, shown.gain) for view, shown in zip(posed, decoded, strict=True)):
            view = replace(view, gain=None if gain is None else tuple(gain.double().tolist()))
            made.append(replace(stored_view(view, output, held, visit.number), name=prefix + view.name))
    return sorted(made, key=lambda view: view.name)


def renamed(
    language: dict[str, np.ndarray], prefix: str, views: Sequence[View], visit_side: int, side: int
) -> dict[str, np.ndarray]:
    """language.npz of the visit's `views` at `visit_side` pixels, with the map's names of them, and boxes at `side`."""
    if not language:
        return {}
    sizes = {v.name: np.divide(scaled_size(v, side), scaled_size(v, visit_side)) for v in views}
    names, boxes = [str(name) for name in language["view_names"]], language["view_boxes"]
    factors = np.array([sizes[name] for name in names]).reshape(len(names), 2)
    low, high = np.floor(boxes[:, :2] * factors), np.ceil(boxes[:, 2:] * factors - 1e-9)
    boxes = np.concatenate([low, high], axis=1).astype(boxes.dtype)
    return {**language, "view_names": np.array([prefix + name for name in names], dtype=np.str_), "view_boxes": boxes}


def _log_result(gmap: Map, output: Path, progress: Progress) -> None:
    states = [entry.get("state") for entry in gmap.instances]
    counts = ", ".join(f"{states.count(s)} {s}" for s in ("moved", "removed", "added", "unchanged", "unseen"))
    psnr = gmap.info["quality"].get("psnr")
    scored = f", held-out PSNR {psnr:.2f} dB" if psnr else ""
    progress.log(f"{output}: {len(gmap)} Gaussians; {counts}{scored}")
