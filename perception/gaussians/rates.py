"""Learning rates as functions of training progress (Kerbl et al. 2023), larger in runs of fewer iterations.

A step of Adam is about as long as the rate, so in fewer iterations a parameter can move less far. The rates of means
and rotations make up for that: they are times sqrt(2000 / iterations).
"""

from __future__ import annotations

import numpy as np
import torch

MEANS, MEANS_LAST = 8e-4, 2e-5
"""Rates of the means at the start and at the end, times the scene extent, for 2,000 iterations. Kerbl et al. have
1.6e-4 and 1.6e-6 for 30,000."""
QUATS = 4e-3
"""For 2,000 iterations; for 30,000 it is that of Kerbl et al., 1e-3."""
MOST_HASTE = 2.0
"""Largest factor of these rates in shorter runs."""
SCALES = 1e-2
"""Rate of the log-scales: twice that of Kerbl et al. COLORS is also twice theirs, HARMONICS eight times theirs."""
OPACITIES = 0.05
COLORS, HARMONICS = 5e-3, 1e-3
FEATURES = 2e-2
COOLDOWN = 0.1
"""Final share of training progress, over which all rates decrease to a twentieth."""


def learning_rates(
    progress: float, extent: float, coefficients: int, iterations: int
) -> dict[str, float | torch.Tensor]:
    """Learning rates of the tensors of `Gaussians` at `progress` in [0, 1]; of sh one per entry, [coefficients, 3].

    extent: scene size in world units. coefficients: number of spherical-harmonic coefficients of a Gaussian.
    iterations: of the whole run.
    """
    cool, haste = cooling(progress), min(MOST_HASTE, (2000 / iterations) ** 0.5)
    sh = torch.full((coefficients, 3), cool * HARMONICS)
    sh[0] = cool * COLORS
    return {
        "means": cool * haste * MEANS * (MEANS_LAST / MEANS) ** progress * extent,
        "quats": cool * haste * QUATS,
        "log_scales": cool * SCALES,
        "opacity_logits": cool * OPACITIES,
        "sh": sh,
        "features": cool * FEATURES,
    }


def cooling(progress: float, share: float = COOLDOWN) -> float:
    """Factor of all rates at `progress`: 1, then half a cosine from 1 to 0.05 over the last `share` of training."""
    if share <= 0 or progress <= 1 - share:
        return 1.0
    return 0.05 + 0.95 * 0.5 * (1 + float(np.cos(np.pi * (progress - 1 + share) / share)))
