"""The mapper's settings: typed, defaults need no file; a TOML file or KEY=VALUE pairs override single fields."""

from __future__ import annotations

import dataclasses
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from perception.errors import InputError


@dataclass(frozen=True)
class PhotoConfig:
    """What is read: long side in pixels at which the map is trained, and every `holdout`-th view kept for scoring.

    held_out: a text file of photo names (with or without suffix), one a line, that are kept for scoring instead.
    """

    max_side: int = 800
    holdout: int = 8
    held_out: str | None = None
    camera: str | None = None


@dataclass(frozen=True)
class TrainConfig:
    """Length and step sizes of the optimisation (Kerbl et al. 2023, shortened: progress drives every schedule).

    Rates of scales and colours are twice theirs, that of the higher harmonics eight times, and that of the means falls
    to a third instead of a hundredth: a tenth of their iterations leaves no time for small steps.
    exchange_db: dB of held-out PSNR that 10 % more time must buy, else growth or training ends. stop_psnr: dB at which
    training ends. cooldown: last share of the course, over which all rates fall.
    """

    iterations: int = 3000
    time_limit: float | None = None
    stop_psnr: float | None = None
    exchange_db: float = 0.03
    cooldown: float = 0.1
    budget: int = 100_000
    lr_means: float = 1.6e-4
    lr_means_final: float = 5e-5
    lr_quats: float = 1e-3
    lr_scales: float = 1e-2
    lr_opacities: float = 0.05
    lr_colors: float = 5e-3
    lr_harmonics: float = 1e-3
    lr_features: float = 1e-2
    ssim_weight: float = 0.2
    sh_degree: int = 3
    sh_min_gain_db: float = 0.05
    coarse_until: float = 0.15
    random_background: bool = True
    checkpoint_seconds: float = 20.0


@dataclass(frozen=True)
class DensifyConfig:
    """Growth by screen-space gradient up to the budget, and pruning of what no photo needs.

    Every `fill_every`-th time (0: never) places that the photos show and the map leaves empty get Gaussians first.
    """

    start: float = 0.05
    stop: float = 0.6
    every: int = 100
    grad_threshold: float = 2e-4
    percent_dense: float = 0.01
    prune_opacity: float = 0.005
    opacity_decay: float = 1e-2
    fill_every: int = 5


@dataclass(frozen=True)
class LossConfig:
    """Instance losses of OpenSplat3D; variants as its authors' tool computes them are selectable.

    Masks that begin from the map's own depth (the built-in ones) are made at progress `geometry_start`.
    From progress `start` on, every `every`-th iteration renders features too, at half the resolution if so set:
    features with their variance cost 2.5 times what colour does, and labels are smooth where photos are not.
    """

    feature_dim: int = 8
    instance_weight: float = 0.1
    variance_weight: float = 0.5
    positive_weight: float = 1.0
    negative_weight: float = 1.0
    margin: float = 1.0
    positive: str = "per-mask"
    negative: str = "squared"
    start: float = 0.3
    geometry_start: float = 0.3
    every: int = 2
    half_resolution: bool = True


@dataclass(frozen=True)
class InstanceConfig:
    """Gaussians into instances and what is kept of them.

    method "consensus": segments of like feature and place, merged as the masks of all photos agree. "hdbscan": the
    paper's clustering of features alone, then split where space does.
    """

    method: str = "consensus"
    max_segments: int = 1000
    min_cluster_size: int = 32
    min_samples: int = 16
    min_opacity: float = 0.1
    max_clustered: int = 60_000


@dataclass(frozen=True)
class LanguageConfig:
    """Encoder and view choice (paper: K = 5 views, L = 3 zooms, expansion 0.3). zooms 0: as suits the encoder.

    background of the crops: plain, dim, blur or fill; plain measured best at top-3 on two rendered scenes.
    """

    encoder: str = "auto"
    views: int = 5
    zooms: int = 0
    expansion: float = 0.3
    background: str = "plain"


@dataclass(frozen=True)
class MapConfig:
    """All settings of `perception map`."""

    seed: int = 0
    device: str = "auto"
    masks: str = "auto"
    photos: PhotoConfig = field(default_factory=PhotoConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    losses: LossConfig = field(default_factory=LossConfig)
    instances: InstanceConfig = field(default_factory=InstanceConfig)
    language: LanguageConfig = field(default_factory=LanguageConfig)

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


BACKGROUNDS = ("plain", "dim", "blur", "fill")

PRESETS: dict[str, list[str]] = {
    "default": [],
    "fast": ["train.iterations=1200", "train.budget=40000", "train.exchange_db=0.1"],
    "quality": ["train.iterations=6000", "train.budget=300000", "train.exchange_db=0.005", "photos.max_side=1280"],
}


def _parse(text: str, kind: Any, where: str) -> Any:
    """`text` (or a TOML value) as the field's type; raises InputError naming the field."""
    options = typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)
    if type(None) in options and text in (None, "none", "null", ""):
        return None
    for option in options:
        try:
            if option is bool and isinstance(text, str) and text.lower() in ("true", "false"):
                return text.lower() == "true"
            if option is bool and isinstance(text, bool):
                return text
            if option in (int, float) and not isinstance(text, bool):
                value = option(text)
                if option is int and float(text) != value:
                    continue
                return value
            if option is str and isinstance(text, str):
                return text
        except (TypeError, ValueError, OverflowError):  # the last: inf as a whole number
            continue
    names = " or ".join(getattr(option, "__name__", str(option)) for option in options)
    raise InputError(f"{where}: found {text!r}, expected {names}")


def set_value(config: Any, key: str, value: Any, where: str = "--set", prefix: str = "") -> Any:
    """A copy of a config dataclass with one dotted `key` ("train.iterations") replaced."""
    head, _, rest = key.partition(".")
    hints = typing.get_type_hints(type(config))
    if head not in hints:
        raise InputError(f"{where}: unknown setting '{prefix}{head}', expected one of: {', '.join(hints)}")
    current = getattr(config, head)
    if dataclasses.is_dataclass(current):
        if isinstance(value, dict):
            for name, inner in value.items():
                current = set_value(current, name, inner, where, f"{head}.")
        elif not rest:
            raise InputError(f"{where}: '{head}' is a group of settings, write {head}.NAME=VALUE")
        else:
            current = set_value(current, rest, value, where, f"{head}.")
        return dataclasses.replace(config, **{head: current})
    if rest:
        raise InputError(f"{where}: '{head}' has no setting '{rest}'")
    return dataclasses.replace(config, **{head: _parse(value, hints[head], f"{where} {prefix}{key}")})


def load_config(file: Path | None = None, pairs: list[str] | None = None, preset: str = "default") -> MapConfig:
    """Defaults, then the preset, then the TOML file, then KEY=VALUE pairs; checked as a whole."""
    if preset not in PRESETS:
        raise InputError(f"--preset: found '{preset}', expected one of: {', '.join(PRESETS)}")
    config = MapConfig()
    for pair in PRESETS[preset]:
        key, _, value = pair.partition("=")
        config = set_value(config, key, value)
    if file is not None:
        for key, value in _read_toml(file).items():
            config = set_value(config, key, value, str(file))
    for key, text in read_pairs(pairs or []).items():
        config = set_value(config, key, text)
    check(config)
    return config


def read_pairs(pairs: list[str]) -> dict[str, Any]:
    """KEY=VALUE texts by key; the last of equal keys counts."""
    values: dict[str, Any] = {}
    for pair in pairs:
        key, separator, value = pair.partition("=")
        if not separator:
            raise InputError(f"--set: found '{pair}', expected KEY=VALUE")
        values[key.strip()] = value.strip()
    return values


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef,import-not-found]
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); give an existing TOML file") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: not valid TOML ({error})") from error


def check(config: MapConfig) -> None:
    """Raises InputError for a value outside its meaning."""
    rules: list[tuple[str, Any, bool, str]] = [
        ("photos.max_side", config.photos.max_side, config.photos.max_side >= 16, "at least 16"),
        ("photos.holdout", config.photos.holdout, config.photos.holdout >= 0, "0 (train on all) or more"),
        ("train.iterations", config.train.iterations, config.train.iterations >= 1, "at least 1"),
        ("train.budget", config.train.budget, config.train.budget >= 100, "at least 100 Gaussians"),
        ("train.sh_degree", config.train.sh_degree, 0 <= config.train.sh_degree <= 3, "0 to 3"),
        ("train.ssim_weight", config.train.ssim_weight, 0 <= config.train.ssim_weight <= 1, "0 to 1"),
        ("losses.feature_dim", config.losses.feature_dim, 1 <= config.losses.feature_dim <= 64, "1 to 64"),
        ("losses.margin", config.losses.margin, config.losses.margin > 0, "above 0"),
        (
            "instances.min_cluster_size",
            config.instances.min_cluster_size,
            config.instances.min_cluster_size >= 2,
            ">= 2",
        ),
        ("seed", config.seed, config.seed >= 0, "0 or more"),
        ("device", config.device, config.device in ("auto", "cpu", "cuda"), "auto, cpu or cuda"),
        (
            "losses.positive",
            config.losses.positive,
            config.losses.positive in ("per-mask", "per-pixel"),
            "per-mask or per-pixel",
        ),
        (
            "instances.method",
            config.instances.method,
            config.instances.method in ("consensus", "hdbscan"),
            "consensus or hdbscan",
        ),
        ("instances.max_segments", config.instances.max_segments, config.instances.max_segments >= 2, ">= 2"),
        (
            "losses.negative",
            config.losses.negative,
            config.losses.negative in ("squared", "unsquared"),
            "squared or unsquared",
        ),
    ]
    words = config.language
    rules += [
        ("language.views", words.views, words.views >= 1, "at least 1"),
        ("language.zooms", words.zooms, words.zooms >= 0, "0 (as suits the encoder) or more"),
        ("language.expansion", words.expansion, words.expansion >= 0, "0 or more"),
        ("language.background", words.background, words.background in BACKGROUNDS, ", ".join(BACKGROUNDS)),
    ]
    limit = config.train.time_limit
    train = config.train
    rules.append(("train.cooldown", train.cooldown, 0 <= train.cooldown <= 0.5, "0 to 0.5"))
    rules.append(("train.stop_psnr", train.stop_psnr, train.stop_psnr is None or train.stop_psnr > 0, "dB above 0"))
    rules.append(("train.time_limit", limit, limit is None or limit > 0, "seconds above 0"))
    for name, value, fine, expected in rules:
        if not fine:
            raise InputError(f"{name}: found {value!r}, expected {expected}")
