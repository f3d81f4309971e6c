"""The built-in segmentation on known pictures."""

from __future__ import annotations

import numpy as np
import pytest

from perception.errors import InputError
from perception.masks import make_source
from perception.masks.cues import photo_cues
from perception.masks.region_graph import RegionGraph
from perception.masks.regions import segment_photo
from perception.masks.source import GeometryMaskSource
from support.mask_scores import best_ious


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
    assert (best_ious(labels, truth + 1) > 0.9).all() and len(np.unique(labels)) <= 8


def test_an_even_photo_is_one_region():
    labels = segment_photo(np.full((60, 80, 3), 128, np.uint8))
    assert len(np.unique(labels)) == 1


def test_the_same_photo_gives_the_same_labels():
    photo, _ = disc_and_box(3)
    np.testing.assert_array_equal(segment_photo(photo), segment_photo(photo.copy()))


def test_merging_keeps_the_evidence_exact():
    """After merging, all sums equal those of a graph built from the merged picture."""
    rng = np.random.default_rng(0)
    regions = np.kron(np.arange(30).reshape(5, 6), np.ones((24, 27), int))[:120, :160]
    photo = photo_cues(rng.integers(0, 256, (120, 160, 3)).astype(np.uint8))
    graph = RegionGraph(regions, photo)
    for _ in range(15):
        a = int(rng.choice([i for i in range(30) if graph.borders[i]]))
        b = int(rng.choice(list(graph.borders[a])))
        graph.merge(a, b)
        regions = np.where(regions == b, a, regions)
    kept, dense = np.unique(regions, return_inverse=True)
    fresh = RegionGraph(dense.reshape(regions.shape), photo)
    np.testing.assert_allclose(graph.sums[kept], fresh.sums)
    for i, a in enumerate(kept):
        others = [int(kept[j]) for j in fresh.borders[i]]
        assert sorted(others) == sorted(graph.borders[a])
        if others:
            expected = fresh.features(i, list(fresh.borders[i]))
            np.testing.assert_allclose(graph.features(int(a), others), expected, atol=1e-9)


def test_the_first_round_alone_judges_each_photo_by_itself() -> None:
    """`builtin:photos` never asks for geometry, and labels a photo as the default does before there is any."""
    first, both = make_source("builtin:photos"), make_source("builtin")
    assert not isinstance(first, GeometryMaskSource) and isinstance(both, GeometryMaskSource)
    assert first.identity != both.identity
    photo = np.zeros((60, 80, 3), np.uint8)
    photo[:, 40:] = 200
    np.testing.assert_array_equal(first.label_image(None, photo), both.label_image(None, photo))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="builtin:photos"):
        make_source("builtin:other")
