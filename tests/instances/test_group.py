"""Grouping against scenes whose instances are known exactly, the hard cases among them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import sparse

pytest.importorskip("perception._core")
from perception.config import InstanceConfig
from perception.gaussians.model import Gaussians, Nearby, from_points
from perception.gaussians.views import TrainingView
from perception.instances.assign import without_strays
from perception.instances.group import Grouping, _without_small, group
from perception.instances.votes import beside, mask_votes
from perception.masks.votes import MaskVotes
from perception.rasterizer.rasterize import rasterize
from perception.rasterizer.types import Gradients
from support.blob_scenes import BlobScene, make_scene, orbit, rand_index, random_scene, with_errors


def run(scene: BlobScene, **changes: object) -> Grouping:
    g = scene.gaussians
    votes = mask_votes(Nearby(g), scene.views)
    arrays = (t.numpy() for t in (g.means, g.scales, g.opacities, g.features))
    return group(*arrays, votes, InstanceConfig(**changes))  # type: ignore[arg-type]


def agrees(found: Grouping, truth: np.ndarray, share: float = 0.9) -> bool:
    known = found.ids >= 0
    return bool(known.mean() >= share and rand_index(truth[known], found.ids[known]) > 0.97)


def row(count: int, gap: float = 0.8) -> np.ndarray:
    return np.stack([gap * (np.arange(count) - (count - 1) / 2), np.zeros(count), np.zeros(count)], axis=1)


CODES = np.random.default_rng(0).normal(0, 0.5, (400, 32))
CAMERAS = orbit(8, 3.0, 1.5, np.zeros(3))


@pytest.mark.parametrize("widths", [[3], [1, 0, 4, 2], [2] * 40])
def test_matrices_stand_beside_each_other_as_scipy_puts_them(widths: list[int]) -> None:
    rng = np.random.default_rng(0)
    parts = [sparse.random(30, width, 0.2, format="csc", dtype=np.float32, rng=rng) for width in widths]
    expected = sparse.hstack(parts).tocsr()
    found = beside(list(parts), np.copy)
    assert found.shape == expected.shape and found.has_canonical_format
    for name in ("data", "indices", "indptr"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_photo_votes_for_the_gaussians_near_it_as_if_there_were_no_others() -> None:
    scene = make_scene(row(3), CODES[:3, :8], CAMERAS[:2])
    g, (one, other) = scene.gaussians, scene.views
    near = np.arange(100, 300)
    votes = mask_votes(Nearby(g, {one.name: [near[:50], near[50:]]}), [one, other])
    of_near, of_all = mask_votes(Nearby(g.rows(torch.from_numpy(near))), [one]), mask_votes(Nearby(g), [other])
    for name in ("pixels", "void"):
        both = getattr(votes, name).toarray()
        width = getattr(of_near, name).shape[1]
        np.testing.assert_array_equal(both[near, :width], getattr(of_near, name).toarray())
        assert both[:, :width].sum() == both[near, :width].sum()
        np.testing.assert_array_equal(both[:, width:], getattr(of_all, name).toarray())


def test_what_a_photo_does_not_show_costs_it_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A building: ten times as many Gaussians stand behind the camera. The votes are the same bit for bit, and no table
    of weights has a row for them."""
    scene = make_scene(row(3), CODES[:3, :8], CAMERAS[:1])
    g, views, tables = scene.gaussians, scene.views, list[int]()
    behind = g.rows(torch.arange(len(g)).repeat(10))
    behind.means -= 1000 * views[0].camera_from_world[2, :3]
    expected = mask_votes(Nearby(g), views)
    zeros = Gradients.zeros
    monkeypatch.setattr(Gradients, "zeros", lambda *given: tables.append(len(given[0].means)) or zeros(*given))
    found = mask_votes(Nearby(Gaussians.concatenate([behind, g])), views)
    for name in ("pixels", "void"):
        np.testing.assert_array_equal(getattr(found, name)[len(behind) :].toarray(), getattr(expected, name).toarray())
        assert getattr(found, name)[: len(behind)].nnz == 0
    assert 0 < max(tables) <= len(g)


def test_votes_are_the_weights_with_which_gaussians_enter_the_picture() -> None:
    scene = make_scene(row(3), CODES[:3, :8], CAMERAS[:2])
    g, view = scene.gaussians, scene.views[0]
    votes = mask_votes(Nearby(g), [view], half_resolution=False)
    names = np.unique(view.labels[view.labels > 0])
    for n in (0, 200, 449):  # render one Gaussian white among the others and add up the mask's pixels
        white = torch.zeros(len(g), 1)
        white[n] = 1
        height, width = view.labels.shape
        out = rasterize(
            g.means, g.quats, g.scales, g.opacities, g.base_colors, view.camera_from_world[None], view.K[None],
            width, height, features=white,
        )  # fmt: skip
        picture = out.features[0, ..., 0].numpy()
        expected = np.array([picture[view.labels.numpy() == name].sum() for name in names])
        found = votes.pixels[n].toarray()[0]
        assert np.abs(np.where(expected > 0.02, expected, 0) - found).max() < 1e-3
        assert votes.void[n].sum() == pytest.approx(picture[view.labels.numpy() == 0].sum(), abs=0.03)
    assert votes.area.tolist() == [int((view.labels == name).sum()) for name in names]


def test_votes_at_half_resolution_weigh_what_the_full_picture_does() -> None:
    """Closed form: a faint round Gaussian of deviation s pixels weighs in proportion to s² + eps2d, in pixels²; the
    average of 2 × 2 pixels adds 1/4 to it, and no more."""
    deviation, faint = 1.5, 0.1
    g = from_points(np.array([[0, 0, 2.0]]), np.full((1, 3), 128, np.uint8), feature_dim=3, seed=0, opacity=faint)
    g.log_scales = torch.full((1, 3), deviation * 2 / 64).log()
    K = torch.tensor([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]])
    labels = torch.ones(64, 64, dtype=torch.int32)
    view = TrainingView("a", torch.zeros(64, 64, 3, dtype=torch.uint8), labels, K, torch.eye(4))
    full, half = (mask_votes(Nearby(g), [view], half_resolution=choice).pixels[0, 0] for choice in (False, True))
    expected = (deviation**2 + 0.3 + 0.25) / (deviation**2 + 0.3)
    assert 4 * half / full == pytest.approx(expected, rel=0.02)  # alpha under 1/255 is cut; with eps2d 0.3: 23 % more


@pytest.mark.parametrize("dim", [1, 8, 32])
@pytest.mark.parametrize("method", ["consensus", "hdbscan"])
def test_balls_are_found_in_any_width(dim: int, method: str) -> None:
    codes = np.arange(5.0)[:, None] + 0 * CODES[:5, :dim] if dim == 1 else CODES[:5, :dim]
    scene = make_scene(row(5), codes, CAMERAS)
    found = run(scene, method=method)
    assert found.count == 5 and agrees(found, scene.truth)
    assert (found.scores > 0).all() and (found.scores <= 1).all() and found.membership.max() <= 1


def test_the_papers_grouping_is_hdbscan_of_the_features_alone() -> None:
    import hdbscan

    """Two objects far apart with one feature stay one cluster, and faint Gaussians are clustered like others."""
    scene = make_scene(row(4), np.repeat(CODES[:2, :8], 2, axis=0), CAMERAS)
    scene.gaussians.opacity_logits[::3] = -4.0
    found = run(scene, method="hdbscan", split=False, settle=False)
    plain = hdbscan.HDBSCAN(min_cluster_size=32, min_samples=16).fit_predict(scene.gaussians.features.double().numpy())
    assert rand_index(plain, found.ids) == 1 and found.count == 2
    assert ((found.ids < 0) == (plain < 0)).all()


def test_one_object() -> None:
    scene = make_scene(row(1), CODES[:1, :8], CAMERAS)
    found = run(scene)
    assert found.count == 1 and (found.ids == 0).mean() > 0.9


def test_no_masks_at_all_leaves_features_and_places_to_decide() -> None:
    scene = make_scene(row(3), CODES[:3, :8], CAMERAS)
    blank = [replace(v, labels=None) for v in scene.views]
    found = run(replace(scene, views=blank))
    assert found.count >= 3 and np.isfinite(found.scores).all()


def test_masks_in_one_photo_only() -> None:
    scene = make_scene(row(4), CODES[:4, :8], CAMERAS)
    views = [v if i == 2 else replace(v, labels=torch.zeros_like(v.labels)) for i, v in enumerate(scene.views)]
    found = run(replace(scene, views=views))
    known = found.ids >= 0
    assert rand_index(scene.truth[known], found.ids[known]) > 0.9


@pytest.mark.slow
def test_300_instances() -> None:
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(15)), axis=-1).reshape(-1, 2) * 0.8
    centres = np.concatenate([grid - grid.mean(axis=0), np.zeros((300, 1))], axis=1)
    cameras = orbit(6, 7.0, 9.0, np.zeros(3))
    scene = make_scene(centres, CODES[:300, :8], cameras, each=40, size=(200, 150), focal=140)
    found = run(scene)
    assert 290 <= found.count <= 310 and agrees(found, scene.truth)


def test_two_identical_objects_side_by_side() -> None:
    codes = np.repeat(CODES[:1, :8], 2, axis=0)
    scene = make_scene(row(2, gap=0.62), codes, CAMERAS)
    found = run(scene)
    assert found.count == 2 and agrees(found, scene.truth)


def test_all_features_equal_leaves_the_masks_to_decide() -> None:
    scene = make_scene(row(4), np.zeros((4, 8)), CAMERAS, feature_noise=0.0)
    assert agrees(run(scene), scene.truth)


def test_equal_features_that_share_no_photo_do_not_collide() -> None:
    far = np.array([[-20.0, 0, 0], [20.0, 0, 0]])
    cameras = orbit(6, 3.0, 1.5, far[0]) + orbit(6, 3.0, 1.5, far[1])
    scene = make_scene(far, np.repeat(CODES[:1, :8], 2, axis=0), cameras)
    found = run(scene)
    assert found.count == 2 and agrees(found, scene.truth)


def test_an_instance_of_12_gaussians_is_kept_when_photos_single_it_out() -> None:
    scene = make_scene(row(3), CODES[:3, :8], CAMERAS, each=[300, 300, 12])
    found = run(scene)
    assert found.count == 3 and agrees(found, scene.truth)


def test_small_things_on_a_table_are_kept_though_features_do_not_part_them() -> None:
    """2,500 Gaussians of a table, 3 things of 14 among them, of one feature; each fills 5 pixels in each of 6 masks."""
    rng = np.random.default_rng(0)
    spots = np.array([[0.4, 0.4, 0], [-0.5, 0.3, 0], [0.1, -0.6, 0]])
    table = np.append(rng.uniform(-1, 1, (2500, 2)), np.zeros((2500, 1)), axis=1)
    things = np.repeat(spots, 14, axis=0) + rng.normal(0, 0.01, (42, 3))
    means = np.concatenate([table, things]).astype(np.float32)
    truth = np.append(np.zeros(2500, int), 1 + np.repeat(np.arange(3), 14))
    owner = np.tile(np.arange(4), 6)  # of each mask
    pixels = sparse.csr_matrix(5 * (owner == truth[:, None]), dtype=np.float32)
    area = 5.0 * np.bincount(truth)[owner]
    votes = MaskVotes(pixels, sparse.csr_matrix((len(means), 6), dtype=np.float32), np.repeat(np.arange(6), 4), area)
    shape, opaque, equal = np.full((len(means), 3), 0.01), np.full(len(means), 0.9), np.zeros((len(means), 8))
    found = group(means, shape, opaque, equal, votes, InstanceConfig())
    assert found.count == 4 and rand_index(truth, found.ids) > 0.99


def test_labels_of_one_surface_are_the_instances_whatever_features_and_seed_say() -> None:
    rng = np.random.default_rng(0)
    truth = np.repeat(np.arange(4), [500, 200, 60, 20])
    names = np.array([7, 2, 40, 5])  # of the things, in all photos; the last photo does not show the first
    owner = np.append(np.tile(np.arange(4), 5), [1, 2, 3])
    weights = 5 * (owner == truth[:, None]) + rng.uniform(0, 1.5, (len(truth), len(owner)))  # and some in wrong ones
    view = np.append(np.repeat(np.arange(5), 4), [5] * 3)
    none = sparse.csr_matrix((len(truth), 6), dtype=np.float32)
    votes = MaskVotes(sparse.csr_matrix(weights, dtype=np.float32), none, view, weights.sum(axis=0), names[owner])
    sums = votes.of_labels().toarray()
    for column, name in enumerate(sorted(names)):
        np.testing.assert_allclose(sums[:, column], weights[:, names[owner] == name].sum(axis=1), rtol=1e-5)
    means, shape, opaque = rng.normal(0, 0.1, (len(truth), 3)) + 3 * truth[:, None], np.full((len(truth), 3), 0.1), 0.9
    opacities = np.full(len(truth), opaque)
    opacities[:3] = 0.01  # too faint to found an instance, and joined to that of its neighbours
    for seed in range(2):
        noise = np.random.default_rng(seed).normal(size=(len(truth), 8))
        found = group(means, shape, opacities, noise, votes, InstanceConfig(), seed=seed, one_surface=True)
        np.testing.assert_array_equal(found.ids, truth)


def test_one_surface_without_masks_has_no_instances() -> None:
    """Labels one pixel wide may all fall between the pixels of half the resolution: grouping ended with an error."""
    none = sparse.csr_matrix((5, 0), dtype=np.float32)
    votes = MaskVotes(none, none, np.zeros(0, np.int64), np.zeros(0))
    five = np.eye(5, 3), np.full((5, 3), 0.1), np.full(5, 0.8), np.zeros((5, 4), np.float32)
    assert group(*five, votes, InstanceConfig(), one_surface=True).count == 0


def test_an_object_cut_by_every_border() -> None:
    scene = make_scene(row(1), CODES[:1, :8], orbit(6, 0.55, 0.1, np.zeros(3)), radius=0.5, each=600)
    found = run(scene)
    assert found.count == 1


def test_errors_of_the_segmenter_are_outvoted() -> None:
    scene = random_scene(5, count=12)
    spoiled = with_errors(scene, np.random.default_rng(1))
    found = run(spoiled)
    assert agrees(found, scene.truth, 0.8)


def test_parts_that_photos_single_out_are_kept_below_their_whole() -> None:
    """Two halves, in one mask in 6 of 8 photos and in two masks in the rest: one instance with two parts."""
    halves = np.array([[-0.25, 0, 0], [0.25, 0, 0], [2.0, 0, 0]])
    cameras = orbit(8, 2.0, 3.0, np.zeros(3))  # from above: neither half hides the other
    scene = make_scene(halves, np.array([[0.0] * 8, [0.3] * 8, [-1.0] * 8]), cameras, each=400)
    views = []
    for number, view in enumerate(scene.views):
        labels = view.labels.clone()
        if number < 6:
            pair = [int(n) for n in _names(scene, view)[:2] if n > 0]
            if len(pair) == 2:
                labels[labels == pair[1]] = pair[0]
        views.append(replace(view, labels=labels))
    found = run(replace(scene, views=views))
    whole = found.ids[scene.truth == 0]
    owner = int(np.bincount(whole[whole >= 0]).argmax())
    assert (found.ids[scene.truth == 1] == owner).mean() > 0.9 and found.count == 2
    assert found.parents == [owner, owner]
    inside = found.part_ids >= 0
    assert rand_index(scene.truth[inside], found.part_ids[inside]) > 0.9
    assert set(np.unique(found.part_ids[inside])) == {2, 3}


def _names(scene: BlobScene, view: object) -> list[int]:
    """The label of each ball in a view (0 = unseen), by the ball whose Gaussians project into the mask."""
    points = scene.gaussians.means.numpy()
    pose, K = view.camera_from_world.numpy(), view.K.numpy()  # type: ignore[attr-defined]
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    pixel = (camera[:, :2] / camera[:, 2:] * K[0, 0] + K[:2, 2]).astype(int)
    labels = view.labels.numpy()  # type: ignore[attr-defined]
    pixel = np.clip(pixel, 0, [labels.shape[1] - 1, labels.shape[0] - 1])
    seen = labels[pixel[:, 1], pixel[:, 0]]
    return [int(np.bincount(seen[scene.truth == k]).argmax()) for k in range(3)]


def test_the_same_input_gives_the_same_groups() -> None:
    scene = with_errors(random_scene(7, count=8, views=10), np.random.default_rng(2))
    first, second = run(scene), run(scene)
    assert np.array_equal(first.ids, second.ids) and np.array_equal(first.scores, second.scores)


@pytest.mark.parametrize("photos", [1, 2])
def test_a_ring_is_kept_that_two_photos_show_though_its_gaussians_fill_a_fifth_of_its_masks(photos: int) -> None:
    """The table's Gaussians straddle its border and fill the rest, so its IoU with its masks is only .2."""
    ids = np.repeat(np.array([0, 1], np.int32), [40, 6])
    shares = np.zeros((46, 2 * photos), np.float32)  # table and ring of each photo
    shares[:40, 0::2], shares[:40, 1::2] = 10_000 / 40, 80 / 40
    shares[40:, 1::2] = 20 / 6
    view, area = np.repeat(np.arange(photos), 2), np.tile([10_000.0, 100.0], photos)
    votes = MaskVotes(sparse.csr_matrix(shares), sparse.csr_matrix((46, photos), dtype=np.float32), view, area)
    kept = _without_small(ids, votes, 32, whole=True)
    assert (kept[:40] == 0).all()
    assert (kept[40:] == (1 if photos == 2 else -1)).all()


def test_floaters_are_strays_and_a_part_behind_something_is_none() -> None:
    """Instance 0: a ball of 60, 5 floaters far off and a piece of 20 beyond instance 1, which is a ball of 60."""
    rng = np.random.default_rng(0)
    places = [((0, 0, 0), 60, 0), ((9, 0, 0), 20, 0), ((5, 0, 0), 60, 1), ((5, 7, 0), 1, 0), ((5, 0, 1.5), 4, 0)]
    means = np.concatenate([rng.normal(size=(count, 3)) * 0.3 + middle for middle, count, _ in places])
    means[60 + 20 + 60 + 1 :] = means[80 : 80 + 4] + 1e-3  # four floaters among the Gaussians of instance 1
    ids = np.repeat([own for *_, own in places], [count for _, count, _ in places]).astype(np.int32)
    found = without_strays(ids, means, np.ones(len(ids)), 0.1)
    expected = ids.copy()
    expected[140:] = -1
    np.testing.assert_array_equal(found, expected)
    order = rng.permutation(len(ids))
    np.testing.assert_array_equal(without_strays(ids[order], means[order], np.ones(len(ids)), 0.1), expected[order])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_gaussians_have_no_strays(count: int) -> None:
    ids, means = np.zeros(count, np.int32), np.arange(3.0 * count).reshape(count, 3)
    np.testing.assert_array_equal(without_strays(ids, means, np.ones(count), 0.1), ids)
