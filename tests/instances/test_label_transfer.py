"""Names of instances: written whole, found by queries, carried over to another map of the same place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from perception.cli import main
from perception.errors import InputError
from perception.geometry import look_at
from perception.instances.label_transfer import match_instances, transfer_labels
from perception.io.store import Map, read_map, set_labels, write_map
from support.views_at import views_at

PLACES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1.2, 1, 0.2]])


def a_map(places: np.ndarray, seed: int, names: list[str | None] | None = None) -> Map:
    """Blobs of 300 Gaussians, ten centimetres wide, one an instance, with six cameras above."""
    rng = np.random.default_rng(seed)
    count = 300 * len(places)
    means = np.repeat(places, 300, axis=0) + rng.uniform(-0.1, 0.1, (count, 3))
    ids = np.repeat(np.arange(len(places)), 300)
    labels = names or [None] * len(places)
    eyes = [np.array([3 * np.cos(a), 3 * np.sin(a), 2 + 0.1 * a]) for a in range(6)]
    poses = np.stack([look_at(eye, np.zeros(3), np.array([0, 0, 1.0])) for eye in eyes])
    return Map(
        means.astype(np.float32), np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, 3)), np.zeros(count),
        np.zeros((count, 1, 3)), np.zeros((count, 2)), ids.astype(np.int32), np.ones(count),
        [
            {"id": i, "label": name, "score": 1.0, "centroid": places[i].tolist(), "num_gaussians": 300,
             "obb": {"center": places[i].tolist(), "rotation": np.eye(3).tolist(), "extent": [0.2, 0.2, 0.2]}}
            for i, name in enumerate(labels)
        ], {},
        views_at(poses),
    )  # fmt: skip


@pytest.fixture
def map_path(tmp_path: Path) -> Path:
    write_map(tmp_path / "m.gsmap", a_map(PLACES, 0))
    return tmp_path / "m.gsmap"


def labels_of(path: Path) -> list[str | None]:
    return [entry["label"] for entry in json.loads((path / "instances.json").read_text())["instances"]]


def test_label_and_clear(map_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = json.loads((map_path / "instances.json").read_text())
    assert main(["label", str(map_path), "2", " grandma's  cup "]) == 0
    assert labels_of(map_path) == [None, None, "grandma's cup", None]
    assert read_map(map_path).instances[2]["label"] == "grandma's cup"
    capsys.readouterr()
    assert main(["label", str(map_path)]) == 0 and "2  grandma's cup" in capsys.readouterr().out
    assert main(["label", str(map_path), "2", "--clear"]) == 0
    assert json.loads((map_path / "instances.json").read_text()) == before
    assert {p.name for p in map_path.iterdir() if p.name.startswith(".")} == set()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["9", "cup"], "has no instance 9; it has 4"),
        (["1", "  "], "label: it is empty"),
        (["1", "x" * 300], "300 characters"),
        (["1"], "no NAME given"),
        (["1", "cup", "--clear"], "only one of them"),
        (["--clear"], "needs the ID"),
    ],
)
def test_bad_labels_change_nothing(
    map_path: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (map_path / "instances.json").read_bytes()
    assert main(["label", str(map_path), *arguments]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert (map_path / "instances.json").read_bytes() == before


def test_no_map_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no map"):
        set_labels(tmp_path, {0: "cup"})


def test_names_follow_the_place_not_the_id(tmp_path: Path) -> None:
    write_map(tmp_path / "old.gsmap", a_map(PLACES, 0, ["cup", None, "lamp", "box"]))
    write_map(tmp_path / "new.gsmap", a_map(PLACES[[2, 1, 0]], 1))  # other ids, other samples, one thing is gone
    transfer = transfer_labels(read_map(tmp_path / "old.gsmap"), read_map(tmp_path / "new.gsmap"))
    assert transfer.labels == {2: "cup", 0: "lamp"} and transfer.dropped == [(3, "box")] and transfer.aligned
    assert main(["label", str(tmp_path / "new.gsmap"), "--from", str(tmp_path / "old.gsmap")]) == 0
    assert labels_of(tmp_path / "new.gsmap") == ["lamp", None, "cup"]


def test_another_frame_is_tied_by_common_photos() -> None:
    old, new = a_map(PLACES, 0, ["cup", None, None, None]), a_map(PLACES, 1)
    rotation = look_at(np.zeros(3), np.array([1.0, 2, 3]), np.array([0, 0, 1.0]))[:3, :3]
    new.means = (2.5 * new.means @ rotation.T + [4, 5, 6]).astype(np.float32)
    poses = new.poses
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    poses[:, :3, :3] = poses[:, :3, :3] @ rotation.T
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], 2.5 * centres @ rotation.T + [4, 5, 6])
    new.views = views_at(poses)
    transfer = transfer_labels(old, new)
    assert transfer.labels == {0: "cup"} and transfer.aligned
    new.views = views_at(poses, [f"other{k}.jpg" for k in range(6)])
    assert transfer_labels(old, new).dropped == [(0, "cup")]


def test_merged_split_and_moved_instances_have_no_partner() -> None:
    rng = np.random.default_rng(0)
    cube = rng.uniform(0, 1, (900, 3))
    thirds = np.minimum((cube[:, 0] * 3).astype(int), 2)
    ones = np.zeros(900, int)
    assert match_instances(cube, ones, cube, thirds, [0]) == {}  # split in three
    assert match_instances(cube, thirds, cube, ones, [0, 1, 2]) == {}  # merged
    assert match_instances(cube, ones, cube + 5, ones, [0]) == {}  # moved
    assert match_instances(cube, ones, cube + 0.01, ones + 6, [0]) == {0: 6}
    mostly = (cube[:, 0] > 0.8).astype(int)
    assert match_instances(cube, ones, cube, mostly, [0]) == {0: 0}  # four fifths of it live on


@pytest.mark.slow
def test_a_map_made_again_keeps_the_names(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command line of it, on two runs that give the same map."""
    make = ["map", str(small_scene), "--masks", f"labels:{small_scene / 'labels'}", "--iterations", "60"]
    make += ["--budget", "4000", "--set", "language.encoder=none"]
    old, new = tmp_path / "old.gsmap", tmp_path / "new.gsmap"
    assert main([*make, "-o", str(old)]) == 0
    largest = max(read_map(old).instances, key=lambda entry: entry["num_gaussians"])
    assert main(["label", str(old), str(largest["id"]), "the big one"]) == 0
    assert main([*make, "-o", str(new), "--labels-from", str(old)]) == 0
    assert "is called “the big one”" in capsys.readouterr().err
    (named,) = [entry for entry in read_map(new).instances if entry["label"]]
    assert named["id"] == largest["id"]
    assert main([*make, "-o", str(tmp_path / "x.gsmap"), "--labels-from", str(tmp_path / "none.gsmap")]) == 2
    assert not (tmp_path / "x.gsmap.work").exists()
