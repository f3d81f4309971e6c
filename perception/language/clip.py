"""CLIP-family encoders through onnxruntime: a pair of ONNX files, or one file with both towers.

Exporters (open_clip, transformers, optimum, immich) name inputs and outputs differently. They are therefore recognised
by type and shape: one input takes pixels, one takes token ids, and one output has a row per image or text. What the
model is stands in the files beside it (see `preprocess.family_of`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError, home_path
from perception.io.documents import refusing
from perception.language.base import Reading, check_images, check_texts, unit_rows
from perception.language.preprocess import CLIP_FAMILY, Family, family_of, find_preprocess
from perception.language.tokenizer import Tokenizer, find_tokenizer
from perception.onnx.sessions import (
    dtype_of,
    fingerprint,
    graph_name,
    model_graphs,
    open_session,
    provider_warning,
    read_config,
    run_graph,
    shape_of,
    signature,
)
from perception.onnx.store import known_names, resolve

BATCH = 16
CLIP_SCALE = 100.0  # to which CLIP's trained logit_scale is clipped, and which its models reach (Radford et al. 2021)
PRIOR = -10.0  # SigLIP's log-odds of a match before training, its initial bias (Zhai et al. 2023)
_IMAGE_FILES = ("vision_model", "visual/model", "visual", "image_encoder", "image", "vision")
_TEXT_FILES = ("text_model", "textual/model", "textual", "text_encoder", "text")
_IDS = ("input_ids", "text", "tokens", "token_ids", "texts", "input")
_IMAGE_OUTPUTS = ("image_embeds", "image_features", "image_embedding", "embedding", "output")
_TEXT_OUTPUTS = ("text_embeds", "text_features", "text_embedding", "embedding", "output")


class ClipEncoder:
    """Image and text towers of a CLIP, open_clip, MobileCLIP or SigLIP export. Both are opened and checked at once."""

    templates: tuple[str, ...] = ("an image of {}", "a photo of a {}", "{}")

    def __init__(self, image: Path, text: Path) -> None:
        self._image_path, self._text_path = image, text
        self._text = open_session(text)
        self._image = self._text if image == text else open_session(image)
        for path, session in ((image, self._image), (text, self._text)):
            if warning := provider_warning(path, session):
                warnings.warn(warning, RuntimeWarning, stacklevel=2)
        self._ids, self._pixels = _ids_input(self._text, text), _pixel_input(self._image, image)
        families = [family_of(path) for path in (image, text)]
        if None not in families and families[0] != families[1]:
            names = " and ".join(family.name for family in families if family)
            raise InputError(f"{image}, {text}: towers of {names}; take both from one model")
        self.family = families[0] or families[1] or CLIP_FAMILY
        self._text_output = _row_output(self._text, _TEXT_OUTPUTS, text, self.family)
        self._image_output = _row_output(self._image, _IMAGE_OUTPUTS, image, self.family)
        self._tokenizer: Tokenizer = find_tokenizer(text, shape_of(self._ids)[1])
        shape = shape_of(self._pixels)
        self.preprocess = find_preprocess(image, shape[1] if shape[-1] == 3 else shape[2])
        self.dim = shape_of(self._text_output)[-1] or self._run_text(["a"]).shape[1]
        self._check_length(shape_of(self._image_output)[-1] or self.dim)
        config = read_config(image, "config.json")
        stated = config.get("embed_dim") or (None if self.family.pooled else config.get("projection_dim"))
        if stated not in (None, self.dim):
            raise InputError(
                f"{image}: its embeddings have {self.dim} numbers, config.json states {stated}; export with projection"
            )

    def _check_length(self, of_images: int) -> None:
        if of_images != self.dim:
            raise InputError(
                f"{self._image_path}: its embeddings have {of_images} numbers, those of {self._text_path} {self.dim}; "
                "take both towers from one model"
            )

    @cached_property
    def reading(self) -> Reading:
        """LERF's canonical phrases, and the scale and bias of the model's log-odds where its graph gives logits.

        No package ships trained weights to tune with: calibration and zooms are the defaults.
        """
        scale, bias = self._logits() or (CLIP_SCALE, None)
        even = None if bias is None else (PRIOR - bias) / scale
        return Reading(canonical=("object", "things", "stuff", "texture"), colors=True, scale=scale, even=even)

    def _logits(self) -> tuple[float, float | None] | None:
        """(scale, bias) that turn cosines into the logits of a graph with both towers; bias None for a softmax."""
        outputs = {value.name: value for value in self._text.get_outputs()}
        name = next((n for n in ("logits_per_text", "logits_per_image") if n in outputs), None)
        fixed = shape_of(self._ids)[0]
        if name is None or self._text is not self._image or fixed not in (None, 2):
            return None
        ids, mask = self._tokenizer(["a red mug", "the sky over a city"])
        feed = {value.name: mask for value in self._text.get_inputs() if "mask" in value.name} | {self._ids.name: ids}
        wanted = [name, self._text_output.name, self._image_output.name]
        logits, texts, images = self._answers(self._text, wanted, feed)
        cosines = (unit_rows(texts) @ unit_rows(images)[:1].T)[:, 0]
        logits = logits[:, 0] if name == "logits_per_text" else logits[0]
        if abs(cosines[0] - cosines[1]) < 1e-6:
            return None
        scale = float((logits[0] - logits[1]) / (cosines[0] - cosines[1]))
        return scale, float(logits[0] - scale * cosines[0]) if self.family.pooled else None

    @classmethod
    def from_spec(cls, argument: str) -> ClipEncoder:
        """From "IMAGE.onnx,TEXT.onnx", "BOTH.onnx", a folder with files of the usual names, or a stored model name."""
        with refusing(f"clip:{argument}: a file beside the model is not understood ({{why}}); fetch it again"):
            argument = resolve(argument)
            parts = [home_path(part.strip()) for part in argument.split(",")]
            if len(parts) == 2:
                return cls(parts[0], parts[1])
            if len(parts) == 1 and parts[0].is_dir():
                return cls(*_find_pair(parts[0]))
            if len(parts) == 1 and parts[0].suffix == ".onnx":
                return cls(parts[0], parts[0])
        raise InputError(
            f"clip:{argument}: expected IMAGE.onnx,TEXT.onnx, a folder that exists, or a stored model; {known_names()}"
        )

    @cached_property
    def identity(self) -> str:
        """Family, file fingerprints and preprocessing: everything that changes an embedding."""
        files = "+".join(dict.fromkeys(fingerprint(p) for p in (self._image_path, self._text_path)))
        return f"clip/{self.family.name.lower()}/{files}/{self.preprocess}/{self._tokenizer.length}"

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """RGB uint8 [H, W, 3] pictures → float32 [n, dim], unit rows."""
        check_images(images)
        fixed = shape_of(self._pixels)[0]
        rows = [np.zeros((0, self.dim), np.float32)]
        for start in range(0, len(images), fixed or BATCH):
            batch = np.stack([self.preprocess(image) for image in images[start : start + (fixed or BATCH)]])
            if shape_of(self._pixels)[-1] == 3:  # channels last
                batch = batch.transpose(0, 2, 3, 1)
            feed: dict[str, np.ndarray] = {self._pixels.name: _padded(batch, fixed)}
            rows.append(self._answers(self._image, [self._image_output.name], feed)[0][: len(batch)])
            self._check_length(rows[-1].shape[1])
        return unit_rows(np.concatenate(rows))

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        """Texts, used as they are without a template → float32 [n, dim], unit rows."""
        tidy = check_texts(texts)
        step = shape_of(self._ids)[0] or BATCH
        rows = [self._run_text(tidy[start : start + step]) for start in range(0, len(tidy), step)]
        return unit_rows(np.concatenate(rows) if rows else np.zeros((0, self.dim), np.float32))

    def _run_text(self, texts: Sequence[str]) -> np.ndarray:
        ids, mask = self._tokenizer(texts)
        fixed = shape_of(self._ids)[0]
        feed: dict[str, np.ndarray] = {self._ids.name: _padded(ids, fixed)}
        for value in self._text.get_inputs():
            if "mask" in value.name:
                feed[value.name] = _padded(mask, fixed)
        return self._answers(self._text, [self._text_output.name], feed)[0][: len(texts)]

    def _answers(self, session: Any, outputs: list[str], feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Outputs as float32. If both towers share a file, the inputs of the other tower get placeholders."""
        for value in session.get_inputs():
            shape = shape_of(value)
            if value.name not in feed and len(shape) == 4:
                size = shape[2] or self.preprocess.size
                feed[value.name] = np.zeros((shape[0] or 1, 3, size, size))
            elif value.name not in feed:
                ids, mask = self._tokenizer(["a"] * (shape[0] or 1))
                feed[value.name] = mask if "mask" in value.name else ids
            feed[value.name] = feed[value.name].astype(dtype_of(value), copy=False)
        path = self._image_path if session is self._image else self._text_path
        return [output.astype(np.float32, copy=False) for output in run_graph(path, session, outputs, feed)]


def _find_pair(folder: Path) -> tuple[Path, Path]:
    """Image and text model of a folder, under one of the usual names of public exports (see `model_graphs`)."""
    graphs, _ = model_graphs(folder)
    named = {f"{path.parent.name}/{graph_name(path)}": path for path in graphs} | {graph_name(p): p for p in graphs}
    image, text = (next((named[n] for n in names if n in named), None) for names in (_IMAGE_FILES, _TEXT_FILES))
    if image and text:
        return image, text
    if lonely := image or text:
        raise InputError(f"{lonely}: the other tower is not beside it; both are needed")
    if "model" in named:
        return named["model"], named["model"]
    held = ", ".join(sorted(p.name for p in folder.iterdir())[:6]) or "nothing"
    raise InputError(f"{folder}: expected vision_model.onnx and text_model.onnx (or model.onnx), found {held}")


def _pixel_input(session: Any, path: Path) -> Any:
    for value in session.get_inputs():
        shape = shape_of(value)
        if len(shape) == 4 and (shape[1] in (3, None) or shape[3] == 3):
            return value
    raise InputError(f"{path}: no input takes pictures [n, 3, H, W] ({signature(session)}); is it the image tower?")


def _ids_input(session: Any, path: Path) -> Any:
    inputs = [v for v in session.get_inputs() if len(v.shape) == 2 and "int" in v.type and "mask" not in v.name]
    usual = next((value for name in _IDS for value in inputs if value.name == name), None)
    if usual is not None or len(inputs) == 1:
        return usual or inputs[0]
    raise InputError(
        f"{path}: no input takes token ids [n, length] ({signature(session)}); the order is clip:IMAGE.onnx,TEXT.onnx"
    )


def _row_output(session: Any, names: Sequence[str], path: Path, family: Family) -> Any:
    """The output with one row per item: recognised by a usual name, else the only output of rank 2."""
    rows = [v for v in session.get_outputs() if len(v.shape) == 2]
    names = [*names, "pooler_output"] if family.pooled else names
    usual = next((value for name in names for value in rows if value.name == name), None)
    if usual is None and not family.pooled and "pooler_output" in {value.name for value in rows}:
        raise InputError(
            f"{path}: its pooler_output is {family.name}'s state before the projection; export it with projection "
            "(CLIPVisionModelWithProjection, CLIPTextModelWithProjection)"
        )
    if usual is not None or len(rows) == 1:
        return usual or rows[0]
    raise InputError(f"{path}: no output holds one embedding a row ({signature(session)}); not of the CLIP family")


def _padded(batch: np.ndarray, fixed: int | None) -> np.ndarray:
    """Repeats the last row up to a fixed batch size."""
    if fixed is None or len(batch) == fixed:
        return batch
    return np.concatenate([batch, np.repeat(batch[-1:], fixed - len(batch), axis=0)])
