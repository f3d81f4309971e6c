"""The built-in segmentation on known pictures, and the benchmark's scores against brute force."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from perception.bench.masks import main, score_photo
from perception.masks import GeometryMaskSource, make_source
from perception.masks.cues import depth_cues, photo_cues
from perception.masks.region_graph import RegionGraph
from perception.masks.regions import refine_with_geometry, segment_photo
from perception.types import View


def disc_and_box(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A red disc and a blue box on grey, with noise: [120, 160, 3] uint8 and the truth [120, 160]."""
    y, x = np.mgrid[:120, :160]
    truth = np.zeros((120, 160), int)
    truth[(x - 45) ** 2 + (y - 60) ** 2 < 30**2] = 1
    truth[30:90, 95:140] = 2
    colours = np.array([[150, 150, 150], [190, 40, 40], [40, 60, 180]])
    noisy = colours[truth] + np.random.default_rng(seed).normal(0, 4, (120, 160, 3))
    return noisy.clip(0, 255).astype(np.uint8), truth


@pytest.mark.parametrize("seed", [0, 1])
def test_flat_objects_are_found_whole(seed):
    photo, truth = disc_and_box(seed)
    labels = segment_photo(photo)
    assert labels.dtype == np.int32 and labels.shape == truth.shape
    score = score_photo(labels, truth + 1)
    assert (score.best_iou > 0.9).all() and score.masks <= 8


def test_an_even_photo_is_one_region():
    labels = segment_photo(np.full((60, 80, 3), 128, np.uint8))
    assert len(np.unique(labels)) == 1


def test_the_same_photo_gives_the_same_labels():
    photo, _ = disc_and_box(3)
    np.testing.assert_array_equal(segment_photo(photo), segment_photo(photo.copy()))


def test_scores_against_brute_force():
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 4, (30, 30))
    labels = np.where(rng.random((30, 30)) < 0.6, truth * 3, rng.integers(0, 9, (30, 30)))
    score = score_photo(labels, truth, smallest=1)
    for row, i in enumerate((1, 2, 3)):
        pairs = [((truth == i) & (labels == m), (truth == i) | (labels == m)) for m in np.unique(labels) if m]
        assert score.best_iou[row] == pytest.approx(max(a.sum() / b.sum() for a, b in pairs))
    assert score.masks == len(np.unique(labels[labels > 0]))


def test_unlabelled_pixels_match_nothing():
    assert score_photo(np.zeros((20, 20), int), np.ones((20, 20), int)).best_iou.tolist() == [0.0]


@pytest.mark.skipif("PERCEPTION_DATA" not in os.environ, reason="needs PERCEPTION_DATA")
def test_benchmark_runs_on_a_truth_scene(capsys):
    import json

    assert main([str(Path(os.environ["PERCEPTION_DATA"]) / "tabletop_a"), "--every", "20"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["mean_best_iou"] > 0.4 and result["photos"] == 4


# Depth: one grey scene of analytic surfaces, where colour tells nothing and only the shape can.

K = np.array([[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]])


def box_on_floor(noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """z-depth [120, 160] of a floor, a wall and a box on the floor by ray casting, and truth ids 1, 2, 3."""
    y, x = np.mgrid[:120, :160] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    tilt = np.deg2rad(35.0)  # the camera, 1 above the floor, looks down; world z is up, y is forward
    world_from_camera = np.array([[1, 0, 0], [0, -np.sin(tilt), np.cos(tilt)], [0, -np.cos(tilt), -np.sin(tilt)]])
    rays, eye = rays @ world_from_camera.T, np.array([0.0, 0.0, 1.0])
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        wall = (2.2 - eye[1]) / rays[..., 1]
        low, high = np.array([-0.25, 1.0, 0.0]), np.array([0.25, 1.4, 0.35])
        sides = np.stack([(low - eye) / rays, (high - eye) / rays])
    enter, leave = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    box = np.where((enter < leave) & (enter > 0), enter, np.inf)
    depths = np.stack([floor, wall, box])
    z = depths.min(axis=0) * (1 + noise * np.random.default_rng(seed).normal(size=(120, 160)))
    return z, depths.argmin(axis=0) + 1


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_shape_alone_parts_box_floor_and_wall(noise, unit):
    depth, truth = box_on_floor(noise)
    grey = np.full((120, 160, 3), 128, np.uint8)
    score = score_photo(refine_with_geometry(grey, depth * unit, K), truth)
    assert (score.best_iou > 0.85).all() and score.masks <= 5


def test_a_photo_without_depth_is_segmented_by_colour():
    photo, _ = disc_and_box(0)
    np.testing.assert_array_equal(refine_with_geometry(photo, np.zeros((120, 160)), K), segment_photo(photo))


def test_depth_with_holes_and_nan():
    depth, truth = box_on_floor(0.0)
    depth[np.random.default_rng(1).random(depth.shape) < 0.2] = 0.0
    depth[5, 5] = np.nan
    score = score_photo(refine_with_geometry(np.full((120, 160, 3), 128, np.uint8), depth, K), truth)
    assert (score.best_iou > 0.8).all()


def test_normals_and_creases_of_known_surfaces():
    depth, truth = box_on_floor(0.0)
    cues = depth_cues(depth, K)
    tilt = np.deg2rad(35.0)
    floor = cues.normals[(truth == 1) & (abs(np.arange(120)[:, None] - 100) < 8)]
    np.testing.assert_allclose(floor.mean(axis=0), [0, -np.cos(tilt), -np.sin(tilt)], atol=0.02)
    crease = np.argmax(truth[:, 5] == 1)  # where the wall meets the floor, concave
    assert cues.bend[1, crease, 5] < -0.5 and abs(cues.bend[1, crease + 20, 5]) < 0.05
    edge = np.flatnonzero(truth[:, 80] == 3)
    front = np.flatnonzero(np.abs(cues.bend[1, edge, 80]) > 0.5)
    assert (
        cues.bend[1, edge[front[(front > 8) & (front < len(edge) - 8)]], 80] > 0
    ).all()  # top and front of the box, convex


def merged_sums_match(seed: int, with_depth: bool) -> None:
    """After merging, all sums equal those of a graph built from the merged picture."""
    rng = np.random.default_rng(seed)
    regions = np.kron(np.arange(30).reshape(5, 6), np.ones((24, 27), int))[:120, :160]
    depth = depth_cues(box_on_floor(0.0)[0], K) if with_depth else None
    photo = photo_cues(rng.integers(0, 256, (120, 160, 3)).astype(np.uint8))
    graph = RegionGraph(regions, photo, depth)
    for _ in range(15):
        a = int(rng.choice([i for i in range(30) if graph.borders[i]]))
        b = int(rng.choice(list(graph.borders[a])))
        graph.merge(a, b)
        regions = np.where(regions == b, a, regions)
    kept, dense = np.unique(regions, return_inverse=True)
    fresh = RegionGraph(dense.reshape(regions.shape), photo, depth)
    np.testing.assert_allclose(graph.sums[kept], fresh.sums)
    for i, a in enumerate(kept):
        others = [int(kept[j]) for j in fresh.borders[i]]
        assert sorted(others) == sorted(graph.borders[a])
        if others:
            expected = fresh.features(i, list(fresh.borders[i]))
            np.testing.assert_allclose(graph.features(int(a), others), expected, atol=1e-9)


@pytest.mark.parametrize("with_depth", [False, True])
def test_merging_keeps_the_evidence_exact(with_depth):
    merged_sums_match(0, with_depth)


def test_source_scales_the_camera_to_the_picture():
    """The second round through the source, at half the view's size, finds the same parts."""
    depth, truth = box_on_floor(0.0)
    doubled = np.diag([2.0, 2.0, 1.0]) @ K
    view = View("a.jpg", Path("a.jpg"), doubled, 320, 240, np.eye(4))
    source = make_source("builtin")
    assert isinstance(source, GeometryMaskSource)
    labels = source.label_image_with_geometry(view, np.full((120, 160, 3), 128, np.uint8), depth)
    assert (score_photo(labels, truth).best_iou > 0.85).all()
