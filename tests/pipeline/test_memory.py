"""Memory that does not grow with the number of photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("perception._core")
from perception.config import load_config
from perception.errors import InputError
from perception.io import memory
from perception.io.memory import DiskArrays, mapped_bytes
from perception.pipeline.estimate import image_memory
from perception.pipeline.mapping import build_map

MIB = 1 << 20


def test_arrays_beyond_the_limit_lie_on_disk_and_stay_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files: list[int] = []
    make = memory._new_file
    monkeypatch.setattr(memory, "_new_file", lambda folder, size: files.append(size) or make(folder, size))
    monkeypatch.setattr(memory, "CHUNK", 128)
    rng = np.random.default_rng(0)
    made = [rng.integers(0, 250, (size, 3)).astype(kind) for size in (7, 100, 1) for kind in ("u1", "i2", "f4", "?")]
    arrays = DiskArrays(tmp_path, limit=800)
    kept = [arrays.keep(array) for array in made]
    arrays.trim()
    for before, after in zip(made, kept, strict=True):
        np.testing.assert_array_equal(before, after)
        assert (before.dtype, before.shape) == (after.dtype, after.shape)
        assert after.ctypes.data % after.itemsize == 0
    assert len(files) == 6  # the first two blocks are in memory
    assert not list(tmp_path.iterdir())  # unnamed: nothing is left, however the run ends


def test_arrays_beside_others_fill_the_same_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "CHUNK", 128)
    first = DiskArrays(tmp_path, limit=800)  # three blocks in memory
    held = [first.keep(np.zeros(128, np.uint8)) for _ in range(2)]
    files: list[int] = []
    make = memory._new_file
    monkeypatch.setattr(memory, "_new_file", lambda folder, size: files.append(size) or make(folder, size))
    second = DiskArrays(tmp_path, 800, first)
    held += [second.keep(np.zeros(128, np.uint8)) for _ in range(3)]
    assert files == [128, 128]


def test_pages_are_dropped_while_a_large_array_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the thread that looks at them has no turn."""
    if mapped_bytes() == 1 << 62:
        pytest.skip("the system does not tell what is resident")
    monkeypatch.setattr(memory, "_watch", lambda _: None)
    arrays, before, seen = DiskArrays(tmp_path, limit=4 * MIB), mapped_bytes(), list[int]()
    monkeypatch.setattr(memory, "mapped_bytes", lambda: seen.append(mapped_bytes()) or seen[-1])
    numbers = np.arange(24 * MIB, dtype=np.uint8)
    np.testing.assert_array_equal(arrays.keep(numbers), numbers)
    assert len(seen) == 24 and max(seen) - before < 5 * MIB


def test_pages_of_files_are_dropped_beyond_the_limit(tmp_path: Path) -> None:
    before = mapped_bytes()
    if before == 1 << 62:
        pytest.skip("the system does not tell what is resident")
    arrays = DiskArrays(tmp_path, limit=2 * MIB)
    kept = [arrays.keep(np.full(MIB, i, np.uint8)) for i in range(24)]
    arrays.trim()
    assert mapped_bytes() - before < 4 * MIB
    assert [int(array.max()) for array in kept] == list(range(24))


def test_a_full_disk_is_an_error_and_not_a_signal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(memory.os, "posix_fallocate", full, raising=False)
    with pytest.raises(OSError, match="No space"):
        DiskArrays(tmp_path, limit=0).keep(np.zeros(9))


@pytest.mark.slow
def test_a_map_is_the_same_with_its_photos_on_disk(small_scene: Path, tmp_path: Path) -> None:
    words = [f"masks=labels:{small_scene / 'labels'}", "train.iterations=8", "train.budget=500"]
    words.append("language.encoder=none")
    held, on_disk = (
        build_map(small_scene, tmp_path / f"{name}.gsmap", load_config(None, [*words, *more]))
        for name, more in (("held", []), ("disk", ["photos.memory=1M"]))
    )
    for name in ("means", "sh", "features", "instance_ids", "membership"):
        np.testing.assert_array_equal(getattr(held, name), getattr(on_disk, name))


@pytest.mark.parametrize("text", ["8G", "8g", "8GB", "8Gi", "8GiB", "8192M", "8192mb"])
def test_a_size_in_each_spelling(text: str) -> None:
    config = load_config(options={"photos.memory": (text, "--memory")})
    assert image_memory(config, None) == 8 << 30


@pytest.mark.parametrize("text", ["8", "0G", "-1G", "1.5G", "8 GB", "G", "8B", "8GIIB"])
def test_a_size_that_is_none(text: str) -> None:
    with pytest.raises(InputError, match=r"photos\.memory: found .* expected a size such as 500M or 8G or none"):
        load_config(None, [f"photos.memory={text}"])
