"""The parser of the `--masks` option."""

from __future__ import annotations

import os
from pathlib import Path

from perception.config import SamConfig
from perception.errors import InputError
from perception.masks.base import MaskSource


def make_source(spec: str, sam: SamConfig | None = None) -> MaskSource:
    """Parses `auto`, `builtin`, `labels:DIR`, or `sam:PATH` (folder, encoder, `ENCODER,DECODER`).

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
