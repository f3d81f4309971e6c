"""Measures the `.spz` of a map: its share of the PLY's size, and PSNR of what is read back.

python tools speed.compressed MAP
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from support.compressed import read_spz

AXES = np.array([1, -1, -1])
"""Of spz, whose y and z point the other way."""


def render(gmap: object, arrays: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Pictures from the map's held-out views."""
    from perception.rasterizer.rasterize import rasterize

    names = ("means", "quats", "scales", "opacities", "sh")
    tensors = [torch.from_numpy(np.ascontiguousarray(arrays[name], np.float32)) for name in names]
    found = []
    for view in [view for view in gmap.views if view.held_out][:6]:  # type: ignore[attr-defined]
        pose, K = (torch.from_numpy(np.asarray(a, np.float32))[None] for a in (view.camera_from_world, view.K))
        degree = int(np.sqrt(arrays["sh"].shape[1])) - 1
        with torch.no_grad():
            out = rasterize(*tensors, pose, K, view.width, view.height, sh_degree=degree)
        found.append(out.colors[0].clamp(0, 1).numpy())
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("map", type=Path)
    options = parser.parse_args()
    from perception import load_map
    from perception.export.spz import FLIPS, spz_bytes

    gmap = load_map(options.map)
    own = {name: getattr(gmap, name) for name in ("means", "quats", "opacities", "sh")}
    whole = render(gmap, {**own, "scales": np.exp(gmap.log_scales)})
    size = (options.map / "gaussians.ply").stat().st_size
    start = time.perf_counter()
    data = spz_bytes(gmap)
    seconds = time.perf_counter() - start
    read = read_spz(data)
    read["means"], read["quats"] = read["means"] * AXES, read["quats"] * [1, *AXES]
    read["sh"] = read["sh"] * FLIPS[: read["sh"].shape[1], None]
    sh = np.concatenate([read["dc"][:, None], read["sh"]], axis=1)
    shown = render(gmap, {**read, "sh": sh, "scales": np.exp(read["log_scales"])})
    error = np.mean([np.square(a - b).mean() for a, b in zip(whole, shown, strict=True)])
    print(f".spz: {len(data) / size:.1%} of the PLY, {-10 * np.log10(error):.1f} dB, {seconds:.1f} s")


if __name__ == "__main__":
    main()
