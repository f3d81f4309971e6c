"""Views and points of a COLMAP model (a pycolmap reconstruction)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.photos.decode import why_left_out
from perception.photos.ignore_masks import mask_of
from perception.photos.lens import lens_from_camera
from perception.photos.views import first_of, posed_view
from perception.sfm.exposure import with_gains
from perception.sfm.options import Cloud, ReadOptions
from perception.sfm.tracks import tracks_of_model
from perception.types import View


def views_of_model(
    model: Any, located: dict[int, tuple[str, Path]], source: Path, options: ReadOptions, upright: bool = True
) -> tuple[list[View], dict[str, Any]]:
    """Views sorted by name, and facts: "left_out" with reasons, "warnings", "exposure". located: view name and photo by
    image id. upright: see `posed_view`. InputError when no photo is left."""
    views, missing, notes = [], [], set()
    lenses = {camera_id: lens_from_camera(camera) for camera_id, camera in model.cameras.items()}
    for image_id, (name, photo) in located.items():
        image = model.images[image_id]
        if not photo.is_file():
            missing.append({"name": name, "why": "in the sparse model, but the photo is missing"})
            continue
        try:
            why_left_out(photo, strict=True)
            pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
            view, lines = posed_view(name, photo, lenses[image.camera_id], pose, source, upright)
        except InputError as error:
            if options.strict:
                raise
            missing.append({"name": name, "why": str(error)})
            continue
        views.append(replace(view, mask=mask_of(options.masks, name)))
        notes.update(lines)
    if not views:
        raise InputError(
            f"{source}: none of the {len(located)} photos of the sparse model can be used{first_of(missing)}"
        )
    names = {image_id: name for image_id, (name, _) in located.items()}
    views.sort(key=lambda view: view.name)
    views, exposure = with_gains(views, tracks_of_model(model, views, names))
    return views, {"left_out": sorted(missing, key=lambda item: item["name"]), "warnings": sorted(notes), **exposure}


def cloud_of(model: Any) -> Cloud:
    """points [P, 3] float64 and colors [P, 3] uint8 of a pycolmap reconstruction, in the order of point ids."""
    ids = sorted(model.points3D)
    points = np.array([model.points3D[i].xyz for i in ids], dtype=np.float64).reshape(-1, 3)
    colors = np.array([model.points3D[i].color for i in ids], dtype=np.uint8).reshape(-1, 3)
    finite = np.isfinite(points).all(1)
    return points[finite], colors[finite]
