"""ConSE (Norouzi et al. 2014), an encoder whose weights come with pip packages.

    p(c|x)  probability of class c of ImageNet for an image x, by a classifier
    s(t)    embedding of a text t, by a sentence encoder; s(c): mean over the names of class c; s̄: mean over all classes

Two comparisons are used. In sentence space, as in the paper:
    f(x) = Σ_{c in top T} √p(c|x) · (s(c) − s̄)  against  s(t) − s̄
In class space, where the dot product is the Bhattacharyya coefficient:
    √p(·|x)  against  √q(·|t),   q(c|t) ∝ exp(cos(s(t) − s̄, s(c) − s̄) / τ),
half of q from the classes that look like t where t is a household thing known by hand (see `household`).

Sentence space generalises to texts that name no class. Class space separates the object from similar ones. The paper
weights by p; √p measured better on objects without a class of their own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cached_property, partial
from typing import Any

import numpy as np

from perception.errors import CLASSIFIER, InputError, packaged_file
from perception.io.arrays import map_npy
from perception.io.atomic import write_file
from perception.language import minilm
from perception.language.base import Part, Reading, check_images, check_texts, unit_rows
from perception.language.household import CLASSES, class_names, household_thing
from perception.language.minilm import MiniLM
from perception.machine import torch_on_one_thread
from perception.onnx.store import cache_folder

TOP = 20  # number of classes T in the sentence-space embedding
TAU = 0.03  # temperature τ: cosine difference at which two words no longer mean the same class
KNOWN = 0.5  # weight in q of the classes that the table lists for a household thing
SHARE = 0.7  # weight of class space in the relevancy; TAU and SHARE are tuned on the demo's objects
CALIBRATION = (1.21, -0.94)  # of the score: fitted to 272 prompts, present and absent, of a made room and tabletop
STEPS = 1024  # quantisation levels of √p, so that a map compresses well
LISTS = range(100, 2000)  # numbers of texts whose embeddings are kept in the user's cache: the probes, the vocabulary


class ConseEncoder:
    """EfficientNet-Lite2 class probabilities and all-MiniLM-L6-v2 sentence embeddings; dim 384 + 1000."""

    dim: int = MiniLM.dim + CLASSES
    templates: tuple[str, ...] = ("a {}",)
    identity: str = f"conse-3/efficientnet-lite2-260/all-minilm-l6-v2/top{TOP}-sqrt-centred+classes"

    def __init__(self) -> None:
        """Checks that the weights and the tokenizer are installed. They are loaded at first use."""
        packaged_file("tokenizers", "__init__.py")
        packaged_file(*minilm.WEIGHTS)
        packaged_file(*CLASSIFIER)

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """RGB uint8 [H, W, 3] images → float32 [n, 1384], unit rows. Images are resized to 260², so use square ones."""
        import torch

        check_images(images)
        if not images:
            return np.zeros((0, self.dim), np.float32)
        workers, _ = torch.get_num_threads(), self._classifier  # loaded once, before the threads ask for it
        # Images side by side, one thread each, keep every processor busy; the threads of one small convolution do not.
        with torch_on_one_thread(), ThreadPoolExecutor(workers, initializer=partial(torch.set_num_threads, 1)) as pool:
            return self.combine(np.concatenate(list(pool.map(self.class_probabilities, ([i] for i in images)))))

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        """Texts → float32 [n, 1384], unit rows."""
        texts, encode = check_texts(texts), self._sentences.encode
        sentences = _cached([[text] for text in texts], encode) if len(texts) in LISTS else encode(texts)
        meant = unit_rows(sentences - self._classes.mean(axis=0))
        return unit_rows(np.concatenate([meant, self.classes_meant(meant, texts)], axis=1))

    def reads(self, text: str) -> bool:
        """Whether the sentence encoder knows any word of the text (`MiniLM.reads`)."""
        return self._sentences.reads(text)

    def classes_meant(self, sentences: np.ndarray, texts: Sequence[str]) -> np.ndarray:
        """√q [n, 1000], unit rows, from centred sentence embeddings [n, 384] and the table of household things."""
        cosines = sentences @ self._centred.T
        q = np.exp((cosines - cosines.max(axis=1, keepdims=True)) / TAU)
        q /= q.sum(axis=1, keepdims=True)
        for n, text in enumerate(texts):
            if (known := household_thing(text)) and known.classes is not None:
                q[n] = (1 - KNOWN) * q[n] + KNOWN * known.classes
        return unit_rows(np.sqrt(q))

    def class_probabilities(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Softmax over the 1000 ImageNet classes, float32 [n, 1000]."""
        import cv2
        import torch

        from perception.efficientnet_lite2 import SIDE

        pixels = np.empty((len(images), SIDE, SIDE, 3), np.float32)
        for n, image in enumerate(images):
            shrinks = max(image.shape[:2]) > SIDE
            pixels[n] = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        planes = torch.from_numpy((pixels - 127.0) / 128.0).permute(0, 3, 1, 2)
        with torch.inference_mode():
            logits = self._classifier(planes.contiguous(memory_format=torch.channels_last))
            return torch.softmax(logits, dim=1).numpy()

    def combine(self, probabilities: np.ndarray) -> np.ndarray:
        """Class probabilities p [n, 1000] → unit embeddings [n, 1384]: f(x) above, then √p quantised to 1 / STEPS."""
        classes = self._classes - self._classes.mean(axis=0)
        top = np.argpartition(-probabilities, TOP, axis=1)[:, :TOP]
        weights = np.sqrt(np.take_along_axis(probabilities, top, axis=1))
        sentences = unit_rows(np.einsum("nt,ntd->nd", weights, classes[top]))
        return unit_rows(np.concatenate([sentences, np.round(STEPS * np.sqrt(probabilities)) / STEPS], axis=1))

    @cached_property
    def reading(self) -> Reading:
        """The two spaces and their weights. How specific a text is, is measured in sentence space only."""
        parts = (Part(MiniLM.dim, 1 - SHARE, self._centred), Part(self.dim, SHARE))
        return Reading(parts, CALIBRATION, zooms=2, wholes=True)  # it names the dominant object: no wide crops

    @cached_property
    def _centred(self) -> np.ndarray:
        """Centred embeddings of the 1000 classes, float32 [1000, 384], unit rows."""
        return unit_rows(self._classes - self._classes.mean(axis=0))

    @cached_property
    def _sentences(self) -> MiniLM:
        return MiniLM()

    @cached_property
    def _classes(self) -> np.ndarray:
        """Sentence embeddings of the 1000 classes, float32 [1000, 384], unit rows, kept in the user's cache."""
        return _cached(class_names(), self._sentences.encode)

    @cached_property
    def _classifier(self) -> Any:
        from perception.efficientnet_lite2 import load_classifier

        return load_classifier(packaged_file(*CLASSIFIER))


def _cached(names: list[list[str]], encode: Any) -> np.ndarray:
    """Mean embedding per group of names, from the user's cache, or computed (1000 in two seconds) and kept there."""
    flat = [name for group in names for name in group]
    key = hashlib.sha256("\n".join(flat).encode()).hexdigest()[:16]
    path = cache_folder() / f"conse-minilm-{key}.npy"
    try:
        known = np.array(map_npy(path))
        if known.shape == (len(names), MiniLM.dim) and known.dtype == np.float32:
            return known
    except Exception:  # damaged files raise errors of many classes
        pass  # missing or damaged: recomputed below
    embedded = encode(flat)
    sizes = np.array([len(group) for group in names])
    classes = unit_rows(np.add.reduceat(embedded, np.cumsum(sizes) - sizes, axis=0) / sizes[:, None])
    with suppress(InputError):  # without a writable cache the embeddings are recomputed each time
        write_file(path, lambda file: np.save(file, classes))
    return classes
