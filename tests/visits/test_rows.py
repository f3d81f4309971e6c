"""Which Gaussians of a map the photos of a visit show, against exact sight lines."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView, render
from perception.map.map import Map
from perception.pipeline.optimise import Photos
from perception.visits.rows import TOLD, shape_of, shown_rows, told_rows
from perception.visits.visit import Visit, gaussians_of

WALL, BEYOND, PANEL = 2.0, 4.0, 1.4
OPENING = 0.2, 0.6
"""Depths of a wall, of what is in the room behind it, and of a panel before it; left and right side of an opening."""
EYES = -0.3, 0.3


def discs(x: np.ndarray, y: np.ndarray, z: float, spacing: float) -> np.ndarray:
    """[P, 4] centres and scale of opaque discs on a grid, which overlap."""
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=2).reshape(-1, 2)
    return np.column_stack([grid, np.full(len(grid), z), np.full(len(grid), 1.2 * spacing)])


def two_rooms() -> tuple[Map, dict[str, np.ndarray]]:
    """A wall with an opening, a wall of the room behind it, and a panel before the first, instance 5, with a poster
    of another 40 cm behind it; the rows of each."""
    across, along = np.arange(-2, 2, 0.02), np.arange(-1, 1, 0.02)
    wall = discs(across, along, WALL, 0.02)
    wall = wall[(wall[:, 0] < OPENING[0]) | (wall[:, 0] > OPENING[1])]
    panel, poster = (discs(np.arange(-0.4, 0.1, 0.02), np.arange(-0.2, 0.2, 0.02), z, 0.02) for z in (PANEL, 1.8))
    parts = {"wall": wall, "room": discs(across[::2], along[::2], BEYOND, 0.04), "panel": panel, "poster": poster}
    rows = np.concatenate(list(parts.values())).astype(np.float32)
    ends = np.cumsum([0, *map(len, parts.values())])
    where = {name: np.arange(*ends[n : n + 2]) for n, name in enumerate(parts)}
    ids = np.full(len(rows), -1, np.int32)
    ids[where["panel"]] = 5
    log_scales = np.log(np.column_stack([rows[:, 3], rows[:, 3], 0.1 * rows[:, 3]]))
    rng = np.random.default_rng(0)
    gmap = Map(
        means=rows[:, :3].copy(),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(rows), 1)),
        log_scales=log_scales,
        opacity_logits=np.full(len(rows), 8.0, np.float32),
        sh=rng.normal(0, 0.3, (len(rows), 4, 3)).astype(np.float32),
        features=np.zeros((len(rows), 2), np.float32),
        instance_ids=ids,
    )
    return gmap, where


def eye(x: float, width: int = 160) -> TrainingView:
    """A camera at x that looks along z."""
    pose = torch.eye(4)
    pose[0, 3] = -x
    K = torch.tensor([[100.0, 0, width / 2], [0, 100, 40], [0, 0, 1]])
    return TrainingView(f"at {x}", torch.zeros(80, width, 3, dtype=torch.uint8), None, K, pose)


def through(points: np.ndarray, x: float, z: float, low: float, high: float, slack: float) -> np.ndarray:
    """[P] bool: whether the ray from an eye at x to each point passes the plane z between low and high, that far from
    both."""
    at = x + (points[:, 0] - x) * z / points[:, 2]
    return np.asarray((at > low + slack) & (at < high - slack))


def test_what_is_behind_a_wall_is_out_and_what_an_opening_shows_is_in() -> None:
    gmap, where = two_rooms()
    found = shown_rows(shape_of(gmap), [eye(x) for x in EYES])
    room = gmap.means[where["room"]].astype(np.float64)
    inside = np.abs(room[:, 1] / room[:, 2]) < 0.37  # of the pictures' 40 of 100
    seen, hidden = np.zeros(len(room), bool), np.ones(len(room), bool)
    for x in EYES:
        framed = inside & (np.abs((room[:, 0] - x) / room[:, 2]) < 0.77)
        seen |= framed & through(room, x, WALL, *OPENING, 0.06)
        hidden &= ~through(room, x, WALL, *OPENING, -0.1)
    assert seen.sum() > 1000 and hidden.sum() > 2000
    assert found[where["room"][seen]].all() and not found[where["room"][hidden]].any()
    wall = gmap.means[where["wall"]].astype(np.float64)
    free = (np.abs(wall[:, 1] / WALL) < 0.37) & (np.abs(wall[:, 0]) < 1.4) & (np.abs(wall[:, 0] + 0.15) > 0.6)
    assert free.sum() > 3000 and found[where["wall"][free]].all() and found[where["panel"]].all()


def test_colours_are_told_of_what_fills_enough_pixels_and_not_of_what_is_behind_a_wall() -> None:
    """By the closed form: a Gaussian of opacity o and σ pixels fills 2π σ² o of each picture. Of two in the pictures
    one fills .6 pixels of both, the other 2; of two with centres 15 pixels beside a picture one fills 60 of it."""
    gmap, where = two_rooms()
    whole = shape_of(gmap)
    points = torch.tensor([[0.3, 0.2, 1.0], [-0.3, 0.2, 1.0], [1.25, 0.0, 1.0], [-1.25, 0.0, 1.0]])
    sizes, opacities = torch.tensor([0.01, 0.01, 0.04, 0.1]), torch.tensor([0.03, 0.12, 0.5, 0.5])
    log_scales = sizes.log()[:, None].expand(4, 3)
    dust = replace(whole.rows(torch.arange(4)), means=points, log_scales=log_scales, opacity_logits=opacities.logit())
    found = told_rows(Gaussians.concatenate([whole, dust]), [eye(x) for x in EYES])
    assert TOLD == (1, 10) and found[-4:].tolist() == [False, True, False, True]
    room = gmap.means[where["room"]].astype(np.float64)
    hidden = np.all([~through(room, x, WALL, *OPENING, -0.1) for x in EYES], axis=0)
    assert found[where["room"]].sum() > 300 and not found[where["room"][hidden]].any()


IN_MEMORY = SimpleNamespace(new_keep=lambda: np.asarray)


def visit(gmap: Map, views: list[TrainingView], **more: Any) -> Visit:
    """A visit of which nothing but its cameras is known."""
    whole: Any = shape_of(gmap)
    rows, light, none = np.flatnonzero(shown_rows(whole, views)), np.ones(3), np.zeros(0, int)
    known: dict[str, Any] = dict.fromkeys(("number", "stereo", "near", "masks", "mark", "left_out"))
    known |= {
        "run": IN_MEMORY,
        "rows": rows,
        "gaussians": gaussians_of(gmap, rows),
        "light": light,
        "grey": False,
        "earlier": [],
    }
    return Visit(
        gmap=gmap, whole=whole, photos=Photos([], [], views, []), **{**known, "run": IN_MEMORY, "beside": none, **more}
    )


def test_what_stands_behind_a_thing_that_is_gone_is_in() -> None:
    gmap, where = two_rooms()
    before = visit(gmap, [eye(0.0)])
    after = before.without(gmap.instance_ids == 5)
    poster = gmap.means[where["poster"]].astype(np.float64)
    inner = through(poster, 0.0, PANEL, -0.4, 0.08, 0.08) & (np.abs(poster[:, 1] * PANEL / 1.8) < 0.1)
    assert inner.sum() > 100
    assert not np.isin(where["poster"][inner], before.rows).any()
    assert np.isin(where["poster"], after.rows).all() and np.isin(before.rows, after.rows).all()
    torch.testing.assert_close(after.gaussians.means.numpy(), gmap.means[after.rows])
    assert before.without(np.zeros(len(gmap.means), bool)) is before


def test_renders_of_what_is_shown_are_those_of_the_map() -> None:
    """Also without the panel; to half a grey level, but for some pixels at the border, where little of a disc shows."""
    gmap, _ = two_rooms()
    everything = gaussians_of(gmap, np.arange(len(gmap.means)))
    stays = np.flatnonzero(gmap.instance_ids != 5)
    shown = visit(gmap, [eye(x) for x in EYES]).without(gmap.instance_ids == 5)
    assert len(shown.rows) < 0.8 * len(gmap.means)
    left = shown.part(gmap.instance_ids[shown.rows] != 5)
    for x in EYES:
        for full, few in ((everything, shown.gaussians), (everything.rows(torch.from_numpy(stays)), left)):
            images = [picture(gaussians, eye(x)) for gaussians in (full, few)]
            assert (images[0] - images[1]).abs().quantile(0.99) < 0.5 / 255 < images[0].std()


def picture(gaussians: Gaussians, view: TrainingView) -> torch.Tensor:
    """[H, W, 3] render."""
    size = view.photo.shape[1::-1]
    return render(gaussians, view.camera_from_world, view.K, *size, harmonics=True).colors[0]


@pytest.mark.parametrize("known", [True, False])
def test_what_only_earlier_views_show_is_not_rehearsed(known: bool) -> None:
    """A photo through the opening, and an earlier view of the whole wall: rehearsed is the wall that the photo shows;
    where the photo showed all, everything is."""
    gmap, _ = two_rooms()
    earlier = [eye(0.0)]
    photo = earlier[0] if known else eye(0.55, width=60)
    rows = np.flatnonzero(shown_rows(shape_of(gmap), [photo]))
    beside = np.setdiff1d(np.flatnonzero(shown_rows(shape_of(gmap), earlier)), rows)
    made = visit(gmap, [photo], earlier=earlier, beside=beside)
    (view,) = made.rehearsed(made.gaussians, made.part(np.zeros(len(made.rows), bool)))
    assert view.weight is not None
    column = (np.arange(160) + 0.5 - 80) / 100  # x / z
    if known:
        assert view.weight.numpy()[20:60].mean() > 0.99  # the room beyond is not as high as the picture
        return
    left = WALL * column < 0.55 - 0.3 * WALL - 0.1  # of what the photo shows of the wall
    assert view.weight.numpy()[:, left].max() == 0
    shown = (WALL * column > OPENING[1] + 0.1) & (WALL * column < 0.55 + 0.3 * WALL - 0.1)
    assert view.weight.numpy()[10:70, shown].min() == 1
