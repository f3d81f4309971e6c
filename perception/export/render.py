"""`perception render`: images of a map from cameras."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
import torch

from perception.errors import InputError
from perception.frame.recentre import map_from_input, moved
from perception.gaussians.model import Gaussians, as_gaussians
from perception.gaussians.views import depth_image, render, rgb_image
from perception.inputs.transforms import in_map_frame, read_frames
from perception.instances.silhouettes import render_silhouettes
from perception.io.atomic import write_file
from perception.io.documents import refusing, safe_name
from perception.map.outputs import refuse_inputs
from perception.map.write import Map, read_map
from perception.photos.decode import SUFFIXES
from perception.photos.lens import camera_from_lens
from perception.photos.views import make_view
from perception.pictures import cut_out, features_to_rgb
from perception.query.query_map import QueryMap
from perception.types import View

_MADE, _HEADER = b"tEXtSoftware\0perception render", 33
"""A chunk of the PNG files that are written here, after their first bytes."""
KINDS = ("rgb", "depth", "instances", "features")
TURNED = 15.0
"""Degrees by which no photo is turned by refined poses: its camera is in another frame."""
WIDEST = 5.0
"""Tangent of the angle to the axis, 79°, up to which a lens is rendered: at 90° the pinhole image has no end."""


def render_map(map_path: Path, output: Path, cameras: Path | None, what: list[str]) -> tuple[dict[str, Any], str]:
    """Writes one image per camera and kind: `NAME.png` for a single kind, `KIND/NAME.png` for several. NAME is that of
    the photo without its suffix, or with it where another photo has the same otherwise.

    rgb: 8-bit PNG. depth: 16-bit PNG, thousandths of the map's unit along the optical axis, 0 = nothing, or beyond the
    65.535 units that 16 bits hold. instances: 16-bit PNG of id + 1, 0 = none. features: 8-bit PNG of the three main
    components. cameras: a transforms.json in the coordinates of the map's input, or one of `localise`; None takes the
    map's held-out views (all views if none were held out). A camera with lens distortion is rendered with that
    distortion, so that the image aligns with its photo. InputError without views, for a name that points outside
    `output`, for an image that would replace anything but another of this command, and for a folder of photos, which a
    later map would be made of.
    """
    what = [kind.strip() for kind in what]
    if wrong := [kind for kind in what if kind not in KINDS]:
        raise InputError(f"--what: found '{wrong[0]}', expected one of: {', '.join(KINDS)}")
    gmap = read_map(map_path)
    if "instances" in what and gmap.instance_ids.max(initial=-1) >= 65535:
        raise InputError(f"{map_path}: has instances above 65534, beyond pictures of 16 bits; give --what without them")
    views = map_views(gmap) if cameras is None else _cameras(cameras)
    if cameras is not None and not in_map_frame(cameras, gmap.info, gmap.views):
        views = [moved(view, map_from_input(map_path, gmap.info)) for view in views]
    if not views:
        raise InputError(f"{map_path if cameras is None else cameras}: holds no views; give others with --cameras FILE")
    files = _picture_names([safe_name(view.name, cameras or map_path) for view in views])  # no path outside `output`
    folders = {kind: output if len(what) == 1 else output / kind for kind in what}
    listed = [] if cameras is None else [cameras.parent / name for name, _, _ in read_frames(cameras)]
    inputs = [map_path, cameras, *listed, *(photo.with_name(f"{photo.name}.png") for photo in listed)]
    outputs = [folder / file for folder in folders.values() for file in files]
    refuse_inputs(outputs, inputs)
    photos = [*listed, *(view.photo for view in gmap.views)]
    if mixed := {file.parent.resolve() for file in outputs} & {photo.parent.resolve() for photo in photos}:
        found = "holds photos, and a later map would be made of pictures of this one too"
        raise InputError(f"{min(mixed)}: {found}; choose another -o")
    for there in filter(os.path.lexists, outputs):  # the user named none of them
        if not _is_render(there):
            raise InputError(f"{there}: lies there, and is no picture of this command; choose another -o")
    gaussians = as_gaussians(gmap)
    for kind, folder in folders.items():
        for file, view in zip(files, views, strict=True):
            write_picture(folder / file, _through_lens(kind, gaussians, gmap, view))
    facts = {"output": str(output), "views": len(views), "what": what}
    text = f"{output}: {len(views)} views of {', '.join(what)}"
    if (turn := turned(views, gmap.views)) > TURNED:
        facts["warning"] = (
            f"{cameras}: turned by {turn:.0f}° against the map's photos of the same names; another frame?"
        )
        text += f"\nwarning: {facts['warning']}"
    return facts, text


def turned(views: list[View], others: list[View]) -> float:
    """Degrees between the axes of views and of those of `others` with the same name: their median, 0 without any."""
    known = {view.name: view.camera_from_world[:3, :3] for view in others}
    pairs = [(view.camera_from_world[:3, :3], known[view.name]) for view in views if view.name in known]
    cosines = [(np.trace(a @ b.T) - 1) / 2 for a, b in pairs]
    return float(np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))) if cosines else 0.0


def _picture_names(names: list[str]) -> list[str]:
    short = [str(Path(name).with_suffix("")) if Path(name).suffix.lower() in SUFFIXES else name for name in names]
    many = Counter(short)
    return [f"{name if many[stem] > 1 else stem}.png" for name, stem in zip(names, short, strict=True)]


def rendered_crop(gmap: QueryMap, instance_id: int, side: int) -> np.ndarray | None:
    """`query.crops.best_crop` of the map's own picture in place of the photo."""
    found = gmap.best_view(instance_id)
    return None if found is None else cut_out(_picture("rgb", as_gaussians(gmap), gmap, found[0]), found[1], side)


def map_views(gmap: Map, held_out: bool = True) -> list[View]:
    """The held-out views of a map, or all when none were (or `held_out` is False), for undistorted pictures: without
    the lens of their photos."""
    views = [view for view in gmap.views if view.held_out or not held_out] or gmap.views
    return [replace(view, lens=None) for view in views]


def _cameras(path: Path) -> list[View]:
    """The frames of a transforms.json as views; their photos need not exist."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a transforms.json with the cameras to render")
    frames = read_frames(path)
    with refusing(f"{path}: some file_path are absolute, others relative; write all of one kind"):
        folder = os.path.commonpath([str(PurePosixPath(name).parent) for name, _, _ in frames]) if frames else ""
    short = [PurePosixPath(name).relative_to(folder).as_posix() for name, _, _ in frames]
    return [make_view(name, path, lens, pose, path) for name, (_, pose, lens) in zip(short, frames, strict=True)]


def _through_lens(kind: str, gaussians: Gaussians, gmap: Map, view: View) -> np.ndarray:
    """The image with the view's lens distortion, warped from a wider pinhole image; 0 beyond WIDEST."""
    if view.lens is None:
        return _picture(kind, gaussians, gmap, view)
    width, height = view.lens.width, view.lens.height
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    camera = camera_from_lens(view.lens)
    rays = np.asarray(camera.cam_from_img(grid), np.float64)[:, :2]
    back = np.asarray(camera.img_from_cam(np.c_[rays, np.ones(len(rays))]))  # another pixel where the lens has no ray
    seen = ((np.abs(rays) <= WIDEST) & (np.abs(back - grid) < 0.5)).all(axis=1)
    if not seen.any():
        raise InputError(f"{view.name}: no pixel of its lens looks within 79° of the optical axis; correct its camera")
    low, high = rays[seen].min(axis=0), rays[seen].max(axis=0)
    fx, fy = view.K[0, 0], view.K[1, 1]
    K = np.array([[fx, 0, 1 - fx * low[0]], [0, fy, 1 - fy * low[1]], [0, 0, 1.0]])
    size = np.ceil((high - low) * [fx, fy] + 2).astype(int)
    wide = View(view.name, view.photo, K, int(size[0]), int(size[1]), view.camera_from_world)
    picture = _picture(kind, gaussians, gmap, wide)
    where = np.where(seen[:, None], rays * [fx, fy] + K[:2, 2] - 0.5, -9.0)  # -9: outside
    where = where.astype(np.float32).reshape(height, width, 2)
    # Ids and depths must not be interpolated.
    interpolation = cv2.INTER_CUBIC if picture.dtype == np.uint8 else cv2.INTER_NEAREST
    return np.asarray(cv2.remap(picture, where[..., 0], where[..., 1], interpolation))


@torch.no_grad()
def _picture(kind: str, gaussians: Gaussians, gmap: Map, view: View) -> np.ndarray:
    pose = torch.from_numpy(view.camera_from_world.astype(np.float32))
    K = torch.from_numpy(view.K.astype(np.float32))
    if kind == "instances":
        found = render_silhouettes(gaussians, [gmap.instance_ids], pose, K, view.width, view.height)[0]
        return (found.ids + 1).astype(np.uint16)
    if kind == "depth":
        depth = depth_image(gaussians, pose, K, view.width, view.height)
        thousandths = (depth * 1000).round().numpy()
        return np.where(thousandths <= 65535, thousandths, 0).astype(np.uint16)
    if kind == "rgb":
        return rgb_image(gaussians, pose, K, view.width, view.height)
    out = render(gaussians, pose, K, view.width, view.height, features=gaussians.features)
    assert out.features is not None  # for the type checker
    return features_to_rgb(out.features[0].numpy())


def write_picture(path: Path, image: np.ndarray) -> None:
    """Writes an image [H, W] or [H, W, 3] RGB, with its maker's name; folders are made. InputError when that fails."""
    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    png, length = cv2.imencode(".png", image)[1].tobytes(), len(_MADE) - len(b"tEXt")
    chunk = struct.pack(">I", length) + _MADE + struct.pack(">I", zlib.crc32(_MADE))
    write_file(path, png[:_HEADER] + chunk + png[_HEADER:])


def _is_render(file: Path) -> bool:
    return file.is_file() and _MADE in file.open("rb").read(_HEADER + 64)
