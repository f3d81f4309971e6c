"""Measures the levels of detail of a map: PSNR to renders of all its Gaussians, time and memory for millions.

python tools speed.levels MAP [--millions 5]
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np
import torch


def render(
    means: np.ndarray, cov: np.ndarray, opacities: np.ndarray, colors: np.ndarray, gmap: object
) -> list[np.ndarray]:
    """Pictures of Gaussians with covariances from the map's held-out views."""
    from scipy.spatial.transform import Rotation

    from perception.rasterizer.rasterize import rasterize

    values, axes = np.linalg.eigh(cov.astype(np.float64))
    axes = axes * np.linalg.det(axes)[:, None, None]
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    scales = np.sqrt(np.maximum(values, 1e-16))
    arrays = (means, quats, scales, np.minimum(opacities, 0.999), colors / 255)
    tensors = [torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays]
    found = []
    for view in [view for view in gmap.views if view.held_out][:6]:  # type: ignore[attr-defined]
        pose, K = (torch.from_numpy(np.asarray(a, np.float32))[None] for a in (view.camera_from_world, view.K))
        with torch.no_grad():
            out = rasterize(*tensors, pose, K, view.width, view.height)
        found.append(out.colors[0].clamp(0, 1).numpy())
    return found


def psnr(a: list[np.ndarray], b: list[np.ndarray]) -> float:
    return float(-10 * np.log10(np.mean([np.square(x - y).mean() for x, y in zip(a, b, strict=True)])))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("map", type=Path)
    parser.add_argument("--millions", type=float, default=5.0)
    options = parser.parse_args()
    from perception import load_map
    from perception.colors import rgb8_from_sh
    from perception.viewer.levels import MOST, level
    from perception.viewer.picking import covariances

    gmap = load_map(options.map)
    cov, colors, opacities = covariances(gmap), rgb8_from_sh(gmap.sh[:, 0]), gmap.opacities
    whole = render(gmap.means, cov, opacities, colors, gmap)
    print(f"{options.map}: {len(gmap)} Gaussians; PSNR to their renders, without harmonics")
    for halvings in (1, 2, 3, 4):
        most = len(gmap) >> halvings
        made = level(gmap.means, cov, opacities, gmap.instance_ids, most)
        shown = made.opacities(np.ones(len(gmap), bool))
        merged = render(made.means, made.covariances, shown, made.colors(colors), gmap)
        kept = np.random.default_rng(0).choice(len(gmap), len(made), replace=False)
        wide = cov[kept] * (len(gmap) / len(made))  # as much area in all
        dropped = render(gmap.means[kept], wide, opacities[kept], colors[kept], gmap)
        ours, random = psnr(whole, merged), psnr(whole, dropped)
        print(f"  1/{1 << halvings}: {len(made)}  {ours:.2f} dB, drawn at random {random:.2f} dB")
    count = int(options.millions * 1e6)
    rows = np.random.default_rng(1).integers(0, len(gmap), count)
    means = gmap.means[rows] + np.random.default_rng(2).normal(0, 0.01, (count, 3)).astype(np.float32)
    start = time.perf_counter()
    made = level(means, cov[rows], opacities[rows], gmap.instance_ids[rows])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    sent = len(made) * (12 + 24 + 3 + 4) / 2**20
    print(
        f"{count} Gaussians to {len(made)} (at most {MOST}): {time.perf_counter() - start:.1f} s, peak {peak:.1f} GiB"
    )
    print(f"about {sent:.0f} MiB for the page")


if __name__ == "__main__":
    main()
