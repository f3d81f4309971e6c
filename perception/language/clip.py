"""CLIP-family encoders through onnxruntime: a pair of ONNX files, or one file with both towers.

Exporters (open_clip, transformers, optimum, immich) name inputs and outputs differently. They are therefore recognised
by type and shape: one input takes pixels, one takes token ids, and one output has a row per image or text.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.model_store import known_names, resolve
from perception.io.onnx_sessions import dtype_of, fingerprint, open_session, provider_warning, shape_of, signature
from perception.language.base import Reading, check_images, check_texts, unit_rows
from perception.language.preprocess import family_of, find_preprocess
from perception.language.tokenizer import Tokenizer, find_tokenizer

BATCH = 16
_IMAGE_FILES = ("vision_model", "visual/model", "visual", "image_encoder", "image", "vision")
_TEXT_FILES = ("text_model", "textual/model", "textual", "text_encoder", "text")
_IDS = ("input_ids", "text", "tokens", "token_ids", "texts", "input")
_IMAGE_OUTPUTS = ("image_embeds", "image_features", "image_embedding", "pooler_output", "embedding", "output")
_TEXT_OUTPUTS = ("text_embeds", "text_features", "text_embedding", "pooler_output", "embedding", "output")


class ClipEncoder:
    """Image and text towers of a CLIP, open_clip, MobileCLIP or SigLIP export. Both are opened and checked at once."""

    # LERF's canonical phrases. No package ships trained weights to tune with: margin and zooms are the defaults.
    reading = Reading(canonical=("object", "things", "stuff", "texture"), colors=True)
    templates: tuple[str, ...] = ("an image of {}", "a photo of a {}", "{}")

    def __init__(self, image: Path, text: Path) -> None:
        self._image_path, self._text_path = image, text
        self._text = open_session(text)
        self._image = self._text if image == text else open_session(image)
        for path, session in ((image, self._image), (text, self._text)):
            if warning := provider_warning(path, session):
                warnings.warn(warning, RuntimeWarning, stacklevel=2)
        self._ids, self._pixels = _ids_input(self._text, text), _pixel_input(self._image, image)
        self._text_output = _row_output(self._text, _TEXT_OUTPUTS, text)
        self._image_output = _row_output(self._image, _IMAGE_OUTPUTS, image)
        self._tokenizer: Tokenizer = find_tokenizer(text, shape_of(self._ids)[1])
        shape = shape_of(self._pixels)
        self.preprocess = find_preprocess(image, shape[1] if shape[-1] == 3 else shape[2])
        self.dim = shape_of(self._text_output)[-1] or self._run_text(["a"]).shape[1]
        of_images = shape_of(self._image_output)[-1] or self.dim
        if of_images != self.dim:
            raise InputError(
                f"{image}: its embeddings have {of_images} numbers, those of {text} {self.dim}; "
                "take both towers from one model"
            )

    @classmethod
    def from_spec(cls, argument: str) -> ClipEncoder:
        """From "IMAGE.onnx,TEXT.onnx", "BOTH.onnx", a folder with files of the usual names, or a stored model name."""
        argument = resolve(argument)
        parts = [Path(part.strip()).expanduser() for part in argument.split(",")]
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
        return f"clip/{family_of(self._image_path)}/{files}/{self.preprocess}/{self._tokenizer.length}"

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """RGB uint8 [H, W, 3] pictures → float32 [n, dim], unit rows."""
        check_images(images)
        fixed = shape_of(self._pixels)[0]
        rows = [np.zeros((0, self.dim), np.float32)]
        for start in range(0, len(images), fixed or BATCH):
            batch = np.stack([self.preprocess(image) for image in images[start : start + (fixed or BATCH)]])
            if shape_of(self._pixels)[-1] == 3:  # channels last
                batch = batch.transpose(0, 2, 3, 1)
            feed: dict[str, np.ndarray] = {self._pixels.name: _padded(batch, fixed).astype(dtype_of(self._pixels))}
            rows.append(self._run(self._image, self._image_output, feed)[: len(batch)])
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
        feed: dict[str, np.ndarray] = {self._ids.name: _padded(ids, fixed).astype(dtype_of(self._ids))}
        for value in self._text.get_inputs():
            if "mask" in value.name:
                feed[value.name] = _padded(mask, fixed).astype(dtype_of(value))
        return self._run(self._text, self._text_output, feed)[: len(texts)]

    def _run(self, session: Any, output: Any, feed: dict[str, np.ndarray]) -> np.ndarray:
        """One output [n, dim] float32. If both towers share a file, the inputs of the other tower get placeholders."""
        for value in session.get_inputs():
            if value.name in feed:
                continue
            shape = shape_of(value)
            if len(shape) == 4:
                size = shape[2] or self.preprocess.size
                feed[value.name] = np.zeros((shape[0] or 1, 3, size, size), dtype_of(value))
            else:
                ids, mask = self._tokenizer(["a"] * (shape[0] or 1))
                feed[value.name] = (mask if "mask" in value.name else ids).astype(dtype_of(value))
        return np.asarray(session.run([output.name], feed)[0], np.float32)


def _find_pair(folder: Path) -> tuple[Path, Path]:
    """Image and text model in the folder or its `onnx/`, under one of the usual names of public exports."""
    for home in (folder, folder / "onnx"):
        image = next((home / f"{n}.onnx" for n in _IMAGE_FILES if (home / f"{n}.onnx").is_file()), None)
        text = next((home / f"{n}.onnx" for n in _TEXT_FILES if (home / f"{n}.onnx").is_file()), None)
        if image and text:
            return image, text
        if (home / "model.onnx").is_file() and not image and not text:
            return home / "model.onnx", home / "model.onnx"
        lonely = image or text
        if lonely:
            raise InputError(f"{lonely}: the other tower is not beside it; both are needed")
    found = ", ".join(sorted(p.name for p in folder.iterdir())[:6]) or "nothing"
    raise InputError(f"{folder}: expected vision_model.onnx and text_model.onnx (or model.onnx), found {found}")


def _pixel_input(session: Any, path: Path) -> Any:
    for value in session.get_inputs():
        shape = shape_of(value)
        if len(shape) == 4 and (shape[1] in (3, None) or shape[3] == 3):
            return value
    raise InputError(f"{path}: no input takes pictures [n, 3, H, W] ({signature(session)}); is it the image tower?")


def _ids_input(session: Any, path: Path) -> Any:
    inputs = [v for v in session.get_inputs() if len(v.shape) == 2 and "int" in v.type and "mask" not in v.name]
    found = next((value for name in _IDS for value in inputs if value.name == name), None)
    if found is not None or len(inputs) == 1:
        return found or inputs[0]
    raise InputError(
        f"{path}: no input takes token ids [n, length] ({signature(session)}); the order is clip:IMAGE.onnx,TEXT.onnx"
    )


def _row_output(session: Any, names: Sequence[str], path: Path) -> Any:
    """The output with one row per item: recognised by a usual name, else the only output of rank 2."""
    rows = [v for v in session.get_outputs() if len(v.shape) == 2]
    found = next((value for name in names for value in rows if value.name == name), None)
    if found is not None or len(rows) == 1:
        return found or rows[0]
    raise InputError(f"{path}: no output holds one embedding a row ({signature(session)}); not of the CLIP family")


def _padded(batch: np.ndarray, fixed: int | None) -> np.ndarray:
    """Repeats the last row up to a fixed batch size."""
    if fixed is None or len(batch) == fixed:
        return batch
    return np.concatenate([batch, np.repeat(batch[-1:], fixed - len(batch), axis=0)])
