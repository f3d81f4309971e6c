"""Registration against rooms in closed form, under known transforms; what must be refused is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.export import align as module
from perception.export.align import Alignment, align
from perception.export.align_steps import _grid
from perception.export.depth_views import observe
from perception.types import PointCloud
from support import box_rooms
from support.box_rooms import FURNISHED


def similarity(seed: int, scale: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.random(random_state=rng).as_matrix()
    matrix[:3, 3] = rng.uniform(-20, 20, 3)
    return matrix


def scan_of(boxes: box_rooms.Boxes, scan_from_map: np.ndarray, seed: int = 0, keep: float = 0.6) -> np.ndarray:
    """Surface points, a random half-space cut away, 5 mm of noise, in the scan's frame."""
    rng = np.random.default_rng(seed)
    points = box_rooms.points(boxes)
    height = points @ rng.normal(size=3)
    points = points[height <= np.quantile(height, keep)]
    points = points + rng.normal(0, 0.005, points.shape)
    return points @ scan_from_map[:3, :3].T + scan_from_map[:3, 3]


def error(found: Alignment, scan_from_map: np.ndarray, scan: np.ndarray) -> tuple[float, float]:
    """(degrees, largest distance of a point from its true place)."""
    true = np.linalg.inv(scan_from_map)
    turn = (
        found.map_from_scan[:3, :3]
        @ np.linalg.inv(true[:3, :3])
        / (found.scale * np.cbrt(np.linalg.det(scan_from_map[:3, :3])))
    )
    away = scan @ (found.map_from_scan - true)[:3, :3].T + (found.map_from_scan - true)[:3, 3]
    return float(np.degrees(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec()))), float(
        np.linalg.norm(away, axis=1).max()
    )


@pytest.fixture(scope="module")
def furnished() -> list[module.DepthView]:
    return box_rooms.views(FURNISHED)


def test_steps_on_planes_and_brightness_end_at_the_true_place() -> None:
    """From 3°, 10 cm and 4 % beside it; the brightness alone finds what planes leave open."""
    points = box_rooms.points(FURNISHED, 0.08)
    gray = np.repeat((box_rooms.texture(points)[:, None] * 255).astype(np.uint8), 3, axis=1)
    views = box_rooms.views(FURNISHED, textured=True)
    registration = module.Registration(views, PointCloud(points, gray), similar=True)
    true = module.Similarity(np.eye(3), registration.scan_middle - registration.middle)
    turn = Rotation.from_euler("xyz", [2, -1, 2], degrees=True).as_matrix()
    place = module.Similarity(1.04 * turn, true.shift + np.array([0.06, -0.06, 0.05]))
    w = registration.tolerance
    planes, rms, information = registration._icp(place, registration.rows, [3 * w] * 8 + [w] * 8)
    assert registration.apart(planes, true) < 0.01 and planes.scale == pytest.approx(1, abs=0.003) and rms < 0.02
    assert np.linalg.eigvalsh(information)[0] > module.LEAST_STIFFNESS
    pictures = registration._photometric(module.Similarity(1.01 * np.eye(3), true.shift + 0.02), registration.rows)
    assert registration.apart(pictures, true) < 0.01
    assert registration.judged(pictures)[0] > registration.judged(place)[0]
    every, registration.rows = registration.rows, registration.rows[:20]  # too few to compare two places
    pictures = registration._photometric(module.Similarity(1.01 * np.eye(3), true.shift + 0.02), every)
    assert registration.apart(pictures, true) < 0.01


@pytest.mark.slow
def test_a_metric_scan_is_found(furnished: list[module.DepthView]) -> None:
    scan_from_map = similarity(1, 1.0)
    scan = scan_of(FURNISHED, scan_from_map)
    scan[::500] = np.nan
    scan[100] += 3000.0  # a stray point
    found = align(furnished, PointCloud(scan), similar=False)
    assert found.refusal is None and found.scale == pytest.approx(1, abs=1e-9)
    scan[100] = np.nan
    degrees, away = error(found, scan_from_map, scan[np.isfinite(scan[:, 0])])
    assert degrees < 0.3 and away < 0.01
    assert found.agreement > 0.97 and found.rival < 0.7 and found.cover > 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "may_refuse"), [(2, True), (3, False)])
def test_scale_is_found_and_colours_sharpen_the_place(seed: int, may_refuse: bool) -> None:
    """The search does not always reach the place at an unknown scale. Then it refuses the scan."""
    scan_from_map = similarity(seed, [0.001, 39.37][seed - 2])
    scan = scan_of(FURNISHED, scan_from_map, seed)
    true = np.linalg.inv(scan_from_map)
    gray = 0.6 * box_rooms.texture(scan @ true[:3, :3].T + true[:3, 3]) + 0.2  # another exposure
    cloud = PointCloud(scan, np.repeat((gray[:, None] * 255).astype(np.uint8), 3, axis=1))
    found = align(box_rooms.views(FURNISHED, size=(240, 180), textured=True), cloud, similar=True)
    if may_refuse and found.refusal is not None:
        return
    assert found.refusal is None
    degrees, away = error(found, scan_from_map, scan)
    assert degrees < 0.1 and away < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(
    ("boxes", "reason"),
    [
        ([([-2, -2, 0], [2, 2, 2.4]), ([-0.5, -0.5, 0], [0.5, 0.5, 0.8])], "another place"),  # four alike places
        ([([-40.0, -40, 0], [40, 40, 90])], "slide|another place|best place"),  # a floor
    ],
)
def test_symmetric_and_flat_scenes_are_refused(boxes: box_rooms.Boxes, reason: str) -> None:
    views = box_rooms.views(boxes)
    scan = (
        scan_of(boxes, np.eye(4), keep=1.0)
        if len(boxes) > 1
        else np.random.default_rng(0).uniform(-2, 2, (20000, 3)) * [1, 1, 0]
    )
    found = align(views, PointCloud(scan @ similarity(4, 1.0)[:3, :3].T), similar=False)
    assert found.refusal is not None and re.search(reason, found.refusal)


@pytest.mark.slow
def test_a_scan_of_another_place_is_refused(furnished: list[module.DepthView]) -> None:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(20000, 3))
    ball *= 1.2 / np.linalg.norm(ball, axis=1, keepdims=True)
    try:
        found = align(furnished, PointCloud(ball), similar=False)
    except InputError:
        return
    assert found.refusal is not None


@pytest.mark.parametrize(
    "scan", [np.full((500, 3), np.nan), np.zeros((500, 3)), np.random.default_rng(0).random((9, 3))]
)
def test_a_scan_that_holds_too_little_is_an_error(scan: np.ndarray, furnished: list[module.DepthView]) -> None:
    with pytest.raises(InputError, match="scan: "):
        align(furnished, PointCloud(scan), similar=True)


def test_views_that_show_no_surface_are_told(furnished: list[module.DepthView]) -> None:
    blind = [replace(view, depth=np.zeros_like(view.depth)) for view in furnished]
    with pytest.raises(InputError, match="500 finite points, 0 of the map are seen"):
        align(blind, PointCloud(np.random.default_rng(0).random((500, 3))), similar=True)


def test_views_tell_surface_from_free_and_hidden_space(furnished: list[module.DepthView]) -> None:
    probes = np.array(
        [[0, -0.3, 1.2], [-0.4, -0.1, 0.45], [-0.4, -0.1, 0.2], [9, 9, 9]]
    )  # air, table top, inside it, outside
    on, free, gap = observe(probes, furnished, 0.05)
    assert free[0] > 0 and on[0] == 0
    assert on[1] > 0 and free[1] == 0 and abs(gap[1]) < 0.03
    assert on[2] == free[2] == on[3] == free[3] == 0


def test_the_grid_of_rotations_leaves_no_gap() -> None:
    grid = _grid(12_000)
    random = Rotation.random(200, random_state=0).as_quat()
    nearest = np.degrees(2 * np.arccos(np.abs(random @ grid.T).max(axis=1).clip(max=1)))
    assert nearest.max() < 9


@pytest.mark.slow
def test_the_place_is_the_same_to_the_bit_on_any_number_of_threads() -> None:
    code = (
        "from perception.export.align import align; from perception.types import PointCloud\n"
        "from support import box_rooms; import numpy as np\n"
        "places = box_rooms.points(box_rooms.FURNISHED)\n"
        "gray = np.repeat((box_rooms.texture(places)[:, None] * 255).astype(np.uint8), 3, axis=1)\n"
        "views = box_rooms.views(box_rooms.FURNISHED, textured=True)\n"
        "print(align(views, PointCloud(places, gray), similar=False).map_from_scan.tobytes().hex())"
    )
    told = set()
    for threads in ("1", "5"):
        names = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), threads)
        paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
        run = [sys.executable, "-c", code]
        told.add(
            subprocess.run(
                run,
                env={**os.environ, **names, "PYTHONPATH": paths},
                cwd=Path(__file__).parent,  # not where sources without a core lie
                capture_output=True,
                check=True,
            ).stdout
        )
    assert len(told) == 1


def test_a_scan_in_millimetres_is_told(furnished: list[module.DepthView]) -> None:
    """The grid of the correlation took terabytes."""
    scan = 1000 * scan_of(FURNISHED, np.eye(4))
    with pytest.raises(InputError, match=r"scan: it is \d+ times as large as the map"):
        align(furnished, PointCloud(scan), similar=False)
