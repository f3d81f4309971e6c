"""A map and the walk it was made from as a ROS 2 bag (MCAP) that Foxglove, RViz and `ros2 bag` open."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.export.mcap import Timed, write_bag
from perception.io.photos import load_photo, scaled_K
from perception.io.ros_messages import MARKERS, POINT_CLOUD, Stamp, box_markers, header, packed_rgb, point_cloud2
from perception.io.store import GaussianMap
from perception.pictures import instance_palette
from perception.pipeline.exporting import SURFACE_OPACITY, surface_points
from perception.types import OrientedBox, View

IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA = "sensor_msgs/msg/CameraInfo"
TRANSFORM = "tf2_msgs/msg/TFMessage"
PHOTO_SIDE = 640
"""Pixels of the longer side of the photos inside."""
START, STEP = 1_000_000_000, 500_000_000
"""Nanoseconds: when the map is there, and from photo to photo. 0 would mean "no time" to ROS."""
CAMERA_FRAME = "camera"


def write_replay(path: Path, gmap: GaussianMap, views: list[View]) -> None:
    """Topics: /map/points, /map/instances (PointCloud2), /map/boxes (MarkerArray) at the start; then photo by photo
    /tf (map → camera), /camera/camera_info and /camera/image/compressed. Photos that are gone are left out."""
    frame = str(gmap.info.get("frame", "map"))
    messages = _map_messages(gmap, frame)
    for i, view in enumerate(views):
        messages += _photo_messages(view, START + i * STEP, frame)
    write_bag(path, messages)


def _map_messages(gmap: GaussianMap, frame: str) -> list[Timed]:
    stamp = _stamp(START)
    surface = surface_points(gmap)
    assert surface.colors is not None  # they are the Gaussians'
    rows = np.flatnonzero((gmap.opacities >= SURFACE_OPACITY) & (gmap.instance_ids >= 0))
    ids = gmap.instance_ids[rows]
    boxes = [
        (OrientedBox.from_json(entry["obb"]), entry.get("label") or str(entry["id"]))
        for entry in gmap.instances
        if not entry.get("hidden")
    ]
    clouds = {
        "/map/points": _cloud(surface.points, surface.colors, {}, frame, stamp),
        "/map/instances": _cloud(gmap.means[rows], instance_palette(ids), {"instance_id": ids}, frame, stamp),
    }
    told: list[Timed] = [(topic, POINT_CLOUD, START, cloud) for topic, cloud in clouds.items()]
    return [*told, ("/map/boxes", MARKERS, START, box_markers(boxes, "instances", header(frame, stamp)))]


def _cloud(
    points: np.ndarray, colors: np.ndarray, more: dict[str, np.ndarray], frame: str, stamp: Stamp
) -> dict[str, Any]:
    columns = {axis: points[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    return point_cloud2({**columns, "rgb": packed_rgb(colors), **more}, frame, stamp)


def _photo_messages(view: View, time: int, frame: str) -> list[Timed]:
    head = header(CAMERA_FRAME, _stamp(time))
    rotation = view.camera_from_world[:3, :3].T
    place = -rotation @ view.camera_from_world[:3, 3]
    turn = Rotation.from_matrix(rotation).as_quat()
    transform = {
        "header": header(frame, _stamp(time)),
        "child_frame_id": CAMERA_FRAME,
        "transform": {
            "translation": dict(zip("xyz", map(float, place), strict=True)),
            "rotation": dict(zip("xyzw", map(float, turn), strict=True)),
        },
    }
    messages: list[Timed] = [("/tf", TRANSFORM, time, {"transforms": [transform]})]
    with contextlib.suppress(InputError):  # a photo that has moved: its camera still takes its place
        photo = load_photo(view, PHOTO_SIDE)
        height, width = photo.shape[:2]
        K = scaled_K(view, width, height)
        info = {
            "header": head,
            "height": height,
            "width": width,
            "distortion_model": "plumb_bob",
            "d": np.zeros(5),
            "k": K.reshape(-1),
            "r": np.eye(3).reshape(-1),
            "p": np.hstack([K, np.zeros((3, 1))]).reshape(-1),
        }
        encoded = cv2.imencode(".jpg", photo[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
        image = {"header": head, "format": "jpeg", "data": np.asarray(encoded, np.uint8).reshape(-1)}
        messages += [("/camera/camera_info", CAMERA, time, info), ("/camera/image/compressed", IMAGE, time, image)]
    return messages


def _stamp(time: int) -> Stamp:
    return time // 1_000_000_000, time % 1_000_000_000
