"""What an update writes about each instance: states, confidences, where it stood; see `map.history`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.boxes import instance_entry
from perception.changes.evidence import UNSEEN, Signs, probability
from perception.changes.motion import Motion
from perception.colors import rgb_from_sh, sh_from_rgb
from perception.gaussians.model import Gaussians
from perception.language.description import chosen_rows, from_arrays, to_arrays
from perception.map.history import is_removed, visits_of
from perception.map.map import Map, language_in, prefixed
from perception.photos.decode import CAMERA_FOLDER, exif_of, open_photo

_GEOMETRY = ("num_gaussians", "centroid", "obb", "aabb")
NOWHERE = 0.7
"""Probability that what does not stand where it stood, and was found nowhere else, was removed; else it moved. Of 23
things of made visits said to be removed .65 were, where signs alone say .94; of 20 kept aside .75."""
_TAKEN, _OFFSET = 36867, 36881  # EXIF DateTimeOriginal and OffsetTimeOriginal


def time_taken(photos: Sequence[Path], utc: bool = False) -> datetime | None:
    """When the newest of the photos was taken, by EXIF; None where none says so. By the camera's clock; `utc`: in UTC
    where EXIF states the offset of that clock."""
    times = []
    for photo in photos:
        try:
            with open_photo(photo) as image:
                exif = exif_of(image, photo, CAMERA_FOLDER)
            time = datetime.strptime(exif[_TAKEN], "%Y:%m:%d %H:%M:%S")
            offset = re.fullmatch(r"([+-])(\d\d):(\d\d)", str(exif.get(_OFFSET))) if utc else None
            sign, hours, minutes = offset.groups() if offset else ("+", 0, 0)
            times.append(time - int(f"{sign}1") * timedelta(hours=int(hours), minutes=int(minutes)))
        except (OSError, KeyError, ValueError, TypeError, OverflowError):
            continue
    return max(times, default=None)


def visit_record(source: Path, photos: Sequence[Path]) -> dict[str, Any]:
    """An entry of `visits` of map.json. time: when the newest photo was taken, else when its file was written; in
    UTC, or by the clock of a camera that does not state its offset."""
    taken = time_taken(photos, utc=True)
    if taken is None and photos:
        taken = datetime.fromtimestamp(max(photo.stat().st_mtime for photo in photos), timezone.utc)
    time = None if taken is None else taken.strftime("%Y-%m-%dT%H:%M:%SZ")
    return {"time": time, "input": str(source.absolute()), "photos": len(photos)}


def visits_with(gmap: Map, source: Path, photos: Sequence[Path]) -> list[dict[str, Any]]:
    """`visits` of map.json after this one."""
    before = visits_of(gmap.info, len(gmap.views))
    old = [{"time": visit.time, "input": visit.input, "photos": visit.photos} for visit in before]
    return [*old, visit_record(source, photos)]


def with_geometry(entry: dict[str, Any], gaussians: Gaussians, rows: np.ndarray) -> dict[str, Any]:
    """The entry with the number, centroid and boxes of the Gaussians `rows`."""
    points, weights = gaussians.means.numpy()[rows].astype(np.float64), gaussians.opacities.numpy()[rows]
    made = instance_entry(entry["id"], points, weights.astype(np.float64), entry["score"], entry.get("views", 0))
    return {**entry, **{key: made[key] for key in _GEOMETRY}}


def with_parts(entry: dict[str, Any], gaussians: Gaussians, part_ids: np.ndarray) -> dict[str, Any]:
    """The entry whose parts have the boxes of their Gaussians, too; without those that have none. part_ids [N]."""
    if "parts" not in entry:
        return entry
    owned = [(part, np.flatnonzero(part_ids == part["id"])) for part in entry["parts"]]
    return {**entry, "parts": [with_geometry(part, gaussians, rows) for part, rows in owned if len(rows)]}


def recorded(entry: dict[str, Any], visit: int, signs: Signs, motion: Motion | None, gone: bool) -> dict[str, Any]:
    """The entry of an old instance after a visit, still with its old geometry. gone: it does not stand there."""
    entry = {"first_seen": 0, "last_seen": visit - 1, "last_looked_for": visit - 1, **entry}
    if is_removed(entry):
        return entry if motion is None else returned(entry, visit, motion)
    if not signs.seen:
        return {**entry, "state": "unseen", "confidence": round(1 - 0.5 * min(1.0, signs.share / UNSEEN), 3)}
    sure = probability(signs.log_odds)
    if not gone:
        state = {"state": "unchanged", "confidence": round(sure, 3)}
        return {**entry, **state, "last_seen": visit, "last_looked_for": visit}
    stood = {**_spot(entry, visit), **({"transform": None} if motion is None else _motion_record(motion))}
    past, sure = [*entry.get("past", ()), stood], 1 - sure
    if motion is None:
        entry = {key: value for key, value in entry.items() if key != "parts"}
        entry |= {"state": "removed", "confidence": round(sure * NOWHERE, 3), "num_gaussians": 0}
    else:
        entry |= {"state": "moved", "confidence": round(sure * probability(motion.odds), 3), "last_seen": visit}
    return {**entry, "last_looked_for": visit, "past": past}


def returned(entry: dict[str, Any], visit: int, motion: Motion) -> dict[str, Any]:
    """The entry of a removed instance that a visit found again, still with its old geometry."""
    *before, left = entry["past"]
    away = {**_spot(entry, visit), "gone": True, **_motion_record(motion)}
    past = [*before, {**left, "transform": np.eye(4).tolist()}, away]
    state = {"state": "added", "confidence": round(probability(motion.odds), 3)}
    return {**entry, **state, "last_seen": visit, "last_looked_for": visit, "past": past}


def _spot(entry: dict[str, Any], visit: int) -> dict[str, Any]:
    """Of `past`: where an entry stood until the visit before `visit`."""
    return {"until": visit - 1, **{key: entry[key] for key in _GEOMETRY[1:] if key in entry}}


def _motion_record(motion: Motion) -> dict[str, Any]:
    """Keys of an entry of `past`."""
    told = {"ambiguous": True} if motion.ambiguous else {}
    axis = {} if motion.axis is None else {"axis": motion.axis.tolist()}
    return {"transform": motion.new_from_old.tolist(), **told, **axis}


def joined_language(old: dict[str, np.ndarray], new: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of language.npz with the rows of `new` appended."""
    if not old or not new:
        return old or new
    (before, encoder), (after, _) = from_arrays(old), from_arrays(new)
    return to_arrays([*before, *after], encoder)


def kept_parts(
    parts: dict[str, np.ndarray], ids: np.ndarray, instances: Sequence[dict[str, Any]]
) -> dict[str, np.ndarray]:
    """parts.npz of the Gaussians with part `ids` [N], without the parts of removed instances."""
    if not parts:
        return {}
    before = np.unique(parts["ids"][parts["ids"] >= 0])
    kept = np.array(sorted(part["id"] for entry in instances for part in entry.get("parts", ())), np.int64)
    if len(kept) == 0:
        return {}
    language = chosen_rows(language_in(parts), np.flatnonzero(np.isin(before, kept)).tolist())
    return {"ids": np.where(np.isin(ids, kept), ids, -1).astype(np.int32), **prefixed(language)}


def past_with(gmap: Map, gone: Sequence[int], until: int, light: np.ndarray) -> dict[str, np.ndarray]:
    """past.npz with the Gaussians of the instances that no longer stand where they stood, all in the light of the
    visit: light [3] are its colours over the map's."""
    rows = np.flatnonzero(np.isin(gmap.instance_ids, list(gone)))
    made = {
        "means": gmap.means[rows].astype(np.float32),
        "ids": gmap.instance_ids[rows].astype(np.int32),
        "until": np.full(len(rows), until, np.int32),
        "colors": rgb_from_sh(gmap.sh[rows, 0]).astype(np.float16),
        **{name: getattr(gmap, name)[rows].astype(np.float16) for name in ("quats", "log_scales", "opacity_logits")},
    }
    if gmap.past:
        blank = {name: np.zeros((len(gmap.past["ids"]), *array.shape[1:]), array.dtype) for name, array in made.items()}
        made = {name: np.concatenate([gmap.past.get(name, blank[name]), array]) for name, array in made.items()}
    made["colors"] = (made["colors"] * light).astype(np.float16)
    return made if len(made["ids"]) else {}


def as_it_was(gmap: Map, entry: dict[str, Any]) -> Gaussians | None:
    """The Gaussians of a removed instance where it stood last, without features; None where past.npz does not hold what
    they looked like."""
    past, last = gmap.past, entry["past"][-1]["until"]
    if "quats" not in past:
        return None
    rows = np.flatnonzero((past["ids"] == entry["id"]) & (past["until"] == last))
    if not past["quats"][rows].any():
        return None
    sh = np.zeros((len(rows), *gmap.sh.shape[1:]), np.float32)
    sh[:, 0] = sh_from_rgb(past["colors"][rows].astype(np.float32))
    looks = (past[name][rows].astype(np.float32) for name in ("means", "quats", "log_scales", "opacity_logits"))
    features = np.zeros((len(rows), gmap.features.shape[1]), np.float32)
    return Gaussians(*(torch.from_numpy(array) for array in (*looks, sh, features)))
