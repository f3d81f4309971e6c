"""Which photos are held out, and what is known of them before they are compared with the map."""

from pathlib import Path

import numpy as np
import pytest

from perception.config import PhotoConfig
from perception.gaussians.photos import exposed_as_neighbours, split_scene
from perception.types import Scene, View


def view(name: str, gain: tuple[float, float, float] | None) -> View:
    return View(name, Path(name), np.eye(3), 4, 4, np.eye(4), gain=gain)


def test_held_out_photos_are_exposed_as_their_neighbours_not_as_they_are() -> None:
    training = [view("b", (1.0, 2.0, 4.0)), view("d", (4.0, 2.0, 1.0)), view("e", (3.0, 3.0, 3.0))]
    held = [view(name, (9.0, 9.0, 9.0)) for name in ("a", "c", "f")]
    first, between, last = (found.gain for found in exposed_as_neighbours(held, training))
    assert first == pytest.approx((1, 2, 4)) and last == pytest.approx((3, 3, 3))
    assert between == pytest.approx((2, 2, 2))  # geometric mean


def test_photos_without_gains_stay_without() -> None:
    assert exposed_as_neighbours([view("a", None)], [view("b", None)])[0].gain is None


def test_names_of_no_photo_in_the_list_of_held_out_ones_are_told(tmp_path: Path) -> None:
    listed = tmp_path / "held.txt"
    listed.write_text("B.JPG\nimages/c.jpg\nlost.jpg\n")
    views = [view(f"{letter}.jpg", None) for letter in "abcd"]
    scene = Scene(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), report={"warnings": ["other"]})
    split, training, held = split_scene(scene, PhotoConfig(held_out=str(listed)))
    assert [one.name for one in held] == ["b.jpg"] and [one.name for one in training] == ["a.jpg", "c.jpg", "d.jpg"]
    found = f"{listed}: 2 of 3 names are of no posed photo, such as images/c.jpg; expected names such as a.jpg"
    assert split.report["warnings"] == ["other", found] and scene.report["warnings"] == ["other"]
    listed.write_text("b\nd.jpg\n")
    assert split_scene(scene, PhotoConfig(held_out=str(listed)))[0].report == scene.report
