"""Folders of photos: finds the photos, and selects those that are useful for structure from motion."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from perception.errors import InputError
from perception.machine import in_threads
from perception.photos.decode import SUFFIXES, decode, open_photo, photo_size, to_rgb, upright
from perception.photos.lens import resized
from perception.photos.video import FRAMES_RECORD, THUMBNAIL, motion_between
from perception.progress import Progress

VIDEO_SUFFIXES = frozenset(
    [".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mpg", ".mpeg", ".mts", ".m2ts", ".wmv"]
)
SAME_MOTION, SAME_GREY = 0.006, 6.0
"""Neighbouring photos are duplicates when their corners move by less than this share of the width and their 320 pixel
thumbnails differ by less than this mean grey level. Measured between neighbours on a walk: at least 0.011 and 11."""
COPY_BLUR = 2.0
"""Standard deviation in pixels of the thumbnail by which photos of other sizes are blurred before they are compared:
copies of photos of leaves then differ by 1 grey level."""
PANORAMA_ASPECT, PANORAMA_EXCESS = 2.2, 1.5
"""Least aspect ratio (long / short side) of a panorama: absolute, and as a multiple of the folder's median."""
SEAM, LEAST_SEAM = 2.0, 8.0
"""The left and the right column of a photo of all directions, 2:1, differ at most by SEAM times as much as neighbours
do; their least standard deviation, in grey levels, for which this says something."""
BLURRED = 0.1
"""Share of the median sharpness (variance of the thumbnail's Laplacian) below which a photo is reported as blurred."""
NO_PHOTOS = re.compile(
    r"(?<![a-z])(masks?|depths?|depth_?maps?|normals|labels?|confidence|segmentations?|semantics?)(?![a-z])",
    re.IGNORECASE,
)
"""Words in names of folders whose pictures are of photos elsewhere."""
_HIDDEN = (".", "@eaDir", "#recycle", "#snapshot", "$RECYCLE.BIN", "__MACOSX")
"""How names of files and folders begin that belong to the system."""
_SHOWN = 5


@dataclass
class PhotoSet:
    """photos: sorted by relative path; names[i] is that path, escaped. left_out: name, reason. notes: one line each."""

    photos: list[Path] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    left_out: list[dict[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class _Look:
    """Data of one photo: a grey thumbnail [h, w] uint8 of at most 320 pixels; why: the reason to leave it out."""

    path: Path
    name: str
    size: tuple[int, int] = (0, 0)
    grey: np.ndarray = field(default_factory=lambda: np.zeros((1, 1), np.uint8))
    sharpness: float = 0.0
    stitched: bool = False
    unreadable: bool = False
    why: str | None = None


def list_photos(folder: Path, suffixes: frozenset[str] = SUFFIXES) -> list[Path]:
    """All photos, or files of other suffixes, under `folder`, sorted by their path relative to it.
    Skipped: hidden files and folders, maps and work folders (*.gsmap*), frames taken from a video, and folders in which
    systems keep thumbnails and what was deleted. Linked folders are followed; each real folder is listed once."""
    folder = Path(folder)
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: {what}; expected a folder of photos")
    found, seen, waiting, links = [], set(), [folder], list[Path]()
    while waiting or links:  # links last, so that a folder is listed under its own path
        here = heappop(waiting or links)
        identity = (here.stat().st_dev, here.stat().st_ino)
        if identity in seen:
            continue
        seen.add(identity)
        try:
            inside = list(here.iterdir())
        except OSError:  # a folder without read permission
            continue
        for path in (path for path in inside if not path.name.startswith(_HIDDEN)):
            if path.is_dir():
                if ".gsmap" not in path.name and not (path / FRAMES_RECORD).is_file():
                    heappush(links if path.is_symlink() else waiting, path)
            elif path.suffix.lower() in suffixes and path.is_file():
                found.append(path.relative_to(folder))
    return [folder / path for path in sorted(found)]


def folders_below(folder: Path, depth: int) -> list[Path]:
    """`folder` and those down to `depth` below it, sorted, without hidden ones, maps and work folders."""
    found = [folder]
    if depth > 0:
        try:
            inside = sorted(entry.name for entry in os.scandir(folder) if entry.is_dir())
        except OSError:  # a folder without read permission
            inside = []
        for name in inside:
            if not name.startswith(".") and ".gsmap" not in name:
                found += folders_below(folder / name, depth - 1)
    return found


def view_name(photo: Path, folder: Path) -> str:
    """The photo's path below `folder`, as `safe_name` accepts it.

    In a name with control characters, bytes that are no UTF-8, or a backslash, these and "%" become %XX (hexadecimal).
    """
    name = photo.relative_to(folder).as_posix()
    if name.isprintable() and "\\" not in name:
        return name
    escaped = {c: "".join(f"%{byte:02X}" for byte in os.fsencode(c)) for c in name if not c.isprintable() or c in "%\\"}
    return "".join(escaped.get(c, c) for c in name)


def choose_photos(folder: Path, strict: bool, progress: Progress) -> PhotoSet:
    """The photos under `folder` to use for structure from motion; each photo is read once, in several threads.

    Left out with the reason: damaged photos, masks and the like, panoramas (not pinhole images) and duplicates. Of
    neighbours by name with nearly the same picture (bursts, JPEG and HEIC of one photo) the sharpest is kept, of equal
    pictures the first, of copies at other sizes the largest. Blurred photos are kept and reported. strict: the first
    photo that cannot be read is raised as InputError.
    """
    paths = list_photos(folder)
    named: dict[str, _Look] = {}
    for done, look in enumerate(in_threads(lambda path: _look(path, folder, strict), paths), start=1):
        while look.name in named:  # an escaped name that is already in use
            look.name += "_"
        named[look.name] = look
        progress.update("poses: photos", done, len(paths))
    looks = list(named.values())
    _leave_out_pictures_of_photos([look for look in looks if look.why is None])
    _leave_out_panoramas([look for look in looks if look.why is None])
    _leave_out_doubles([look for look in looks if look.why is None])
    kept = [look for look in looks if look.why is None]
    left_out = [{"name": look.name, "why": look.why} for look in looks if look.why is not None]
    return PhotoSet([k.path for k in kept], [k.name for k in kept], left_out, _notes(folder, looks, kept))


def _look(path: Path, folder: Path, strict: bool) -> _Look:
    look = _Look(path, view_name(path, folder))
    try:
        look.size = photo_size(path)
        with open_photo(path) as image:
            xmp = image.info.get("xmp", b"")
            look.stitched = b"GPano:" in (xmp if isinstance(xmp, bytes) else str(xmp).encode())
            image.draft("RGB", _thumbnail_size(image.size))
            decode(image, path)
            scale = max(1, max(image.size) // THUMBNAIL)
            small = image.reduce(scale) if scale > 1 and image.mode in ("L", "RGB") else image
            grey = Image.fromarray(to_rgb(upright(small, path), path)).convert("L")
            look.grey = np.array(grey.resize(_thumbnail_size(look.size), Image.Resampling.BOX))
    except InputError as error:
        if strict:
            raise
        look.unreadable, look.why = True, str(error)
        return look
    look.sharpness = float(cv2.Laplacian(look.grey, cv2.CV_64F).var())
    return look


def _thumbnail_size(size: tuple[int, int]) -> tuple[int, int]:
    scale = min(1.0, THUMBNAIL / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _leave_out_pictures_of_photos(looks: list[_Look]) -> None:
    """Marks what lies in folders of NO_PHOTOS where a photo of that name lies elsewhere: "masks/1.jpg.png"."""
    of_photos = [look for look in looks if NO_PHOTOS.search(Path(look.name).parent.as_posix())]
    marked = {look.name for look in of_photos}
    stems = {_stem(look.name) for look in looks if look.name not in marked}
    for look in of_photos:
        if _stem(look.name) in stems:
            look.why = "by its folder a mask, depth or the like of a photo, and none itself"


def _stem(name: str) -> str:
    """The name of a photo without folder and suffix, or both suffixes of "1.jpg.png", in small letters."""
    stem = Path(name.casefold()).stem
    return Path(stem).stem if Path(stem).suffix in SUFFIXES else stem


def _leave_out_panoramas(looks: list[_Look]) -> None:
    aspects = [max(look.size) / min(look.size) for look in looks]
    least = max(PANORAMA_ASPECT, PANORAMA_EXCESS * float(np.median(aspects))) if aspects else 0.0
    around = [look for look, aspect in zip(looks, aspects, strict=True) if round(100 * aspect) == 200]
    closed = {id(look) for look in around if _is_closed(look.grey)}
    for look, aspect in zip(looks, aspects, strict=True):
        if look.stitched or aspect >= least or (id(look) in closed and 2 * len(closed) > len(around)):
            look.why = f"a panorama ({look.size[0]}×{look.size[1]}): stitched photos fit no camera; use ordinary photos"


def _is_closed(grey: np.ndarray) -> bool:
    """Whether a picture goes on at its left where it ends at its right, as one of all directions."""
    columns = grey.T.astype(np.float64)
    steps = np.abs(np.diff(columns, axis=0)).mean(axis=1)
    return bool(columns[0].std() > LEAST_SEAM and np.abs(columns[0] - columns[-1]).mean() < SEAM * np.median(steps))


def _leave_out_doubles(looks: list[_Look]) -> None:
    """Marks copies at other sizes, then all but the sharpest of similar neighbours, then all but the first of equal
    pictures, as left out."""
    _leave_out_copies(looks)
    looks = [look for look in looks if look.why is None]
    runs: list[list[_Look]] = []
    for look in looks:
        if runs and _same_picture(runs[-1][0], look):
            runs[-1].append(look)
        else:
            runs.append([look])
    pictures: dict[tuple[tuple[int, int], bytes], _Look] = {}
    for run in runs:
        best = max(run, key=lambda look: look.sharpness)
        for look in run:
            if look is not best:
                look.why = f"a double: nearly the same picture as {best.name}"
        first = pictures.setdefault((best.size, best.grey.tobytes()), best)
        if first is not best:
            best.why = f"a double: the same picture as {first.name}"


def _leave_out_copies(looks: list[_Look]) -> None:
    """Marks photos that show the same as one of the same name elsewhere, of their size or larger, such as
    `images_4/1.jpg` beside `images/1.jpg`, or the undistorted one."""
    alike: dict[str, list[_Look]] = {}
    for look in sorted(looks, key=lambda look: -look.size[0] * look.size[1]):
        larger = alike.setdefault(_stem(look.name), [])
        others = (other for other in larger if other.size != look.size or other.path.parent != look.path.parent)
        copied = next((other for other in others if _is_copy(look, other)), None)
        if copied is None:
            larger.append(look)
        else:
            at = " at another size" if look.size != copied.size else ""
            look.why = f"a double: the same picture as {copied.name}{at}"


def _is_copy(small: _Look, large: _Look) -> bool:
    if not resized(small.size, large.size):
        return False
    grey = cv2.resize(large.grey, small.grey.shape[::-1], interpolation=cv2.INTER_AREA)
    # Programs that resize differ in sharpness, which blurring evens out.
    blurred = (cv2.GaussianBlur(picture, (0, 0), COPY_BLUR) for picture in (small.grey, grey))
    return _same_picture(*(replace(small, grey=picture) for picture in blurred))


def _same_picture(a: _Look, b: _Look) -> bool:
    if a.grey.shape != b.grey.shape or np.abs(a.grey.astype(np.int16) - b.grey).mean() >= SAME_GREY:
        return False
    return motion_between(a.grey, b.grey) < SAME_MOTION


def _notes(folder: Path, looks: list[_Look], kept: list[_Look]) -> list[str]:
    notes, of = [], f"of {len(looks)} photos"
    if doubles := [look.name for look in looks if (look.why or "").startswith("a double")]:
        notes.append(f"{len(doubles)} {of} are doubles (bursts, copies) and left out: {_some(doubles)}")
    if others := [look.name for look in looks if (look.why or "").startswith("by its folder")]:
        told = "are by their folders masks, depth or the like and left out (--ignore-masks takes masks)"
        notes.append(f"{len(others)} {of} {told}: {_some(others)}")
    if broken := [look for look in looks if look.unreadable]:
        names = _some([look.name for look in broken])
        notes.append(f"warning: {len(broken)} {of} cannot be read and are left out: {names} ({broken[0].why})")
    usual = float(np.median([look.sharpness for look in kept])) if kept else 0.0
    if blurred := [look.name for look in kept if look.sharpness < BLURRED * usual]:
        notes.append(f"{len(blurred)} {of} are far more blurred than the others, and used: {_some(blurred)}")
    if videos := list_photos(folder, VIDEO_SUFFIXES):
        stems = {look.path.with_suffix("") for look in looks}
        live = sum(video.with_suffix("") in stems for video in videos)
        names = _some([view_name(video, folder) for video in videos])
        unread = f"{len(videos)} videos beside the photos are not read"
        notes.append(f"{unread}, {live} of them belong to Live Photos: {names}")
    return notes


def _some(names: list[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", …" if len(names) > _SHOWN else "")
