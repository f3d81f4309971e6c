"""Where a robot is: images from its camera in, the camera's pose in the map out, as standard ROS 2 messages."""

from __future__ import annotations

import json
import threading
from concurrent.futures import Future
from typing import Any

from perception.bags.read import decode_image, encoded
from perception.errors import InputError
from perception.geometry import inverse_se3
from perception.localise.localiser import Localised, NotHere
from perception.node import answers
from perception.node.config import NodeConfig
from perception.photos.camera_file import camera_info, lens_of
from perception.query import QueryMap
from perception.serve.engine import QueryEngine
from perception.serve.localise import localised, pose_json, ros_covariance
from perception.serve.requests import EngineBusy, EngineClosed, error_json, source
from perception.types import Lens


class Localising:
    """Answers one image at a time; those that come meanwhile are dropped, so that an answer is never old. Thread-safe.

    transport: `core.Transport`. photos: a folder where the map's photos may be read beside its own. An image is
    answered by its pose, if it has one, and by JSON, also where it has none; both have the image's stamp.
    """

    def __init__(self, engine: QueryEngine, transport: Any, config: NodeConfig) -> None:
        self._engine, self._transport, self.photos = engine, transport, config.photos
        self._lens: Lens | None = None
        self._one = threading.Lock()
        self.dropped = 0

    def camera(self, message: Any) -> None:
        """Takes the intrinsics of the images that follow from a CameraInfo; one that is none is ignored."""
        try:
            self._lens = lens_of(camera_info(message), answers.LOCALISE_CAMERA.name)
        except InputError:
            self._lens = None

    def image(self, message: Any) -> None:
        """Takes an Image or CompressedImage; returns at once, a thread of the engine answers."""
        if not self._one.acquire(blocking=False):
            self.dropped += 1
            return
        try:
            future = self._engine.run(lambda gmap: self._answer(gmap, message))
        except (EngineBusy, EngineClosed) as error:
            self._one.release()
            self._send(message, {"error": error_json(error)})
        else:
            future.add_done_callback(lambda done: self._finish(message, done))

    def _answer(self, gmap: QueryMap, message: Any) -> tuple[QueryMap, Localised | NotHere]:
        picture = decode_image(message, answers.LOCALISE_IMAGE.name)
        lens = self._lens
        if lens is not None and (lens.width, lens.height) != picture.shape[1::-1]:
            lens = None  # of another camera
        return gmap, localised(gmap, encoded(message, picture)[1], lens, self.photos)

    def _finish(self, message: Any, done: Future[tuple[QueryMap, Localised | NotHere]]) -> None:
        self._one.release()
        error = done.exception()
        if error is not None:
            self._send(message, {"error": error_json(error)})
            return
        gmap, answer = done.result()
        if isinstance(answer, Localised):
            self._transport.publish(answers.LOCALISE_POSE, _pose_message(answer, gmap.frame, _stamp(message)))
        self._send(message, {**pose_json(answer, None), **source(gmap)})

    def _send(self, message: Any, body: dict[str, Any]) -> None:
        about = {"camera_frame": str(message.header.frame_id), "stamp": answers.stamp_json(_stamp(message))}
        self._transport.publish(answers.LOCALISE_ANSWER, {"data": json.dumps({**body, **about}, allow_nan=False)})


def _stamp(message: Any) -> answers.Stamp:
    return int(message.header.stamp.sec), int(message.header.stamp.nanosec)


def _pose_message(answer: Localised, frame: str, stamp: answers.Stamp) -> dict[str, Any]:
    """geometry_msgs/PoseWithCovarianceStamped of the camera in the map's frame."""
    pose = inverse_se3(answer.camera_from_map)
    at = {"position": answers.xyz(pose[:3, 3]), "orientation": answers.xyzw(pose[:3, :3])}
    return {"header": answers.header(frame, stamp), "pose": {"pose": at, "covariance": ros_covariance(answer)}}
