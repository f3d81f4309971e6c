"""The camera of an image topic: which camera_info of a bag describes it."""

from __future__ import annotations

from typing import Any

from perception.bags.read import CAMERA_INFO, DEPTH_TRANSPORT, Bag, first_frame
from perception.errors import InputError
from perception.photos.camera_file import camera_info, lens_of
from perception.types import Lens

_ADVICE = "give its topic with --camera-info, or a camera file with --camera (perception calibrate makes one)"
_RECORDER = "/image/data"
"""Ends the topics of images in recordings of librealsense; their camera is /info/camera_info."""


def camera_of(topic: str) -> tuple[str, bool]:
    """(its camera_info, whether its images are rectified) of an image topic, as ROS's image_pipeline names them:
    /front/image_rect_color/compressed has /front/camera_info, and is rectified."""
    for transport in ("/compressed", f"/{DEPTH_TRANSPORT}"):
        topic = topic.removesuffix(transport)
    if topic.endswith(_RECORDER):
        return f"{topic.removesuffix(_RECORDER)}/info/camera_info", False
    namespace, _, image = topic.rpartition("/")
    return f"{namespace}/camera_info", "rect" in image.partition("_")[2]


def image_camera(bag: Bag, topic: str, wanted: str | None) -> dict[str, Any]:
    """The camera_info, as in a camera file, of the camera that publishes `topic`: the wanted one, else the one beside
    it, else the one in the tf frame of its images. InputError where there is none: another camera's is of no use."""
    topics, (beside, rectified) = bag.of_type(CAMERA_INFO), camera_of(topic)
    name = wanted or beside
    if name not in topics and wanted is None:
        frames = {name: first_frame(bag, name) for name in (topic, *topics)}
        framed = [described(bag, other, rectified) for other in topics if frames[other] == frames[topic] != ""]
        if len({lens_of(data, topic) for data in framed}) == 1:
            return framed[0]
    if name not in topics:
        found = f"has no camera_info '{name}' (found {', '.join(topics) or 'none'})"
        raise InputError(f"{bag.path}: {found}; {_ADVICE}")
    return described(bag, name, rectified)


def depth_camera(bag: Bag, topic: str) -> Lens | None:
    """The lens of a depth topic by the camera_info beside it; None without."""
    name, rectified = camera_of(topic)
    where = f"{bag.path}: {name}"
    return lens_of(described(bag, name, rectified), where) if name in bag.of_type(CAMERA_INFO) else None


def described(bag: Bag, name: str, rectified: bool) -> dict[str, Any]:
    """The first message on the camera_info topic `name` that describes a camera. InputError where none does."""
    wrong = None
    for one in bag.messages([name]):
        try:
            data = camera_info(one.message, rectified)
            lens_of(data, f"{bag.path}: {name}")
            return data
        except InputError as error:
            wrong = wrong or error
    raise InputError(f"{wrong or f'{bag.path}: {name} holds no message'}; {_ADVICE}")
