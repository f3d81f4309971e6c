"""Places, filters and frames of a loaded map against brute force over all Gaussians."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import perception
from perception.errors import InputError
from perception.map.write import Map, read_map, set_labels, write_map
from perception.query import Frame, QueryMap, Where, axis_box, load_map
from perception.query.floor_grid import floor_grid
from perception.query.robot_pose import where_to_stand
from perception.types import OrientedBox
from support.query_maps import NAMES, encoders, write_map_of
from support.rotations import rotation_from_quaternion
from support.synthetic_map import SIGMA, grid


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write_map_of(tmp_path_factory.mktemp("space") / "a.gsmap", first_id=3, seed=1)
    set_labels(path, {4: "My Fruit"})
    return path


@pytest.fixture(scope="module")
def gmap(path: Path) -> QueryMap:
    return load_map(path, encoders)


@pytest.fixture(scope="module")
def arrays(path: Path) -> Map:
    return read_map(path)


def members(arrays: Map, number: int) -> np.ndarray:
    return arrays.means[arrays.instance_ids == number].astype(np.float64)


def similarity(rng: np.random.Generator, scale: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation_from_quaternion(rng.normal(size=4))
    matrix[:3, 3] = rng.normal(size=3) * 5
    return matrix


def test_hits_are_the_gaussians_of_their_instance(gmap: QueryMap, arrays: Map) -> None:
    hits = gmap.find()
    assert [hit.instance_id for hit in hits] == list(range(3, 12))
    for hit in hits:
        assert hit.points.dtype == np.float32 and not hit.points.flags.writeable
        assert np.array_equal(hit.points, arrays.means[arrays.instance_ids == hit.instance_id])
        assert np.allclose(hit.covariance, np.cov(hit.points.T.astype(np.float64), bias=True), atol=1e-12)
        local = (hit.points - hit.obb.center) @ hit.obb.rotation.T
        assert (np.abs(local) <= hit.obb.extent / 2 + 1e-5).all()
    assert [gmap.query(name)[0].instance_id for name in NAMES] == list(range(3, 12))
    # Texts that mean nothing here are present at the rate the score promises: one in five.
    assert 0 < sum(bool(gmap.query(f"nothing {n}")) for n in range(100)) < 40


def test_a_hit_belongs_to_its_caller(gmap: QueryMap) -> None:
    """What is written into it changes no other answer; and hits are told apart, also those of one instance."""
    first, before = gmap.get(4), gmap.get(4).to_json()
    for array in (first.centroid, first.obb.center, first.obb.rotation, first.obb.extent):
        array += 1
    assert gmap.get(4).to_json() == before != first.to_json()
    assert gmap.get(4) not in [first] and len({first, gmap.get(4)}) == 2
    assert gmap.describe(4) != gmap.describe(4)


@pytest.mark.parametrize("seed", range(6))
def test_nearest_agrees_with_brute_force(gmap: QueryMap, arrays: Map, seed: int) -> None:
    point = np.random.default_rng(seed).uniform(-2, 5, 3)
    brute = sorted((np.linalg.norm(members(arrays, k) - point, axis=1).min(), k) for k in range(3, 12))
    hits = gmap.nearest(point, 4)
    assert [hit.instance_id for hit in hits] == [k for _, k in brute[:4]]
    assert np.allclose([hit.distance for hit in hits], [d for d, _ in brute[:4]], rtol=1e-9)
    pose = np.eye(4)
    pose[:3, 3] = point
    assert gmap.nearest(pose)[0].instance_id == brute[0][1]
    assert len(gmap.nearest(point, 100)) == 9


def test_nearest_on_ties_and_inside_points(gmap: QueryMap, arrays: Map) -> None:
    for k in (3, 7, 11):
        (hit,) = gmap.nearest(members(arrays, k)[5])
        assert (hit.instance_id, hit.distance) == (k, 0.0)


@pytest.mark.parametrize("share", [0.01, 0.5, 1.0])
def test_in_box_counts_points(gmap: QueryMap, arrays: Map, share: float) -> None:
    rng = np.random.default_rng(int(100 * share))
    for _ in range(12):
        box = OrientedBox(rng.uniform(0, 2, 3), rotation_from_quaternion(rng.normal(size=4)), rng.uniform(0.1, 3, 3))
        inside = {}
        for k in range(3, 12):
            p = members(arrays, k) - box.center
            inside[k] = np.mean(
                [all(abs(row @ axis) <= e / 2 for axis, e in zip(box.rotation, box.extent, strict=True)) for row in p]
            )
        expected = [k for k, value in inside.items() if value >= share]
        assert [hit.instance_id for hit in gmap.in_box(box, share=share)] == expected
    everything = axis_box([-9, -9, -9], [9, 9, 9])
    assert len(gmap.in_box(everything, share=1.0)) == 9
    assert gmap.in_box(axis_box([5, 5, 5], [6, 6, 6]), share=0.01) == []


def test_instance_at_follows_the_points_spacing(gmap: QueryMap, arrays: Map) -> None:
    for k, center in zip(range(3, 12), grid(9), strict=True):
        hit = gmap.instance_at(center)
        assert hit is not None and hit.instance_id == k
    outside = grid(9)[4] + [0.5, 0.0, 0.0]  # midway between two balls of radius .24
    assert gmap.instance_at(outside) is None
    near = gmap.instance_at(outside, max_distance=1.0)
    gap = min(np.linalg.norm(members(arrays, k) - outside, axis=1).min() for k in range(3, 12))
    assert near is not None and near.distance is not None and np.isclose(near.distance, gap, rtol=1e-9)
    assert gmap.instance_at(outside, max_distance=gap * 0.999) is None
    assert gmap.instance_at([0, 0, 100.0]) is None


def test_an_instance_without_gaussians_has_no_distance(path: Path, tmp_path: Path) -> None:
    """Such a map is made by hand; JSON holds no infinity."""
    bare = read_map(path)
    bare.instance_ids[bare.instance_ids == 5] = -1
    bare.instances[2]["num_gaussians"] = 0
    write_map(tmp_path / "bare.gsmap", bare)
    hits = load_map(tmp_path / "bare.gsmap", encoders).find(Where(near=[0.0, 0.0, 0.0]))
    assert [hit.instance_id for hit in hits if hit.distance is None] == [5]
    assert json.loads(json.dumps([hit.to_json() for hit in hits], allow_nan=False))[2]["num_points"] == 0


def test_filters_of_size_label_and_distance(gmap: QueryMap, arrays: Map) -> None:
    longest = {k: max(gmap.get(k).obb.extent) for k in range(3, 12)}
    bound = float(np.median(list(longest.values())))
    big = [k for k, value in longest.items() if value >= bound]
    assert [hit.instance_id for hit in gmap.find(Where(min_size=bound))] == big
    assert [hit.instance_id for hit in gmap.find(Where(max_size=bound))] == [
        k for k, value in longest.items() if value <= bound
    ]
    assert [hit.instance_id for hit in gmap.find(Where(labels="my  fruit"))] == [4]
    assert gmap.find(Where(labels=["fruit"])) == []
    assert gmap.find(Where(labels=["", " "])) == []  # what has no label has none of these
    point = grid(9)[0]
    for within in (0.0, 0.9, 1.1, 9.0):
        expected = [k for k in range(3, 12) if np.linalg.norm(members(arrays, k) - point, axis=1).min() <= within]
        hits = gmap.find(Where(near=point, within=within))
        assert [hit.instance_id for hit in hits] == expected
        for hit in hits:
            assert hit.distance is not None and hit.distance <= within


def test_a_prompt_with_a_filter_looks_only_where_it_may(gmap: QueryMap) -> None:
    around = Where(region=axis_box(grid(9)[2] - 0.5, grid(9)[2] + 0.5))
    assert [hit.instance_id for hit in gmap.query("laptop", where=around)] == [5]
    assert gmap.query("mug", where=around) == []  # the mug is elsewhere, and nothing here is like it
    assert [hit.instance_id for hit in gmap.query("mug", where=around, min_score=0.0)] == [5]
    assert gmap.query("mug", where=Where(near=grid(9)[0]))[0].distance is not None
    for name in NAMES:
        free, filtered = gmap.query(name, 5), gmap.query(name, 5, where=Where())
        assert [(hit.instance_id, hit.score) for hit in free] == [(hit.instance_id, hit.score) for hit in filtered]


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_everything_in_another_frame_is_the_same_thing_moved(gmap: QueryMap, arrays: Map, scale: float) -> None:
    rng = np.random.default_rng(3)
    base_from_map = similarity(rng, scale)
    base = Frame("base", base_from_map)

    def to_base(points: np.ndarray) -> np.ndarray:
        return np.asarray(points) @ base_from_map[:3, :3].T + base_from_map[:3, 3]

    here = gmap.get(6)
    there = gmap.query("teapot", frame=base)[0]
    assert there.frame == "base" and there.instance_id == 6
    assert np.allclose(there.points, to_base(members(arrays, 6)), atol=1e-5)
    assert np.allclose(there.centroid, to_base(here.centroid))
    assert np.allclose(there.covariance, np.cov(to_base(members(arrays, 6)).T, bias=True), atol=1e-9)
    assert np.isclose(np.linalg.det(there.obb.rotation), 1) and np.allclose(there.obb.extent, scale * here.obb.extent)
    local = (there.points - there.obb.center) @ there.obb.rotation.T
    assert (np.abs(local) <= there.obb.extent / 2 + 1e-4).all()

    point = rng.uniform(-1, 3, 3)
    (mine,), (theirs,) = gmap.nearest(point), gmap.nearest(to_base(point), frame=base)
    assert mine.instance_id == theirs.instance_id and mine.distance is not None and theirs.distance is not None
    assert np.isclose(theirs.distance, scale * mine.distance)
    assert gmap.instance_at(to_base(grid(9)[4]), frame=base).instance_id == 7  # type: ignore[union-attr]
    box = OrientedBox(to_base(grid(9)[4]), (base_from_map[:3, :3] / scale).T, np.full(3, scale))
    assert [hit.instance_id for hit in gmap.in_box(box, frame=base)] == [7]
    half = Where(region=axis_box([-9, -9, -9], [9, 0.5, 9]))
    z_turn = Frame("turned", np.array([[0, -1.0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    # In the turned frame y is the map's x: the half plane y <= .5 there is x <= .5 here.
    assert [hit.instance_id for hit in gmap.find(half, frame=z_turn)] == [3, 6, 9]
    longest = np.sort([max(gmap.get(k).obb.extent) for k in range(3, 12)])
    size = Where(min_size=scale * float(longest[3] + longest[4]) / 2)
    assert len(gmap.find(size, frame=base)) == 5


def test_there_and_back_is_where_we_were(gmap: QueryMap) -> None:
    a_from_b = similarity(np.random.default_rng(5), 0.3)
    hit = gmap.get(5)
    back = hit.transformed(a_from_b, "a").transformed(np.linalg.inv(a_from_b), "map")
    assert np.allclose(back.points, hit.points, atol=1e-5) and back.frame == hit.frame
    assert np.allclose(back.covariance, hit.covariance) and np.allclose(back.obb.rotation, hit.obb.rotation)


def test_a_description_names_neighbours_by_their_gap(gmap: QueryMap, arrays: Map) -> None:
    told = gmap.describe(7).to_json()
    gaps = {}
    for k in range(3, 12):
        if k != 7:
            a, b = members(arrays, 7), members(arrays, k)
            gaps[k] = min(np.linalg.norm(b - row, axis=1).min() for row in a)
    nearest = sorted(gaps, key=lambda k: gaps[k])[:3]
    assert [entry["instance_id"] for entry in told["neighbors"]] == nearest
    assert np.allclose([entry["gap"] for entry in told["neighbors"]], [gaps[k] for k in nearest], rtol=1e-6)
    assert told["aabb"]["min"] == members(arrays, 7).min(axis=0).tolist()
    assert told["colors"][0]["name"] == "gray" and told["views"] == ["00004.jpg"]
    assert gmap.describe(4).to_json()["label"] == "My Fruit"


@pytest.mark.parametrize(
    "ask",
    [
        lambda g: g.get(99),
        lambda g: g.describe(-1),
        lambda g: g.get([1]),
        lambda g: g.describe(np.arange(3)),
        lambda g: where_to_stand(g, 0, radius="wide"),
        lambda g: where_to_stand(g, 0, distance=0),
        lambda g: floor_grid(g, None),
        lambda g: g.query(" "),
        lambda g: g.query("x" * 1_000_000),
        lambda g: g.query("mug \udcff"),  # as an argument of a command with a byte that is no UTF-8
        lambda g: g.query("mug", top_k=0),
        lambda g: g.query("mug", top_k=1.5),
        lambda g: g.query("mug", min_score=float("nan")),
        lambda g: g.query(None),
        lambda g: g.nearest([1, 2]),
        lambda g: g.nearest([1, 2, float("inf")]),
        lambda g: g.nearest("here"),
        lambda g: g.nearest([0, 0, 0], 0),
        lambda g: g.find(Where(within=1.0)),
        lambda g: g.find(Where(share=0)),
        lambda g: g.find(Where(share=None)),
        lambda g: g.find(Where(min_size=-1)),
        lambda g: g.find(Where(max_size="big")),
        lambda g: g.find(Where(labels=[3])),
        lambda g: g.find(Where(region="room")),
        lambda g: g.in_box(axis_box([1, 1, 1], [0, 2, 2])),
        lambda g: g.in_box(OrientedBox(np.zeros(3), np.diag([1, 1, -1.0]), np.ones(3))),
        lambda g: g.in_box(OrientedBox(np.zeros(3), 2 * np.eye(3), np.ones(3))),
        lambda g: g.get(3).transformed(np.diag([1, 1, -1, 1.0])),
        lambda g: g.get(3).transformed(np.diag([1, 2, 1, 1.0])),
        lambda g: g.get(3).transformed(np.eye(3)),
        lambda g: g.get(3).transformed(np.full((4, 4), np.nan)),
        lambda g: g.get(3, frame=Frame("a", np.zeros((4, 4)))),
        lambda g: g.get(3, frame="base_link"),
        lambda g: g.query("mug", frame=np.eye(4)),
        lambda g: g.query("mug", where={"labels": ["mug"]}),
        lambda g: g.nearest([0, 0, 0], 1.5),
        lambda g: g.nearest([0, 0, 0], frame="base_link"),
        lambda g: g.instance_at([0, 0, 0], max_distance=float("nan")),
        lambda g: g.instance_at([0, 0, 0], max_distance=-1),
        lambda g: g.in_box(None),  # not all instances
        lambda g: g.find(Where(labels=3)),
        lambda g: g.gone("mug", top_k=0),
        lambda g: Frame(3, np.eye(4)),
    ],
)
def test_bad_questions_are_told_in_one_line(gmap: QueryMap, ask) -> None:
    with pytest.raises(InputError) as error:
        ask(gmap)
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


def test_a_map_without_words_still_knows_places(tmp_path: Path) -> None:
    from support.synthetic_map import write_synthetic_map

    write_synthetic_map(tmp_path / "a.gsmap", NAMES, None, gaussians=500, sh_degree=0)
    silent = perception.load_map(tmp_path / "a.gsmap")
    assert len(silent.nearest([0, 0, 0])) == 1 and silent.problem is not None
    with pytest.raises(InputError, match="no language"):
        silent.query("mug")


def test_a_map_without_instances_answers_nothing(tmp_path: Path) -> None:
    gmap = read_map(write_map_of(tmp_path / "a.gsmap", gaussians=50))
    gmap.instances, gmap.language = [], {}
    gmap.instance_ids[:] = -1
    empty = QueryMap.of(gmap)
    assert empty.query("mug") == [] and empty.nearest([0, 0, 0]) == [] and empty.instance_at([0, 0, 0]) is None
    assert empty.find() == []


def test_balls_are_as_the_generator_says(arrays: Map) -> None:
    for k, center in zip(range(3, 12), grid(9), strict=True):
        assert np.abs(members(arrays, k) - center).max() <= 3 * SIGMA + 1e-6
