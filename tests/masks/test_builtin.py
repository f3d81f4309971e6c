"""The built-in segmentation of whole scenes, on surfaces whose depth, normals and parts are known exactly."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perception.errors import InputError
from perception.geometry import move_points
from perception.masks import compute_masks, load_labels, make_source
from perception.masks import surface as surface_module
from perception.masks.builtin import BuiltinSegmentation, fuse, labels_of, surface_graphs
from perception.masks.cues import depth_cues, photo_cues
from perception.masks.merge_features import PAIR_FEATURES, pair_features
from perception.masks.merging import (
    REGION_COLUMNS,
    MergeTree,
    _with_relatives,
    divided,
    read_model,
    segmentation,
    tree_by,
)
from perception.masks.stereo import (
    StereoView,
    choose_neighbours,
    confirmed,
    homographies,
    make_stereo_view,
    measure_depths,
    plane_depths,
)
from perception.masks.surface import Surface, SurfaceBuilder, pack_voxels, unpack_voxels, voxel_keys
from perception.masks.surface_graph import CONTACT, DEPTH, PIXELS, VOXELS, SurfaceGraph, neighbours, voxel_edges
from perception.types import DepthImage, View
from support.mask_scores import best_ious, leaf_sums

K = np.array([[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]])
LOW, HIGH = np.array([-0.3, 1.0, 0.0]), np.array([0.3, 1.5, 0.45])  # the box
WALL = 2.4  # y of the wall; the floor is z = 0
EYES = [
    (x, y, z) for z in (0.9, 1.15) for x, y in ((-0.5, -0.25), (-0.25, 0.0), (0.0, -0.1), (0.25, 0.0), (0.5, -0.25))
]


@pytest.fixture(autouse=True)
def matched_as_they_are(monkeypatch):
    """The photos are small; making them larger for stereo would only cost time."""
    monkeypatch.setattr("perception.masks.stereo.SIDE", 160)


def camera_from_world(eye: np.ndarray) -> np.ndarray:
    """A camera at `eye` that looks at the box, z up."""
    forward = np.array([0.0, 1.4, 0.2]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose


def cast(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z-depth [120, 160], ids (1 floor, 2 wall, 3 box) and world points [120, 160, 3] by ray casting."""
    y, x = np.mgrid[:120, :160] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1) @ pose[:3, :3]
    eye = -pose[:3, :3].T @ pose[:3, 3]
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        wall = (WALL - eye[1]) / rays[..., 1]
        sides = np.stack([(LOW - eye) / rays, (HIGH - eye) / rays])
    enter, leave = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    depths = np.stack([floor, wall, np.where((enter < leave) & (enter > 0), enter, np.inf)])
    z = depths.min(axis=0)
    return z, depths.argmin(axis=0) + 1, eye + rays * z[..., None]


def painted(points: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Photo [h, w, 3] uint8: a speckle fixed to the surface, and for each part a tint of its own."""
    waves = np.random.default_rng(5).normal(0, 1, (40, 3)) * np.geomspace(15, 110, 40)[:, None]
    speckle = np.cos(points @ waves.T + np.arange(40)).sum(axis=-1) * 6
    tint = np.array([[0, 0, 0], [150, 140, 120], [120, 140, 150], [150, 90, 80]])[ids]
    return (tint + speckle[..., None]).clip(0, 255).astype(np.uint8)


@functools.cache
def world() -> list[tuple[View, np.ndarray, np.ndarray, np.ndarray]]:
    """(view, photo, depth, ids) of ten photos of a speckled box before a wall, on a floor."""
    photos = []
    for i, eye in enumerate(EYES):
        pose = camera_from_world(np.array(eye))
        depth, ids, points = cast(pose)
        photos.append((View(f"{i}.jpg", Path(f"{i}.jpg"), K, 160, 120, pose), painted(points, ids), depth, ids))
    return photos


def rough(depth: np.ndarray, seed: int) -> np.ndarray:
    """A depth that is wrong by 8 % everywhere, in waves."""
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    return depth * (1 + 0.08 * np.sign(np.sin(x / 7 + seed) * np.cos(y / 9)))


def stereo_views() -> list[StereoView]:
    made = [make_stereo_view(view, photo, rough(depth, i)) for i, (view, photo, depth, _) in enumerate(world())]
    return [shown for shown in made if shown is not None]


def test_borders_of_labels_are_those_of_the_photo():
    """A disc whose labels come in blocks of four pixels, and reach too far where no photo confirms the depth."""
    y, x = np.mgrid[:96, :128]
    distance = np.hypot(y - 44.3, x - 60.7)
    truth = np.where(distance < 25, 2, 1)
    truth[8:12, 8:40] = 3  # so thin that nothing of it is far from its border
    tint = np.array([(60, 90, 130), (150, 60, 50), (200, 200, 60)])[truth - 1]
    photo = (tint + np.random.default_rng(0).integers(0, 12, tint.shape)).astype(np.uint8)
    rough = np.kron(truth[2::4, 2::4], np.ones((4, 4), np.int64))
    far = (distance < 32) & (x > 60)
    rough[far] = 2
    blank = np.zeros(truth.shape)
    view = StereoView("a", photo, photo[..., 0], K, np.eye(4), blank, blank, blank, ~far)
    view.voxel, view.learned = np.where(far, -1, rough).astype(np.int32), np.full((3, 96, 128), -9, np.float16)
    labels = labels_of(view, np.arange(4))
    assert labels.dtype == np.int32
    assert np.mean(rough != truth) > 0.05
    assert np.mean(labels != truth) < 0.005
    assert np.mean(labels[truth == 3] == 3) > 0.95
    view.voxel[:] = -1
    assert not labels_of(view, np.arange(4)).any()


@pytest.mark.slow
def test_stereo_finds_the_depth_that_the_map_has_wrong():
    found = stereo_views()
    measure_depths(found)
    errors, sure = [], []
    for shown, (_, _, depth, _) in zip(found, world(), strict=True):
        error = np.abs(shown.depth / depth - 1)
        errors.append(error[shown.confirmed])
        sure.append(shown.confirmed.mean())
    error = np.concatenate(errors)
    assert np.mean(sure) > 0.6
    assert np.median(error) < 0.01 and np.quantile(error, 0.9) < 0.03  # it began at 0.08


def test_measured_depth_is_confirmed_without_stereo(monkeypatch):
    """Sensors with noise of 1 %: no photo is swept, and the mean over the views that agree is nearer than each."""
    monkeypatch.setattr("perception.masks.stereo.sweep", lambda *_: pytest.fail("a measured photo was swept"))
    rng, found = np.random.default_rng(0), []
    for view, photo, depth, _ in world():
        noisy = depth * rng.normal(1, 0.01, depth.shape)
        found.append(make_stereo_view(replace(view, depth=DepthImage(Path("d.png"), 1)), photo, noisy))
    measure_depths(found)
    errors = [
        np.abs(shown.depth / depth - 1)[shown.confirmed] for shown, (_, _, depth, _) in zip(found, world(), strict=True)
    ]
    assert np.mean([shown.confirmed.mean() for shown in found]) > 0.8
    assert np.median(np.concatenate(errors)) < 0.0067 / 2  # 0.0067 is the median of one; at least 4 are averaged


def test_a_photo_of_which_stereo_sees_no_depth_is_not_used():
    """At half the size only pixels of odd rows are seen."""
    photo, depth = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640))
    depth[1::2] = 2
    view = View("a.jpg", Path("a.jpg"), K, 640, 480, np.eye(4))
    assert make_stereo_view(view, photo, depth) is None
    made = make_stereo_view(view, photo, np.roll(depth, 1, axis=0))
    assert made is not None and (made.prior == 2).all()


def bare_view(pose: np.ndarray) -> StereoView:
    """A camera without a photo."""
    none = np.zeros((120, 160), np.float32)
    return StereoView("", none, none, K, pose, none, none, none, none > 0)


def test_homography_carries_points_of_its_plane():
    a, b = (np.array(EYES[i]) for i in (0, 3))
    eyes = [bare_view(camera_from_world(e)) for e in (a, b)]
    still, moving = homographies(*eyes)
    pixel, z = np.array([33.5, 71.5, 1.0]), 1.7
    local = np.linalg.inv(K) @ pixel * z
    world_point = eyes[0].camera_from_world[:3, :3].T @ (local - eyes[0].camera_from_world[:3, 3])
    seen = K @ (eyes[1].camera_from_world[:3, :3] @ world_point + eyes[1].camera_from_world[:3, 3])
    carried = (still + moving / z) @ (pixel - [0.5, 0.5, 0])
    np.testing.assert_allclose(carried[:2] / carried[2] + 0.5, seen[:2] / seen[2])


def test_depths_confirm_each_other_only_where_they_agree():
    view, _, depth, _ = world()[2]
    other, _, theirs, _ = world()[3]
    eyes = [bare_view(v.camera_from_world) for v in (view, other)]
    count, mean = confirmed(depth, eyes[0], eyes[1:], [theirs])
    assert count.max() == 1 and count.mean() > 0.8
    np.testing.assert_allclose(mean[count == 1], depth[count == 1], rtol=0.031)
    assert confirmed(depth * 1.2, eyes[0], eyes[1:], [theirs])[0].mean() < 0.1


def test_a_photo_of_which_no_point_of_the_grid_has_depth_is_matched_with_none():
    """Lines of a laser may miss the grid; a photo was then matched with itself, which confirms every depth."""
    views = true_views()[:4]
    lines = np.zeros_like(views[0].prior)
    lines[::16] = views[0].prior[::16]
    assert (lines > 0).mean() > 0.05
    first, *others = choose_neighbours([replace(views[0], prior=lines), *views[1:]])
    assert first == [] and all(others)


def test_neighbours_are_those_of_the_greedy_choice_written_out():
    """Point by point: the sum of the usefulness of each point's best two photos grows most with every photo chosen."""
    rng = np.random.default_rng(0)
    views = true_views()
    for view in list(views):  # some elsewhere, turned about their own y axis
        c, s = np.cos(turn := rng.uniform(0, 2 * np.pi)), np.sin(turn)
        pose = np.eye(4)
        pose[:3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ view.camera_from_world[:3]
        pose[:3, 3] += rng.normal(0, 1, 3)
        views.append(replace(view, camera_from_world=pose, prior=view.prior * rng.uniform(0.5, 2)))
    expected = []
    for i, view in enumerate(views):
        points = [
            np.linalg.inv(view.camera_from_world) @ [*(z * (np.linalg.inv(view.K) @ [x + 0.5, y + 0.5, 1])), 1]
            for y in range(12, view.prior.shape[0], 24)
            for x in range(12, view.prior.shape[1], 24)
            if (z := view.prior[y, x]) > 0
        ]
        useful = np.array([[0 if j == i else useful_at(p[:3], view, v) for p in points] for j, v in enumerate(views)])
        near: list[int] = []
        while len(near) < 6:
            sums = [np.sort(useful[[*near, j]], axis=0)[-2:].sum() / len(points) for j in range(len(views))]
            sums = [-1.0 if j in near else value for j, value in enumerate(sums)]
            before = np.sort(useful[near], axis=0)[-2:].sum() / len(points)
            if max(sums) - before < 1e-3:
                break
            near.append(int(np.argmax(sums)))
        expected.append(near)
    assert choose_neighbours(views) == expected
    assert len({len(near) for near in expected}) > 1


def useful_at(point: np.ndarray, view: StereoView, other: StereoView) -> float:
    x, y, z = other.K @ (other.camera_from_world @ [*point, 1])[:3]
    if z <= 0 or not (0 < x / z < other.grey.shape[1] and 0 < y / z < other.grey.shape[0]):
        return 0.0
    a, b = point - view.center, point - other.center
    far, near = (float(np.linalg.norm(ray)) for ray in (a, b))
    angle = math.degrees(math.acos(min(1.0, a @ b / far / near)))
    return min(far / near, near / far) * math.exp(-(((angle - 12) / (5 if angle < 12 else 10)) ** 2) / 2)


def test_planes_cover_the_depths_known():
    inverse = plane_depths(np.array([[0.0, 1.0], [2.0, 4.0]]))
    assert 1 / inverse[0] < 1 and 1 / inverse[-1] > 4 and (np.diff(inverse) < 0).all()


def test_voxel_keys_tell_voxels_apart():
    points = np.random.default_rng(0).normal(0, 3, (500, 3))
    cells = np.floor(points / 0.25).astype(np.int64)
    keys = voxel_keys(points, 0.25)
    np.testing.assert_array_equal(unpack_voxels(keys), cells)
    np.testing.assert_array_equal(pack_voxels(cells), keys)
    assert len(np.unique(keys)) == len(np.unique(cells, axis=0))


def true_views() -> list[StereoView]:
    """As stereo_views(), but with true depth."""
    made = [make_stereo_view(view, photo, depth) for view, photo, depth, _ in world()]
    return [shown for shown in made if shown is not None]


def test_fused_surface_lies_on_the_parts():
    (surface,) = fuse(true_views())
    p = surface.points.astype(float)
    outside = np.maximum(np.maximum(LOW - p, p - HIGH), 0)
    within = np.minimum(p - LOW, HIGH - p).min(axis=1)
    box = np.where(within > 0, within, np.linalg.norm(outside, axis=1))
    distance = np.minimum(np.minimum(np.abs(p[:, 2]), np.abs(p[:, 1] - WALL)), box)
    assert np.quantile(distance, 0.95) < surface.size
    floor = (np.abs(p[:, 2]) < 0.01) & (box > 0.1) & (p[:, 1] < WALL - 0.1)
    assert (surface.normals[floor] @ [0, 0, 1] > 0.98).mean() > 0.95
    np.testing.assert_array_equal(surface.voxel_of(p[:50]), np.arange(50))
    assert surface.voxel_of(np.array([[50.0, 50, 50]])).tolist() == [-1]


def test_merging_patches_keeps_the_evidence_exact():
    """After merging, all sums equal those of a graph built from the merged patches; contacts, which no photo shows at
    some borders, those of the borders that are shown. A photo may show patches side by side that do not touch, which
    counts only once they are parts of ones that do: their borders are left out."""
    seen = true_views()[:3]
    (surface,) = fuse(seen)
    edges = voxel_edges(surface)
    (first,) = surface_graphs(seen, [surface])

    def graph_of(patch: np.ndarray) -> SurfaceGraph:
        graph = SurfaceGraph(surface, patch, edges)
        for shown in seen:
            photo, depth = shown.cues()
            voxel = surface.voxel_of(move_points(shown.world_from_camera, depth.points.astype(float)))
            regions = np.where(voxel >= 0, patch[voxel], -1)
            graph.add(*graph.evidence(regions, photo, depth, shown.learned.astype(np.float32)))
        graph.link()
        return graph

    apart = np.zeros((first.count, first.count), bool)
    for shown in seen:
        patch_of = np.where(shown.voxel >= 0, first.patch[shown.voxel], -1)
        for one, two in (neighbours(patch_of, 0), neighbours(patch_of, 1)):
            known = (one >= 0) & (two >= 0) & (one != two)
            apart[one[known], two[known]] = apart[two[known], one[known]] = True
    for a, links in enumerate(first.borders):
        apart[a, list(links)] = False
    contacts = np.array(
        [[links[b][CONTACT] if b in links else 0 for b in range(first.count)] for links in first.borders]
    )
    rng, patch, into = np.random.default_rng(1), first.patch.copy(), np.arange(first.count)
    for _ in range(first.count // 2):
        a = int(rng.choice([i for i in range(first.count) if first.borders[i]]))
        b = int(rng.choice(list(first.borders[a])))
        first.merge(a, b)
        patch[patch == b] = into[into == b] = a
    kept, dense = np.unique(patch, return_inverse=True)
    fresh = graph_of(dense.astype(np.int32))
    np.testing.assert_allclose(first.sums[kept], fresh.sums, atol=1e-6)
    compared = 0
    for i, a in enumerate(kept):
        for j in fresh.borders[i]:
            if apart[into == a][:, into == kept[j]].any():
                continue
            old, new = (pair_features(g, np.array([pair]))[0] for g, pair in ((first, (a, kept[j])), (fresh, (i, j))))
            of_contacts = [PAIR_FEATURES.index(name) for name in ("contact_share", "contact")]
            np.testing.assert_allclose(np.delete(old, of_contacts), np.delete(new, of_contacts), atol=1e-6)
            assert first.borders[a][kept[j]][CONTACT] == contacts[into == a][:, into == kept[j]].sum()
            compared += 1
    assert compared > 3


def test_things_that_nowhere_touch_are_segments_although_photos_show_them_side_by_side():
    """A board before a wall, each of one colour: no pair of patches has a border."""
    side, points = 0.05, np.mgrid[:20, :20, :1].reshape(3, -1).T * 0.05
    points = np.concatenate([points, points + np.array([1, 0, 2])])
    keys = voxel_keys(points, side)
    order, count = np.argsort(keys), len(points)
    normals, lab = np.tile([0, 0, -1.0], (count, 1)), np.full((count, 3), 100.0)
    surface = Surface(side, 0.0, keys[order], np.ones(count), points[order], normals, lab, np.zeros(count))
    patch = (points[order, 2] > 1).astype(np.int32)
    graph = SurfaceGraph(surface, patch, voxel_edges(surface))
    regions = np.repeat([[0, 1]], 16, axis=1)[np.zeros(32, int)]
    photo, depth = photo_cues(np.full((32, 32, 3), 90, np.uint8)), depth_cues(1 + 2.0 * regions, K)
    graph.add(*graph.evidence(regions, photo, depth, np.zeros((3, 32, 32), np.float32)))
    graph.link()
    assert graph.borders == [{}, {}] and graph.sums[:, PIXELS].tolist() == [512, 512]
    assert len(np.unique(segmentation(graph).segment * 2 + patch)) == 2


def test_growth_of_a_union_against_its_voxels():
    """Features of a pair, from the voxels themselves: extents by singular values, not from sums of squares."""
    seen = true_views()[:3]
    (surface,) = fuse(seen)
    (graph,) = surface_graphs(seen, [surface])
    compared = 0
    for a, links in enumerate(graph.borders):
        for b in links:
            one, two = (surface.points[graph.patch == i].astype(np.float64) for i in (a, b))
            larger, smaller = (one, two) if len(one) > len(two) else (two, one)
            if len(smaller) < 12:
                continue
            pixels, depths = graph.sums[[a, b], PIXELS], graph.sums[[a, b], DEPTH]
            depth, least = depths.sum() / pixels.sum(), surface.size / 4

            def extent(points: np.ndarray, least: float = least) -> np.ndarray:
                centred = points - points.mean(axis=0)
                spread = np.linalg.svd(centred, compute_uv=False)[::-1] / np.sqrt(len(points))
                return np.maximum(spread, least)

            chord = two.mean(axis=0) - one.mean(axis=0)
            chord /= (distance := np.linalg.norm(chord))
            along = max((one @ chord).std(), least) + max((two @ chord).std(), least)
            union, big, small = (extent(points) for points in (np.concatenate([one, two]), larger, smaller))
            expected = [
                distance / along,
                *np.log(union / big),
                *np.log(big / depth),
                *np.log(small / depth),
                np.log(union.prod() / (big.prod() + small.prod())),
            ]
            first, last = (PAIR_FEATURES.index(name) for name in ("distance", "volume_growth"))
            found = pair_features(graph, np.array([[a, b]]))[0, first : last + 1]
            np.testing.assert_allclose(found, expected, atol=1e-4)  # points are float32
            compared += 1
    assert compared > 20


@pytest.mark.slow
def test_box_floor_and_wall_are_one_segment_each_in_all_photos(tmp_path):
    """Through the store, with rough depth, in millimetres: whole parts, and the same ids in every photo."""
    unit = 1000.0
    source = make_source("builtin")
    assert isinstance(source, BuiltinSegmentation)
    photos, depths, views = {}, {}, []
    for i, (view, photo, depth, _) in enumerate(world()):
        pose = view.camera_from_world.copy()
        pose[:3, 3] *= unit
        views.append(View(view.name, view.photo, K, 160, 120, pose))
        photos[view.name], depths[view.name] = photo, unit * rough(depth, i)
    report = compute_masks(
        views, source, lambda v: photos[v.name], tmp_path, load_depth=lambda v: depths[v.name], depth_key="rough"
    )
    assert report["empty"] == [] and report["masks"] <= 8
    names = []
    for view, (_, _, _, ids) in zip(views, world(), strict=True):
        labels = load_labels(tmp_path, view)
        assert best_ious(labels, ids).mean() > 0.8
        names.append([np.bincount(labels[ids == part]).argmax() for part in (1, 2, 3)])
    assert len({tuple(n) for n in names}) == 1 and len(set(names[0])) == 3


@pytest.mark.parametrize("spec", ["builtin:borders", "labels:", "sam", ""])
def test_other_sources_are_refused(spec):
    with pytest.raises(InputError, match="expected auto, builtin, sam:PATH or labels:DIR"):
        make_source(spec)


def test_photos_without_depth_stay_unlabelled(tmp_path):
    views = [world()[0][0]]
    report = compute_masks(
        views,
        make_source("builtin"),
        lambda v: world()[0][1],
        tmp_path,
        load_depth=lambda v: np.zeros((120, 160)),
        depth_key="0",
    )
    assert report["empty"] == ["0.jpg"] and not load_labels(tmp_path, views[0]).any()


def test_an_opencv_without_ximgproc_is_told_at_once(monkeypatch):
    import cv2

    monkeypatch.delattr(cv2, "ximgproc")
    with pytest.raises(InputError, match="opencv-contrib-python-headless"):
        make_source("builtin")


@pytest.mark.slow
def test_a_photo_that_sees_another_place_spoils_no_other(tmp_path):
    views = [view for view, *_ in world()]
    away = np.eye(4)
    away[:3, 3] = 500.0
    views[4] = View("4.jpg", Path("4.jpg"), K, 160, 120, away)
    photos, depths = ({v.name: x[i] for v, x in zip(views, world(), strict=True)} for i in (1, 2))
    report = compute_masks(
        views,
        make_source("builtin"),
        lambda v: photos[v.name],
        tmp_path,
        load_depth=lambda v: depths[v.name],
        depth_key="1",
    )
    assert report["photos"] == 10 and report["empty"] == []
    assert best_ious(load_labels(tmp_path, views[0]), world()[0][3]).mean() > 0.6


def test_normals_and_creases_of_known_surfaces():
    pose = camera_from_world(np.array(EYES[2]))
    depth, ids, points = cast(pose)
    cues = depth_cues(depth, K)
    far = np.maximum(LOW - points, points - HIGH).max(axis=-1) > 0.1  # from the box
    floor = cues.normals[(ids == 1) & far & (points[..., 1] < WALL - 0.3)] @ pose[:3, :3]
    np.testing.assert_allclose(np.median(floor, axis=0), [0, 0, 1], atol=0.02)
    column = 5
    crease = int(np.argmax(ids[:, column] == 1))  # where the wall meets the floor, concave
    assert cues.bend[1, crease, column] < -0.5 and abs(cues.bend[1, crease + 20, column]) < 0.05
    box = np.flatnonzero(ids[:, 80] == 3)[8:-8]
    bent = box[np.abs(cues.bend[1, box, 80]) > 0.5]
    assert len(bent) and (cues.bend[1, bent, 80] > 0).all()  # top and front of the box, convex


def random_tree(rng: np.random.Generator, leaves: int) -> MergeTree:
    """One or more trees over the leaves, merged in random order."""
    alive, children, roots = list(range(leaves)), [], int(rng.integers(1, 4))
    while len(alive) > roots:
        children.append([alive.pop(int(rng.integers(len(alive)))) for _ in range(2)])
        alive.append(leaves + len(children) - 1)
    return MergeTree(leaves, np.array(children), np.zeros((leaves + len(children), 1)))


def test_the_cut_of_a_tree_against_all_cuts():
    rng = np.random.default_rng(4)
    for _ in range(30):
        tree = random_tree(rng, 7)
        members = leaf_sums(tree, np.eye(7, dtype=int)) > 0

        def cuts(left: frozenset[int], members: np.ndarray = members) -> Iterator[tuple[int, ...]]:
            """All sets of regions that divide the leaves left."""
            if not left:
                yield ()
            for k in range(len(members)):
                leaves = frozenset(np.flatnonzero(members[k]).tolist())
                if left and min(left) in leaves and leaves <= left:
                    yield from ((k, *rest) for rest in cuts(left - leaves))

        gain = rng.normal(0, 1, len(members))
        best = max(gain[list(cut)].sum() for cut in cuts(frozenset(range(7))))
        owner = tree.cut(gain)
        assert all((owner[members[k]] == k).all() and not (owner[~members[k]] == k).any() for k in owner)
        np.testing.assert_allclose(gain[np.unique(owner)].sum(), best)


def test_cuts_of_rising_cost_are_nested():
    rng = np.random.default_rng(6)
    for _ in range(100):
        tree = random_tree(rng, 15)
        p = rng.random(len(tree.features)) ** 2
        owners = [tree.cut(p - cost) for cost in (0.0, 0.05, 0.15, 0.4, 0.8)]
        for fine, coarse in itertools.pairwise(owners):
            assert all(len(np.unique(coarse[fine == k])) == 1 for k in fine)


def test_parts_lie_in_segments_and_probabilities_belong_to_them():
    seen = true_views()[:3]
    cuts = segmentation(surface_graphs(seen, fuse(seen))[0])
    assert all(len(np.unique(cuts.segment[cuts.part == k])) == 1 for k in range(len(cuts.part_probability)))
    assert cuts.part.max() + 1 == len(cuts.part_probability) and cuts.group.max() + 1 == len(cuts.group_probability)
    assert len(cuts.group) == len(cuts.probability) == cuts.segment.max() + 1 and len(cuts.points) == len(cuts.segment)
    alone = [s for s in range(1, len(cuts.group)) if len(np.unique(cuts.part[cuts.segment == s])) == 1]
    whole = [cuts.part_probability[cuts.part[cuts.segment == s][0]] for s in alone]
    np.testing.assert_allclose(whole, cuts.probability[alone])  # a segment that is its only part


def test_regions_of_the_tree_are_sums_of_their_patches():
    seen = true_views()[:3]
    (surface,) = fuse(seen)
    (graph,) = surface_graphs(seen, [surface])
    tree = tree_by(read_model(), graph)
    sums = leaf_sums(tree, graph.sums)
    depth = sums[:, DEPTH] / np.maximum(sums[:, PIXELS], 1)
    area = sums[:, VOXELS] * surface.size**2 / depth.clip(1e-9) ** 2
    columns = dict(zip(REGION_COLUMNS, tree.features.T, strict=False))
    np.testing.assert_allclose(columns["area"], np.log(area), atol=1e-4)
    np.testing.assert_allclose(np.exp(columns["patches"]), leaf_sums(tree, np.ones((graph.count, 1)))[:, 0], rtol=1e-5)


def test_relatives_of_regions_are_compared_with_them():
    """One tree of three leaves and one that is alone, by hand: 3 = 0 + 1 and 4 = 3 + 2."""
    own = np.array([[1.0, 10], [2, 20], [4, 40], [8, 80], [16, 160], [32, 320]])
    own = own[[0, 1, 2, 5, 3, 4]]  # leaves 0, 1, 2 and 3, which is alone; regions 4 and 5
    rows = _with_relatives(own, np.array([[0, 1], [4, 2]]))
    none = -1
    parent, sibling, grandparent = [4, 4, 5, none, 5, none], [1, 0, 4, none, 2, none], [5, 5, none, none, none, none]
    larger, smaller = [none] * 4 + [0, 4], [none] * 4 + [1, 2]
    expected = [own]
    for relatives in (parent, sibling, grandparent, larger, smaller):
        expected.append(np.array([own[k] - row if k >= 0 else 0 * row for k, row in zip(relatives, own, strict=True)]))
    np.testing.assert_array_equal(rows[:, :12], np.concatenate(expected, axis=1))
    np.testing.assert_array_equal(rows[:, 12:], np.array([parent, grandparent, larger]).T < 0)


def test_every_input_of_the_trained_weights_has_a_name():
    model, relatives, missing = read_model(), 6, 3
    assert len(model.pair.parts[0]) == len(set(PAIR_FEATURES))
    assert len(model.region.parts[0]) == relatives * len(set(REGION_COLUMNS)) + missing


def test_networks_give_the_same_bits_for_any_batch():
    network = read_model().pair
    x = np.random.default_rng(0).normal(0, 2, (50, len(network.parts[0]))) * network.parts[1] + network.parts[0]
    whole = network(x)
    np.testing.assert_array_equal(whole, np.concatenate([network(row[None]) for row in x]))
    mean, scale, *layers = (part.astype(np.float64) for part in network.parts)
    expected = []
    for k in range(3):
        h = np.clip((x - mean) / scale, -5, 5)
        for weight, bias in zip(layers[::2], layers[1::2], strict=True):
            h = (h if weight is layers[0] else np.maximum(h, 0)) @ weight[k].T + bias[k]
        expected.append(h)
    np.testing.assert_allclose(whole, np.mean(expected, axis=0), atol=1e-4)


def test_segments_do_not_depend_on_the_order_of_patches():
    seen = true_views()
    (surface,) = fuse(seen)
    (first,) = surface_graphs(seen, [surface])
    order = np.random.default_rng(3).permutation(first.count).astype(np.int32)
    second = SurfaceGraph(surface, order[first.patch], voxel_edges(surface))
    for shown in seen:
        photo, depth = shown.cues()
        voxel = surface.voxel_of(move_points(shown.world_from_camera, depth.points.astype(float)))
        regions = np.where(voxel >= 0, second.patch[voxel], -1)
        second.add(*second.evidence(regions, photo, depth, shown.learned.astype(np.float32)))
    second.link()
    (labels, probability), (others, _) = (divided(g, tree_by(read_model(), g), read_model()) for g in (first, second))
    np.testing.assert_array_equal(labels, others)
    inside = np.all((surface.points > LOW - 0.02) & (surface.points < HIGH + 0.02), axis=1) & (
        surface.points[:, 2] > 0.03
    )
    box = np.bincount(labels[inside]).argmax()
    assert (inside & (labels == box)).sum() / (inside | (labels == box)).sum() > 0.7 and probability[box] > 0.5


def test_noise_on_a_bare_wall_is_no_thing():
    rng, views = np.random.default_rng(6), []
    y, x = np.mgrid[:120, :160] + 0.5
    for eye in EYES:
        pose = camera_from_world(np.array(eye))
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1) @ pose[:3, :3]
        depth = (WALL - eye[1]) / rays[..., 1] * rng.normal(1, 0.004, x.shape)
        photo = rng.normal(128, 3, (120, 160, 3)).astype(np.uint8)
        views.append(make_stereo_view(View("", Path("x.jpg"), K, 160, 120, pose), photo, depth))
    (surface,) = fuse(views)
    (graph,) = surface_graphs(views, [surface])
    labels, probability = divided(graph, tree_by(read_model(), graph), read_model())
    small = np.bincount(labels, minlength=len(probability)) < 0.5 * len(labels)
    assert (probability[small] < 0.5).all()


def test_too_many_voxels_are_doubled_until_they_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a grid that had the last size from the start; photos come before and after it is doubled."""
    rng = np.random.default_rng(5)
    photos = [rng.uniform(-1, 1, (400, 11)) * [1, *[1 + n] * 3, *[1] * 7] for n in range(4)]
    for photo in photos:
        photo[:, 0] = 1
    monkeypatch.setattr(surface_module, "_MOST", 60)
    grown = SurfaceBuilder(0.05, 1 / 3)
    for photo in photos:
        grown.add(*grown.voxels_of(photo))
    monkeypatch.undo()
    plain = SurfaceBuilder(grown.size)
    plain.origin = grown.origin
    for photo in photos:
        plain.add(*plain.voxels_of(photo))
    assert grown.size == 0.05 * 2**grown.halvings and grown.halvings >= 3
    one, other = grown.build(), plain.build()
    np.testing.assert_array_equal(one.keys, other.keys)
    np.testing.assert_allclose(one.points, other.points, atol=1e-6)
    np.testing.assert_array_equal(one.pixels, other.pixels)
    assert 10 < len(one) <= 120
