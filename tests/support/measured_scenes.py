"""Scenes of known unit and gravity as structure from motion gives them: under a random similarity, noised."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from perception.frame.recentre import moved
from perception.types import View
from support.rotations import rotation_from_quaternion
from worlds.cameras import orbit, walk

SIZE = (640, 480)


def cameras(scene: str, count: int) -> list[View]:
    """Views of the demo's camera paths, in metres, z up: "orbit" around a table or "walk" through a room of 4 × 5 m."""
    path = orbit(count, *SIZE, 28) if scene == "orbit" else walk(count, *SIZE, 28, np.array([2.0, 2.5]))
    return [
        View(f"{i:03d}.png", Path(f"{i:03d}.png"), camera.K, *SIZE, camera.camera_from_world)
        for i, camera in enumerate(path)
    ]


def random_similarity(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """(world_from_metres [4, 4], metres per unit): any rotation, a unit of 0.1 to 10 m, a shift."""
    metres = float(np.exp(rng.uniform(np.log(0.1), np.log(10))))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quaternion(rng.normal(size=4)) / metres
    matrix[:3, 3] = rng.normal(size=3) / metres
    return matrix, metres


def estimated(views: list[View], world_from_metres: np.ndarray, rng: np.random.Generator) -> list[View]:
    """The views in another world, with errors of structure from motion: 0.02° and 1 mm on each pose."""
    found = []
    for view in views:
        error = np.eye(4)
        error[:3, :3] = cv2.Rodrigues(np.radians(0.02) * rng.normal(size=3))[0]
        error[:3, 3] = 0.001 * rng.normal(size=3)
        noisy = View(view.name, view.photo, view.K, *SIZE, error @ view.camera_from_world)
        found.append(moved(noisy, world_from_metres))
    return found


def rolled(views: list[View], rng: np.random.Generator, each: float = 2.0, shared: float = 0.7) -> list[View]:
    """The views as people hold cameras: rolled by `each` degrees at random, and all by one random angle."""
    common, turned = shared * rng.normal(), []
    for view in views:
        roll = np.eye(4)
        roll[:3, :3] = cv2.Rodrigues(np.radians([0, 0, common + each * rng.normal()]))[0]
        turned.append(View(view.name, view.photo, view.K, *SIZE, roll @ view.camera_from_world))
    return turned


def seen(views: list[View], points: np.ndarray, pixel_noise: float, rng: np.random.Generator) -> np.ndarray:
    """x/z and y/z [V, K, 2] of points [K, 3] in metres under true views; NaN where a view does not see all of them."""
    rays = np.full((len(views), len(points), 2), np.nan)
    for number, view in enumerate(views):
        local = points @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
        pixels = (local @ view.K.T)[:, :2] / local[:, 2:]
        if (local[:, 2] > 0).all() and (pixels > 0).all() and (pixels < SIZE).all():
            noisy = pixels + pixel_noise * rng.normal(size=pixels.shape)
            rays[number] = (noisy - view.K[:2, 2]) / np.diag(view.K)[:2]
    return rays


def room_points(rng: np.random.Generator, count: int = 3000) -> np.ndarray:
    """[count, 3]: floor, table, two walls and clutter of a room of 4 × 5 m, with 1 cm of noise and 10 % outliers."""
    u, v = rng.uniform(-1, 1, (2, count))
    kind = rng.integers(6, size=count)
    floor, wall, side = np.c_[2 * u, 2.5 * v, 0 * u], np.c_[2 * u, 2.5 + 0 * u, 1.2 + 1.2 * v], 2.5 * v
    table, across = np.c_[0.6 * u, 0.4 * v, 0.75 + 0 * u], np.c_[2 + 0 * u, side, 1.2 + 1.2 * u]
    clutter = np.c_[2 * u, 2.5 * v, rng.uniform(0, 1.5, count)]
    points = np.select([kind[:, None] == k for k in range(5)], [floor, floor, wall, table, across], clutter)
    points = points + 0.01 * rng.normal(size=points.shape)
    out = rng.random(count) < 0.1
    points[out] += rng.normal(size=(out.sum(), 3))
    return points


def painted(view: View, texture: np.ndarray, world_from_texture: np.ndarray, path: Path) -> View:
    """Writes the view's photo of a grey world with one flat texture [h, w] uint8, 4 × 4 samples a pixel.

    world_from_texture [4, 4]: from texture pixels (x, y, 0, 1), whose centres lie at +0.5.
    """
    fine = 4
    camera = np.diag([fine, fine, 1.0]) @ view.K @ (view.camera_from_world @ world_from_texture)[:3][:, [0, 1, 3]]
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    width, height = view.width, view.height
    big = cv2.warpPerspective(
        texture,
        np.linalg.inv(half) @ camera @ half,
        (fine * width, fine * height),
        flags=cv2.INTER_AREA,
        borderValue=128,
    )
    small = big.reshape(height, fine, width, fine).mean(axis=(1, 3))
    cv2.imwrite(str(path), small.round().astype(np.uint8))
    return View(view.name, path, view.K, width, height, view.camera_from_world)


def tag_texture(number: int, side: int = 240, margin: int = 40, name: str = "APRILTAG_36h11") -> np.ndarray:
    """A tag whose black square has `side` pixels, in a white margin."""
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
    return np.pad(cv2.aruco.generateImageMarker(words, number, side), margin, constant_values=255)
