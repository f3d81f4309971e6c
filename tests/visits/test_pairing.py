"""Things that masks split, and that moved as one, in photos rendered from what truly stands there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch

from perception.changes.motion import Motion, stands_after
from perception.changes.registration import Points, angle_between, carried, touching
from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, render
from perception.progress import QUIET
from perception.visits.pairing import _paired, along, moved, whole
from perception.visits.visit import Visit
from support.aimed import look_at

K, SIDE = torch.tensor([[110.0, 0, 48], [0, 110, 48], [0, 0, 1]]), 96
TRUE = np.eye(4)
TRUE[:3, :3] = [[np.cos(0.7), -np.sin(0.7), 0], [np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]]
TRUE[:3, 3] = [0.4, 0.2, 0]


def block(low: tuple[float, ...], high: tuple[float, ...], seed: int, count: int = 400) -> Gaussians:
    """A box full of small balls, each of its own colour."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    points, colors = rng.uniform(low, high, (count, 3)), torch.rand(count, 3, generator=generator)
    return isotropic(points, torch.full((count,), -4.2), colors, 0.9, 2, generator)


SEAT, BACK = block((-0.1, -0.1, 0), (0.1, 0.1, 0.15), 1), block((-0.1, 0.06, 0.15), (0.1, 0.1, 0.4), 2)
LAMP = block((-0.1, -0.2, 0), (0, -0.11, 0.5), 3)
"""It stood beside the chair, and was taken away with it."""


def frames_of(truth: Gaussians) -> list[tuple[TrainingView, np.ndarray]]:
    """Photos of `truth` alone, from all sides, of one mask; nothing was measured."""
    frames = []
    for angle in np.arange(6):
        middle = TRUE[:3, 3] + np.array([0, 0, 0.15])
        eye = middle + np.array([0.7 * np.cos(angle), 0.7 * np.sin(angle), 0.4])
        camera = torch.from_numpy(look_at(eye, middle, np.array([0, 0, 1.0])).astype(np.float32))
        out = render(truth, camera, K, SIDE, SIDE, harmonics=True)
        photo, labels = (out.colors[0].clamp(0, 1) * 255).to(torch.uint8), (out.alphas[0] > 0.5).to(torch.int32)
        frames.append((TrainingView("a", photo, labels, K, camera), np.zeros((SIDE, SIDE), np.float32)))
    return frames


def test_parts_of_a_chair_that_masks_split_moved_as_one_and_a_lamp_beside_it_did_not() -> None:
    olds = {4: SEAT, 7: LAMP, 9: BACK}
    chair = carried(Gaussians.concatenate([SEAT, BACK]), TRUE)
    entries = [{"id": i, "obb": {"extent": np.ptp(old.means.numpy(), axis=0).tolist()}} for i, old in olds.items()]
    run, gmap = SimpleNamespace(progress=QUIET), SimpleNamespace(instances=entries, info={})
    seen = np.array([[np.cos(a), np.sin(a), 0.5] for a in np.arange(6)]) / np.sqrt(1.25)
    sides: Any = SimpleNamespace(thing=olds.get, seen_from=lambda i: seen, away={}, gmap=gmap, run=run)
    sides.frames = frames_of(chair)
    pairs = moved(cast(Visit, sides), chair, [(np.arange(len(chair)), 0.9)], [4, 7, 9])
    assert sorted(pairs) == [4, 9] and {j for j, _ in pairs.values()} == {0}
    for _, motion in pairs.values():
        assert angle_between(motion.new_from_old, TRUE) < 3
        assert np.linalg.norm((motion.new_from_old - TRUE)[:3, 3]) < 0.01


def test_two_things_touch_where_boxes_do() -> None:
    far = block((1, -0.1, 0), (1.2, 0.1, 0.15), 4)
    near = touching([Points.of(each) for each in (SEAT, BACK, far)])
    assert near[~np.eye(3, dtype=bool)].tolist() == [True, False, True, False, False, False]


def test_what_touches_is_taken_as_long_as_it_fits_better() -> None:
    """A chain 0-1-2-3 and one apart; with thing 2 the odds fall, so that nothing beyond it is reached."""
    near = np.zeros((5, 5), bool)
    for a in range(3):
        near[a, a + 1] = near[a + 1, a] = True
    gain = {0: 1.0, 1: 2.0, 2: -0.5, 3: 4.0, 4: 9.0}
    assert whole(0, 1.0, near, lambda parts: sum(gain[a] for a in parts)) == (0, 1)
    gain[2] = 0.5
    assert whole(0, 1.0, near, lambda parts: sum(gain[a] for a in parts)) == (0, 1, 2, 3)
    assert whole(5, 1.0, near, lambda parts: 9.0) == (5,)  # of an earlier visit


def test_no_part_is_in_two_pairs() -> None:
    odds = {((0,), 0): 1.0, ((0, 1), 0): 3.0, ((1,), 1): 2.0, ((2,), 1): 0.5, ((2, 1), 1): 2.5}
    pairs = _paired([10, 11, 12], {key: Motion(np.eye(4), value) for key, value in odds.items()}, 2)
    assert {i: j for i, (j, _) in pairs.items()} == {10: 0, 11: 0, 12: 1}
    assert [motion.ambiguous for _, motion in pairs.values()] == [False, False, True]  # others fit thing 1 better


def test_what_was_near_a_moved_thing_moved_with_it_where_photos_show_it_there() -> None:
    """7 was near 4 alone, and does not stand there; 9 near 4 and 5, 8 near none; 5, less sure, stands there, too."""
    gone, near = [4, 5, 7, 8, 9], np.zeros((5, 5), bool)
    for a, b in ((0, 1), (0, 2), (0, 4), (1, 4)):
        near[a, b] = near[b, a] = True
    pairs = {4: (0, Motion(TRUE, 6.0)), 5: (1, Motion(np.eye(4), 5.0))}
    odds = {(2, True): -1.0, (4, True): 1.0, (4, False): -3.0, (1, True): 9.0}
    found = along(gone, pairs, near, lambda a, pose: odds[a, np.array_equal(pose, TRUE)])
    assert {i: (j, motion.odds) for i, (j, motion) in found.items()} == {5: (1, 6.0), 9: (0, 1.0)}
    assert all(np.array_equal(motion.new_from_old, TRUE) for _, motion in found.values())


def test_the_back_of_a_chair_stands_where_its_seat_went_and_a_lamp_does_not() -> None:
    frames, seat = frames_of(carried(Gaussians.concatenate([SEAT, BACK]), TRUE)), carried(SEAT, TRUE)
    assert stands_after(BACK, TRUE, frames, seat, 0.04) > 3
    assert stands_after(LAMP, TRUE, frames, seat, 0.09) < -3
