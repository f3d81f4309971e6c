"""The scene graph of a map: rooms, the things in them, what each rests on, and their parts, with z up.

    part --part of--> object --on | in | attached to--> support --in--> room,    object --next to--> object

The layers are those of Armeni et al. (ICCV 2019) and Hughes et al. (RSS 2022). What lies under a thing is never seen,
so what it stands on is looked for in a ring around its foot.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from perception.errors import InputError
from perception.io.atomic import write_file
from perception.query.relations import LevelBoxes, level_from_map

if TYPE_CHECKING:
    import networkx

    from perception.map.map import Map

MOST_POINTS = 3000  # of an instance that are looked at
SECTORS = 8  # of the ring around a thing's foot
LEAST_RING, LEAST_WALLS = 2 / SECTORS, 7 / SECTORS  # shares of the sectors that a support, a container fills
CLEAR = 0.5  # of several supports the highest counts whose score is at least this share of the best one's
SHELL = 0.6  # share of the map's extent along two axes from which an instance is a wall, a floor or a ceiling
RING = 0.4  # width of the ring, as a share of the foot's shorter side
FLAT = 0.15  # most thickness of what hangs on a wall, as a share of its size
BESIDE, UPPER, LEVEL = 0.8, 0.5, 0.1
"""Of what a thing may be in: distance of its points from the thing's middle, relative to the thing's half sides, from
which they are beside it; relative height from which these are walls; least share of walls: fewer are noise."""
TOUCHING = 0.05  # least share of the points of what is attached that touch what holds it
HIDDEN = 0.5  # share of a thing's height, at its foot, that no photo may have seen
MATCH = 0.5  # least match of `LevelBoxes` for "in" and "next to"
DOOR = 1.2  # metres: narrower passages part two rooms


@dataclass(frozen=True)
class Holder:
    """The instance that holds another, by its position: relation is "on", "in" or "attached to", score in [0, 1]."""

    position: int
    relation: str
    score: float


def scene_graph(gmap: Map) -> networkx.DiGraph:
    """The scene graph of a map, ready for `networkx.node_link_data`.

    Nodes: instances by their id, "part 7", "room 0"; each with `kind` (room, shell, support, object or part), and where
    it has one its label, score, centroid [3], box (`obb`) and lengths in the map's frame. Edges as above, with
    `relation` and `score`. Graph attributes: frame, metric, map_id. Rooms need a metric map with gravity and a floor;
    otherwise there is one. InputError when it is not known which way is up.

    >>> graph = scene_graph(perception.load_map("room.gsmap"))
    >>> graph.nodes[4]["kind"], graph.edges[4, "room 0"]["relation"]
    ('object', 'in')
    """
    import networkx

    things = _level_things(gmap)
    if things is None:
        advice = "map photos of a level camera, or a transforms.json with 'gravity'"
        raise InputError(f"{gmap.path}: which way is up is not known, and a scene graph needs it; {advice}")
    held, boxes = holders(*things), things[1]
    shell, beside, rooms = _shells(boxes), boxes.match("beside"), _rooms(gmap)
    ids = [int(entry["id"]) for entry in gmap.instances]
    graph = networkx.DiGraph(frame=gmap.frame, metric=gmap.metric, map_id=gmap.map_id)
    supports = {holder.position for holder in held if holder is not None and holder.relation == "on"}
    for n, entry in enumerate(gmap.instances):
        kind = "shell" if shell[n] else "support" if n in supports else "object"
        facts = {key: entry[key] for key in ("label", "score", "centroid", "obb", "texts") if key in entry}
        graph.add_node(ids[n], kind=kind, **facts)
        for part in entry.get("parts", []):
            of = {key: part[key] for key in ("score", "centroid", "obb") if key in part}
            graph.add_edge(f"part {part['id']}", ids[n], relation="part of", score=1.0)
            graph.add_node(f"part {part['id']}", kind="part", **of)
    for n, holder in enumerate(held):
        if holder is not None:
            graph.add_edge(ids[n], ids[holder.position], relation=holder.relation, score=round(holder.score, 3))
        room = f"room {rooms[n]}"
        if holder is None or shell[holder.position]:
            graph.add_node(room, kind="room")
        if holder is None:
            graph.add_edge(ids[n], room, relation="in", score=1.0)
        elif shell[holder.position]:
            graph.nodes[ids[n]]["room"] = room
    on = [None if holder is None else holder.position for holder in held]
    for a, b in zip(*np.nonzero(np.triu(beside >= MATCH)), strict=True):
        apart = not graph.has_edge(ids[a], ids[b]) and not graph.has_edge(ids[b], ids[a])
        for i, j in ((a, b), (b, a)) if apart and on[a] is not None and on[a] == on[b] else ():
            graph.add_edge(ids[i], ids[j], relation="next to", score=round(float(beside[a, b]), 3))
    return graph


def held_by(gmap: Map) -> dict[int, tuple[str, int]]:
    """What holds each instance that something holds, by its id: the relation and the other's id. {} where it is not
    known which way is up."""
    things = _level_things(gmap)
    held = [] if things is None else holders(*things)
    ids = [int(entry["id"]) for entry in gmap.instances]
    return {i: (by.relation, ids[by.position]) for i, by in zip(ids, held, strict=False) if by is not None}


def _level_things(gmap: Map) -> tuple[list[np.ndarray], LevelBoxes] | None:
    """At most MOST_POINTS points [P, 3] of each instance, and their boxes, z up; None where up is not known."""
    boxes, level = LevelBoxes.of(gmap), level_from_map(gmap)
    if boxes is None or level is None:
        return None
    clouds = [gmap.index.of(entry["id"]) for entry in gmap.instances]
    return [cloud[:: -(-len(cloud) // MOST_POINTS) or 1].astype(np.float64) @ level.T for cloud in clouds], boxes


def holders(points: list[np.ndarray], boxes: LevelBoxes) -> list[Holder | None]:
    """What holds each instance; None where nothing does. points: of the instances, [P, 3] each, z up."""
    things = _Things(points, boxes)
    held = [things.holder(n) for n in range(len(points))]
    for n, holder in enumerate(held):  # of two things that hold each other, nothing holds the lower one
        other = None if holder is None else held[holder.position]
        if holder is not None and other is not None and other.position == n:
            held[n if boxes.lows[n, 2] <= boxes.lows[holder.position, 2] else holder.position] = None
    return held


class _Things:
    """I instances, among which one holds another. points: [P, 3] of each, z up; boxes: theirs."""

    def __init__(self, points: list[np.ndarray], boxes: LevelBoxes) -> None:
        self.points, self.lows, self.highs, self.sizes = points, boxes.lows, boxes.highs, boxes.highs - boxes.lows
        self.shell, self.inside = _shells(boxes), boxes.match("in")
        self.floors = self.shell & (self.sizes[:, 2] < 0.5 * self.sizes[:, :2].min(axis=1))
        typical = float(np.median(self.sizes[~self.shell].max(axis=1))) if (~self.shell).any() else 0.0
        self.slack = 0.02 * typical + np.minimum(0.25 * self.sizes[:, 2], 0.1 * typical)  # of heights, for noise
        self.trees = {j: cKDTree(cloud) for j, cloud in enumerate(points) if len(cloud)}

    def holder(self, n: int) -> Holder | None:
        """What thing n is in, hangs on, stands on or else touches; at last the floor that is nearest below its foot."""
        if self.shell[n] or len(self.points[n]) == 0:
            return None
        middle = (self.lows[n] + self.highs[n])[:2] / 2
        if (container := self._container(n, middle)) is not None:
            return container
        touches, tall = self._touches(n), self.sizes[n, 2]
        flat = self.sizes[n, :2].min() < FLAT * self.sizes[n].max()
        walls = {j: share for j, share in touches.items() if flat and self.shell[j] and self.sizes[j, 2] > tall}
        over = ((self.lows[:, :2] <= middle) & (middle <= self.highs[:, :2])).all(axis=1)
        under = [j for j in touches if self.floors[j] or (over[j] and not self.shell[j])]
        if found := _most_touched(walls) or self._support(n, middle, under) or _most_touched(touches):
            return found
        off = self.highs[:, 2] - self.lows[n, 2]
        floors = [j for j in under if self.floors[j] and -tall <= off[j] <= self.slack[n]]
        return Holder(max(floors, key=lambda j: off[j]), "on", 1 / SECTORS) if floors else None

    def _container(self, n: int, middle: np.ndarray) -> Holder | None:
        """What has the thing's box in its own, and walls around it."""
        for j in np.argsort(-self.inside[n], kind="stable"):
            if self.inside[n, j] < MATCH:
                break
            apart = np.abs(self.points[j][:, :2] - middle) >= BESIDE * self.sizes[n, :2] / 2
            beside = self.points[j][apart.any(axis=1)]
            walls = beside[beside[:, 2] >= self.lows[n, 2] + UPPER * self.sizes[n, 2]]
            flat = len(walls) < LEVEL * len(beside)  # a level surface
            if not self.shell[j] and not flat and _around(walls[:, :2], middle) >= LEAST_WALLS:
                return Holder(int(j), "in", float(self.inside[n, j]))
        return None

    def _touches(self, n: int) -> dict[int, float]:
        """Of each other instance the share of the thing's points that are near it."""
        mine, reach = self.points[n], 2 * self.slack[n] + float(self.sizes[n].min())
        near = np.maximum(self.lows - self.highs[n], self.lows[n] - self.highs).max(axis=1) <= 2 * reach
        others = {j: tree for j, tree in self.trees.items() if j != n}
        away = {j: tree.query(mine, distance_upper_bound=reach)[0] for j, tree in others.items() if near[j]}
        return {j: float(np.isfinite(away[j]).mean()) if near[j] else 0.0 for j in others}

    def _support(self, n: int, middle: np.ndarray, under: list[int]) -> Holder | None:
        """The highest surface in a ring around the thing's foot, of those that fill it well."""
        mine, low, size, slack = self.points[n], self.lows[n, 2], self.sizes[n], self.slack[n]
        foot = mine[mine[:, 2] <= low + slack + 0.1 * size[2]][:, :2]
        tree, width = cKDTree(foot if len(foot) else mine[:, :2]), max(RING * float(size[:2].min()), 3 * slack)
        for wide in (width, 3 * width):  # of a corner behind furniture little floor is seen
            tops: list[tuple[float, float, int]] = []  # height, score, position
            for j in under:
                near = self.points[j][self.points[j][:, 2] >= low - max(3 * slack, HIDDEN * size[2])]
                near = near[np.isfinite(tree.query(near[:, :2], distance_upper_bound=wide)[0])] if len(near) else near
                below = near[near[:, 2] <= low + slack]
                share = _around(below[:, :2], middle)
                if share >= LEAST_RING:  # a neighbour is higher beside the thing
                    tops.append((float(np.quantile(below[:, 2], 0.9)), share * len(below) / len(near), j))
            if tops:
                best_score = max(score for _, score, _ in tops)
                _, score, j = max(top for top in tops if top[1] >= CLEAR * best_score)
                return Holder(j, "on", score)
        return None


def _most_touched(touches: dict[int, float]) -> Holder | None:
    best = max(touches, key=lambda j: touches[j], default=None)
    return None if best is None or touches[best] < TOUCHING else Holder(best, "attached to", touches[best])


def _around(points: np.ndarray, middle: np.ndarray) -> float:
    """Share of the SECTORS about `middle` [2] in which there are points [P, 2]."""
    turn = np.arctan2(*(points - middle).T[::-1])
    return len(np.unique(np.floor((turn / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS)) / SECTORS


def _shells(boxes: LevelBoxes) -> np.ndarray:
    """[I] bool: the instances as large as the map along two axes: walls, floors, ceilings."""
    if len(boxes.lows) == 0:
        return np.zeros(0, bool)
    extent = np.maximum(boxes.highs.max(axis=0) - boxes.lows.min(axis=0), 1e-9)
    return np.asarray(((boxes.highs - boxes.lows) >= SHELL * extent).sum(axis=1) >= 2)


def _rooms(gmap: Map) -> list[int]:
    """The room of each instance: rooms are what remains connected of the free space, 1.2 to 1.8 m above the floor,
    without what is nearer than DOOR / 2 to something. One room where that is not known."""
    from scipy import ndimage

    from perception.query.floor_grid import FREE, OCCUPIED, floor_grid

    cell = 0.1
    try:
        cells, map_from_grid = floor_grid(gmap, cell, step=1.2)
    except InputError:
        return [0] * len(gmap.instances)
    open_ = ndimage.distance_transform_edt(cells != OCCUPIED) * cell > DOOR / 2
    rooms, count = ndimage.label(open_ & (cells == FREE))
    if count < 2:
        return [0] * len(gmap.instances)
    nearest = ndimage.distance_transform_edt(rooms == 0, return_distances=False, return_indices=True)
    middles = np.array([entry["centroid"] for entry in gmap.instances]).reshape(-1, 3)
    local = np.linalg.inv(map_from_grid) @ np.c_[middles, np.ones(len(middles))].T
    x, y = np.clip((local[:2] / cell).astype(int), 0, np.array(cells.shape)[::-1, None] - 1)
    return [int(room) - 1 for room in rooms[nearest[0][y, x], nearest[1][y, x]]]


def write_graph(gmap: Map, path: Path) -> tuple[dict[str, Any], str]:
    """Writes the scene graph as node-link JSON; facts and a line."""
    import networkx

    graph = scene_graph(gmap)
    write_file(path, json.dumps(networkx.node_link_data(graph, edges="edges"), indent=1))
    kinds = Counter(kind for _, kind in graph.nodes(data="kind"))
    relations = Counter(relation for _, _, relation in graph.edges(data="relation"))
    counts = ", ".join(f"{count} {name}" for name, count in (*sorted(kinds.items()), *sorted(relations.items())))
    return {"path": str(path), "nodes": dict(kinds), "edges": dict(relations)}, f"{path}: {counts or 'no instance'}"
