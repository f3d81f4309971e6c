"""More effort for photos that are left out at once: made matches with exact truth, repeated parts among them."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from perception.geometry import align_similarity
from perception.sfm import features
from perception.sfm.consistency import Pair, consistent_photos, stronger_contradictions
from perception.sfm.database import FeatureStore
from perception.sfm.escalation import MORE, Candidate, Escalation, _loose
from perception.sfm.features import QUICK, THOROUGH, Effort
from perception.sfm.incremental import map_photos, pipeline_options
from perception.sfm.options import ReadOptions
from support.aimed import look_at
from support.progress import Told

PHOTOS, WIDTH, HEIGHT, FOCAL, NOISE = 14, 640, 480, 500.0, 0.3
STEP, THING = 12, 150
"""Degrees between two cameras; points of a thing that is there twice."""
LATE = {10, 11, 12, 13}
"""Photos that have no matches at once."""


class Room:
    """Cameras in an arc around points; `seen[i]` are the points of photo i and its pixels, with NOISE.
    The last THING points repeat the THING before them, turned by ten steps of the cameras."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        points = rng.uniform([-3, -3, 0], [3, 3, 2], (700, 3))
        points[-2 * THING : -THING] = rng.uniform([1, -1.5, 0], [2.5, 1.5, 1.5], (THING, 3))
        points[-THING:] = points[-2 * THING : -THING] @ Rotation.from_euler("z", 10 * STEP, degrees=True).as_matrix().T
        self.centres, self.seen = [], []
        for number in range(PHOTOS):
            angle = np.radians(STEP * number)
            eye = np.array([6 * np.cos(angle), 6 * np.sin(angle), 1.5 + 0.4 * np.sin(2 * number)])
            pose = look_at(eye, np.array([0, 0, 0.8]), np.array([0, 0, 1.0]))
            x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
            pixels = np.stack([FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2], axis=1)
            inside = (pixels > 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1) & (rng.random(700) < 0.5)
            self.seen.append((np.flatnonzero(inside), pixels[inside] + rng.normal(0, NOISE, (inside.sum(), 2))))
            self.centres.append(eye)

    def store(self, folder: Path, effort: Effort, linked: Any, alike: bool = False) -> FeatureStore:
        """The matches of the share linked(i, j) of the common points of each pair. alike: if there are few, those of
        the thing in the early photos with its repetition in the LATE ones."""
        (folder / "photos").mkdir(parents=True)
        photos = [folder / "photos" / f"{number:06}.png" for number in range(PHOTOS)]
        for number, photo in enumerate(photos):
            Image.new("RGB", (WIDTH, HEIGHT), (number, 100, 100)).save(photo)
        names = [photo.name for photo in photos]
        features.import_photos(folder / "database.db", folder / "photos", photos, names, [None] * PHOTOS)
        db = pycolmap.Database.open(folder / "database.db")
        ids = [db.read_image_with_name(name).image_id for name in names]
        for image, (_, pixels) in zip(ids, self.seen, strict=True):
            db.write_keypoints(image, np.concatenate([pixels, np.ones((len(pixels), 4))], axis=1).astype(np.float32))
        for i, j in combinations(range(PHOTOS), 2):
            _, a, b = np.intersect1d(self.seen[i][0], self.seen[j][0], return_indices=True)
            found = np.stack([a, b], axis=1)[: int(linked(i, j) * len(a))]
            if alike and i < 4 and j in LATE:
                _, a, b = np.intersect1d(self.seen[i][0] + THING, self.seen[j][0], return_indices=True)
                thing = self.seen[j][0][b] >= 700 - THING
                found = np.stack([a, b], axis=1)[thing]
            if len(found) >= effort.inliers:
                geometry = pycolmap.TwoViewGeometry(config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
                geometry.inlier_matches = found.astype(np.uint32)
                db.write_two_view_geometry(ids[i], ids[j], geometry)
        db.close()
        return FeatureStore(folder, folder / "photos", names, {"pairs_matched": 0}, effort)

    def wrong(self, found: Candidate) -> int:
        """Number of registered photos that are off by more than 3 % of the arc's radius, after a similarity of the
        photos that are not LATE."""
        model = found.models[0]
        where = {int(model.images[i].name[:6]): model.images[i].projection_center() for i in model.reg_image_ids()}
        early = sorted(set(where) - LATE)
        scale, turn, shift = align_similarity(
            np.array([self.centres[i] for i in early]), np.array([where[i] for i in early])
        )
        away = {i: np.linalg.norm(scale * turn @ centre + shift - self.centres[i]) for i, centre in where.items()}
        return sum(each > 0.03 * 6 for each in away.values())


def escalated(
    room: Room, folder: Path, monkeypatch: pytest.MonkeyPatch, linked: Any, alike: bool = False
) -> tuple[Candidate, Candidate, list[dict[str, Any]], Told]:
    """What is registered at once, where LATE photos have no matches, and in the end; the steps; what was said."""
    told = Told()
    early = room.store(folder / "early", QUICK, lambda i, j: not {i, j} & LATE and j - i < 5)
    more = room.store(folder / "early" / MORE, THOROUGH, linked, alike)
    monkeypatch.setattr(Escalation, "_more_features", lambda self: more)
    first = Candidate(*map_photos(early, pipeline_options(False, 0, True), PHOTOS, told), early)
    best, steps = Escalation(first, [], ReadOptions(folder, progress=told)).run()
    return first, best, steps, told


@pytest.mark.slow
def test_more_matches_add_the_photos_that_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for number in range(2):
        room = Room()
        first, best, steps, told = escalated(room, tmp_path / str(number), monkeypatch, lambda i, j: j - i < 5)
        assert len(first.registered) == PHOTOS - len(LATE) and len(best.registered) == PHOTOS
        assert room.wrong(first) == room.wrong(best) == 0
        assert [(step["step"], step["registered"]) for step in steps] == [("at once", 10), ("more features", 14)]
        assert told.lines == ["poses: 10 of 14 photos registered; more features is next"]
        model = best.models[0]
        found.append({i: model.images[i].cam_from_world().matrix().tobytes() for i in best.registered})
    assert found[0] == found[1]


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.25, 1.0])
def test_photos_that_a_repeated_thing_puts_elsewhere_are_not_added_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    """Without the checks all four are added, near the first ones."""

    def linked(i: int, j: int) -> float:
        return (share if i not in LATE and j in LATE else 1.0) * (j - i < 5)

    room = Room()
    first, best, *_ = escalated(room, tmp_path, monkeypatch, linked, alike=True)
    assert len(first.registered) == 10 and len(best.registered) >= 10
    assert room.wrong(best) == 0 and not best.folded


@pytest.mark.slow
def test_photos_without_matches_cost_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = escalated(Room(), tmp_path, monkeypatch, lambda i, j: j - i < 5 and not {i, j} & LATE)
    first, best, steps, _ = found
    assert [step["step"] for step in steps] == ["at once", "more features"]
    assert best is first


@pytest.mark.parametrize("blank", [PHOTOS, PHOTOS - 1])
def test_photos_without_features_cost_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blank: int) -> None:
    room, asked = Room(), []
    for number in range(blank):
        room.seen[number] = tuple(each[: features.FEW_FEATURES - 1] for each in room.seen[number])
    store = room.store(tmp_path / "early", QUICK, lambda i, j: False)
    more = room.store(tmp_path / "early" / MORE, THOROUGH, lambda i, j: False)
    monkeypatch.setattr(Escalation, "_more_features", lambda self: asked.append(self._left_out()) or more)
    _, steps = Escalation(Candidate([], set(), store), [], ReadOptions(tmp_path, progress=Told())).run()
    assert asked == [list(range(blank, PHOTOS))] * (blank < PHOTOS)
    assert [step["step"] for step in steps] == ["at once", "more features"][: 1 + len(asked)]


@pytest.mark.slow
def test_a_scene_is_mapped_anew_where_nothing_is_registered_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = Room()
    more = room.store(tmp_path / MORE, THOROUGH, lambda i, j: j - i < 5)
    monkeypatch.setattr(Escalation, "_more_features", lambda self: more)
    none = Candidate([], set(), FeatureStore(more.folder, more.image_root, more.names, {}))
    best, steps = Escalation(none, [], ReadOptions(tmp_path, progress=Told())).run()
    assert [step["step"] for step in steps] == ["at once", "more features", "mapping anew"]
    assert len(best.registered) == PHOTOS and room.wrong(best) == 0


@pytest.mark.parametrize("seed", range(20))
def test_no_stronger_contradiction_is_left_between_consistent_photos(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = [
        Pair(i, j, int(rng.integers(15, 300)), float(rng.random() < 0.8))
        for i, j in combinations(range(12), 2)
        if rng.random() < 0.6
    ]
    kept = consistent_photos(pairs)
    inside = [pair for pair in pairs if {pair.i, pair.j} <= kept]
    assert stronger_contradictions(inside) == []
    for photo in kept:
        mine = [pair.agrees for pair in inside if photo in (pair.i, pair.j)]
        assert sum(mine) > len(mine) / 2


def test_the_larger_side_of_a_fold_is_kept() -> None:
    one = [Pair(i, j, 100, 1.0) for i, j in combinations(range(6), 2)]
    other = [Pair(i, j, 200, 1.0) for i, j in combinations(range(6, 10), 2)]
    fold = [Pair(5, 6, 80, 0.0), Pair(4, 7, 50, 1.0), Pair(3, 8, 40, 1.0)]
    assert consistent_photos([*one, *other, *fold]) == set(range(6))
    assert consistent_photos([*one, *other, *fold[1:]]) == set(range(10))
    lost = [Pair(0, 10, 300, 1.0), Pair(1, 10, 30, 0.0), Pair(2, 10, 20, 0.0)]  # more photos contradict it
    assert consistent_photos([*one, *lost]) == set(range(6))
    assert consistent_photos([]) == set()


@pytest.mark.parametrize(("points", "loose"), [(29, {1, 2, 3, 4}), (30, set())])
def test_photos_are_loose_that_share_few_points_with_two_others(points: int, loose: set[int]) -> None:
    """pycolmap itself places no photo by fewer than 30 points."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 4
    options.num_points3D = points  # each seen by all four photos
    model = pycolmap.synthesize_dataset(options)
    assert _loose(model) == loose


def test_a_photo_that_only_two_others_hold_is_loose() -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 6
    options.num_points3D = 80
    model = pycolmap.synthesize_dataset(options)
    assert _loose(model) == set()
    numbers, gone = sorted(model.points3D), {2: (4, 5, 6), 1: (1,)}  # half are seen by 1, 2, 3, the others by 2 to 6
    for number, images in [(n, gone[2] if k < 40 else gone[1]) for k, n in enumerate(numbers)]:
        seen = [(each.image_id, each.point2D_idx) for each in model.points3D[number].track.elements]
        for image, index in [each for each in seen if each[0] in images]:
            model.delete_observation(image, index)
    assert _loose(model) == {1}
