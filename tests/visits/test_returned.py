"""A thing that was away comes back under its id: what the map keeps of it, and the record of its visits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.changes.evidence import signs_from
from perception.changes.motion import Motion
from perception.colors import rgb_from_sh
from perception.edit.scale import scaled
from perception.errors import InputError
from perception.map.history import changes_of, stood, visits_of
from perception.map.map import Map
from perception.map.write import read_map, write_map
from perception.visits.record import as_it_was, past_with, recorded
from support.visited_map import ball, number, write_visited_map

DRUM, MUG, LIGHT = number("drum"), number("mug"), np.array([0.8, 1.0, 1.25])
SIGNS = signs_from(np.array([3, 900, 0.1, 1, 1, 90, 900, 300, 500, 400, 50], float), 1.0)
"""Of a thing that does not stand there."""


def later(gmap: Map, light: np.ndarray, motion: Motion | None, path: Path) -> Map:
    """The map, written and read, after one more visit: the drum is gone, or back after `motion`; all else stays."""
    visit, back = len(gmap.info["visits"]), motion is not None
    entries = [
        recorded(e, visit, SIGNS, motion if e["id"] == DRUM else None, e["id"] == DRUM and not back)
        for e in gmap.instances
    ]
    entries = [{**e, "num_gaussians": 200} if back and e["id"] == DRUM else e for e in entries]
    stays = gmap.instance_ids != DRUM
    info = {**gmap.info, "visits": [*gmap.info["visits"], {"time": None, "input": "later", "photos": 2}]}
    names = ("means", "quats", "log_scales", "opacity_logits", "sh", "features", "instance_ids", "membership")
    rows = np.flatnonzero(stays)
    if back:  # the test needs no more than some Gaussians there
        rows = np.concatenate([rows, np.flatnonzero(gmap.instance_ids == number("violin"))])
    arrays = {name: getattr(gmap, name)[rows] for name in names}
    arrays["instance_ids"][stays.sum() :] = DRUM
    past = past_with(gmap, [] if back else [DRUM], visit - 1, light)
    write_map(path, Map.of(gmap, **arrays, instances=entries, info=info, past=past))
    return read_map(path)


def entry_of(gmap: Map, instance: int) -> dict[str, Any]:
    return next(entry for entry in gmap.instances if entry["id"] == instance)


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Map, Map, Map]:
    """Of visit 2, where the drum stands; of visit 3, where it is gone; of visit 4, where it is back."""
    folder = tmp_path_factory.mktemp("back")
    first = read_map(write_visited_map(folder / "a.gsmap"))
    gone = later(first, LIGHT, None, folder / "b.gsmap")
    motion = np.eye(4)
    motion[:3, 3] = [0.5, -1, 0]
    return first, gone, later(gone, LIGHT, Motion(motion, 3.0, axis=np.array([0, 0, 1.0])), folder / "c.gsmap")


def test_the_map_keeps_what_a_thing_looked_like_in_the_light_of_the_newest_visit(maps: tuple[Map, Map, Map]) -> None:
    first, gone, _ = maps
    rows = first.instance_ids == DRUM
    was = as_it_was(gone, entry_of(gone, DRUM))
    assert was is not None and np.array_equal(was.means.numpy(), ball("drum", 5))
    # The arrays have half precision: 11 bits.
    assert np.allclose(rgb_from_sh(was.sh[:, 0].numpy()), rgb_from_sh(first.sh[rows, 0]) * LIGHT, rtol=2e-3)
    assert np.allclose(was.log_scales.numpy(), first.log_scales[rows], rtol=1e-3)
    assert np.array_equal(was.opacity_logits.numpy(), first.opacity_logits[rows])
    assert np.array_equal(was.quats.numpy(), first.quats[rows]) and not was.sh[:, 1:].any()
    assert as_it_was(gone, entry_of(gone, MUG)) is None, "of what was removed before, the means alone are known"
    again = past_with(gone, [], 3, LIGHT)
    drum = again["ids"] == DRUM
    assert np.allclose(again["colors"][drum], rgb_from_sh(first.sh[rows, 0]) * LIGHT**2, rtol=4e-3)


def test_what_is_scaled_is_scaled_away_too(maps: tuple[Map, Map, Map]) -> None:
    before, after = (as_it_was(m, entry_of(m, DRUM)) for m in (maps[1], scaled(maps[1], 3.0)))
    assert before is not None and after is not None
    assert np.allclose(after.means, 3 * before.means) and np.allclose(after.scales, 3 * before.scales, rtol=2e-3)


def test_a_thing_that_is_back_was_away_and_has_moved(maps: tuple[Map, Map, Map]) -> None:
    back = maps[2]
    entry, visits = entry_of(back, DRUM), visits_of(back.info)
    assert entry["state"] == "added" and entry["past"][-1]["gone"] and entry["last_seen"] == 4
    assert [stood(entry, visit) is not None for visit in range(5)] == [False, False, True, False, True]
    told = {
        start: {c["instance_id"]: c for c in changes_of(visits, back.instances, start)}.get(DRUM) for start in (2, 3)
    }
    assert told[3] is not None and told[3]["state"] == "added"
    assert told[2] is not None and told[2]["state"] == "moved" and told[2]["axis"] == [0, 0, 1]
    assert np.allclose(np.array(told[2]["transform"])[:3, 3], [0.5, -1, 0])
    assert entry_of(back, MUG) == entry_of(maps[0], MUG), "what stays away stays as it was"


def test_half_of_what_a_thing_looked_like_is_refused(maps: tuple[Map, Map, Map], tmp_path: Path) -> None:
    past = {name: array for name, array in maps[1].past.items() if name != "colors"}
    write_map(tmp_path / "d.gsmap", Map.of(maps[1], past=past))
    with pytest.raises(InputError, match=r"past\.npz: colors: is missing"):
        read_map(tmp_path / "d.gsmap")
