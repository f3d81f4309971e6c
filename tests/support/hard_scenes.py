"""Scenes at the edge of what numbers can hold, by name, in float64, and how far float32 may stray."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from support import reference_rasterizer as reference
from support.rasterizer import scene

Inputs = dict[str, Any]
U = 2.0**-24
"""Unit roundoff of float32."""


def _front(n: int = 40, **options: Any) -> Inputs:
    """Gaussians before a camera at the origin that looks along z."""
    inputs = scene(n=n, cameras=1, **options)
    inputs["viewmats"][0] = torch.eye(4)
    inputs["means"][:, 2] = inputs["means"][:, 2].abs() + 0.5
    return inputs


def _scales(value: float, axes: slice) -> Callable[[], Inputs]:
    def make() -> Inputs:
        inputs = _front()
        inputs["scales"][::2, axes] = value
        return inputs

    return make


def _crossing() -> Inputs:
    """Means on both sides of the near plane and of the camera, each far wider than its distance to them."""
    inputs = _front()
    inputs["means"][:, 2] = torch.linspace(-0.05, 0.12, 40, dtype=torch.float64)
    inputs["means"][:, :2] *= 0.02
    inputs["scales"] = 0.03 + 0.1 * inputs["scales"]
    return inputs


def _behind() -> Inputs:
    inputs = _front()
    inputs["means"][::2, 2] *= -1
    return inputs


def _outside() -> Inputs:
    """Half the means far outside the frustum, wide enough to reach into it: J is taken at the clamped place."""
    inputs = _front()
    inputs["means"][::2, 0] = torch.linspace(-60, 60, 20, dtype=torch.float64)
    inputs["scales"][::2] = 20.0
    inputs["opacities"][::2] = 0.5
    return inputs


def _quats(factor: float) -> Callable[[], Inputs]:
    def make() -> Inputs:
        inputs = _front()
        inputs["quats"] = inputs["quats"] * factor
        return inputs

    return make


def _zero_quats() -> Inputs:
    inputs = _front()
    inputs["quats"][::2] = 0
    return inputs


def _opacities() -> Inputs:
    inputs = _front()
    inputs["opacities"][::4], inputs["opacities"][1::4] = 0.0, 1 - 1e-7
    inputs["opacities"][2::4] = 1.0
    return inputs


def _ties() -> Inputs:
    inputs = _front()
    inputs["means"][:, 2] = 2.0
    return inputs


def _image(width: int, height: int) -> Callable[[], Inputs]:
    def make() -> Inputs:
        inputs = _front(n=12)
        inputs["Ks"] = torch.tensor([[[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]]], dtype=torch.float64)
        inputs["scales"] = inputs["scales"] + 0.3
        return {**inputs, "width": width, "height": height}

    return make


def _camera(fx: float, cx: float, cy: float) -> Callable[[], Inputs]:
    def make() -> Inputs:
        inputs = _front()
        inputs["Ks"] = torch.tensor([[[fx, 0, cx], [0, fx, cy], [0, 0, 1]]], dtype=torch.float64)
        if fx > 1000:  # what such a lens sees at all
            inputs["means"][:, :2] *= 30 / fx
            inputs["scales"] = inputs["scales"] * 30 / fx
        return inputs

    return make


def _beside(cx: float) -> Inputs:
    """The principal point outside the image, the Gaussians where the image is."""
    inputs = _camera(30.0, cx, 17.0)()
    inputs["means"][:, 0] += (16 - cx) / 30 * inputs["means"][:, 2]
    return inputs


def _features(factor: float, offset: float = 0.0) -> Callable[[], Inputs]:
    def make() -> Inputs:
        inputs = _front()
        inputs["features"] = inputs["features"] * factor + offset
        return inputs

    return make


def _walls() -> Inputs:
    """Layer upon opaque layer: the transmittance would underflow if blending did not stop."""
    inputs = _front()
    inputs["scales"][:] = 50.0
    inputs["opacities"][:] = 1.0
    return inputs


def _coincident() -> Inputs:
    inputs = _front(n=80)
    for name in ("means", "quats", "scales"):
        inputs[name][:] = inputs[name][0].clone()
    inputs["means"][:] = torch.tensor([0.1, -0.1, 2.0])
    inputs["opacities"][:] = 0.05
    return inputs


SCENES: dict[str, Callable[[], Inputs]] = {
    "crossing the near plane": _crossing,
    "behind the camera": _behind,
    "far outside the frustum": _outside,
    "scale 0": _scales(0.0, slice(0, 3)),
    "scale 1e-8": _scales(1e-8, slice(0, 3)),
    "scale 1e4": _scales(1e4, slice(0, 3)),
    "needle": _scales(30.0, slice(0, 1)),
    "needle of zero width": _scales(0.0, slice(1, 3)),
    "pancake": _scales(1e-9, slice(0, 1)),
    "pancake 1e4 wide": _scales(1e4, slice(1, 3)),
    "quaternions 1e-9": _quats(1e-9),
    "quaternions 1e30": _quats(1e30),
    "zero quaternions": _zero_quats,
    "opacity 0, 1 - 1e-7 and 1": _opacities,
    "80 coincident": _coincident,
    "depth ties": _ties,
    "1 x 1": _image(1, 1),
    "1 x 4096": _image(1, 4096),
    "4096 x 1": _image(4096, 1),
    "63 x 65": _image(63, 65),
    "transmittance underflow": _walls,
    "features 1e4": _features(1e4),
    "features 1e-8": _features(1e-8),
    "features 1e4 with spread 1e-2": _features(1e-2, 1e4),
    "principal point left of the image": lambda: _beside(-200.0),
    "principal point far right": lambda: _beside(900.0),
    "focal length 1": _camera(1.0, 18.0, 14.0),
    "focal length 1e5": _camera(1e5, 18.0, 14.0),
}


def weights(rasterize: Callable[..., Any], inputs: Inputs) -> torch.Tensor:
    """[H, W, N] float64: how much each Gaussian adds to each pixel (features that pick one Gaussian each)."""
    picks = torch.eye(len(inputs["means"]), dtype=inputs["means"].dtype)
    out = rasterize(**{**inputs, "features": picks})
    return (out["features"] if isinstance(out, dict) else out.features)[0].double()


def relative_bound(inputs: Inputs) -> tuple[torch.Tensor, torch.Tensor]:
    """(bound [H, W, N] on |w32 / w64 − 1|, pixels [H, W] away from every threshold), to first order in U.

    w = α Π (1 − α_j). A relative error ρ of the alphas moves w by at most ρ (1 + Σ_{j before} α_j / (1 − α_j)).
    α = o exp(−½ dᵀ Σ⁻¹ d): with s² the smallest eigenvalue of Σ (at least 0.3 px²), κ its condition number, q =
    dᵀ Σ⁻¹ d and δ the error of the projected mean in pixels, |d ln α| ≤ δ √q / s + ½ q κ ε + 4 U, where q ≤ 2 ln 255
    wherever α reaches 1/255. The counts of roundings are read off the formulas: the mean is two dot products of four
    terms, a division, a product and a sum (δ ≤ 12 U (f (|R||m| + |t|) / z + |c|)); Σ is the square of J R Q S, 24
    roundings deep.
    """
    means, view, k = inputs["means"], inputs["viewmats"][0], inputs["Ks"][0]
    place = means @ view[:3, :3].T + view[:3, 3]
    z = place[:, 2].clamp(min=1e-12)
    size = (means.abs() @ view[:3, :3].abs().T + view[:3, 3].abs()).amax(dim=1)
    slant = 1 + (place[:, :2] / z[:, None]).abs().amax(dim=1)
    delta = 12 * U * (k[0, 0] * size / z * slant + k[:2, 2].abs().amax())
    low, high = _eigenvalues(inputs, place, z)
    q = 2 * torch.log(torch.tensor(255.0, dtype=torch.float64))
    rho = delta * q.sqrt() / low.sqrt() + 0.5 * q * (high / low) * 48 * U + 4 * U
    w = weights(reference.rasterize, inputs)
    order = torch.argsort(place[:, 2], stable=True)
    before = torch.cumsum(w[..., order], dim=-1) - w[..., order]
    alpha = (w[..., order] / (1 - before).clamp(min=1e-9)).clamp(max=0.999)
    grown = torch.cumsum(rho[order] * alpha / (1 - alpha), dim=-1)
    bound = torch.empty_like(w)
    bound[..., order] = rho[order] + grown
    return bound, _away(inputs, rho, w, order)


def _eigenvalues(inputs: Inputs, place: torch.Tensor, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    k, view = inputs["Ks"][0], inputs["viewmats"][0]
    width, height, fx, fy = inputs["width"], inputs["height"], k[0, 0], k[1, 1]
    u = (place[:, 0] / z).clamp(-k[0, 2] / fx - 0.15 * width / fx, (width - k[0, 2]) / fx + 0.15 * width / fx)
    v = (place[:, 1] / z).clamp(-k[1, 2] / fy - 0.15 * height / fy, (height - k[1, 2]) / fy + 0.15 * height / fy)
    zero = torch.zeros_like(z)
    rows = [torch.stack([fx / z, zero, -fx * u / z], -1), torch.stack([zero, fy / z, -fy * v / z], -1)]
    m = torch.stack(rows, -2) @ view[:3, :3] @ reference.rotation_matrices(inputs["quats"])
    m = m * inputs["scales"][:, None, :]
    values = torch.linalg.eigvalsh(m @ m.transpose(1, 2) + 0.3 * torch.eye(2, dtype=m.dtype))
    return values[:, 0].clamp(min=0.3), values[:, 1].clamp(min=0.3)


def _away(inputs: Inputs, rho: torch.Tensor, w: torch.Tensor, order: torch.Tensor) -> torch.Tensor:
    """Pixels where no rounding within `rho` can push an alpha over 1/255 or the transmittance over 1e-4."""
    slightly = 1 + rho.clamp(max=0.5) * 4 + 1e-5
    away = torch.ones(w.shape[:2], dtype=torch.bool)
    for factor in (slightly, 1 / slightly):
        moved = weights(reference.rasterize, {**inputs, "opacities": inputs["opacities"] * factor})
        away &= ((moved > 0) == (w > 0)).all(dim=-1)
    return away
