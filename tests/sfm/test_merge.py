"""Parts of a model are moved onto each other by their matched points: a made scene with exact truth."""

from __future__ import annotations

from itertools import product

import numpy as np
import pycolmap
import pytest

from perception.sfm.merge import MATCHED, Matches, align_by_matches, merged, part_of


def scene() -> tuple[pycolmap.Reconstruction, set[int], set[int], Matches]:
    """A model, the photos of its two halves, and the matches between these: both see the same point."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    options.num_points3D = 400
    model = pycolmap.synthesize_dataset(options)
    photos = sorted(model.reg_image_ids())
    seen = {i: {p.point3D_id: n for n, p in enumerate(model.images[i].points2D) if p.has_point3D()} for i in photos}
    matches = {
        (i, j): np.array([(seen[i][point], seen[j][point]) for point in sorted(seen[i].keys() & seen[j].keys())])
        for i, j in product(photos[:6], photos[6:])
    }
    return model, set(photos[:6]), set(photos[6:]), matches


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_a_part_is_moved_to_where_most_matched_points_agree(wrong: float) -> None:
    model, first, second, matches = scene()
    rng = np.random.default_rng(0)
    for found in matches.values():
        some = rng.random(len(found)) < wrong
        found[some, 1] = rng.permutation(found[some, 1])
    main, other = part_of(model, first), part_of(model, second)
    assert set(main.reg_image_ids()) == first and set(other.reg_image_ids()) == second
    turn = pycolmap.Rotation3d(np.array([0.1, 0.7, -0.2, 0.6]) / np.linalg.norm([0.1, 0.7, -0.2, 0.6]))
    other.transform(pycolmap.Sim3d(2.5, turn, np.array([3.0, -1.0, 2.0])))
    assert align_by_matches(main, other, matches, seed=0)
    for image in second:
        # Points are exact, cameras about 5 from their centre. Wrong matches that fit by chance shift the mean.
        moved, right = (each.images[image].projection_center() for each in (other, model))
        np.testing.assert_allclose(moved, right, atol=1e-6 if wrong == 0 else 0.02)


def test_few_matched_points_say_nothing() -> None:
    model, first, second, matches = scene()
    pair = next(iter(matches))
    few = {pair: matches[pair][: MATCHED - 1]}
    other = part_of(model, second)
    assert not align_by_matches(part_of(model, first), other, few, seed=0)


def test_models_that_are_merged_keep_their_own_intrinsics() -> None:
    """Each is still a candidate if the merged one is worse."""
    model, first, second, _ = scene()
    models, camera = [part_of(model, first), part_of(model, second)], model.images[min(first)].camera_id
    for each, factor in zip(models, (1.0, 1.2), strict=True):
        each.cameras[camera].params = factor * model.cameras[camera].params
    found = merged(models).cameras[camera].params
    np.testing.assert_allclose(found, 1.1 * model.cameras[camera].params)
    for each, factor in zip(models, (1.0, 1.2), strict=True):
        np.testing.assert_array_equal(each.cameras[camera].params, factor * model.cameras[camera].params)
