"""How second visits are scored: what nobody can tell is right either way."""

from __future__ import annotations

import numpy as np

from perception.map.map import Map
from score.visits import Truth, as_cut


def test_things_of_one_name_that_came_and_went_look_alike() -> None:
    names = {1: "cactus", 2: "blue mug", 3: "cactus 25", 4: "purple mug 26", 5: "chair 2", 6: "cactus 27"}
    states = {1: "removed", 2: "removed", 3: "added", 4: "added", 5: "moved", 6: "unchanged"}
    entries = {n: {"id": n, "name": names[n], "state": states[n]} for n in names}
    none = np.zeros((0, 3)), np.zeros((0, 3))
    assert Truth(none, none, entries).look_alikes() == [(3, 1)]


def test_a_map_is_scored_by_its_instances_as_the_update_found_them() -> None:
    """Of instance 3, the third Gaussian went as instance 8 and the fourth moved; one of no instance stays so; and what
    left the map of instance 4 is of it."""
    means, ids = np.arange(18, dtype=np.float32).reshape(6, 3), np.array([3, 3, 3, 3, -1, 4], np.int32)
    other = {name: np.zeros((6, 0), np.float32) for name in ("quats", "log_scales", "opacity_logits", "sh", "features")}
    before = Map(means, **other, instance_ids=ids, membership=np.ones(6, np.float32))
    moved = np.array([[9.0, 0, 0]], np.float32)
    past = {"means": means[[2, 3, 0]], "ids": np.array([8, 9, 7]), "until": np.array([1, 1, 0])}
    today = np.concatenate([means[[0, 1, 4]], moved])
    known = {"instance_ids": np.array([3, 3, -1, 9], np.int32), "past": past, "info": {"visits": [{}, {}, {}]}}
    after = Map(today, **other, membership=np.ones(4, np.float32), **known)
    assert as_cut(before, after).instance_ids.tolist() == [3, 3, 8, 9, -1, 4]
