"""`perception update` on a made visit, against its exact truth."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from perception.cli import main
from perception.colors import sh_from_rgb
from perception.config import load_config
from perception.edit.editor import Editor
from perception.errors import InputError
from perception.gaussians.model import as_gaussians
from perception.gaussians.views import render
from perception.io.cloud import read_cloud
from perception.map.history import changes_of, visits_of
from perception.map.write import Map, read_map, write_map
from perception.pipeline.checkpoint import work_folder
from perception.pipeline.mapping import build_map
from perception.types import View
from perception.visits.scene import update_settings
from perception.visits.update import update_map
from perception.visits.visit import Visit
from worlds.visits import make_visits

pytestmark = pytest.mark.slow
SHARE = {"moved": 0.0, "turned": 0.0, "removed": 0.2, "added": 0.1}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two visits of a table, and the map of the first."""
    folder = tmp_path_factory.mktemp("visits")
    size = {"views": 24, "later_views": 14, "width": 200, "height": 150, "light_samples": 2, "seed": 3}
    make_visits(folder, visits=2, share=SHARE, **size)
    first = folder / "visit0"
    settings = ["train.iterations=700", "language.encoder=none", "language.texts=off"]
    build_map(first, folder / "old.gsmap", load_config(None, [f"masks=labels:{first / 'labels'}", *settings]))
    editor = Editor(folder / "old.gsmap")
    editor.merge([entry["id"] for entry in editor.instances[:2]])
    editor.save()
    editor.undo()
    editor.save()  # an id was given, and nothing has it
    return folder


@pytest.fixture(scope="module")
def new(world: Path) -> Map:
    """The map of the second visit."""
    old, second = world / "old.gsmap", world / "visit1"
    update_map(old, second, world / "new.gsmap", update_settings(old, None, [f"masks=labels:{second / 'labels'}"]))
    return read_map(world / "new.gsmap")


def content(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir()) if file.name != "report.html"}


def thing_of(gmap: Map, instance: int, folder: Path) -> int:
    """The true thing that most of an instance's Gaussians lie on."""
    cloud = read_cloud(folder / "gt_points.ply")
    nearest = cKDTree(cloud.points).query(gmap.means[gmap.instance_ids == instance])[1]
    return int(np.bincount(cloud.labels["instance_id"][nearest]).argmax())


def test_states_are_the_true_ones(world: Path, new: Map) -> None:
    old = read_map(world / "old.gsmap")
    true = {e["id"]: e for e in json.loads((world / "visit1" / "changes.json").read_text())["instances"]}
    said: dict[str, list[str]] = {"removed": [], "unchanged": []}
    for change in changes_of(visits_of(new.info), new.instances, 0):
        if change["instance_id"] not in old.instance_ids:  # added, or known by its looks alone
            continue
        entry = true[thing_of(old, change["instance_id"], world / "visit0")]
        if not entry["is_stuff"]:
            said.setdefault(entry["state"], []).append(change["state"])
    assert said["removed"] and set(said["removed"]) <= {"removed", "moved"}
    assert said["unchanged"].count("unchanged") == len(said["unchanged"]) > 5
    added = [c["instance_id"] for c in changes_of(visits_of(new.info), new.instances, 0) if c["state"] == "added"]
    assert added and {true[thing_of(new, i, world / "visit1")]["state"] for i in added} <= {"added"}


def test_what_stays_keeps_its_ids_and_its_geometry(world: Path, new: Map) -> None:
    """Every Gaussian of the old map that is still there has the same bits, but for its colours."""
    old = read_map(world / "old.gsmap")
    gone = {e["id"] for e in new.instances if e["state"] == "removed"}
    names = ("means", "quats", "log_scales", "opacity_logits", "features")
    rows = {b"".join(getattr(new, n)[i].tobytes() for n in names): int(new.instance_ids[i]) for i in range(len(new))}
    stays = [i for i in range(len(old)) if old.instance_ids[i] not in gone]
    found = [rows.get(b"".join(getattr(old, n)[i].tobytes() for n in names)) for i in stays]
    assert found == old.instance_ids[stays].tolist()


def test_what_is_new_has_an_id_that_nothing_had(world: Path, new: Map) -> None:
    before = read_map(world / "old.gsmap").instances
    first = max(part["id"] for entry in before for part in (entry, *entry.get("parts", ()))) + 2
    came = [entry["id"] for entry in new.instances[len(before) :]]
    assert came == [*range(first, first + len(came))] != [] and new.next_id == first + len(came)


def test_scores_are_of_the_visits_own_photos_and_seconds_have_a_total(new: Map) -> None:
    held = {view.name for view in new.views if view.held_out and view.visit == 1}
    assert held and set(new.info["quality"]["views"]) == held
    assert {text[:6] for text in new.info["training"]["decisions"]} == {"leg 1:", "leg 2:"}
    seconds = dict(new.info["seconds"])
    assert seconds.pop("total") >= sum(seconds.values()) > 0


def test_a_visit_with_a_grey_camera_leaves_the_colours(world: Path, new: Map) -> None:
    """What stays keeps its hue in the light of the visit, one number; what is new is grey, and what went is told."""
    old, grey = read_map(world / "old.gsmap"), world / "grey"
    shutil.copytree(world / "visit1", grey)
    for file in (grey / "images").iterdir():
        cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
    config = update_settings(world / "old.gsmap", None, [f"masks=labels:{grey / 'labels'}"])
    made = update_map(world / "old.gsmap", grey, world / "grey.gsmap", config)
    where = {mean.tobytes(): i for i, mean in enumerate(old.means)}
    pairs = np.array([(i, where[mean.tobytes()]) for i, mean in enumerate(made.means) if mean.tobytes() in where])
    constant = [m.sh[i, 0] for m, i in zip((made, old), pairs.T, strict=True)]
    now, then = (sh - (sh @ [0.299, 0.587, 0.114])[:, None] for sh in constant)
    seen = (made.sh[pairs[:, 0]] != old.sh[pairs[:, 1]]).any(axis=(1, 2))
    light = np.sum(now[seen] * then[seen]) / np.sum(then[seen] ** 2)
    assert seen.sum() > 1000 and 0.5 < light < 2
    np.testing.assert_allclose(now[seen], light * then[seen], atol=1e-4)
    assert np.ptp(made.sh[np.setdiff1d(np.arange(len(made)), pairs[:, 0]), 0], axis=1).max() < 1e-3
    gone = [{e["id"] for e in m.instances if e["state"] == "removed"} for m in (made, new)]
    assert gone[0] == gone[1] != set()


def hidden(gmap: Map, folder: Path, views: list[View]) -> np.ndarray:
    """[N] bool: Gaussians that no view shows, by its exact depths: each picture has all near a Gaussian well before it,
    or does not have it."""
    seen = np.zeros(len(gmap), bool)
    for view in views:
        depth = cv2.imread(str(folder / "depth" / f"{view.photo.stem}.png"), cv2.IMREAD_UNCHANGED) / 1000
        local = gmap.means @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
        column, row = np.floor(local[:, :2] / local[:, 2:] * np.diag(view.K)[:2] + view.K[:2, 2]).astype(int).T
        inside = (local[:, 2] > 0) & (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
        nearest = cv2.dilate(np.where(depth > 0, depth, np.inf), np.ones((7, 7)))[row[inside], column[inside]]
        seen[inside] |= local[inside, 2] < 1.25 * nearest + 3 * np.exp(gmap.log_scales[inside].max(axis=1))
    return ~seen


def filled(gmap: Map, views: list[View], rows: np.ndarray) -> float:
    """Pixels of all views that each of the Gaussians `rows` fills, in the mean: rendered white, all others black."""
    white = torch.from_numpy(np.isin(np.arange(len(gmap)), rows).astype(np.float32))
    marked = replace(as_gaussians(gmap), sh=sh_from_rgb(white[:, None, None].expand(-1, 1, 3)))
    total = 0.0
    for view in views:
        camera = (torch.from_numpy(a.astype(np.float32)) for a in (view.camera_from_world, view.K))
        total += float(render(marked, *camera, view.width, view.height, harmonics=True).colors[0, ..., 0].sum())
    return total / len(rows)


def test_an_update_keeps_what_earlier_visits_saw(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A visit of one side: what it does not see keeps its colours, bit for bit, but for Gaussians that show through
    what hides them. Photos of the first visit, in whatever light, are shown better than by an update that rehearses
    nothing."""
    old, second, errors = world / "old.gsmap", world / "visit1", []
    known = json.loads((second / "transforms.json").read_text())
    frames = sorted(known["frames"], key=lambda frame: str(frame["file_path"]))[:5]
    (second / "side.json").write_text(json.dumps({**known, "frames": frames}))
    config = update_settings(old, None, [f"masks=labels:{second / 'labels'}"])
    for name in ("side.gsmap", "forgetful.gsmap"):
        gmap = update_map(old, second / "side.json", world / name, config)
        then = {mean.tobytes(): sh for mean, sh in zip(read_map(old).means, read_map(old).sh, strict=True)}
        shown = [view for view in gmap.views if view.visit == 1]
        unseen = [i for i in np.flatnonzero(hidden(gmap, second, shown)) if gmap.means[i].tobytes() in then]
        same = np.array([np.array_equal(gmap.sh[i], then[gmap.means[i].tobytes()]) for i in unseen])
        parts = [np.array(unseen)[same], np.array(unseen)[~same]]
        few, many = (filled(gmap, [view for view in shown if not view.held_out], part) for part in parts)
        assert len(same) > 200 and same.mean() > 0.7 and few < 10 < many, (same.mean(), few, many)
        gaussians, found = as_gaussians(gmap), []
        for view in gmap.views:
            if view.visit == 0:
                photo = torch.from_numpy(cv2.imread(str(view.photo))[..., ::-1] / 255.0)
                camera = (torch.from_numpy(a.astype(np.float32)) for a in (view.camera_from_world, view.K))
                image = render(gaussians, *camera, view.width, view.height, harmonics=True).colors[0]
                light = (image * photo).sum(dim=(0, 1)) / (image * image).sum(dim=(0, 1))
                found.append(float((light * image - photo).abs().median()))  # most of it did not change
        errors.append(np.mean(found))
        monkeypatch.setattr(Visit, "rehearsed", lambda *_: [])
    assert 0 < errors[0] < 0.95 * errors[1], errors


def test_a_visit_without_changes_adds_nothing(world: Path) -> None:
    first = world / "visit0"
    pairs = [f"masks=labels:{first / 'labels'}", "photos.max_side=190"]
    gmap = update_map(
        world / "old.gsmap", first, world / "same.gsmap", update_settings(world / "old.gsmap", None, pairs)
    )
    assert {entry["state"] for entry in gmap.instances} <= {"unchanged", "unseen"}
    assert gmap.setting("photos", "max_side", 0) == 800  # at which the boxes of the first visit are


def test_what_was_removed_and_comes_back_has_its_id_again(world: Path, new: Map) -> None:
    """The third visit finds the place as the first one did."""
    again = world / "visit2"
    shutil.copytree(world / "visit0", again, copy_function=shutil.copyfile)  # newer photos
    config = update_settings(world / "new.gsmap", None, [f"masks=labels:{again / 'labels'}"])
    back = update_map(world / "new.gsmap", again, world / "back.gsmap", config)
    then = {entry["id"]: entry for entry in read_map(world / "old.gsmap").instances}
    gone = [entry["id"] for entry in new.instances if entry["state"] == "removed"]
    found = {entry["id"]: entry for entry in back.instances if entry["id"] in gone and entry["state"] == "added"}
    assert found, gone
    for i, entry in found.items():
        assert np.linalg.norm(np.subtract(entry["centroid"], then[i]["centroid"])) < 0.03  # a quarter of a thing
        assert thing_of(back, i, again) == thing_of(read_map(world / "old.gsmap"), i, world / "visit0")
        change = next(c for c in changes_of(visits_of(back.info), back.instances, 0) if c["instance_id"] == i)
        assert change["state"] == "unchanged"


def test_another_scene_and_other_masks_are_refused(world: Path, small_scene: Path) -> None:
    old = world / "old.gsmap"
    before = content(old)
    config = update_settings(old, None, [f"masks=labels:{small_scene / 'labels'}"])
    with pytest.raises(InputError, match="do not show"):
        update_map(old, small_scene, world / "no.gsmap", config)
    with pytest.raises(InputError, match="come from labels"):
        update_map(old, world / "visit1", world / "no.gsmap", config.model_copy(update={"masks": "builtin"}))
    with pytest.raises(InputError, match="give labels:DIR"):
        update_settings(old, None, [])
    assert content(old) == before and not (world / "no.gsmap").exists()


def test_the_truth_of_a_visit_agrees_with_its_pictures(world: Path) -> None:
    """Things taken away are in no mask, and all others that changes.json says are seen are in one."""
    listed = json.loads((world / "visit1" / "changes.json").read_text())["instances"]
    seen = {int(i) for f in (world / "visit1" / "masks_gt").iterdir() for i in np.unique(cv2.imread(str(f), -1))}
    for entry in listed:
        if entry["state"] == "removed":
            assert entry["id"] not in seen
        elif entry["seen_in_visit2"] > 0.05:
            assert entry["id"] in seen


def command(world: Path, visit: Path, name: str) -> list[str]:
    """The words of `perception update` for a visit of the world."""
    masks = ["--masks", f"labels:{world / 'visit1' / 'labels'}"]
    return ["update", str(world / "old.gsmap"), str(visit), "-o", str(world / name), *masks]


def test_a_killed_update_goes_on_to_the_same_map(world: Path, new: Map, capsys: pytest.CaptureFixture[str]) -> None:
    """So an update is repeatable, in another process too; and it leaves the old map."""
    before = content(world / "old.gsmap")
    words, out = command(world, world / "visit1", "killed.gsmap"), world / "killed.gsmap"
    often = "import sys, perception.cli, perception.pipeline.checkpoint as m; m.CHECKPOINT_SECONDS = .01; "
    run = [sys.executable, "-c", f"{often}sys.exit(perception.cli.main(sys.argv[1:]))", *words]
    process = subprocess.Popen(run, stderr=subprocess.DEVNULL, cwd=world)
    settle = "leg-settle-*/checkpoint.pt"
    while process.poll() is None and not list(work_folder(out).glob(settle)):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert list(work_folder(out).glob(settle)) and not out.exists()
    assert main(words) == 2  # the unfinished run is named, not overwritten
    assert main([*words, "--resume"]) == 0
    assert capsys.readouterr().err.count("resuming at iteration") == 2
    one, other = content(world / "new.gsmap"), content(out)
    assert one.keys() == other.keys() and not work_folder(out).exists()
    assert all(one[name] == other[name] for name in one if name != "map.json")  # which holds seconds
    assert content(world / "old.gsmap") == before


def test_photos_alone_are_localised(world: Path, new: Map, capsys: pytest.CaptureFixture[str]) -> None:
    """Beside a damaged photo and one that its mask ignores, in a map of photos that lie in a folder visit1. A part of
    the robot stays in the lower corner of all pictures."""
    photos, masks, old = world / "photos", world / "ignore", read_map(world / "old.gsmap")
    part = cv2.GaussianBlur(np.random.default_rng(9).integers(10, 250, (40, 50, 3)).astype(np.uint8), (0, 0), 1.0)
    photos.mkdir()
    for photo in sorted((world / "visit1" / "images").iterdir()):
        picture = cv2.imread(str(photo))
        picture[-40:, :50] = part
        cv2.imwrite(str(photos / photo.name), picture, [cv2.IMWRITE_JPEG_QUALITY, 97])
    (photos / "broken.jpg").write_bytes(b"no picture")
    masks.mkdir()
    cv2.imwrite(str(masks / "003.png"), np.zeros((150, 200), np.uint8))
    old.views = [replace(view, name=f"visit1/{view.name}") for view in old.views]
    old.info["peak_memory_mib"] = 1.0
    write_map(world / "named.gsmap", old)
    words = command(world, photos, "localised.gsmap")
    assert main(["update", str(world / "named.gsmap"), *words[2:], "--ignore-masks", str(masks)]) == 0
    assert "what stays in the picture while the camera moves is ignored" in capsys.readouterr().err
    gmap = read_map(world / "localised.gsmap")
    assert len({view.name for view in gmap.views}) == len(gmap.views) > len(old.views)
    left_out = {Path(entry["name"]).name for entry in gmap.info["scene"]["left_out"]}
    assert left_out == {"broken.jpg", "003.jpg"} and gmap.info["peak_memory_mib"] > 1
    poses = {Path(view.name).name: view.camera_from_world for view in gmap.views if view.visit == 1}
    given = {Path(v.name).name: v.camera_from_world for v in new.views if v.visit == 1 and "003" not in v.name}
    assert poses.keys() == given.keys()
    size = np.ptp(old.means, axis=0).max()
    shifts = [np.linalg.norm(np.linalg.inv(poses[n])[:3, 3] - np.linalg.inv(given[n])[:3, 3]) for n in poses]
    assert np.median(shifts) < 0.01 * size
    counts = [[entry["state"] for entry in each.instances].count("added") for each in (gmap, new)]
    assert counts[0] == counts[1]  # the part is none


def test_poses_that_are_off_are_found_in_the_map(world: Path, new: Map, capsys: pytest.CaptureFixture[str]) -> None:
    """As a robot's, which drift: by 3 % of the table's width and 2° about other axes from photo to photo."""
    off, rng = world / "off", np.random.default_rng(0)
    shutil.copytree(world / "visit1", off)
    placed = json.loads((off / "transforms.json").read_text())
    for n, frame in enumerate(placed["frames"]):
        drift = np.eye(4)
        drift[:3, :3] = Rotation.from_rotvec(np.radians([2 * np.cos(n / 3), 2 * np.sin(n / 3), 1])).as_matrix()
        drift[:3, 3] = 0.03 * np.array([np.sin(n / 5), np.cos(n / 5), 0.3]) + rng.normal(0, 0.002, 3)
        frame["transform_matrix"] = (drift @ np.array(frame["transform_matrix"])).tolist()
    (off / "transforms.json").write_text(json.dumps(placed))
    assert main(command(world, off, "off.gsmap")) == 0
    assert "the given poses do not fit the map" in capsys.readouterr().err
    gmap = read_map(world / "off.gsmap")
    states, true = ({e["id"]: e["state"] for e in each.instances} for each in (gmap, new))
    assert [i for i in true if true[i] != "added" and states.get(i) != true[i]] == []
    poses, given = ({v.name: v.camera_from_world for v in each.views if v.visit == 1} for each in (gmap, new))
    shifts = [np.linalg.norm(np.linalg.inv(poses[n])[:3, 3] - np.linalg.inv(given[n])[:3, 3]) for n in given]
    assert np.median(shifts) < 0.005
    assert main([*command(world, off, "kept.gsmap"), "--set", "photos.poses=keep"]) in (0, 2)
    assert "the given poses do not fit the map" not in capsys.readouterr().err


def test_bad_visits_are_refused_in_one_line(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, second = content(world / "old.gsmap"), world / "visit1"
    empty, unit, nothing = tmp_path / "empty", tmp_path / "unit", tmp_path / "nothing"
    empty.mkdir()
    (empty / "notes.txt").write_text("no photo")
    nothing.mkdir()
    (nothing / "transforms.json").write_text(json.dumps({"w": 1, "h": 1, "fl_x": 1, "fl_y": 1, "frames": []}))
    shutil.copytree(second, unit)
    placed = json.loads((second / "transforms.json").read_text())
    for frame in placed["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, 3] *= 10
        frame["transform_matrix"] = matrix.tolist()
    (unit / "transforms.json").write_text(json.dumps(placed))
    for source, what in ((empty, "no"), (nothing, "no"), (unit / "transforms.json", "unit"), (tmp_path / "x", "no")):
        keep = ["--set", "photos.poses=keep"] if what == "unit" else []  # else its photos are localised
        assert main([*command(world, source, "no.gsmap"), *keep]) == 2
        err = capsys.readouterr().err.strip().splitlines()
        assert what in err[-1] and str(source) in err[-1], err
        assert not (world / "no.gsmap").exists()
        shutil.rmtree(work_folder(world / "no.gsmap"), ignore_errors=True)
    assert content(world / "old.gsmap") == before
