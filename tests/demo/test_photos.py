"""The demo's photos against their truth: projection, masks, points, files, determinism."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from perception.errors import InputError
from support.demo_truth import labels_of, load_truth, things
from worlds import DemoTruth, make_photos

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DemoTruth]:
    folder = tmp_path_factory.mktemp("demo") / "photos"
    return folder, make_photos(folder, views=5, width=160, height=120, light_samples=2)


def test_truth_survives_the_disk(made: tuple[Path, DemoTruth]) -> None:
    folder, truth = made
    again = load_truth(folder.parent / "truth")
    assert again.names == truth.names == sorted(path.name for path in folder.iterdir())
    assert (again.queries, again.asked, again.photos) == (truth.queries, truth.asked, truth.photos)
    assert again.instances == truth.instances
    np.testing.assert_array_equal(again.points, truth.points)
    np.testing.assert_array_equal(again.instance_ids, truth.instance_ids)
    for a, b in zip(again.cameras, truth.cameras, strict=True):
        np.testing.assert_allclose(a.camera_from_world, b.camera_from_world, atol=1e-12)
        np.testing.assert_allclose(a.K, b.K)


def test_projected_points_fall_on_the_mask_of_their_object(made: tuple[Path, DemoTruth]) -> None:
    """An independent projection of truth points with the saved poses meets the id images."""
    _, truth = made
    for name, camera in zip(truth.names, truth.cameras, strict=True):
        labels = labels_of(truth, name)
        ball = truth.points[truth.instance_ids == 4]  # the basketball: convex and in the open
        center = ball.mean(0) * [1, 1, 0] + [0, 0, 0.088]
        x, y, z = camera.K @ (camera.camera_from_world[:3, :3] @ center + camera.camera_from_world[:3, 3])
        row, column = int(y / z), int(x / z)
        if z > 0 and 3 <= row < 117 and 3 <= column < 157:
            window = labels[row - 3 : row + 4, column - 3 : column + 4]
            assert np.isin(window, (4, 2, 3, 9)).all() and (window != 0).all()


def test_the_table_is_the_plane_it_says(made: tuple[Path, DemoTruth]) -> None:
    """Pixels labelled table, cast back onto z = 0 by hand, land inside the table's rectangle (or see its
    edge, legs)."""
    _, truth = made
    camera, labels = truth.cameras[3], labels_of(truth, truth.names[3])
    rows, columns = np.nonzero(labels == 11)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    rays = camera.camera_from_world[:3, :3].T @ np.linalg.inv(camera.K) @ pixels
    eye = np.linalg.inv(camera.camera_from_world)[:3, 3]
    hits = eye[:, None] - eye[2] / rays[2] * rays
    inside = (np.abs(hits[0]) < 0.56) & (np.abs(hits[1]) < 0.40)
    assert inside.mean() > 0.75
    outside = (labels == 12) | (labels == 13)
    rows, columns = np.nonzero(outside)
    rays = (
        camera.camera_from_world[:3, :3].T
        @ np.linalg.inv(camera.K)
        @ np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    )
    hits = eye[:, None] - eye[2] / rays[2] * rays
    on_table = (rays[2] < 0) & (np.abs(hits[0]) < 0.54) & (np.abs(hits[1]) < 0.38)
    assert not on_table.any()


def test_every_thing_is_seen_and_every_query_has_its_answer(made: tuple[Path, DemoTruth]) -> None:
    _, truth = made
    names = {instance.id: instance.name for instance in truth.instances}
    assert sorted(names) == list(range(1, len(names) + 1))
    assert set(np.unique(truth.instance_ids)) >= {thing.id for thing in things(truth)}
    answers = {text: [names[i] for i in ids] for text, ids in truth.queries}
    assert [answers.get(text) for text in truth.asked] == [["red mug"], ["basketball"], ["banana"], None]
    assert answers["mug"] == ["red mug", "blue mug"] and answers["poster"] == [
        n for n in names.values() if "poster" in n
    ]
    red = truth.colors[truth.instance_ids == 1].mean(0)
    blue = truth.colors[truth.instance_ids == 2].mean(0)
    assert red[0] > 2 * red[2] and blue[2] > 2 * blue[0]


def test_same_seed_same_photos(made: tuple[Path, DemoTruth], tmp_path: Path) -> None:
    folder, truth = made
    again = make_photos(tmp_path / "again" / "photos", views=5, width=160, height=120, light_samples=2)
    for name in truth.names:
        assert (folder / name).read_bytes() == (tmp_path / "again" / "photos" / name).read_bytes()
    np.testing.assert_array_equal(again.points, truth.points)


def test_photos_tell_their_focal_length(made: tuple[Path, DemoTruth]) -> None:
    folder, truth = made
    exif = Image.open(folder / "000.jpg").getexif().get_ifd(0x8769)
    assert exif[0xA405] * 160 / 36 == pytest.approx(truth.cameras[0].K[0, 0])


def test_bad_arguments_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least 3"):
        make_photos(tmp_path / "p", views=2)
