"""Measures peak memory and CPU time of whole runs against the number of photos.

python tools speed.memory SCENE --photos 100 300 1000 --memory 500M [--plot peaks.png]

The photos of SCENE are used again and again.
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

import perception


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
