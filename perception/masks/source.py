"""The interface of mask sources, and the parser of the `--masks` option."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import numpy as np

from perception.config import SamConfig
from perception.errors import InputError
from perception.types import View


class MaskSource(Protocol):
    """Gives each photo a label image. Ids need not be consistent across photos.

    name: short, for messages. identity: cache key; it changes whenever the label images could change.
    A source may have `photos_at_once`, the number of threads in which `label_image` is called; else it is one.
    """

    name: str
    identity: str

    def check(self, views: list[View]) -> list[str]:
        """Validates everything that can be checked before any work. Returns warnings. Raises InputError."""

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB, undistorted. Returns [h, w] int32, 0 = unlabelled."""


def make_source(spec: str, sam: SamConfig | None = None) -> MaskSource:
    """Parses `auto`, `builtin`, `labels:DIR`, or `sam:PATH` (folder, encoder file, or `ENCODER,DECODER`).

    `auto` uses the SAM that the environment variable PERCEPTION_SAM names; without one it is `builtin`. Files, model
    signatures and packages are checked here, before any work. InputError names what is missing or wrong. sam: settings
    of SAM's mask generation; None: the defaults.
    """
    kind, _, argument = spec.partition(":")
    if kind == "auto" and not argument:
        argument = os.environ.get("PERCEPTION_SAM", "").strip()
        kind = "sam" if argument else "builtin"
    if kind == "builtin" and not argument:
        from perception.masks.builtin import BuiltinSegmentation

        return BuiltinSegmentation()
    if kind == "labels" and argument:
        from perception.masks.label_folder import LabelFolder

        return LabelFolder(Path(argument))
    if kind == "sam" and argument:
        from perception.masks.sam import SamSource

        return SamSource(argument, sam or SamConfig())
    raise InputError(f"--masks {spec}: expected auto, builtin, sam:PATH or labels:DIR")
