"""Picture masks against scipy, and the dataset runners on miniature copies of the layouts."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from bench.masks import (
    boundary_iou,
    evaluate_lerf_mask,
    evaluate_lerf_ovs,
    mask_boundary,
    mask_iou,
    read_lerf_polygons,
    read_mask_folder,
    scenes_result,
)
from bench.scannet import run_scannet, write_scannet
from perception.errors import InputError
from support.ap import evaluate_masks


def blob(seed, shape=(60, 90)):
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.random(shape), (0, 0), 6) > 0.5


@pytest.mark.parametrize("seed", range(5))
def test_boundary_iou_by_repeated_erosion(seed):
    a, b = blob(seed), blob(seed + 50)
    n = round(0.02 * np.hypot(60, 90))

    def boundary(mask):
        return mask & ~binary_erosion(mask, np.ones((3, 3)), iterations=n, border_value=0)

    np.testing.assert_array_equal(mask_boundary(a), boundary(a))
    p, q = boundary(a), boundary(b)
    assert boundary_iou(a, b) == pytest.approx((p & q).sum() / (p | q).sum(), abs=1e-12)


def test_iou_of_empty_masks():
    none, full = np.zeros((4, 4), bool), np.ones((4, 4), bool)
    assert (mask_iou(none, none), mask_iou(none, full), mask_iou(full, full)) == (1, 0, 1)


def test_lerf_mask_averages_by_prompt_and_scores_the_missing_zero():
    full = np.full((40, 40), 255, np.uint8)
    half = full.copy()
    half[:, 20:] = 0
    truths = {("v1", "cup"): full, ("v2", "cup"): full, ("v1", "egg"): half}
    predictions = {("v1", "cup"): full, ("v1", "egg"): cv2.resize(full, (10, 10))}
    result = evaluate_lerf_mask(predictions, truths)
    assert result["prompts"]["cup"]["miou"] == 0.5 and result["miou"] == pytest.approx((0.5 + 0.5) / 2)
    assert result["missing"] == [["v2", "cup"]]


def test_lerf_ovs_is_a_flat_mean_and_strict_at_a_quarter():
    truth = np.zeros((10, 10), np.uint8)
    truth[:, :] = 11
    quarter = np.zeros((10, 10))
    quarter[:5, :5] = 0.71
    truths = {("f1", "a"): truth, ("f1", "b"): truth, ("f2", "a"): truth}
    result = evaluate_lerf_ovs({("f1", "a"): quarter, ("f2", "a"): np.ones((10, 10))}, truths, selection="top-1")
    assert result["miou"] == pytest.approx((0.25 + 0 + 1) / 3)
    assert result["macc25"] == pytest.approx(1 / 3)
    assert result["protocol"]["selection"] == "top-1"


def save(path, mask):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), mask.astype(np.uint8) * 255)


def test_lerf_mask_directory(tmp_path):
    data, pred = tmp_path / "data", tmp_path / "pred"
    for scene in ("figurines", "ramen"):
        for view in ("test_0", "test_1"):
            save(data / scene / "test_mask" / view / "green apple.png", blob(1))
    save(pred / "figurines/test_0/green apple.png", blob(1))
    save(pred / "figurines/test_1/green apple.png", blob(2))
    found = {name: read_mask_folder(pred / name) if (pred / name).is_dir() else {} for name in ("figurines", "ramen")}
    scored = {
        name: evaluate_lerf_mask(masks, read_mask_folder(data / name / "test_mask")) for name, masks in found.items()
    }
    result, table = scenes_result(scored, ("miou", "mbiou"))
    want = (1 + mask_iou(blob(2), blob(1))) / 2
    assert result["scenes"]["figurines"]["miou"] == pytest.approx(want)
    assert result["scenes"]["ramen"]["miou"] == 0 and result["mean"]["miou"] == pytest.approx(want / 2)
    assert "figurines" in table and "zero padding" in table
    with pytest.raises(InputError, match="no folder"):
        read_mask_folder(tmp_path / "none")


def test_lerf_ovs_directory(tmp_path):
    label = tmp_path / "label/teatime"
    label.mkdir(parents=True)
    square = [[10, 5], [29, 5], [29, 24], [10, 24]]
    objects = [{"category": "sheep", "segmentation": square}]
    (label / "frame_00001.json").write_text(json.dumps({"info": {"height": 40, "width": 50}, "objects": objects}))
    mask = np.zeros((40, 50), bool)
    mask[5:25, 10:30] = True
    found = {("frame_00001", "sheep"): mask}
    scored = evaluate_lerf_ovs(found, read_lerf_polygons(label), selection="top-1", occlusion="off")
    result, table = scenes_result({"teatime": scored}, ("miou", "macc25"))
    assert result["mean"] == {"macc25": 1.0, "miou": 1.0}
    assert "selection: top-1" in table
    (label / "frame_00002.json").write_text("{}")
    with pytest.raises(InputError, match="frame_00002"):
        read_lerf_polygons(label)


def test_scannet_directory(tmp_path):
    rng = np.random.default_rng(0)
    truth = np.repeat([0, 3001, 3002, 5001, 7], 200)
    labels = np.where(rng.random(1000) < 0.1, -1, np.repeat([-1, 4, 6, 8, 9], 200)).astype(np.int32)
    scores = {4: 0.9, 6: 0.5, 8: 0.25, 9: 0.125}
    gt, text = tmp_path / "gt", tmp_path / "text"
    gt.mkdir()
    np.savetxt(gt / "scene0.txt", truth, fmt="%d")
    write_scannet(text, "scene0", labels, {i: {"score": s} for i, s in scores.items()}, {4: 3, 6: 3, 8: 5, 9: 5})
    first, table = run_scannet(text, gt, by_class=True)
    void = np.where(truth < 1000, 0, truth)
    want = evaluate_masks(
        [labels == i for i in scores],
        list(scores.values()),
        void,
        classes=[3, 3, 5, 5],
        gt_semantics=void // 1000,
        by_class=True,
    )
    assert first["ap"] == want["ap"] == pytest.approx(1.0 - 1 / 9, abs=0.2)
    assert "class 3" in table
    np.savetxt(gt / "scene1.txt", truth, fmt="%d")
    halved, _ = run_scannet(text, gt, by_class=True)
    assert halved["missing"] == ["scene1"] and halved["ap50"] == pytest.approx(0.5, abs=1e-9)


def test_bad_scannet_predictions_are_told(tmp_path):
    gt, pred = tmp_path / "gt", tmp_path / "pred"
    gt.mkdir()
    pred.mkdir()
    with pytest.raises(InputError, match="no truth files"):
        run_scannet(pred, gt)
    np.savetxt(gt / "s.txt", np.full(10, 3001), fmt="%d")
    (pred / "s.txt").write_text("mask.txt 3\n")
    with pytest.raises(InputError, match="line 1"):
        run_scannet(pred, gt)
    (pred / "s.txt").write_text("mask.txt 3 0.5\n")
    (pred / "mask.txt").write_text("1\n0\n")
    with pytest.raises(InputError, match="2 rows, the truth has 10"):
        run_scannet(pred, gt)
