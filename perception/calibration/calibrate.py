"""`perception calibrate`: computes a camera file and its quality report from photos of a board, if the views suffice:
number of distinct views, tilt, coverage, and uncertainty of the focal length."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.calibration.board import Board, Detection
from perception.calibration.solve import NAMES, Solution, solve
from perception.errors import InputError
from perception.io.atomic import write_file
from perception.map.outputs import check_side_file, refuse_inputs
from perception.photos.camera_file import camera_data, write_camera
from perception.photos.decode import orientation, read_grey
from perception.photos.folder import list_photos, view_name
from perception.photos.video import frames

MAX_FRAMES = 240
"""Maximum number of video frames that are read, evenly spaced."""
MAX_VIEWS = 60
"""Maximum number of views used. More of them increase the run time without changing the result."""
MIN_VIEWS = 5
MIN_TILT_SPREAD = 20.0
"""Required angle in degrees between two board normals. Parallel views do not separate focal length and distance."""
MAX_FOCAL_SIGMA = 0.01
"""Maximum relative standard deviation of the focal length of an accepted calibration."""
MIN_COVERAGE, GOOD_COVERAGE = 0.25, 0.6
"""Share of the image area inside the convex hull of all corners: error below the first, warning below the second."""
SAME_VIEW = 0.03
"""Views count as equal if their corners move by less than this share of the image width."""


def run_calibration(source: Path, output: Path, board: Board, model: str = "auto") -> tuple[dict[str, Any], str]:
    """Calibrates a camera from a folder of photos or a video of a board: (JSON-serialisable result, table).

    Writes `output` (ROS camera_info YAML) and a .json with all figures beside it, of the same stem where `output` is a
    .yaml or .yml. Photos are rotated by their EXIF data. InputError if no board is seen, or if the views are too few or
    too similar.
    """
    report = output.with_suffix(".json") if output.suffix.lower() in (".yaml", ".yml") else Path(f"{output}.json")
    refuse_inputs([output, report], list_photos(source) if source.is_dir() else [source])
    check_side_file(report, output, "distortion_model")
    found, size, looked_at = _detect(source, board)
    views = distinct_views(found, size[0])
    if not found:
        raise InputError(
            f"{source}: no {board} was found in {looked_at} pictures; check --board, --squares (of squares, not "
            "corners) and --dictionary, and that the board is sharp and wholly lit"
        )
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"{source}: the board is seen in {len(found)} of {looked_at} pictures, {len(views)} of them different; at "
            f"least {MIN_VIEWS} different views are needed: move and tilt it (20 are good)"
        )
    views = [views[i] for i in np.linspace(0, len(views) - 1, min(len(views), MAX_VIEWS)).round().astype(int)]
    solution = best_model(views, size, model)
    result = _facts(solution, looked_at, len(found), board, check_solution(solution, source))
    fx, fy, cx, cy, *distortion = solution.values.tolist()
    K, kind = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], result["distortion_model"]
    write_camera(output, camera_data(output.stem, solution.size, kind, K, distortion))
    write_file(report, json.dumps(result, indent=1) + "\n")
    result["camera"] = str(output)
    return result, _table(result)


def best_model(views: list[Detection], size: tuple[int, int], model: str = "auto") -> Solution:
    """Solves for one model. "auto" solves both and takes the smaller error; within 5 % it takes pinhole."""
    if model != "auto":
        return solve(model, views, size)
    solved = []
    for name in ("pinhole", "fisheye"):
        with contextlib.suppress(InputError):  # this model does not fit the views
            solved.append(solve(name, views, size))
    if not solved:
        raise InputError("neither a pinhole nor a fisheye camera explains the boards found; is the board flat?")
    return solved[0] if len(solved) == 2 and solved[1].rms > 0.95 * solved[0].rms else solved[-1]


def _pictures(source: Path) -> Iterator[tuple[str, np.ndarray]]:
    """(name, grey image [H, W] uint8) of a folder's photos in order of name, or of a video's frames."""
    if source.is_dir():
        files = list_photos(source)
        if not files:
            raise InputError(f"{source}: holds no photos; expected pictures of a calibration board")
        for file in files:
            if orientation(file) != orientation(files[0]):
                what = f"{file.name} was taken with the camera turned against {files[0].name} (EXIF)"
                raise InputError(f"{source}: {what}, so its lens lies elsewhere; give photos of one orientation")
            yield view_name(file, source), read_grey(file)
    elif source.is_file():
        number = None
        for number, _, frame in frames(source, most=MAX_FRAMES):
            yield f"frame_{number:06d}", cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        if number is None:
            raise InputError(f"{source}: is not a readable video (nor a folder of photos)")
    else:
        raise InputError(f"{source}: no such file or folder; give photos of a calibration board, or a video of it")


def _detect(source: Path, board: Board) -> tuple[list[Detection], tuple[int, int], int]:
    found: list[Detection] = []
    size, looked_at = (0, 0), 0
    for looked_at, (name, picture) in enumerate(_pictures(source), start=1):
        here = (picture.shape[1], picture.shape[0])
        if looked_at > 1 and here != size:
            what = f"{name} is {here[0]}x{here[1]} pixels, the pictures before it {size[0]}x{size[1]}"
            raise InputError(f"{source}: {what}; a calibration is for one camera at one size")
        size, seen = here, board.detect(name, picture)
        if seen is not None:
            found.append(seen)
    return found, size, looked_at


def _facts(solution: Solution, looked_at: int, found: int, board: Board, notes: list[str]) -> dict[str, Any]:
    names = NAMES[solution.model]
    rows = zip(names, solution.values, solution.sigmas, solution.free, strict=True)
    return {
        "model": solution.model,
        "distortion_model": "equidistant" if solution.model == "fisheye" else "plumb_bob",
        "size": list(solution.size),
        "board": str(board),
        "parameters": {n: {"value": float(v), "sigma": float(s)} for n, v, s, free in rows if free},
        "pixel_convention": "ROS and OpenCV: the centre of the first pixel is (0, 0)",
        "reprojection_error_px": solution.rms * float(np.sqrt(2)),
        "views": {
            view.name: float(np.sqrt((r**2).sum(axis=1).mean()))
            for view, r in zip(solution.views, solution.residuals, strict=True)
        },
        "pictures_looked_at": looked_at,
        "pictures_with_board": found,
        "coverage": coverage(solution),
        "tilt_spread_degrees": tilt_spread(solution),
        "warnings": notes,
    }


def _table(result: dict[str, Any]) -> str:
    rows = (f"{name:6}{row['value']:>14.5f}{row['sigma']:>12.5f}" for name, row in result["parameters"].items())
    worst = max(result["views"], key=result["views"].get)
    return "\n".join([
        f"{result['model']} ({result['distortion_model']}), {result['size'][0]}x{result['size'][1]} pixels",
        f"{'':6}{'value':>14}{'+- sigma':>12}",
        *rows,
        f"reprojection error {result['reprojection_error_px']:.3f} px over {len(result['views'])} views "
        f"(worst {worst}: {result['views'][worst]:.3f} px); {result['pictures_with_board']} of "
        f"{result['pictures_looked_at']} pictures show the board",
        f"corners cover {result['coverage']:.0%} of the picture, "
        f"tilts differ by {result['tilt_spread_degrees']:.0f} deg",
        *(f"warning: {note}" for note in result["warnings"]),
        f"written to {result['camera']}",
    ])  # fmt: skip


def distinct_views(views: Sequence[Detection], width: int) -> list[Detection]:
    """The views without those that repeat an earlier one (static video, burst photos)."""
    kept: list[Detection] = []
    for view in views:
        if all(_motion(view, other) > SAME_VIEW * width for other in kept):
            kept.append(view)
    return kept


def _motion(a: Detection, b: Detection) -> float:
    """Median displacement in pixels of the corners that both views show; infinite if they share fewer than 4."""
    of_a, of_b = np.nonzero((a.board_points[:, None] == b.board_points).all(axis=2))
    return float(np.median(np.linalg.norm(a.pixels[of_a] - b.pixels[of_b], axis=1))) if len(of_a) >= 4 else np.inf


def coverage(solution: Solution) -> float:
    """Share of the image area within the convex hull of all corners."""
    hull = cv2.convexHull(np.concatenate([view.pixels for view in solution.views]).astype(np.float32))
    return float(cv2.contourArea(hull)) / (solution.size[0] * solution.size[1])


def tilt_spread(solution: Solution) -> float:
    """Largest angle in degrees between the board normals of two views."""
    normals = np.stack([cv2.Rodrigues(pose[:3])[0][:, 2] for pose in solution.poses])
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))


def check_solution(solution: Solution, source: Path) -> list[str]:
    """Returns warnings. Raises InputError if the views do not determine the camera."""
    spread = tilt_spread(solution)
    if spread < MIN_TILT_SPREAD:
        raise InputError(
            f"{source}: the views are too alike: the board's directions differ by {spread:.0f} degrees at most, at "
            f"least {MIN_TILT_SPREAD:.0f} are needed; tilt it by 30 to 45 degrees to all sides"
        )
    sigma = float((solution.sigmas[:2] / solution.values[:2]).max())
    if not sigma <= MAX_FOCAL_SIGMA:
        raise InputError(
            f"{source}: the views do not fix the focal length (uncertain by {100 * sigma:.1f} %, at most "
            f"{100 * MAX_FOCAL_SIGMA:.0f} % is accepted); add views with the board tilted and near the corners"
        )
    share = coverage(solution)
    if share < MIN_COVERAGE:
        found = f"the board covers {share:.0%} of the picture over all views, at least {MIN_COVERAGE:.0%} is needed"
        raise InputError(f"{source}: {found}; move it into the corners of the picture, or nearer")
    notes = []
    if share < GOOD_COVERAGE:
        notes.append(f"the board covers {share:.0%} of the picture; beyond that the distortion is a guess")
    if solution.rms > 1.0:
        notes.append(f"reprojection error is {solution.rms:.2f} px; is the board flat, and the pictures sharp?")
    return notes
