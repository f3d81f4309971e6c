"""The learned part of the built-in masks: small neural networks whose weights come with the package.

`python tests/training/masks.py` makes the packaged file from rendered worlds alone, see docs/masks.md.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

WEIGHTS = Path(__file__).with_name("merge_weights.npz")
_CLIP = 5.0  # standard deviations: inputs far from all training data do not extrapolate
_PARTS = 8  # arrays of a network


@dataclass(frozen=True)
class Network:
    """The mean of E multilayer perceptrons with ReLU. parts: mean and scale of the inputs [F], then for each of three
    layers weights [E, out, in] and biases [E, 1, out]. All float32."""

    parts: tuple[np.ndarray, ...]

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """[M, F] -> [M, out]. einsum without BLAS: its sums have one order, whatever the number of threads."""
        mean, scale, *layers = self.parts
        x = np.clip((inputs - mean) / scale, -_CLIP, _CLIP).astype(np.float32)
        x = np.broadcast_to(x, (len(layers[0]), *x.shape))
        for k in range(0, len(layers), 2):
            x = np.einsum("emi,eoi->emo", np.maximum(x, 0) if k else x, layers[k]) + layers[k + 1]
        return np.asarray(x.mean(axis=0))


@dataclass(frozen=True)
class MergeModel:
    """pair: features of two neighbours (SurfaceGraph.features) -> [M, 1] log odds that they are one object.

    whole: features of a region (MergeTree.features) -> [M, 2] log odds that its IoU with an object exceeds 0.5, 0.75.
    cost: of one more object, in units of an object's probability. calibration: slope and offset of the log odds of the
    regions that were selected.
    """

    pair: Network
    whole: Network
    cost: float
    calibration: tuple[float, float] = (1.0, 0.0)

    def save(self, file: Path) -> None:
        np.savez_compressed(file, np.array([self.cost, *self.calibration]), *self.pair.parts, *self.whole.parts)


@functools.cache
def packaged_model(file: Path = WEIGHTS) -> MergeModel:
    """The model of the package."""
    with np.load(file) as stored:
        settings, *parts = (stored[f"arr_{k}"] for k in range(1 + 2 * _PARTS))
    cost, slope, offset = settings.tolist()
    return MergeModel(Network(tuple(parts[:_PARTS])), Network(tuple(parts[_PARTS:])), cost, (slope, offset))
