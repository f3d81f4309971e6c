"""`make_photos`: writes a folder of photos of a synthetic scene and its ground truth."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
from PIL import Image

from perception.errors import InputError
from worlds import room, tabletop, trifles
from worlds.cameras import Camera
from worlds.light import WORKERS, Scene
from worlds.render import Picture, cast
from worlds.segmenter import erring_labels, perfect_labels
from worlds.shapes import Box, Ellipsoid, Shape, to_world
from worlds.truth import DemoTruth, Truth

SCENES = {"tabletop": tabletop, "room": room, "trifles": trifles}
LEAST_POINTS = 1200  # minimum per object, before points that fewer than two photos see are dropped
NOISE = 1.6  # standard deviation of the sensor noise in 8-bit steps
QUALITY = 92


def make_photos(
    folder: Path | str,
    *,
    scene: str = "tabletop",
    views: int | None = None,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
    light_samples: int = 20,
    truth_folder: Path | None = None,
) -> DemoTruth:
    """Writes JPEG photos (000.jpg ...) of one of SCENES into `folder`, and the ground truth into `truth_folder`
    (default: the folder `truth` beside it).

    Ground truth: transforms.json (exact poses); labels/*.png (label images without errors); labels_sam/*.png (with the
    errors of a segmenter); masks_gt/*.png (16-bit instance ids, 0 = none); depth/*.png (16-bit millimetres along the
    optical axis, 0 = none); scene.json (instances, prompts); gt_points.ply (instance_id, semantic_id).
    light_samples: rays per texel of the light maps; fewer are faster and noisier. Equal arguments give equal photos.
    Units are metres, z is up. Raises InputError for fewer than 3 views or views under 64 × 48.
    """
    if scene not in SCENES:
        raise InputError(f"demo photos: found scene '{scene}', expected one of: {', '.join(SCENES)}")
    maker = SCENES[scene]
    views = maker.VIEWS if views is None else views
    if views < 3 or width < 64 or height < 48:
        raise InputError(f"demo photos: {views} views of {width}x{height} asked; at least 3 views of 64x48 are needed")
    folder = Path(folder)
    home = truth_folder or folder.parent / "truth"
    made: Scene = maker.build(seed, light_samples)
    return photograph(made, maker, made.cameras(views, width, height), folder, home, seed)[0]


def photograph(
    made: Scene, maker: ModuleType, cameras: list[Camera], folder: Path, home: Path, seed: int
) -> tuple[DemoTruth, list[Picture]]:
    """Writes the photos of a built scene into `folder` and the truth into `home`, as `make_photos`; the truth, and the
    pictures without noise. maker: the module that built it."""
    views = len(cameras)
    for path in (folder, *(home / name for name in ("labels", "labels_sam", "masks_gt", "depth"))):
        path.mkdir(parents=True, exist_ok=True)
    digits = max(3, len(str(views - 1)))
    names = [f"{i:0{digits}d}.jpg" for i in range(views)]
    stuff = {number for number, body in enumerate(made.bodies, start=1) if body.is_stuff}

    def shoot(i: int) -> Picture:
        picture = cast(made.bodies, made.lighting.lamps[0], cameras[i])
        _write_photo(folder / names[i], picture.rgb, maker.FOCAL_35MM, np.random.default_rng((seed, i)))
        rng = np.random.default_rng((seed, i, 1))
        images = {
            "masks_gt": picture.ids,
            "depth": np.round(1000 * np.where(picture.depth < 65, picture.depth, 0)).astype(np.uint16),
            "labels": perfect_labels(picture.ids, rng),
            "labels_sam": erring_labels(picture.ids, picture.parts, stuff, rng),
        }
        for name, image in images.items():
            cv2.imwrite(str(home / name / f"{i:0{digits}d}.png"), image)
        return picture

    with ThreadPoolExecutor(WORKERS) as pool:  # numpy and OpenCV release the GIL in their loops
        pictures = list(pool.map(shoot, range(views)))
    cloud = _surface(made, maker.POINTS, np.random.default_rng((seed, views)))
    seen = times_seen(cloud[0], cloud[1], cloud[3], cameras, pictures) >= 2
    points, normals, colors, ids = (column[seen] for column in cloud)
    instances = _instances(made, ids, pictures)
    photos = Path(os.path.relpath(folder, home)).as_posix()
    truth = DemoTruth(instances, made.asked, names, cameras, points, normals, colors, ids, home, photos)
    truth.save()
    return truth, pictures


def _instances(made: Scene, ids: np.ndarray, pictures: list[Picture]) -> list[Truth]:
    """One entry per body. Category ids follow the alphabetical order of the category names."""
    categories = sorted({body.category for body in made.bodies})
    points = np.bincount(ids, minlength=len(made.bodies) + 1)
    views = np.zeros(len(made.bodies) + 1, int)
    for picture in pictures:
        views[np.unique(picture.ids)] += 1
    found, ids_of = [], {body.name: number for number, body in enumerate(made.bodies, start=1)}
    for number, body in enumerate(made.bodies, start=1):
        category, seen = body.category, (int(points[number]), int(views[number]))
        semantic, held = 1 + categories.index(category), (ids_of.get(body.on or ""), ids_of.get(body.hangs_on or ""))
        found.append(Truth(number, body.name, category, semantic, body.prompts, body.is_stuff, *seen, *held))
    return found


def _write_photo(path: Path, rgb: np.ndarray, focal_35mm: int, rng: np.random.Generator) -> None:
    """Adds sensor noise and writes a JPEG. Its EXIF data holds the focal length, as in a phone's photo."""
    noisy = rgb + NOISE * rng.standard_normal(rgb.shape, dtype=np.float32)
    image = Image.fromarray(np.round(np.clip(noisy, 0, 255)).astype(np.uint8))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = focal_35mm  # FocalLengthIn35mmFilm
    image.save(path, quality=QUALITY, exif=exif)


def _surface(made: Scene, total: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Points, normals, colours, ids on all surfaces: half by area, half on objects with at least LEAST_POINTS each."""
    charts = [(number, body, part) for number, body in enumerate(made.bodies, start=1) for part in body.parts]
    owners = np.array([number for number, _, _ in charts])
    area = np.array([np.prod(part.shape.size()) for _, _, part in charts])
    small = np.array([0.0 if body.is_stuff else 1.0 for _, body, _ in charts])
    share = area / area.sum() + small * area / (small * area).sum()
    wanted = total * share / share.sum()
    wanted *= np.maximum(1, small * LEAST_POINTS / np.bincount(owners, wanted)[owners])
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for (number, _, part), count in zip(charts, np.ceil(wanted).astype(int), strict=True):
        u, v = _even(part.shape, *rng.random((2, count)))
        p, n = part.shape.point_normal(u, v)
        rows, across = part.lit.shape[:2]
        color = part.lit[np.minimum(v * rows, rows - 1).astype(int), np.minimum(u * across, across - 1).astype(int)]
        values = (to_world(part.shape, p), n @ part.shape.rotation.T, color, np.full(count, number))
        for column, value in zip(columns, values, strict=True):
            column.append(value)
    points, normals, colors, ids = (np.concatenate(column) for column in columns)
    return points.astype(np.float32), normals.astype(np.float32), colors.astype(np.uint8), ids.astype(np.int32)


def _even(shape: Shape, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chart coordinates uniform over the surface area, from uniform u, v in [0, 1]."""
    if isinstance(shape, Ellipsoid):
        return u, np.arccos(1 - 2 * v) / np.pi  # exact for a sphere
    if isinstance(shape, Box):
        edges = np.concatenate([[0], np.cumsum(shape.face_sizes().prod(1))])
        return u, np.interp(v, edges / edges[-1], np.arange(7) / 6)
    return u, v


def times_seen(
    points: np.ndarray, normals: np.ndarray, ids: np.ndarray, cameras: list[Camera], pictures: list[Picture]
) -> np.ndarray:
    """Number of photos that see each point: inside the frame, facing the camera, and not occluded."""
    seen = np.zeros(len(points), int)
    for camera, picture in zip(cameras, pictures, strict=True):
        pixels, depth = camera.project(points)
        inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        k = np.flatnonzero(inside)
        x, y = pixels[k].astype(int).T
        facing = np.einsum("nk,nk->n", camera.center - points[k], normals[k]) > 0
        nearest = np.abs(picture.depth[y, x] - depth[k]) < 0.006 + 0.01 * depth[k]
        seen[k] += facing & nearest & (picture.ids[y, x] == ids[k])
    return seen
