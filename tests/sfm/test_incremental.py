"""Photos that contradict a model are left out of it by name, also where COLMAP's next model no longer lists them."""

from __future__ import annotations

from pathlib import Path

import pycolmap
import pytest

from perception.progress import QUIET
from perception.sfm import incremental
from perception.sfm.database import FeatureStore


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
