"""`bench mask-speed`: photos are repeated under names of their own, and every source is measured."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from perception.bench import mask_speed
from perception.errors import InputError


@pytest.fixture
def scene(tmp_path):
    folder = tmp_path / "scene"
    for name in ("images", "labels", "depth"):
        (folder / name).mkdir(parents=True)
    frames = []
    for i in range(2):
        photo = np.zeros((24, 32, 3), np.uint8)
        photo[:, 16 + i :] = 255
        labels = np.where(photo[..., 0] > 0, 7, 3).astype(np.uint8)
        Image.fromarray(photo).save(folder / "images" / f"{i}.png")
        Image.fromarray(labels).save(folder / "labels" / f"{i}.png")
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": np.eye(4).tolist()})
    about = {"fl_x": 30, "fl_y": 30, "cx": 16, "cy": 12, "w": 32, "h": 24, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about))
    return folder


def test_every_source_and_count_is_a_row(scene, tmp_path):
    out = tmp_path / "out"
    assert mask_speed.main([str(scene), "labels", "--counts", "3", "1", "-o", str(out)]) == 0
    rows = json.loads((out / "mask-speed.json").read_text())["rows"]
    assert [(row["source"], row["photos"], row["masks"]) for row in rows] == [("labels", 1, 2.0), ("labels", 3, 2.0)]
    assert all(min(row["loaded_mib"], row["peak_mib"], row["photos_per_second"]) > 0 for row in rows)


def test_photos_are_repeated_in_turns(scene, tmp_path):
    views = mask_speed.repeated_views(scene, 5, tmp_path)
    assert [view.photo.resolve().name for view in views] == ["0.png", "1.png", "0.png", "1.png", "0.png"]
    assert len({view.name for view in views}) == 5


def test_bad_input_is_one_line(scene, tmp_path):
    with pytest.raises(InputError, match="at least one photo"):
        mask_speed.main([str(scene), "--counts", "0"])
    with pytest.raises(InputError, match="expected the folder of a scene"):
        mask_speed.main([str(tmp_path)])
    with pytest.raises(InputError, match="expected auto, builtin"):
        mask_speed.main([str(scene), "nonsense", "-o", str(tmp_path / "out")])
