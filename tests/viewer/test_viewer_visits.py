"""The viewer's page of a map of several visits."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("viser")
from support.viewer_maps import free_port
from support.visited_map import NAMES, STATES, number, write_visited_map


@pytest.mark.slow
def test_boxes_tell_the_state_of_what_changed_and_show_what_is_gone(tmp_path: Path) -> None:
    from perception.viewer import Viewer

    viewer = Viewer(write_visited_map(tmp_path / "a.gsmap"), port=free_port())
    try:
        shown = {}
        for viewer.session.mode in ("photo", "changes"):
            viewer.show_boxes(True)
            handles = [handle for handle in viewer._overlays if "/map/names/" in handle.name]
            shown[viewer.session.mode] = {handle.text for handle in handles}
        ghosts = [handle for handle in viewer._overlays if handle.name == "/map/ghosts"]
        assert len(ghosts) == 1 and len(ghosts[0].points) == len(viewer.session.ghosts()) > 0
    finally:
        viewer.stop()
    there = {f"instance {number(name)}" for name in NAMES if STATES[name] != "removed"}
    assert shown["photo"] == there
    told = {name: "" if STATES[name] == "unchanged" else f", {STATES[name]}" for name in NAMES}
    assert shown["changes"] == {f"instance {number(name)}{told[name]}" for name in NAMES}
