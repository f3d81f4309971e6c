"""Messages of a map for planners, as dicts of their fields; the types are standard ones and `perception_msgs`.

Coordinates are in the frame of the hits, metres when the map is metric (REP 103).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.node.answers import Channel, Stamp, box_markers, header, pose, xyz, xyzw
from perception.query import Frame, Hit, QueryMap
from perception.query.robot_pose import RobotPose

FIND = Channel("find", "perception_msgs/srv/Query")
STAND = Channel("where_to_stand", "perception_msgs/srv/WhereToStand")
INSTANCES = Channel("map/instances", "perception_msgs/msg/InstanceArray", latched=True)
INFO = Channel("map/info", "perception_msgs/msg/MapInfo", latched=True)
MARKERS = Channel("map/markers", "visualization_msgs/msg/MarkerArray", latched=True)
GRID = Channel("map/grid", "nav_msgs/msg/OccupancyGrid", latched=True)
WORLD = Channel("map/planning_scene_world", "moveit_msgs/msg/PlanningSceneWorld", latched=True)
STATIC_TF = Channel("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
OUTPUTS = (INSTANCES, INFO, MARKERS, GRID, WORLD, STATIC_TF)

_BOX = 1  # shape_msgs/SolidPrimitive
_ADD = 0  # moveit_msgs/CollisionObject

Message = dict[str, Any]


def instance(hit: Hit) -> Message:
    """perception_msgs/Instance."""
    return {
        "id": hit.instance_id,
        "label": hit.label or "",
        "score": float(hit.score),
        "num_points": len(hit.points),
        "centroid": xyz(hit.centroid),
        "pose": pose(hit.obb),
        "size": xyz(hit.obb.extent),
        "covariance": np.asarray(hit.covariance, np.float64).reshape(-1),
        "state": hit.state or "",
        "last_seen": -1 if hit.last_seen is None else hit.last_seen,
    }


def instance_array(hits: Iterable[Hit], map_id: str, frame: str, stamp: Stamp, gone: Iterable[Hit] = ()) -> Message:
    """perception_msgs/InstanceArray."""
    instances = {"instances": [instance(hit) for hit in hits], "gone": [instance(hit) for hit in gone]}
    return {"header": header(frame, stamp), "map_id": map_id, **instances}


def map_info(gmap: QueryMap, path: Path, stamp: Stamp) -> Message:
    """perception_msgs/MapInfo."""
    down = (gmap.info.get("gravity") or {}).get("direction")
    return {
        "header": header(gmap.frame, stamp),
        "map_id": gmap.map_id,
        "path": str(path),
        "metric": gmap.metric,
        "gravity_known": down is not None,
        "gravity": xyz([0.0, 0.0, 0.0] if down is None else down),
        "num_instances": len(gmap.instances),
        "num_gaussians": len(gmap),
        "visits": [visit.time or "" for visit in gmap.visits],
    }


def map_markers(hits: Sequence[Hit], frame: str, stamp: Stamp) -> Message:
    """visualization_msgs/MarkerArray: a box and a text for each instance of the map."""
    boxes = [(hit.instance_id, hit.obb, f"{hit.label or ''} #{hit.instance_id}".strip()) for hit in hits]
    return box_markers(boxes, "map", header(frame, stamp))


def collision_object(hit: Hit, stamp: Stamp) -> Message:
    """moveit_msgs/CollisionObject of an instance: its oriented box; id `instance_7`.

    The box bounds the instance's visible points: a side that no photo shows may reach further.
    """
    return {
        "header": header(hit.frame, stamp),
        "pose": pose(hit.obb),
        "id": f"instance_{hit.instance_id}",
        "primitives": [{"type": _BOX, "dimensions": np.asarray(hit.obb.extent, np.float64)}],
        "primitive_poses": [{"orientation": {"w": 1.0}}],
        "operation": _ADD,
    }


def planning_scene_world(hits: Iterable[Hit], stamp: Stamp) -> Message:
    """moveit_msgs/PlanningSceneWorld with a collision object for each instance."""
    return {"collision_objects": [collision_object(hit, stamp) for hit in hits]}


def occupancy_grid(
    cells: np.ndarray, frame_from_grid: np.ndarray, resolution: float, frame: str, stamp: Stamp
) -> Message:
    """nav_msgs/OccupancyGrid of `perception.query.floor_grid`.

    info.origin: the outer corner of cell (0, 0) on the floor. Its orientation is the identity where the frame's z is
    up; planners such as Nav2 expect that.
    """
    head = header(frame, stamp)
    return {
        "header": head,
        "info": {
            "map_load_time": head["stamp"],
            "resolution": resolution,
            "width": cells.shape[1],
            "height": cells.shape[0],
            "origin": {"position": xyz(frame_from_grid[:3, 3]), "orientation": xyzw(frame_from_grid[:3, :3])},
        },
        "data": cells.reshape(-1),
    }


def stand_pose(stand: RobotPose, stamp: Stamp) -> Message:
    """geometry_msgs/PoseStamped of a robot that stands there: on the floor, x forward, z up (REP 103); a goal."""
    at = {"position": xyz(stand.position), "orientation": xyzw(stand.map_from_robot[:3, :3])}
    return {"header": header(stand.frame, stamp), "pose": at}


def static_transform(parent: Frame, child: str, stamp: Stamp) -> Message:
    """tf2_msgs/TFMessage with parent_from_child, given the parent as a frame of the child's map."""
    transform = {"translation": xyz(parent.from_map[:3, 3]), "rotation": xyzw(parent.from_map[:3, :3])}
    return {"transforms": [{"header": header(parent.name, stamp), "child_frame_id": child, "transform": transform}]}
