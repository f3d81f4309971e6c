"""What of a map goes that belongs to no instance, in photos and depths rendered from what truly stands there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
import torch

from perception.changes.look import Look, look
from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, expected_depth, render
from perception.visits.ghosts import clusters, compared_without, ghosts, seen_through
from perception.visits.visit import Visit
from support.aimed import look_at

SIDE = 96
K = torch.tensor([[110.0, 0, SIDE / 2], [0, 110, SIDE / 2], [0, 0, 1]])


def balls(points: np.ndarray, color: tuple[float, ...], size: float, seed: int = 0) -> Gaussians:
    """Small balls of nearly one colour."""
    generator = torch.Generator().manual_seed(seed)
    colors = torch.tensor(color) + 0.1 * torch.rand(len(points), 3, generator=generator)
    return isotropic(points, torch.full((len(points),), float(np.log(size))), colors, 0.95, 2, generator)


def floor() -> Gaussians:
    points = np.stack([a.ravel() for a in np.meshgrid(*[np.linspace(-0.8, 0.8, 65)] * 2)], axis=1)
    return balls(np.column_stack([points, np.zeros(len(points))]), (0.6, 0.5, 0.4), 0.016)


def column(x: float, y: float, radius: float, color: tuple[float, ...]) -> Gaussians:
    """An upright tube."""
    turn, z = np.meshgrid(np.linspace(0, 2 * np.pi, 12, endpoint=False), np.linspace(0.1, 0.4, 30))
    points = np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn), z], axis=-1).reshape(-1, 3)
    return balls(points, color, 0.007)


FLOOR, LAMP = floor(), column(0.15, 0.1, 0.04, (0.1, 0.1, 0.6))
POLE = column(-0.2, -0.1, 0.004, (0.1, 0.4, 0.1))
MAP = Gaussians.concatenate([FLOOR, LAMP, POLE])
PART = np.repeat([0, 1, 2], [len(FLOOR), len(LAMP), len(POLE)])


def visit_of(truth: Gaussians, measured: Gaussians, ids: np.ndarray, shift: float = 0.0) -> tuple[Visit, list[Look]]:
    """A visit whose photos show `truth` from six sides and whose depths are those of `measured`; its looks at MAP, with
    instances ids [N]. shift: of the photos, in pixels."""
    looks = []
    for angle in np.arange(6):
        eye = np.array([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.6])
        camera = torch.from_numpy(look_at(eye, np.array([0, 0, 0.15]), np.array([0, 0, 1.0])).astype(np.float32))
        image = render(truth, camera, K, SIDE, SIDE, harmonics=True).colors[0].clamp(0, 1).numpy()
        image = cv2.warpAffine(image, np.array([[1, 0, shift], [0, 1, 0.0]]), (SIDE, SIDE), borderMode=1)
        depth = expected_depth(render(measured, camera, K, SIDE, SIDE)).numpy()
        view = TrainingView("a", torch.from_numpy(np.rint(255 * image)).to(torch.uint8), None, K, camera)
        looks.append(look(MAP, ids, view, depth))
    rows = SimpleNamespace(gaussians=MAP, ids=ids, gmap=SimpleNamespace(instance_ids=ids))
    rows.part = lambda chosen: MAP.rows(torch.from_numpy(np.flatnonzero(chosen)))
    return cast(Visit, rows), looks


def lost(visit: Visit, looks: list[Look]) -> list[float]:
    """Share of the floor, the lamp and the pole that are ghosts."""
    found = ghosts(visit, looks, np.ones(len(PART), bool))
    return [float(found[n == PART].mean()) for n in range(3)]


@pytest.mark.parametrize("instance", [-1, 7], ids=["of none", "of the floor's"])
def test_a_lamp_of_no_instance_that_was_taken_away_goes_and_a_pole_that_stands_stays(instance: int) -> None:
    """Stereo measures the floor behind both."""
    visit, looks = visit_of(Gaussians.concatenate([FLOOR, POLE]), FLOOR, np.where(PART == 0, 7, instance))
    free = seen_through(looks, MAP.means.double().numpy())
    assert free[PART == 1].mean() > 0.8 and free[PART == 2].mean() > 0.9
    assert np.array_equal(ghosts(visit, looks, np.ones(len(PART), bool)), free & (PART == 1))


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_where_nothing_changed_nothing_goes_wherever_stereo_sees_through(shift: float) -> None:
    """Also where photos lie a pixel beside the map."""
    assert lost(*visit_of(MAP, FLOOR, np.full(len(PART), -1), shift)) == [0, 0, 0]


def test_what_depth_did_not_measure_stays_whatever_photos_show() -> None:
    """And so does what was measured where it stood, and most of an instance that stays."""
    away = Gaussians.concatenate([FLOOR, POLE])
    none = np.full(len(PART), -1)
    nothing = FLOOR.rows(torch.zeros(0, dtype=torch.long))
    assert lost(*visit_of(away, nothing, none)) == [0, 0, 0]
    assert lost(*visit_of(away, MAP, none)) == [0, 0, 0]
    assert lost(*visit_of(away, FLOOR, PART)) == [0, 0, 0]


def test_photos_show_what_stands_and_not_what_went_by_the_closed_form() -> None:
    """Of photos without the lamp shown is 0, of photos with it 1."""
    free = PART == 1
    none, truths = np.full(len(PART), -1), (Gaussians.concatenate([FLOOR, POLE]), MAP)
    looks = [visit_of(truth, FLOOR, none)[1] for truth in truths]
    (gone, change), (stands, same) = (compared_without(MAP, free, each) for each in looks)
    seen = change > 0.1
    assert np.array_equal(change, same) and seen.mean() > 0.5
    np.testing.assert_allclose(gone[seen] / change[seen], 0, atol=0.02)  # 8 bits: .002 of a difference of .3
    np.testing.assert_allclose(stands[seen] / change[seen], 1, atol=0.02)


def test_points_within_reach_of_each_other_are_one_cluster() -> None:
    x = np.array([0.0, 0.9, 1.8, 5.0, 5.9, 9.0])
    found = clusters(np.column_stack([x, 0 * x, 0 * x]), 1.0)
    assert found.tolist() == [0, 0, 0, 1, 1, 2]
