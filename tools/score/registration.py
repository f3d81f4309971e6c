"""Scores structure from motion on thinned sets of photos beside pycolmap: registered, wrong, errors

Runs one way over the sets that WORK has no result of, then prints a row for each set, with columns for each way that
WORK knows. Poses are compared after a similarity; a wrong one is off by more than 5° or a tenth of the cameras' spread.

python tools score.registration DATA WORK --way base --sets bonsai:1      # poses to compare with, where DATA has none
python tools score.registration DATA WORK --way pycolmap
PYTHONPATH=OLDER/CHECKOUT python tools score.registration DATA WORK --way base
python tools score.registration DATA WORK --way now
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.geometry import align_similarity, inverse_se3
from perception.inputs.load import load_scene
from perception.photos.lens import load_pycolmap
from perception.sfm.options import ReadOptions

THINNED = {
    "fox_480": (2, 3, 4),
    "tabletop_a": (2, 3, 4),
    "room_a": (2, 3, 4),
    "kitchen_rgbd": (2, 3, 4),
    "bonsai": (8, 12, 16),
}
SETS = [f"{scene}:{step}" for scene, steps in THINNED.items() for step in steps] + ["kitchen_rgbd:3:video"]
"""SCENE:STEP, every STEP-th photo; with `video` these photos as a video of 15 frames a second."""
POSES = {"kitchen_rgbd": "refined/transforms.json"}
"""Files of true poses where they are not transforms.json."""
WRONG_DEGREES, WRONG_SHARE = 5.0, 0.1
"""A pose that is off by more is wrong: degrees, and a share of the mean distance of the cameras from their centre."""
FLIPPED = np.diag([1.0, -1.0, -1.0])
"""OpenGL's camera axes to OpenCV's."""
Found = dict[str, Any]
"""poses: camera_from_world [3, 4] by file name; seconds, cpu; notes."""


def made(data: Path, work: Path, name: str) -> Path:
    """The folder of photos, or the video, of a set."""
    scene, step, *video = name.split(":")
    folder = work / name.replace(":", "_") / "photos"
    photos = sorted((data / scene / "images").iterdir())[:: int(step)]
    target = folder.with_name("video.mp4") if video else folder
    if not target.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        if video:
            height, width = cv2.imread(str(photos[0])).shape[:2]
            writer = cv2.VideoWriter(str(target), cv2.VideoWriter.fourcc(*"mp4v"), 15, (width, height))
            for photo in photos:
                writer.write(cv2.imread(str(photo)))
            writer.release()
        else:
            folder.mkdir()
            for photo in photos:
                (folder / photo.name).symlink_to(photo.resolve())
    return target


def package(source: Path, work: Path) -> Found:
    """The way of `map`, of the package that is imported."""
    try:
        scene = load_scene(source, ReadOptions(work, frames=source.parent / "frames"))
    except InputError as error:
        return {"poses": {}, "report": {"warnings": [str(error)]}}
    poses = {view.name: view.camera_from_world[:3].tolist() for view in scene.views}
    kept = ("registered", "models", "warnings", "notes", "left_out", "mean_track_length", "steps", "seconds")
    return {"poses": poses, "report": {key: scene.report[key] for key in kept if key in scene.report}}


def pycolmap_defaults(source: Path, work: Path) -> Found:
    """pycolmap's own defaults; of a video, on the frames that `map` has chosen."""
    pycolmap, folder = load_pycolmap(), source.parent / "frames" if source.is_file() else source
    if source.is_file() and not folder.is_dir():
        sys.exit(f"{source}: run another way first, which chooses the frames")
    pycolmap.set_random_seed(0)
    database = work / "database.db"
    pycolmap.extract_features(database, folder)
    pycolmap.match_exhaustive(database)
    models = pycolmap.incremental_mapping(database, folder, work).values()
    best = max(models, key=lambda model: model.num_reg_images(), default=pycolmap.Reconstruction())
    images = [best.images[i] for i in best.reg_image_ids()]
    sizes = [model.num_reg_images() for model in models]
    return {"poses": {i.name: i.cam_from_world().matrix().tolist() for i in images}, "report": {"models": sizes}}


def truth(data: Path, work: Path, name: str, names: list[str]) -> dict[str, np.ndarray]:
    """True world_from_camera [3, 4] of the photos `names` of a set, if known, else those of the set of all."""
    scene, step, *video = name.split(":")
    file = data / scene / POSES.get(scene, "transforms.json")
    if file.is_file():
        frames = json.loads(file.read_text(encoding="utf-8"))["frames"]
        known = {Path(frame["file_path"]).name: np.array(frame["transform_matrix"])[:3] for frame in frames}
        known = {each: np.c_[pose[:, :3] @ FLIPPED, pose[:, 3]] for each, pose in known.items()}
    else:
        every = sorted((work / "results").glob(f"{scene}_1.*.json"))
        poses = json.loads(every[0].read_text())["poses"] if every else {}
        known = {each: inverse_se3(np.vstack([pose, [0, 0, 0, 1]]))[:3] for each, pose in poses.items()}
    if video:
        photos = sorted(photo.name for photo in (data / scene / "images").iterdir())[:: int(step)]
        known = {each: known[photos[int(Path(each).stem)]] for each in names}
    return {each: known[each] for each in names if each in known}


def errors(poses: dict[str, Any], known: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the centres, as shares of the spread of the true ones, and of the rotations, in degrees.
    The similarity is that with the least median error of those by three cameras; then by all that it fits."""
    right = np.array([known[name] for name in poses])
    found = np.array(list(poses.values()))
    turned = np.swapaxes(found[:, :, :3], 1, 2)
    centres = -np.einsum("nij,nj->ni", turned, found[:, :, 3])
    spread = np.linalg.norm(right[:, :, 3] - right[:, :, 3].mean(0), axis=1).mean()

    def away(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scale, turn, shift = align_similarity(right[chosen, :, 3], centres[chosen])
        off = np.linalg.norm(scale * centres @ turn.T + shift - right[:, :, 3], axis=1) / spread
        angle = Rotation.from_matrix(np.swapaxes(right[:, :, :3], 1, 2) @ turn @ turned).magnitude()
        return off, np.degrees(angle)

    rng = np.random.default_rng(0)
    tried = [away(rng.choice(len(right), 3, replace=False)) for _ in range(300)]
    best = min(tried, key=lambda each: float(np.median(each[0]) + np.median(each[1]) / 100))
    fits = (best[0] < WRONG_SHARE) & (best[1] < WRONG_DEGREES)
    return away(fits) if fits.sum() >= 3 else best


def row(data: Path, work: Path, name: str, found: Found) -> str:
    poses, report = found["poses"], found["report"]
    known = truth(data, work, name, list(poses))
    cell = f"{len(poses)} | {found['seconds']:.0f} ({found['cpu']:.0f}) | "
    if len(known) < 3 or len(known) < len(poses):
        return cell + "| | "
    off, angle = errors(poses, known)
    wrong = int(((off > WRONG_SHARE) | (angle > WRONG_DEGREES)).sum())
    doubted = " warned" if any("folded" in warning for warning in report.get("warnings", ())) else ""
    return cell + f"{1000 * np.median(off):.2f}, {np.median(angle):.2f}° | {wrong}{doubted} | "


def table(data: Path, work: Path, sets: list[str]) -> None:
    ways = sorted({file.suffixes[-2][1:] for file in work.glob("results/*.*.json")})
    head = [f"{way}: photos | s (CPU s) | median error, ‰ of the spread, and degrees | wrong" for way in ways]
    print("| set | photos | " + " | ".join(head) + " |\n" + "|---" * (2 + 4 * len(ways)) + "|")
    for name in sets:
        cells = ""
        source = made(data, work, name)
        photos = source.parent / "frames" if source.is_file() else source
        for way in ways:
            file = work / "results" / f"{name.replace(':', '_')}.{way}.json"
            cells += row(data, work, name, json.loads(file.read_text())) if file.is_file() else "| | | | "
        count = len([photo for photo in photos.iterdir() if photo.suffix.lower() != ".json"])
        print(f"| {name} | {count} | {cells.strip()}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the scenes, each with `images`")
    parser.add_argument("work", type=Path, help="folder of the sets and results, which later calls use again")
    parser.add_argument("--way", help="`pycolmap`, or any other name for the package that is imported; only the table")
    parser.add_argument("--sets", nargs="+", default=SETS, help=f"of {' '.join(SETS)}, or others of the kind")
    options = parser.parse_args()
    if options.way and not re.fullmatch(r"[\w-]+", options.way):
        parser.error("--way: letters and digits only")
    (options.work / "results").mkdir(parents=True, exist_ok=True)
    for name in options.sets if options.way else ():
        file = options.work / "results" / f"{name.replace(':', '_')}.{options.way}.json"
        if file.exists():
            continue
        source = made(options.data, options.work, name)
        scratch = source.parent / f"work-{options.way}"
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir()
        started, begun = time.perf_counter(), _cpu()
        found = (pycolmap_defaults if options.way == "pycolmap" else package)(source, scratch)
        found |= {"seconds": time.perf_counter() - started, "cpu": _cpu() - begun}
        file.write_text(json.dumps(found))
        print(f"{name}: {len(found['poses'])} registered, {found['seconds']:.0f} s", file=sys.stderr, flush=True)
    table(options.data, options.work, options.sets)


def _cpu() -> float:
    """CPU seconds of this process and of those it waited for."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


if __name__ == "__main__":
    main()
