"""The made building: what one photo shows, the photos of the next room show at the same place, through the opening."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from worlds import room
from worlds.building import make_building
from worlds.light import Body

pytestmark = pytest.mark.slow


def unlit(bodies: list[Body], *_: object) -> None:
    """In place of the light, which takes most of the time."""
    for body in bodies:
        for part in body.parts:
            part.lit = (255 * part.paint.clip(0, 1)).astype(np.uint8)


def test_depth_and_ids_of_two_rooms_agree_and_one_is_seen_from_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(room, "bake_all", unlit)
    make_building(tmp_path, count=2, photos=24, size=(96, 72), rays=2)
    facts = json.loads((tmp_path / "transforms.json").read_text())
    truth = json.loads((tmp_path / "scene.json").read_text())
    names = [Path(frame["file_path"]).stem for frame in facts["frames"]]
    poses = [np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1]) for frame in facts["frames"]]
    depths = [cv2.imread(str(tmp_path / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED) / 1000 for name in names]
    ids = [cv2.imread(str(tmp_path / "masks_gt" / f"{name}.png"), cv2.IMREAD_UNCHANGED) for name in names]
    K = np.array([[facts["fl_x"], 0, facts["cx"]], [0, facts["fl_y"], facts["cy"]], [0, 0, 1]])
    v, u = np.mgrid[:72, :96] + 0.5
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)

    agreeing = compared = 0
    for a, b in itertools.pairwise(range(24)):
        world = (rays * depths[a][..., None]) @ poses[a][:3, :3].T + poses[a][:3, 3]
        x, y, z = np.moveaxis((world - poses[b][:3, 3]) @ poses[b][:3, :3], -1, 0)
        column, row = ((K[0, 0] * x / z + K[0, 2]), (K[1, 1] * y / z + K[1, 2]))
        inside = (depths[a] > 0) & (z > 0.1) & (column >= 0) & (column < 96) & (row >= 0) & (row < 72)
        at = row[inside].astype(int), column[inside].astype(int)
        visible = np.abs(depths[b][at] - z[inside]) < 0.05 * z[inside]
        behind = depths[b][at] < z[inside]
        assert (visible | behind).sum() >= 0.8 * inside.sum()  # but for borders and flat angles
        agreeing += (ids[a][inside][visible] == ids[b][at][visible]).sum()
        compared += visible.sum()
    assert compared > 3000 and agreeing > 0.97 * compared

    numbers = [instance["id"] for instance in truth["instances"]]
    assert len(set(numbers)) == len(numbers) > 70
    floors = [instance["id"] for instance in truth["instances"] if instance["name"] == "floor"]
    assert len(floors) == 2
    first, second = (np.array([(seen == floor).any() for seen in ids]) for floor in floors)
    assert (first & second).any() and first[:8].all() and not second[:2].any() and second[-8:].sum() > 5
