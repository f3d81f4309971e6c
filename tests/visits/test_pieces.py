"""What goes, and pieces of a moved thing that grew apart from it, in photos rendered from what truly stands there."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix

from perception.changes.evidence import Signs, signs_from
from perception.changes.look import Look, look
from perception.config import load_config
from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, render
from perception.masks.votes import MaskVotes
from perception.visits import today
from perception.visits.growth import grouped
from perception.visits.today import _apart, _gone, _pieces
from perception.visits.visit import Visit
from support.aimed import look_at

K, SIDE = torch.tensor([[110.0, 0, 48], [0, 110, 48], [0, 0, 1]]), 96


def block(low: tuple[float, ...], high: tuple[float, ...], seed: int, count: int = 400) -> Gaussians:
    """A box full of small balls, each of its own colour."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    points, colors = rng.uniform(low, high, (count, 3)), torch.rand(count, 3, generator=generator)
    return isotropic(points, torch.full((count,), -4.2), colors, 0.9, 2, generator)


CHAIR = block((-0.1, -0.1, 0), (0.1, 0.1, 0.3), 1)
LEG = CHAIR.means.numpy()[:, 0] > 0.05
"""The part of the chair that grew apart from it."""
BOX = block((0.1, -0.1, 0), (0.13, 0.1, 0.3), 2)
"""What stood elsewhere, and would fit beside the chair."""


def visit_of(truth: Gaussians) -> Visit:
    """A visit whose photos show `truth`, from all sides."""
    views = []
    for angle in np.arange(6):
        eye = np.array([0.7 * np.cos(angle), 0.7 * np.sin(angle), 0.5])
        camera = torch.from_numpy(look_at(eye, np.array([0, 0, 0.15]), np.array([0, 0, 1.0])).astype(np.float32))
        image = render(truth, camera, K, SIDE, SIDE, harmonics=True).colors[0]
        views.append(TrainingView("a", (image.clamp(0, 1) * 255).to(torch.uint8), None, K, camera))
    nothing = np.zeros((SIDE, SIDE), np.float32)

    def looks(gaussians: Gaussians, ids: np.ndarray) -> list[Look]:
        return [look(gaussians, ids, view, nothing) for view in views]

    return cast(Visit, SimpleNamespace(looks=looks))


@pytest.mark.parametrize("paired", [False, True])
def test_a_leg_is_a_piece_of_the_chair_also_where_it_was_taken_for_a_box(paired: bool) -> None:
    things = [(np.flatnonzero(~LEG), 0.9), (np.flatnonzero(LEG), 0.6)]
    whole = {0: CHAIR} | ({1: BOX} if paired else {})
    assert _pieces(visit_of(CHAIR), CHAIR, things, whole) == {1}


@pytest.mark.parametrize("paired", [False, True])
def test_a_box_beside_the_chair_that_the_photos_show_is_none(paired: bool) -> None:
    grown = Gaussians.concatenate([CHAIR, BOX])
    things = [(np.arange(400), 0.9), (np.arange(400, 800), 0.9)]
    whole = {0: CHAIR} | ({1: BOX} if paired else {})
    assert _pieces(visit_of(grown), grown, things, whole) == set()


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_two_new_things_are_two_whatever_method_made_the_map(preset: str) -> None:
    """A metre apart, each in a mask of its own in all photos; features say nothing of them yet."""
    things = Gaussians.concatenate([CHAIR, block((1, 0, 0), (1.2, 0.2, 0.3), 3)])
    pixels = np.zeros((800, 12), np.float32)
    pixels[:400, ::2] = pixels[400:, 1::2] = 9
    masks = np.repeat(np.arange(6), 2), pixels.sum(axis=0, dtype=np.float64)
    votes = MaskVotes(csr_matrix(pixels), csr_matrix((800, 6), dtype=np.float32), *masks)
    found = grouped(things, votes, np.arange(800), load_config(preset=preset))
    assert found.count == 2 and [np.unique(half).size for half in np.split(found.ids, 2)] == [1, 1]


def test_a_thing_that_moved_away_from_all_that_it_was_known_by_leaves_that_apart() -> None:
    """Photos may draw a motion beyond the new thing that it began at; no Gaussian is left at its number then."""
    far = block((0.7, 0.7, 0), (0.9, 0.9, 0.3), 3)
    grown = Gaussians.concatenate([CHAIR, BOX])
    things, whole = [(np.arange(400), 0.9), (np.arange(400, 800), 0.8)], {0: CHAIR, 1: far}
    apart = _apart(things, grown.means.double().numpy(), whole, 32)
    assert [len(rows) for rows, _ in apart] == [400, 0, 400] and apart[2][1] == 0.8
    assert _pieces(visit_of(grown), grown, apart, whole) == set()


@pytest.mark.parametrize("seen_through", [400, 390])
def test_a_screen_as_large_as_the_room_goes_once_all_of_it_is_seen_through(seen_through: int) -> None:
    """And a wall stays, of which less is. All rays end 3 m away; the rest of the screen is outside of the photo."""
    view = TrainingView("a", torch.zeros(SIDE, SIDE, 3, dtype=torch.uint8), None, K, torch.eye(4))
    far, ids = np.full((SIDE, SIDE), 3.0, np.float32), np.repeat([4, 9], 400)
    screen, box = block((-0.5, -0.5, 1.5), (0.5, 0.5, 1.51), 3), block((-0.1, -0.1, 1.9), (0.1, 0.1, 2.1), 4)
    screen.means[seen_through:, 0] += 9
    nothing = np.zeros((SIDE, SIDE))
    looks = [Look(view, far, far, np.full((SIDE, SIDE), -1), nothing, nothing, nothing, nothing)] * 2
    instances = [{"id": 4, "obb": {"extent": [1, 1, 0.01]}}, {"id": 9, "obb": {"extent": [0.2, 0.2, 0.2]}}]
    gmap = SimpleNamespace(instances=instances, instance_ids=ids)
    visit = cast(Visit, SimpleNamespace(gmap=gmap, gaussians=Gaussians.concatenate([screen, box]), ids=ids))
    other = signs_from(np.array([3, 900, 0.1, 1, 1, 90, 900, 300, 500, 400, 50], float), 1.0)
    gone, haze = _gone(visit, looks, [other, other])
    assert gone == ([4, 9] if seen_through == 400 else [9])
    assert haze.tolist() == [n < seen_through for n in range(800)]


def test_what_masks_outline_is_surface_though_too_coarse_to_be_a_thing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four things that grew: one that photos show; one too coarse; one too coarse that masks hardly outline, and one
    in a single photo."""
    kinds = (5, 0.9), (5, 0.4), (5, 0.4), (1, 0.9)  # photos, correlation
    grew = [Signs(n, 900, 1.0, known, 0.7, 0.1, 0.1, 0.8, 1.0, 0.9) for n, known in kinds]
    assert [each.alike > 1 for each in grew] == [True, False, False, True]
    monkeypatch.setattr(today, "signs_of", lambda *_: grew)
    things = [(np.arange(5 * n, 5 * n + 5), score) for n, score in enumerate((0.9, 0.6, 0.3, 0.9))]
    visit: Any = SimpleNamespace(looks=lambda *_: [])
    true, _, surface = today._true(visit, [], [], cast(Any, range(20)), things, [])
    assert [rows.tolist() for rows, _ in true] == [[0, 1, 2, 3, 4]] and surface.tolist() == [5, 6, 7, 8, 9]


@pytest.mark.parametrize(("depth", "outline", "told"), [(0.9, 0.5, True), (1.0, 0.5, False), (1.0, 0.7, True)])
def test_ground_that_a_thing_hid_asks_for_a_better_outline(
    depth: float, outline: float, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a thing of id 7 is gone, which stood 1 m away, or what grew stands in front of that. Masks outline what
    stays with an IoU of .8."""
    view = TrainingView("a", torch.zeros(SIDE, SIDE, 3, dtype=torch.uint8), None, K, torch.eye(4))
    zero, one = np.zeros((SIDE, SIDE)), np.ones((SIDE, SIDE))
    before = Look(view, one, zero, np.full((SIDE, SIDE), 7), zero, zero, zero, zero)
    after = replace(before, mapped=depth * one, ids=np.zeros((SIDE, SIDE), int))
    stays, grew = (Signs(5, 900, 1.0, 0.9, iou, 0.1, 0.1, 0.8, 1.0, 0.9) for iou in (0.8, outline))
    monkeypatch.setattr(today, "signs_of", lambda *_: [grew])
    visit: Any = SimpleNamespace(looks=lambda *_: [after])
    true, _, _ = today._true(visit, [before], [stays], cast(Any, range(9)), [(np.arange(9), 0.9)], [7])
    assert bool(true) == told
