"""What a mask source is, and how the text of `--masks` becomes one."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from perception.config import read_toml
from perception.errors import InputError
from perception.io.model_store import default_model
from perception.progress import Progress
from perception.types import View


class MaskSource(Protocol):
    """Gives every photo a label image of its own; ids need not agree between photos.

    name: short, for messages. identity: changes whenever the label images could (the key of the cache).
    """

    name: str
    identity: str

    def check(self, views: list[View]) -> list[str]:
        """Validates everything that can be told up front. Raises InputError; returns warnings."""
        ...

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB, undistorted. Returns [h, w] int32, 0 = unlabelled."""
        ...


@runtime_checkable
class GeometryMaskSource(MaskSource, Protocol):
    """A source that needs to know about how far away each pixel is: `survey` comes before `label_image`."""

    def survey(
        self,
        views: list[View],
        load_photo: Callable[[View], np.ndarray],
        load_depth: Callable[[View], np.ndarray],
        progress: Progress | None = None,
    ) -> None:
        """Looks at all photos together, once; load_depth: view -> [h, w] z-depth, 0 = none."""
        ...


def make_source(spec: str) -> MaskSource:
    """`auto`, `builtin`, `labels:DIR`, or `sam:PATH` (folder, encoder file, or `ENCODER,DECODER`).

    `auto` takes the SAM named by the environment variable PERCEPTION_SAM or by `masks.sam` in the user's
    configuration (`perception/config.toml` under XDG_CONFIG_HOME), or made the default by `perception models add
    --default`; else the built-in segmentation.
    Files, signatures and packages are checked here, before any work; InputError names what is missing or wrong.
    """
    kind, _, argument = spec.partition(":")
    if kind == "auto" and not argument:
        configured = configured_sam()
        kind, argument = ("builtin", "") if configured is None else ("sam", configured)
    if kind == "builtin" and not argument:
        from perception.masks.builtin import BuiltinSegmentation

        return BuiltinSegmentation()
    if kind == "labels" and argument:
        from perception.masks.label_folder import LabelFolder

        return LabelFolder(Path(argument))
    if kind == "sam" and argument:
        from perception.masks.sam import SamSource

        return SamSource(argument)
    raise InputError(f"--masks {spec}: expected auto, builtin, sam:PATH or labels:DIR")


def configured_sam() -> str | None:
    """The user's SAM, a path or a stored name, or None."""
    from_environment = os.environ.get("PERCEPTION_SAM", "").strip()
    if from_environment:
        return from_environment
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    file = home / "perception" / "config.toml"
    if not file.is_file():
        return default_model("sam")
    value = read_toml(file).get("masks", {}).get("sam")
    if value is not None and not isinstance(value, str):
        raise InputError(f"{file}: masks.sam is {value!r}, expected the path of a SAM model as text")
    return value or default_model("sam")
