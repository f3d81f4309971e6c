"""The record of visits in a map, and what changed between two of them.

A visit is one recording of the scene. Visit 0 is the making of the map; `perception update` adds one each time. Numbers
of visits index `visits` of map.json. Keys of an instance in instances.json (all may be missing in maps of one visit):

state            as of the newest visit: "unchanged", "moved" (by this visit), "added" (by it), "removed" (by it or an
                 earlier one) or "unseen" (this visit did not look there)
confidence       of that state, in [0, 1]
first_seen, last_seen, last_looked_for     numbers of visits
hidden_before    true: no photo before first_seen looked where it stands, so that it is not known to have come
past             where it stood before, oldest first: {"until", "centroid", "obb", "aabb", "transform", "ambiguous"}.
                 until: the visit before the one that found it to stand there no more, so entries ascend. transform:
                 [4, 4] that takes points from there to where it stood next (the next entry, else today's spot); null
                 where that is not known, as for a removed thing. ambiguous: another motion, or another thing that looks
                 alike, explains the visit as well, or another turn may show sides of it that no visit saw. axis: [3]
                 about which its turn is not known, as it looks round.
                 "gone": true: it was away until that visit; it has come back since.

A removed instance stays in instances.json and language.npz, with `num_gaussians` 0 and its last box; the last entry of
its `past` is the spot that it left. past.npz holds the means of what stood elsewhere: means [M, 3] float32, ids [M]
int32, until [M] int32 as in `past`; and what it looked like, by which it is known when it comes back: quats [M, 4],
log_scales [M, 3], opacity_logits [M], colors [M, 3] RGB in the light of the newest visit, float16. Zero quats: not
known.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import product
from typing import Any, Literal, get_args

import numpy as np

from perception.errors import InputError
from perception.geometry import move_points, scale_of
from perception.io.json_shapes import Count, Matrix3, Moment, PathText, Point, Pose, Share, Sides

State = Literal["moved", "removed", "added", "unchanged", "unseen"]
STATES = get_args(State)
"""Of an instance between two visits, in the order in which they are listed."""
BACK = 0.05
"""What moved more than once stands where it stood if no corner of its box is farther off than this share of the box's
diagonal."""
OBB = {"center": Point, "rotation": Matrix3, "extent": Sides}
AABB = {"min": Point, "max": Point}
VISIT = {"time": Moment | None, "input": PathText, "photos": Count}
PAST = {
    "until": Count, "centroid": Point, "obb": OBB, "aabb?": AABB, "transform": Pose | None, "ambiguous?": bool,
    "gone?": bool, "axis?": Point,
}  # fmt: skip
RECORD = {
    "state?": State, "confidence?": Share, "first_seen?": Count, "last_seen?": Count, "last_looked_for?": Count,
    "past?": [PAST], "hidden_before?": bool,
}  # fmt: skip
"""Of an instance."""


@dataclass(frozen=True)
class Visit:
    """number: 0 is the making of the map. time: UTC, "2026-11-25T19:41:58Z", None where it is not known; by the clock
    of a camera that does not state its offset. input: path of what was recorded. photos: how many."""

    number: int
    time: str | None
    input: str
    photos: int

    def to_json(self) -> dict[str, Any]:
        """As JSON; the keys of map.json and the number."""
        return dict(vars(self))


def visits_of(info: dict[str, Any], photos: int = 0) -> list[Visit]:
    """The visits of a map, oldest first; info: of `Map`; photos: of a map that lists no visits, which has one."""
    only = {"time": None, "input": info.get("source", ""), "photos": photos}
    return [Visit(n, v["time"], v["input"], v["photos"]) for n, v in enumerate(info.get("visits") or [only])]


def date_of(visits: Sequence[Visit], number: int) -> str:
    """The date of a visit in UTC, with the time of day if another visit has the same date, and its number if that has
    the same time; "visit 2" without a time."""
    days = [datetime.fromisoformat(v.time.removesuffix("Z")) if v.time else None for v in visits]
    if days[number] is None:
        return f"visit {number}"
    for form in ("%Y-%m-%d", "%Y-%m-%d %H:%M"):
        texts = [day.strftime(form) if day else "" for day in days]
        if texts.count(texts[number]) == 1:
            return texts[number]
    return f"{texts[number]} (visit {number})"


def visit_number(visits: Sequence[Visit], text: str | int) -> int:
    """The visit that `text` names: its number, or "last", the one before the newest; InputError when there is none."""
    newest = len(visits) - 1
    number = max(newest - 1, 0) if text == "last" else int(text) if re.fullmatch(r"\d{1,9}", str(text)) else -1
    if not 0 <= number <= newest:
        raise InputError(
            f"visit {str(text)[:20]}: the map has visits 0 to {newest}; give one of these numbers, or last"
        )
    return number


# ------------------------------------------------------------------ one instance at one visit


def is_removed(entry: dict[str, Any]) -> bool:
    """Whether an entry of instances.json stands nowhere today."""
    return entry.get("state") == "removed"


def stood(entry: dict[str, Any], visit: int) -> dict[str, Any] | None:
    """Where an entry stood as of a visit: the entry itself, or one of its `past`; None when it was not there."""
    if entry.get("first_seen", 0) > visit:
        return None
    for spot in entry.get("past", ()):
        if spot["until"] >= visit:
            return None if spot.get("gone") else spot
    return None if is_removed(entry) else entry


def left(entry: dict[str, Any], visit: int) -> dict[str, Any] | None:
    """The last spot of an entry that stood nowhere as of a visit, of its `past`; None when it stood, or never had."""
    if stood(entry, visit) is not None:
        return None
    earlier = (spot for spot in reversed(entry.get("past", [])) if spot["until"] < visit and not spot.get("gone"))
    return next(earlier, None)


def since(entry: dict[str, Any]) -> int:
    """The visit that first found an entry where it is today; that first missed it, if it is removed."""
    past = entry.get("past")
    return int(past[-1]["until"]) + 1 if past else int(entry.get("first_seen", 0))


def last_seen(entry: dict[str, Any], newest: int) -> int:
    """The visit at which an entry was seen last; maps of one visit do not record it."""
    return int(entry.get("last_seen", newest if entry.get("state") not in ("removed", "unseen") else 0))


# ------------------------------------------------------------------ changes


def changes_of(visits: Sequence[Visit], instances: list[dict[str, Any]], start: int) -> list[dict[str, Any]]:
    """What differs between the scene as of visit `start` and today, by `STATES`, then in the order of `instances`.

    One dict per instance that stood then or stands today: state, instance_id, label, confidence, old_centroid,
    new_centroid (None where it stood or stands nowhere), transform ([4, 4] new_from_old, None where it is not known),
    last_seen (number of a visit); of a moved or removed one also since (the visit that found it so), ambiguous, axis.
    unseen: no visit after `start` saw it, and none missed it. confidence: that of the newest visit.
    """
    changes = [change for entry in instances if (change := _change(entry, start, len(visits) - 1)) is not None]
    return sorted(changes, key=lambda change: STATES.index(change["state"]))


def _change(entry: dict[str, Any], start: int, newest: int) -> dict[str, Any] | None:
    known = max(start, entry["first_seen"]) if entry.get("hidden_before") else start
    before, after = stood(entry, known), None if is_removed(entry) else entry
    if before is None and after is None:
        return None
    later = [spot for spot in entry.get("past", ()) if spot["until"] >= start]
    seen, motion = last_seen(entry, newest), _motion(later)
    if before is None:
        state = "added"
    elif after is None:
        state = "removed"
    elif later and not (len(later) > 1 and _is_back(entry, later, motion)):
        state = "moved"
    else:
        state = "unchanged" if seen >= min(start + 1, newest) else "unseen"
    change = {
        "state": state,
        "instance_id": entry["id"],
        "label": entry.get("label"),
        "confidence": entry.get("confidence"),
        "old_centroid": None if before is None else before["centroid"],
        "new_centroid": None if after is None else after["centroid"],
        "transform": motion if state == "moved" else None,
        "last_seen": seen,
    }
    if state in ("moved", "removed"):
        change["since"] = since(entry)
        change["ambiguous"] = any(spot.get("ambiguous", False) for spot in later)
        change["axis"] = next((spot["axis"] for spot in reversed(later) if "axis" in spot), None)
    return change


def change_in(a_from_b: np.ndarray, change: dict[str, Any]) -> dict[str, Any]:
    """A change of `changes_of` in frame a, from frame b; a_from_b [4, 4]: a similarity."""
    moved = dict(change)
    for key in ("old_centroid", "new_centroid"):
        if change[key] is not None:
            moved[key] = move_points(a_from_b, np.array(change[key])).tolist()
    if change["transform"] is not None:
        moved["transform"] = (a_from_b @ np.array(change["transform"]) @ np.linalg.inv(a_from_b)).tolist()
    if change.get("axis") is not None:
        moved["axis"] = (a_from_b[:3, :3] @ np.array(change["axis"]) / scale_of(a_from_b)).tolist()
    return moved


def _motion(spots: Iterable[dict[str, Any]]) -> list[list[float]] | None:
    """The transforms of successive spots as one, [4, 4] now_from_then; None when one is not known."""
    whole = np.eye(4)
    for spot in spots:
        if spot["transform"] is None:
            return None
        whole = np.array(spot["transform"], np.float64) @ whole
    return whole.tolist()


def _is_back(entry: dict[str, Any], spots: Sequence[dict[str, Any]], motion: list[list[float]] | None) -> bool:
    """Whether an entry stands where it stood before it moved over `spots`, as far as `motion` [4, 4] is known."""
    if motion is None or any(spot.get("ambiguous") for spot in spots):
        return False
    box = entry["obb"]
    sides = np.array(list(product((-0.5, 0.5), repeat=3))) * box["extent"]
    corners = sides @ np.array(box["rotation"]).T + box["center"]
    off = np.linalg.norm(move_points(np.array(motion), corners) - corners, axis=1).max()
    return bool(off <= BACK * np.linalg.norm(box["extent"]))


# ------------------------------------------------------------------ edits


def joined_record(entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The record of one thing that is made of others, {} where there is none: first and last visits, and the state that
    all share, else "unchanged"; without past, so nothing that is made of others has moved."""
    if any("state" not in entry for entry in entries):
        return {}
    states = {entry["state"] for entry in entries}
    state = states.pop() if len(states) == 1 and states != {"moved"} else "unchanged"
    record: dict[str, Any] = {"state": state}
    for key, choose in (("confidence", min), ("first_seen", min), ("last_seen", max), ("last_looked_for", max)):
        if values := [entry[key] for entry in entries if key in entry]:
            record[key] = choose(values)
    hidden = all(entry.get("hidden_before") for entry in entries)
    return {**record, "hidden_before": True} if hidden and entries else record


def past_of(past: dict[str, np.ndarray], instances: Iterable[dict[str, Any]]) -> dict[str, np.ndarray]:
    """The rows of past.npz that belong to a spot of these instances."""
    if not past:
        return {}
    spots = {(entry["id"], spot["until"]) for entry in instances for spot in entry.get("past", ())}
    rows = [pair in spots for pair in zip(past["ids"].tolist(), past["until"].tolist(), strict=True)]
    return {name: array[rows] for name, array in past.items()} if any(rows) else {}


# ------------------------------------------------------------------ checks


def check_record(entry: dict[str, Any], visits: int) -> None:
    """ValueError unless the record of an entry, whose shape is right, fits a map of so many visits."""
    name = f"instance {entry['id']}"
    for key in ("first_seen", "last_seen", "last_looked_for"):
        if entry.get(key, 0) >= visits:
            raise ValueError(f"{key}: that of {name} is visit {entry[key]}, the map has {visits}")
    ends = [spot["until"] for spot in entry.get("past", ())]
    if ends != sorted(set(ends)) or (ends and ends[-1] >= visits - 1):
        raise ValueError(f"past: until of {name} is {ends[:9]}, expected ascending visits below {visits - 1}")
    if entry.get("state") == "moved" and ends[-1:] != [visits - 2]:
        raise ValueError(f"past: {name} was moved by visit {visits - 1}, and no entry with until {visits - 2} is last")
    bare = not entry["num_gaussians"] and not entry.get("parts")
    if is_removed(entry) and not (bare and ends and not entry["past"][-1].get("gone")):
        raise ValueError(f"past: {name} is removed, so it has the spot that it left, no Gaussians and no parts")
