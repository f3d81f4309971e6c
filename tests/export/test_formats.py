"""Written files read back by other libraries where they are installed, boxes against closed forms."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bench.scannet import write_scannet
from perception.boxes import oriented_box
from perception.errors import InputError
from perception.export.export_map import ExportOptions, check_overlap, export_labels, write_export
from perception.io.cloud import read_cloud
from perception.types import PointCloud


def scene(n: int = 3000):
    rng = np.random.default_rng(0)
    points = rng.random((n, 3)).astype(np.float32)
    labels = (points[:, 0] * 4).astype(np.int32) - 1  # -1, 0, 1, 2 in slabs along x
    return PointCloud(points, rng.integers(0, 256, (n, 3)).astype(np.uint8)), labels


def test_export_takes_the_nearest_gaussian_and_drops_noise():
    cloud, _ = scene(800)
    rng = np.random.default_rng(1)
    means = rng.random((900, 3))
    ids = (means[:, 0] * 4).astype(np.int32) - 1
    distance = np.linalg.norm(cloud.points[:, None] - means[None], axis=2)
    kept = np.where(ids >= 0, distance, np.inf)
    dropped = export_labels(means, ids, cloud, ExportOptions(smooth=False))
    np.testing.assert_array_equal(dropped, ids[kept.argmin(axis=1)])
    limited = export_labels(means, ids, cloud, ExportOptions(smooth=False, max_distance=0.05))
    np.testing.assert_array_equal(limited, np.where(kept.min(axis=1) <= 0.05, dropped, -1))
    assert (export_labels(means, np.full(900, -1, np.int32), cloud) == -1).all()


def test_smoothing_repairs_wrong_gaussians_and_nan_points_get_nothing():
    rng = np.random.default_rng(0)
    side = np.arange(4000) % 2
    points = np.concatenate([rng.random((4000, 2)), np.zeros((4000, 1))], axis=1)
    points[side == 1] = points[side == 1][:, [2, 0, 1]] + [0, 0, 0.05]  # a wall beside the floor
    normals = np.where(side[:, None] == 0, [0, 0, 1.0], [1.0, 0, 0]).astype(np.float32)
    ids = side.astype(np.int32)
    ids[rng.random(4000) < 0.2] = 9
    points[17] = np.nan
    cloud = PointCloud(points, normals=normals)
    means = np.nan_to_num(points, nan=5.0)
    labels = export_labels(means, ids, cloud)
    assert labels[17] == -1
    right = np.delete(labels == side, 17)
    assert right.mean() > 0.99


def test_scattered_points_keep_their_own_labels_and_dense_ones_are_smoothed():
    """Nine balls of radius 0.1, 0.3 apart: one to three points of each, alone and beside a dense scan of a floor."""
    rng = np.random.default_rng(0)
    centers = 0.3 * np.stack(np.meshgrid([0, 1, 2], [0, 1, 2], [1.0]), axis=-1).reshape(-1, 3)
    truth = np.repeat(np.arange(9, dtype=np.int32), 400)
    directions = rng.normal(size=(3600, 3))
    means = centers[truth] + 0.1 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for count in (1, 2, 3):
        rows = np.concatenate([400 * n + np.arange(count) * 130 for n in range(9)])
        found = export_labels(means, truth, PointCloud(means[rows]))
        assert (found == truth[rows]).mean() >= (1.0 if count == 1 else 0.8)
    floor = np.concatenate([rng.random((4000, 2)), np.zeros((4000, 1))], axis=1)
    noisy = np.where(rng.random(4000) < 0.1, 8, 9).astype(np.int32)
    points, ids = np.concatenate([means[::400], floor]), np.concatenate([truth, noisy])
    found = export_labels(np.concatenate([means, floor]), ids, PointCloud(points))
    assert (found[:9] == np.arange(9)).all() and (found[9:] == 9).all()


def test_export_file_and_sidecar(tmp_path):
    cloud, labels = scene()
    instances = {0: {"score": 0.25, "label": "mug"}, 1: {"score": 0.5, "label": None}, 7: {"score": 1.0}}
    write_export(tmp_path / "out.ply", cloud, labels, instances)
    back = read_cloud(tmp_path / "out.ply")
    np.testing.assert_array_equal(back.points, cloud.points)
    np.testing.assert_array_equal(back.labels["instance_id"], labels)
    sidecar = json.loads((tmp_path / "out.json").read_text())["instances"]
    assert sidecar.keys() == {"0", "1", "2"}
    assert sidecar["0"] == {"score": 0.25, "label": "mug", "num_points": int((labels == 0).sum())}


def test_a_cloud_in_another_frame_is_told_with_its_distance():
    cloud, _ = scene()
    assert check_overlap(np.asarray(cloud.points) + 0.5, cloud.points) == pytest.approx(1 / 8, abs=0.05)
    with pytest.raises(InputError, match=r"does not overlap the map: it lies 9\.\d+ units away"):
        check_overlap(cloud.points + np.array([10, 0, 0]), cloud.points)
    with pytest.raises(InputError, match="no Gaussians"):
        check_overlap(np.full((2, 3), np.nan), cloud.points)
    for nothing, count in ((np.full((3, 3), np.nan), 3), (np.zeros((0, 3)), 0)):
        with pytest.raises(InputError, match=f"of its {count} points none is finite"):
            check_overlap(cloud.points, nothing)


def test_a_scan_of_what_lies_outermost_is_of_the_map() -> None:
    """Bounds without the outermost hundredths must not refuse it; what lies far beside them is another frame."""
    means = np.random.default_rng(0).uniform(0, 1, (1000, 3))
    outermost = means[means[:, 0] > 0.995]
    assert 0 < len(outermost) < 10 and check_overlap(means, outermost) == 0
    with pytest.raises(InputError, match=r"it lies 0\.\d+ units away"):
        check_overlap(means, outermost + np.array([0.3, 0, 0]))


def test_a_floor_that_goes_on_beyond_the_map_is_labelled_within_it() -> None:
    rng = np.random.default_rng(0)
    floor, means = (np.insert(rng.uniform(0, side, (count, 2)), 2, 0, axis=1) for side, count in ((9, 9000), (3, 3000)))
    labels = export_labels(means, np.ones(3000, np.int32), PointCloud(floor), ExportOptions(max_distance=0.2))
    outside = np.maximum(floor[:, :2] - 3, 0)
    assert (labels[(floor[:, :2] < 2.9).all(axis=1)] == 1).all()
    assert (labels[np.linalg.norm(outside, axis=1) > 0.2] == -1).all()


def test_one_point_and_duplicated_points_are_exported():
    means, ids = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([3, 8], np.int32)
    assert export_labels(means, ids, PointCloud(np.array([[0.9, 0, 0]]))).tolist() == [8]
    twins = PointCloud(np.tile([[0.1, 0, 0]], (50, 1)))
    assert export_labels(means, ids, twins).tolist() == [3] * 50
    assert export_labels(means[:0], ids[:0], twins).tolist() == [-1] * 50


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.2])
def test_the_box_of_a_turned_brick_is_the_brick(turn):
    rng = np.random.default_rng(2)
    brick = (rng.random((900, 3)) - 0.5) * [2.0, 0.6, 0.3]
    brick[:8] = np.array([[x, y, z] for x in (-1, 1) for y in (-0.3, 0.3) for z in (-0.15, 0.15)])
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    box = oriented_box(brick @ rotation.T + [5, -3, 1])
    np.testing.assert_allclose(sorted(box.extent), [0.3, 0.6, 2.0], rtol=1e-9)
    np.testing.assert_allclose(box.center, [5, -3, 1], atol=1e-9)
    np.testing.assert_allclose(box.rotation @ box.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(box.rotation) == pytest.approx(1)
    local = (brick @ rotation.T + [5, -3, 1] - box.center) @ box.rotation.T
    assert (np.abs(local) <= box.extent / 2 + 1e-9).all()


def test_scannet_submission_layout(tmp_path):
    _, labels = scene(500)
    path = write_scannet(tmp_path, "scene0000_00", labels, {0: {"score": 0.2}, 1: {"score": 0.9}, 2: {"score": 0.5}})
    rows = [line.split() for line in path.read_text().splitlines()]
    assert [(row[1], float(row[2])) for row in rows] == [("1", 0.9), ("1", 0.5), ("1", 0.2)]
    for row, i in zip(rows, (1, 2, 0), strict=True):
        np.testing.assert_array_equal(np.loadtxt(tmp_path / row[0], dtype=int), labels == i)
