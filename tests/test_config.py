"""Settings: defaults, files, pairs, and the one clear line for each mistake."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perception.cli import main
from perception.config import METHOD, PAPER, MapConfig, expected, fields, load_config
from perception.errors import InputError
from perception.gaussians.train import INSTANCE_WEIGHT, SSIM_WEIGHT
from perception.instances.crops import EXPANSION


def test_pairs_override_file_overrides_preset(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("seed = 3\n[train]\niterations = 77\nbudget = 1000\n")
    config = load_config(file, ["train.budget=2000"], "fast")
    assert (config.seed, config.train.iterations, config.train.budget) == (3, 77, 2000)
    assert config.train.exchange_db == 0.1 and config.densify == load_config().densify


def test_files_are_the_same_from_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A map tells its encoder and masks to programs that run elsewhere."""
    monkeypatch.chdir(tmp_path)
    for name in ("labels, 1", "a.onnx", "b.onnx", "cam.yaml"):
        (tmp_path / name).touch()
    given = {"masks": "labels:labels, 1", "language.encoder": "clip:a.onnx, b.onnx", "photos.camera": "cam.yaml"}
    given |= {"photos.held_out": "no, such.txt", "splat.cameras": "none"}
    config = load_config(pairs=[f"{key}={value}" for key, value in given.items()])
    assert config.masks == f"labels:{tmp_path}/labels, 1" and config.photos.camera == f"{tmp_path}/cam.yaml"
    assert config.language.encoder == f"clip:{tmp_path}/a.onnx,{tmp_path}/b.onnx"
    assert config.photos.held_out == "no, such.txt" and config.splat.cameras is None
    assert load_config(pairs=["masks=sam:mobilesam"]).masks == "sam:mobilesam"
    (tmp_path / "builtin").mkdir()
    (tmp_path / "none").mkdir()
    words = load_config(pairs=["masks=builtin", "language.encoder=none"])
    assert (words.masks, words.language.encoder) == ("builtin", "none")
    assert load_config(pairs=["masks=sam:a.onnx,"]).masks == f"sam:{tmp_path}/a.onnx,"


def test_the_papers_preset_is_the_published_method() -> None:
    """Every setting of the method, spelt out: a changed default must not change what `paper` means."""
    config = load_config(None, [], "paper")
    found = {
        name: getattr(config, name).model_dump() for name in ("train", "densify", "losses", "instances", "language")
    }
    assert found == {
        "train": {
            "effort": 1, "iterations": 30_000, "time_limit": None, "exchange_db": 0, "budget": 2_000_000,
            "block_photos": 0, "sh_degree": 3,
        },
        "densify": {"every": 100, "grad_threshold": 3.5e-4, "absgrad": False},
        "losses": {
            "feature_dim": 8, "variance_weight": 0.5, "margin": 1,
            "depth_weight": 0, "start": 0, "every": 1, "half_resolution": False,
        },
        "instances": {
            "method": "hdbscan", "split": False, "settle": False, "min_cluster_size": 32, "min_samples": 16,
        },
        "language": {"encoder": "auto", "views": 5, "zooms": 3, "texts": "off"},
    }  # fmt: skip
    changed = {"max_side": 1600, "poses": "keep"}
    assert config.photos == load_config().photos.model_copy(update=changed) and config.frame == load_config().frame
    method = {key for key, _ in fields(MapConfig) if key.startswith((*METHOD, "train."))}
    assert method - set(PAPER) == {"train.time_limit"}  # the rest is listed, whatever the defaults
    assert (SSIM_WEIGHT, INSTANCE_WEIGHT, EXPANSION) == (0.2, 0.1, 0.3)  # β, λ_inst2d and the growth of the crops


def test_values_take_their_field_type() -> None:
    config = load_config(None, ["train.time_limit=30", "losses.half_resolution=false", "losses.margin=1"])
    assert config.train.time_limit == 30 and isinstance(config.losses.margin, float)
    assert config.losses.half_resolution is False
    assert load_config(None, ["train.time_limit=none"]).train.time_limit is None
    assert load_config(None, ["language.encoder=none"]).language.encoder == "none"  # a name here, no absent value


@pytest.mark.parametrize(
    ("pair", "told"),
    [
        ("train.iterations=many", "--set train.iterations: found 'many', expected a whole number from 0 to 100000000"),
        ("train.iterations=1.5", "train.iterations: found '1.5'"),
        ("train.budget=-3", "a whole number from 0 to"),
        ("train.time_limit=-1", "train.time_limit: found '-1', expected a number above 0 or none"),
        ("train.time_limit=inf", "found 'inf'"),
        ("train.time_limit=nan", "found 'nan'"),
        ("densify.every=0", "densify.every: found '0'"),
        ("losses.every=0", "losses.every: found '0'"),
        ("instances.method=mean", "consensus or hdbscan"),
        ("losses.half_resolution=perhaps", "true or false"),
        ("instances.min_samples=0", "instances.min_samples: found '0'"),
        ("device=tpu", "auto, cpu or cuda"),
        ("train.lr_means=0", "unknown setting 'train.lr_means', expected one of: train.effort, "),
        ("train.lr_scales=nan", "unknown setting 'train.lr_scales', expected one of: train.effort, "),
        ("train.min_samples=3", "did you mean instances.min_samples?"),
        ("trian.iteratons=3", "did you mean train.iterations?"),
        ("losses.geometry_start=2", "unknown setting 'losses.geometry_start'"),
        ("train.iteratons=3", "did you mean train.iterations?"),
        ("min_cluster=3", "did you mean instances.min_cluster_size?"),
        ("train=3", "group of settings"),
        ("seed.x=3", "unknown setting 'seed.x'"),
        ("seed", "KEY=VALUE"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(
    pair: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", str(tmp_path), "-o", str(tmp_path / "m.gsmap"), "--set", pair]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: --set") and told in lines[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[train\n", "not valid TOML"),
        ("seed = true\n", "seed: found True, expected a whole number"),
        ("masks = 3\n", "masks: found 3, expected text"),
        ("[train]\nbudget = [1]\n", r"train.budget: found \[1\]"),
        ("train = 3\n", "group of settings"),
        ("[train.budget]\nx = 3\n", "train.budget: found {'x': 3}"),
    ],
)
def test_bad_files_are_named(text: str, told: str, tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=rf"c\.toml.*{told}"):
        load_config(file)
    with pytest.raises(InputError, match=r"none\.toml"):
        load_config(tmp_path / "none.toml")


KEYS = dict(fields(MapConfig))
NUMBERS = st.one_of(st.integers(-5, 200_000), st.floats(), st.integers())
VALUES = st.one_of(NUMBERS.map(str), st.text(max_size=8), st.sampled_from(["none", "true", "1e3", "-0", "0x1", "1_0"]))


@pytest.mark.slow
@settings(deadline=None)  # a busy machine may pause it
@given(pairs=st.lists(st.tuples(st.sampled_from(sorted(KEYS)) | st.text(max_size=12), VALUES), max_size=4))
def test_any_pairs_are_settings_in_range_or_one_line(pairs: list[tuple[str, str]]) -> None:
    config: MapConfig | None = None
    with contextlib.suppress(InputError):
        config = load_config(None, [f"{key}={value}" for key, value in pairs])
    if config is not None:
        stored = json.loads(json.dumps(config.to_json(), allow_nan=False))
        assert MapConfig.model_validate(stored) == config
        values = {key: _value(stored, key) for key in KEYS}
        assert all(math.isfinite(value) for value in values.values() if isinstance(value, float))
        assert values["densify.every"] >= 1 and values["losses.every"] >= 1 and values["instances.min_samples"] >= 1
        assert values["train.time_limit"] is None or values["train.time_limit"] > 0
        assert values["losses.margin"] > 0 and 0 <= values["losses.start"] <= 1


def _value(stored: dict[str, Any], key: str) -> Any:
    for name in key.split("."):
        stored = stored[name]
    return stored


def test_help_of_map_lists_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["map", "--help"])
    shown = capsys.readouterr().out
    for key, field in KEYS.items():
        assert f"  {key}=" in shown and f"({expected(field)})" in shown and str(field.description) in shown
