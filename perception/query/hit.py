"""The result types of queries: Hit, Neighbor, Description."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from perception.boxes import move_box
from perception.geometry import check_similarity, move_points, scale_of
from perception.types import OrientedBox


class _Points:
    """The field `points`: an array, or a function that is called when they are first read."""

    def __get__(self, hit: Hit, owner: type) -> np.ndarray:
        if callable(points := hit.__dict__["_points"]):
            points = hit.__dict__["_points"] = points()
        return np.asarray(points)

    def __set__(self, hit: Hit, points: np.ndarray | Callable[[], np.ndarray]) -> None:
        hit.__dict__["_points"] = points


@dataclass(frozen=True, eq=False)
class Hit:
    """One instance in the result of a query.

    points: [P, 3] float32, read-only, the means of its Gaussians. centroid: [3] float64, weighted by opacity.
    obb: oriented bounding box of the points. covariance: [3, 3] float64 of the points about their mean, divided by P.
    score: in [0, 1]; for a text prompt how well the instance matches, else the mapper's confidence. views: the photos
    that show it best, best first. distance: from the query's position to the nearest point; None without either.
    part: id of the part that fits better than its instance; instances: ids of the group that fits better than its
    members; points, box and colours are then the part's or the group's. colors(): [P, 3] uint8 of the points, read when
    called; None where they are not known. All of it is in `frame`, in metres when the map is metric.

    In a map of several visits (see `map.history`): state as of the newest visit ("unchanged", "moved", "added",
    "removed" or "unseen"), last_seen: the visit that saw it last, since: the visit that first found it here, or missed
    it (removed; the hit is then where it stood), was: [3] centroid of the spot that it left, if any, and stood: the
    relation and the id of what held a removed thing ("on", 5). None in other maps, and for parts and groups.

    A hit of a store also has the path of its `map`, `map_id`, and whether that is `metric`. Its points are read from
    the map's folder when asked for: InputError when that is gone or holds another map.

    >>> mug = perception.load_map("kitchen.gsmap").query("red mug")[0]
    >>> mug.instance_id, mug.label, mug.frame, mug.points.shape == (mug.num_points, 3)
    (0, None, 'map', True)
    >>> bool(np.allclose(mug.centroid, 0, atol=0.05) and (mug.obb.extent < 0.6).all())
    True
    """

    instance_id: int
    score: float
    points: np.ndarray
    centroid: np.ndarray
    obb: OrientedBox
    label: str | None = None
    views: tuple[str, ...] = ()
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    frame: str = "map"
    distance: float | None = None
    part: int | None = None
    instances: tuple[int, ...] = ()
    colors: Callable[[], np.ndarray] | None = field(default=None, repr=False, compare=False)
    map: str | None = None
    map_id: str | None = None
    metric: bool | None = None
    count: int | None = None
    state: str | None = None
    last_seen: int | None = None
    since: int | None = None
    was: np.ndarray | None = None
    stood: tuple[str, int] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """For pickle and deepcopy: points and colours as they are read now, and nothing of the map."""
        colors = None if self.colors is None else partial(np.asarray, self.colors())
        return {**vars(self), "_points": self.points, "colors": colors}

    @property
    def num_points(self) -> int:
        """P, without reading the points where it is known."""
        return len(self.points) if self.count is None else self.count

    def transformed(self, a_from_b: np.ndarray, frame: str | None = None) -> Hit:
        """The same hit in frame a, given a_from_b [4, 4] (rigid or similarity) from the frame it is in now.

        `frame` names a. Raises InputError when a_from_b shears or mirrors.
        """
        moved = check_similarity(a_from_b)
        linear, scale = moved[:3, :3], scale_of(moved)
        points = move_points(moved, self.points)
        points.setflags(write=False)
        return replace(
            self,
            points=points,
            centroid=move_points(moved, np.asarray(self.centroid, np.float64)),
            obb=move_box(moved, self.obb),
            covariance=linear @ self.covariance @ linear.T,
            frame=self.frame if frame is None else frame,
            was=None if self.was is None else move_points(moved, np.asarray(self.was, np.float64)),
            distance=None if self.distance is None else self.distance * scale,
            metric=self.metric and abs(scale - 1) < 1e-6,
        )

    def to_open3d(self) -> Any:
        """The points as an `open3d.t.geometry.PointCloud` in `frame`: positions, colors (float32 in [0, 1], if known),
        instance_id (int32). InputError without the package open3d."""
        from perception.io.open3d import tensor_cloud

        ids = np.full(len(self.points), self.instance_id, np.int32)
        return tensor_cloud(self.points, None if self.colors is None else self.colors(), ids)

    def to_json(self) -> dict[str, Any]:
        """The hit as JSON, as in `perception query --json`."""
        answer: dict[str, Any] = {
            "instance_id": self.instance_id,
            "score": round(float(self.score), 4),
            "num_points": self.num_points,
            "centroid": [float(x) for x in self.centroid],
            "obb": self.obb.to_json(),
            "label": self.label,
            "views": list(self.views),
            "covariance": [[float(x) for x in row] for row in self.covariance],
        }
        answer |= {} if self.part is None else {"part": self.part}
        answer |= {"instances": list(self.instances)} if self.instances else {}
        if self.state is not None:
            answer |= {"state": self.state, "last_seen": self.last_seen, "since": self.since}
            answer |= {} if self.was is None else {"was": [float(x) for x in self.was]}
            answer |= {} if self.stood is None else {"stood": dict(zip(("relation", "other"), self.stood, strict=True))}
        if self.map is not None:
            answer |= {"map": self.map, "map_id": self.map_id, "frame": self.frame, "metric": self.metric}
        return answer if self.distance is None else {**answer, "distance": float(self.distance)}


def answer_json(text: str, hits: Sequence[Hit], gone: Sequence[Hit]) -> dict[str, Any]:
    """The answer to a prompt as an entry of `results` in the JSON output; gone: of `QueryMap.gone`."""
    answer = {"text": text, "present": bool(hits), "hits": [hit.to_json() for hit in hits]}
    return {**answer, "gone": [hit.to_json() for hit in gone]} if gone else answer


Hit.points = _Points()  # type: ignore[assignment]


@dataclass(frozen=True)
class Neighbor:
    """An instance near another one; gap: the smallest distance between points of the two, in the unit of the frame.

    >>> sorted(neighbor.instance_id for neighbor in perception.load_map("kitchen.gsmap").describe(0).neighbors)
    [1, 3, 4]
    """

    instance_id: int
    label: str | None
    gap: float


def printed_texts(entry: dict[str, Any]) -> list[str]:
    """The texts printed on the instance of this entry of instances.json, in quotation marks, best supported first."""
    return [f'"{text["text"]}"' for text in entry.get("texts", [])]


@dataclass(frozen=True, eq=False)
class Description:
    """All properties of one instance. confidence: the mapper's score in [0, 1]; aabb: [2, 3] lowest and highest corner
    in the frame of `hit`; colors: names of its main colours with their shares, largest first.

    >>> known = perception.load_map("kitchen.gsmap").describe(0)
    >>> known.confidence, known.aabb.shape, known.hit.instance_id
    (0.9, (2, 3), 0)
    """

    hit: Hit
    confidence: float
    aabb: np.ndarray
    colors: tuple[tuple[str, float], ...] = ()
    neighbors: tuple[Neighbor, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As JSON; the keys of `Hit.to_json` and more."""
        return {
            **self.hit.to_json(),
            "confidence": round(float(self.confidence), 4),
            "aabb": {"min": self.aabb[0].tolist(), "max": self.aabb[1].tolist()},
            "colors": [{"name": name, "share": round(share, 3)} for name, share in self.colors],
            "neighbors": [vars(neighbor) for neighbor in self.neighbors],
        }
