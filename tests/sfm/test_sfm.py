"""Structure from motion, whole: photos of a made-up corner with exact poses; warnings on models wrecked on purpose."""

import json
import os
import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.geometry import align_similarity, inverse_se3
from perception.inputs.load import load_scene
from perception.photos.folder import PhotoSet
from perception.photos.lens import load_pycolmap
from perception.sfm import consistency, escalation, features, reconstruct
from perception.sfm.consistency import Pair
from perception.sfm.database import build_features
from perception.sfm.escalation import Escalation
from perception.sfm.incremental import take_out
from perception.sfm.options import ReadOptions
from support.aimed import look_at
from support.progress import Told

pytestmark = pytest.mark.slow

WIDTH, HEIGHT, FOCAL, VIEWS = 320, 240, 300.0, 10


def texture(rng):
    """Noise of many scales, so that SIFT finds something at every distance."""
    layers = [cv2.resize(rng.random((n, n)).astype(np.float32), (1024, 1024)) for n in (16, 32, 64, 128, 256)]
    mixed = sum(layers)
    return np.round(255 * (mixed - mixed.min()) / np.ptp(mixed)).astype(np.uint8)


def shoot(textures, camera_from_world):
    """The corner x = 0, y = 0, z = 0, seen from the octant of positive coordinates: nearest plane along every ray."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    world = inverse_se3(camera_from_world)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], -1) @ world[:3, :3].T
    with np.errstate(divide="ignore"):
        t = np.where(rays < 0, -world[:3, 3] / rays, np.inf)
    nearest = t.argmin(-1)
    points = world[:3, 3] + rays * t.min(-1, keepdims=True)
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    for axis, picture in enumerate(textures):
        u, v = (np.delete(points, axis, -1) * 256).astype(np.float32).transpose(2, 0, 1)
        image = np.where(nearest == axis, cv2.remap(picture, u, v, cv2.INTER_AREA), image)
    return image


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corner") / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    textures = [texture(rng) for _ in range(3)]
    truth = {}
    for index, angle in enumerate(np.radians(np.linspace(15, 75, VIEWS))):
        eye = np.array([2.6 * np.cos(angle), 2.6 * np.sin(angle), 1.6 + 0.3 * np.sin(3 * index)])
        pose = look_at(eye, np.array([0.6, 0.6, 0.6]), np.array([0, 0, 1.0]))
        name = f"{index:02d}.png"
        Image.fromarray(shoot(textures, pose)).save(folder / name)
        truth[name] = pose
    return folder, truth


@pytest.fixture(scope="module")
def run(corner, tmp_path_factory):
    told = Told()
    workdir = tmp_path_factory.mktemp("work")
    return load_scene(corner[0], ReadOptions(workdir, progress=told)), told.updates, workdir


def errors(scene, truth):
    """(largest centre error as a share of the spread of the cameras, largest rotation error in degrees)."""
    right = np.stack([inverse_se3(truth[view.name]) for view in scene.views])
    found = np.stack([inverse_se3(view.camera_from_world) for view in scene.views])
    scale, rotation, shift = align_similarity(right[:, :3, 3], found[:, :3, 3])
    centers = scale * found[:, :3, 3] @ rotation.T + shift
    spread = np.linalg.norm(right[:, :3, 3] - right[:, :3, 3].mean(0), axis=1).mean()
    turned = np.swapaxes(right[:, :3, :3], 1, 2) @ rotation @ found[:, :3, :3]
    return np.linalg.norm(right[:, :3, 3] - centers, axis=1).max() / spread, np.degrees(
        Rotation.from_matrix(turned).magnitude()
    ).max()


def test_poses_are_the_true_ones(corner, run):
    scene, told, _ = run
    assert len(scene.views) == VIEWS and not scene.report["left_out"] and not scene.report["warnings"]
    center, turned = errors(scene, corner[1])
    assert center < 0.02 and turned < 0.5
    assert scene.views[0].K[0, 0] == pytest.approx(FOCAL, rel=0.03)
    assert len(scene.points) > 200 and not scene.metric
    names = ("photos", "what stays in the picture", "features", "matching", "mapping")
    stages = [f"poses: {name}" for name in names]
    assert list(dict.fromkeys(stage for stage, *_ in told)) == stages
    for stage in stages:
        shares = [done / total for name, done, total in told if name == stage]
        assert shares == sorted(shares) and shares[-1] == 1.0


def test_finished_work_is_used_again(corner, run):
    scene, _, workdir = run
    told = Told()
    again = load_scene(corner[0], ReadOptions(workdir, progress=told))
    looked = {"poses: photos", "poses: what stays in the picture"}
    assert {stage for stage, *_ in told.updates} == looked  # nothing else is done again
    for a, b in zip(scene.views, again.views, strict=True):
        np.testing.assert_array_equal(a.camera_from_world, b.camera_from_world)


def test_known_intrinsics_are_kept(corner, tmp_path):
    camera = tmp_path / "camera.yaml"
    camera.write_text(
        f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ndistortion_model: plumb_bob\n"
        f"camera_matrix: {{data: [{FOCAL}, 0, {WIDTH / 2 - 0.5}, 0, {FOCAL}, {HEIGHT / 2 - 0.5}, 0, 0, 1]}}\n"
        "distortion_coefficients: {data: [0, 0, 0, 0, 0]}\n"
    )
    scene = load_scene(corner[0], ReadOptions(tmp_path / "work", camera=camera))
    assert len(scene.views) == VIEWS
    assert scene.views[0].K.tolist() == [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    center, turned = errors(scene, corner[1])
    assert center < 0.01 and turned < 0.2


def test_a_seed_repeats(corner, run, tmp_path):
    again = load_scene(corner[0], ReadOptions(tmp_path))
    for a, b in zip(run[0].views, again.views, strict=True):
        np.testing.assert_array_equal(a.camera_from_world, b.camera_from_world)


def test_one_thread_trains_the_index_of_descriptors(corner, tmp_path, monkeypatch):
    """In several, a pair in about 10,000 got other matches (fox_480, under load): too rare to be seen here."""
    pycolmap, threads = load_pycolmap(), []
    match = pycolmap.match_image_pairs

    def watched(database, options, *rest):
        threads.append(options.num_threads)
        match(database, options, *rest)

    monkeypatch.setattr(pycolmap, "match_image_pairs", watched)
    photos = sorted(corner[0].iterdir())[:2]
    store = build_features(photos, [None, None], ReadOptions(tmp_path))
    assert threads == [1]
    with closing(sqlite3.connect(store.database)) as tables:
        ((found, verified),) = tables.execute("SELECT m.rows, g.rows FROM matches m, two_view_geometries g")
    assert found >= verified > 100


@pytest.mark.parametrize("wrecked", [1, VIEWS // 2])
def test_a_wrecked_model_raises_a_warning(run, wrecked):
    pycolmap = load_pycolmap()
    (store,) = run[2].glob("features-*")
    model = pycolmap.Reconstruction(store / "model")
    assert consistency.model_warnings([model], store / "database.db", VIEWS) == []
    half_turn = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.diag([-1.0, -1.0, 1.0])), np.zeros(3))
    for image in sorted(model.images.values(), key=lambda image: image.name)[-wrecked:]:
        frame = model.frames[image.frame_id]
        frame.rig_from_world = pycolmap.Rigid3d((frame.rig_from_world.matrix() @ matrix_4x4(half_turn))[:3])
    warnings = consistency.model_warnings([model], store / "database.db", VIEWS)
    assert len(warnings) == 1 and "folded" in warnings[0]


def test_photos_that_are_registered_at_once_take_no_further_step(run):
    scene, _, workdir = run
    assert "steps" not in scene.report and scene.report["notes"] == []
    (store,) = workdir.glob("features-*")
    assert {path.name for path in store.iterdir()} == {"database.db", "facts.json", "model", "pairs.txt", "photos"}


def lacking(monkeypatch, photos):
    """From here on the first way to map lacks the last photos."""

    def some(*args, **rest):
        models, contradicted = map_photos(*args, **rest)
        take_out(models[0], set(sorted(models[0].reg_image_ids())[-photos:]))
        return models, contradicted

    map_photos = reconstruct.map_photos
    monkeypatch.setattr(reconstruct, "map_photos", some)


def test_a_model_without_points_is_refused(tmp_path, monkeypatch):
    """As of a flat picture along which the camera moved: training would start from no Gaussians."""
    model = load_pycolmap().Reconstruction()
    found = SimpleNamespace(models=[model], contradicted=set(), registered=frozenset(range(5)))
    monkeypatch.setattr(reconstruct, "_at_once", lambda *_: found)
    store, chosen = SimpleNamespace(folder=tmp_path, facts={"seconds": {}}), PhotoSet([tmp_path] * 5)
    with pytest.raises(InputError, match="photos: 5 of the 5 photos could be registered, in a model without points;"):
        reconstruct._map(store, chosen, tmp_path / "photos", ReadOptions(tmp_path))


def test_photos_left_out_are_added_and_an_interrupted_call_goes_on(corner, tmp_path, monkeypatch):
    lacking(monkeypatch, 3)
    whole = load_scene(corner[0], ReadOptions(tmp_path / "whole"))
    assert whole.report["registered"] == VIEWS and not whole.report["left_out"]
    assert [(step["step"], step["registered"]) for step in whole.report["steps"]] == [
        ("at once", VIEWS - 3),
        ("more features", VIEWS),
    ]
    assert whole.report["notes"] == [f"poses: {VIEWS - 3} of {VIEWS} photos registered at once; more features added 3"]
    center, turned = errors(whole, corner[1])
    assert center < 0.02 and turned < 0.5

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        stopped.setattr(Escalation, "_grow", stop)
        load_scene(corner[0], ReadOptions(tmp_path / "parts"))
    for name in ("extract", "match"):
        monkeypatch.setattr(escalation, name, None)
    monkeypatch.setattr(reconstruct, "map_photos", None)
    parts = load_scene(corner[0], ReadOptions(tmp_path / "parts"))
    for a, b in zip(whole.views, parts.views, strict=True):
        np.testing.assert_array_equal(a.camera_from_world, b.camera_from_world)
    (store,) = (tmp_path / "parts").glob("features-*")
    assert not (store / escalation.MORE).exists() and not (store / reconstruct.AT_ONCE).exists()


def matrix_4x4(transform):
    return np.vstack([transform.matrix(), [0, 0, 0, 1]])


def test_contradictions_count_when_stronger_than_every_chain():
    chain = [Pair(0, 1, 100, 1.0), Pair(1, 2, 60, 0.9)]
    assert consistency.stronger_contradictions([*chain, Pair(0, 2, 50, 0.0)]) == []
    assert consistency.stronger_contradictions([*chain, Pair(0, 2, 70, 0.1)]) == [Pair(0, 2, 70, 0.1)]
    assert consistency.stronger_contradictions([*chain, Pair(0, 2, 60, 0.1)]) == []  # equally strong
    assert consistency.outvoted_photos([*chain, Pair(0, 2, 70, 0.1)]) == {2}


@pytest.mark.parametrize(
    ("count", "wrong", "told"), [(400, 2, False), (400, 3, True), (9000, 4, False), (9000, 5, True)]
)
def test_a_few_strong_contradictions_are_enough_also_in_a_large_place(count, wrong, told):
    chain = [Pair(i, i + 1, 100, 1.0) for i in range(count - wrong)]
    assert consistency.is_contradicted([*chain, *(Pair(i, i + 50, 200, 0.0) for i in range(wrong))]) is told


def test_photos_with_few_features_are_upsampled(corner, tmp_path, monkeypatch):
    names = sorted(corner[1])[:3]
    count = {}
    for least in (0, 10_000):
        monkeypatch.setattr(features, "MIN_FEATURES", least)
        database = tmp_path / f"{least}.db"
        photos = [corner[0] / name for name in names]
        groups = features.import_photos(database, corner[0], photos, names, [None] * 3)
        features.extract(database, corner[0], groups, Told())
        db = load_pycolmap().Database.open(database)
        assert db.num_cameras() == 1 and db.num_images() == 3
        count[least] = db.num_keypoints()
        db.close()
    assert count[10_000] > 1.5 * count[0] > 0


def test_equal_posters_do_not_fold_the_tabletop(tmp_path):
    data = os.environ.get("PERCEPTION_DATA")
    if not data:
        pytest.skip("PERCEPTION_DATA is not set")
    root = Path(data) / "tabletop_a"
    (tmp_path / "photos").mkdir()
    frames = sorted(json.loads((root / "transforms.json").read_text())["frames"], key=lambda f: f["file_path"])[:36]
    truth = {}
    for frame in frames:
        name = Path(frame["file_path"]).name
        (tmp_path / "photos" / name).symlink_to(root / "images" / name)
        truth[name] = inverse_se3(np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1]))
    scene = load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work"))
    assert len(scene.views) == 36 and not scene.report["warnings"]
    center, turned = errors(scene, truth)
    assert center < 0.08 and turned < 1.5


@pytest.mark.slow
def test_two_places_are_told_apart(tmp_path):
    data = os.environ.get("PERCEPTION_DATA")
    if not data:
        pytest.skip("PERCEPTION_DATA is not set")
    (tmp_path / "photos").mkdir()
    for place, most in (("fox_480", 12), ("tabletop_a", 8)):
        for photo in sorted((Path(data) / place / "images").iterdir())[:most]:
            (tmp_path / "photos" / f"{place}-{photo.name}").symlink_to(photo)
    scene = load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work"))
    assert scene.report["models"] == [12, 8]
    assert any("2 unconnected models (12, 8); the largest is mapped" in told for told in scene.report["warnings"])
    assert {view.name.partition("-")[0] for view in scene.views} == {"fox_480"}
    assert {entry["name"].partition("-")[0] for entry in scene.report["left_out"]} == {"tabletop_a"}
