"""Folders of RGB-D data sets, recognised by content: TUM RGB-D, ScanNet, 7-Scenes, 3DMatch, BundleFusion and 3RScan,
Redwood / Open3D.

All write pixel centres at whole numbers, so 0.5 is added to their principal points.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.geometry import interpolated_pose
from perception.inputs.recordings import Frame, Recording
from perception.io.documents import read_json, refusing, text_of
from perception.photos.decode import open_photo, photo_size
from perception.photos.folder import list_photos
from perception.photos.lens import opencv_lens
from perception.photos.named_files import NamedFiles
from perception.types import Lens

TUM_APART, TUM_GAP = 0.02, 0.1
"""Greatest time in seconds between a photo and its depth image, and between two poses that are interpolated."""
_TUM_LENSES = {  # fx fy cx cy k1 k2 p1 p2 k3, from the data set's page on calibration
    "freiburg1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
_PRIMESENSE = (525.0, 525.0, 319.5, 239.5)  # the intrinsics that Redwood and Open3D assume for 640 × 480 pixels
_KINECT_DEPTH, _KINECT_COLOR = (585.0, 585.0, 320.0, 240.0), (525.0, 525.0, 320.0, 240.0)
_SIZE = (640, 480)
_COMMA = re.compile(r"[+-]?\d+,\d+(e[+-]?\d+)?", re.IGNORECASE)
_TEXTS = (
    *("rgb.txt", "depth.txt", "groundtruth.txt", "pose/*.txt", "intrinsic/*.txt", "intrinsics_*.txt"),
    *("frame-*.pose.txt", "seq*/frame-*.pose.txt", "camera-intrinsics.txt", "*info.txt"),
    *("*.log", "*intrinsic*.json", "camera*.json"),
)
_COLOR_FOLDERS = ("color", "image", "rgb")
_SENSOR = ("_info.txt", "info.txt")
"""Names of the files in which ScanNet's SensReader and its kin describe the cameras."""


def open_recording(source: Path) -> Recording:
    """The recording in folder `source`. InputError for one that is damaged, or without a layout."""
    read = layout_of(source)
    if read is None:
        raise InputError(f"{source}: no RGB-D recording; expected the files of TUM, ScanNet, 7-Scenes or Redwood")
    return read(source)


def layout_of(source: Path) -> Callable[[Path], Recording] | None:
    """The reader of the layout that the folder has, recognised by its names; None where it has none."""
    if (source / "rgb.txt").is_file() and (source / "depth.txt").is_file():
        return _tum
    if (source / "color").is_dir() and (source / "pose").is_dir():
        return _scannet
    if any(source.glob("frame-*.color.*")) or any(source.glob("seq*/frame-*.color.*")):
        return _seven_scenes
    if _color_folder(source) and (source / "depth").is_dir() and any(source.glob("*.log")):
        return _redwood
    return None


def text_files(source: Path) -> list[Path]:
    """The files with poses, cameras and lists of photos in folder `source`, or cameras above it."""
    found = [file for pattern in _TEXTS for file in source.glob(pattern)]
    above = (source.parent / name for name in ("camera-intrinsics.txt", *_SENSOR))
    return [file for file in [*found, *above] if file.is_file()]


def _color_folder(source: Path) -> Path | None:
    return next((source / name for name in _COLOR_FOLDERS if (source / name).is_dir()), None)


def refuse_depth_without_poses(source: Path) -> None:
    """InputError for a folder of photos that holds 16-bit images named depth, which would be taken for photos."""
    names = (path.relative_to(source).as_posix() for path in list_photos(source))
    first = next((name for name in names if "depth" in name.lower() and _has_16_bits(source / name)), None)
    if first is not None:
        raise InputError(
            f"{source}: has depth images ({first}) but no poses that are read; expected transforms.json with "
            "depth_file_path (which nerfstudio's ns-process-data writes for Polycam and Record3D), groundtruth.txt "
            "(TUM), pose/*.txt (ScanNet) or a trajectory *.log (Redwood); to map the photos alone, give a folder "
            "without depth"
        )


def _has_16_bits(path: Path) -> bool:
    """Whether an image is of one channel of 16 bits; not one that cannot be read."""
    with contextlib.suppress(InputError), open_photo(path) as image:
        return image.mode.startswith("I")
    return False


def _tum(source: Path) -> Recording:
    """Lists of "time file" for photos and depth, "time tx ty tz qx qy qz qw" for poses; 5000 units of depth a metre."""
    truth = source / "groundtruth.txt"
    if not truth.is_file():
        raise InputError(f"{truth}: missing, so depth has no poses; expected lines 'time tx ty tz qx qy qz qw'")
    (at, photos), (depth_at, depths) = (_listed(source / name) for name in ("rgb.txt", "depth.txt"))
    rows = _numbers(truth, 8)
    lost = ~np.isfinite(rows[:, :8]).all(axis=1) | (np.linalg.norm(rows[:, 4:8], axis=1) < 1e-6)  # of tracking
    rows = rows[~lost]
    if len(rows) == 0:
        found = "holds no pose of finite numbers whose quaternion is not zero"
        raise InputError(f"{truth}: {found}; expected lines 'time tx ty tz qx qy qz qw'")
    times, shifts, quaternions = np.split(rows[np.argsort(rows[:, 0], kind="stable"), :8], [1, 4], axis=1)
    times, poses = times[:, 0], np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_quat(quaternions).as_matrix(), shifts
    after = np.searchsorted(depth_at, at).clip(min(1, len(depth_at) - 1), len(depth_at) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(at - depth_at[before] <= depth_at[after] - at, before, after)
    apart = np.abs(depth_at[nearest] - at)
    if apart.min() > TUM_APART:
        found = f"photos and depth are at least {apart.min():.3g} s apart, at most {TUM_APART} are allowed"
        raise InputError(f"{source}: {found}; do rgb.txt and depth.txt use one clock?")
    if not any(photos):
        raise InputError(f"{source / 'rgb.txt'}: none of the {len(photos)} photos that it lists is there")
    frames = []
    for time, photo, depth, near in zip(at, photos, nearest, apart <= TUM_APART, strict=True):
        pose = interpolated_pose(times, poses, time, TUM_GAP)
        if pose is not None and photo is not None:
            name = Path(os.path.relpath(photo, source)).as_posix()  # lists may hold absolute paths
            frames.append(Frame(name, photo, depths[depth] if near else None, pose))
    if not frames:
        raise InputError(
            f"{source}: no photo lies between two poses; photos are from {at.min():.3f} to {at.max():.3f} s, poses "
            f"from {times.min():.3f} to {times.max():.3f} s"
        )
    lens = next((_lens(k, _SIZE) for name, k in _TUM_LENSES.items() if name in source.resolve().name), None)
    notes = _missing(len(photos) - len(frames), len(photos), "a pose")
    notes += _missing(sum(frame.depth is None for frame in frames), len(frames), f"depth within {TUM_APART} s")
    return Recording(source, "TUM RGB-D", frames, lens, 5000.0, None, notes)


def _listed(file: Path) -> tuple[np.ndarray, list[Path | None]]:
    """Times [N] in ascending order, and the files, None where they are missing."""
    files = NamedFiles(file.parent)
    with refusing(f"{file}: expected lines 'time file' ({{why}})"):
        rows = sorted(((float(row[0]), row[1:]) for row in _rows(file)), key=lambda row: row[0])
        found = [files.find(name[0]) or files.find(" ".join(name)) for _, name in rows]
    return np.array([time for time, _ in rows]), found


def _scannet(source: Path) -> Recording:
    """Exported frames: color/, depth/ in mm, pose/ world_from_camera, infinite where tracking was lost."""
    photos = _images(source / "color")
    frames = _posed(source, photos, lambda photo, kind: source / kind / photo.stem)
    depths = [frame.depth for frame in frames if frame.depth is not None]
    files = {kind: source / f"intrinsic/intrinsic_{kind}.txt" for kind in ("color", "depth")}
    if not files["color"].is_file():  # ScanNet's own choice of 25,000 frames
        files = {kind: source / f"intrinsics_{kind}.txt" for kind in files}
    own = _matrix_lens(files["depth"], _first_size(depths)) if depths else None
    notes = _missing(len(photos) - len(frames), len(photos), "a pose (tracking was lost)")
    lens = _tried(_matrix_lens, files["color"], _first_size(photos))
    return Recording(source, "ScanNet", frames, lens, 1000.0, own, notes)


def _seven_scenes(source: Path) -> Recording:
    """frame-*.color.png, .depth.png in mm and .pose.txt, in the folder or in seq-*; 3DMatch adds the intrinsics, and
    BundleFusion, 3RScan and 12 Scenes what `_sensor` reads."""
    photos = sorted(source.glob("frame-*.color.*")) or sorted(source.glob("seq*/frame-*.color.*"))
    frames = _posed(source, photos, lambda photo, kind: photo.with_name(f"{photo.name.partition('.')[0]}.{kind}"))
    notes = _missing(len(photos) - len(frames), len(photos), "a pose")
    for file in (folder / name for folder in (source, source.parent) for name in _SENSOR):
        if file.is_file() and b"m_calibrationColor" in file.read_bytes():  # not somebody's notes
            color, own, metre = _sensor(file)
            return Recording(source, "BundleFusion / 3RScan", frames, color, metre, own, notes)
    for folder in (source, source.parent):
        lens = _tried(_matrix_lens, folder / "camera-intrinsics.txt", _first_size(photos))
        if lens is not None:
            folders = {photo.parent for photo in photos}
            if len(folders) > 1:
                raise InputError(f"{source}: {len(folders)} sequences, each with a world of its own; give one of them")
            return Recording(source, "3DMatch", frames, lens, 1000.0, None, notes)
    warning = (
        f"{source}: 7-Scenes does not register depth to the photos; the nominal lenses are used (focal length "
        f"{_KINECT_COLOR[0]:g} and {_KINECT_DEPTH[0]:g} pixels), and the 2 to 3 cm between the cameras are neglected"
    )
    color, depth_lens = _lens(_KINECT_COLOR, _SIZE), _lens(_KINECT_DEPTH, _SIZE)
    return Recording(source, "7-Scenes", frames, color, 1000.0, depth_lens, notes, [warning])


def _sensor(file: Path) -> tuple[Lens, Lens, float]:
    """The lenses of photos and depth, and units of depth per metre, of lines "m_name = numbers"."""
    with refusing(
        f"{file}: expected lines 'm_calibrationColorIntrinsic = fx 0 cx 0 0 fy cy …' and their like ({{why}})"
    ):
        values = {row[0]: row[2:] for row in _rows(file) if row[1:2] == ["="]}
        lenses = []
        for kind in ("Color", "Depth"):
            fx, _, cx, _, _, fy, cy = map(float, values[f"m_calibration{kind}Intrinsic"][:7])
            width, height = (int(values[f"m_{kind.lower()}{side}"][0]) for side in ("Width", "Height"))
            lenses.append(_lens((fx, fy, cx, cy), (width, height)))
        return lenses[0], lenses[1], float(values["m_depthShift"][0])


def _posed(source: Path, photos: list[Path], beside: Callable[[Path, str], Path]) -> list[Frame]:
    """The photos with a pose, a file of world_from_camera that is neither infinite nor all zero (tracking was lost).
    beside: the photo's file of kind "depth" (.png or .pgm) or "pose" (.txt), without suffix."""
    frames, files = [], NamedFiles(source)
    for photo in photos:
        stems = (str(beside(photo, kind).relative_to(source)) for kind in ("depth", "pose"))
        depth, pose = (files.find(s, ends) for s, ends in zip(stems, ((".png", ".pgm"), (".txt",)), strict=True))
        matrix = _numbers(pose, 4) if pose is not None else np.zeros((4, 4))
        if matrix.shape != (4, 4):
            raise InputError(f"{pose}: {len(matrix)} rows, expected a 4×4 matrix world_from_camera")
        if np.isfinite(matrix).all() and matrix[:3, :3].any():
            name = photo.relative_to(source).as_posix()
            frames.append(Frame(name, photo, depth, matrix))
    return frames


def _redwood(source: Path) -> Recording:
    """color/ (or image/, rgb/) and depth/ in mm in equal order, and a .log of world_from_camera matrices."""
    folder = _color_folder(source) or source
    photos, depths = _images(folder), _images(source / "depth")
    if len(photos) != len(depths):
        raise InputError(f"{source}: {len(photos)} photos in {folder.name}/, {len(depths)} images in depth/; pair them")
    logs = _visible(source, "*.log")
    named = [log for log in logs if log.name == "trajectory.log"] or logs
    if len(named) > 1:
        raise InputError(f"{source}: several trajectories ({', '.join(log.name for log in logs)}); keep one of them")
    poses = _trajectory(named[0], len(photos))
    frames = [Frame(f"{folder.name}/{photos[i].name}", photos[i], depths[i], pose) for i, pose in poses.items()]
    lens: Lens | InputError | None = None
    notes = _missing(len(photos) - len(poses), len(photos), "a pose")
    if cameras := _visible(source, "*intrinsic*.json") + _visible(source, "camera*.json"):
        lens = _tried(_open3d_lens, cameras[0])
    elif _first_size(photos) == _SIZE:
        lens = _lens(_PRIMESENSE, _SIZE)
        notes.append(f"{source}: no intrinsics, those of PrimeSense are used ({_PRIMESENSE[0]:g} pixels)")
    return Recording(source, "Redwood / Open3D", frames, lens, 1000.0, None, notes)


def _trajectory(file: Path, photos: int) -> dict[int, np.ndarray]:
    """Blocks of a line of three whole numbers, the first the number of the photo from 0, and four rows of a matrix."""
    rows = _rows(file)
    with refusing(f"{file}: expected blocks of a line 'i i i+1' and four rows of four numbers"):
        numbers = [int(row[0]) for row in rows[::5]]
        matrices = np.array([row for index, row in enumerate(rows) if index % 5], np.float64).reshape(-1, 4, 4)
        numbers = list(range(photos)) if len(numbers) == photos else numbers
        poses = dict(zip(numbers, matrices, strict=True))
    if min(numbers) < 0 or max(numbers) >= photos:
        raise InputError(f"{file}: holds a pose of photo {max(numbers)} (counted from 0), there are {photos} photos")
    return poses


def _images(folder: Path) -> list[Path]:
    """PNG and JPEG files in order of their numbers, which need not be padded with zeros."""
    found = [path for path in _visible(folder, "*") if path.suffix.lower() in (".png", ".jpg", ".jpeg")]
    if not found:
        raise InputError(f"{folder}: holds no PNG or JPEG images")
    return sorted(found, key=lambda path: (len(path.stem), path.name))


def _visible(folder: Path, pattern: str) -> list[Path]:
    """What matches, sorted, without hidden files: macOS leaves "._0.txt" beside "0.txt" on other file systems."""
    return sorted(path for path in folder.glob(pattern) if not path.name.startswith("."))


def _numbers(file: Path, columns: int) -> np.ndarray:
    """[N, at least `columns`] float64."""
    rows = _rows(file)
    with refusing(f"{file}: expected lines of {columns} numbers ({{why}})"):
        table = np.array([["nan" if "1.#" in field else field for field in row] for row in rows], np.float64)
        if table.shape[1] < columns:
            raise ValueError(f"found {table.shape[1]}")
    return table


def _rows(file: Path) -> list[list[str]]:
    """The fields of each line that is not empty and no comment, parted by blanks or commas. InputError where there is
    none, and for decimal commas."""
    with refusing(f"{file}: cannot be read as text"):
        lines = text_of(file.read_bytes()).splitlines()
    lines = [line for line in lines if not line.lstrip().startswith("#")]
    if commas := [field for line in lines for field in line.split() if _COMMA.fullmatch(field) and field != line]:
        raise InputError(f"{file}: {commas[0]} has a decimal comma; write it with decimal points")
    rows = [row for line in lines if (row := line.replace(",", " ").split())]
    if not rows:
        raise InputError(f"{file}: is empty")
    return rows


def _first_size(images: list[Path]) -> tuple[int, int]:
    """Of the first image that can be read. InputError where none can."""
    for image in images:
        with contextlib.suppress(InputError):
            return photo_size(image)
    return photo_size(images[0])


def _tried(read: Callable[..., Lens | None], *of: object) -> Lens | InputError | None:
    """The lens that `read` returns, or its error: `--camera` takes the place of intrinsics that are wrong."""
    try:
        return read(*of)
    except InputError as error:
        return error


def _matrix_lens(file: Path, size: tuple[int, int]) -> Lens | None:
    if not file.is_file():
        return None
    K = _numbers(file, 3)
    if len(K) < 3:
        raise InputError(f"{file}: {len(K)} rows, expected a matrix of intrinsics, 3×3 or 4×4")
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if not (min(fx, fy) > 0 and abs(cx / size[0] - 0.5) < 0.25 and abs(cy / size[1] - 0.5) < 0.25):
        found = f"focal length {fx:g} and centre ({cx:g}, {cy:g}) are not those of images of {size[0]}×{size[1]}"
        raise InputError(f"{file}: {found}; were they resized? give --camera FILE, or the original images")
    return _lens((fx, fy, cx, cy), size)


def _open3d_lens(file: Path) -> Lens:
    with refusing(f"{file}: expected Open3D's camera intrinsics: width, height, intrinsic_matrix"):
        data = read_json(file)
        K = np.array(data["intrinsic_matrix"], np.float64).reshape(3, 3).T  # stored by columns
        return _lens((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), (int(data["width"]), int(data["height"])))


def _lens(values: tuple[float, ...], size: tuple[int, int]) -> Lens:
    fx, fy, cx, cy, *k = (float(value) for value in values)
    return opencv_lens((fx, fy, cx + 0.5, cy + 0.5), k, *size)


def _missing(count: int, total: int, what: str) -> list[str]:
    return [f"{count} of {total} photos have not {what}"] if count else []
