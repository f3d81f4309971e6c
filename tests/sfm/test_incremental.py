"""Checks of models against matches; photos left out by name, also where COLMAP's next model no longer lists them."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from perception.progress import QUIET
from perception.sfm import consistency, incremental
from perception.sfm.database import FeatureStore


def test_neighbours_without_matches_are_all_pairs_near_each_other() -> None:
    """By brute force. A camera far away is near none; by its depth all others were pairs: 1.5 GiB of 6,000 photos."""
    rng = np.random.default_rng(0)
    centers, turns = rng.random((120, 3)) * [9, 9, 2], rng.normal([20, 0, 0], 2, (120, 3))
    centers[7], turns = [1e4, 0, 0], turns / np.linalg.norm(turns, axis=1, keepdims=True)
    points = rng.random((500, 3)) * [20, 20, 3]
    images = {
        i + 1: SimpleNamespace(projection_center=lambda i=i: centers[i], viewing_direction=lambda i=i: turns[i])
        for i in range(120)
    }
    seen = {i: SimpleNamespace(xyz=point) for i, point in enumerate(points)}
    model = SimpleNamespace(reg_image_ids=lambda: sorted(images), images=images, points3D=seen)
    depth = [np.median(np.linalg.norm(points - center, axis=1)) for center in centers]
    near = {
        (i + 1, j + 1)
        for i, j in combinations(range(120), 2)
        if np.linalg.norm(centers[i] - centers[j]) < 0.1 * min(depth[i], depth[j])
        and turns[i] @ turns[j] > np.cos(np.radians(15))
    }
    matched = set(sorted(near)[::3])
    assert consistency._unmatched_neighbors(model, matched) == (len(near - matched), len(near))
    assert len(near) > 50 and not any(8 in pair for pair in near)


def test_a_photo_that_no_later_model_lists_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8, num_points3D=60)
    model = pycolmap.synthesize_dataset(options)
    outvoted = sorted(model.reg_image_ids())[3]
    name = model.images[outvoted].name

    def map_again(*_: object) -> list[pycolmap.Reconstruction]:
        """The rest of the model, as COLMAP writes it: without the photo and its frame."""
        rest = pycolmap.Reconstruction()
        for camera in model.cameras.values():
            rest.add_camera_with_trivial_rig(camera)
        for i in sorted(model.reg_image_ids()):
            pose = model.images[i].cam_from_world()
            image = pycolmap.Image(name=model.images[i].name, camera_id=model.images[i].camera_id, image_id=i)
            rest.add_image_with_trivial_frame(image, pose)
        return [rest]

    votes = iter([{outvoted}, set()])
    monkeypatch.setattr(incremental, "verified_pairs", lambda *_: [])
    monkeypatch.setattr(incremental, "outvoted_photos", lambda _: next(votes))
    monkeypatch.setattr(incremental._Mapping, "_map", map_again)
    monkeypatch.setattr(incremental._Mapping, "_database_without", lambda *_: tmp_path)
    store = FeatureStore(tmp_path, tmp_path, [], {})
    mapping = incremental._Mapping(store, incremental.pipeline_options(True, 0, True), tmp_path, 8, QUIET)
    (best,), left_out = mapping._without_outvoted([model])
    assert left_out == {name} and outvoted not in best.images
