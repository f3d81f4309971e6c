"""Our automatic masks against `SamAutomaticMaskGenerator`: a small SAM with random weights, exported to ONNX."""

from __future__ import annotations

import numpy as np
import pytest

from perception.config import SamConfig
from perception.masks.sam import automatic_masks, paint
from perception.masks.sam_models import open_sam
from support.sam_exports import export, imported, local_sam

SIDE, CHANNELS = 256, 32


@pytest.fixture(scope="module")
def segment_anything():
    with imported() as package:
        yield package


@pytest.fixture(scope="module")
def sam(segment_anything):
    """A small SAM whose random decoder gives logits and scores spread around the thresholds."""
    return local_sam(side=SIDE, channels=CHANNELS, depth=2, width=32)


@pytest.fixture(scope="module")
def exported(sam, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sam")
    export(sam, folder)
    return folder


def photo(height: int, width: int, seed: int) -> np.ndarray:
    """Coloured rectangles and noise."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 40, (height, width, 3))
    for _ in range(12):
        y, x = rng.integers(0, height - 10), rng.integers(0, width - 10)
        image[y : y + rng.integers(8, height), x : x + rng.integers(8, width)] += rng.integers(0, 90, 3)
    return image.clip(0, 255).astype(np.uint8)


CASES = [
    ({}, (96, 128), 7),
    ({}, (131, 87), 7),
    ({"stability": 0.8, "pred_iou": 0.5}, (96, 128), 6),
]


@pytest.mark.parametrize(("changes", "size", "side"), CASES)
def test_same_masks_in_the_same_order(segment_anything, sam, exported, changes, size, side):
    settings = SamConfig(points_per_side=side, skip_covered=False, **changes)
    image = photo(*size, seed=side)
    theirs = segment_anything.SamAutomaticMaskGenerator(
        sam,
        points_per_side=side,
        pred_iou_thresh=settings.pred_iou,
        stability_score_thresh=settings.stability,
    ).generate(image)
    ours = automatic_masks(open_sam(str(exported)), image, settings)
    print(f"{len(theirs)} masks")
    assert len(ours) == len(theirs) >= 5
    for found, record in zip(ours, theirs, strict=True):
        mask, expected = found.pixels(), record["segmentation"]
        assert (mask & expected).sum() >= 0.995 * (mask | expected).sum()
        assert found.pred_iou == pytest.approx(record["predicted_iou"], abs=1e-4)
        assert found.stability == pytest.approx(record["stability_score"], abs=5e-3)
        np.testing.assert_allclose(found.point, record["point_coords"][0], atol=1e-9)


def test_label_image_gives_every_pixel_to_the_best_mask(exported):
    image = photo(96, 128, seed=10)
    settings = SamConfig(points_per_side=10, stability=0.8, pred_iou=0.5)
    masks = automatic_masks(open_sam(str(exported)), image, settings)
    labels = paint(masks, image.shape[:2])
    stack = np.stack([mask.pixels() for mask in masks])
    of_mask = np.array([mask.pred_iou * mask.stability for mask in masks])
    scores = np.where(stack, of_mask[:, None, None], -np.inf)
    winners = np.where(stack.any(axis=0), scores.max(axis=0), 0.0)
    np.testing.assert_allclose(np.concatenate([[0.0], np.sort(of_mask)])[labels], winners)
