"""Settings of mapping, typed and validated; a TOML file or KEY=VALUE pairs override individual defaults.

Values that users have no reason to change are named constants in the module that uses them.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import NoneType
from typing import Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator
from pydantic.fields import FieldInfo

from perception.errors import InputError, refuse_named_pipe

LARGEST_SEED = 2**31 - 1  # COLMAP's random generator takes 32-bit signed seeds


class Settings(BaseModel):
    """Base of all settings: immutable; unknown names, NaN and infinities are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _plain(cls, value: Any, info: ValidationInfo) -> Any:
        """Converts the texts that mean None, and rejects booleans for numbers."""
        kinds = _kinds(cls.model_fields[str(info.field_name)])
        if NoneType in kinds and isinstance(value, str) and value in ("none", "null", ""):
            return None
        if isinstance(value, bool) and bool not in kinds:
            raise ValueError("a truth value")
        return value


KINDS = ("labels:", "sam:", "clip:")


def _paths(*names: str) -> Any:
    """A validator of settings that name files, as PATH, or for masks and encoders as KIND:PATH,PATH: paths are made
    absolute, to mean the same files in another folder. What is not there, as the name of a stored model, stays; but
    models aside, all paths lie in the `folder` of `settings_from` if there is one."""

    def absolute(value: str | None, info: ValidationInfo) -> str | None:
        spec, folder = info.field_name in ("masks", "encoder"), (info.context or {}).get("folder")
        if value is None or (spec and not value.startswith(KINDS)):  # a word such as "auto"
            return value
        kind, colon, named = value.partition(":") if spec else ("", "", value)
        models = kind in ("sam", "clip")

        def found(part: str) -> str | None:
            path = (folder or Path()) / part  # Path.exists raises for a name that is too long
            there = (folder and not models) or (part and os.path.exists(path))  # noqa: PTH110
            return str(path.absolute()) if there else None

        return kind + colon + (found(named) or ",".join(found(part.strip()) or part for part in named.split(",")))

    return field_validator(*names)(absolute)


class PhotoConfig(Settings):
    max_side: int = Field(800, ge=16, le=65536, description="pixels of the long side at which the map is trained")
    holdout: int = Field(
        8,
        ge=0,
        le=10**6,
        description="every N-th photo, or the test part of the input, is kept for scoring; 0: all are trained on",
    )
    held_out: str | None = Field(None, description="text file of the photos kept for scoring instead, a name a line")
    camera: str | None = Field(None, description="ROS camera_info YAML: the intrinsics of all photos, kept fixed")
    ignore_masks: str | None = Field(None, description="folder of PNG masks, same stem as the photo: black is ignored")
    ignore_still: bool = Field(
        True, description="ignore what stays in the picture while the camera moves: a gripper, a bumper, dirt, a date"
    )
    init_points: str | None = Field(None, description="cloud in the frame of the input's poses to start training from")
    poses: Literal["auto", "keep", "refine"] = Field(
        "auto", description="given poses: refined where matched features show that they are wrong, kept, or refined"
    )
    strict: bool = Field(False, description="refuse a damaged photo instead of leaving it out")
    _absolute = _paths("held_out", "camera", "ignore_masks", "init_points")
    memory: str | None = Field(
        None,
        pattern=r"(?i)^[1-9][0-9]*[MG]i?B?$",
        title="a size such as 500M or 8G",
        description="memory for photos, labels and depth, and as much for votes of masks; what does not fit is on "
        "disk; none: a quarter of the machine's",
    )


class FrameConfig(Settings):
    keep_world: bool | None = Field(None, description="keep the input's frame and unit; none: if the input has poses")
    known_length: str | None = Field(None, description="METRES: PHOTO X,Y X,Y; PHOTO X,Y X,Y: a length, by its pixels")
    tag_size: float | None = Field(
        None, gt=0, le=1000, description="metres: black square of the AprilTags or ArUco markers in the photos"
    )
    board: str | None = Field(None, description="KIND:COLSxROWS:SQUARE[:MARKER[:DICTIONARY]]: a board in the photos")


class SplatConfig(Settings):
    cameras: str | None = Field(None, description="of a finished splat: COLMAP model or transforms.json, used first")
    up: str | None = Field(None, description="of a finished splat: z, -y, ... or X,Y,Z; none: as its floor lies")
    unit: str | None = Field(None, pattern="^metre$", title="metre", description="of a finished splat, if known")
    _absolute = _paths("cameras")


class SamConfig(Settings):
    points_per_side: int = Field(32, ge=1, le=256, description="side of the grid of point prompts")
    skip_covered: bool = Field(
        True, description="leave out prompts that lie in the smallest good mask of an earlier one; false: as published"
    )
    pred_iou: float = Field(0.88, ge=0, le=1, description="smallest IoU of a mask as the model predicts it")
    stability: float = Field(0.95, ge=0, le=1, description="smallest IoU of the masks cut at logits of -1 and 1")


class TrainConfig(Settings):
    effort: float = Field(
        1.0, ge=0.01, le=100, description="multiple of the iterations and Gaussians that the number of photos suggests"
    )
    iterations: int = Field(
        0, ge=0, le=10**8, description="iterations of training, all schedules scale with them; 0: 2000, or 46 a photo"
    )
    time_limit: float | None = Field(None, gt=0, description="seconds of training; all schedules shrink to fit")
    exchange_db: float = Field(
        0.03,
        ge=0,
        le=1000,
        description="dB of held-out PSNR that 10 % more time must gain, else training ends; 0: never",
    )
    budget: int = Field(
        0, ge=0, le=10**8, description="most Gaussians of the map, or of each block; 0: 100,000, or 2,300 a photo"
    )
    block_photos: int = Field(
        400, ge=0, le=10**6, description="a scene of more photos is trained in overlapping blocks; 0: never"
    )
    sh_degree: int = Field(3, ge=0, le=3, description="highest degree of the spherical harmonics that is tried")


class DensifyConfig(Settings):
    every: int = Field(100, ge=1, le=10**8, description="iterations between two steps of growth and pruning")
    grad_threshold: float = Field(
        1e-4, ge=0, description="gradient of the 2D mean from which a Gaussian grows; units of half the long side"
    )
    absgrad: bool = Field(
        True, description="that gradient sums absolute values over pixels (AbsGS, Ye et al. 2024), not signed ones"
    )


class LossConfig(Settings):
    feature_dim: int = Field(8, ge=1, le=64, description="dimensions D of the instance features")
    variance_weight: float = Field(0.5, ge=0, le=1000, description="weight λ_var of the variance loss (eq. 13)")
    margin: float = Field(1.0, gt=0, le=1000, description="margin γ of L_neg (eq. 8), in units of ‖z‖²")
    depth_weight: float = Field(
        0.5, ge=0, le=1000, description="weight of the loss of measured depth; 0: neither that nor depth by stereo"
    )
    start: float = Field(0.3, ge=0, le=1, description="share of the training after which features are trained")
    every: int = Field(3, ge=1, le=10**8, description="features are trained in every N-th iteration")
    half_resolution: bool = Field(
        True, description="features, and everything at the start, are trained at half the resolution of the photos"
    )


class InstanceConfig(Settings):
    method: Literal["consensus", "hdbscan"] = Field(
        "consensus", description="segments merged as all masks agree, or the paper's clustering of features alone"
    )
    split: bool = Field(True, description="clusters of HDBSCAN are split into parts that are connected in space")
    settle: bool = Field(
        True, description="Gaussians join the instance that masks and neighbours agree on, and specks are dropped"
    )
    min_cluster_size: int = Field(32, ge=2, le=10**6, description="Gaussians of the smallest instance")
    min_samples: int = Field(16, ge=1, le=10_000, description="neighbours that define a density (HDBSCAN)")


class LanguageConfig(Settings):
    encoder: str = Field("auto", description="auto, none, conse or clip:FOLDER: what describes the instances")
    views: int = Field(5, ge=1, le=1000, description="best views K that describe an instance (paper: 5)")
    zooms: int = Field(0, ge=0, le=20, description="crops L of each view (paper: 3); 0: as suits the encoder")
    texts: Literal["auto", "on", "off"] = Field(
        "auto", description="reading of printed texts; auto: if the extra ocr is installed"
    )
    _absolute = _paths("encoder")


class MapConfig(Settings):
    """All settings of `perception map`, whose --help prints descriptions and ranges. Made by `load_config`, which
    raises InputError for a setting that is unknown or out of range.

    >>> MapConfig(seed=3).to_json()["seed"]
    3
    """

    seed: int = Field(0, ge=0, le=LARGEST_SEED, description="of all random choices")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="what trains; auto: a GPU if one works")
    masks: str = Field("auto", description="auto, builtin, sam:PATH or labels:DIR: where object masks come from")
    sam: SamConfig = SamConfig()
    photos: PhotoConfig = PhotoConfig()
    frame: FrameConfig = FrameConfig()
    splat: SplatConfig = SplatConfig()
    train: TrainConfig = TrainConfig()
    densify: DensifyConfig = DensifyConfig()
    losses: LossConfig = LossConfig()
    instances: InstanceConfig = InstanceConfig()
    language: LanguageConfig = LanguageConfig()
    _absolute = _paths("masks")

    def part(self, share: float) -> MapConfig:
        """The settings of one of several trainings of a run, which has `share` of the time limit if there is one."""
        limit = self.train.time_limit and share * self.train.time_limit
        return self.model_copy(update={"train": self.train.model_copy(update={"time_limit": limit})})

    def to_json(self) -> dict[str, Any]:
        """All settings as nested dicts, as `config` of map.json."""
        return self.model_dump()


PAPER: dict[str, Any] = {
    "sam.skip_covered": False,
    "photos.max_side": 1600,
    "photos.poses": "keep",
    "train.effort": 1.0,
    "train.block_photos": 0,
    "train.iterations": 30_000,
    "train.exchange_db": 0.0,
    "train.budget": 2_000_000,
    "train.sh_degree": 3,
    "densify.every": 100,
    "densify.grad_threshold": 3.5e-4,
    "densify.absgrad": False,
    "losses.feature_dim": 8,
    "losses.variance_weight": 0.5,
    "losses.margin": 1.0,
    "losses.depth_weight": 0.0,
    "losses.start": 0.0,
    "losses.every": 1,
    "losses.half_resolution": False,
    "instances.method": "hdbscan",
    "instances.split": False,
    "instances.settle": False,
    "instances.min_cluster_size": 32,
    "instances.min_samples": 16,
    "language.views": 5,
    "language.zooms": 3,
    "language.texts": "off",
}
"""OpenSplat3D as published: 30k iterations, each training all parameters at full resolution (3DGS reduces photos wider
than 1600 pixels), with the densification threshold of the authors' LERF configuration; then HDBSCAN of the features
alone. docs/benchmarks.md lists what still differs from the paper."""

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "fast": {"train.effort": 0.4, "train.exchange_db": 0.1},
    "quality": {"train.effort": 2.0, "train.exchange_db": 0.005, "photos.max_side": 1280},
    "paper": PAPER,
}

METHOD = ("densify.", "losses.", "instances.", "train.sh_degree", "language.views", "language.zooms")
"""Prefixes of the settings that change the method, for experiments; the others are for users."""

AnySettings = TypeVar("AnySettings", bound=Settings)


def load_config(
    file: Path | None = None,
    pairs: list[str] | None = None,
    preset: str = "default",
    given: Mapping[str, tuple[Any, str]] | None = None,
    folder: Path | None = None,
    options: Mapping[str, tuple[Any, str]] | None = None,
) -> MapConfig:
    """Defaults, overridden by the preset, `given` settings (see `settings_from`), the TOML file, KEY=VALUE pairs and
    `options`, as `given`. folder: that of relative paths in settings; None: the current one. InputError: the first.

    >>> config = load_config(pairs=["train.iterations=500", "masks=labels:labels"], preset="fast")
    >>> config.train.iterations, config.train.effort, config.masks
    (500, 0.4, 'labels:labels')
    """
    if preset not in PRESETS:
        raise InputError(f"--preset: found '{preset}', expected one of: {', '.join(PRESETS)}")
    given = {key: (value, "--preset") for key, value in PRESETS[preset].items()} | dict(given or {})
    if file is not None:
        given |= {key: (value, str(file)) for key, value in flat(read_toml(file))}
    given |= {key: (text, "--set") for key, text in read_pairs(pairs or []).items()}
    return settings_from(MapConfig, given | dict(options or {}), folder)


def settings_from(
    model: type[AnySettings], given: Mapping[str, tuple[Any, str]], folder: Path | None = None
) -> AnySettings:
    """The model with the given settings: dotted key -> (value, --set, --preset, a file, or the option of this setting
    alone). folder: as of `load_config`.

    Raises InputError with key, value and range for the first setting that is unknown, of another type or out of range.
    """
    known = dict(fields(model))
    nested: dict[str, Any] = {}
    for key, (value, where) in given.items():
        if key not in known:
            raise InputError(f"{where}: {_unknown(key, list(known))}")
        group, _, name = key.rpartition(".")
        (nested.setdefault(group, {}) if group else nested)[name] = value
    try:
        return model.model_validate(nested, context={"folder": folder})
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        key = next(key for key in known if key.split(".") == list(first["loc"])[: key.count(".") + 1])
        value, where = given[key]
        what = where if where.startswith("--") and where not in ("--set", "--preset") else f"{where} {key}"
        raise InputError(f"{what}: found {_short(value)}, expected {expected(known[key])}") from None


def fields(model: type[Settings]) -> Iterator[tuple[str, FieldInfo]]:
    """(dotted key, field) of all settings of a model."""
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, Settings):
            yield from ((f"{name}.{key}", value) for key, value in fields(inner))
        else:
            yield name, field


def expected(field: FieldInfo) -> str:
    """Type and range of a setting as text; a field's `title` gives it if the constraints do not."""
    kinds = _kinds(field)
    if field.title:
        text = field.title
    elif isinstance(kinds[0], str):  # a Literal
        text = ", ".join(kinds[:-1]) + f" or {kinds[-1]}"
    else:
        text = {bool: "true or false", str: "text", int: "a whole number", float: "a number"}[kinds[0]]
        for name, relation in (("gt", "above"), ("ge", "from"), ("le", "to")):
            text += "".join(f" {relation} {getattr(m, name)}" for m in field.metadata if hasattr(m, name))
    return f"{text} or none" if NoneType in kinds else text


def read_pairs(pairs: list[str]) -> dict[str, Any]:
    """KEY=VALUE texts by key; the last of equal keys is used."""
    values: dict[str, Any] = {}
    for pair in pairs:
        key, separator, value = pair.partition("=")
        if not separator:
            raise InputError(f"--set: found '{pair}', expected KEY=VALUE")
        values[key.strip()] = value.strip()
    return values


def _kinds(field: FieldInfo) -> tuple[Any, ...]:
    """The types a field may have, or the values of a Literal."""
    return get_args(field.annotation) or (field.annotation,)


def _unknown(key: str, known: list[str]) -> str:
    if any(name.startswith(f"{key}.") for name in known):
        return f"'{key}' is a group of settings, write {key}.NAME=VALUE"
    head, _, last = key.rpartition(".")
    group = [name for name in known if name.startswith(f"{head}.")] if head else []
    near = _like(last, group, 0.6) or _like(last, known, 0.75) or difflib.get_close_matches(key, known, 1, 0.8)
    if near:
        return f"unknown setting '{key}', did you mean {' or '.join(near)}?"
    return f"unknown setting '{_short(key)[1:-1]}', expected one of: {', '.join(group or known)}"


def _like(name: str, known: list[str], least: float) -> list[str]:
    """The settings whose last name is the one nearest to `name`, when their similarity is at least `least`."""
    last = {key: key.rpartition(".")[2] for key in known}
    near = difflib.get_close_matches(name, sorted(set(last.values())), 1, least)
    return [key for key in known if last[key] in near]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def flat(table: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of a TOML table of settings and groups of them."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from ((f"{name}.{key}", inner) for key, inner in value.items())
        else:
            yield name, value


def read_toml(file: Path) -> dict[str, Any]:
    """The tables of a TOML file; InputError if it cannot be read or is not valid TOML."""
    refuse_named_pipe(file)
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef,import-not-found]
    try:
        return tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); give an existing TOML file") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: not valid TOML ({error})") from error
