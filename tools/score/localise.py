"""Scores the poses that `localise` finds for the photos of a posed input, against the input's poses.

python tools score.localise KNOWN VISIT [--gone] [--alone] [--cropped SEED] [--truth TRANSFORMS]
python tools score.localise KNOWN --leave-out N [--alone] [--cropped SEED] [--truth TRANSFORMS]

KNOWN: a map, or a posed input, of which no map is made, as localisation needs photos and poses. VISIT: a posed input in
KNOWN's world; its poses are the truth, and only its lenses and depth images are used. --gone: the map's photos are not
used, only its renders. --alone: a call for each photo, as a robot asks. --cropped: of each photo a random part, 50 to
85 % of its width and height, without lens and depth. --leave-out N: every N-th photo of KNOWN, a transforms.json, is
left out and localised. --truth: other poses of the same photos. Prints a line for each photo, then one JSON object;
seconds are of CPU time. With --truth, from which KNOWN's refined poses differ together, "own_photos" has their errors,
and "beside" those of the new photos relative to the nearest of KNOWN's.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.export.render import write_picture
from perception.frame.recentre import map_from_input, moved
from perception.geometry import camera_centres, inverse_se3
from perception.inputs.load import load_scene
from perception.inputs.readers import reader_of
from perception.inputs.transforms import transforms_files
from perception.localise.localiser import Localised, Localiser, NewPhoto, NotHere
from perception.localise.photos import NO_POINTS, new_photos
from perception.map.map import Map
from perception.photos.decode import read_photo
from perception.progress import QUIET
from perception.sfm.options import ReadOptions
from perception.types import View


def gone(view: View) -> View:
    """The rule that finds no photo of the map."""
    raise InputError(f"{view.name}: taken as gone")


def truth_of(source: Path, workdir: Path) -> list[View]:
    """The views of a posed input, as given."""
    return reader_of(source).read(source, ReadOptions(workdir, poses="keep", cloud=NO_POINTS)).views


def split(known: Path, every: int, workdir: Path) -> tuple[Path, Path]:
    """Two files: the frames of a transforms.json without every N-th by name, and these."""
    file = transforms_files(known)[0]
    data = json.loads(file.read_text())
    frames = sorted(data["frames"], key=lambda frame: str(frame["file_path"]))
    for frame in frames:
        for key in ("file_path", "depth_file_path", "mask_path"):
            if key in frame:
                frame[key] = str((file.parent / frame[key]).resolve())
    parts = [frame for n, frame in enumerate(frames) if n % every], frames[::every]
    paths = workdir / "rest.json", workdir / "left.json"
    for path, part in zip(paths, parts, strict=True):
        path.write_text(json.dumps({**data, "frames": part}))
    return paths


def cropped(photos: list[NewPhoto], folder: Path, seed: int) -> list[NewPhoto]:
    """A random part of each photo, as a picture in `folder`, without lens and depth."""
    rng, parts = np.random.default_rng(seed), []
    for number, photo in enumerate(photos):
        pixels = read_photo(photo.photo, photo.as_stored)
        size = np.round(pixels.shape[:2] * rng.uniform(0.5, 0.85, 2)).astype(int)
        top, left = rng.integers(0, pixels.shape[:2] - size + 1)
        write_picture(folder / f"{number}.png", pixels[top : top + size[0], left : left + size[1]])
        parts.append(NewPhoto(photo.name, folder / f"{number}.png"))
    return parts


def difference(pose: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Distance of the centres of two cameras [4, 4], and the angle between their directions in degrees."""
    turn = pose[:3, :3] @ truth[:3, :3].T
    sine = np.linalg.norm(turn - turn.T) / np.sqrt(8)
    a, b = camera_centres(np.stack([pose, truth]))
    return float(np.linalg.norm(a - b)), float(np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2)))


def named(poses: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """By the file's name alone."""
    return {Path(name).name: pose for name, pose in poses.items()}


def beside(truths: dict[str, np.ndarray], poses: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The truths moved as the nearest of the map's photos lies by the map."""
    both = [(pose, truths[name]) for name, pose in named(poses).items() if name in truths]
    centers = camera_centres(np.stack([truth for _, truth in both]))
    moved_truths = {}
    for name, truth in truths.items():
        pose, near = both[int(np.linalg.norm(centers - camera_centres(truth[None]), axis=1).argmin())]
        moved_truths[name] = truth @ inverse_se3(near) @ pose
    return moved_truths


def errors_of(found: list[Localised], truths: dict[str, np.ndarray]) -> list[tuple[float, ...]]:
    """Errors of the poses in length and degrees, and their standard errors."""
    return [(*difference(a.camera_from_map, truths[Path(a.name).name]), *a.standard_error) for a in found]


def figures(errors: list[tuple[float, ...]]) -> dict[str, Any]:
    """Median, 90 % and largest of the errors, and the root mean square of errors over standard errors."""
    if not errors:
        return {}
    table = np.array(errors)
    parts = {"median": np.median(table, 0), "90": np.percentile(table, 90, 0), "max": table.max(0)}
    result: dict[str, Any] = {name: {"length": row[0], "deg": row[1]} for name, row in parts.items()}
    if table.shape[1] == 4:
        over = np.sqrt(np.mean((table[:, :2] / table[:, 2:]) ** 2, axis=0))
        result["over_standard_error"] = {"length": over[0], "deg": over[1]}
    return result


def score(args: argparse.Namespace, workdir: Path) -> dict[str, Any]:
    """Localises the photos and prints a line for each."""
    if args.leave_out:
        args.truth = args.truth or args.known
        args.known, args.visit = split(args.known, args.leave_out, workdir)
    if (args.known / "map.json").is_file():
        gmap = Map.open(args.known)
    else:
        gmap = Map(views=load_scene(args.known, ReadOptions(workdir / "known")).views, info={})
    placed = map_from_input(args.known, gmap.info)
    new = new_photos([args.visit], None, workdir, QUIET)
    if args.cropped is not None:
        new = cropped(new, workdir, args.cropped)
    truth = {Path(view.name).name: moved(view, placed) for view in truth_of(args.truth or args.visit, workdir)}
    started = time.process_time()
    localiser = Localiser(gmap, locate=gone if args.gone else None)
    opened, started = time.process_time() - started, time.process_time()
    calls = [[photo] for photo in new] if args.alone else [new]
    found = [answer for call in calls for answer in localiser.answers(call)]
    seconds, truths = time.process_time() - started, {name: view.camera_from_world for name, view in truth.items()}
    for answer in found:
        what = answer.why if isinstance(answer, NotHere) else f"{answer.inliers} features, {answer.rms_px:.2f} px"
        print(f"{answer.name}: {what}")
    poses = {view.name: view.camera_from_world for view in gmap.views}
    here = [answer for answer in found if isinstance(answer, Localised)]
    compared = {}
    if args.truth is not None:
        own = [difference(pose, truths[name]) for name, pose in named(poses).items() if name in truths]
        compared = {"own_photos": figures(own), "beside": figures(errors_of(here, beside(truths, poses)))}
    return {
        "photos": len(new),
        "localised": sum(isinstance(answer, Localised) for answer in found),
        **figures(errors_of(here, truths)),
        **compared,
        "rendered": len(localiser.rendered),
        "seconds_to_open": opened,
        "seconds_a_photo": seconds / len(new),
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="score.localise", description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("known", type=Path)
    parser.add_argument("visit", type=Path, nargs="?")
    for flag in ("--gone", "--alone"):
        parser.add_argument(flag, action="store_true")
    parser.add_argument("--cropped", type=int, metavar="SEED")
    parser.add_argument("--leave-out", type=int, default=0)
    parser.add_argument("--truth", type=Path)
    args = parser.parse_args()
    if (args.visit is None) == (args.leave_out == 0):
        raise SystemExit("give VISIT, or --leave-out N")
    with TemporaryDirectory() as workdir:
        print(json.dumps(score(args, Path(workdir))))


if __name__ == "__main__":
    main()
