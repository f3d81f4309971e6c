"""Rendered-mask mIoU against counts done by hand and against a map whose pictures are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("perception._core")
from perception.errors import InputError
from perception.export.render import as_gaussians
from perception.gaussians.model import from_points
from perception.map.write import Map, read_map, write_map
from perception.photos.view_json import stored_view
from perception.types import Lens, View
from score.masks import evaluate_rendered, mask_miou


def image(*columns: int) -> np.ndarray:
    """An id image 10 pixels high, each id 10 columns wide."""
    return np.repeat(np.array(columns), 10)[None].repeat(10, axis=0)


def test_perfect_masks_of_other_names_score_one() -> None:
    truth = [image(1, 2, 5), image(2, 5, 5)]
    pred = [image(7, 0, 3), image(0, 3, 3)]
    assert mask_miou(zip(pred, truth, strict=True))["miou"] == 1


def test_a_name_that_changes_between_views_is_not_forgiven() -> None:
    truth, pred = [image(1, 2), image(1, 2)], [image(0, 1), image(1, 0)]
    assert mask_miou(zip(pred, truth, strict=True))["miou"] == pytest.approx(0.5)


def test_counts_by_hand() -> None:
    # View 1: truth 1 covers 200, predicted 100 of it and nothing else: 1/2. Truth 2 unpredicted: 0.
    # View 2: truth 1 covers 100, prediction 200 covers it and truth 2: 1/2. Void is left out.
    truth, pred = [image(1, 1, 2, 0), image(1, 2, 0, 0)], [image(4, -1, -1, 4), image(4, 4, 4, -1)]
    result = mask_miou(zip(pred, truth, strict=True))
    assert [row["miou"] for row in result["instances"]] == [0.5, 0]
    assert result["miou"] == 0.25 and result["instances"][1]["pred"] is None


def test_small_glimpses_do_not_count() -> None:
    seen, glimpse = image(1, 2), image(1, 1)
    glimpse[0, :3] = 2
    result = mask_miou([(image(0, 1), seen), (image(0, 0), glimpse)])
    assert [row["views"] for row in result["instances"]] == [2, 1]


def test_nothing_predicted_scores_zero_and_no_truth_is_told() -> None:
    assert mask_miou([(image(-1, -1), image(1, 2))])["miou"] == 0
    with pytest.raises(InputError, match="void"):
        mask_miou([(image(0), image(0))])


def discs(tmp_path: Path) -> tuple:
    """Two clouds of Gaussians left and right of the axis, one view of 60 × 40, their true masks in halves."""
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [rng.uniform([-3, -2, 4], [0, 2, 4.01], (4000, 3)), rng.uniform([0, -2, 4], [3, 2, 4.01], (4000, 3))]
    )
    gaussians = from_points(points, np.full((8000, 3), 200, np.uint8), feature_dim=2, seed=0, opacity=0.9)
    K = np.array([[40.0, 0, 30], [0, 40.0, 20], [0, 0, 1]])
    view = View("a.jpg", Path("a.jpg"), K, 60, 40, np.eye(4))
    truth = np.repeat(np.array([1, 2], np.uint8), 30)[None].repeat(40, axis=0)
    cv2.imwrite(str(tmp_path / "a.png"), truth)
    return gaussians, np.repeat(np.array([0, 1], np.int32), 4000), view


def test_a_map_whose_halves_are_known(tmp_path: Path) -> None:
    gaussians, ids, view = discs(tmp_path)
    assert evaluate_rendered(gaussians, ids, [view], tmp_path)["miou"] > 0.95
    swapped = evaluate_rendered(gaussians, 1 - ids, [view], tmp_path)
    assert [row["pred"] for row in swapped["instances"]] == [1, 0]
    assert evaluate_rendered(gaussians, np.full_like(ids, -1), [view], tmp_path)["miou"] == 0
    assert evaluate_rendered(gaussians, np.zeros_like(ids), [view], tmp_path)["miou"] == pytest.approx(0.25, abs=0.02)
    assert torch.is_grad_enabled()


def test_a_view_without_truth_is_told(tmp_path: Path) -> None:
    gaussians, ids, view = discs(tmp_path)
    with pytest.raises(InputError, match="no label image for photo other"):
        evaluate_rendered(gaussians, ids, [replace(view, name="other.jpg")], tmp_path)


def test_true_masks_have_the_shape_of_distorted_photos(tmp_path: Path) -> None:
    """A map from photos alone undistorts them, to another size than its photos and their true masks have."""
    gaussians, ids, view = discs(tmp_path)
    truth = np.repeat(np.array([1, 2], np.uint8), 31)[None].repeat(41, axis=0)
    cv2.imwrite(str(tmp_path / "a.png"), truth)
    lens = Lens("SIMPLE_RADIAL", (40.0, 31.0, 20.5, -0.001), 62, 41)
    arrays = {name: tensor.numpy() for name, tensor in vars(gaussians).items()}
    shown = stored_view(replace(view, lens=lens), tmp_path, held_out=True)
    box = {"centroid": [0, 0, 4], "aabb": {"min": [0, 0, 0], "max": [1, 1, 1]}, "num_gaussians": 4000, "views": 1}
    box |= {"obb": {"center": [0, 0, 4], "rotation": np.eye(3).tolist(), "extent": [1, 1, 1]}}
    entries = [{"id": i, "label": None, "score": 1.0, **box} for i in (0, 1)]
    info = {"frame": "map", "metric": True}
    gmap = Map(
        **arrays, instance_ids=ids, membership=np.ones(8000, np.float32), instances=entries, info=info, views=[shown]
    )
    write_map(tmp_path / "a.gsmap", gmap)
    read = read_map(tmp_path / "a.gsmap")
    assert evaluate_rendered(as_gaussians(read), read.instance_ids, read.views, tmp_path)["miou"] > 0.95
