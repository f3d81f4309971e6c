"""A map of the released format version: opened, asked for names that a person gave, embedded by another encoder."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import perception
from perception.cli import main
from perception.edit import upgrade
from perception.edit.upgrade import upgrade_map
from perception.errors import InputError
from perception.language.ocr import Line
from perception.map.files import read_info
from perception.map.write import FORMAT_VERSION, read_map, verify_map, write_map
from support.color_encoder import THINGS, ColorEncoder, encoders
from support.paths import MAPS
from support.synthetic_map import write_synthetic_map

RELEASED = MAPS / f"v{FORMAT_VERSION}.gsmap"


@pytest.fixture
def old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The map as another encoder described it, with its photos beside it."""
    shutil.copytree(MAPS, tmp_path / "maps")
    monkeypatch.chdir(tmp_path / "maps")
    path = tmp_path / "maps" / RELEASED.name
    gmap = read_map(path)
    by, rows = {"encoder": np.array("encoder of that time")}, np.eye(8, dtype=np.float32)
    gmap.language |= by | {"embeddings": rows[:3], "view_embeddings": rows[:6]}
    gmap.parts |= {f"language_{name}": array for name, array in by.items()}
    write_map(path, gmap)
    return path


def test_the_released_version_opens() -> None:
    """The oracle is how the map was made: three cubes of 60 random means about (-0.6, 0, 3), (0, 0, 3), (0.6, 0, 3), of
    which every 20th belongs to none, and three cameras at x = 0.1, 0 and -0.1 that look along z."""
    path = RELEASED
    gmap = read_map(path)
    assert (len(gmap), gmap.frame, gmap.metric, gmap.sh.shape, gmap.features.shape) == (
        180, "kitchen", True, (180, 4, 3), (180, 4),
    )  # fmt: skip
    assert [entry["label"] for entry in gmap.instances] == [None, "grandma's cup", None]
    assert np.bincount(gmap.instance_ids + 1).tolist() == [9, 57, 57, 57]
    assert [view.name for view in gmap.views] == ["0.png", "1.png", "2.png"]
    assert [view.held_out for view in gmap.views] == [True, False, False]
    assert gmap.poses[:, 0, 3] == pytest.approx([-0.1, 0, 0.1]) and gmap.views[2].lens.model == "OPENCV"
    assert set(verify_map(path).values()) == {"ok"} and len(gmap.parts["ids"]) == 180
    opened = perception.load_map(path)
    assert [len(opened.get(i).points) for i in range(3)] == [57] * 3
    assert opened.get(0).centroid == pytest.approx([-0.6, 0, 3], abs=0.05)


def test_a_map_of_another_version_is_refused_in_one_line(old: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = json.loads((old / "map.json").read_text())
    for version, advice in ((1, "made by an older perception; build the map again"), (3, "made by a newer perception")):
        (old / "map.json").write_text(json.dumps({**facts, "format_version": version}))
        for command in ("info", "upgrade"):
            assert main([command, str(old)]) == 2
            told = capsys.readouterr().err.strip()
            assert advice in told and f"is {version}, this program reads 2" in told and "\n" not in told


def test_a_name_that_a_person_gave_needs_no_encoder() -> None:
    def none_such(spec: str) -> None:
        raise InputError("no such encoder")

    for maker in (encoders, none_such):
        opened = perception.load_map(RELEASED, encoders=maker)
        hits = opened.query(" Grandma's  CUP ", top_k=1)
        assert [(hit.instance_id, hit.score) for hit in hits] == [(1, 1.0)]
    with pytest.raises(InputError, match="no such encoder"):
        opened.query("cup")


def test_upgrade_embeds_from_the_photos_and_keeps_all_else(old: Path, tmp_path: Path) -> None:
    out = tmp_path / "new.gsmap"
    before = read_map(old)
    with pytest.raises(InputError, match="perception upgrade"):
        perception.load_map(old, encoders).query("strawberry")
    facts = upgrade_map(old, out, encoders=encoders)
    assert facts["encoder"] == ["encoder of that time", "color-test"]
    after = read_map(out)
    for name in ("gaussians.ply", "instance_ids.npy", "instances.json", "features.npy"):
        assert (out / name).read_bytes() == (old / name).read_bytes()
    assert np.array_equal(after.poses, before.poses)
    assert set(verify_map(out).values()) == {"ok"}
    opened = perception.load_map(out, encoders)
    for position, thing in enumerate(THINGS):  # the photos show a red, a green and a blue square
        assert opened.query(thing, top_k=1, min_score=0.0)[0].instance_id == position
        assert after.language["embeddings"][position] == pytest.approx(np.eye(3)[position])
    assert after.parts["language_embeddings"] == pytest.approx(np.eye(3)[[1, 1]])
    assert [len(d) for d in (after.language["view_names"], after.parts["language_view_names"])] == [6, 4]


def test_upgrade_in_place_then_nothing_is_left_to_do(old: Path) -> None:
    upgrade_map(old, encoders=encoders)
    first = {file.name: file.read_bytes() for file in old.iterdir() if file.suffix != ".npz"}
    assert upgrade_map(old, encoders=encoders)["encoder"] == ["color-test", "color-test"]
    first.pop("map.json")  # lists the checksums of archives, whose members carry the time
    assert all((old / name).read_bytes() == raw for name, raw in first.items())
    assert sorted(path.name for path in old.parent.iterdir() if path.name.startswith(".")) == []


def test_upgrade_refuses_without_the_photos_and_changes_nothing(old: Path) -> None:
    before = {file.name: file.read_bytes() for file in old.iterdir()}
    Path("photos/2.png").unlink()
    with pytest.raises(InputError, match=r"2\.png: the photo is missing.*perception relink"):
        upgrade_map(old, encoders=encoders)
    assert {file.name: file.read_bytes() for file in old.iterdir()} == before


def test_upgrade_of_the_same_encoder_needs_no_photos(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ColorEncoder, "identity", "encoder of that time")
    shutil.rmtree("photos")
    before = read_map(old).language
    assert upgrade_map(old, encoders=encoders)["encoder"] == ["encoder of that time"] * 2
    after = read_map(old).language
    assert all(np.array_equal(after[name], before[name]) for name in before)


class Reader:
    """Reads STRAWBERRY wherever a photo is red."""

    identity = "red"

    def read(self, photo: np.ndarray) -> list[Line]:
        rows, columns = np.nonzero((photo[..., 0] > 150) & (photo[..., 1:].max(axis=2) < 100))
        x0, y0, x1, y1 = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
        return [Line("STRAWBERRY", 0.9, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], np.float32))]


def test_upgrade_reads_texts_and_prompts_use_them(
    old: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(upgrade, "make_reader", lambda setting: None)
    upgrade_map(old, encoders=encoders)
    assert b"texts" not in (old / "instances.json").read_bytes() and "instances" not in read_info(old)
    monkeypatch.setattr(upgrade, "make_reader", lambda setting: Reader())
    upgrade_map(old, encoders=encoders)
    opened = perception.load_map(old, encoders)
    assert [entry.get("texts") for entry in opened.instances] == [[{"text": "STRAWBERRY", "score": 0.99}], None, None]
    assert [hit.instance_id for hit in opened.query("the box that says strawberry", top_k=1)] == [0]
    assert opened.query("the box that says lime") == []
    assert main(["info", str(old)]) == 0 and 'printed on 0: "STRAWBERRY"' in capsys.readouterr().out
    shutil.rmtree("photos")
    upgrade_map(old, encoders=encoders)  # nothing is left to read
    monkeypatch.setattr(Reader, "identity", "newer")
    upgrade_map(old, encoders=encoders)  # cannot be read; what is known stays
    assert read_info(old)["instances"]["texts"] == "red" and read_map(old).instances[0]["texts"]


def test_upgrade_on_the_command_line(old: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["upgrade", str(old), "-o", str(old)]) == 2 and "exists already" in capsys.readouterr().err


def test_a_map_without_embeddings_stays_without_and_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "plain.gsmap"
    write_synthetic_map(path, ["mug"], None, gaussians=100)
    assert main(["upgrade", str(path)]) == 0 and "holds no embeddings" in capsys.readouterr().out
    assert main(["query", str(path), "mug"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "perception label" in told and "language.encoder=conse" in told
    assert main(["label", str(path), "0", "mug"]) == 0 and main(["query", str(path), "mug"]) == 0
