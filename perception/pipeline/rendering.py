"""`perception render`: pictures of a map from given cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.errors import InputError
from perception.gaussians.model import Gaussians
from perception.gaussians.rasterize import rasterize
from perception.instances.silhouettes import render_silhouettes
from perception.io.store import GaussianMap, read_map
from perception.types import View

KINDS = ("rgb", "depth", "instances", "features")


def render_map(map_path: Path, output: Path, cameras: Path | None, what: list[str]) -> tuple[dict[str, Any], str]:
    """Writes one picture per camera and kind: `NAME.png` for a single kind, `KIND/NAME.png` for several.

    rgb: 8-bit PNG. depth: 16-bit PNG, thousandths of the map's unit along the optical axis, 0 = nothing.
    instances: 16-bit PNG of id + 1, 0 = none. features: 8-bit PNG of the three main components.
    cameras: a transforms.json; None takes the map's held-out views (all views if none were held out).
    """
    for kind in what:
        if kind not in KINDS:
            raise InputError(f"--what: found '{kind}', expected one of: {', '.join(KINDS)}")
    gmap = read_map(map_path)
    views = map_views(gmap) if cameras is None else _cameras(cameras)
    gaussians = as_gaussians(gmap)
    for kind in what:
        folder = output if len(what) == 1 else output / kind
        for view in views:
            path = (folder / view.name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, _picture(kind, gaussians, gmap, view))
    facts = {"output": str(output), "views": len(views), "what": what}
    return facts, f"{output}: {len(views)} views of {', '.join(what)}"


def as_gaussians(gmap: GaussianMap) -> Gaussians:
    """A map's Gaussians as tensors."""
    names = ("means", "quats", "log_scales", "opacity_logits", "sh", "features")
    return Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(getattr(gmap, name))) for name in names})


def map_views(gmap: GaussianMap, held_out: bool = True) -> list[View]:
    """The views a map was made from: the held-out ones, or all when none were (or `held_out` is False)."""
    cameras = gmap.cameras
    rows = np.flatnonzero(cameras["held_out"]) if held_out else np.arange(len(cameras["names"]))
    if len(rows) == 0:
        rows = np.arange(len(cameras["names"]))
    return [
        View(
            str(cameras["names"][i]),
            Path(str(cameras["photos"][i])),
            cameras["K"][i],
            int(cameras["sizes"][i][0]),
            int(cameras["sizes"][i][1]),
            cameras["camera_from_world"][i],
        )
        for i in rows
    ]


def _cameras(path: Path) -> list[View]:
    from perception.io.transforms import read_cameras

    return read_cameras(path)


@torch.no_grad()
def _picture(kind: str, gaussians: Gaussians, gmap: GaussianMap, view: View) -> np.ndarray:
    pose = torch.from_numpy(view.camera_from_world.astype(np.float32))
    K = torch.from_numpy(view.K.astype(np.float32))
    if kind == "instances":
        found = render_silhouettes(gaussians, gmap.instance_ids, pose, K, view.width, view.height)
        return (found.ids + 1).astype(np.uint16)
    out = rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        pose[None],
        K[None],
        view.width,
        view.height,
        sh_degree=gaussians.sh_degree,
        features=gaussians.features if kind == "features" else None,
    )
    if kind == "rgb":
        return (out.colors[0].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    if kind == "features":
        from perception.pictures import features_to_rgb

        return features_to_rgb(out.features[0].numpy())
    alpha = out.alphas[0]
    depth = torch.where(alpha > 0.5, out.depths[0] / alpha.clamp(min=1e-6), torch.zeros_like(alpha))
    return (depth * 1000).round().clamp(0, 65535).numpy().astype(np.uint16)


def _write(path: Path, image: np.ndarray) -> None:
    import cv2

    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    if not cv2.imwrite(str(path), image):
        raise InputError(f"{path}: cannot be written; choose a writable -o")
