"""Empty places are filled where the truth has a surface, only they, within the room there is, and always alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from perception.gaussians.densify import fill_holes
from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.views import TrainingView, render_view, visible_in

SIZE, DEPTH = 64, 2.0


def wall(hole: tuple[float, float, float, float] | None) -> Gaussians:
    """A grey wall at z = DEPTH, dense enough to be opaque, without the points of x0, x1, y0, y1."""
    x, y = np.meshgrid(np.linspace(-1.3, 1.3, 60), np.linspace(-1.3, 1.3, 60))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, DEPTH)], axis=1)
    if hole is not None:
        inside = (
            (points[:, 0] > hole[0]) & (points[:, 0] < hole[1]) & (points[:, 1] > hole[2]) & (points[:, 1] < hole[3])
        )
        points = points[~inside]
    return from_points(points, np.full((len(points), 3), 128, np.uint8), feature_dim=3, seed=0, opacity=0.95)


def view(shift: float = 0.0) -> TrainingView:
    pose = torch.eye(4)
    pose[0, 3] = shift
    K = torch.tensor([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1.0]])
    photo = torch.full((SIZE, SIZE, 3), 128, dtype=torch.uint8)
    photo[:, :, 0] = 200
    return TrainingView(f"{shift}", photo, None, K, pose)


HOLE = (-0.5, 0.3, -0.4, 0.5)


def test_the_hole_gets_gaussians_on_the_wall_in_the_photos_colour() -> None:
    gaussians = wall(HOLE)
    born, lacking = fill_holes(gaussians, [view(), view(0.05)], 10_000, seed=1)
    area = (HOLE[1] - HOLE[0]) * (HOLE[3] - HOLE[2]) / DEPTH**2  # of the picture, which is 1 wide at unit depth
    assert 0.3 * area < lacking < area  # the first view's filling leaves the second little
    assert torch.allclose(born.means[:, 2], torch.tensor(DEPTH), atol=0.02)
    low, high = torch.tensor([HOLE[0], HOLE[2]]), torch.tensor([HOLE[1], HOLE[3]])
    spread = 0.13  # half a block at that depth
    assert bool(((born.means[:, :2] > low - spread) & (born.means[:, :2] < high + spread)).all())
    torch.testing.assert_close(born.base_colors, torch.tensor([200, 128, 128]).expand(len(born), 3) / 255)

    before = render_view(gaussians, view())
    after = render_view(Gaussians.concatenate([gaussians, born]), view())
    centre = slice(24, 36)
    assert float(before[centre, centre].max()) < 0.1 and float(after[centre, centre, 0].min()) > 0.25


def test_a_hole_beside_something_near_is_filled_far_behind_it() -> None:
    """Most of the picture shows a tree at half the depth of the wall; between the two nothing is known."""
    gaussians = wall((-9, 0.6, -9, 9))
    tree = wall((-0.1, 9, -9, 9))
    tree.means /= 2
    tree.log_scales -= np.log(2)
    born, lacking = fill_holes(Gaussians.concatenate([gaussians, tree]), [view()], 1000, seed=1)
    assert lacking > 0.2 and len(born) > 0
    assert bool((born.means[:, 2] > 0.9 * DEPTH).all())


def test_half_resolution_finds_the_empty_places_of_the_full_picture() -> None:
    """Oracle: the full picture. A third of the wall's points, finer than a pixel, leave it emptier than half; blurred
    by the 0.3 px² of larger pixels it would look covered (mean opacity .78)."""
    thin = wall(None)
    thin = thin.rows(torch.arange(0, len(thin), 3))
    thin.log_scales = torch.full_like(thin.log_scales, 0.008).log()
    full, half = (fill_holes(thin, [shown], 0, seed=1)[1] for shown in (view(), view().halved()))
    assert full == 1 and half > 0.5, (full, half)


def test_a_covered_wall_gets_nothing_and_the_room_holds() -> None:
    born, lacking = fill_holes(wall(None), [view()], 1000, seed=1)
    assert len(born) == 0 and lacking == 0
    for room in (0, 1, 3):
        assert len(fill_holes(wall(HOLE), [view(), view(0.4)], room, seed=1)[0]) == room


def test_a_picture_that_is_wholly_empty_tells_no_depth() -> None:
    away = view()
    away.camera_from_world[:3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    born, lacking = fill_holes(wall(None), [away], 1000, seed=1)
    assert len(born) == 0 and lacking == 1


@pytest.mark.parametrize("threads", [1, 2])
def test_filling_repeats(threads: int) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        one, two = (fill_holes(wall(HOLE), [view(), view(0.1)], 1000, seed=7)[0] for _ in range(2))
    finally:
        torch.set_num_threads(before)
    for name, tensor in one.named().items():
        assert torch.equal(tensor, getattr(two, name))


def test_what_no_view_sees_is_known() -> None:
    gaussians = wall(None)
    gaussians.means[5] = torch.tensor([0.0, 0.0, 2 * DEPTH])  # behind the wall
    gaussians.means[7] = torch.tensor([0.0, 0.0, -1.0])  # behind the camera
    seen = visible_in(gaussians, view())
    without = gaussians.rows(torch.nonzero(seen).flatten())
    assert not seen[5] and not seen[7] and 0 < int(seen.sum()) < len(seen)
    assert torch.equal(render_view(gaussians, view()), render_view(without, view()))
