"""The viewer's state, without any browser: an edited map, a prompt and its hits, a selection, colours."""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from perception.colors import instance_palette, rgb8_from_sh
from perception.edit.editor import Editor
from perception.errors import InputError
from perception.language.encoders import make_encoder
from perception.map.write import Map
from perception.pictures import features_to_rgb
from perception.query import Hit, QueryMap
from perception.query.crops import OUTSIDE, PhotoOutside, best_crop
from perception.viewer.picking import pick, pick_point

MODES = ("photo", "instances", "parts", "features", "changes")
"""Colours of the Gaussians; the last only in maps of several visits."""
STATE_COLORS = {"moved": (50, 110, 255), "added": (40, 200, 80), "removed": (235, 60, 50), "unseen": (70, 70, 80)}
"""Of things by the newest visit, over the colours of the photos, which are those of what is unchanged."""
LEGEND = "blue: moved · green: new · dark: nobody looked · red points: where a thing stood"
HIGHLIGHT = np.array([255, 214, 10], np.uint8)


def paint(gmap: Map, ids: np.ndarray, mode: str) -> np.ndarray:
    """[N, 3] uint8 colours in a mode of MODES; ids [N]: instance (or part) of each Gaussian, −1 = none (grey)."""
    if mode in ("instances", "parts"):
        return instance_palette(ids)
    if mode == "features":
        return features_to_rgb(gmap.features[None])[0]
    return rgb8_from_sh(gmap.sh[:, 0])  # the part that does not depend on the view


def highlight(colors: np.ndarray, ids: np.ndarray, chosen: Collection[int]) -> np.ndarray:
    """colors [N, 3] with the chosen instances in HIGHLIGHT's hue and all others dimmed; unchanged if none is chosen."""
    if not chosen:
        return colors
    lit = np.isin(ids, list(chosen))
    dimmed = (0.35 * colors + 28).astype(np.uint8)
    glowing = (0.35 * colors + 0.65 * HIGHLIGHT).astype(np.uint8)
    return np.asarray(np.where(lit[:, None], glowing, dimmed))


CROP_SIDE = 320  # pixels of the longer side of the photo shown beside a selected instance


class Session:
    """The state shared by all browsers of one viewer, which see the same map. Not for concurrent threads."""

    def __init__(self, path: Path, photos: Path | None = None):
        """photos: a folder where photos may be read beside the map's own (see `best_crop`)."""
        self.editor = Editor(path)
        self.photos = photos
        self.mode = "photo"
        self.selected: list[int] = []
        self.part: int | None = None
        self.question = ""
        self.hits: list[Hit] = []
        self.gone: list[Hit] = []
        self.measuring, self.ends, self.notes = False, list[np.ndarray](), list[str]()
        self._encoders = lru_cache(make_encoder)  # one for the maps of all edits
        self._opened: QueryMap | None = None

    def _loaded(self) -> QueryMap:
        if self._opened is None:
            self._opened = QueryMap.of(self.editor.current(), encoders=self._encoders)
        return self._opened

    def ask(self, text: str, top_k: int = 5) -> list[Hit]:
        """Ranked hits, which are then highlighted; empty when the text is not present. None is hidden."""
        hidden = {entry["id"] for entry in self.editor.instances if entry.get("hidden")}
        hits = self._loaded().query(text, top_k + len(hidden))
        self.gone = self._loaded().gone(text, top_k)
        self.question = " ".join(text.split())
        self.hits = [hit for hit in hits if hidden.isdisjoint((hit.instance_id, *hit.instances))][:top_k]
        self.select(None)
        for hit in self.hits[:1]:
            self.show_hit(hit)
        return self.hits

    def show_hit(self, hit: Hit) -> None:
        """Selects the instance of a hit, all those of a group; a part is highlighted."""
        self.select(hit.instance_id)
        self.selected, self.part = list(hit.instances or self.selected), hit.part

    def select(self, instance: int | None, add: bool = False) -> None:
        """Selects an instance, or with `add` toggles it in the selection. None clears the selection, unless `add`."""
        before, clicked = self.selected if add else [], [] if instance is None else [instance]
        self.selected = [i for i in before if i != instance] + [i for i in clicked if i not in before]
        self.part = None

    def clear(self) -> None:
        """Clears the question, its hits and the selection."""
        self.hits, self.gone, self.question = [], [], ""
        self.select(None)

    def pick(self, origin: np.ndarray, direction: np.ndarray, add: bool = False) -> int | None:
        """Selects the instance that a ray in the map frame shows, and returns its id.
        After `measure`, the point that it shows becomes an end of the length; InputError when it shows none."""
        if self.measuring:
            end = pick_point(self.editor.original, self.shown(), origin, direction)
            if end is None:
                raise InputError("measure: there is nothing at that place; click on the map")
            self.ends.append(end)
            self.measuring = len(self.ends) < 2
            return None
        instance = pick(self.editor.original, self.editor.ids, self.shown(), origin, direction)
        self.select(instance, add)
        return instance

    def chosen(self) -> int:
        """The one selected instance; raises InputError when none or several are."""
        if len(self.selected) != 1:
            raise InputError(f"{len(self.selected)} instances are selected; click exactly one")
        return self.selected[0]

    def measure(self) -> None:
        """Makes the next two clicks the ends of a length."""
        self.measuring, self.ends, self.notes = True, [], []

    @property
    def length(self) -> str:
        """The distance of the two ends as text, with the map's unit; empty before both are there."""
        unit = "m" if self.editor.original.metric else "map units"
        return f"{np.linalg.norm(self.ends[1] - self.ends[0]):.4g} {unit}" if len(self.ends) == 2 else ""

    def set_scale(self, metres: float) -> None:
        """Writes the map in metres, by the true distance of the two ends (`Editor.set_scale`); fills `notes`."""
        if len(self.ends) < 2:
            raise InputError("measure: press Two points, then click both ends of a length that you know")
        ends = " ".join(",".join(repr(float(x)) for x in end) for end in self.ends)
        facts = self.editor.set_scale(f"{float(metres)!r}: {ends}")
        self.ends, self.notes = [facts["factor"] * end for end in self.ends], facts["notes"]

    def show_all(self) -> None:
        """Shows the hidden instances again."""
        for entry in self.editor.instances:
            if entry.get("hidden"):
                self.editor.hide(entry["id"], False)

    def edited(self) -> None:
        """To be called after an edit: removes what no longer exists from the selection and the hits."""
        self._opened = None
        known = {entry["id"] for entry in self.editor.instances}
        parts = {part["id"] for entry in self.editor.instances for part in entry.get("parts", [])}
        self.selected = [instance for instance in self.selected if instance in known]
        self.part = self.part if self.part in parts else None
        self.gone = [hit for hit in self.gone if hit.instance_id in known]
        self.hits = [
            hit
            for hit in self.hits
            if known.issuperset((hit.instance_id, *hit.instances)) and hit.part in {None, *parts}
        ]

    def reopen(self) -> None:
        """Opens the map that another program changed; unsaved edits are dropped."""
        self.editor.reopen()
        self.measuring, self.ends, self.notes = False, [], []
        self.edited()

    def shown(self) -> np.ndarray:
        """[N] bool: Gaussians of no hidden instance."""
        hidden = [entry["id"] for entry in self.editor.instances if entry.get("hidden")]
        return ~np.isin(self.editor.ids, hidden)

    def colors(self) -> np.ndarray:
        """[N, 3] uint8 in the current mode, with the selection (or the hits) highlighted."""
        ids, parts = self.editor.ids, self.editor.part_ids
        shown = self.finest_ids() if self.mode == "parts" else ids
        colors = paint(self.editor.original, shown, self.mode)
        for entry in self.editor.instances if self.mode == "changes" else ():
            if (color := STATE_COLORS.get(entry.get("state", ""))) is not None:
                own = ids == entry["id"]
                colors[own] = (0.4 * colors[own] + 0.6 * np.array(color)).astype(np.uint8)
        if self.part is not None:
            return highlight(colors, parts, [self.part])
        return highlight(colors, ids, self.lit())

    def ghosts(self) -> np.ndarray:
        """[M, 3] float32 points of what the newest visit found moved or gone, where it stood before; in the mode
        "changes" only."""
        past, newest = self.editor.current().past, self.editor.original.newest_visit
        rows = past["until"] == newest - 1 if past and self.mode == "changes" else []
        return past["means"][rows] if len(rows) else np.zeros((0, 3), np.float32)

    def finest_ids(self) -> np.ndarray:
        """[N] the part of each Gaussian, else its instance, −1 = none: what is never shown in one colour."""
        return np.where(self.editor.part_ids >= 0, self.editor.part_ids, self.editor.ids)

    def lit(self) -> list[int]:
        """The highlighted instances: the selected ones, else those of all hits; empty when there are neither."""
        return self.selected or [i for hit in self.hits for i in hit.instances or (hit.instance_id,)]

    def opacities(self) -> np.ndarray:
        """[N] float32 opacities; 0 for Gaussians that are not shown."""
        return np.where(self.shown(), self.editor.original.opacities, 0).astype(np.float32)

    def name(self, entry: dict[str, Any]) -> str:
        """The name of an instance in the viewer: its label, else its id."""
        return entry.get("label") or f"instance {entry['id']}"

    def crop(self, instance: int) -> tuple[np.ndarray | None, str]:
        """The crop of an instance from its best photo, None when no photo of it can be read; why it may not be read."""
        try:
            return best_crop(self._loaded(), instance, CROP_SIDE, self.photos), ""
        except PhotoOutside:
            return None, OUTSIDE
        except InputError:
            return None, ""
