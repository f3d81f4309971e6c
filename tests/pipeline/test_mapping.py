"""The whole pipeline on a small scene with exact truth: what it writes, finds, resumes and refuses."""

from __future__ import annotations

import errno
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import perception
from perception.cli import main
from perception.config import load_config
from perception.errors import InputError
from perception.io.cloud import read_cloud
from perception.map.replace import lock_file
from perception.map.write import read_map
from perception.pipeline import checkpoint
from perception.pipeline.checkpoint import work_folder
from perception.pipeline.demo import DemoTruth, truth_in_map_frame
from perception.pipeline.mapping import build_map
from support.demo_truth import load_truth
from support.interrupts import interrupt_at
from worlds.make import write_truth

pytestmark = pytest.mark.slow

SETTINGS = [
    "train.iterations=200",
    "train.budget=6000",
    "densify.every=25",
    "instances.min_cluster_size=15",
    "instances.min_samples=5",
    "language.encoder=none",
    "photos.holdout=6",
]


def settings(scene: Path, *more: str):
    return load_config(None, [*SETTINGS, f"masks=labels:{scene / 'labels'}", *more])


@pytest.fixture(scope="module")
def finished(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "small.gsmap"
    words = ("language.encoder=conse", "language.views=1", "language.zooms=1")
    build_map(small_scene / "transforms.json", path, settings(small_scene, *words))
    return path


def test_the_map_holds_what_the_contract_says(finished: Path) -> None:
    info = json.loads((finished / "map.json").read_text())
    instances = json.loads((finished / "instances.json").read_text())["instances"]
    gmap = read_map(finished)
    assert info["num_gaussians"] == len(gmap) <= 6000
    assert info["num_instances"] == len(instances) > 3
    assert set(instances[0]) >= {"id", "label", "score", "num_gaussians", "centroid", "obb", "aabb"}
    assert [entry["num_gaussians"] for entry in instances] == np.bincount(
        gmap.instance_ids[gmap.instance_ids >= 0]
    ).tolist()
    assert all(0 <= entry["score"] <= 1 for entry in instances)
    assert {"poses", "masks", "train", "instances", "total"} <= set(info["seconds"])
    assert len(info["quality"]["views"]) == 2 and info["config"]["train"]["budget"] == 6000
    assert not work_folder(finished).exists()


def test_renders_explain_the_photos(finished: Path, small_scene: Path, tmp_path: Path) -> None:
    """A map that learned nothing would show each photo's mean colour at best; 5 dB is a third of its variance."""
    import cv2

    cameras = str(small_scene / "transforms.json")
    assert main(["render", str(finished), "--cameras", cameras, "-o", str(tmp_path), "--what", "rgb"]) == 0
    gains = []
    for path in sorted((small_scene / "images").glob("*.jpg")):
        photo, render = (cv2.imread(str(p)) / 255 for p in (path, tmp_path / f"{path.stem}.png"))
        blank = np.mean((photo - photo.mean(axis=(0, 1))) ** 2)
        gains.append(10 * np.log10(blank / np.mean((photo - render) ** 2)))
    assert np.median(gains) > 5


def test_instances_agree_with_the_truth(finished: Path, small_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "labelled.ply"
    truth = small_scene / "truth" / "gt_points.ply"
    assert main(["export", str(finished), "--points", str(truth), "-o", str(out), "--json"]) == 0
    assert main(["eval", "instances", str(out), str(truth), "--json"]) == 0
    from perception.evaluate.instances import run_instances

    result, _ = run_instances(out, truth)
    assert result["ap25"] > 0.4


def test_query_answers_as_the_contract_says(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = tmp_path / "hits.ply"
    command = ["query", str(finished), "a ball", "--top", "2", "--min-score", "0", "--points", str(cloud), "--json"]
    assert main(command) == 0
    answer = json.loads(capsys.readouterr().out)
    (result,) = answer["results"]
    assert (result["text"], result["present"], answer["metric"]) == ("a ball", True, False)
    assert len(result["hits"]) == 2 and result["hits"][0]["score"] >= result["hits"][1]["score"]
    assert set(result["hits"][0]) >= {"instance_id", "score", "num_points", "centroid", "obb"}

    gmap = read_map(finished)
    hit = perception.load_map(finished).query("a ball", top_k=1, min_score=0)[0]
    assert np.array_equal(hit.points, gmap.means[gmap.instance_ids == hit.instance_id])
    local = (hit.points - hit.obb.center) @ hit.obb.rotation.T
    inside = (np.abs(local) <= hit.obb.extent / 2 + 1e-5).all(axis=1)  # a box leaves strays out
    assert inside.mean() > 0.9
    held = read_cloud(cloud)
    assert set(held.labels["instance_id"]) == {entry["instance_id"] for entry in result["hits"]}
    assert perception.load_map(finished).query("a ball", min_score=1.01) == []
    assert main(["query", str(finished), " "]) == 2


def test_a_users_label_answers_to_its_name(finished: Path, tmp_path: Path) -> None:
    named = tmp_path / "named.gsmap"
    shutil.copytree(finished, named)
    facts = json.loads((named / "instances.json").read_text())
    facts["instances"][2]["label"] = "grandma's cup"
    (named / "instances.json").write_text(json.dumps(facts))
    hit = perception.load_map(named).query("Grandma's cup", top_k=1)[0]
    assert (hit.instance_id, hit.score) == (facts["instances"][2]["id"], 1.0)


def test_the_report_is_one_page_that_needs_nothing_else(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    assert main(["report", str(finished), "-o", str(out), "--ask", "a ball"]) == 0
    page = out.read_text()
    text = re.sub(r"base64,[A-Za-z0-9+/=]+", "", page)  # in which four letters may stand by chance
    assert "http" not in text.replace("http://www.w3.org", "")
    assert page.count("data:image") > len(read_map(finished).instances) // 2


def test_the_truth_is_brought_into_the_maps_frame(finished: Path, small_scene: Path, tmp_path: Path) -> None:
    """With the true poses given, the demo's alignment must be the identity."""
    truth = load_truth(small_scene / "truth")
    write_truth(tmp_path, truth)
    cloud, scale = truth_in_map_frame(DemoTruth.read(tmp_path), read_map(finished))
    assert np.isclose(scale, 1, atol=1e-6) and np.allclose(cloud.points, truth.points, atol=2e-4)


def test_render_writes_every_kind(finished: Path, small_scene: Path, tmp_path: Path) -> None:
    import cv2

    cameras = str(small_scene / "transforms.json")
    what = "rgb,depth,instances,features"
    assert main(["render", str(finished), "--cameras", cameras, "-o", str(tmp_path), "--what", what]) == 0
    for kind in what.split(","):
        assert len(list((tmp_path / kind).rglob("*.png"))) == 12
    depth = cv2.imread(str(next((tmp_path / "depth").rglob("*.png"))), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16 and 300 < np.median(depth[depth > 0]) < 3000  # metres in thousandths


def test_killed_and_resumed_is_the_run_that_was_never_killed(finished: Path, small_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed.gsmap"
    pairs = [f"--set={pair}" for pair in SETTINGS]
    often = "import sys, perception.cli, perception.pipeline.checkpoint as m; m.CHECKPOINT_SECONDS = .01; "
    command = [
        sys.executable,
        "-c",
        f"{often}sys.exit(perception.cli.main(sys.argv[1:]))",
        "map",
        str(small_scene / "transforms.json"),
        "-o",
        str(out),
    ]
    command += ["--masks", f"labels:{small_scene / 'labels'}", *pairs]
    # Not in the repository's root, where the sources without their compiled core would be found first.
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, cwd=tmp_path)
    checkpoint = work_folder(out) / "checkpoint.pt"
    while process.poll() is None and not checkpoint.exists():
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not out.exists() and checkpoint.exists()
    assert main(command[3:]) == 2  # the unfinished run is named, not overwritten
    assert main([*command[3:], "--resume", "--json"]) == 0
    assert (finished / "gaussians.ply").read_bytes() == (out / "gaussians.ply").read_bytes()
    lock_file(out).touch()  # as a run leaves it that is killed after the map took its place
    assert main([*command[3:], "--resume", "--json"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == [out.name]


def test_built_in_masks_are_made_from_the_maps_own_depth(small_scene: Path, tmp_path: Path) -> None:
    """They wait for the geometry, and a run that is interrupted around them ends in the same map."""
    config = load_config(None, [*SETTINGS, "masks=builtin", "train.iterations=120"])
    whole = build_map(small_scene / "transforms.json", tmp_path / "whole.gsmap", config)
    assert whole.info["masks"]["source"] == "builtin" and whole.info["masks"]["photos"] == 10

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint.TrainingObserver, "after_step", interrupt_at(90))
        build_map(small_scene / "transforms.json", tmp_path / "cut.gsmap", config)
    again = build_map(small_scene / "transforms.json", tmp_path / "cut.gsmap", config, resume=True)
    assert again.info["masks"]["skipped"] == 10
    assert np.array_equal(whole.means, again.means) and np.array_equal(whole.instance_ids, again.instance_ids)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("missing", "does not exist"),
        ("exists", "exists already"),
        ("nan", "pose"),
        ("label_size", "labels"),
        ("label_missing", "labels"),
        ("photo", "damaged or cut short"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    change: str, told: str, small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, out = tmp_path / "scene", tmp_path / "out.gsmap"
    shutil.copytree(small_scene, scene)
    source = scene / "transforms.json"
    _spoil(change, scene, out)
    if change == "missing":
        source = tmp_path / "nowhere"
    code = main(
        ["map", str(source), "-o", str(out), "--strict", "--masks", f"labels:{scene / 'labels'}"]
        + [f"--set={s}" for s in SETTINGS]
    )
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert code == 2 and len(lines) == 1 and told in lines[0]
    assert change == "exists" or not out.exists()
    assert not work_folder(out).exists()


def test_a_full_disk_is_one_line(small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1 << 20))
    with pytest.raises(InputError, match="1 MiB free"):
        build_map(small_scene / "transforms.json", tmp_path / "full.gsmap", settings(small_scene))
    monkeypatch.undo()

    def fail(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, "save_checkpoint", fail)
    with pytest.raises(InputError, match="the disk is full"):
        build_map(small_scene / "transforms.json", tmp_path / "full.gsmap", settings(small_scene, "train.iterations=2"))
    assert not (tmp_path / "full.gsmap").exists()


def _spoil(change: str, scene: Path, out: Path) -> None:
    import cv2

    label = scene / "labels" / "003.png"
    if change == "exists":
        out.mkdir()
    elif change == "nan":
        data = json.loads((scene / "transforms.json").read_text())
        data["frames"][0]["transform_matrix"][0][3] = float("nan")
        (scene / "transforms.json").write_text(json.dumps(data))
    elif change == "label_size":
        cv2.imwrite(str(label), np.zeros((10, 10), np.uint8))
    elif change == "label_missing":
        label.unlink()
    elif change == "photo":
        photo = scene / "images" / "003.jpg"
        photo.write_bytes(photo.read_bytes()[:900])


def test_a_map_of_another_version_is_refused(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.gsmap"
    shutil.copytree(finished, other)
    info = json.loads((other / "map.json").read_text())
    (other / "map.json").write_text(json.dumps({**info, "format_version": 99}))
    for command in (
        ["info", str(other)],
        ["query", str(other), "mug"],
        ["export", str(other), "-o", str(tmp_path / "x.ply")],
    ):
        assert main(command) == 2
        assert "format_version is 99" in capsys.readouterr().err
    assert main(["info", str(finished), "--json"]) == 0
