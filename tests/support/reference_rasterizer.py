"""A naive dense rasterizer in torch, the oracle of the compiled one: every rule spelt out."""

from __future__ import annotations

import torch
from torch import Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """[N, 4] wxyz of any norm -> [N, 3, 3]; the zero quaternion is the identity."""
    norm = quats.norm(dim=-1, keepdim=True)
    return rotation_polynomial(quats / torch.where(norm > 0, norm, torch.ones_like(norm)))


def rotation_polynomial(quats: Tensor) -> Tensor:
    """[N, 4] wxyz -> [N, 3, 3], the polynomial that is a rotation where the norm is 1."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(r, -1) for r in rows], -2)


def sh_colors(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    """3DGS spherical harmonics: real SH with the Condon-Shortley phase; +0.5, clamped at 0."""
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).unbind(-1)
    pi = torch.pi
    one = torch.ones_like(x)
    basis = [one * (1 / (4 * pi)) ** 0.5]
    if degree >= 1:
        k = (3 / (4 * pi)) ** 0.5
        basis += [-k * y, k * z, -k * x]
    if degree >= 2:
        k = (15 / (4 * pi)) ** 0.5
        basis += [
            k * x * y, -k * y * z, (5 / (16 * pi)) ** 0.5 * (2 * z * z - x * x - y * y),
            -k * x * z, k / 2 * (x * x - y * y),
        ]  # fmt: skip
    if degree >= 3:
        a, b, c = (35 / (32 * pi)) ** 0.5, (105 / (4 * pi)) ** 0.5, (21 / (32 * pi)) ** 0.5
        basis += [
            -a * y * (3 * x * x - y * y), b * x * y * z, -c * y * (4 * z * z - x * x - y * y),
            (7 / (16 * pi)) ** 0.5 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c * x * (4 * z * z - x * x - y * y), b / 2 * z * (x * x - y * y), -a * x * (x * x - 3 * y * y),
        ]  # fmt: skip
    b = torch.stack(basis, -1)
    return (torch.einsum("nk,nkc->nc", b, coefficients[:, : b.shape[1]]) + 0.5).clamp(min=0)


def _camera(means, quats, scales, opacities, colors, viewmat, k, width, height, features, near_plane, eps2d, taps=None):  # type: ignore[no-untyped-def]
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    p = means @ rotation.T + translation
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    mx, my = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy

    def clamped(u, v):  # type: ignore[no-untyped-def]
        return u.clamp(-cx / fx - mx, (width - cx) / fx + mx), v.clamp(-cy / fy - my, (height - cy) / fy + my)

    keep = p[:, 2] > near_plane
    u, v = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
    tx, ty = clamped(u, v)
    keep &= ((tx == u) & (ty == v)) | (u**2 + v**2 <= 25)  # the guard band
    index = torch.nonzero(keep)[:, 0]
    index = index[torch.argsort(p[index, 2].detach(), stable=True)]
    p, z = p[index], p[index, 2]
    u, v = p[:, 0] / z, p[:, 1] / z
    tx, ty = clamped(u, v)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * tx / z], -1), torch.stack([zero, fy / z, -fy * ty / z], -1)], -2
    )
    m = jacobian @ rotation @ rotation_matrices(quats[index]) * scales[index][:, None, :]
    cov = m @ m.transpose(1, 2) + eps2d * torch.eye(2, dtype=m.dtype)
    conic = torch.linalg.inv(cov)
    ys, xs = torch.meshgrid(
        torch.arange(height, dtype=m.dtype) + 0.5, torch.arange(width, dtype=m.dtype) + 0.5, indexing="ij"
    )
    pixels = torch.stack([xs, ys], -1).reshape(-1, 2)
    d = torch.stack([fx * u + cx, fy * v + cy], -1)[:, None] - pixels[None]
    if taps is not None:
        d.retain_grad()
        taps.append((index, d, conic.detach()))
    q = torch.einsum("npi,nij,npj->np", d, conic, d)
    raw = opacities[index][:, None] * torch.exp(-0.5 * q)
    alpha = torch.where(raw >= 1 / 255, raw.clamp(max=0.999), torch.zeros_like(raw))
    t = torch.ones(pixels.shape[0], dtype=m.dtype)
    open_ = torch.ones(pixels.shape[0], dtype=torch.bool)
    weights = []
    for a in alpha:
        after = t * (1 - a)
        open_ = open_ & ~((a > 0) & (after < 1e-4))
        weights.append(torch.where(open_, a * t, torch.zeros_like(t)))
        t = torch.where(open_, after, t)
    w = torch.stack(weights) if weights else torch.zeros((0, pixels.shape[0]), dtype=m.dtype)
    visible = torch.zeros(means.shape[0], dtype=torch.bool)
    visible[index] = (w > 0).any(1)
    out = {"colors": w.T @ colors[index], "alphas": 1 - t, "depths": w.T @ z, "transmittance": t}
    out["pairs"] = (w > 0).sum(0)  # Gaussians that contribute to the pixel
    if features is not None:
        f = features[index]
        out["features"] = w.T @ f
        mean = (w.T @ f)[:, None] / w.sum(0)[:, None, None].clamp(min=1e-300)
        centred = (f[None] - mean) ** 2  # two passes: Var = Σ w (f - m)² + A (1 - A) m²
        total = w.sum(0)[:, None]
        out["feature_variance"] = torch.einsum("np,pnd->pd", w, centred) + total * t[:, None] * mean[:, 0] ** 2
    return out, visible


def rasterize(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height,
    sh_degree=None, features=None, background=None, near_plane=0.01, eps2d=0.3, taps=None,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """The same arguments as perception.rasterize; a dict of tensors with the same names.

    taps: a list to which each camera adds the indices [n] of its Gaussians, the vectors [n, P, 2] from the pixels to
    the 2D means, of which autograd then keeps the gradient, and the inverse covariances [n, 2, 2].
    """
    results = []
    for c in range(viewmats.shape[0]):
        rgb = colors
        if sh_degree is not None:
            centre = -viewmats[c, :3, :3].T @ viewmats[c, :3, 3]
            rgb = sh_colors(sh_degree, means - centre, colors)
        out, visible = _camera(
            means, quats, scales, opacities, rgb, viewmats[c], Ks[c], width, height, features, near_plane, eps2d, taps
        )
        t = out.pop("transmittance")
        if background is not None:
            shade = background if background.ndim == 1 else background[c]
            out["colors"] = out["colors"] + t[:, None] * shade
        out = {k: v.reshape(height, width, *v.shape[1:]) for k, v in out.items()}
        results.append({**out, "visible": visible})
    return {k: torch.stack([r[k] for r in results]) for k in results[0]}
