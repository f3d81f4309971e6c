"""Motions of things between visits, against motions that are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from perception.changes.colours import GREY, HUES, LOOKS, colour_odds
from perception.changes.look import seen_from
from perception.changes.motion import (
    Cut,
    _upright_starts,
    assigned,
    judged,
    other_sides,
    refined,
)
from perception.changes.registration import Points, angle_between, carried, compact, looks_round, register
from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, render
from perception.instances.group import Grouping
from perception.types import View
from perception.visits.today import _apart, _without_fragments
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


def speckled(rng: np.random.Generator, generator: torch.Generator) -> Gaussians:
    """Of the box of `thing`, each of its own colour."""
    points, colors = thing(rng, 500).points, torch.rand(500, 3, generator=generator)
    return isotropic(points, torch.full((500,), -4.6), colors, 0.9, 2, generator)


def photographed(gaussians: Gaussians, true: np.ndarray, eyes: Sequence[tuple[float, float, float]]) -> list[Cut]:
    """Photos of a thing after the motion `true`, from cameras at `eyes` that look where it went; nothing else is."""
    K, cuts = torch.tensor([[110.0, 0, 32], [0, 110, 32], [0, 0, 1]]), []
    for eye in eyes:
        camera = torch.from_numpy(look_at(np.array(eye), true[:3, 3], UP).astype(np.float32))
        out = render(carried(gaussians, true), camera, K, 64, 64, harmonics=True)
        photo = (out.colors[0].clamp(0, 1) * 255).to(torch.uint8)
        labels = (out.alphas[0] > 0.5).to(torch.int32)
        view = TrainingView("a", photo, labels, K, camera)
        empty = np.zeros((64, 64), np.float32)
        cuts.append(Cut(view, empty, np.zeros((64, 64, 3), np.float32), np.full((64, 64), np.inf)))
    return cuts


def test_a_motion_is_refined_to_the_one_that_the_photos_show() -> None:
    """Photos are renders of the moved thing, so the motion is known; the search starts 9° and 2 cm off."""
    rng = np.random.default_rng(4)
    generator = torch.Generator().manual_seed(1)
    gaussians = speckled(rng, generator)
    true = motion(40.0, (0.1, 0.05, 0.0))
    cuts = photographed(gaussians, true, ((0.6, 0.1, 0.4), (-0.3, 0.5, 0.4), (0.0, -0.5, 0.6)))
    start = motion(49.0, (0.12, 0.05, 0.0))
    found = refined(gaussians, judged(gaussians, [start], cuts, 0.06)[0], cuts, 0.06, 0.1, 0.03)
    assert found[0].same > judged(gaussians, [start], cuts, 0.06)[0][0].same + 1
    assert angle_between(found[1], true) < 2 and np.linalg.norm((found[1] - true)[:3, 3]) < 0.003


@pytest.mark.parametrize("light", [1.0, 0.6])
@pytest.mark.parametrize("shown", [(0.2, 0.3, 0.5), (0.45, 0.2, 0.45), (0.5, 0.5, 0.5)])
def test_the_hue_of_a_thing_is_compared_whatever_its_brightness(shown: tuple[float, ...], light: float) -> None:
    """Things of one colour before black: the shares of red, green and blue are those of the colours."""
    generator, true = torch.Generator().manual_seed(1), motion(40.0, (0.1, 0.05, 0.0))
    points, sizes = thing(np.random.default_rng(4), 500).points, torch.full((500,), -4.6)

    def painted(color: Sequence[float]) -> Gaussians:
        return isotropic(points, sizes, torch.tensor(color).expand(500, 3), 0.9, 2, generator)

    old = (0.2, 0.3, 0.5)
    cuts = photographed(painted([light * c for c in shown]), true, ((0.6, 0.1, 0.4), (-0.3, 0.5, 0.4)))
    differ = sum(abs(a / sum(old) - b / sum(shown)) for a, b in zip(old, shown, strict=True))
    # Photos have 8 bits, cut off: up to 1/255 of each colour.

    def odds_of(color: Sequence[float], pose: np.ndarray, alike: float) -> float:
        return colour_odds(painted(color), alike, np.sum([cut.colours(painted(color), pose) for cut in cuts], axis=0))

    odds = odds_of(old, true, LOOKS[1] + 0.1)
    assert odds == pytest.approx(0.1 * LOOKS[0] + HUES[0] * (differ - HUES[1]), abs=-HUES[0] * 0.02)
    away = motion(0.0, (9.0, 9.0, 0.0))
    assert odds_of(old, away, LOOKS[1]) == 0.0, "where no photo looks nothing is known"
    assert odds_of((0.4, 0.4, 0.4), true, 1.0) == GREY, "nor where nothing has a colour"


def test_another_turn_is_excluded_only_where_the_sides_that_it_would_show_were_seen() -> None:
    """Two photos from +x. Of a box seen all around, no other turn is possible; of one seen from +x, or from +x and -x,
    the turns that show the sides between. Where one of two photos would show a side that was not seen, but the other
    one that was, that one excludes the turn."""
    generator = torch.Generator().manual_seed(1)
    gaussians = speckled(np.random.default_rng(4), generator)
    around = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians(np.arange(0, 360, 30))])
    cuts = photographed(gaussians, np.eye(4), ((0.6, 0.1, 0.1), (0.6, -0.1, 0.1)))
    for seen, unknown in ((around, False), (around[:1], True), (around[[0, 6]], True), (np.zeros((0, 3)), True)):
        assert other_sides(gaussians, np.eye(4), cuts, UP, 0.06, seen) is unknown
    both = photographed(gaussians, np.eye(4), ((0.6, 0.1, 0.1), (-0.6, 0.1, 0.1)))
    front_and_back = around[[0, 1, 2, 10, 11, 6]]
    assert not other_sides(gaussians, np.eye(4), both, UP, 0.06, front_and_back)


def test_the_pixels_of_a_thing_within_others_are_those_less_than_its_extent_behind_them() -> None:
    generator = torch.Generator().manual_seed(1)
    gaussians = speckled(np.random.default_rng(4), generator)
    (cut,) = photographed(gaussians, np.eye(4), ((0.6, 0.0, 0.0),))
    front = 0.5  # its nearest side, of the camera at .6
    for depth, share in ((front - 0.03, 1.0), (front - 0.2, 0.0), (front + 0.2, 0.0)):
        shown, within = replace(cut, depth=np.full((64, 64), depth)).within(gaussians, np.eye(4), 0.06)
        assert shown > 300 and abs(within / shown - share) < 0.02
    halved = np.where(np.arange(64) < 32, front - 0.03, np.inf) * np.ones((64, 1))
    shown, within = replace(cut, depth=halved).within(gaussians, np.eye(4), 0.06)
    assert abs(within / shown - 0.5) < 0.05


def test_a_thing_of_which_the_lower_half_is_hidden_starts_with_its_top_in_place() -> None:
    rng = np.random.default_rng(6)
    old, true = thing(rng), motion(60.0, (0.3, -0.1, 0.02))
    points = old.points @ true[:3, :3].T + true[:3, 3]
    upper = points[:, 2] > np.median(points[:, 2]) + 0.005
    for new, lowest in ((points, 12), (points[upper], 24)):
        starts = _upright_starts(old, Points(new, np.zeros_like(new)), UP)
        assert len(starts) == lowest
        near = min(starts, key=lambda pose: angle_between(pose, true) + 100 * abs((pose - true)[2, 3]))
        assert angle_between(near, true) < 1 and abs((near - true)[2, 3]) < 0.003


def test_directions_are_to_the_cameras_that_have_a_thing_in_their_picture() -> None:
    K, points = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]]), np.array([[1.0, 2, 0], [1.2, 2, 0], [0.8, 2, 0]])

    def view(eye: tuple[float, float, float], at: tuple[float, float, float]) -> View:
        return View("a", Path("a"), K, 100, 80, look_at(np.array(eye), np.array(at), UP))

    views = [
        view((3, 2, 0), (1, 2, 0)),
        view((1, 2, -4), (1, 2.5, 0)),
        view((3, 2, 0), (5, 2, 0)),
        view((1, 0, 0), (3, 2, 0)),
    ]
    assert seen_from(views, points) == pytest.approx(np.array([[1.0, 0, 0], [0, 0, -1]]), abs=1e-12)
    assert seen_from([], points).shape == (0, 3)


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
        best = max(sum(max(0.0, odds[i, j]) for i, j in enumerate(order)) for order in permutations(range(4)))
        pairs = assigned(odds)
        assert np.isclose(sum(odds[i, j] for i, j in pairs), best) and all(odds[i, j] > 0 for i, j in pairs)


def test_what_is_out_of_reach_of_a_moved_thing_is_a_thing_of_its_own() -> None:
    generator = torch.Generator().manual_seed(1)
    gaussians = speckled(np.random.default_rng(4), generator)
    own = gaussians.means.double().numpy()
    other, few = own + np.array([0.5, 0, 0]), own[:5] + np.array([0, 0.7, 0])
    means = np.concatenate([own, other, few])
    rows = np.arange(len(own)), np.arange(len(own), 2 * len(own)), np.arange(2 * len(own), len(means))
    joined, plain = (np.concatenate([rows[0], rows[1]]), 0.5), (rows[0], 0.9)
    apart = _apart([plain, joined], means, {1: gaussians}, 10)
    assert [each.tolist() for each, _ in apart] == [each.tolist() for each in (rows[0], rows[0], rows[1])]
    assert [score for _, score in apart] == [0.9, 0.5, 0.5]
    stray = (np.concatenate([rows[0], rows[2]]), 0.5)  # too few for a thing: they go with the moved one
    assert _apart([plain, stray], means, {1: gaussians}, 10) == [plain, stray]


def test_small_groups_in_hardly_any_mask_are_no_things() -> None:
    sizes = [200, 60, 50]
    ids = np.repeat(np.arange(3), sizes).astype(np.int32)
    none = np.full(len(ids), -1, np.int32)
    made = _without_fragments(Grouping(ids, np.ones(len(ids)), np.array([0.1, 0.9, 0.1]), none), 32)
    assert np.bincount(made.ids[made.ids >= 0], minlength=3).tolist() == [200, 60, 0]
