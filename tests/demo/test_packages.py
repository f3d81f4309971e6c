"""The scene of printed words: the truth that its builder writes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from worlds.packages import ABSENT, make_packages


@pytest.mark.slow
def test_twenty_prompts_with_exact_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worlds.packages.room_around", lambda *_: [])  # painting it takes longest
    make_packages(tmp_path, seed=1, views=3, width=64, height=48, rays=1)
    scene = json.loads((tmp_path / "scene.json").read_text(encoding="utf-8"))
    names = {entry["id"]: entry["name"] for entry in scene["instances"]}
    asked = {
        q["text"]: {names[i] for i in q["instance_ids"]} for q in scene["queries"] if re.search("[A-Z]", q["text"])
    }
    assert len(asked) == 20 and scene["absent"] == ABSENT
    assert asked["something labelled RICE"] == {"rice box", "rice tin"} and asked["the tin that says RICE"] == {
        "rice tin"
    }
    assert asked["the box that says SALT"] == {"salt box"}  # not the book of BREAD AND SALT
    frames = json.loads((tmp_path / "transforms.json").read_text(encoding="utf-8"))["frames"]
    assert all((tmp_path / frame["depth_file_path"]).is_file() for frame in frames)
