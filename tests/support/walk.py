"""Photos along an uneven wall, as features and matches, with exact truth."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from perception.sfm import features
from perception.sfm.database import FeatureStore
from support.aimed import look_at

PHOTOS, WIDTH, HEIGHT, FOCAL, STEP = 48, 320, 240, 250.0, 0.3


def walk(folder: Path, rng: np.random.Generator) -> tuple[FeatureStore, np.ndarray]:
    """The features and matches of photos along an uneven wall, as a database, and the true poses [N, 4, 4]."""
    length = PHOTOS * STEP
    points = np.stack([rng.uniform(-3, length + 3, 5000), rng.uniform(2, 4, 5000), rng.uniform(0, 2.6, 5000)], axis=1)
    (folder / "photos").mkdir(parents=True)
    photos, seen, poses = [], [], []
    for number in range(PHOTOS):
        eye = np.array([STEP * number, 0.3 * np.sin(number), 1.4 + 0.1 * np.cos(2 * number)])
        ahead = np.array([0.6 * np.sin(0.9 * number), 1, -0.1])
        pose = look_at(eye, eye + ahead, np.array([0, 0, 1.0]))
        x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
        pixels = np.stack([FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2], axis=1)
        inside = (pixels > 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1)
        seen.append((np.flatnonzero(inside), pixels[inside] + rng.normal(0, 0.3, (inside.sum(), 2))))
        poses.append(pose)
        photos.append(folder / "photos" / f"{number:03}.png")
        Image.new("RGB", (WIDTH, HEIGHT), (number, 100, 100)).save(photos[-1])
    names = [photo.name for photo in photos]
    features.import_photos(folder / "database.db", folder / "photos", photos, names, [None] * PHOTOS)
    db = pycolmap.Database.open(folder / "database.db")
    ids = [db.read_image_with_name(name).image_id for name in names]
    for image, (_, pixels) in zip(ids, seen, strict=True):
        db.write_keypoints(image, np.concatenate([pixels, np.ones((len(pixels), 4))], axis=1).astype(np.float32))
    for i, j in combinations(range(PHOTOS), 2):
        _, a, b = np.intersect1d(seen[i][0], seen[j][0], return_indices=True)
        if len(a) >= 60:
            found = np.stack([a, b], axis=1).astype(np.uint32)
            geometry = pycolmap.TwoViewGeometry(config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
            geometry.inlier_matches = found
            db.write_two_view_geometry(ids[i], ids[j], geometry)
    db.close()
    return FeatureStore(folder, folder / "photos", names, {}), np.array(poses)
