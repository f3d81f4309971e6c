"""`perception export` of a map's own surface points: what is written, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from perception.colors import instance_palette
from perception.errors import InputError
from perception.export.export_map import ExportOptions, export_map
from perception.io.cloud import read_cloud
from perception.map.write import write_map
from support.viewer_maps import small_map


def test_all_that_was_asked_for_is_written(tmp_path: Path) -> None:
    gmap, folder, path = small_map(), tmp_path / "out", tmp_path / "m.gsmap"
    gmap.instances[2]["label"] = "blue ball"
    write_map(path, gmap)
    folder.mkdir()
    facts, table = export_map(path, folder / "out.ply", None, ExportOptions(), "instance")
    solid = gmap.opacities >= 0.5
    back = read_cloud(folder / "out.ply")
    np.testing.assert_array_equal(back.labels["instance_id"], gmap.instance_ids[solid])
    np.testing.assert_array_equal(back.colors, instance_palette(gmap.instance_ids[solid]))
    assert facts["points"] == solid.sum() and facts["labelled"] == (solid & (gmap.instance_ids >= 0)).sum()
    assert "blue ball" in table and json.loads(json.dumps(facts))["instances"]["2"]["label"] == "blue ball"
    assert {p.name for p in folder.iterdir()} == {"out.ply", "out.json"}
    with pytest.raises(InputError, match=r"expected one of \.ply"):
        export_map(path, folder / "m.rrd", None, ExportOptions())
