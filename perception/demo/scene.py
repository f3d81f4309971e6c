"""`make_photos`: a folder of photos of the demo's tabletop, and the truth about them in a folder beside
it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from perception.demo import tabletop
from perception.demo.light import Body
from perception.demo.orbit import FOCAL_35MM, orbit
from perception.demo.render import Camera, Picture, cast
from perception.demo.shapes import Ellipsoid, to_world
from perception.demo.truth import DemoTruth, Truth, load_truth
from perception.errors import InputError

__all__ = ["DemoTruth", "load_truth", "make_photos"]

POINTS = 60_000  # truth points before those that no two photos see are dropped
NOISE = 1.6  # sensor noise, deviation in 8-bit steps
QUALITY = 92


def make_photos(
    folder: Path | str,
    *,
    views: int = 40,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
    light_samples: int = 20,
) -> DemoTruth:
    """Writes `views` JPEG photos (000.jpg ...) into `folder` and the truth into its sibling folder `truth`.

    The truth: labels/*.png (16-bit instance ids, 0 = nothing), scene.json, transforms.json, gt_points.ply.
    light_samples: rays per texel of the light maps; fewer are faster and noisier.
    The same arguments give the same photos. Distances in metres, z up, the origin on the middle of the table
    top.
    """
    if views < 3 or width < 64 or height < 48:
        raise InputError(f"demo photos: {views} views of {width}x{height} asked; at least 3 views of 64x48 are needed")
    folder = Path(folder)
    truth_folder = folder.parent / "truth"
    folder.mkdir(parents=True, exist_ok=True)
    (truth_folder / "labels").mkdir(parents=True, exist_ok=True)
    bodies = tabletop.build(seed, light_samples)
    cameras = orbit(views, width, height)
    names = [f"{i:03d}.jpg" for i in range(views)]

    def shoot(i: int) -> Picture:
        picture = cast(bodies, cameras[i])
        _write_photo(folder / names[i], picture.rgb, np.random.default_rng((seed, i)))
        cv2.imwrite(str(truth_folder / "labels" / f"{i:03d}.png"), picture.ids)
        return picture

    with ThreadPoolExecutor(tabletop.WORKERS) as pool:  # numpy and OpenCV let go of the interpreter lock in their loops
        pictures = list(pool.map(shoot, range(views)))
    points, normals, colors, ids = _surface(bodies, np.random.default_rng((seed, views)))
    seen = _times_seen(points, normals, ids, cameras, pictures) >= 2
    name_of = {body.name: body.id for body in bodies}
    truth = DemoTruth(
        [Truth(body.id, body.name, body.prompts, body.is_stuff) for body in bodies],
        [(text, [name_of[name] for name in answers]) for text, answers in tabletop.QUERIES],
        names,
        cameras,
        points[seen],
        normals[seen],
        colors[seen],
        ids[seen],
        truth_folder,
    )
    truth.save()
    return truth


def _write_photo(path: Path, rgb: np.ndarray, rng: np.random.Generator) -> None:
    """Sensor noise, then a JPEG whose EXIF tells the focal length, as a phone's would."""
    noisy = rgb + NOISE * rng.standard_normal(rgb.shape, dtype=np.float32)
    image = Image.fromarray(np.round(np.clip(noisy, 0, 255)).astype(np.uint8))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = FOCAL_35MM  # FocalLengthIn35mmFilm
    image.save(path, quality=QUALITY, exif=exif)


def _surface(bodies: list[Body], rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Points drawn on all surfaces, half of them by area, half in equal shares for the objects on the
    table."""
    charts = [(body, part) for body in bodies for part in body.parts]
    area = np.array([np.prod(part.shape.size()) for _, part in charts])
    small = np.array([0.0 if body.is_stuff else 1.0 for body, _ in charts])
    share = area / area.sum() + small * area / (small * area).sum()
    counts = np.ceil(POINTS * share / share.sum()).astype(int)
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for (body, part), count in zip(charts, counts, strict=True):
        u, v = rng.random((2, count))
        if isinstance(part.shape, Ellipsoid):
            v = np.arccos(1 - 2 * v) / np.pi  # even over a ball
        p, n = part.shape.point_normal(u, v)
        rows, across = part.lit.shape[:2]
        color = part.lit[np.minimum(v * rows, rows - 1).astype(int), np.minimum(u * across, across - 1).astype(int)]
        for column, value in zip(
            columns,
            (to_world(part.shape, p), n @ part.shape.rotation.T, color, np.full(count, body.id)),
            strict=True,
        ):
            column.append(value)
    points, normals, colors, ids = (np.concatenate(column) for column in columns)
    return (
        points.astype(np.float32),
        normals.astype(np.float32),
        colors.astype(np.uint8),
        ids.astype(np.int32),
    )


def _times_seen(
    points: np.ndarray, normals: np.ndarray, ids: np.ndarray, cameras: list[Camera], pictures: list[Picture]
) -> np.ndarray:
    """In how many photos each point is seen: inside the frame, facing the camera, its own body the
    nearest."""
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
