"""`QueryMap`, a map that answers queries; `perception.load_map` opens one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.boxes import check_box
from perception.errors import InputError
from perception.geometry import move_points, scale_of
from perception.io.documents import brief
from perception.language.colors import COLOR_NAMES, color_share
from perception.language.encoders import make_encoder
from perception.map.history import Visit, changes_of, is_removed, last_seen, left, stood, visit_number, visits_of
from perception.map.map import InstanceIndex, Map, build_index
from perception.query.hit import Description, Hit, Neighbor
from perception.query.instance_set import InstanceSet
from perception.query.naming import likely_names
from perception.query.nodes import Candidate, Node, Nodes
from perception.query.past import Spot, present, scene
from perception.query.ranking import Ranker, answering
from perception.query.requests import MAX_TOP, TOP, UnknownInstance, check_prompt
from perception.query.text_ranking import Encoders, TextRanking
from perception.query.where import Frame, Where, check_frame, check_length, position_of, wanted_in_map
from perception.types import DepthImage, Lens, OrientedBox, View

if TYPE_CHECKING:
    from perception.localise.localiser import Localised, Localiser
    from perception.query.free_space import FreeSpace

_NEIGHBORS = 3
_LEAST_COLOR = 0.05
_VIEWS = 4  # earlier visits whose scenes are kept in memory


@dataclass(eq=False, repr=False)
class QueryMap(Map):
    """A `Map` with queries. Thread-safe.

    Data is loaded on first use: embeddings and encoder at the first prompt. The map's folder may be replaced meanwhile:
    this object keeps the map that it opened. encoders: makes an encoder from its name in the map's config.

    A method with `frame` takes and returns points, poses, boxes and lengths in that frame. Without it, they are in the
    map's own frame (`frame`), in metres when `metric`. Methods raise InputError for bad arguments and damaged files.

    >>> gmap = perception.load_map("kitchen.gsmap")
    >>> [hit.instance_id for hit in gmap.query("red mug")]
    [0]
    >>> nearest = gmap.nearest([2.0, 0.0, 1.0])[0]  # a point [3] in the map's frame
    >>> nearest.instance_id, 0.7 < nearest.distance < 1.0
    (2, True)
    """

    encoders: Encoders = make_encoder

    def __post_init__(self) -> None:
        self.encoders = lru_cache(self.encoders)  # one for the scenes of all visits
        self._at = lru_cache(_VIEWS)(lambda visit: self._scene(visit, lambda entry: stood(entry, visit)))
        self._visit, self._today = self.newest_visit, self
        self._record: Map | None = None
        if any(map(is_removed, self.instances)):
            self._record = Map.of(self)
            vars(self).update(present(self._record))

    @property
    def record(self) -> Map:
        """The map with its removed instances, which `instances` and all answers but those of `gone` leave out."""
        return self if self._record is None else self._record

    @property
    def problem(self) -> str | None:
        """Why prompts cannot be answered (no embeddings, no encoder), one line; None when they can."""
        try:
            _ = self.ranker
        except InputError as error:
            return str(error)
        return None

    @property
    def ranker(self) -> Ranker:
        """The ranker of instances for prompts; InputError when the map has no embeddings or encoder."""
        return self._ranking.ranker

    @property
    def counts(self) -> dict[str, int]:
        """How much it holds."""
        return {"instances": len(self.instances), "gaussians": int(self.info.get("num_gaussians", 0))}

    def warm(self) -> None:
        """Prepares what the first queries need: spatial index, shape scores, text encoder."""
        _ = self._wholes.spatial
        if self.problem is None and self.instances:
            _ = self.ranker.shapes
            self.query("thing")
            self.gone("thing")

    # --------------------------------------------------------------- questions

    def query(
        self,
        text: str,
        top_k: int = TOP,
        min_score: float | None = None,
        *,
        where: Where | None = None,
        frame: Frame | None = None,
    ) -> list[Hit]:
        """The instances that answer `text` (`ranking.answering`), best first, none, one or up to top_k.

        A part of an instance, or a group of them, is answered where it fits clearly better (see `Hit`). `min_score`:
        the instances with at least this score instead. `where` keeps only instances that fulfil it, and those
        that answer are then decided among these. Raises InputError for an empty or overlong text, and
        for a map without embeddings or whose encoder is not installed.
        """
        text = check_prompt(text, top_k, min_score)
        if not self.instances:
            return []
        ranked, wanted = self._ranking.rank(text), wanted_in_map(where, frame)
        allowed = set(range(len(self.instances)) if where is None else self._fulfilling(wanted))
        found = self._nodes.fitting(text, ranked, wanted) if min_score is None else ranked
        chosen: list[Candidate] = [pair for pair in found if isinstance(pair[0], Node) or pair[0] in allowed]
        answers, whole = answering(chosen, min_score)[:top_k], self._wholes.measured
        hits = (c.hit(score, wanted) if isinstance(c, Node) else whole(c, wanted, score) for c, score in answers)
        return [_in(frame, hit) for hit in hits]

    def find(self, where: Where | None = None, *, frame: Frame | None = None) -> list[Hit]:
        """All instances that fulfil `where`, in the order of instances.json, scored by the mapper's confidence."""
        wanted = wanted_in_map(where, frame)
        return [_in(frame, self._wholes.measured(n, wanted)) for n in self._fulfilling(wanted)]

    def in_box(self, box: OrientedBox, *, share: float = 0.5, frame: Frame | None = None) -> list[Hit]:
        """The instances with at least `share` of their points in `box` (`axis_box`: a box along the axes)."""
        return self.find(Where(region=check_box(box), share=share), frame=frame)

    def nearest(
        self, near: np.ndarray, top_k: int = 1, *, where: Where | None = None, frame: Frame | None = None
    ) -> list[Hit]:
        """The top_k instances nearest to a point [3] or a pose [4, 4] by their nearest point, nearest first, each hit
        with its `distance`. `where` keeps only instances that fulfil it. Raises InputError for top_k below 1."""
        if isinstance(top_k, bool) or not isinstance(top_k, (int, np.integer)) or top_k < 1:
            raise InputError(f"nearest: top_k is {top_k!r}, expected a whole number of at least 1")
        wanted = wanted_in_map(where, frame)
        point = _in_map(near, frame)
        ids = [int(self.instances[n]["id"]) for n in self._fulfilling(wanted)]
        nearest = self._wholes.spatial.nearest(point, top_k, ids)
        return [_in(frame, replace(self.hit(self.position(i)), distance=distance)) for distance, i in nearest]

    def instance_at(
        self, point: np.ndarray, *, max_distance: float | None = None, frame: Frame | None = None
    ) -> Hit | None:
        """The instance that `point` [3] lies on: the one with the nearest point, if that is at most `max_distance`
        away; when None, no farther than the spacing of the instance's points there (see `SpatialIndex.reaches`)."""
        check_length("instance_at: max_distance", max_distance)
        for hit in self.nearest(point, 1, frame=frame):
            if max_distance is not None and hit.distance is not None:
                return hit if hit.distance <= max_distance else None
            return hit if self._wholes.spatial.reaches(hit.instance_id, _in_map(point, frame)) else None
        return None

    def get(self, instance_id: int, *, frame: Frame | None = None) -> Hit:
        """The instance with this id; InputError when there is none."""
        return _in(frame, self.hit(self.position(instance_id)))

    def describe(self, instance_id: int, *, frame: Frame | None = None) -> Description:
        """The properties of an instance: its hit, colours, bounds and the three nearest instances."""
        position = self.position(instance_id)
        hit = _in(frame, self.hit(position))
        scale = 1.0 if frame is None else scale_of(frame.from_map)
        beside = self._wholes.spatial.neighbors(instance_id, _NEIGHBORS)
        labels = {entry["id"]: entry.get("label") for entry in self.instances}
        bounds = np.array([hit.points.min(axis=0), hit.points.max(axis=0)] if len(hit.points) else np.full((2, 3), 0.0))
        return Description(
            hit,
            float(self.instances[position]["score"]),
            bounds.astype(np.float64),
            self._colors(position),
            tuple(Neighbor(i, labels.get(i), gap * scale) for gap, i in beside),
        )

    # ------------------------------------------------------------------ visits

    @cached_property
    def visits(self) -> list[Visit]:
        """The visits that made the map and brought it up to date, oldest first."""
        return visits_of(self.info, len(self.views))

    def changes(self, since: int | str = "last") -> list[dict[str, Any]]:
        """What differs today from what stood as of visit `since`, by default the one before the newest, in the map's
        frame (`history.changes_of`). InputError for a visit that the map does not have."""
        return changes_of(self.visits, self.record.instances, visit_number(self.visits, since))

    def changes_json(self, since: int | str = "last") -> dict[str, Any]:
        """`changes` as JSON, with the visits that they name by number."""
        start = visit_number(self.visits, since)
        facts = {"changes": self.changes(start), "since": start, "visits": [visit.to_json() for visit in self.visits]}
        return {**facts, "frame": self.frame, "metric": self.metric}

    def visits_json(self) -> dict[str, Any]:
        """What answers whose hits name visits hold beside: {"visits"}; {} for a map of one visit."""
        return {"visits": [visit.to_json() for visit in self.visits]} if self.newest_visit else {}

    def at(self, visit: int | str) -> QueryMap:
        """The map as it stood as of a visit, with the points of then: for prompts and all questions about instances.
        Gaussians, free space and photos are today's. InputError for a visit that the map does not have."""
        number = visit_number(self.visits, visit)
        return self if number == self._visit else self._at(number)

    def gone(
        self,
        text: str,
        top_k: int = TOP,
        min_score: float | None = None,
        *,
        where: Where | None = None,
        frame: Frame | None = None,
    ) -> list[Hit]:
        """As `query`, the instances that are gone and answer `text` when they are compared with all others: hits where
        they stood last, with `since` and, where it is known, what they `stood` on."""
        text = check_prompt(text, top_k, min_score)
        spots, hits = self._left, list[Hit]()
        for hit in self.last_known.query(text, MAX_TOP, min_score, where=where, frame=frame) if spots else ():
            if hit.instance_id in spots and len(hits) < top_k:
                entry, spot = spots[hit.instance_id]
                until, seen = spot["until"], last_seen(entry, self.newest_visit)
                by = self.at(until).holders.get(entry["id"])
                hits.append(replace(hit, state="removed", last_seen=min(seen, until), since=until + 1, stood=by))
        return hits

    @cached_property
    def holders(self) -> dict[int, tuple[str, int]]:
        """What holds each instance that something holds, by its id: the relation, "on", "in" or "attached to", and the
        other's id; {} where it is not known which way is up."""
        from perception.query.scene_graph import held_by

        return held_by(self)

    @cached_property
    def _left(self) -> dict[int, tuple[Spot, Spot]]:
        """Of what is gone, by its id: the entry, and the spot that it left."""
        return {e["id"]: (e, spot) for e in self.record.instances if (spot := left(e, self._visit)) is not None}

    @cached_property
    def last_known(self) -> QueryMap:
        """This map, and every instance that it does not have any more where it stood last."""
        if not self._left:
            return self
        return self._scene(self._visit, lambda entry: stood(entry, self._visit) or left(entry, self._visit))

    def _scene(self, visit: int, spot_of: Callable[[Spot], Spot | None]) -> QueryMap:
        fields = scene(self.record, spot_of)
        index = fields.pop("index")
        then = QueryMap.of(self, **fields, encoders=self.encoders)
        vars(then).update(index=index, _record=self.record, _visit=visit, _today=self._today)
        return then

    # ------------------------------------------------------------------ one instance

    def likely_names(self, count: int = 3) -> list[list[str]]:
        """The likeliest names of every instance, best first, in the order of `instances`."""
        return likely_names(self.ranker, count) if self.instances else []

    def hit(self, position: int, score: float | None = None) -> Hit:
        """Entry `position` of instances.json as a Hit; score: the mapper's confidence when None."""
        return self._wholes.hit(position, score)

    def position(self, instance_id: int) -> int:
        """The index of this id in instances.json; UnknownInstance when there is none."""
        try:
            position = self._positions.get(instance_id)
        except TypeError as error:  # a list, an array
            raise UnknownInstance(f"instance: found {brief(instance_id)}, expected a number") from error
        if position is None:
            known = next((e for e in self.record.instances if e["id"] == instance_id), None)
            if known is not None:
                when = f"it was not there at visit {self._visit}; another visit may have seen it"
                raise UnknownInstance(f"instance {instance_id}: {when} (last seen: {last_seen(known, self._visit)})")
            raise UnknownInstance(f"instance {instance_id}: the map has none such; it has {len(self.instances)}")
        return position

    def localise(
        self, photo: str | Path | np.ndarray, lens: Lens | None = None, depth: DepthImage | None = None
    ) -> Localised | None:
        """The pose of a new photo, a file or [H, W, 3] uint8 RGB, in the map's own frame; None where it is not in this
        map (see `Localiser`). lens: if known; depth: scale in the map's unit. The first call reads the map's photos."""
        if isinstance(photo, np.ndarray):
            from perception.localise.reference import write_rgb

            with TemporaryDirectory(prefix="perception-localise-") as folder:
                return self.localise(write_rgb(Path(folder) / "photo.png", photo), lens, depth)
        return self.localiser.localise([Path(photo)], lens, [depth])[0]

    @cached_property
    def localiser(self) -> Localiser:
        """Localises photos, also many together, which is more exact; it holds the features of the map's photos."""
        from perception.localise.localiser import Localiser

        return Localiser(self)

    def best_view(self, instance_id: int) -> tuple[View, tuple[int, int, int, int]] | None:
        """The view that shows the instance best and the tight box (x0, y0, x1, y1) in it, in pixels of the size used
        for training; None when none shows it. InputError for an unknown id."""
        position = self.position(instance_id)
        names = self._wholes.views(position)
        view = next((view for view in self.views if view.name in names[:1]), None)
        return None if view is None else (view, self._wholes.best_box(position))

    # --------------------------------------------------------------- internals

    def _fulfilling(self, where: Where) -> list[int]:
        """Indices in instances.json of the instances that fulfil `where`, which is in the map's frame."""
        return [n for n in range(len(self.instances)) if self._wholes.fulfils(n, where)]

    def _colors(self, position: int) -> tuple[tuple[str, float], ...]:
        """Names of the instance's colours and their shares, from 5 % up, largest first."""
        palettes = self.language.get("palettes")
        if palettes is None:
            return ()
        shares = [(name, float(color_share(palettes[position : position + 1], name)[0])) for name in COLOR_NAMES]
        return tuple(sorted((entry for entry in shares if entry[1] >= _LEAST_COLOR), key=lambda entry: -entry[1]))

    @cached_property
    def index(self) -> InstanceIndex:
        return build_index(self.means, self.instance_ids) if self._record is None else self._record.index

    @cached_property
    def _positions(self) -> dict[int, int]:
        return {int(entry["id"]): n for n, entry in enumerate(self.instances)}

    @cached_property
    def _wholes(self) -> InstanceSet:
        return InstanceSet(self, self.instances, self.language)

    @cached_property
    def _ranking(self) -> TextRanking:
        return TextRanking(self, self.encoders, [entry.get("label") for entry in self.record.instances])

    @cached_property
    def _nodes(self) -> Nodes:
        return Nodes(self, self._wholes, lambda: self.ranker)

    @cached_property
    def free_space(self) -> FreeSpace:
        """Where a robot can be (`robot_pose.where_to_stand`); InputError as `floor_grid`."""
        from perception.query.free_space import FreeSpace

        return FreeSpace(self) if self._today is self else self._today.free_space


def _in(frame: Frame | None, hit: Hit) -> Hit:
    """A hit of the map in `frame`; None: in the map's own."""
    check_frame(frame)
    return hit if frame is None else hit.transformed(frame.from_map, frame.name)


def _in_map(point_or_pose: np.ndarray, frame: Frame | None) -> np.ndarray:
    """The position [3] of a point or pose in `frame`, in the map's frame."""
    position = position_of(point_or_pose)
    return position if frame is None else move_points(frame.to_map, position)
