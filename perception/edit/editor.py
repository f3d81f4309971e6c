"""Manual corrections of a map: rename, hide, merge, split, remove; with undo, redo and save.

An `Editor` holds one opened map. Edits change memory only; `save` writes the map to a new folder and swaps it in.
Thread-safe: each edit is one step under a lock, so it is applied completely or not at all. A map that another program
changed meanwhile is not overwritten.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from perception.boxes import instance_entry
from perception.config import FrameConfig, InstanceConfig
from perception.edit.scale import scale_map
from perception.errors import InputError
from perception.io.json_shapes import LARGEST
from perception.language.description import InstanceDescription, chosen_rows, from_arrays, to_arrays
from perception.map.files import map_signature, read_info
from perception.map.history import is_removed, joined_record, past_of
from perception.map.map import Map, language_in, prefixed
from perception.map.replace import writing
from perception.map.write import read_map, tidy_label, write_map

UNDO_DEPTH = 100

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class _State:
    """One state of the edit history; arrays are never changed in place, so states share the unchanged ones."""

    what: str
    ids: np.ndarray
    instances: tuple[dict[str, Any], ...]
    descriptions: tuple[InstanceDescription, ...]


def _step(method: F) -> F:
    @wraps(method)
    def locked(self: Editor, *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            return method(self, *args, **kwargs)

    return locked  # type: ignore[return-value]


class Editor:
    """A map and its edit history. Instances are named by their `id`, which never changes; merged ones get a new id,
    which nothing else had before, in this map or the ones that it was made from.

    Edits raise InputError for an id that the map does not have.

    >>> editor = Editor(Path("kitchen.gsmap"))
    >>> editor.rename(1, "breakfast")
    >>> editor.merge([2, 3])
    9
    >>> editor.undo()
    'merged 2, 3 into 9'
    >>> editor.save()
    >>> perception.load_map("kitchen.gsmap").get(1).label
    'breakfast'
    """

    def __init__(self, path: Path):
        self.path = Path(path) if Path(path).name else Path(path).absolute()
        self._lock = threading.RLock()
        self._next = 0  # above all ids that were ever given here
        self.reopen()

    @_step
    def reopen(self) -> None:
        """Opens the map that is on disk now. Unsaved edits and the history are dropped."""
        read_info(self.path)  # its error is the clearest when there is no map
        self._signature = map_signature(self.path)
        self.original = gmap = read_map(self.path)
        descriptions, self._encoder = from_arrays(gmap.language) if gmap.language else ([], "")
        self._past = [_State("opened", gmap.instance_ids, tuple(gmap.instances), tuple(descriptions))]
        self._future: list[_State] = []
        self._saved = self._past[0]
        self._next = max(self._next, gmap.next_id)

    # ------------------------------------------------------------------ reading

    @property
    def _now(self) -> _State:
        return self._past[-1]

    @property
    def instances(self) -> tuple[dict[str, Any], ...]:
        """The entries of instances.json in their current state."""
        return self._now.instances

    @property
    def ids(self) -> np.ndarray:
        """[N] int32 instance of every Gaussian of the opened map, −1 = none."""
        return self._now.ids

    @property
    def part_ids(self) -> np.ndarray:
        """[N] part of every Gaussian as opened, −1 = none; without the parts of merged, split or removed instances."""
        ids = self.original.parts.get("ids")
        return np.full(len(self.ids), -1) if ids is None else np.where(np.isin(ids, self._known_parts()), ids, -1)

    def _known_parts(self) -> list[int]:
        return [part["id"] for entry in self.instances for part in entry.get("parts", [])]

    @property
    def dirty(self) -> bool:
        """Whether there are unsaved edits."""
        return self._now is not self._saved

    @property
    def history(self) -> list[str]:
        """Descriptions of the edits, oldest first."""
        return [state.what for state in self._past[1:]]

    def entry(self, instance: int) -> dict[str, Any]:
        """The entry of instance id `instance`; raises InputError when there is none."""
        return self.instances[self._row(instance)]

    def _row(self, instance: int) -> int:
        for row, entry in enumerate(self.instances):
            if entry["id"] == instance:
                return row
        raise InputError(f"instance {instance}: not in {self.path}; expected one of its {len(self.instances)} ids")

    def _present_row(self, instance: int) -> int:
        row = self._row(instance)
        if is_removed(self.instances[row]):
            raise InputError(f"instance {instance}: is gone, nothing of it stands there; choose another one")
        return row

    @_step
    def current(self) -> Map:
        """The edited map."""
        now = self._now
        same = [entry["id"] for entry in now.instances] == [entry["id"] for entry in self.original.instances]
        return dataclasses.replace(
            self.original,
            instance_ids=now.ids,
            membership=np.where(now.ids >= 0, self.original.membership, 0).astype(np.float32),
            instances=list(now.instances),
            info={**self.original.info, "next_id": self._next},
            language=to_arrays(now.descriptions, self._encoder) if self._encoder else {},
            parts=self._parts_now(),
            groups=self.original.groups if same else {},
            past=past_of(self.original.past, now.instances),
        )

    def _parts_now(self) -> dict[str, np.ndarray]:
        """The arrays of parts.npz, without the parts of instances that were merged, split or removed."""
        parts = self.original.parts
        if "ids" not in parts:
            return parts
        kept = np.isin(np.unique(parts["ids"][parts["ids"] >= 0]), self._known_parts())
        if not kept.all():
            parts = prefixed(chosen_rows(language_in(parts), np.flatnonzero(kept).tolist()))
        return {**parts, "ids": self.part_ids.astype(np.int32)}

    # ------------------------------------------------------------------ editing

    def _push(self, what: str, **changes: Any) -> None:
        self._past.append(dataclasses.replace(self._now, what=what, **changes))
        self._future.clear()
        del self._past[: max(0, len(self._past) - UNDO_DEPTH)]

    def _change(self, what: str, instance: int, **values: Any) -> None:
        row = self._row(instance)
        instances = list(self.instances)
        instances[row] = {**instances[row], **values}
        self._push(what, instances=tuple(instances))

    @_step
    def rename(self, instance: int, label: str | None) -> None:
        """Sets the user's label of an instance; an empty label or None removes it."""
        label = tidy_label(label) if label and label.strip() else None
        self._change(f"named {instance} '{label}'" if label else f"took the name of {instance}", instance, label=label)

    @_step
    def hide(self, instance: int, hidden: bool = True) -> None:
        """Marks an instance as hidden or visible in the viewer; it stays in the map."""
        self._change(f"{'hid' if hidden else 'showed'} {instance}", instance, hidden=hidden)

    @_step
    def merge(self, chosen: list[int]) -> int:
        """Joins instances into one with a new id, which is returned; it keeps the first label among them. Where they
        stood at earlier visits is dropped."""
        chosen = sorted(set(chosen))
        if len(chosen) < 2:
            raise InputError(f"merge: found {len(chosen)} instance, expected at least 2; choose another one to join")
        rows = [self._present_row(instance) for instance in chosen]
        if not np.isin(self.ids, chosen).any():
            raise InputError(f"merge: {', '.join(map(str, chosen))} have no Gaussians; choose others")
        new = self._new_ids(1)
        ids = np.where(np.isin(self.ids, chosen), new, self.ids).astype(np.int32)
        entries = [self.instances[row] for row in rows]
        weights = np.array([entry["num_gaussians"] for entry in entries], np.float64)
        label = next((entry["label"] for entry in entries if entry.get("label")), None)
        score = float(weights @ [entry["score"] for entry in entries] / weights.sum())
        merged = self._entry(new, ids, score, max(int(entry.get("views", 0)) for entry in entries), label)
        merged |= joined_record(entries)
        if texts := [text for entry in entries for text in entry.get("texts", [])]:
            merged["texts"] = texts
        self._replace(f"merged {', '.join(map(str, chosen))} into {new}", rows, ids, [merged])
        return new

    @_step
    def split(self, instance: int) -> list[int]:
        """Splits an instance into new ones; returns their ids. Raises InputError when it cannot be split.

        The parts in the map's hierarchy are used where the instance has any. Otherwise its Gaussians alone are
        clustered by their features again, with finer settings. Where it stood at earlier visits is dropped.
        """
        row = self._present_row(instance)
        own, entry = np.flatnonzero(self.ids == instance), self.instances[row]
        part = self._parts_of(entry, own)
        if part.max(initial=-1) < 1:
            raise InputError(f"instance {instance}: its Gaussians are all alike, there is nothing to split")
        first = self._new_ids(int(part.max()) + 1)
        ids = self.ids.copy()
        known, means = part >= 0, self.original.means[own]
        ids[own] = np.where(known, part, part[known][cKDTree(means[known]).query(means)[1]]) + first
        new_ids = list(range(first, first + int(part.max()) + 1))
        record = joined_record([entry])
        parts = [self._entry(new, ids, entry["score"], entry.get("views", 0)) | record for new in new_ids]
        self._replace(f"split {instance} into {len(parts)}", [row], ids, parts)
        return new_ids

    @_step
    def remove(self, instance: int) -> None:
        """Removes an instance from the list, with its history; its Gaussians stay and belong to no instance."""
        ids = np.where(self.ids == instance, -1, self.ids).astype(np.int32)
        self._replace(f"removed {instance}", [self._row(instance)], ids, [])

    @_step
    def undo(self) -> str | None:
        """Undoes the last edit; returns its description, None when there is none."""
        if len(self._past) < 2:
            return None
        state = self._past.pop()
        self._future.append(state)
        return state.what

    @_step
    def redo(self) -> str | None:
        """Repeats the edit that was undone last; returns its description, None when there is none."""
        if not self._future:
            return None
        self._past.append(self._future.pop())
        return self._now.what

    @property
    @_step
    def outdated(self) -> bool:
        """Whether another program changed the map since it was opened or saved; InputError when it is missing."""
        return map_signature(self.path) != self._signature

    @_step
    def save(self) -> None:
        """Writes the edited map over the old one; InputError if another program changed that meanwhile."""
        with writing(self.path):
            if self.outdated:
                raise InputError(
                    f"{self.path}: was changed by another program since it was opened; nothing is saved: open it again "
                    "and repeat the corrections"
                )
            write_map(self.path, self.current(), keep_report=True)
            self._signature = map_signature(self.path)
        self._saved = self._now

    @_step
    def rescue(self) -> Path | None:
        """Writes the map with its unsaved edits beside it, for a program that ends; its path, None without any."""
        if not self.dirty:
            return None
        number = next(n for n in range(1, LARGEST) if not self._rescued(n).exists())
        write_map(self._rescued(number), self.current(), fresh=True)
        return self._rescued(number)

    def _rescued(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.stem}.unsaved-{number}{self.path.suffix}")

    @_step
    def set_scale(self, known_length: str) -> dict[str, Any]:
        """Writes the map in metres by `scale_map`, whose result is returned, and opens it anew without history.

        InputError as `save`, with unsaved edits, or when the map's own scale is more certain.
        """
        with writing(self.path):
            if self.dirty or self.outdated:
                found = "unsaved corrections; save them" if self.dirty else "changes by another program; open it"
                raise InputError(f"{self.path}: has {found} first, then set the scale")
            facts = scale_map(self.path, None, FrameConfig(known_length=known_length), improve=True)
            self.reopen()
        return facts

    # ------------------------------------------------------------------ helpers

    def _parts_of(self, entry: dict[str, Any], rows: np.ndarray) -> np.ndarray:
        """[R] index of the part of each Gaussian of an instance, from 0; −1 = none."""
        from perception.instances.cluster import cluster_gaussians

        gmap = self.original
        if entry.get("parts") and "ids" in gmap.parts:
            own = gmap.parts["ids"][rows]
            known = np.unique(own[np.isin(own, [part["id"] for part in entry["parts"]])])
            return np.where(np.isin(own, known), np.searchsorted(known, own), -1)
        finer = InstanceConfig(min_cluster_size=max(8, len(rows) // 20), min_samples=8)
        return cluster_gaussians(gmap.means[rows], gmap.scales[rows], gmap.opacities[rows], gmap.features[rows], finer)

    def _new_ids(self, count: int) -> int:
        """The first of `count` new ids in a row."""
        if self._next + count - 1 > LARGEST:
            raise InputError(f"{self.path}: ids go up to {LARGEST}; there are not {count} left for other instances")
        return self._next

    def _entry(self, instance: int, ids: np.ndarray, score: float, views: int, label: Any = None) -> dict[str, Any]:
        gmap, rows = self.original, ids == instance
        points, weights = gmap.means[rows].astype(np.float64), gmap.opacities[rows].astype(np.float64)
        return instance_entry(instance, points, weights, score, views, label)

    def _replace(self, what: str, rows: list[int], ids: np.ndarray, new: list[dict[str, Any]]) -> None:
        """Replaces the entries in `rows` by `new`, which are inserted at the first of these rows, each with the joined
        description of the replaced."""
        now, first = self._now, min(rows)

        def spliced(old: Sequence[Any], inserted: list[Any]) -> tuple[Any, ...]:
            later = (value for row, value in enumerate(old) if row > first and row not in rows)
            return (*old[:first], *inserted, *later)

        descriptions = now.descriptions
        if descriptions:
            descriptions = spliced(descriptions, [_joined([descriptions[row] for row in rows])] * len(new))
        self._next = max([self._next, *(entry["id"] + 1 for entry in new)])
        self._push(what, ids=ids, instances=spliced(now.instances, new), descriptions=descriptions)


def _joined(descriptions: list[InstanceDescription]) -> InstanceDescription:
    """One description of several instances: all views, their mean embedding, the palette of the one with most views."""
    if len(descriptions) == 1:
        return descriptions[0]
    best = max(descriptions, key=lambda d: len(d.views))
    total = np.sum([d.embedding * len(d.views) for d in descriptions], axis=0)
    norm = float(np.linalg.norm(total))
    return InstanceDescription(
        (total / norm if norm > 0 else best.embedding).astype(np.float32),
        np.concatenate([d.per_view for d in descriptions]),
        best.palette,
        [name for d in descriptions for name in d.views],
        [box for d in descriptions for box in d.boxes],
    )
