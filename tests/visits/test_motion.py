"""Motions of things between visits, against motions that are known."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import render
from perception.instances.group import Grouping
from perception.visits.motion import assigned
from perception.visits.registration import Points, angle_between, carried, register
from perception.visits.today import _without_fragments
from support.aimed import look_at

UP = np.array([0.0, 0.0, 1.0])


def motion(degrees: float, step: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * UP).as_matrix()
    pose[:3, 3] = step
    return pose


def thing(rng: np.random.Generator, count: int = 600) -> Points:
    """The surface of a box with an edge of its own colour."""
    points = rng.uniform(-1, 1, (count, 3))
    side = rng.integers(0, 3, count)
    points[np.arange(count), side] = np.sign(points[np.arange(count), side])
    colors = 0.5 + 0.4 * np.sin(4 * points + [0, 1, 2])
    return Points(points * [0.1, 0.06, 0.03], colors)


def test_a_known_motion_is_found_from_a_part_of_the_thing() -> None:
    rng = np.random.default_rng(1)
    old, true = thing(rng), motion(137.0, (0.4, -0.2, 0.1))
    again = thing(rng, 900)
    seen = again.points @ true[:3, :3].T @ UP > 0  # the upper half
    moved = again.points @ true[:3, :3].T + true[:3, 3]
    residual, found = register(old, Points(moved[seen], again.colors[seen]), UP)[0]
    assert angle_between(found, true) < 3 and np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.004 and residual < 0.2


def test_a_carried_thing_looks_as_the_thing_does_from_the_carried_camera() -> None:
    """Rendering is the oracle: to move a thing and the camera by the same motion changes nothing."""
    rng = np.random.default_rng(2)
    generator = torch.Generator().manual_seed(0)
    gaussians = isotropic(
        rng.uniform(-0.3, 0.3, (40, 3)),
        torch.full((40,), -2.5),
        torch.rand(40, 3, generator=generator),
        0.7,
        2,
        generator,
    )
    gaussians.sh = torch.cat([gaussians.sh, 0.2 * torch.randn(40, 15, 3, generator=generator)], dim=1)
    gaussians.log_scales = gaussians.log_scales + torch.tensor([0.5, 0.0, -0.5])
    pose = look_at(np.array([1.5, 0.7, 0.8]), np.zeros(3), UP)
    turn = motion(71.0, (0.2, 0.3, -0.1))
    K = torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]])

    def image(shown: Gaussians, camera: np.ndarray) -> np.ndarray:
        out = render(shown, torch.from_numpy(camera.astype(np.float32)), K, 80, 60, harmonics=True)
        return out.colors[0].numpy()

    before, after = image(gaussians, pose), image(carried(gaussians, turn), pose @ np.linalg.inv(turn))
    assert before.max() > 0.3
    assert np.quantile(np.abs(before - after), 0.99) < 2e-3


def test_pairs_have_the_largest_sum_of_log_odds() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        odds = rng.normal(0, 3, (4, 4))
        odds[rng.random((4, 4)) < 0.3] = -np.inf
        best = max(sum(max(0.0, odds[i, j] - 1) for i, j in enumerate(order)) for order in permutations(range(4)))
        pairs = assigned(odds, 1.0)
        assert np.isclose(sum(odds[i, j] - 1 for i, j in pairs), best) and all(odds[i, j] > 1 for i, j in pairs)


def test_small_groups_in_hardly_any_mask_are_no_things() -> None:
    sizes = [200, 60, 50]
    ids = np.repeat(np.arange(3), sizes).astype(np.int32)
    none = np.full(len(ids), -1, np.int32)
    made = _without_fragments(Grouping(ids, np.ones(len(ids)), np.array([0.1, 0.9, 0.1]), none), 32)
    assert np.bincount(made.ids[made.ids >= 0], minlength=3).tolist() == [200, 60, 0]
