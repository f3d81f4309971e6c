"""Gains of photos: made tracks with known gains, and plain photos of known brightness."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from perception.photos.lens import load_pycolmap
from perception.photos.view_json import view_from_json, view_json
from perception.sfm.exposure import VARIES, photo_gains, with_gains
from perception.sfm.tracks import Features, Tracks, tracks_of, tracks_of_model
from perception.types import View

PHOTOS, POINTS = 30, 400


def test_gains_are_found_among_wrong_matches_and_shadows():
    """A walk: each point is seen in five photos of the row, so that gains are tied in a chain only."""
    rng = np.random.default_rng(0)
    right = np.cumsum(rng.normal(0, 0.05, (PHOTOS, 3)), axis=0)
    right -= right.mean(axis=0)
    first = rng.integers(0, PHOTOS - 4, POINTS)
    view, point = (first[:, None] + np.arange(5)).ravel(), np.repeat(np.arange(POINTS), 5)
    logs = rng.normal(-1, 0.4, (POINTS, 3))[point] + right[view] + rng.normal(0, 0.02, (len(view), 3))
    wrong = rng.random(len(view)) < 0.15
    logs[wrong] += rng.normal(-0.3, 0.5, (wrong.sum(), 3))
    tracks = Tracks(view, point, np.zeros((len(view), 2)), np.ones(len(view)), np.zeros(len(view)))
    found = photo_gains(logs, np.ones(len(view), bool), tracks, PHOTOS)
    # About 60 points of 0.02 tie one photo to the next, 0.003 a step; a chain of 30 steps is off by a hundredth or two.
    assert np.abs(found - right).max() < 0.03 < np.abs(right).max()
    assert np.abs(found.mean(axis=0)).max() < 1e-12


def photos(folder, levels):
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    views = []
    for i, level in enumerate(levels):
        Image.fromarray(np.full((48, 64, 3), level, np.uint8)).save(folder / f"{i}.png")
        views.append(View(f"{i}.png", folder / f"{i}.png", K, 64, 48, np.eye(4)))
    return views


def matched(count):
    """Twenty features a photo, each seen in all of them."""
    rays = np.tile(np.random.default_rng(1).uniform(-0.4, 0.4, (20, 2)), (count, 1))
    pairs = np.stack([np.arange(20 * (count - 1)), np.arange(20, 20 * count)], axis=1)
    features = Features(np.repeat(np.arange(count), 20), rays, np.full(len(rays), 50.0), np.zeros(len(rays)), pairs)
    return tracks_of(features, pairs)


def test_photos_of_changing_exposure_and_white_balance_get_gains(tmp_path):
    levels = np.array([[100, 100, 100], [120, 120, 120], [100, 100, 150], [60, 90, 100]])
    views, report = with_gains(photos(tmp_path, levels), matched(4))
    geometric = levels / np.exp(np.log(levels).mean(axis=0))
    np.testing.assert_allclose([view.gain for view in views], geometric, rtol=0.02)
    assert report["exposure"]["varies"] and report["exposure"]["spread"] > VARIES


@pytest.mark.parametrize("levels", [[100, 100, 101, 100], [255, 255, 255, 3]])
def test_photos_of_equal_exposure_and_clipped_ones_are_left_as_they_are(tmp_path, levels):
    given = photos(tmp_path, levels)
    views, report = with_gains(given, matched(4))
    assert views is given and not report["exposure"]["varies"]


def test_gains_are_kept_and_wrong_ones_refused(tmp_path):
    (view,) = photos(tmp_path, [100])
    entry = json.loads(json.dumps(view_json(replace(view, gain=(0.5, 1.0, 1.5)))))
    assert view_from_json(entry).gain == (0.5, 1.0, 1.5) and view_from_json(view_json(view)).gain is None
    for wrong in ([1, 2], [1, 1, float("nan")], [0, 1, 1]):
        with pytest.raises(ValueError, match="gain"):
            view_from_json({**entry, "gain": wrong})


def test_tracks_of_a_model_are_those_it_was_made_with(tmp_path):
    """Oracle: pycolmap's made scenes; the same, of every second point, when there are more than asked for."""
    pycolmap = load_pycolmap()
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 6, 40
    model = pycolmap.synthesize_dataset(options)
    names = {image_id: f"{image_id}.png" for image_id in model.images}
    views = [View(name, tmp_path, np.eye(3), 4, 4, np.eye(4)) for name in sorted(names.values())][1:]
    tracks = tracks_of_model(model, views, names)
    right = {(e.image_id, point) for point in model.points3D for e in model.points3D[point].track.elements}
    right = {(f"{image}.png", rank) for image, point in right for rank in [sorted(model.points3D).index(point)]}
    found = [(views[v].name, p) for v, p in zip(tracks.view, tracks.point, strict=True)]
    assert sorted(found) == sorted(pair for pair in right if pair[0] != f"{min(model.images)}.png")
    points = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])[tracks.point]
    ids = {name: image_id for image_id, name in names.items()}
    poses = np.stack([model.images[ids[views[v].name]].cam_from_world().matrix() for v in tracks.view])
    x = np.einsum("oij,oj->oi", poses[:, :, :3], points) + poses[:, :, 3]
    np.testing.assert_allclose(tracks.rays, x[:, :2] / x[:, 2:], atol=1e-4)
    assert tracks_of_model(model, views, names, 20).size == 20
