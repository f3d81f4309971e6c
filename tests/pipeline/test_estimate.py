"""The memory estimate before the work, against figures that were read, and the refusal of what cannot fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from perception.config import load_config
from perception.errors import InputError
from perception.gaussians.state import sized
from perception.inputs.load import PhotoSizes, photo_sizes
from perception.pipeline import estimate as module
from perception.pipeline.estimate import check_memory, check_size, largest_budget, log_estimate, needed_bytes
from support.given_poses import SIZE, transforms

GIB = 2**30


@pytest.mark.parametrize(
    ("count", "size", "budget", "gib"),  # GiB read on two cores: fox_480, the same with half the budget, room_a
    [(50, (270, 480), 100_000, 1.2), (50, (270, 480), 50_000, 1.1), (86, (640, 480), 100_000, 1.4)],
)
def test_the_estimate_is_near_what_was_read(count: int, size: tuple[int, int], budget: int, gib: float) -> None:
    assert needed_bytes(PhotoSizes([size] * count, ""), 800, budget) / GIB == pytest.approx(gib, rel=0.2)


def test_what_grows_the_estimate() -> None:
    base, more = (PhotoSizes([(640, 480)] * count, "") for count in (50, 100))
    small = needed_bytes(base, 800, 100_000)
    assert needed_bytes(more, 800, 100_000) - small == 50 * 640 * 480 * 7  # photo and labels
    assert needed_bytes(base, 800, 200_000) - small == 100_000 * 2400
    assert needed_bytes(replace(base, depth=True), 800, 100_000) - small == 50 * 640 * 480 * 5
    assert needed_bytes(base, 320, 100_000) < small
    assert small - needed_bytes(base, 800, 100_000, 5 << 20) == 50 * 640 * 480 * 7 - (5 << 20)  # the others: on disk


def test_a_run_that_cannot_fit_says_what_to_change() -> None:
    """It was ended by the system after hours, without a word."""
    photos = PhotoSizes([(4032, 3024)] * 3000, "3000 photos")
    words = ["photos.max_side=2000", "train.budget=1000000", "photos.memory=90G"]
    with pytest.raises(InputError, match=r"^3000 photos need about [\d.]+ GiB with .* give --max-side \d+") as told:
        check_memory(photos, load_config(None, words), 6 * GIB)
    options = str(told.value).rpartition("give ")[2].replace("--max-side ", "photos.max_side=")
    changed = options.replace("--budget ", "train.budget=").split()
    check_memory(photos, load_config(None, words + changed), 6 * GIB)
    with pytest.raises(InputError, match="fewer or smaller photos"):
        check_memory(photos, load_config(None, words), GIB // 2)


@pytest.mark.parametrize("gib", [1.3, 1.5, 1.7, 2, 4])
def test_a_small_machine_gives_a_map_its_gaussians(gib: float) -> None:
    """Half of 1.7 GiB is the program alone: a map had 100 Gaussians there, and nobody was told."""
    limit = int(gib * GIB)
    budget = sized(load_config(None, []), 43, largest_budget(limit)).train.budget
    assert 50_000 <= budget <= 100_000
    assert check_memory(PhotoSizes([(480, 640)] * 43, ""), load_config(None, []), limit) <= limit


def test_the_line_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for index in range(4):
        Image.new("RGB", (64, 48)).save(tmp_path / f"{index}.png")
    (tmp_path / "3.png").write_bytes(b"broken")
    assert photo_sizes(tmp_path) == PhotoSizes([(64, 48)] * 3, "3 photos")
    lines: list[str] = []
    log_estimate(tmp_path, load_config(None, []), lines.append)
    assert lines == ["3 photos, trained at up to 800 pixels: about 1.1 GiB"]
    monkeypatch.setattr(module, "memory_limit", lambda: GIB // 2)
    with pytest.raises(InputError, match=r"there are 0\.5"):
        log_estimate(tmp_path, load_config(None, []), lines.append)


def test_sizes_of_posed_inputs(tmp_path: Path) -> None:
    transforms(tmp_path)
    assert photo_sizes(tmp_path) == photo_sizes(tmp_path / "transforms.json") == PhotoSizes([SIZE] * 8, "8 photos")


@pytest.mark.parametrize(("size", "least"), [((270, 480), 20), ((640, 480), 15), ((4000, 1000), 44)])
def test_photos_too_small_to_be_scored_are_refused_before_the_work(size: tuple[int, int], least: int) -> None:
    """It was told after the training, by SSIM, whose windows have 11 pixels a side. One small file among others is not
    counted: it is left out later."""
    photos = PhotoSizes([size] * 4 + [(8, 8)], "5 photos")
    check_size(photos, least)
    side = max(size)
    assert round(min(size) * least / side) >= 11 > round(min(size) * (least - 2) / side)
    with pytest.raises(
        InputError, match=rf"^5 photos of {size[0]}×{size[1]} pixels .* give --max-side {least} or more$"
    ):
        check_size(photos, least - 1)
    with pytest.raises(InputError, match="at least 11 a side"):
        check_size(PhotoSizes([(300, 10)], "1 photo"), 800)
