"""View choice, crop geometry and photo-by-photo description against brute force and a hand-made encoder."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest

from perception.instances.crops import (
    FILL,
    choose_views,
    crop_levels,
    expand_box,
    letterbox,
    mask_box,
    view_scores,
)
from perception.instances.describe import Unread, describe_instances
from perception.language.colors import palette
from support.progress import Told


class MeanColor:
    """A hand-made encoder: the mean colour of a picture, scaled to length 1."""

    identity, dim, templates = "mean-color", 3, ("{}",)

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        means = np.array([i.reshape(-1, 3).mean(0) for i in images], np.float32)
        return means / np.linalg.norm(means, axis=1, keepdims=True)

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        return np.eye(3, dtype=np.float32)[[len(t) % 3 for t in texts]]


def test_view_score_is_the_papers() -> None:
    scores = view_scores(np.array([[50, 0]]), np.array([100, 200]), np.array([[0.5, 1.0]]))
    assert scores.tolist() == [[0.25, 0.0]]


def test_best_views_first_ties_by_order_and_zeros_never() -> None:
    scores = np.array([[0.1, 0.5, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]])
    first, second = choose_views(scores, 3)
    assert first.tolist() == [1, 3, 0]
    assert second.tolist() == []


def test_boxes_by_hand() -> None:
    mask = np.zeros((40, 60), bool)
    mask[10:20, 30:50] = True
    assert mask_box(mask) == (30, 10, 50, 20)
    assert mask_box(np.zeros((4, 4), bool)) is None
    assert expand_box((30, 10, 50, 20), 0.3, 60, 40) == (24, 7, 56, 23)
    assert expand_box((30, 10, 50, 20), 0.6, 60, 40) == (18, 4, 60, 26)


@pytest.mark.parametrize(("height", "width"), [(4, 9), (9, 4), (5, 5), (1, 3)])
def test_letterbox_keeps_every_pixel(height: int, width: int) -> None:
    image = np.random.default_rng(1).integers(0, 255, (height, width, 3), dtype=np.uint8)
    square = letterbox(image)
    side = max(height, width)
    assert square.shape == (side, side, 3)
    top, left = (side - height) // 2, (side - width) // 2
    assert np.array_equal(square[top : top + height, left : left + width], image)
    outside = np.ones((side, side), bool)
    outside[top : top + height, left : left + width] = False
    assert np.all(square[outside] == FILL)


def test_levels_grow_by_the_expansion() -> None:
    photo = np.random.default_rng(2).integers(0, 255, (100, 100, 3), dtype=np.uint8)
    mask = np.zeros((100, 100), bool)
    mask[40:60, 45:55] = True
    crops = crop_levels(photo, mask, levels=3)
    assert [len(c) for c in crops] == [20, 32, 44]
    assert np.array_equal(crops[1][:, 8:24], photo[34:66, 42:58])
    assert crop_levels(photo, np.zeros((100, 100), bool)) == []


def test_description_is_the_mean_over_crops_whatever_the_order_of_photos() -> None:
    rng = np.random.default_rng(4)
    photos = rng.integers(20, 255, (4, 48, 64, 3), dtype=np.uint8)
    ids = np.full((4, 48, 64), -1, np.int32)
    ids[:, 5:20, 8:30], ids[:, 25:45, 30:60] = 0, 1
    loaded: list[int] = []

    def load(view: int) -> tuple[np.ndarray, np.ndarray]:
        loaded.append(view)
        return photos[view], ids[view]

    choices = [np.array([2, 0]), np.array([3]), np.array([], np.int64)]
    names = [f"{v}.jpg" for v in range(4)]
    told = Told()
    found = describe_instances(MeanColor(), choices, load, names, progress=told)
    assert loaded == [0, 2, 3]
    assert told.updates == [("language", done, 3) for done in (1, 2, 3)]
    rows = [MeanColor().encode_images(crop_levels(photos[v], ids[v] == 0, 3)).astype(np.float64) for v in (2, 0)]
    mean = np.mean(list(itertools.chain(*rows)), axis=0)
    assert np.allclose(found[0].embedding, mean / np.linalg.norm(mean), atol=1e-6)
    assert found[0].views == ["2.jpg", "0.jpg"] and found[0].boxes == [(8, 5, 30, 20)] * 2
    first = rows[0].mean(0)
    assert np.allclose(found[0].per_view[0], first / np.linalg.norm(first), atol=1e-6)
    assert not found[2].seen and not found[2].embedding.any()


def test_palette_comes_from_the_mask_alone() -> None:
    photo = np.full((60, 60, 3), (0, 0, 255), np.uint8)
    ids = np.full((60, 60), -1, np.int32)
    photo[20:40, 20:40], ids[20:40, 20:40] = (255, 0, 0), 0
    found = describe_instances(MeanColor(), [np.array([0])], lambda _: (photo, ids), ["a.jpg"])
    assert np.allclose(found[0].palette, palette(np.array([[255, 0, 0]], np.uint8)), atol=1e-4)


def test_unread_gives_the_views_boxes_and_colours_of_any_encoder_and_no_embedding() -> None:
    rng = np.random.default_rng(0)
    photos = rng.integers(0, 256, (3, 30, 40, 3), np.uint8)
    ids = rng.integers(-1, 2, (3, 30, 40)).astype(np.int32)
    choices = [np.array([2, 0]), np.array([1]), np.array([], int)]
    both = [
        describe_instances(encoder, choices, lambda n: (photos[n], ids[n]), ["a", "b", "c"], 1)
        for encoder in (MeanColor(), Unread(3))
    ]
    for read, unread in zip(*both, strict=True):
        assert (read.views, read.boxes) == (unread.views, unread.boxes)
        np.testing.assert_array_equal(read.palette, unread.palette)
        np.testing.assert_array_equal(unread.per_view, np.zeros_like(read.per_view))
        np.testing.assert_array_equal(unread.embedding, np.zeros(3))
