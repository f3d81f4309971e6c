"""Signs of a thing in photos whose depths and masks are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from perception.changes.evidence import in_free_space, looked_at, signs_of
from perception.changes.look import Look, in_view
from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.views import TrainingView, render
from perception.io.memory import DiskArrays
from perception.types import View
from perception.visits.record import recorded, with_parts
from perception.visits.rehearsal import rehearsed, showing, to_rehearse

SHAPE = 40, 50
BOX = np.s_[10:30, 10:40]


def shown(measured: float, *, same: bool = True, cover: int = 0) -> Look:
    """A photo of a thing in BOX at a depth of 2, where `measured` was measured; cover: its columns behind another."""
    rng = np.random.default_rng(0)
    inside = np.zeros(SHAPE, bool)
    inside[BOX] = True
    depth = np.full(SHAPE, measured)
    depth[:, 10 : 10 + cover] = 1.0
    labels = torch.from_numpy(np.where(inside & (depth > 1), 3, 1))
    view = TrainingView("a", torch.zeros(*SHAPE, 3, dtype=torch.uint8), labels, torch.eye(3), torch.eye(4))
    variance = rng.uniform(0.01, 0.02, SHAPE)
    product = variance * (0.9 if same else 0.1)
    return Look(view, np.full(SHAPE, 2.0), depth, np.where(inside, 7, -1), product, variance, variance, 0.1 * variance)


def test_a_thing_that_stands_there_a_thing_that_is_gone_and_a_hidden_one() -> None:
    still, gone = (
        signs_of([look] * 5, [7], np.ones(1), np.array([0.1]))[0] for look in (shown(2.0), shown(3.0, same=False))
    )
    assert still.hit == 1 and still.through == 0 and still.outline == 1 and still.correlation == pytest.approx(0.9)
    assert gone.through == 1 and gone.hit == 0 and gone.correlation == pytest.approx(0.1)
    assert still.log_odds > 3 and gone.log_odds < -3
    hidden = signs_of([shown(2.0, cover=30)], [7], np.zeros(1), np.array([0.1]))[0]
    assert hidden.pixels == 0 and not hidden.seen


def test_a_blurred_map_and_rays_that_were_not_measured_say_little_against_a_thing() -> None:
    """Its outline agrees and its texture does not; one row of its 20 was measured, behind it."""
    behind = np.zeros(SHAPE)
    behind[10, 10:40] = 3.0
    sharp = replace(shown(2.0, same=False), measured=behind)
    blurred = replace(sharp, rendered=sharp.rendered / 5, product=sharp.product / np.sqrt(5))
    plain = replace(sharp, **dict.fromkeys(("rendered", "shown", "product"), np.zeros(SHAPE)))
    looks = (sharp, blurred, plain)
    seen, unclear, nothing = (signs_of([look] * 5, [7], np.ones(1), np.array([0.1]))[0] for look in looks)
    assert seen.correlation == pytest.approx(0.1) and unclear.correlation == pytest.approx(0.1)
    assert seen.contrast == pytest.approx(1) and unclear.contrast == pytest.approx(0.2)
    assert seen.measured == 1 / 20 and seen.through == 1
    assert seen.log_odds < -3 and unclear.log_odds > 0 and nothing.log_odds > 0
    assert unclear.alike == pytest.approx(seen.alike)
    told = 3 * (1 - 0.6) - 8 * (unclear.colour - 0.12) - 2 * (1 - 0.2) / 20  # by hand, of WEIGHTS
    assert unclear.log_odds == pytest.approx(
        told * 3000 / 3500
    )  # of 5 photos with 600 pixels each, where 500 count half


def test_few_pixels_and_the_outline_of_what_is_hardly_a_thing_say_little() -> None:
    gone = signs_of([shown(3.0, same=False)] * 5, [7], np.ones(1), np.array([0.1]))[0]
    assert replace(gone, pixels=44).log_odds > 0.1 * gone.log_odds
    other = replace(gone, outline=0.0, through=0.0, correlation=0.52, colour=0.12)
    odds = [replace(other, score=score).log_odds for score in (1.0, 0.5, 0.0)]
    assert odds[0] == pytest.approx(3 * (0 - 0.6) * 3000 / 3500 + odds[2]) and odds[0] < odds[1] < odds[2]
    agrees = replace(other, outline=1.0)
    assert replace(agrees, score=0.1).log_odds == agrees.log_odds


def test_what_stands_in_front_is_not_looked_at() -> None:
    half = signs_of([shown(2.0, cover=15)], [7], np.ones(1), np.array([0.1]))[0]
    assert half.pixels == 20 * 15 and half.outline == 1 and half.hit == 1


def test_the_gaussians_in_view_are_those_that_project_into_it() -> None:
    view = TrainingView(
        "a", torch.zeros(20, 40, 3, dtype=torch.uint8), None, torch.tensor([[10.0, 0, 20], [0, 10, 10], [0, 0, 1]]),
        torch.eye(4),
    )  # fmt: skip
    means = np.array([[0, 0, 1.0], [1.9, 0, 1], [2.5, 0, 1], [0, 0, -1], [2.5, 0, 1]])
    assert in_view(means, np.array([0.01, 0.01, 0.01, 0.01, 0.2]), [view]).tolist() == [True, True, False, False, True]


def test_a_spot_where_no_photo_looks_is_worse_than_one_that_photos_contradict() -> None:
    (there,) = signs_of([shown(3.0, same=False)], [7], np.ones(1), np.array([0.1]))
    (hidden,) = signs_of([shown(2.0, cover=30)], [7], np.ones(1), np.array([0.1]))
    assert not hidden.photos and hidden.same < there.same < 0


def test_parts_of_a_thing_that_moved_lie_where_it_stands() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.1, 0.1, (60, 3)) + np.array([2, -1, 0.5])
    gaussians = from_points(points, np.zeros((60, 3), np.uint8), feature_dim=1, seed=0)
    part_ids = np.repeat([-1, 7, 8], 20)
    old = {"score": 0.5, "num_gaussians": 20, "centroid": [9, 9, 9], "views": 3, "label": "lid"}
    entry = {"id": 4, "parts": [{"id": 7, **old}, {"id": 9, **old}, {"id": 8, **old}]}
    lid, cup = with_parts(entry, gaussians, part_ids)["parts"]  # 9 has no Gaussians any more
    assert (lid["id"], lid["label"], cup["id"]) == (7, "lid", 8)
    for part, own in ((lid, points[20:40]), (cup, points[40:])):
        assert np.allclose(part["centroid"], own.mean(axis=0), atol=1e-3) and part["num_gaussians"] == 20
        assert np.allclose(part["aabb"]["min"], own.min(axis=0), atol=0.02)
    assert with_parts({"id": 4}, gaussians, part_ids) == {"id": 4}


def wall() -> Gaussians:
    """A plain wall at z = 2 from x = -1 to 1 and y = -0.5 to 0.5."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, 81), torch.linspace(-0.5, 0.5, 41), indexing="ij")
    grid = torch.stack([x, y, torch.full_like(x, 2.0)], dim=2).reshape(-1, 3)
    n = len(grid)
    return Gaussians(
        means=grid,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.tensor([[0.02, 0.02, 0.002]]).log().repeat(n, 1),
        opacity_logits=torch.full((n,), 6.0),
        sh=torch.zeros(n, 16, 3),
        features=torch.zeros(n, 2),
    )


K = np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]])
VIEWS = [View(str(x), Path(), K, 320, 240, np.eye(4) - np.eye(4, k=3) * x) for x in (-0.2, 0.2)]


def test_a_place_was_looked_at_where_two_views_saw_it_before_the_wall() -> None:
    """Exact sight lines of cameras that look along z."""
    points = np.array(
        [[0, 0, 1.0], [0.3, 0.2, 1.99], [0, 0, 2.5], [5, 0, 1.0], [0, 0, -1.0], [0.6, 0, 1.0], [0, 2, 6.0]]
    )
    # Of the last but one only the second view is near enough, |x - 0.2| < z 160 / 300; the last is seen past the wall.
    looked, through = looked_at(wall(), VIEWS, points)
    assert looked.tolist() == [True, True, False, False, False, False, True]
    assert through.tolist() == [True, False, False, False, False, False, False], "to the wall, not on or past it"
    assert not np.any(looked_at(wall(), VIEWS[:1], points))


def test_removed_is_less_sure_than_that_it_does_not_stand_there() -> None:
    """Of 43 things of made visits that were said to be removed 30 were, and 13 moved."""
    (signs,) = signs_of([shown(4.0, same=False)] * 3, [7], np.ones(1), np.ones(1))
    entry = {"id": 7, "centroid": [0.0] * 3, "obb": {}, "aabb": {}}
    sure = 1 / (1 + np.exp(signs.log_odds / 2))
    removed = recorded(entry, 1, signs, None, True)
    assert removed["state"] == "removed" and sure > 0.8
    assert removed["confidence"] == pytest.approx(sure * 30 / 43, abs=0.01)
    assert recorded(entry, 1, signs, None, False)["confidence"] == pytest.approx(1 - sure, abs=1e-3)


def test_what_is_rehearsed_is_the_render_but_where_something_new_stands_or_stood() -> None:
    """A ball of 0.1 before the wall and one behind it: pixels of the first do not count, nor those past the wall."""
    front, behind = (replace(wall().rows(torch.arange(1)), log_scales=torch.full((1, 3), -3.0)) for _ in range(2))
    front.means[:], behind.means[:] = torch.tensor([0.1, 0.0, 1.0]), torch.tensor([0.1, 0.0, 3.0])
    both = rehearsed(to_rehearse([(view, 1) for view in VIEWS], 160, 9), wall(), Gaussians.concatenate([front, behind]))
    plain = rehearsed(to_rehearse([(view, 1) for view in VIEWS], 160, 1), wall(), behind)
    assert [view.name for view in both] == ["rehearsed -0.2", "rehearsed 0.2"] and len(plain) == 1
    row, column = np.mgrid[:120, :160] + 0.5
    for view, x in zip(both, (-0.2, 0.2), strict=True):
        away = np.hypot(column - 80 - 150 * (0.1 - x), row - 60) / 150  # at the depth of the ball
        on_wall = (np.abs((row - 60) / 75) < 0.45) & (np.abs((column - 80) / 75 + x) < 0.95)
        weight = view.weight.numpy()
        assert (weight[on_wall & (away > 0.2)] == 1).all() and (weight[away < 0.1] == 0).all()
        assert (weight[np.abs((row - 60) / 75) > 0.55] == 0).all()
        image = render(wall(), view.camera_from_world, view.K, 160, 120, harmonics=True).colors[0]
        assert np.abs(view.photo.numpy() / 255 - image.numpy()).max() < 0.003
    assert (plain[0].weight.numpy()[(np.abs(row - 60) < 25) & (np.abs(column - 95) < 40)] == 1).all()


def test_renders_lie_in_the_memory_of_photos_with_the_same_bits(tmp_path: Path) -> None:
    """With none of it, in files: photo and weight of each view, and nothing else."""
    arrays, kept = DiskArrays(tmp_path, 0), list[np.ndarray]()

    def keep(image: np.ndarray) -> np.ndarray:
        kept.append(arrays.keep(image))
        return kept[-1]

    plain, bounded = (
        rehearsed(to_rehearse([(view, 1) for view in VIEWS], 160, 9), wall(), wall().rows(torch.arange(0)), *given)
        for given in ((), (keep,))
    )
    images = [image for view in bounded for image in (view.photo, view.weight)]
    assert all(np.shares_memory(image.numpy(), there) for image, there in zip(images, kept, strict=True))
    for view, other in zip(plain, bounded, strict=True):
        assert torch.equal(view.photo, other.photo) and torch.equal(view.weight, other.weight)


def test_views_of_the_other_side_of_a_wall_are_not_rehearsed() -> None:
    """A poster 30 cm before a wall, and cameras on both sides; one looks away, one was held out of training."""
    poster = replace(wall(), means=wall().means * 0.3 + torch.tensor([0, 0, 1.1]))
    both = Gaussians.concatenate([wall(), poster])
    behind = np.diag([-1.0, 1, -1, 1])
    behind[:3, 3] = -behind[:3, :3] @ [0, 0, 4.0]
    away = replace(VIEWS[0], camera_from_world=np.diag([-1.0, 1, -1, 1]))
    held = replace(VIEWS[0], held_out=True)
    back = np.eye(4)
    back[2, 3] = 9
    far = replace(VIEWS[0], camera_from_world=back)
    views = [*VIEWS, replace(VIEWS[0], camera_from_world=behind), away, held, far]
    seen = np.arange(len(both)) >= len(wall())
    shown = showing(views, both, seen, 5.0)
    assert showing(views, both, seen, 12.0)[:-1] == shown and showing(views, both, seen, 0.1) == []
    assert [view for view, _ in shown] == [*VIEWS, held]
    few = shown[0][0], 0.05 * shown[0][1]
    assert [view.name for view in to_rehearse([few, *shown[1:]], 160, 9)] == [f"rehearsed {VIEWS[1].name}"]


def test_what_two_photos_see_through_is_free_space() -> None:
    """Points on the axis of the photos, whose measured depth is 3: before it, within its noise, behind it; not in the
    picture; and where nothing was measured."""
    look = shown(3.0)
    points = np.array([[0, 0, 2.0], [0, 0, 2.95], [0, 0, 3.5], [-90, 0, 2.0]])
    view = replace(look.view, K=torch.tensor([[1.0, 0, 20], [0, 1, 20], [0, 0, 1]]))
    looks = [replace(look, view=view)] * 2
    assert in_free_space(looks, points).tolist() == [True, False, False, False]
    assert not in_free_space(looks[:1], points).any()
    assert not in_free_space([replace(each, measured=np.zeros(SHAPE)) for each in looks], points).any()
