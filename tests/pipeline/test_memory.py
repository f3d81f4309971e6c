"""Memory that does not grow with the number of photos. As a command it reads the peak of whole runs:

python tests/pipeline/test_memory.py SCENE --photos 100 300 1000 --memory 500M [--plot peaks.png]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("perception._core")
import perception
from perception.config import load_config
from perception.errors import InputError
from perception.io import memory
from perception.io.memory import DiskArrays, mapped_bytes
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


def test_a_map_is_the_same_with_its_photos_on_disk(small_scene: Path, tmp_path: Path) -> None:
    words = [f"masks=labels:{small_scene / 'labels'}", "train.iterations=8", "train.budget=500"]
    words.append("language.encoder=none")
    held, on_disk = (
        build_map(small_scene, tmp_path / f"{name}.gsmap", load_config(None, [*words, *more]))
        for name, more in (("held", []), ("disk", ["photos.memory=1M"]))
    )
    for name in ("means", "sh", "features", "instance_ids", "membership"):
        np.testing.assert_array_equal(getattr(held, name), getattr(on_disk, name))


@pytest.mark.parametrize("text", ["8", "0G", "-1G", "1.5G", "8 GB", "G"])
def test_a_size_that_is_none(text: str) -> None:
    with pytest.raises(InputError, match=r"photos\.memory: found .* expected a size such as 500M or 8G or none"):
        load_config(None, [f"photos.memory={text}"])


# ---------------------------------------------------------------- the command


def repeated(scene: Path, count: int, folder: Path) -> Path:
    """A scene of `count` photos: those of `scene` (transforms.json, labels/) under new names, over and over."""
    document = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    given = document["frames"]
    frames = []
    for index in range(count):
        frame = given[index % len(given)]
        photo = (scene / frame["file_path"]).resolve()
        name = f"images/{index:05d}{photo.suffix}"
        (folder / "images").mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(photo)
        (folder / "labels").mkdir(exist_ok=True)
        (folder / f"labels/{index:05d}.png").symlink_to((scene / f"labels/{photo.stem}.png").resolve())
        frames.append({"file_path": name, "transform_matrix": frame["transform_matrix"]})
    for key in [key for key in document if key.endswith("_filenames")]:
        del document[key]
    cloud = next(scene.rglob("gt_points.ply"))  # structure from motion is not what is read here
    text = json.dumps({**document, "frames": frames, "ply_file_path": str(cloud.resolve())})
    (folder / "transforms.json").write_text(text, encoding="utf-8")
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="a made scene (transforms.json, labels/), whose photos are repeated")
    parser.add_argument("--photos", type=int, nargs="+", default=[100, 300])
    parser.add_argument("--memory", help="as of `map`")
    parser.add_argument("--builtin", action="store_true", help="masks of the built-in segmentation, not of labels/")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draws both against the photos (matplotlib)")
    options = parser.parse_args()
    if options.plot:
        import matplotlib  # noqa: F401  before minutes of work
    few = ["train.iterations=40", "train.budget=5000", "language.encoder=none", "photos.poses=keep", *options.pairs]
    more = ["--memory", options.memory] if options.memory else []
    paths = {**os.environ, "PYTHONPATH": str(Path(perception.__file__).resolve().parents[1])}
    measured = []
    for count in options.photos:
        with tempfile.TemporaryDirectory() as folder:
            scene = repeated(options.scene, count, Path(folder) / "scene")
            command = [sys.executable, "-m", "perception.cli", "map", str(scene), "-o", f"{folder}/m.gsmap", "--json"]
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            masks = "builtin" if options.builtin else f"labels:{scene / 'labels'}"
            words = [word for pair in [*few, f"masks={masks}"] for word in ("--set", pair)]
            done = subprocess.run([*command, *words, *more], cwd=folder, env=paths, capture_output=True, text=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            if done.returncode:
                raise SystemExit(done.stderr)
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            peak = json.loads(done.stdout)["peak_memory_mib"]
            print(f"{count} photos: peak {peak:.0f} MiB, {cpu:.0f} s of CPU", flush=True)
            measured.append((count, cpu, peak))
    if options.plot:
        draw(measured, options.plot)


def draw(measured: list[tuple[int, float, float]], file: Path) -> None:
    from matplotlib import pyplot as plt

    counts, *curves = zip(*measured, strict=True)
    _, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for axis, values, label in zip(axes, curves, ("CPU seconds", "peak memory, MiB"), strict=True):
        axis.plot(counts, values, "o-")
        axis.set(xlabel="photos", ylabel=label, ylim=(0, 1.15 * max(values)))
        for count, value in zip(counts, values, strict=True):
            axis.annotate(f"{value:.0f}", (count, value), (0, 6), textcoords="offset points", ha="center")
        axis.grid(alpha=0.3)
    plt.savefig(file, dpi=110)


if __name__ == "__main__":
    main()
