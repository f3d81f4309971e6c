"""Learning rates over the course of training (Kerbl et al. 2023, for a tenth of their iterations)."""

from __future__ import annotations

import numpy as np
import torch

MEANS, MEANS_LAST = 1.6e-4, 5e-5
"""Of the means at the start and the end, times the scene's extent. Kerbl et al. let it fall to a hundredth; a tenth of
their iterations leaves no time for small steps."""
QUATS = 1e-3
SCALES = 1e-2
"""Of log-scales: twice theirs, as that of the colours; that of the higher harmonics is eight times theirs."""
OPACITIES = 0.05
COLORS, HARMONICS = 5e-3, 1e-3
FEATURES = 1e-2
COOLDOWN = 0.1
"""Last share of the course, over which all rates fall to a twentieth."""


def learning_rates(progress: float, extent: float, coefficients: int) -> dict[str, float | torch.Tensor]:
    """Rates of all tensors of `Gaussians` at `progress` in [0, 1]; of sh one a coefficient, [coefficients, 3].

    extent: size of the scene in world units.
    """
    cool = cooling(progress)
    sh = torch.full((coefficients, 3), cool * HARMONICS)
    sh[0] = cool * COLORS
    return {
        "means": cool * MEANS * (MEANS_LAST / MEANS) ** progress * extent,
        "quats": cool * QUATS,
        "log_scales": cool * SCALES,
        "opacity_logits": cool * OPACITIES,
        "sh": sh,
        "features": cool * FEATURES,
    }


def cooling(progress: float, share: float = COOLDOWN) -> float:
    """Factor of all rates at `progress`: 1, and over the last `share` of the course down to .05 (half a cosine)."""
    if share <= 0 or progress <= 1 - share:
        return 1.0
    return 0.05 + 0.95 * 0.5 * (1 + float(np.cos(np.pi * (progress - 1 + share) / share)))
