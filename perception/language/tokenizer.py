"""Tokenizer for the text models of the CLIP family, from the `tokenizer.json` that exports include."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError, missing_extra
from perception.language.preprocess import family_of, read_config


class Tokenizer:
    """Texts → ids and attention mask of one fixed length."""

    def __init__(self, backend: Any, length: int, pad: int, end: int | None) -> None:
        """backend: a `tokenizers.Tokenizer`; end: id placed last if a text is cut at `length`, None: it is only cut."""
        self._backend, self.length, self.pad, self._end = backend, length, pad, end
        backend.no_padding()
        backend.no_truncation()

    def __call__(self, texts: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """ids [n, length] int64, mask [n, length] int64 (1 = token, 0 = padding)."""
        ids = np.full((len(texts), self.length), self.pad, np.int64)
        mask = np.zeros((len(texts), self.length), np.int64)
        for row, encoding in enumerate(self._backend.encode_batch(list(texts))):
            tokens = encoding.ids[: self.length]
            if len(encoding.ids) > self.length and self._end is not None:
                tokens[-1] = self._end
            ids[row, : len(tokens)] = tokens
            mask[row, : len(tokens)] = 1
        return ids, mask


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
    end = backend.token_to_id("<|endoftext|>")
    end = backend.token_to_id("</s>") if end is None else end
    length = length or _configured_length(model) or (64 if family_of(model) == "siglip" else 77)
    return Tokenizer(backend, length, _padding_id(backend, model), end)


def _padding_id(backend: Any, model: Path) -> int:
    name = read_config(model, "tokenizer_config.json").get("pad_token")
    if isinstance(name, dict):
        name = name.get("content")
    found = backend.token_to_id(name) if isinstance(name, str) else None
    return int((backend.padding or {}).get("pad_id") or 0) if found is None else int(found)


def _configured_length(model: Path) -> int | None:
    text = read_config(model, "config.json").get("text_config", {})
    described = read_config(model, "open_clip_config.json").get("model_cfg", {}).get("text_cfg", {})
    found = text.get("max_position_embeddings") or described.get("context_length")
    return int(found) if found else None
