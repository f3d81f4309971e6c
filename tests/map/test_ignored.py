"""ignored.png: the mask of what stays in the photos lies in the map, stays there, and is checked."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.map.files import MapFiles
from perception.map.model import check_facts
from perception.map.write import read_map, verify_map, write_map
from support.viewer_maps import small_map


def test_the_mask_of_still_things_is_written_and_kept(tmp_path: Path) -> None:
    png = cv2.imencode(".png", np.eye(8, dtype=np.uint8) * 255)[1].tobytes()
    still = {"photos": 15, "share": 0.125, "mask": base64.b64encode(png).decode()}
    gmap = small_map(60)
    write_map(tmp_path / "without.gsmap", gmap)
    assert not (tmp_path / "without.gsmap" / "ignored.png").exists()
    write_map(tmp_path / "m.gsmap", replace(gmap, info={**gmap.info, "scene": {"still": still}}))
    write_map(tmp_path / "again.gsmap", read_map(tmp_path / "m.gsmap"))
    assert (tmp_path / "again.gsmap" / "ignored.png").read_bytes() == png
    assert verify_map(tmp_path / "again.gsmap")["ignored.png"] == "ok"
    facts = {**MapFiles(tmp_path / "m.gsmap").facts, "scene": {"still": {**still, "mask": "§"}}}
    with pytest.raises(ValueError, match=r"scene\.still\.mask"):
        check_facts(facts)
