"""The posed scene of a finished splat: renders of virtual cameras with exact depth, and photos where there are some."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from perception.colors import rgb8_from_sh
from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.model import Gaussians
from perception.gaussians.views import expected_depth, psnr, render
from perception.inputs.colmap import model_frames, models_below
from perception.inputs.readers import reader_of
from perception.inputs.transforms import read_frames, transforms_files
from perception.io.atomic import write_file
from perception.io.documents import read_json
from perception.map.outputs import check_empty
from perception.photos.decode import load_photo, scaled_K
from perception.photos.video import FRAMES_RECORD
from perception.photos.views import make_view
from perception.sfm.options import ReadOptions
from perception.splats.cameras import FOCAL, choose_views, intrinsics
from perception.splats.gravity import direction
from perception.splats.panoramas import proxy_of, survey
from perception.splats.read import Splat
from perception.splats.surface import hide, sampled
from perception.types import DepthImage, Scene, View

WIDTH = 640
"""Pixels of a virtual view's width, at most `photos.max_side`."""
POINTS = 20_000
"""Means that stand for the scene's sparse cloud."""
LEAST_SEEN = 0.2
"""Share of a given camera's pixels that show the scene, in the median, below which cameras are of another frame."""
UNLIKE = 15.0
"""PSNR in dB between given photos and renders, in the median, below which a warning is given."""


@dataclass(frozen=True)
class Rendered:
    """A view's render: colors [H, W, 3] uint8, depth [H, W] float32 along its axis, 0 = nothing."""

    colors: np.ndarray
    depth: np.ndarray


def drawn(splat: Splat, hidden: np.ndarray, features: torch.Tensor) -> Gaussians:
    """The Gaussians of which hidden ones are never drawn; other arrays are shared with `splat`."""
    tensors = {name: torch.from_numpy(array) for name, array in splat.arrays().items()}
    tensors["opacity_logits"] = torch.from_numpy(hide(splat, hidden))
    return Gaussians(**tensors, features=features)


def splat_scene(
    splat: Splat, gaussians: Gaussians, hidden: np.ndarray, folder: Path, config: MapConfig, options: ReadOptions
) -> Scene:
    """Views of the scene in the splat's own frame: those of `splat.cameras` first, then virtual ones. gaussians: as
    they are drawn. Renders and depth are written to `folder`. InputError for cameras that see nothing of the scene, and
    as `claim`."""
    claim(folder, splat, config)
    side, cameras = config.photos.max_side, None if config.splat.cameras is None else Path(config.splat.cameras)
    means = splat.means[~hidden].astype(np.float64)
    points, colors = _cloud(splat, hidden)
    given, notes = ([], []) if cameras is None else _given(cameras, replace(options, cloud=(points, colors)))
    given, warnings = _with_renders(given, gaussians, folder, side, cameras)
    up = None if config.splat.up is None else direction(config.splat.up)
    proxy = proxy_of(gaussians, hidden)
    found = survey(proxy, means, up, options.progress)
    poses = np.array([view.camera_from_world for view in given]).reshape(-1, 4, 4)
    focal = float(np.median([view.K[0, 0] / view.width for view in given])) if given else FOCAL
    width = min(WIDTH, side)
    chosen = choose_views(found, proxy, width, poses, focal)
    views = given + _virtual(chosen.poses, gaussians, width, folder)
    parked = int(splat.parked.sum())
    facts = {"gaussians": len(splat), "not_finite": parked, "hidden": int(hidden.sum()) - parked, **chosen.facts}
    facts["given_views"] = len(given)
    report: dict[str, Any] = {
        "input": "splat",
        "gravity": found.gravity.to_json(),
        "splat": facts,
        "notes": [*splat.notes, *notes, _told(facts)],
        "warnings": warnings,
        "left_out": [],
        "mean_reprojection_error_px": None,
        "seconds": {},
    }
    metric = config.splat.unit is not None
    if metric:
        report["scale"] = {"metres_per_unit": 1.0, "source": "--unit metre", "standard_error": None}
    return Scene(sorted(views, key=lambda view: view.name), points, colors, metric, report=report)


def claim(folder: Path, splat: Splat, config: MapConfig) -> None:
    """Makes the folder for renders, with a record of what they show. InputError where it holds other files, such as the
    renders of another scene or of other settings: they may be photos of a map that was renamed since."""
    rendered_by = json.dumps([config.splat.model_dump(), config.photos.max_side]).encode()
    record = {"splat": hashlib.sha256(splat.means.tobytes() + splat.sh.tobytes() + rendered_by).hexdigest()[:16]}
    listed = folder / FRAMES_RECORD
    if not listed.is_file() or read_json(listed) != record:
        check_empty(folder)
    write_file(listed, json.dumps(record), parents=True)


def _virtual(poses: np.ndarray, gaussians: Gaussians, width: int, folder: Path) -> list[View]:
    (K, height), views = intrinsics(width), []
    for number, pose in enumerate(poses):
        name = f"virtual/{number:03d}.png"
        view = View(name, folder / name, K, width, height, pose)
        views.append(_written(view, rendered(gaussians, pose, K, width, height), folder))
    return views


def rendered(gaussians: Gaussians, pose: np.ndarray, K: np.ndarray, width: int, height: int) -> Rendered:
    """What a pinhole camera sees: K [3, 3], pose camera_from_world [4, 4]."""
    tensors = torch.from_numpy(pose).float(), torch.from_numpy(K).float()
    out = render(gaussians, *tensors, width, height, harmonics=True)
    colors = (out.colors[0].clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()
    return Rendered(colors, expected_depth(out).numpy())


def _cloud(splat: Splat, hidden: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rows = sampled(np.flatnonzero(~hidden), POINTS)
    return splat.means[rows].astype(np.float64), rgb8_from_sh(splat.sh[rows, 0])


def _told(facts: dict[str, Any]) -> str:
    given = f"{facts['given_views']} given and " if facts["given_views"] else ""
    seen = f"{facts['seen_by_five']:.0%} of the surface that can be seen is seen by five or more"
    return f"{facts['hidden']} Gaussians are hidden as floaters; {given}{facts['views']} virtual views: {seen}"


def _given(cameras: Path, options: ReadOptions) -> tuple[list[View], list[str]]:
    """The views of a posed input, and notes. One without any of its photos gives its poses alone."""
    reader = reader_of(cameras)
    if not reader.poses:
        raise InputError(f"{cameras}: is read as {reader.name}; expected a COLMAP workspace or a transforms.json")
    if reader.sizes(cameras).sizes:
        scene = reader.read(cameras, replace(options, poses="keep", still=False))
        return scene.views, [f"{len(scene.views)} photos with poses of {cameras}"]
    if models_below(cameras):
        frames = model_frames(cameras)
    else:
        frames = [frame for file in transforms_files(cameras) for frame in read_frames(file)]
    views = [make_view(f"given/{n:04d}.png", Path(), lens, pose, cameras) for n, (_, pose, lens) in enumerate(frames)]
    return views, [f"{len(views)} poses without photos of {cameras}"]


def _with_renders(
    views: list[View], gaussians: Gaussians, folder: Path, side: int, cameras: Path | None
) -> tuple[list[View], list[str]]:
    """Given views with depth of the scene, and with a render for a photo where they have none; warnings."""
    done, shares, likeness = [], [], []
    for view in views:
        has_photo = view.photo != Path()
        share = min(1.0, side / max(view.width, view.height))
        photo = load_photo(view, side) if has_photo else None
        shape = (round(view.height * share), round(view.width * share)) if photo is None else photo.shape[:2]
        K = scaled_K(view, shape[1], shape[0])
        seen = rendered(gaussians, view.camera_from_world, K, shape[1], shape[0])
        shares.append(float((seen.depth > 0).mean()))
        if photo is None:
            pinhole = View(view.name, folder / view.name, K, shape[1], shape[0], view.camera_from_world)
            done.append(_written(pinhole, seen, folder))
        else:
            likeness.append(psnr(torch.from_numpy(seen.colors / np.float32(255)), torch.from_numpy(photo)))
            done.append(replace(view, depth=_depth_file(folder, view.name, seen.depth)))
    if shares and float(np.median(shares)) < LEAST_SEEN:
        what = f"{np.median(shares):.0%} of their pixels show the scene, in the median"
        raise InputError(f"{cameras}: its cameras are of another frame: {what}; give cameras in the splat's frame")
    if likeness and float(np.median(likeness)) < UNLIKE:
        return done, [f"{cameras}: photos differ from the scene ({np.median(likeness):.1f} dB): another frame?"]
    return done, []


def _written(view: View, seen: Rendered, folder: Path) -> View:
    view.photo.parent.mkdir(parents=True, exist_ok=True)
    view.photo.write_bytes(cv2.imencode(".png", seen.colors[:, :, ::-1])[1].tobytes())
    return replace(view, depth=_depth_file(folder, view.name, seen.depth))


def _depth_file(folder: Path, name: str, depth: np.ndarray) -> DepthImage:
    file = folder / "depth" / f"{name}.npy"
    file.parent.mkdir(parents=True, exist_ok=True)
    np.save(file, depth)
    return DepthImage(file, 1.0)
