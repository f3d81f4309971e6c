"""Tokenizer for the text models of the CLIP family, from the `tokenizer.json` that exports include."""

from __future__ import annotations

import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError, missing_extra
from perception.language.preprocess import family_of
from perception.onnx.sessions import read_config

_GEMMA = 200_000  # words that SigLIP 2's vocabulary exceeds; it is trained on lower case with punctuation
_PUNCTUATION = str.maketrans("", "", string.punctuation)


class Tokenizer:
    """Texts → ids and attention mask of one fixed length."""

    def __init__(self, backend: Any, length: int, pad: int, clean: str = "", left: bool = False) -> None:
        """backend: a `tokenizers.Tokenizer`. clean: "", "lower" or "canonicalize" (also without punctuation), applied
        to a text first. left: padding comes before the text.
        """
        self._backend, self.length, self.pad, self.clean, self._left = backend, length, pad, clean, left
        backend.no_padding()
        backend.no_truncation()

    def __call__(self, texts: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """ids [n, length] int64, mask [n, length] int64 (1 = token, 0 = padding). A text that is cut keeps its end."""
        ids = np.full((len(texts), self.length), self.pad, np.int64)
        mask = np.zeros((len(texts), self.length), np.int64)
        for row, encoding in enumerate(self._backend.encode_batch([self._cleaned(text) for text in texts])):
            tokens = encoding.ids[: self.length]
            if len(encoding.ids) > self.length and encoding.special_tokens_mask[-1]:
                tokens[-1] = encoding.ids[-1]
            place = slice(self.length - len(tokens), None) if self._left else slice(len(tokens))
            ids[row, place], mask[row, place] = tokens, 1
        return ids, mask

    def _cleaned(self, text: str) -> str:
        if self.clean == "canonicalize":  # as in big_vision, with which SigLIP was trained
            text = " ".join(text.replace("_", " ").translate(_PUNCTUATION).split())
        return text.lower() if self.clean else text


def find_tokenizer(model: Path, length: int | None) -> Tokenizer:
    """The tokenizer next to a text model or in the parent folder (exports often lie in `onnx/`, `textual/`).

    length: of the model's input; None if it is dynamic. Then the config files decide, else it is 77 (SigLIP: 64).
    """
    try:
        import tokenizers
    except ImportError as error:
        raise missing_extra("tokenizers", "demo") from error
    files = [folder / "tokenizer.json" for folder in (model.parent, model.parent.parent)]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise InputError(f"{model}: no tokenizer.json in {model.parent}; put the one of this model there")
    try:
        backend = tokenizers.Tokenizer.from_file(str(file))
    except Exception as error:  # tokenizers raises bare Exception on a malformed file
        raise InputError(f"{file}: not a tokenizer ({error})") from error
    family = family_of(model)
    canonical = family is not None and family.canonical
    stated = read_config(model, "config.json").get("text_config", {}).get("max_position_embeddings")
    length = length or int(stated or _text_config(model).get("context_length") or (64 if canonical else 77))
    wanted = _text_config(model).get("tokenizer_kwargs", {}).get("clean")
    usual = "" if not canonical else "lower" if backend.get_vocab_size() > _GEMMA else "canonicalize"
    left = read_config(model, "tokenizer_config.json").get("padding_side") == "left"
    clean = wanted if wanted in ("lower", "canonicalize") else usual
    return Tokenizer(backend, length, _padding_id(backend, model), clean, left)


def _padding_id(backend: Any, model: Path) -> int:
    name = read_config(model, "tokenizer_config.json").get("pad_token")
    if isinstance(name, dict):
        name = name.get("content")
    found = backend.token_to_id(name) if isinstance(name, str) else None
    return int((backend.padding or {}).get("pad_id") or 0) if found is None else int(found)


def _text_config(model: Path) -> dict[str, Any]:
    """open_clip's `text_cfg`, from its own file or from the `config.json` of immich's exports."""
    described = read_config(model, "open_clip_config.json").get("model_cfg") or read_config(model, "config.json")
    return described.get("text_cfg") or {}
