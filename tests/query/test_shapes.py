"""Shapes against bodies made for it: a furnished room in a frame turned at random, round and square things."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.language.shape_words import KINDS, head_noun, shape_kind
from perception.language.shapes import (
    RESTING,
    Body,
    _resting,
    boxiness,
    covered_area,
    roundness,
    shape_scores,
    up_from_cameras,
)
from support.aimed import look_at


def box(size: tuple[float, float, float], rng: np.random.Generator, count: int = 800) -> np.ndarray:
    """Points on five faces (the bottom is never seen), from 0 to `size`."""
    s = np.array(size)
    areas = np.array([s[1] * s[2], s[1] * s[2], s[0] * s[2], s[0] * s[2], s[0] * s[1]])
    face = rng.choice(5, count, p=areas / areas.sum())
    points = rng.random((count, 3))
    for k, (axis, value) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1), (2, 1)]):
        points[face == k, axis] = value
    return points * s


def can(radius: float, height: float, rng: np.random.Generator, count: int = 800) -> np.ndarray:
    angle, points = rng.random(count) * 2 * np.pi, rng.random((count, 3)) * height
    points[:, 0], points[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    lid = rng.random(count) < radius / (radius + 2 * height)
    points[lid, :2] *= np.sqrt(rng.random((lid.sum(), 1)))
    points[lid, 2] = height
    return points


def ball(rng: np.random.Generator, hidden: float = 0.1, count: int = 800) -> np.ndarray:
    """A unit sphere without its lowest part."""
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points[points[:, 2] > 2 * hidden - 1]


def noisy(points: np.ndarray, rng: np.random.Generator, turn: float) -> np.ndarray:
    turned = points @ Rotation.from_euler("z", turn).as_matrix().T
    return turned + rng.normal(size=points.shape) * 0.01 * np.ptp(points, axis=0).max()


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.2])
def test_boxes_are_square_and_balls_are_round(turn: float) -> None:
    rng = np.random.default_rng(0)
    for size in [(1, 1, 1), (0.3, 1, 1.4), (1, 0.7, 0.2), (0.3, 0.3, 1)]:
        points = noisy(box(size, rng), rng, turn)
        assert boxiness(points) > 0.9 and roundness(points) < 0.1
    for radius, height in [(0.5, 1.4), (1, 0.7), (0.3, 1.4)]:
        points = noisy(can(radius, height, rng), rng, turn)
        assert boxiness(points) < 0.2 and roundness(points) < 0.1
    whole, half = noisy(ball(rng), rng, turn), noisy(ball(rng, 0.5), rng, turn)
    assert roundness(whole) > 0.9 and boxiness(whole) < 0.2
    assert roundness(half) < 0.5 and boxiness(half) < 0.2


def at(points: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    return points + np.array([x, y, z])


def room(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Four by three by 2.4 metres: what it holds by name, points in a z-up frame."""

    def sheet(width: float, height: float, count: int = 900) -> np.ndarray:
        return np.concatenate([rng.random((count, 2)) * [width, height], np.zeros((count, 1))], axis=1)

    upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # x stays, y becomes z
    legs = [at(box((0.06, 0.06, 0.7), rng, 60), x, y, 0) for x in (2.0, 3.3) for y in (1.5, 2.2)]
    back = at(sheet(0.4, 0.5, 300) @ upright.T, 2.4, 0.9, 0)
    things = {
        "floor": sheet(4, 3, 2000),
        "wall n": at(sheet(4, 2.4, 1500) @ upright.T, 0, 3, 0),
        "wall s": sheet(4, 2.4, 1500) @ upright.T,
        "wall e": at((sheet(3, 2.4, 1500) @ upright.T)[:, [1, 0, 2]], 4, 0, 0),
        "picture": at(sheet(0.7, 0.5, 400) @ upright.T, 1, 2.97, 1.2),
        "rug": at(sheet(1.4, 1.0, 600), 0.3, 0.4, 0.012),
        "table": np.concatenate([at(sheet(1.4, 0.8, 900), 2, 1.5, 0.75), *legs]),
        "box": at(box((0.3, 0.2, 0.25), rng), 2.2, 1.6, 0.75),
        "can": at(can(0.06, 0.15, rng), 2.9, 1.9, 0.75),
        "ball": at(ball(rng) * 0.12, 0.5, 2.2, 0.12),
        "chair": np.concatenate([at(box((0.4, 0.4, 0.05), rng, 300), 2.4, 0.9, 0.42), back]),
        "cactus": at(rng.normal(size=(500, 3)) * [0.1, 0.1, 0.25], 3.4, 0.5, 0.5),
    }
    return {name: points + rng.normal(size=points.shape) * 0.004 for name, points in things.items()}


def poses(rng: np.random.Generator, roll: float = 0.03) -> np.ndarray:
    eyes = [np.array([2 + 1.2 * np.cos(a), 1.5 + 0.9 * np.sin(a), 1.4]) for a in np.linspace(0, 6, 16)]
    tilted = [look_at(eye, np.array([2, 1.5, 0.8]) + rng.normal(size=3) * 0.3, np.array([0, 0, 1.0])) for eye in eyes]
    for pose in tilted:
        pose[:3] = Rotation.from_euler("z", rng.normal() * roll).as_matrix() @ pose[:3]
    return np.stack(tilted)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_room_is_told_by_its_shapes_in_any_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    things, cameras = room(rng), poses(rng)
    frame_from_room = Rotation.random(random_state=seed).as_matrix()
    scale, shift = 3.7, np.array([10.0, -4, 2])
    means = np.concatenate(list(things.values())) @ frame_from_room.T * scale + shift
    ids = np.repeat(np.arange(len(things)), [len(p) for p in things.values()])
    moved = cameras.copy()
    centres = -np.einsum("nji,nj->ni", cameras[:, :3, :3], cameras[:, :3, 3]) @ frame_from_room.T * scale + shift
    moved[:, :3, :3] = cameras[:, :3, :3] @ frame_from_room.T
    moved[:, :3, 3] = -np.einsum("nij,nj->ni", moved[:, :3, :3], centres)

    up = up_from_cameras(moved)
    assert up is not None and up @ frame_from_room[:, 2] > 0.995
    scores = shape_scores(means, ids, list(range(len(things))), moved)
    best = {kind: {n for n, s in zip(things, scores[:, k], strict=True) if s > 0.6} for k, kind in enumerate(KINDS)}
    assert best["floor"] == {"floor"} and best["table"] == {"table"} and best["ceiling"] == set()
    assert best["wall"] == {"wall n", "wall s", "wall e"} and best["picture"] == {"picture"}
    assert best["rug"] == {"rug"} and best["ball"] == {"ball"}
    assert "box" in best["box"] and not best["box"] & {"can", "ball", "cactus"}


def test_a_floor_in_pieces_is_scored_by_what_each_covers_not_by_rectangles() -> None:
    rng = np.random.default_rng(0)
    along = [rng.random((1200, 2)) * [4, 0.1], rng.random((900, 2)) * [0.1, 3]]
    strip = np.concatenate(along)[rng.permutation(2100)]
    large, small = rng.random((3000, 2)) * [2, 2.8] + 0.15, rng.random((1500, 2)) * [1, 2.8] + [2.5, 0.15]
    assert covered_area(large) == pytest.approx(5.6 * 0.94**2, rel=0.1) and 0.69 < covered_area(strip) < 3
    flat = [np.column_stack([part, np.full(len(part), 0.002)]) for part in (large, small, strip)]
    points = np.concatenate([*flat, at(box((1, 0.6, 0.7), rng), 1, 1, 0.01)])
    ids = np.repeat(np.arange(4), [3000, 1500, 2100, 800])
    floor = shape_scores(points, ids, [0, 1, 2, 3], poses(rng))[:, KINDS.index("floor")]
    assert floor[0] == 1 and floor[1] == pytest.approx(0.5, rel=0.15) and floor[2] < 0.4 and floor[3] == 0


def test_rolled_cameras_tell_no_up() -> None:
    rng = np.random.default_rng(0)
    wild = np.stack([np.eye(4)] * 20)
    wild[:, :3, :3] = Rotation.random(20, random_state=0).as_matrix()
    assert up_from_cameras(wild) is None and up_from_cameras(wild[:0]) is None
    points = np.concatenate([ball(rng), box((1, 1, 1), rng) + 3])
    ids = np.repeat([0, 1], [len(points) - 800, 800])
    scores = shape_scores(points, ids, [0, 1, 2], wild)
    assert scores[0, KINDS.index("ball")] > 0.9
    scores[0, KINDS.index("ball")] = 0
    assert not scores.any()


@pytest.mark.parametrize(
    ("text", "noun", "kind"),
    [
        ("a framed picture of a forest", "picture", "picture"),
        ("rug on the floor", "rug", "rug"),
        ("floor lamp", "lamp", None),
        ("pair of scissors", "scissor", None),
        ("wall E", "wall", "wall"),
        ("Wooden Desks", "desk", "table"),
        ("boxes", "box", "box"),
        ("bowl of apples", "bowl", None),
        ("wooden table with white legs", "table", "table"),
        ("small red and yellow box", "box", "box"),
        ("a mug and a box", "mug", None),
        ("стена", "стена", None),
        ("???", "", None),
        ("with", "with", None),
    ],
)
def test_head_nouns(text: str, noun: str, kind: str | None) -> None:
    assert head_noun(text) == noun and shape_kind(text) == kind


def test_what_stands_on_a_body_is_smaller_above_its_slab_and_touches_it() -> None:
    rng, no_points, up = np.random.default_rng(0), np.zeros((0, 3)), np.eye(3)[2]
    bodies = [
        Body(no_points, center, up, 0.1, area, low, low + 1, top, 0.5, np.array([center[:2] - 0.5, center[:2] + 0.5]))
        for center, area, low, top in zip(rng.uniform(0, 2, (60, 3)), *rng.uniform(0, 1, (3, 60)), strict=True)
    ]
    centers, area, low = (np.array([getattr(body, name) for body in bodies]) for name in ("center", "area", "low"))
    found = [_resting(body, centers, area, low, 2.0).tolist() for body in bodies]
    expected = [
        [
            all(b.footprint[0][k] < a.center[k] < b.footprint[1][k] for k in (0, 1))
            and a.area < b.area
            and abs(a.low - b.top) < RESTING * 2.0
            for a in bodies
        ]
        for b in bodies
    ]
    assert found == expected and np.any(expected)
