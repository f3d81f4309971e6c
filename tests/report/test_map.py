"""What a map's report says of the map: how to make it again, what is missing, where things stand."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest

from perception.colors import instance_palette
from perception.config import load_config
from perception.io.store import Map
from perception.pipeline.reporting import _left_out, rerun_command
from perception.pipeline.top_view import instances_top_view
from support.views_at import views_at


@pytest.mark.parametrize(
    "pairs",
    [
        [],
        ["masks=labels:my labels", "train.time_limit=60", "losses.half_resolution=false", "seed=7"],
        ["photos.holdout=0", "instances.method=hdbscan", "densify.grad_threshold=1e-5"],
    ],
)
@pytest.mark.parametrize("preset", ["default", "quality"])
def test_the_command_that_makes_a_map_again_means_the_same_settings(pairs: list[str], preset: str) -> None:
    """The command is given to the program's own parser, and the settings it comes to are compared."""
    from perception.cli import build_parser
    from perception.cli.mapping import _SHORTCUTS

    config = load_config(None, pairs, preset)
    info = {"source": "my photos/", "seed": config.seed, "config": config.to_json()}
    words = shlex.split(rerun_command(info, Path("a b.gsmap")))
    args = build_parser().parse_args(words[1:])
    given = [f"{key}={getattr(args, name)}" for name, key in _SHORTCUTS.items() if getattr(args, name) is not None]
    assert (str(args.input), args.output) == ("my photos", Path("a b.gsmap"))
    assert load_config(args.config, args.pairs + given, args.preset) == config


def test_photos_that_are_not_in_the_map_are_named_by_reason() -> None:
    lost = [{"name": f"{i}.jpg", "why": "too blurred"} for i in range(14)] + [{"name": "x.jpg", "why": "no overlap"}]
    told = _left_out({"left_out": lost})
    assert len(told) == 2
    assert told[0].startswith("14 photos not in the map, too blurred: 0.jpg, ") and told[0].endswith(" and 2 more")
    assert told[1] == "1 photo not in the map, no overlap: x.jpg"
    assert _left_out({}) == []


def plan(ceiling: bool) -> Map:
    """Balls on the ground (z up), id 0 at x = 0 and 1 at x = 4, perhaps a ceiling; a camera at z = 2 looks along y."""
    rng = np.random.default_rng(0)
    count = 400
    places = [[0.0, 0, 0], [4.0, 0, 0]] + [[2.0, 0, 3]] * ceiling
    means = np.concatenate([np.array(place) + rng.normal(0, 0.05, (count, 3)) for place in places])
    if ceiling:
        means[2 * count :, :2] += rng.uniform(-4, 4, (count, 2))
    n = len(means)
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # right = x, down = -z, forward = y
    pose[:3, 3] = -pose[:3, :3] @ [2, -1, 2]
    return Map(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.full((n, 3), np.log(0.1), np.float32),
        np.full(n, 4, np.float32),
        np.zeros((n, 1, 3), np.float32),
        np.zeros((n, 4), np.float32),
        np.repeat(np.arange(len(places)), count).astype(np.int32),
        np.ones(n, np.float32),
        [],
        {"metric": True},
        views_at([pose]),
    )


@pytest.mark.parametrize("ceiling", [False, True])
def test_from_above_things_lie_where_they_are_and_the_ceiling_is_lifted_off(ceiling: bool) -> None:
    side = 240
    picture = instances_top_view(plan(ceiling), side).astype(int)
    colors = instance_palette(np.arange(3)).astype(int)
    found = [np.argwhere(np.abs(picture - color).max(axis=2) < 12) for color in colors]
    (row0, column0), (row1, column1) = (spots.mean(axis=0).tolist() for spots in found[:2])
    assert abs(row0 - row1) < 3 and abs((row0 + row1) / 2 - side / 2) < 6
    assert column0 < column1  # x runs right, as it does for the camera
    pixels = (column1 - column0) / 4  # a unit's
    assert len(found[2]) == 0
    bar = np.flatnonzero(np.abs(picture[side - 16] - 70).max(axis=1) < 12)
    assert abs((bar[-1] - bar[0]) / pixels - 1) < 0.1  # the round length below a third of four and a bit
    camera = picture[round((row0 + row1) / 2 + pixels), round((column0 + column1) / 2)]
    assert np.abs(camera - 70).max() < 12  # at y = -1: one unit towards the reader


def test_a_map_without_solid_instances_is_a_white_plan() -> None:
    gmap = plan(False)
    gmap.instance_ids[:] = -1
    assert (instances_top_view(gmap, 50) == 255).all()
