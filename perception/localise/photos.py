"""The photos that a user names for localisation, with what their input states: lens and depth, but no pose."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import OPENCV_FROM_OPENGL, inverse_se3
from perception.inputs.readers import reader_of
from perception.inputs.transforms import lens_values
from perception.localise.localiser import Localised, NewPhoto
from perception.photos.camera_file import read_camera
from perception.photos.decode import SUFFIXES, photo_size
from perception.photos.folder import VIDEO_SUFFIXES, list_photos, view_name
from perception.photos.view_json import absolute
from perception.photos.views import fit_lens, view_lens
from perception.progress import Progress
from perception.sfm.options import ReadOptions
from perception.types import Lens

NO_POINTS = np.zeros((1, 3)), np.zeros((1, 3), np.uint8)
"""A cloud for readers of posed inputs, which else triangulate one."""


def new_photos(sources: Sequence[Path], camera: Path | None, workdir: Path, progress: Progress) -> list[NewPhoto]:
    """The photos of files and inputs, in their order, with unique names. camera: ROS camera_info of all that come
    without a lens. InputError for a source that cannot be read, or holds no photo, and where none comes without."""
    lens = None if camera is None else read_camera(camera)
    found, unused = list[NewPhoto](), camera
    for source in sources:
        if source.suffix.lower() in SUFFIXES and source.is_file():
            found.append(NewPhoto(source.name, source))
            unused = None
        elif source.suffix.lower() in VIDEO_SUFFIXES and source.is_file():
            raise InputError(f"{source}: is a video; localise takes photos, such as frames of it")
        elif (reader := reader_of(source)).poses:
            options = ReadOptions(workdir, progress=progress, poses="keep", cloud=NO_POINTS, lens=lens, still=False)
            views = reader.read(source, options).views
            found += [NewPhoto(v.name, v.photo, view_lens(v), v.depth, v.mask, v.as_stored) for v in views]
            unused = unused if reader.cameras else None
        elif photos := list_photos(source):
            found += [NewPhoto(view_name(photo, source), photo) for photo in photos]
            unused = None
        else:
            raise InputError(f"{source}: no photos found; expected .jpg, .heic, .png, .tif, .bmp or .webp files")
    if unused is not None:
        raise InputError(f"{unused}: a camera file goes with photos; {sources[0]} brings its own cameras")
    if lens is not None:
        found = [p if p.lens else replace(p, lens=_fitted(lens, p.photo, camera)) for p in found]
    names = [photo.name for photo in found]
    return [p if names.count(p.name) == 1 else replace(p, name=str(p.photo)) for p in found]


def _fitted(lens: Lens, photo: Path, camera: Path | None) -> Lens:
    """The lens of a camera file at the size of a photo. InputError for a photo of another shape."""
    if (fitted := fit_lens(lens, photo, as_stored=False)) is not None:
        return fitted
    found = "×".join(map(str, photo_size(photo)))
    raise InputError(f"{photo}: the photo is {found}, the camera file {camera} says {lens.width}×{lens.height}")


def transforms_of(found: Sequence[Localised], output: Path, facts: dict[str, Any]) -> Any:
    """The transforms.json of poses in the map's frame, as nerfstudio reads it (OpenGL camera axes), for a file at
    `output`; paths are relative to it. facts: entries of the file itself."""
    frames = []
    for each in found:
        frame = {
            "file_path": _beside(each.photo, output),
            "transform_matrix": (inverse_se3(each.camera_from_map) @ OPENCV_FROM_OPENGL).tolist(),
            **lens_values(each.lens),
        }
        depth = each.depth
        if depth is not None and depth.lens is None:
            frame |= {"depth_file_path": _beside(depth.path, output), "depth_unit_scale_factor": depth.scale}
        frames.append(frame)
    return {**facts, "frames": frames}


def _beside(file: Path, output: Path) -> str:
    return Path(os.path.relpath(absolute(file), absolute(output).parent)).as_posix()
