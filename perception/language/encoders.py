"""Creates encoders from the value of `language.encoder` or `--encoder`."""

from __future__ import annotations

import numpy as np

from perception.errors import InputError
from perception.language.base import Encoder
from perception.language.clip import ClipEncoder
from perception.language.conse import ConseEncoder


def make_encoder(spec: str, pictures: bool = False) -> Encoder | None:
    """The encoder that `spec` names. Files and signatures are checked here, before any work.
    pictures: the user's own image tower is also tried on a picture.

    "conse", "auto": the offline default. "clip:IMAGE.onnx,TEXT.onnx", "clip:DIR": a CLIP-family pair. "none": None.
    Raises InputError for an unknown name, a missing package or file, and towers that do not match.
    """
    kind, _, argument = spec.partition(":")
    if kind == "none" and not argument:
        return None
    if kind in ("conse", "auto") and not argument:
        return ConseEncoder()
    if kind == "clip" and argument:
        encoder = ClipEncoder.from_spec(argument)
        if pictures:
            encoder.encode_images([np.zeros((64, 64, 3), np.uint8)])
        return encoder
    raise InputError(f"encoder '{spec}': expected conse, clip:IMAGE.onnx,TEXT.onnx, clip:DIR or none")
