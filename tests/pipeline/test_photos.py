"""What is known of held-out photos before they are compared with the map."""

from pathlib import Path

import numpy as np
import pytest

from perception.gaussians.photos import exposed_as_neighbours
from perception.types import View


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
