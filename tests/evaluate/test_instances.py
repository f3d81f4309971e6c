"""Instance AP against a plain mask-by-mask implementation of the rules, closed forms, and bad input."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from perception.errors import InputError
from perception.evaluate.instances import evaluate
from support.ap import evaluate_masks


@cache
def iou(a, b):
    return len(a & b) / len(a | b)


def slow_aps(masks, scores, classes, gt_ids, gt_classes, label, thresholds, min_region):
    """`slow_ap` at each threshold, of the masks as sets of points."""
    preds = []
    for mask, score, cls in zip(masks, scores, classes, strict=True):
        points = frozenset(np.flatnonzero(mask).tolist())
        if cls == label and len(points) >= max(min_region, 1):
            preds.append((points, score))
    truths = []
    for g in sorted(set(gt_ids.tolist())):
        if g > 0 and gt_classes[g] == label:
            truths.append(frozenset(np.flatnonzero(gt_ids == g).tolist()))
    void = set(np.flatnonzero(gt_ids <= 0).tolist())
    return [slow_ap(preds, truths, void, threshold, min_region) for threshold in thresholds]


def slow_ap(preds, truths, void, threshold, min_region):
    """One mask at a time, straight from the rules: Python sets, an explicit curve, trapezoids between
    neighbours.
    """
    big = [t for t in truths if len(t) >= min_region]
    if not big:
        return math.nan
    if not preds:
        return 0.0

    events, misses, used = [], 0, [False] * len(preds)
    for t in big:
        held = None
        for i, (points, score) in enumerate(preds):
            if used[i] or not iou(points, t) > threshold:
                continue
            if held is None:
                held, used[i] = score, True
            else:
                events.append((min(held, score), 0))
                held = max(held, score)
        if held is None:
            misses += 1
        else:
            events.append((held, 1))
    for points, score in preds:
        if any(iou(points, t) > threshold for t in truths):
            continue
        ignored = len(points & void) + sum(len(points & t) for t in truths if len(t) < min_region)
        if ignored / len(points) <= threshold:
            events.append((score, 0))
    if not events:
        return 0.0
    hits = sum(e[1] for e in events)
    curve = []
    for level in sorted({e[0] for e in events}):
        above = [e[1] for e in events if e[0] >= level]
        curve.append((sum(above) / (hits + misses), sum(above) / len(above)))
    curve.append((0.0, 1.0))
    area = 0.0
    for i, (_, precision) in enumerate(curve):
        before = curve[max(i - 1, 0)][0]
        after = curve[i + 1][0] if i + 1 < len(curve) else 0.0
        area += precision * (before - after) / 2
    return area


def random_case(seed):
    rng = np.random.default_rng(seed)
    n = 900
    gt_ids = np.repeat(rng.integers(-1, 14, 60), 15)
    gt_classes = {g: int(rng.integers(1, 4)) for g in range(-1, 14)}
    masks = []
    for _ in range(int(rng.integers(0, 24))):
        mask = gt_ids == rng.integers(-1, 14)
        flip = rng.random(n) < rng.choice([0.02, 0.1, 0.3])
        mask = mask ^ (flip & (rng.random(n) < 0.5))
        if rng.random() < 0.3:
            mask |= gt_ids == rng.integers(-1, 14)
        masks.append(mask)
        if rng.random() < 0.4:
            masks.append(mask & (rng.random(n) < 0.8))
    scores = rng.choice([0.1, 0.3, 0.3, 0.5, 0.9], len(masks)) if seed % 2 else rng.random(len(masks))
    classes = rng.integers(1, 4, len(masks))
    return masks, scores, classes, gt_ids, gt_classes


@pytest.mark.parametrize("block", range(10))
def test_agrees_with_a_plain_implementation_on_200_cases(block):
    for seed in range(20 * block, 20 * block + 20):
        masks, scores, classes, gt_ids, gt_classes = random_case(seed)
        by_class = seed % 3 == 0
        semantics = np.array([gt_classes[g] for g in gt_ids.tolist()])
        extra = {"classes": classes, "gt_semantics": semantics} if by_class else {}
        got = evaluate_masks(masks, scores, gt_ids, min_region=40, by_class=by_class, **extra)
        labels = sorted(set(gt_classes.values())) if by_class else [1]
        kinds = gt_classes if by_class else dict.fromkeys(range(-1, 14), 1)
        thresholds = [*np.arange(0.5, 0.95, 0.05), 0.25]
        chosen = classes if by_class else np.ones(len(masks), int)
        want = [slow_aps(masks, scores, chosen, gt_ids, kinds, c, thresholds, 40) for c in labels]
        want = np.array(want)[~np.isnan(np.array(want)[:, 0])]
        assert got["ap"] == pytest.approx(want[:, :9].mean(), abs=1e-9)
        assert got["ap50"] == pytest.approx(want[:, 0].mean(), abs=1e-9)
        assert got["ap25"] == pytest.approx(want[:, 9].mean(), abs=1e-9)


def test_a_labelling_equals_its_masks():
    rng = np.random.default_rng(5)
    gt = np.repeat(rng.integers(0, 9, 40), 50)
    pred = np.where(rng.random(2000) < 0.2, rng.integers(-1, 8, 2000), gt - 1)
    scores = {i: float(rng.random()) for i in range(8)}
    by_ids = evaluate(pred, scores, gt)
    by_masks = evaluate_masks([pred == i for i in range(8)], [scores[i] for i in range(8)], gt)
    assert by_ids["per_threshold"] == by_masks["per_threshold"]


def test_truth_against_itself_is_perfect_and_ids_do_not_matter():
    gt = np.repeat(np.arange(1, 6), 200)
    assert evaluate(gt, None, gt)["ap"] == pytest.approx(1.0)
    renamed = np.array([0, 70000000, 3, 9, 4, 0])[gt]
    result = evaluate(renamed, None, gt)
    assert (result["ap"], result["ap50"], result["ap25"]) == (1.0, 1.0, 1.0)


def test_closed_form_one_hit_one_miss_one_false_positive():
    # Scores .9 (hit) and .4 (false positive), two truths: curve (r .5, p .5), (.5, 1), (0, 1).
    gt = np.repeat([1, 2, 3], 100)
    masks = [gt == 1, (np.arange(300) >= 150) & (np.arange(300) < 250)]
    gt3 = np.where(gt == 3, 2, gt)
    result = evaluate_masks([masks[0], np.arange(300) < 100], [0.9, 0.4], gt3)
    # the second mask duplicates the first: a false positive at the lower score
    assert result["ap50"] == pytest.approx(0.5 * (0.5 - 0.5) / 2 + 1.0 * (0.5 - 0.0) / 2 + 1.0 * 0.5 / 2)


def test_iou_equal_to_the_threshold_is_no_match():
    gt = np.repeat([1, 0], 200)
    mask = np.arange(400) < 100  # IoU exactly .5
    assert evaluate_masks([mask], [1.0], gt)["ap50"] == 0.0
    assert evaluate_masks([np.arange(400) < 101], [1.0], gt)["ap50"] == 1.0


def test_nine_thresholds():
    gt = np.repeat([1, 2], 200)
    result = evaluate(gt, None, gt)
    assert [round(row["iou"], 2) for row in result["per_threshold"]] == [
        0.5,
        0.55,
        0.6,
        0.65,
        0.7,
        0.75,
        0.8,
        0.85,
        0.9,
        0.25,
    ]


def test_ignored_points_are_removed_by_scannetpp_and_void_elsewhere():
    gt = np.repeat([1, -100], 200)
    pred = np.zeros(400, int)  # half on ignored points
    assert evaluate(pred, None, gt, "scannetpp")["ap50"] == 1.0
    assert evaluate(pred, None, gt, "scannet")["ap50"] == 0.0


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
def test_ignored_points_of_unsigned_truth_are_void(kind):
    """They became an object of the greatest number, or an error (NumPy 2.5)."""
    gt, ignore = np.repeat([1, 2], 200), np.repeat([False, True], 200)
    pred = np.repeat([0, 1], 200)
    for protocol in ("scannet", "mask3d", "scannetpp"):
        assert evaluate(pred, None, gt.astype(kind), protocol, ignore) == evaluate(pred, None, gt, protocol, ignore)
    assert evaluate(pred, None, gt.astype(kind), "scannet", ignore)["ap50"] == 1.0


def test_confidence_order_matters_and_segment3d_drops_it():
    gt = np.repeat([1, 2, 3], 200)
    pred = np.repeat([0, 1, 2, 3, 4, 5], 100)  # halves: IoU .5 each, none above
    pred[:200] = 0
    low_first = evaluate(pred, {0: 0.1, 2: 0.9, 3: 0.9, 4: 0.9, 5: 0.9}, gt)["ap50"]
    high_first = evaluate(pred, {0: 0.9, 2: 0.1, 3: 0.1, 4: 0.1, 5: 0.1}, gt)["ap50"]
    assert high_first > low_first
    flat = [evaluate(pred, {0: s, 2: 0.5, 3: 0.5, 4: 0.5, 5: 0.5}, gt, "segment3d")["ap50"] for s in (0.1, 0.9)]
    assert flat[0] == flat[1]


@pytest.mark.parametrize(
    ("pred", "scores", "changes", "word"),
    [
        (np.zeros(9, int), None, {}, "9 points, truth has 10"),
        (np.zeros(10), None, {}, "whole numbers"),
        (np.zeros(10, int), {1: 0.5}, {}, "no score for instance 0"),
        (np.zeros(10, int), {0: float("nan")}, {}, "not a finite number"),
        (np.zeros(10, int), None, {"protocol": "coco"}, "scannet, mask3d"),
    ],
)
def test_bad_input_is_told(pred, scores, changes, word):
    with pytest.raises(InputError, match=word) as error:
        evaluate(pred, scores, np.ones(10, int), **changes)
    assert "\n" not in str(error.value)


def test_empty_truth_has_no_figure_and_no_prediction_scores_zero():
    assert evaluate(np.zeros(500, int), None, np.zeros(500, int))["ap"] is None
    assert evaluate(np.full(500, -1), None, np.ones(500, int))["ap"] == 0.0
