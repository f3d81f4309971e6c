"""Motions of things between visits, against motions that are known."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, render
from perception.instances.group import Grouping
from perception.visits.motion import Cut, assigned, judged, refined
from perception.visits.registration import Points, angle_between, carried, compact, looks_round, register
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


def test_floaters_far_from_a_thing_are_strays_and_no_part_of_common_shapes_is_one() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, (400, 3))
    box = thing(rng).points
    pan = np.concatenate([x[:300] * [0.2, 0.2, 0.02], x[300:] * [0.2, 0.02, 0.02] + [0.4, 0, 0]])  # with its handle
    for points in (x * [1, 0.02, 0.02], x * [1, 1, 0.01], x / np.linalg.norm(x, axis=1)[:, None], box, pan):
        assert compact(points).all()
        size = np.ptp(points, axis=0).max()
        floaters = rng.uniform(3, 9, (len(points) // 5, 3)) * size
        kept = compact(np.concatenate([points, floaters]))
        assert kept[: len(points)].all() and not kept[len(points) :].any()
    assert compact(np.zeros((0, 3))).shape == (0,)


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


def test_a_motion_is_refined_to_the_one_that_the_photos_show() -> None:
    """Photos are renders of the moved thing, so the motion is known; the search starts 9° and 2 cm off."""
    rng = np.random.default_rng(4)
    generator = torch.Generator().manual_seed(1)
    points, colors = thing(rng, 500).points, torch.rand(500, 3, generator=generator)
    gaussians = isotropic(points, torch.full((500,), -4.6), colors, 0.9, 2, generator)
    true = motion(40.0, (0.1, 0.05, 0.0))
    K, cuts = torch.tensor([[110.0, 0, 32], [0, 110, 32], [0, 0, 1]]), []
    for eye in ((0.6, 0.1, 0.4), (-0.3, 0.5, 0.4), (0.0, -0.5, 0.6)):
        camera = torch.from_numpy(look_at(np.array(eye), true[:3, 3], UP).astype(np.float32))
        out = render(carried(gaussians, true), camera, K, 64, 64, harmonics=True)
        photo = (out.colors[0].clamp(0, 1) * 255).to(torch.uint8)
        labels = (out.alphas[0] > 0.5).to(torch.int32)
        view = TrainingView("a", photo, labels, K, camera)
        empty = np.zeros((64, 64), np.float32)
        cuts.append(Cut(view, empty, np.zeros((64, 64, 3), np.float32), np.full((64, 64), np.inf)))
    start = motion(49.0, (0.12, 0.05, 0.0))
    found = refined(gaussians, judged(gaussians, [start], cuts, 0.06)[0], cuts, 0.06, 0.1, 0.03)
    assert found[0].same > judged(gaussians, [start], cuts, 0.06)[0][0].same + 1
    assert angle_between(found[1], true) < 2 and np.linalg.norm((found[1] - true)[:3, 3]) < 0.003


def test_round_things_are_told_from_those_with_a_handle_and_those_with_a_stripe() -> None:
    rng = np.random.default_rng(5)
    angle, height = rng.uniform(0, 2 * np.pi, 900), rng.uniform(-0.05, 0.05, 900)
    can = np.stack([0.04 * np.cos(angle), 0.04 * np.sin(angle), height], axis=1)
    shade = 0.4 + 0.3 * np.cos(angle)[:, None]  # light from one side
    plain = Points(can, shade * [0.9, 0.5, 0.3])
    handle = rng.uniform([0.045, -0.005, -0.03], [0.08, 0.005, 0.03], (150, 3))
    striped = np.where(np.abs(angle - 2)[:, None] < 0.5, [0.2, 0.3, 0.9], [0.9, 0.5, 0.3])
    assert looks_round(plain, UP) and not looks_round(plain, np.array([1.0, 0, 0]))
    assert not looks_round(Points(np.concatenate([can, handle]), np.full((1050, 3), 0.5)), UP)
    assert not looks_round(Points(can, striped), UP)


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
