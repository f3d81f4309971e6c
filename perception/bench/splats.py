"""Gaussians with one camera, used to benchmark the rasterizer and training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from perception.errors import InputError

SPLAT_KEYS = ("means", "quats", "scales", "opacities", "colors", "features")


def synthetic_scene(n: int = 50_000, width: int = 640, height: int = 480) -> dict[str, Any]:
    """A synthetic set of small Gaussians in front of one camera, float32, in the format of `load_scene`."""
    import torch

    g = torch.Generator().manual_seed(0)
    means = (torch.rand((n, 3), generator=g) - 0.5) * torch.tensor([8.0, 6.0, 6.0]) + torch.tensor([0.0, 0.0, 5.0])
    return {
        "means": means,
        "quats": torch.randn((n, 4), generator=g),
        "scales": torch.exp(torch.randn((n, 3), generator=g) * 0.5 - 4.0),
        "opacities": torch.rand(n, generator=g) * 0.9 + 0.05,
        "colors": torch.rand((n, 3), generator=g),
        "features": torch.randn((n, 8), generator=g),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[500.0, 0, width / 2], [0, 500.0, height / 2], [0, 0, 1]]]),
        "width": width,
        "height": height,
    }


def load_scene(path: Path) -> dict[str, Any]:
    """Reads a splats .npz: means, quats, scales, opacities, colors, features, viewmat, K, width, height.

    Returns the arguments of `perception.rasterize` for one camera, float32.
    """
    import zipfile

    import numpy as np
    import torch

    try:
        data = np.load(path)
        scene: dict[str, Any] = {k: torch.from_numpy(data[k].astype(np.float32)) for k in SPLAT_KEYS}
        scene["viewmats"], scene["Ks"] = (torch.from_numpy(data[k].astype(np.float32))[None] for k in ("viewmat", "K"))
        scene["width"], scene["height"] = int(data["width"]), int(data["height"])
    except (OSError, KeyError, ValueError, IndexError, zipfile.BadZipFile) as error:
        expected = f"an .npz with {', '.join(SPLAT_KEYS)}, viewmat, K, width, height"
        raise InputError(f"{path}: not a splats file ({error}); expected {expected}") from None
    return scene
