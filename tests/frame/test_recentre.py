"""A georeferenced scene gives the map that the same scene gives near the origin, and exports in its own coordinates."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.cli import main
from perception.config import load_config
from perception.errors import InputError
from perception.frame.recentre import FAR, map_from_input, moved_scene, recentred
from perception.io.cloud import read_cloud, write_cloud
from perception.map.write import read_map
from perception.pipeline.mapping import build_map
from perception.types import DepthImage, Scene, View
from support.aimed import look_at

pytestmark = pytest.mark.slow

ORIGIN = np.array([367_000.0, 5_790_000.0, 40.0])  # UTM 33N, metres
QUICK = ["train.iterations=60", "train.budget=3000", "language.encoder=none", "densify.every=20", "photos.holdout=6"]
QUICK += ["instances.min_cluster_size=15", "instances.min_samples=5"]


def scene_at(place: np.ndarray, path: float = 1.0) -> Scene:
    """Five cameras on a line of length `path` whose middle is `place`, and a cloud around it."""
    rng = np.random.default_rng(0)
    views = []
    for x in np.linspace(-0.5, 0.5, 5) * path:
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ (place + np.array([x, 0, 0]))
        views.append(View(f"{x}", Path("x"), np.eye(3), 4, 4, pose))
    return Scene(views, place + rng.normal(size=(50, 3)), np.zeros((50, 3), np.uint8))


def test_only_what_is_far_is_moved() -> None:
    near = scene_at(np.array([FAR / 2 - 1, 0, 0]))
    assert recentred(near) is near
    far = scene_at(ORIGIN)
    scene = recentred(far)
    origin = -np.array(scene.report["map_from_input"])[:3, 3]
    assert np.linalg.norm(origin - ORIGIN) < 1 and "map_from_input" not in far.report
    np.testing.assert_allclose(scene.points + origin, far.points, rtol=0, atol=1e-9)
    for old, new in zip(far.views, scene.views, strict=True):  # a place is seen where it was
        place = np.append(far.points[0], 1)
        seen = new.camera_from_world @ np.append(far.points[0] - origin, 1)
        np.testing.assert_allclose(seen, old.camera_from_world @ place, rtol=0, atol=1e-8)


def test_one_camera_or_many_in_one_place_stay() -> None:
    scene = scene_at(ORIGIN, path=0)
    scene.views = scene.views[:1]
    assert recentred(scene) is scene


@pytest.mark.parametrize("origin", [[1, 2], "x", [1, 2, float("nan")], None, {}])
def test_an_origin_that_is_none_is_told(origin: object) -> None:
    with pytest.raises(InputError, match=r"scene\.origin is no position"):
        map_from_input(Path("m.gsmap"), {"scene": {"origin": origin}})


def test_an_offset_of_an_earlier_release_and_a_matrix_that_is_none() -> None:
    old = map_from_input(Path("m.gsmap"), {"scene": {"origin": [1.0, 2.0, 3.0]}})
    assert np.array_equal(old @ [1, 2, 3, 1], [0, 0, 0, 1])
    with pytest.raises(InputError, match=r"map\.json: map_from_input: expected a rotation"):
        map_from_input(Path("m.gsmap"), {"map_from_input": np.diag([1.0, 2, 3, 1]).tolist()})


def test_a_scene_in_another_frame_is_the_same_scene() -> None:
    """Pixels stay, depths along the optical axis grow with the unit; two moves are one, and gravity turns along."""
    scene = scene_at(np.zeros(3))
    scene.views[0] = replace(scene.views[0], depth=DepthImage(Path("d.png"), 0.001))
    scene.report["gravity"] = {"direction": [0.0, 0.6, 0.8], "source": "x", "standard_error_deg": 1.0}
    turn = look_at(np.array([1.0, 2, 3]), np.zeros(3), np.array([0, 0, 1.0]))[:3, :3]
    b_from_a = np.eye(4)
    b_from_a[:3, :3], b_from_a[:3, 3] = 2.5 * turn, [4, 5, 6]
    twice = moved_scene(moved_scene(scene, b_from_a), b_from_a)
    for old, new in zip(scene.views, twice.views, strict=True):
        seen = [v.camera_from_world @ np.append(s.points[0], 1) for v, s in ((old, scene), (new, twice))]
        np.testing.assert_allclose(seen[1][:3], 2.5**2 * seen[0][:3], atol=1e-9)
    assert twice.views[0].depth is not None and twice.views[0].depth.scale == pytest.approx(0.001 * 2.5**2)
    np.testing.assert_allclose(twice.report["gravity"]["direction"], turn @ turn @ [0, 0.6, 0.8], atol=1e-12)
    np.testing.assert_allclose(twice.report["map_from_input"], b_from_a @ b_from_a, atol=1e-12)


@pytest.fixture(scope="module")
def both(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The small scene where it is and at ORIGIN: {"near": folder, "far": folder}, each with cloud, cameras and map."""
    folder = tmp_path_factory.mktemp("far")
    config = load_config(None, [*QUICK, f"masks=labels:{small_scene / 'labels'}"])
    for name, shift in (("near", np.zeros(3)), ("far", ORIGIN)):
        (folder / name).mkdir()
        cloud = read_cloud(small_scene / "truth" / "gt_points.ply")
        cloud.points = cloud.points.astype(np.float64) + shift
        write_cloud(folder / name / "points.ply", cloud)
        cameras = json.loads((small_scene / "transforms.json").read_text())
        for frame in cameras["frames"]:
            frame["file_path"] = str(small_scene / frame["file_path"])
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] += shift
            frame["transform_matrix"] = matrix.tolist()
        source = folder / name / "transforms.json"
        source.write_text(json.dumps({**cameras, "ply_file_path": str(folder / name / "points.ply")}))
        build_map(source, folder / name / "m.gsmap", config)
    return {name: folder / name for name in ("near", "far")}


def test_a_georeferenced_scene_maps_as_well_as_one_at_home(both: dict[str, Path]) -> None:
    """The rounding of the moved coordinates differs, 1e-9 m in double, so bits do; the quality may not."""
    near, far = (read_map(both[name] / "m.gsmap") for name in ("near", "far"))
    assert "map_from_input" not in near.info and np.abs(far.means).max() < 100
    assert far.info["quality"]["psnr"] == pytest.approx(near.info["quality"]["psnr"], abs=0.3)
    assert len(far.instances) > 3


def test_exports_and_cameras_are_in_the_inputs_coordinates(both: dict[str, Path], tmp_path: Path) -> None:
    far = both["far"]
    labelled, own = tmp_path / "labelled.ply", tmp_path / "own.ply"
    words = ["--points", str(far / "points.ply"), "-o", str(labelled)]
    assert main(["export", str(far / "m.gsmap"), *words]) == 0
    given, result = read_cloud(far / "points.ply"), read_cloud(labelled)
    assert np.array_equal(given.points, result.points) and (result.labels["instance_id"] >= 0).mean() > 0.3
    assert main(["export", str(far / "m.gsmap"), "-o", str(own)]) == 0
    gmap = read_map(far / "m.gsmap")
    shown = gmap.means[gmap.opacities >= 0.5] - map_from_input(far, gmap.info)[:3, 3]
    np.testing.assert_allclose(read_cloud(own).points, shown, rtol=0, atol=1e-9)
    for given in ([], ["--cameras", str(far / "transforms.json")]):
        assert main(["render", str(far / "m.gsmap"), *given, "-o", str(tmp_path / str(len(given)))]) == 0
    for held in (tmp_path / "0").rglob("*.png"):  # the held-out views, from the map and from the file
        one, other = cv2.imread(str(held)), cv2.imread(str(tmp_path / "2" / held.name))
        assert np.abs(one.astype(int) - other).mean() < 0.5
