"""`tools/score/places.py`: its figures against hand-made reports, and things found in boxes whose points are known."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perception.errors import InputError
from score.places import places, rows_of, share_found, text_of


def one(place: str, seed: int, ap: float) -> dict[str, Any]:
    return {"place": place, "seed": seed, "ap": ap, "instances": 3, "cpu_seconds": 60.0}


def test_spread_is_over_seeds_and_the_worst_tenth_over_maps() -> None:
    maps = [one("a", 0, 0.4), one("a", 1, 0.6), one("b", 0, 0.9), one("b", 1, 0.9)]
    a, b, every = rows_of(maps)
    assert a["ap_mean"] == pytest.approx(0.5) and a["ap_spread"] == pytest.approx(0.2 / 2**0.5)
    assert b["ap_spread"] == 0 and every["ap_mean"] == pytest.approx(0.7)
    assert every["ap_spread"] == pytest.approx(0.1)  # sqrt((.02 + 0) / 2)
    assert every["ap_worst"] == a["ap_worst"] == 0.4 and "own_mean" not in every


def test_another_run_is_compared_in_the_maps_of_both() -> None:
    now, then = [one("a", 0, 0.5), one("b", 0, 0.9)], [one("a", 0, 0.3), one("c", 0, 0.1)]
    changed = text_of(now, then).partition("less the other run's:")[2]
    assert "+0.200" in changed and "b" not in changed.split()


def test_unknown_places_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="castle, expected some of tabletop-71"):
        places(tmp_path, ["castle"])


def test_a_thing_is_found_by_half_of_an_instance_that_covers_a_quarter(tmp_path: Path) -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-0.1, 0.1, 5)] * 3), axis=-1).reshape(-1, 3)
    away = np.array([5.0, 0, 0])
    box = {"center": [0, 0, 0], "axes": np.eye(3).tolist(), "half": [0.1] * 3}
    far = {"center": [5, 0, 0], "axes": np.eye(3).tolist(), "half": [0.1] * 3}
    things = [{"id": 1, "is_stuff": False, "obb": box}, {"id": 2, "is_stuff": False, "obb": far}]
    (tmp_path / "scene.json").write_text(json.dumps({"instances": things}), encoding="utf-8")
    np.savez(tmp_path / "points.npz", points=np.concatenate([grid, grid + away]), instance=np.repeat([1, 2], 125))
    stray = np.tile([[5.0, 3, 0]], (130, 1))  # more than half of the second instance lies elsewhere
    means = np.concatenate([grid, grid + away, stray])
    ids = np.repeat([0, 1], [125, 255])
    gmap = SimpleNamespace(instances=[{"id": 0}, {"id": 1}], instance_ids=ids, means=means, info={})
    assert share_found(gmap, tmp_path) == 0.5  # type: ignore[arg-type]
