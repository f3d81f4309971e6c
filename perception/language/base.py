"""The encoder protocol, the meaning of an encoder's similarities, and shared input checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from perception.errors import InputError


@dataclass(frozen=True)
class Part:
    """A slice of an embedding that is compared separately.

    stop: its end; it begins where the previous part ends. weight: its share of the relevancy. references: [R, d] unit
    rows of many common words in this part, by which the specificity of a text is measured; None: not measured.
    """

    stop: int
    weight: float = 1.0
    references: np.ndarray | None = None


@dataclass(frozen=True)
class Reading:
    """What the similarities of an encoder mean.

    parts: slices of its embeddings; empty: one part. calibration: a and b of Φ(a z + b), the probability that the
    thing is there, where z is the best hit's distance above the map's probes, see `query.ranking`. canonical: generic
    phrases that a prompt must exceed (LERF); empty for encoders whose sentence embeddings do not describe images.
    zooms: best number of crops per view (3 in the paper). colors: it knows colours, so that colour words stay in the
    prompt. scale: factor of a cosine in the model's log odds (CLIP's and SigLIP's logit_scale). even: cosine at which a
    text and a picture are as likely to belong together as not; None: not known. wholes: it knows whole
    objects, so that no part of an instance answers: half a book may look like a laptop to it.
    """

    parts: tuple[Part, ...] = ()
    calibration: tuple[float, float] = (1.0, 0.0)
    zooms: int = 3
    canonical: tuple[str, ...] = ()
    colors: bool = False
    scale: float = 10.0
    even: float | None = None
    wholes: bool = False


def reading_of(encoder: Encoder) -> Reading:
    """The encoder's `reading` attribute if it has one, else the default `Reading()`."""
    known = getattr(encoder, "reading", None)
    return known if isinstance(known, Reading) else Reading()


class Encoder(Protocol):
    """Embeds images and texts in one space. The dot product of two unit rows measures how well they match.

    identity: model, version and preprocessing. A map stores it, and embeddings of another encoder are refused.
    dim: length of an embedding. templates: sentences with one {} for the prompt; their embeddings are averaged.
    An encoder may also have a `reading`, see `reading_of`, and `reads(text)`: whether it knows any word of a text; all
    texts are read where it has none.
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
        """Texts in any script → float32 [n, dim], unit rows. Raises InputError for an empty text."""
        ...


def check_texts(texts: Sequence[str]) -> list[str]:
    """Texts with normalised white space. Raises InputError for an empty text."""
    if isinstance(texts, str):
        raise InputError(f"texts: expected a list of texts, found the single text '{texts[:40]}'")
    tidy = [" ".join(text.split()) for text in texts]
    for n, text in enumerate(tidy):
        if not text:
            raise InputError(f"text {n + 1} of {len(tidy)}: it is empty; write what to look for, e.g. 'red mug'")
    return tidy


def check_images(images: Sequence[np.ndarray]) -> None:
    """Raises InputError unless every image is RGB uint8 [H, W, 3] and not empty."""
    for n, image in enumerate(images):
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise InputError(
                f"picture {n + 1}: expected RGB uint8 [H, W, 3], found {image.dtype} of shape {list(image.shape)}"
            )


def normal_cdf(x: np.ndarray) -> np.ndarray:
    """Φ of each number, the cumulative function of the normal distribution, as float32 or float64 of x's shape.

    Of the compiled core, as SciPy takes longer to import than a prompt to answer; of SciPy in a robot's Python that has
    the sources alone.
    """
    x = np.asarray(x, order="C")
    try:
        from perception._core import normal_cdf as compiled
    except ImportError:
        from scipy.special import ndtr

        return np.asarray(ndtr(x))
    out = np.empty_like(x)
    compiled(x.reshape(-1), out.reshape(-1))
    return out


AT_ONCE = 4096


NEAREST_NONSENSE = 5
"""Texts without meaning over which a likeness to them is averaged, the nearest."""


def like_nonsense(texts: np.ndarray, known: np.ndarray, nonsense: np.ndarray) -> np.ndarray:
    """[T]: by how much texts [T, d] are more like nonsense [N, d] than any of the known texts [K, d] is, in cosine; 0
    where N = 0. All are unit rows. Words that an encoder does not know are much alike to it, and near to few pictures,
    which answered them."""
    if not len(nonsense):
        return np.zeros(len(texts))
    likeness = [np.sort(rows @ nonsense.T, axis=1)[:, -NEAREST_NONSENSE:].mean(axis=1) for rows in (texts, known)]
    return np.maximum(likeness[0] - likeness[1].max(), 0)


def unit_rows(x: np.ndarray) -> np.ndarray:
    """Rows scaled to length 1, float32. Zero rows stay zero."""
    if x.ndim == 2 and len(x) > AT_ONCE:  # float64 copies of all rows of many maps would take gigabytes
        return np.concatenate([unit_rows(x[at : at + AT_ONCE]) for at in range(0, len(x), AT_ONCE)])
    norms = np.linalg.norm(x.astype(np.float64), axis=-1, keepdims=True)
    return (x / np.where(norms > 0, norms, 1.0)).astype(np.float32)
