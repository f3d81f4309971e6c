"""Localisation for all servers: pictures from clients, and the localiser of a map, made once in the background."""

from __future__ import annotations

import base64
import io
import threading
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any
from weakref import WeakKeyDictionary

import numpy as np
from PIL import Image
from pydantic import BaseModel, Field

from perception.errors import InputError
from perception.frame.recentre import moved_pose
from perception.geometry import inverse_se3, scale_of
from perception.io.documents import refusing
from perception.localise.localiser import Localised, Localiser, NewPhoto, NotHere
from perception.photos.camera_file import lens_of
from perception.photos.decode import check_size, why_left_out
from perception.query import Frame, QueryMap
from perception.query.crops import readable_view
from perception.serve.bodies import Body, FramedBody, Text
from perception.serve.requests import MAX_PICTURE, EngineBusy
from perception.types import Lens, View

MOST_PIXELS = 50_000_000  # of a client's picture
FORMATS = ("JPEG", "PNG", "WEBP", "BMP")
WAIT = 2.0  # seconds that a question waits for the map's photos to be read, which takes longer for most maps

Picture = Annotated[str, Field(min_length=1, max_length=MAX_PICTURE, description="JPEG, PNG, WebP or BMP in base64")]
Camera = Annotated[dict[str, Any], Field(description="ROS camera_info of the picture: image_width, camera_matrix, …")]


class LocaliseBody(FramedBody):
    """A picture, and the camera's intrinsics if known."""

    picture: Picture
    camera: Camera | None = None

    def answered(self, gmap: QueryMap, photos: Path | None) -> dict[str, Any]:
        """Where the picture was taken."""
        return placed(gmap, decoded(self.picture), self.camera, self.query_frame(), photos)


class GivenPhoto(Body):
    """A picture, or a file on this machine, for a client that works on it."""

    picture: Picture | None = None
    file: Annotated[Text, Field(description="of a photo in the folder of --photos, instead of picture")] | None = None
    camera: Camera | None = None

    def place(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        """Where it was taken. InputError unless one of picture and file is given."""
        if (self.picture is None) == (self.file is None):
            raise InputError("localise: give picture or file, one of them")
        data = read_allowed(str(self.file), photos) if self.picture is None else decoded(self.picture)
        return placed(gmap, data, self.camera, frame, photos)


class Place(BaseModel):
    localised: bool = Field(description="whether the photo is in this map")
    why: str | None = Field(None, description="why it is not")
    position: list[float] | None = None
    pose: list[list[float]] | None = Field(None, description="[4, 4] frame_from_camera: x right, y down, z forward")
    standard_error: dict[str, float] | None = Field(None, description="of position, and of the direction in degrees")
    inliers: int | None = Field(None, description="features that agree with the pose")
    rms_px: float | None = None


def placed(
    gmap: QueryMap, picture: bytes, camera: dict[str, Any] | None, frame: Frame | None, photos: Path | None
) -> dict[str, Any]:
    """The answer to a client. camera: ROS camera_info; other arguments: see `localised`."""
    lens = None if camera is None else lens_of(camera, "camera")
    return pose_json(localised(gmap, picture, lens, photos), frame)


def decoded(picture: str) -> bytes:
    """The bytes of a picture in base64. InputError for other text."""
    with refusing("picture: no base64 ({why})"):
        return base64.b64decode(picture, validate=True)


def localised(gmap: QueryMap, picture: bytes, lens: Lens | None, photos: Path | None) -> Localised | NotHere:
    """Where a client's picture was taken, in the map's frame. photos: a folder where the map's photos may be read
    beside its own. InputError for data that are no picture of at most MOST_PIXELS; EngineBusy as `localiser_of`."""
    unreadable = f"picture: not readable as {', '.join(FORMATS)}"
    with refusing(unreadable), Image.open(io.BytesIO(picture), formats=FORMATS) as image:
        size, kind = image.size, image.format
    check_size("picture", size, kind, len(picture), MOST_PIXELS)
    localiser = localiser_of(gmap, photos)
    with TemporaryDirectory(prefix="perception-localise-") as folder:
        file = Path(folder) / f"picture.{str(kind).lower()}"
        file.write_bytes(picture)
        if why := why_left_out(file):
            raise InputError(why.replace(str(file), "picture"))
        return localiser.answers([NewPhoto("picture", file, lens)])[0]


_beginning = threading.Lock()
_localisers = WeakKeyDictionary[QueryMap, Future[Localiser]]()


def localiser_of(gmap: QueryMap, photos: Path | None) -> Localiser:
    """The localiser of a map. EngineBusy while its photos are being read, which begins with the first question."""
    with _beginning:
        made = _localisers[gmap] = _localisers.get(gmap) or _begun(gmap, photos)
    try:
        return made.result(WAIT)
    except FutureTimeout:
        raise EngineBusy("the map's photos are being read to localise others; ask again in a minute") from None
    except Exception:
        _localisers.pop(gmap, None)  # the next question tries anew: a full disk may have been cleared
        raise


def _begun(gmap: QueryMap, photos: Path | None) -> Future[Localiser]:
    """Makes the localiser of a map in a thread. A map from others may name any file, so only photos in its folder and
    in `photos` are read."""

    def locate(view: View) -> View:
        return replace(readable_view(gmap, view, photos), depth=None, mask=None)

    def make() -> None:
        try:
            future.set_result(Localiser(gmap, locate=locate))
        except BaseException as error:
            future.set_exception(error)

    future: Future[Localiser] = Future()
    threading.Thread(target=make, name="localiser", daemon=True).start()
    return future


def pose_json(answer: Localised | NotHere, frame: Frame | None) -> dict[str, Any]:
    """The answer to a client, in `frame`, None = the map's. pose: [4, 4] frame_from_camera, whose axes are x right, y
    down, z forward."""
    if isinstance(answer, NotHere):
        return {"localised": False, "why": answer.why}
    from_map = np.eye(4) if frame is None else frame.from_map
    pose = inverse_se3(moved_pose(answer.camera_from_map, from_map))
    length, degrees = answer.standard_error
    return {
        "localised": True,
        "pose": pose.tolist(),
        "position": pose[:3, 3].tolist(),
        "standard_error": {"position": length * scale_of(from_map), "degrees": degrees},
        "inliers": answer.inliers,
        "rms_px": answer.rms_px,
    }


def ros_covariance(answer: Localised) -> np.ndarray:
    """[36] of a geometry_msgs/PoseWithCovariance: x, y, z, then rotations about the fixed axes, row by row."""
    order = [3, 4, 5, 0, 1, 2]
    return answer.covariance[np.ix_(order, order)].reshape(-1)


def read_allowed(path: str, photos: Path | None) -> bytes:
    """The bytes of a client's photo on this machine. InputError unless it lies in `photos`, links followed."""
    with refusing(f"file: {path[:80]} cannot be read"):
        file = None if photos is None else (photos / path).resolve()
    if photos is None or file is None or not file.is_relative_to(photos.resolve()):
        raise InputError("file: not in the folder of --photos; send the picture itself")
    if not file.is_file() or file.stat().st_size > MAX_PICTURE:
        raise InputError(f"file: no photo of at most {MAX_PICTURE} bytes is there")
    return file.read_bytes()
