"""Bundle adjustment in parts: similarities against their definition, what a part has against brute force."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import networkx as nx
import numpy as np
import pycolmap
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from perception.geometry import align_similarity, camera_centres
from perception.sfm import alignment, partition, parts
from perception.sfm.alignment import Poses, moved_pose, similarities
from perception.sfm.database import verified_matches
from perception.sfm.options import ReadOptions
from perception.tasks.engine import Engine
from support.elsewhere import Elsewhere
from support.walk import FOCAL, HEIGHT, PHOTOS, WIDTH, walk

PARTS, STEP, OVERLAP = 6, 8, 3


def ring(rng: np.random.Generator, noise: float) -> tuple[Poses, list[Poses]]:
    """Poses along a ring, and parts of it, each moved by a similarity of its own, with noise; neighbours overlap."""
    count = PARTS * STEP
    poses = {}
    for n in range(count):
        turn = Rotation.from_rotvec([0, 2 * np.pi * n / count, 0]) * Rotation.from_rotvec(rng.normal(0, 0.2, 3))
        centre = np.array([np.cos(2 * np.pi * n / count), rng.normal(0, 0.05), np.sin(2 * np.pi * n / count)]) * 5
        poses[n] = np.column_stack([turn.as_matrix(), -turn.as_matrix() @ centre])
    found = []
    for part in range(PARTS):
        photos = [n % count for n in range(part * STEP, (part + 1) * STEP + OVERLAP)]
        move = (rng.uniform(0.5, 2), Rotation.random(random_state=part).as_matrix(), rng.normal(0, 3, 3))
        own = {}
        for n in photos:
            turn = Rotation.from_rotvec(noise * rng.normal(0, 1, 3)).as_matrix()
            own[n] = moved_pose(
                move, turn @ poses[n] + noise * np.column_stack([np.zeros((3, 3)), rng.normal(0, 1, 3)])
            )
        found.append(own)
    return poses, found


def test_a_moved_pose_shows_moved_points_where_it_showed_them() -> None:
    rng = np.random.default_rng(0)
    poses, _ = ring(rng, 0)
    scale, turn, shift = 1.7, Rotation.random(random_state=0).as_matrix(), rng.normal(size=3)
    points, pose = rng.normal(size=(20, 3)), moved_pose((scale, turn, shift), poses[5])
    seen = poses[5][:, :3] @ points.T + poses[5][:, 3:]
    again = pose[:, :3] @ (scale * points @ turn.T + shift).T + pose[:, 3:]
    np.testing.assert_allclose(again, scale * seen, atol=1e-12)


def own_of(found: list[Poses]) -> list[set[int]]:
    """The first photos of each part; those after them are own ones of the next."""
    return [set(list(part)[:STEP]) for part in found]


def test_parts_without_noise_are_put_together_exactly() -> None:
    """Though a part has some photos of its neighbour in places of their own, as photos that look alike may be."""
    poses, found = ring(np.random.default_rng(1), 0)
    found[2][24] = moved_pose((1.0, np.eye(3), np.array([3.0, 0, 1])), found[2][24])
    found[4] = {**found[4], 3: np.eye(3, 4), 4: np.ones((3, 4)), 5: 2 * np.eye(3, 4)}  # three of the other side
    for part, own, similarity in zip(found, own_of(found), similarities(found, own_of(found), poses, 0), strict=True):
        for image in own:
            np.testing.assert_allclose(moved_pose(similarity, part[image]), poses[image], atol=1e-9)


def test_a_loop_is_closed_where_parts_begin_apart() -> None:
    """Each part begins turned against the one before, as parts joined one after the other are: the gap at the end of
    the loop is gone, and what is left is what the noise makes of it."""
    poses, found = ring(np.random.default_rng(2), 1e-3)
    start = {}
    for image, pose in poses.items():
        turn = Rotation.from_rotvec([0, 0.01 * (image // STEP), 0]).as_matrix()
        start[image] = moved_pose((1 + 0.01 * (image // STEP), turn, np.zeros(3)), pose)
    moves = similarities(found, own_of(found), start, 0)
    placed = {
        i: moved_pose(move, part[i]) for move, part, own in zip(moves, found, own_of(found), strict=True) for i in own
    }

    def errors(of: Poses) -> np.ndarray:
        true, got = (camera_centres(np.array([each[i] for i in sorted(poses)])) for each in (poses, of))
        scale, turn, shift = align_similarity(true, got)
        return np.linalg.norm(scale * got @ turn.T + shift - true, axis=1)

    assert errors(start).max() > 0.15 and errors(placed).max() < 0.02


def test_similarities_are_the_least_squares_that_they_say() -> None:
    """Against SciPy's solver with numerical derivatives, from the parts' ties as they fit; the first part stays."""
    poses, found = ring(np.random.default_rng(3), 1e-3)
    moves = similarities(found, own_of(found), poses, 0)
    centres = [camera_centres(np.array([poses[image] for image in part])) for part in found]
    size = float(np.median(np.concatenate([np.linalg.norm(c - c.mean(axis=0), axis=1) for c in centres])))
    rows = [{image: n for n, image in enumerate(part)} for part in found]
    pairs = [(a, (a + 1) % PARTS) for a in range(PARTS)]

    def cost(given: list[alignment.Similarity]) -> np.ndarray:
        now = []
        for move, part in zip(given, found, strict=True):
            at = [moved_pose(move, pose) for pose in part.values()]
            now.append(
                [(-p[:, :3].T @ p[:, 3])[None] + size * np.array([0 * p[0, :3], p[2, :3], p[1, :3]]) for p in at]
            )
        away = [now[a][rows[a][i]] - now[b][rows[b][i]] for a, b in pairs for i in found[a] if i in rows[b]]
        squared = (np.concatenate(away) ** 2).sum(axis=1) / (alignment.NEAR / 3 * size) ** 2
        return np.sqrt(np.log1p(squared))

    def of(x: np.ndarray) -> np.ndarray:
        rest = [
            (s * np.exp(p[6]), Rotation.from_rotvec(p[3:6]).as_matrix() @ R, t + p[:3])
            for (s, R, t), p in zip(moves[1:], x.reshape(-1, 7), strict=True)
        ]
        return cost([moves[0], *rest])

    here = np.zeros(7 * (PARTS - 1))
    least = least_squares(of, here, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert 0 < np.sum(of(here) ** 2) <= 2 * least.cost * (1 + 1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_a_part_has_the_photos_around_its_own(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Distances in the graph of matches; where there are too many photos, the nearer ones."""
    rng = np.random.default_rng(seed)
    matches = {pair: int(rng.integers(20, 99)) for pair in combinations(range(60), 2) if rng.random() < 0.06}
    own = list(range(10))
    graph = nx.Graph(matches.keys())
    graph.add_edges_from(("own", i) for i in own)
    away = {i: d - 1 for i, d in nx.single_source_shortest_path_length(graph, "own").items() if d > 1}
    away = {i: d for i, d in away.items() if i not in own and d <= parts.HOPS}
    (part,) = parts.parts_of([own], matches)
    assert part.own == own and set(part.around) == away.keys()
    monkeypatch.setattr(parts, "LARGEST", 5)
    (few,) = parts.parts_of([own], matches)
    assert few.around == part.around[:5]
    assert [away[i] for i in part.around] == sorted(away.values())


def test_points_of_parts_share_no_feature() -> None:
    """Two parts that saw the same photos: the points of the second have what the first did not use."""
    truth = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_frames_per_rig=4, num_points3D=30))
    empty = pycolmap.Reconstruction(truth)
    for point in list(empty.points3D):
        empty.delete_point3D(point)
    less = pycolmap.Reconstruction(truth)
    for point in sorted(less.points3D)[::2]:
        less.delete_point3D(point)
    for image in (1, 2):
        for point in sorted(less.points3D):
            for each in list(less.points3D[point].track.elements):
                if each.image_id == image and less.points3D[point].track.length() > 2:
                    less.delete_observation(image, each.point2D_idx)
    model = parts.with_points(empty, [less, truth])
    used = [(e.image_id, e.point2D_idx) for p in model.points3D.values() for e in p.track.elements]
    assert len(used) == len(set(used)) == truth.compute_num_observations()
    seen = {(e.image_id, e.point2D_idx): p.xyz for p in truth.points3D.values() for e in p.track.elements}
    for point in model.points3D.values():
        for each in point.track.elements:
            np.testing.assert_array_equal(point.xyz, seen[each.image_id, each.point2D_idx])


@pytest.mark.slow
def test_a_walk_adjusted_in_parts_is_the_true_one_and_the_same_on_any_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From true poses with errors that grow along the walk; all points are where features say that they are."""
    monkeypatch.setattr(partition, "LARGEST", 18)
    monkeypatch.setattr(parts, "LARGEST", 18)
    found = []
    for number, engine in enumerate([Engine(), Elsewhere()]):
        store, truth = walk(tmp_path / str(number), np.random.default_rng(0))
        counts = {pair: len(matches) for pair, matches in verified_matches(store.database).items()}
        given = parts.parts_of(partition.divide(counts, 18), counts)
        with pycolmap.Database.open(store.database) as db:
            images, (camera,) = db.read_all_images(), db.read_all_cameras()
        camera.params = [FOCAL, WIDTH / 2, HEIGHT / 2, 0]
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(camera)
        rng = np.random.default_rng(1)
        for n, image in enumerate(sorted(images, key=lambda image: image.name)):
            turn = Rotation.from_rotvec(1e-4 * n * np.ones(3) + rng.normal(0, 1e-3, 3)).as_matrix()
            pose = pycolmap.Rigid3d(np.column_stack([turn @ truth[n, :3, :3], turn @ truth[n, :3, 3] + 1e-3 * n]))
            plain = pycolmap.Image(image.name, camera_id=camera.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(plain, pose)
        options = ReadOptions(tmp_path, engine=engine)
        adjusted = parts.adjusted_in_parts(model, store, given, options)
        found.append({i: adjusted.images[i].cam_from_world().matrix() for i in sorted(adjusted.reg_image_ids())})
        assert not (store.folder / parts.FOLDER).exists()
    assert len(given) == 4 and engine.asked == [4, 4]
    assert all(np.array_equal(found[0][image], found[1][image]) for image in found[0])
    centres = camera_centres(np.array(list(found[0].values())))
    true = camera_centres(truth)
    scale, turn, shift = align_similarity(true, centres)
    away = np.linalg.norm(scale * centres @ turn.T + shift - true, axis=1)
    assert len(found[0]) == PHOTOS and np.median(away) < 0.01 and away.max() < 0.03
    assert adjusted.compute_mean_reprojection_error() < 0.4  # of a noise of .3 px along either axis
    assert adjusted.compute_mean_track_length() > 5
