"""The CLIP family through onnxruntime: a pair of ONNX files, or one file with both towers, bound by
introspection.

Exports name their inputs and outputs differently (open_clip, transformers, optimum, immich): what counts is
that one input takes pixels, one takes token ids, and one output is a row per picture or text.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.model_store import known_names, resolve
from perception.language.base import Reading, check_images, check_texts, unit_rows
from perception.language.onnx import Device, dtype_of, fingerprint, open_session, shape_of, signature
from perception.language.preprocess import Preprocess, family_of, find_preprocess
from perception.language.tokenizer import Tokenizer, find_tokenizer

BATCH = 16
_IMAGE_FILES = ("vision_model", "visual/model", "visual", "image_encoder", "image", "vision")
_TEXT_FILES = ("text_model", "textual/model", "textual", "text_encoder", "text")
_IDS = ("input_ids", "text", "tokens", "token_ids", "texts", "input")
_IMAGE_OUTPUTS = ("image_embeds", "image_features", "image_embedding", "pooler_output", "embedding", "output")
_TEXT_OUTPUTS = ("text_embeds", "text_features", "text_embedding", "pooler_output", "embedding", "output")


class ClipEncoder:
    """Image and text towers of a CLIP, open_clip, MobileCLIP or SigLIP export. The image tower opens when
    first used.
    """

    # Untried on real weights: none can be had here. The probes of the map and LERF's phrases are all there is.
    reading = Reading(canonical=("object", "things", "stuff", "texture"))
    templates: tuple[str, ...] = ("an image of {}", "a photo of a {}", "{}")

    def __init__(self, image: Path, text: Path, device: Device = "auto") -> None:
        self._image_path, self._text_path, self._device = image, text, device
        if not image.is_file():
            raise InputError(f"{image}: no such file; expected the image tower as ONNX")
        self._text = open_session(text, device)
        self._ids = _ids_input(self._text, text)
        self._text_output = _row_output(self._text, _TEXT_OUTPUTS, text)
        self._tokenizer: Tokenizer = find_tokenizer(text, shape_of(self._ids)[1])
        dim = shape_of(self._text_output)[-1]
        self.dim = dim if dim else int(self._run_text(["a"]).shape[1])

    @classmethod
    def from_spec(cls, argument: str, device: Device = "auto") -> ClipEncoder:
        """From "IMAGE.onnx,TEXT.onnx", "BOTH.onnx" a folder that holds them under a usual name, or a stored name."""
        argument = resolve(argument)
        parts = [Path(part.strip()).expanduser() for part in argument.split(",")]
        if len(parts) == 2:
            return cls(parts[0], parts[1], device)
        if len(parts) == 1 and parts[0].is_dir():
            return cls(*_find_pair(parts[0]), device)
        if len(parts) == 1 and parts[0].suffix == ".onnx":
            return cls(parts[0], parts[0], device)
        raise InputError(
            f"clip:{argument}: expected IMAGE.onnx,TEXT.onnx, a folder that exists, or a stored model; {known_names()}"
        )

    @cached_property
    def identity(self) -> str:
        """Family, fingerprints of the files, preprocessing: anything that changes an embedding."""
        files = "+".join(dict.fromkeys(fingerprint(p) for p in (self._image_path, self._text_path)))
        return f"clip/{family_of(self._image_path)}/{files}/{self.preprocess}/{self._tokenizer.length}"

    @property
    def providers(self) -> list[str]:
        """The execution providers really in use by the text tower."""
        return list(self._text.get_providers())

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """RGB uint8 [H, W, 3] pictures → float32 [n, dim], unit rows."""
        check_images(images)
        pixels, output = self._pixels, _row_output(self._image, _IMAGE_OUTPUTS, self._image_path)
        channels_last = shape_of(pixels)[-1] == 3
        step = shape_of(pixels)[0] or BATCH
        rows = [np.zeros((0, self.dim), np.float32)]
        for start in range(0, len(images), step):
            batch = np.stack([self.preprocess(image) for image in images[start : start + step]])
            if channels_last:
                batch = batch.transpose(0, 2, 3, 1)
            count = len(batch)
            feed: dict[str, np.ndarray] = {pixels.name: _padded(batch, shape_of(pixels)[0]).astype(dtype_of(pixels))}
            feed |= _other_inputs(self._image, set(feed), 1, self.preprocess.size, self._tokenizer)
            rows.append(np.asarray(self._image.run([output.name], feed)[0], np.float32)[:count])
        out = np.concatenate(rows) if rows[-1].shape[1] == self.dim else rows[-1]
        if out.shape[1] != self.dim:
            raise InputError(
                f"{self._image_path}: its embeddings have {out.shape[1]} numbers, those of {self._text_path} "
                f"{self.dim}; take both towers from one model"
            )
        return unit_rows(out)

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        """Texts, as they are (no template) → float32 [n, dim], unit rows."""
        tidy = check_texts(texts)
        step = shape_of(self._ids)[0] or BATCH
        rows = [self._run_text(tidy[start : start + step]) for start in range(0, len(tidy), step)]
        return unit_rows(np.concatenate(rows) if rows else np.zeros((0, self.dim), np.float32))

    @cached_property
    def preprocess(self) -> Preprocess:
        """How pictures are prepared; the size comes from the image tower when its input is fixed."""
        return find_preprocess(self._image_path, None if self._image is None else self._side)

    @cached_property
    def _image(self) -> Any:
        return self._text if self._image_path == self._text_path else open_session(self._image_path, self._device)

    @cached_property
    def _pixels(self) -> Any:
        return _pixel_input(self._image, self._image_path)

    @property
    def _side(self) -> int | None:
        shape = shape_of(self._pixels)
        return shape[1] if shape[-1] == 3 else shape[2]

    def _run_text(self, texts: Sequence[str]) -> np.ndarray:
        ids, mask = self._tokenizer(texts)
        fixed = shape_of(self._ids)[0]
        feed: dict[str, np.ndarray] = {self._ids.name: _padded(ids, fixed).astype(dtype_of(self._ids))}
        for value in self._text.get_inputs():
            if "mask" in value.name:
                feed[value.name] = _padded(mask, fixed).astype(dtype_of(value))
        feed |= _other_inputs(self._text, set(feed), 1, None, self._tokenizer)
        out = self._text.run([self._text_output.name], feed)[0]
        return np.asarray(out, np.float32)[: len(texts)]


def _find_pair(folder: Path) -> tuple[Path, Path]:
    """Image and text model under one of the names that public exports use, in the folder or its `onnx/`."""
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
    for name in _IDS:
        for value in inputs:
            if value.name == name:
                return value
    if len(inputs) == 1:
        return inputs[0]
    raise InputError(
        f"{path}: no input takes token ids [n, length] ({signature(session)}); the order is clip:IMAGE.onnx,TEXT.onnx"
    )


def _row_output(session: Any, names: Sequence[str], path: Path) -> Any:
    """The output with one row per item: by its usual names, else the only one of rank 2."""
    rows = [v for v in session.get_outputs() if len(v.shape) == 2]
    for name in names:
        for value in rows:
            if value.name == name:
                return value
    if len(rows) == 1:
        return rows[0]
    raise InputError(f"{path}: no output holds one embedding a row ({signature(session)}); not of the CLIP family")


def _other_inputs(
    session: Any, fed: set[str], count: int, side: int | None, tokenizer: Tokenizer
) -> dict[str, np.ndarray]:
    """Placeholders for the tower that is not asked, where both live in one file."""
    feed: dict[str, np.ndarray] = {}
    for value in session.get_inputs():
        if value.name in fed:
            continue
        shape = shape_of(value)
        if len(shape) == 4:
            edge = side or shape[2] or 224
            feed[value.name] = np.zeros((shape[0] or count, 3, edge, edge), dtype_of(value))
        else:
            ids, mask = tokenizer(["a"] * (shape[0] or count))
            feed[value.name] = (mask if "mask" in value.name else ids).astype(dtype_of(value))
    return feed


def _padded(batch: np.ndarray, fixed: int | None) -> np.ndarray:
    """Repeat the last row up to a fixed batch size."""
    if fixed is None or len(batch) == fixed:
        return batch
    return np.concatenate([batch, np.repeat(batch[-1:], fixed - len(batch), axis=0)])
