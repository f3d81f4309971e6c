"""The protocol of all encoders, how their similarities are to be read, and checks that they share."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from perception.errors import InputError, missing_extra


@dataclass(frozen=True)
class Part:
    """A stretch of an embedding's numbers that is compared on its own.

    stop: where it ends (it begins where the last one ended). weight: its share of the relevancy. references: [R, d]
    unit rows of many common words in this part, the ruler for how specific a text is; None without one.
    """

    stop: int
    weight: float = 1.0
    references: np.ndarray | None = None


@dataclass(frozen=True)
class Reading:
    """How an encoder's similarities are to be read.

    parts: of its embeddings; none: the whole is one. margin: spreads above the map's probes from which an answer is
    believed. canonical: phrases that fit anything, which a prompt must beat; none where sentences do not describe
    pictures in general. zooms: crops a view that it does best with (the paper's 3 for what reads context well).
    """

    parts: tuple[Part, ...] = ()
    margin: float = 0.0
    zooms: int = 3
    canonical: tuple[str, ...] = ()


def reading_of(encoder: Encoder) -> Reading:
    """The encoder's own `reading` where it has one, else the plain one."""
    known = getattr(encoder, "reading", None)
    return known if isinstance(known, Reading) else Reading()


class Encoder(Protocol):
    """Images and texts in one space, where the dot product of two unit rows says how well they fit.

    identity: model, version and preprocessing; a map stores it and refuses embeddings of another.
    dim: length of an embedding. templates: sentences with one {} that a prompt is put into; their embeddings are
    averaged. An encoder may have a `reading` too, see `reading_of`.
    """

    @property
    def identity(self) -> str: ...

    @property
    def dim(self) -> int: ...

    @property
    def templates(self) -> tuple[str, ...]: ...

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """RGB uint8 [H, W, 3] pictures of any size → float32 [n, dim], unit rows."""
        ...

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        """Texts in any script → float32 [n, dim], unit rows. An empty text is an InputError."""
        ...


def check_texts(texts: Sequence[str]) -> list[str]:
    """Texts with their white space tidied; an empty one is an InputError."""
    if isinstance(texts, str):
        raise InputError(f"texts: expected a list of texts, found the single text '{texts[:40]}'")
    tidy = [" ".join(text.split()) for text in texts]
    for n, text in enumerate(tidy):
        if not text:
            raise InputError(f"text {n + 1} of {len(tidy)}: it is empty; write what to look for, e.g. 'red mug'")
    return tidy


def check_images(images: Sequence[np.ndarray]) -> None:
    """Every picture must be RGB uint8 [H, W, 3] and hold a pixel."""
    for n, image in enumerate(images):
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise InputError(
                f"picture {n + 1}: expected RGB uint8 [H, W, 3], found {image.dtype} of shape {list(image.shape)}"
            )


def unit_rows(x: np.ndarray) -> np.ndarray:
    """Rows scaled to length 1, float32; a zero row stays zero."""
    norms = np.linalg.norm(x.astype(np.float64), axis=-1, keepdims=True)
    return (x / np.where(norms > 0, norms, 1.0)).astype(np.float32)


def packaged_file(package: str, pattern: str) -> Path:
    """A file of weights that an installed package ships, which is not imported for it.

    pattern: as of Path.glob below the package's folder. InputError where the package or the file is missing.
    """
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise missing_extra(package.replace("_", "-"), "demo")
    folder = Path(spec.origin).parent
    found = sorted(folder.glob(pattern))
    if not found:
        raise InputError(f"{folder}: holds no {pattern}; reinstall {package.replace('_', '-')}")
    return found[0]
