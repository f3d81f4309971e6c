"""How second visits are scored: what nobody can tell is right either way."""

from __future__ import annotations

import numpy as np

from score.visits import Truth


def test_things_of_one_name_that_came_and_went_look_alike() -> None:
    names = {1: "cactus", 2: "blue mug", 3: "cactus 25", 4: "purple mug 26", 5: "chair 2", 6: "cactus 27"}
    states = {1: "removed", 2: "removed", 3: "added", 4: "added", 5: "moved", 6: "unchanged"}
    entries = {n: {"id": n, "name": names[n], "state": states[n]} for n in names}
    none = np.zeros((0, 3)), np.zeros((0, 3))
    assert Truth(none, none, entries).look_alikes() == [(3, 1)]
