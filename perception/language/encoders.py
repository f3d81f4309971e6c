"""Encoders by name: what `language.encoder` and `--encoder` may say."""

from __future__ import annotations

from perception.errors import InputError
from perception.language.base import Encoder
from perception.language.clip import ClipEncoder
from perception.language.conse import ConseEncoder


def make_encoder(spec: str) -> Encoder | None:
    """The encoder named by `spec`; its files and their signatures are checked here, before any work.

    "conse": the offline default. "clip:IMAGE.onnx,TEXT.onnx" or "clip:DIR": a CLIP-family pair. "none": None.
    Raises InputError for an unknown name, a package or a file that is missing, and towers that do not fit.
    """
    kind, _, argument = spec.partition(":")
    if kind == "none" and not argument:
        return None
    if kind == "conse" and not argument:
        return ConseEncoder()
    if kind == "clip" and argument:
        return ClipEncoder.from_spec(argument)
    raise InputError(f"encoder '{spec}': expected conse, clip:IMAGE.onnx,TEXT.onnx, clip:DIR or none")
