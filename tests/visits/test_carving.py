"""Carving against a ball on a floor, seen by cameras around it: every pixel's ray is intersected exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from perception.changes.carving import carved_surface
from perception.changes.evidence import mask_odds
from perception.changes.look import Look
from perception.gaussians.views import TrainingView
from support.aimed import look_at

CENTRE, RADIUS, SIZE, FOCAL = np.array([0.1, -0.05, 0.25]), 0.25, (90, 120), 130.0
NONE = np.zeros((0, 3))
ANGLES = np.radians(np.arange(0, 360, 36))


def pose(angle: float) -> np.ndarray:
    """camera_from_world of a camera 2 m away, which looks at the middle of the floor."""
    return look_at(np.array([2 * np.cos(angle), 2 * np.sin(angle), 1.2]), np.zeros(3), np.array([0, 0, 1.0]))


def painted(points: np.ndarray) -> np.ndarray:
    """Colours that no two places share."""
    return 0.5 + 0.45 * np.sin(np.stack([9 * points[..., i] + 2 * points[..., i - 1] for i in range(3)], axis=-1))


def photographed(angle: float, *, ball: bool = True) -> tuple[Look, np.ndarray]:
    """A photo of the ball, or of a round patch of the floor that was painted anew, and its pixels [h, w]. The map knows
    the floor alone. Nothing was measured."""
    camera = pose(angle)
    row, column = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    local = np.stack([(column - SIZE[1] / 2) / FOCAL, (row - SIZE[0] / 2) / FOCAL, np.ones(SIZE)], axis=-1)
    rays, origin = local @ camera[:3, :3], -camera[:3, :3].T @ camera[:3, 3]
    floor = origin[2] / -rays[..., 2]
    on_floor = origin + rays * floor[..., None]
    a, b = (rays**2).sum(axis=-1), rays @ (origin - CENTRE)
    root = b**2 - a * (((origin - CENTRE) ** 2).sum() - RADIUS**2)
    hit = (root > 0) if ball else (np.linalg.norm(on_floor[..., :2] - CENTRE[:2], axis=-1) < RADIUS)
    near = (-b - np.sqrt(np.maximum(root, 0))) / a if ball else floor
    colors = np.where(hit[..., None], painted(origin + rays * near[..., None]), painted(0.3 * on_floor) / 2)
    K = torch.tensor([[FOCAL, 0, SIZE[1] / 2], [0, FOCAL, SIZE[0] / 2], [0, 0, 1]])
    photo = torch.from_numpy(np.rint(255 * colors).astype(np.uint8))
    labels = torch.from_numpy(np.where(hit, 1, 2))
    view = TrainingView("a", photo, labels, K, torch.from_numpy(camera.astype(np.float32)))
    none, variance = np.zeros(SIZE), np.full(SIZE, 0.01)
    product = np.where(hit, 0.1 * variance, 0.9 * variance)
    return Look(view, floor, none, np.full(SIZE, -1), product, variance, variance, np.where(hit, 0.3, 0.02)), hit


def test_the_surface_of_a_ball_that_no_stereo_measured_is_found() -> None:
    looks, balls = zip(*(photographed(angle) for angle in ANGLES), strict=True)
    found = carved_surface(looks, balls, NONE)
    off = np.abs(np.linalg.norm(found.points - CENTRE, axis=1) - RADIUS)
    assert len(found.points) > 100 and np.median(off) < 0.02 and np.quantile(off, 0.9) < 0.06
    near = off < 0.02
    assert np.abs(found.colors[near] / 255 - painted(found.points[near])).mean() < 0.08
    upper = (found.points - CENTRE)[near] / RADIUS
    for axis in ([1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1]):  # from all sides
        assert (upper @ np.array(axis)).max() > 0.8


def test_a_photo_whose_mask_is_missing_does_not_hide_the_ball() -> None:
    looks, balls = zip(*(photographed(angle) for angle in ANGLES), strict=True)
    found = carved_surface(looks, [*balls[:-1], np.zeros(SIZE, bool)], NONE)
    off = np.abs(np.linalg.norm(found.points - CENTRE, axis=1) - RADIUS)
    assert len(found.points) > 60 and np.median(off) < 0.02


@pytest.mark.parametrize("start", [0, 3, 6])
def test_two_photos_are_enough(start: int) -> None:
    looks, balls = zip(*(photographed(angle) for angle in ANGLES[start : start + 2]), strict=True)
    found = carved_surface(looks, balls, NONE)
    off = np.abs(np.linalg.norm(found.points - CENTRE, axis=1) - RADIUS)
    assert len(found.points) > 100 and np.median(off) < 0.02 and np.quantile(off, 0.9) < 0.06


@pytest.mark.parametrize("count", [2, 10])
def test_paint_on_the_floor_is_no_thing(count: int) -> None:
    looks, patches = zip(*(photographed(angle, ball=False) for angle in ANGLES[:count]), strict=True)
    assert len(carved_surface(looks, patches, NONE).points) == 0


@pytest.mark.parametrize("why", ["measured", "known", "one photo", "nothing new", "blurred"])
def test_where_nothing_is_carved(why: str) -> None:
    looks, balls = zip(*(photographed(angle) for angle in ANGLES), strict=True)
    if why == "measured":
        looks = tuple(replace(look, measured=look.mapped) for look in looks)
    if why == "one photo":
        looks, balls = looks[:1], balls[:1]
    if why == "nothing new":
        balls = tuple(np.zeros(SIZE, bool) for _ in looks)
    if why == "blurred":  # and of the colours of the floor, as a far floor that the map shows without its texture
        looks = tuple(
            replace(look, rendered=look.rendered / 5, product=look.product / 5, colour=np.full(SIZE, 0.06))
            for look in looks
        )
    known = NONE
    if why == "known":  # as measured between other photos
        normal = np.random.default_rng(0).normal(size=(1500, 3))
        known = CENTRE + RADIUS * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    found = carved_surface(looks, balls, known)
    assert len(found.points) == len(found.colors) == 0


def test_the_odds_of_masks_by_hand() -> None:
    (look, _), small = photographed(0.0), torch.zeros(SIZE, dtype=torch.int64)
    odds, careful = mask_odds(look)
    assert odds[0] == np.inf
    assert odds[1] == pytest.approx(14 * (0.1 - 0.52) - 8 * (0.3 - 0.12)) and careful[1] == odds[1]
    assert odds[2] == pytest.approx(14 * (0.9 - 0.52) - 8 * (0.02 - 0.12)) and careful[2] == odds[2]
    blurred = replace(look, rendered=look.rendered * 0.4, product=look.product * np.sqrt(0.4))
    assert mask_odds(blurred)[1][1] == pytest.approx(14 * (0.1 - 0.52) * 0.25 - 8 * (0.3 - 0.12))
    small[:2, :3] = 1
    assert mask_odds(replace(look, view=replace(look.view, labels=small)))[0][1] == np.inf
