"""frame.yaml: where a map lies in the robot's world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from perception.config import Settings, settings_from
from perception.errors import InputError
from perception.io.documents import read_yaml
from perception.query import Frame, QueryMap


class FrameFile(Settings):
    """parent_from_child is rigid; a point of the map, times `scale`, is a point of the child in metres."""

    parent: str = Field("map", min_length=1, description="the robot's fixed frame")
    child: str | None = Field(None, min_length=1, description="name of the map's frame; none: the map's own")
    scale: float | None = Field(None, gt=1e-9, lt=1e9, description="metres per unit of the map")
    translation: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="three numbers")
    rotation: tuple[float, float, float, float] = Field((0.0, 0.0, 0.0, 1.0), description="quaternion x y z w")

    def placed(self, gmap: QueryMap) -> QueryMap:
        """The map in the child frame, in metres. InputError when its unit is unknown or the frames have one name."""
        child = self.child or gmap.frame
        if child == self.parent:
            raise InputError(f"frame file: parent and child are both '{child}'; give the child another name")
        if not gmap.metric and self.scale is None:
            raise InputError(
                f"{gmap.path}: its unit is unknown; frame file: expected scale, metres per unit of the map"
            )
        held = gmap.record
        if self.scale not in (None, 1.0):
            from perception.edit.scale import scaled

            held = scaled(held, self.scale)
        info = {**held.info, "frame": child, "metric": True}
        made = QueryMap.of(held, info=info, encoders=gmap.encoders)
        made.warm()
        return made

    def parent_frame(self) -> Frame:
        """The parent as a frame of queries on the placed map."""
        parent_from_child = np.eye(4)
        parent_from_child[:3, :3] = Rotation.from_quat(self.rotation).as_matrix()
        parent_from_child[:3, 3] = self.translation
        return Frame(self.parent, parent_from_child)


def read_frame(path: Path) -> FrameFile:
    """The frame file at `path`; InputError, with the line or the setting, when it is not one."""
    values = read_yaml(path, "settings such as 'parent: map'")
    if not isinstance(values, dict):
        raise InputError(f"{path}: found {type(values).__name__}, expected settings such as 'parent: map'")
    read = settings_from(FrameFile, {str(key): (value, str(path)) for key, value in values.items()})
    length = float(np.linalg.norm(read.rotation))
    if abs(length - 1) > 1e-3:
        raise InputError(f"{path} rotation: found a quaternion of length {length:g}, expected 1")
    return read
