"""What a map's report says of the map: how to make it again, and what is missing."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from perception.config import load_config
from perception.pipeline.reporting import _left_out, rerun_command


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
    from perception.cli.mapping import settings_given

    config = load_config(None, pairs, preset)
    info = {"source": "my photos/", "seed": config.seed, "config": config.to_json()}
    words = shlex.split(rerun_command(info, Path("a b.gsmap")))
    args = build_parser().parse_args(words[1:])
    assert (str(args.input), args.output) == ("my photos", Path("a b.gsmap"))
    assert load_config(args.config, settings_given(args), args.preset) == config


def test_photos_that_are_not_in_the_map_are_named_by_reason() -> None:
    lost = [{"name": f"{i}.jpg", "why": "too blurred"} for i in range(14)] + [{"name": "x.jpg", "why": "no overlap"}]
    told = _left_out({"left_out": lost})
    assert len(told) == 2
    assert told[0].startswith("14 photos not in the map, too blurred: 0.jpg, ") and told[0].endswith(" and 2 more")
    assert told[1] == "1 photo not in the map, no overlap: x.jpg"
    assert _left_out({}) == []
