"""What stereo among a visit's photos finds where something new stands, against the exact depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from PIL import Image

from perception.changes.colours import grey_photo, in_grey
from perception.changes.look import Look, depth_at, moments, stereo_of
from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, render
from perception.pipeline.optimise import Photos
from perception.types import DepthImage, View
from perception.visits.visit import _of_this_place

H, W = 120, 160
K = np.array([[150.0, 0, W / 2], [0, 150.0, H / 2], [0, 0, 1]])
WALL, BOX = 2.0, 1.6


def texture(rng: np.random.Generator, strength: float) -> np.ndarray:
    """[400, 400] smooth brightness around one half."""
    import cv2

    noise = cv2.GaussianBlur(rng.normal(size=(400, 400)), (0, 0), 2.0)
    return 0.5 + strength * noise / noise.std()


def plane(brightness: np.ndarray, depth: float, x: float) -> np.ndarray:
    """[H, W] brightness of a plane at `depth` from a camera at x; 100 texels a metre."""
    v, u = np.mgrid[:H, :W] + 0.5
    columns = 100 * ((u - K[0, 2]) / K[0, 0] * depth + x) + 200
    rows = 100 * (v - K[1, 2]) / K[1, 1] * depth + 200
    return brightness[np.rint(rows).astype(int) % 400, np.rint(columns).astype(int) % 400]


def shot(name: str, x: float, wall: np.ndarray, box: np.ndarray) -> tuple[View, TrainingView, Look, np.ndarray]:
    """A photo of a plain box before a wall, beside a map of the wall alone; and the exact depth."""
    u = np.arange(W) + 0.5
    hit = np.abs((u - K[0, 2]) / K[0, 0] * BOX + x) < 0.25
    hit = hit[None] & (np.abs(np.arange(H) + 0.5 - H / 2)[:, None] < 30)
    old, new = plane(wall, WALL, x), plane(box, BOX, x)
    image, photo = (np.repeat(a[..., None], 3, axis=2).astype(np.float32) for a in (old, np.where(hit, new, old)))
    pose = np.eye(4)
    pose[0, 3] = -x
    bytes_ = np.clip(255 * photo, 0, 255).astype(np.uint8)
    view = View(name, Path(name), K, W, H, pose)
    camera = (torch.from_numpy(a.astype(np.float32)) for a in (K, pose))
    training = TrainingView(name, torch.from_numpy(bytes_), None, *camera)
    none, ids = np.zeros((H, W), np.float32), np.full((H, W), -1)
    mapped = np.full((H, W), WALL, np.float32)
    shown = Look(training, mapped, none, ids, *moments(image, photo), np.abs(image - photo).mean(axis=2))
    return view, training, shown, np.where(hit, BOX, WALL)


def test_a_plain_new_thing_is_not_drawn_to_the_surface_behind_it() -> None:
    rng = np.random.default_rng(0)
    wall, box = texture(rng, 0.12), texture(rng, 0.01) + 0.3
    shots = [shot(f"{n}.jpg", x, wall, box) for n, x in enumerate(np.linspace(-0.4, 0.4, 5))]
    views, photos, looks, exact = zip(*shots, strict=True)
    found = stereo_of(views, photos, looks)
    for stereo, depth in zip(found, exact, strict=True):
        assert stereo is not None
        off = np.abs(depth_at(stereo, (H, W), confirmed=False) / depth - 1) < 0.03
        assert off[depth == BOX].mean() > 0.9 and off[depth == WALL].mean() > 0.95


def test_nothing_is_measured_where_the_sensor_measured_nothing() -> None:
    """There the map's depth only fills the image: it is no sign that the box, which the map shows, still stands."""
    rng = np.random.default_rng(0)
    wall, box = texture(rng, 0.12), texture(rng, 0.01) + 0.3
    shots = [shot(f"{n}.jpg", x, wall, box) for n, x in enumerate(np.linspace(-0.4, 0.4, 5))]
    views, photos, looks, exact = zip(*shots, strict=True)
    depths = [torch.from_numpy(np.where(depth == BOX, 0, depth).astype(np.float32)) for depth in exact]
    measured = [replace(view, depth=DepthImage(Path("depth.png"), 1.0)) for view in views]
    mapped = [
        replace(each, mapped=depth.astype(np.float32), view=replace(each.view, depth=sensor))
        for each, depth, sensor in zip(looks, exact, depths, strict=True)
    ]
    for stereo, depth in zip(stereo_of(measured, photos, mapped), exact, strict=True):
        found = depth_at(stereo, (H, W))
        assert not found[depth == BOX].any()
        assert (found[depth == WALL] > 0).mean() > 0.5  # what two other photos see
        assert np.abs(found[found > 0] / WALL - 1).max() < 0.03


def test_the_map_in_grey_is_the_grey_of_its_render() -> None:
    """Pillow's brightness of a photo, and of a render of coloured harmonics."""
    generator = torch.Generator().manual_seed(0)
    n, pose = 300, torch.eye(4)
    pose[2, 3] = 2.0
    gaussians = Gaussians(
        means=torch.rand(n, 3, generator=generator) - 0.5,
        quats=torch.randn(n, 4, generator=generator),
        log_scales=torch.full((n, 3), -3.0),
        opacity_logits=torch.zeros(n),
        sh=0.1 * torch.randn(n, 16, 3, generator=generator),  # no colour below 0
        features=torch.zeros(n, 2),
    )
    colours, grey = (
        render(g, pose, torch.from_numpy(K).float(), W, H, harmonics=True).colors[0]
        for g in (gaussians, in_grey(gaussians))
    )
    image = (255 * colours.clamp(0, 1)).to(torch.uint8)
    pillow = np.asarray(Image.fromarray(image.numpy()).convert("L"))
    inside = ((colours > 0) & (colours < 1)).all(dim=2).numpy()
    assert inside.mean() > 0.5
    assert np.abs(255 * grey.numpy() - pillow[..., None])[inside].max() < 2.0  # two roundings to 8 bits
    view = TrainingView("a", image, None, torch.from_numpy(K).float(), pose)
    assert np.abs(grey_photo(view).photo.numpy().astype(int) - pillow[..., None]).max() <= 1


def test_photos_of_another_place_are_left_out_also_where_they_are_held_out() -> None:
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    points, colors = rng.uniform(-1, 1, (900, 3)), torch.rand(900, 3, generator=generator)
    scene = isotropic(points, torch.full((900,), -2.5), colors, 0.9, 2, generator)
    posed, decoded = [], []
    for n in range(12):
        pose = np.eye(4)
        pose[:3, 3] = 0.1 * n - 0.6, 0, 3
        camera = (torch.from_numpy(a.astype(np.float32)) for a in (pose, K))
        view = TrainingView(f"{n}.jpg", torch.zeros(H, W, 3, dtype=torch.uint8), None, *reversed([*camera]))
        image = render(scene, view.camera_from_world, view.K, W, H, harmonics=True).colors[0].clamp(0, 1)
        decoded.append(replace(view, photo=(255 * image).to(torch.uint8)))
        posed.append(View(view.name, Path(view.name), K, W, H, pose))
    for n in (0, 5):  # one of each part
        decoded[n] = replace(decoded[n], photo=torch.randint(0, 256, (H, W, 3), generator=generator).to(torch.uint8))
    photos = Photos(posed[1:8], [posed[0], *posed[8:]], decoded[1:8], [decoded[0], *decoded[8:]])
    gmap: Any = SimpleNamespace(path=Path("home.gsmap"))
    here, looks, foreign = _of_this_place(Path("visit"), gmap, photos, scene, np.zeros(900, np.int32))
    assert sorted(foreign) == ["0.jpg", "5.jpg"]
    names = [[view.name for view in part] for part in (here.training, here.views, [each.view for each in looks])]
    assert names == [["1.jpg", "2.jpg", "3.jpg", "4.jpg", "6.jpg", "7.jpg"]] * 3
    assert [v.name for v in here.held_out] == [v.name for v in here.held] == [f"{n}.jpg" for n in range(8, 12)]
