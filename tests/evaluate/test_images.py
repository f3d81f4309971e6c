"""PSNR and SSIM against their formulas; folders paired by stem; the instance evaluation from files."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio

from perception.errors import InputError
from perception.evaluate.images import evaluate_images, psnr, run_images, ssim
from perception.evaluate.instances import evaluate, overlap_of_ids, read_truth, run_instances
from perception.io.cloud import write_cloud
from perception.types import PointCloud


def pair(h=48, w=61, seed=0):
    rng = np.random.default_rng(seed)
    truth = cv2.GaussianBlur(rng.random((h, w, 3)), (0, 0), 2)
    return np.clip(truth + rng.normal(0, 0.03, truth.shape), 0, 1), truth


@pytest.mark.parametrize("seed", range(3))
def test_ssim_is_the_papers_formula_over_whole_windows(seed):
    """Equation 13 written out with scipy's correlation, cropped to the windows inside the picture."""
    from scipy.ndimage import correlate

    prediction, truth = pair(seed=seed)
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(taps, taps)[..., None] / taps.sum() ** 2

    def blur(image):
        return correlate(image, window)[5:-5, 5:-5]

    x, y = prediction, truth
    mx, my = blur(x), blur(y)
    vx, vy, c = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    want = (2 * mx * my + 1e-4) * (2 * c + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    assert ssim(prediction, truth) == pytest.approx(want.mean(), abs=1e-12)
    assert ssim(truth, truth) == pytest.approx(1)
    assert psnr(prediction, truth) == pytest.approx(peak_signal_noise_ratio(truth, prediction, data_range=1), abs=1e-9)


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def test_folders_are_paired_by_stem_and_a_missing_view_scores_zero(tmp_path):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    for name in ("a.png", "sub/b.png", "c.png"):
        save(tmp_path / "gt" / name, image)
    save(tmp_path / "pred/a.png", image)
    save(tmp_path / "pred/sub/b.png", 255 - image)
    save(tmp_path / "pred/extra.png", image)
    result, table = run_images(tmp_path / "pred", tmp_path / "gt")
    views = result["views"]
    assert views["a"]["psnr"] == 100 and views["a"]["ssim"] == pytest.approx(1)
    assert views["c"] == {"psnr": 0.0, "ssim": 0.0, "missing": True} and result["missing"] == ["c"]
    want = peak_signal_noise_ratio(image / 255, (255 - image) / 255, data_range=1)
    assert views["sub/b"]["psnr"] == pytest.approx(want)
    assert result["psnr"] == pytest.approx((100 + want) / 3) and result["without_truth"] == ["extra"]
    assert "missing" in table and "mean" in table


def test_sixteen_bit_grey_and_alpha_pictures_are_read_alike(tmp_path):
    grey = np.arange(400, dtype=np.uint8).reshape(20, 20)
    save(tmp_path / "gt/a.png", np.repeat(grey[..., None], 3, axis=2))
    for name, image in {
        "grey": grey,
        "wide": grey.astype(np.uint16) * 257,
        "alpha": np.dstack([grey, grey, grey, 0 * grey]),
    }.items():
        save(tmp_path / name / "a.png", image)
        assert evaluate_images(tmp_path / name, tmp_path / "gt")["psnr"] == 100


def test_bad_pictures_are_told(tmp_path):
    save(tmp_path / "gt/a.png", np.zeros((20, 20, 3), np.uint8))
    save(tmp_path / "small/a.png", np.zeros((10, 20, 3), np.uint8))
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/a.png").write_bytes(b"no picture")
    (tmp_path / "empty").mkdir()
    for folder, word in (("small", "20x10 pixels"), ("broken", "not a readable"), ("nowhere", "no folder")):
        with pytest.raises(InputError, match=word):
            evaluate_images(tmp_path / folder, tmp_path / "gt")
    with pytest.raises(InputError, match="no pictures"):
        evaluate_images(tmp_path / "small", tmp_path / "empty")
    with pytest.raises(InputError, match="at least 11"):
        ssim(np.zeros((10, 40, 3)), np.zeros((10, 40, 3)))


def labelled(path, ids):
    labels = {"instance_id": np.asarray(ids, np.int32)}
    write_cloud(path, PointCloud(np.zeros((len(ids), 3), np.float32), labels=labels))


def test_instances_from_files_with_scores_from_the_sidecar(tmp_path):
    gt = np.repeat([1, 2, 3], 200)
    pred = np.where(np.arange(600) < 200, 5, np.repeat([-1, 6, 7, 8, 9, 4], 100))
    labelled(tmp_path / "gt.ply", gt)
    labelled(tmp_path / "pred.ply", pred)
    flat, table = run_instances(tmp_path / "pred.ply", tmp_path / "gt.ply")
    assert flat["void_points"] == {"negative": 0} and "void truth points" not in table
    labelled(tmp_path / "void.ply", np.where(gt == 3, 0, gt))
    part, void_table = run_instances(tmp_path / "pred.ply", tmp_path / "void.ply")
    assert part["num_truth"] == 2 and "void truth points: 200 of id 0" in void_table
    assert flat["protocol"]["confidence"] == "constant 1.0" and "constant 1.0" in table
    scores = {i: 0.9 if i == 5 else 0.1 for i in (5, 6, 7, 8, 9, 4)}
    sidecar = {"instances": {str(i): {"score": s} for i, s in scores.items()}}
    (tmp_path / "pred.json").write_text(json.dumps(sidecar))
    ranked, _ = run_instances(tmp_path / "pred.ply", tmp_path / "gt.ply")
    assert ranked["ap50"] == evaluate(pred, scores, gt)["ap50"] > flat["ap50"]
    (tmp_path / "pred.json").write_text("[]")
    with pytest.raises(InputError, match=r"pred\.json"):
        run_instances(tmp_path / "pred.ply", tmp_path / "gt.ply")


def test_clouds_of_different_length_or_without_ids_are_told(tmp_path):
    labelled(tmp_path / "a.ply", [1, 2])
    labelled(tmp_path / "b.ply", [1, 2, 3])
    with pytest.raises(InputError, match=r"has 2 points, the truth .* has 3"):
        run_instances(tmp_path / "a.ply", tmp_path / "b.ply")
    write_cloud(tmp_path / "c.ply", PointCloud(np.zeros((2, 3), np.float32)))
    with pytest.raises(InputError, match="instance_id"):
        run_instances(tmp_path / "c.ply", tmp_path / "a.ply")


def test_the_same_points_in_another_order_are_told(tmp_path):
    """A perfect prediction, saved in another order, scored 0. A frame of its own is no other order."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (4000, 3)).astype(np.float32)
    ids = np.digitize(points[:, 0], [-0.5, 0, 0.5]).astype(np.int32) + 1
    order = rng.permutation(4000)
    turned = (
        points[:, [1, 2, 0]] * 1.3 + np.float32([100, 20, 3]) + rng.normal(0, 1e-3, points.shape).astype(np.float32)
    )
    for name, xyz, label in (("gt", points, ids), ("turned", turned, ids), ("mixed", points[order], ids[order])):
        write_cloud(tmp_path / f"{name}.ply", PointCloud(xyz, labels={"instance_id": label}))
    assert run_instances(tmp_path / "turned.ply", tmp_path / "gt.ply")[0]["ap"] == 1
    with pytest.raises(InputError, match=r"mixed\.ply: half of its points lie over \d+%"):
        run_instances(tmp_path / "mixed.ply", tmp_path / "gt.ply")


def test_two_hundred_by_two_hundred_on_a_million_points():
    rng = np.random.default_rng(0)
    gt = rng.integers(1, 201, 1_000_000)
    pred = np.where(rng.random(1_000_000) < 0.3, rng.integers(0, 200, 1_000_000), gt - 1)
    result = evaluate(pred, {i: i / 200 for i in range(200)}, gt)
    assert result["num_truth"] == result["num_predictions"] == 200 and result["ap50"] == 1.0
    overlap = overlap_of_ids(pred, None, read_truth(gt))
    counts = np.histogram2d(gt, pred, [np.arange(1, 202), np.arange(201)])[0]
    iou = counts / (counts.sum(axis=1)[:, None] + counts.sum(axis=0)[None] - counts)
    np.testing.assert_allclose(overlap.iou.T, iou, rtol=1e-12)
