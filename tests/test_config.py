"""Settings: defaults, files, pairs, and the one clear line for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from perception.config import load_config
from perception.errors import InputError


def test_pairs_override_file_overrides_preset(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("seed = 3\n[train]\niterations = 77\nbudget = 1000\n")
    config = load_config(file, ["train.budget=2000"], "fast")
    assert (config.seed, config.train.iterations, config.train.budget) == (3, 77, 2000)
    assert config.densify == load_config().densify


def test_values_take_their_field_type() -> None:
    config = load_config(None, ["train.time_limit=30", "train.random_background=false", "train.lr_means=1"])
    assert config.train.time_limit == 30 and isinstance(config.train.lr_means, float)
    assert config.train.random_background is False
    assert load_config(None, ["train.time_limit=none"]).train.time_limit is None


@pytest.mark.parametrize(
    ("pair", "told"),
    [
        ("train.iterations=many", "train.iterations"),
        ("train.iterations=1.5", "expected int"),
        ("train.speed=3", "speed"),
        ("speed=3", "unknown setting"),
        ("train=3", "group of settings"),
        ("seed.x=3", "has no setting"),
        ("seed", "KEY=VALUE"),
        ("train.budget=3", "at least 100"),
        ("losses.positive=mean", "per-mask or per-pixel"),
        ("train.time_limit=-1", "above 0"),
        ("device=tpu", "auto, cpu or cuda"),
    ],
)
def test_mistakes_are_named(pair: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        load_config(None, [pair])


def test_bad_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml"):
        load_config(tmp_path / "none.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("[train\n")
    with pytest.raises(InputError, match="not valid TOML"):
        load_config(broken)
