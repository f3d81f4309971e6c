"""The estimate before the work, against figures that were read, and the refusal of what cannot fit."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from perception.config import load_config
from perception.errors import InputError
from perception.io.inputs import PhotoSizes, photo_sizes
from perception.pipeline import estimate as module
from perception.pipeline.estimate import check_memory, estimate, log_estimate

GIB = 2**30
CASES = {  # photos, size, settings, seconds and GiB read on two cores
    "fox_480": (50, (270, 480), [], 268, 1.2),
    "fox_480 fast": (50, (270, 480), ["train.iterations=1500", "train.budget=50000"], 125, 1.1),
    "room_a": (86, (640, 480), ["masks=labels:x"], 222, 1.4),
    "tabletop_a, one core": (62, (640, 480), ["masks=labels:x"], 354, 1.3),
}


@pytest.mark.parametrize("name", CASES)
def test_the_estimate_is_near_what_was_read(name: str) -> None:
    count, size, settings, seconds, gib = CASES[name]
    needed = estimate(PhotoSizes([size] * count, True, f"{count} photos"), load_config(None, settings))
    assert needed.memory / GIB == pytest.approx(gib, rel=0.2)
    assert 0.5 < needed.training_seconds / seconds < 2 and needed.poses_seconds == 0


@pytest.mark.parametrize(("count", "size", "seconds"), [(50, (270, 480), 96), (62, (640, 480), 64)])
def test_the_estimate_of_structure_from_motion(count: int, size: tuple[int, int], seconds: float) -> None:
    needed = estimate(PhotoSizes([size] * count, False, ""), load_config(None, []))
    assert 0.5 < needed.poses_seconds / seconds < 2


def test_what_grows_the_estimate() -> None:
    base = PhotoSizes([(640, 480)] * 50, True, "50 photos")
    config = load_config(None, [])
    small = estimate(base, config)
    more = estimate(PhotoSizes([(640, 480)] * 100, True, ""), config)
    assert more.memory - small.memory == 50 * 640 * 480 * 7  # photo and labels
    assert estimate(base, load_config(None, ["train.budget=200000"])).memory - small.memory == 100_000 * 2400
    assert estimate(base, load_config(None, ["photos.max_side=320"])).memory < small.memory
    assert estimate(base, load_config(None, ["train.time_limit=1"])).training_seconds < small.training_seconds / 3
    assert estimate(PhotoSizes(base.sizes, False, ""), config).poses_seconds > 0


def test_a_run_that_cannot_fit_says_what_to_change() -> None:
    """It was ended by the system after hours, without a word."""
    photos = PhotoSizes([(4032, 3024)] * 3000, False, "3000 photos")
    words = ["photos.max_side=2000", "train.budget=1000000"]
    with pytest.raises(InputError, match=r"^3000 photos need about [\d.]+ GiB with .* give --max-side \d+") as told:
        check_memory(photos, load_config(None, words), 6 * GIB)
    options = str(told.value).rpartition("give ")[2].replace("--max-side ", "photos.max_side=")
    changed = options.replace("--budget ", "train.budget=").split()
    check_memory(photos, load_config(None, words + changed), 6 * GIB)
    with pytest.raises(InputError, match="fewer or smaller photos"):
        check_memory(photos, load_config(None, words), GIB // 2)


def test_the_line_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for index in range(4):
        Image.new("RGB", (64, 48)).save(tmp_path / f"{index}.png")
    (tmp_path / "3.png").write_bytes(b"broken")
    assert photo_sizes(tmp_path) == PhotoSizes([(64, 48)] * 3, False, "3 photos")
    lines: list[str] = []
    log_estimate(tmp_path, load_config(None, []), lines.append)
    (line,) = lines
    assert line.startswith("3 photos, trained at up to 64 pixels: about 1.1 GiB and") and "two cores" in line
    monkeypatch.setattr(module, "memory_limit", lambda: GIB // 2)
    with pytest.raises(InputError, match=r"there are 0\.5"):
        log_estimate(tmp_path, load_config(None, []), lines.append)


def test_sizes_of_posed_inputs(small_scene: Path) -> None:
    found = photo_sizes(small_scene)
    assert found == photo_sizes(small_scene / "transforms.json") == PhotoSizes([(128, 96)] * 12, True, "12 photos")
