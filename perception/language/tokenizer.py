"""Tokens for the text models of the CLIP family, always offline.

In order: `tokenizer.json` beside the model; `vocab.json` with `merges.txt`; CLIP's byte-pair merges, which
ship inside the package open-clip-torch (MobileCLIP uses the same).
"""

from __future__ import annotations

import gzip
import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError, missing_extra
from perception.language.preprocess import family_of, read_config

START, END = "<|startoftext|>", "<|endoftext|>"
_WORDS = r"""'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"""
_CLIP_MERGES = 49152 - 256 - 2  # merges that OpenAI's vocabulary of 49408 keeps


class Tokenizer:
    """Texts → ids and attention mask of one fixed length."""

    def __init__(self, backend: Any, length: int, pad: int, end: int | None) -> None:
        """backend: a `tokenizers.Tokenizer`; end: id that must close a text cut at `length`, None to leave
        it cut.
        """
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
    """The tokenizer of a text model; `length` from its input's shape, else from the configs, else 77 (SigLIP
    64).
    """
    try:
        import tokenizers
    except ImportError as error:
        raise missing_extra("tokenizers", "demo") from error
    siglip = family_of(model) == "siglip"
    length = length or _configured_length(model) or (64 if siglip else 77)
    folders = (model.parent, model.parent.parent)
    for folder in folders:
        if (folder / "tokenizer.json").is_file():
            try:
                backend = tokenizers.Tokenizer.from_file(str(folder / "tokenizer.json"))
            except Exception as error:  # tokenizers raises bare Exception on a malformed file
                raise InputError(f"{folder / 'tokenizer.json'}: not a tokenizer ({error})") from error
            return _finish(backend, model, length)
        if (folder / "vocab.json").is_file() and (folder / "merges.txt").is_file():
            lines = (folder / "merges.txt").read_text(encoding="utf-8").splitlines()
            vocabulary = json.loads((folder / "vocab.json").read_text(encoding="utf-8"))
            return _finish(clip_bpe(vocabulary, _merges(lines)), model, length)
    if siglip:
        raise InputError(f"{model}: SigLIP needs its tokenizer.json beside the model; found none in {model.parent}")
    vocabulary, merges = packaged_clip_vocabulary()
    return _finish(clip_bpe(vocabulary, merges), model, length)


def clip_bpe(vocabulary: dict[str, int], merges: list[tuple[str, str]]) -> Any:
    """CLIP's tokenizer (lower-cased byte-level BPE with `</w>`, start and end marks) as a
    `tokenizers.Tokenizer`.
    """
    from tokenizers import Regex, Tokenizer, normalizers, pre_tokenizers, processors
    from tokenizers.models import BPE

    backend = Tokenizer(
        BPE(
            vocab=vocabulary,
            merges=merges,
            continuing_subword_prefix="",
            end_of_word_suffix="</w>",
            unk_token=END,
            fuse_unk=False,
        )
    )
    backend.normalizer = normalizers.Sequence(
        [normalizers.NFC(), normalizers.Replace(Regex(r"\s+"), " "), normalizers.Lowercase()]
    )
    backend.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(_WORDS), behavior="removed", invert=True),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    marks = [(START, vocabulary[START]), (END, vocabulary[END])]
    backend.post_processor = processors.TemplateProcessing(single=f"{START} $A {END}", special_tokens=marks)
    return backend


def packaged_clip_vocabulary() -> tuple[dict[str, int], list[tuple[str, str]]]:
    """CLIP's vocabulary and merges from the file inside open-clip-torch, which is not imported for it."""
    spec = importlib.util.find_spec("open_clip")
    path = Path(spec.origin).parent / "bpe_simple_vocab_16e6.txt.gz" if spec and spec.origin else None
    if path is None or not path.is_file():
        raise InputError(
            "CLIP's vocabulary was not found: put the model's tokenizer.json beside the ONNX files, "
            "or run: pip install --no-deps open-clip-torch"
        )
    lines = gzip.decompress(path.read_bytes()).decode("utf-8").splitlines()
    merges = _merges(lines)[:_CLIP_MERGES]
    return clip_vocabulary(merges), merges


def clip_vocabulary(merges: list[tuple[str, str]]) -> dict[str, int]:
    """Ids in OpenAI's order: 256 bytes, the same ending a word, the merges, then the two marks."""
    letters = _byte_letters()
    words = letters + [letter + "</w>" for letter in letters] + ["".join(pair) for pair in merges] + [START, END]
    return {word: n for n, word in enumerate(words)}


def _byte_letters() -> list[str]:
    """The printable stand-ins of GPT-2's byte-level BPE: printable Latin-1 bytes themselves, then the
    others.
    """
    printable = [*range(0x21, 0x7F), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    others = len(set(range(256)) - set(printable))
    return [chr(b) for b in printable] + [chr(256 + n) for n in range(others)]


def _merges(lines: list[str]) -> list[tuple[str, str]]:
    pairs = [line.split() for line in lines[1:]]  # the first line is a version mark
    return [(pair[0], pair[1]) for pair in pairs if len(pair) == 2]


def _finish(backend: Any, model: Path, length: int) -> Tokenizer:
    about = read_config(model, "tokenizer_config.json")
    pad_token = about.get("pad_token")
    if isinstance(pad_token, dict):
        pad_token = pad_token.get("content")
    pad = backend.token_to_id(pad_token) if isinstance(pad_token, str) else None
    if pad is None:
        pad = (backend.padding or {}).get("pad_id")
    end = backend.token_to_id(END)
    if end is None:
        end = backend.token_to_id("</s>")
    return Tokenizer(backend, length, int(pad or 0), end)


def _configured_length(model: Path) -> int | None:
    text = read_config(model, "config.json").get("text_config", {})
    described = read_config(model, "open_clip_config.json").get("model_cfg", {}).get("text_cfg", {})
    found = text.get("max_position_embeddings") or described.get("context_length")
    return int(found) if found else None
