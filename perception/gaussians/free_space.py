"""The space around the cameras of few photos, into which Gaussians reach only where something was measured.

Colours of few photos leave free how far a surface is. What shows a wall in some can then hang before the cameras
of others that do not see it, and it is a veil before photos taken between these.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from perception.gaussians.densify import rotation_matrices
from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView

REACH, NEAREST = 0.8, 0.01
"""Radius of the space around a camera, as a share of the depth of the nearest points in its photo, of which the share
NEAREST is noise. With 0.5 veils hung between the spaces of neighbouring cameras."""
MEASURED = 0.5
"""Share of that radius within which a measured point must lie, and up to which a Gaussian there may extend. With 0.25 a
plain wall beside the cameras goes, too, that only edges of photos show: 0.7 dB with every 2nd photo of a fox."""


class FreeSpace:
    """points [P, 3]: what was measured, here the means of the first Gaussians; views: of the cameras."""

    def __init__(self, points: np.ndarray, views: Sequence[TrainingView]):
        self._measured = cKDTree(points)
        balls = [_ball(points, view) for view in views]
        self._balls = [(center, radius) for center, radius in balls if radius > 0]

    def reached_by(self, gaussians: Gaussians) -> np.ndarray:
        """[N] bool: whether each Gaussian reaches, by a standard deviation, into the space around a camera, and was not
        measured there."""
        means, scales = gaussians.means.double(), gaussians.scales.double()
        least = torch.full_like(means[:, 0], torch.inf)  # radius of the balls that each Gaussian reaches into
        found = least < 0
        for center, radius, near in self._near(gaussians):
            away = torch.from_numpy(center).to(means) - means[near]
            distance = away.square().sum(dim=1).sqrt()
            axes = rotation_matrices(gaussians.quats[near]).double()
            toward = (away[:, :, None] * axes).sum(dim=1) / distance.clamp(min=1e-9)[:, None]
            extent = (scales[near] * toward).square().sum(dim=1).sqrt()  # standard deviation on the ray to the camera
            reaching = distance - extent < radius
            found[near[reaching & (extent > MEASURED * radius)]] = True
            rows = near[reaching]
            least[rows] = least[rows].clamp(max=radius)
        asked = (least.isfinite() & ~found).nonzero()[:, 0]
        bound = MEASURED * least[asked].cpu().numpy()
        most = np.nextafter(bound.max(initial=0), np.inf)
        away = self._measured.query(means[asked].cpu().numpy(), distance_upper_bound=most)[0]
        found[asked] = torch.from_numpy(away > bound).to(found.device)
        return found.cpu().numpy()

    def _near(self, gaussians: Gaussians) -> Iterator[tuple[np.ndarray, float, torch.Tensor]]:
        """Centre, radius, and the rows of the Gaussians that may reach into the ball, by their widest axes."""
        middle = self._balls[0][0] if self._balls else np.zeros(3)
        means = gaussians.means - torch.from_numpy(middle).to(gaussians.means)
        squares, widest = means.square().sum(dim=1), gaussians.scales.amax(dim=1)
        rounding = 1e-5 * squares
        for center, radius in self._balls:
            c = torch.from_numpy(center - middle).to(means)
            within = torch.addmv(squares, means, c, alpha=-2) + c.square().sum() * (1 - 1e-5) - rounding
            yield center, radius, (within < (widest + radius).square()).nonzero()[:, 0]


def _ball(points: np.ndarray, view: TrainingView) -> tuple[np.ndarray, float]:
    """Centre [3] of the camera, and the radius around it; 0 where its photo shows no point."""
    inside, _, z = view.seen(points)
    radius = REACH * float(np.quantile(z[inside], NEAREST)) if len(inside) else 0.0
    pose = view.camera[1]
    return -pose[:3, :3].T @ pose[:3, 3], radius
