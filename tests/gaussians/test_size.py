"""Iterations and Gaussians by the number of photos, as arithmetic says."""

from __future__ import annotations

import pytest

from perception.config import load_config
from perception.gaussians.state import sized


@pytest.mark.parametrize(
    ("pairs", "photos", "wanted"),
    [
        ([], 10, (2000, 100_000)),
        ([], 43, (2000, 100_000)),
        ([], 86, (4000, 200_000)),
        (["train.effort=0.5"], 430, (10_000, 500_000)),
        (["train.iterations=77"], 86, (77, 200_000)),
        (["train.budget=5000", "train.effort=3"], 43, (6000, 5000)),
    ],
)
def test_both_are_proportional_to_the_photos_from_43_on(pairs: list[str], photos: int, wanted: tuple[int, int]) -> None:
    train = sized(load_config(None, pairs), photos).train
    assert (train.iterations, train.budget) == wanted


def test_memory_bounds_what_is_chosen_and_not_what_is_given() -> None:
    assert sized(load_config(), 430, 300_000).train.budget == 300_000
    assert sized(load_config(None, ["train.budget=400000"]), 430, 300_000).train.budget == 400_000


def test_a_sized_config_stays() -> None:
    once = sized(load_config(), 86)
    assert sized(once, 500) == once
