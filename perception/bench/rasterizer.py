"""Speed against error of the rasterizer: `python -m perception.bench.rasterizer [scene.npz] [--json FILE]`.

Times forward + backward to the 3D parameters, every case once a round (interleaved, so that a busy machine is
equally unkind to all), and reports the error to the float64 build. A pair is one Gaussian contributing to one
pixel; its nanoseconds are CPU time, the steadier figure on a shared machine.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perception.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

SPLAT_KEYS = ("means", "quats", "scales", "opacities", "colors", "features")


@dataclass
class Case:
    """One line of the table; times in milliseconds of wall clock, cpu_ms (the least) summed over threads."""

    simd: str
    threads: int
    channels: str
    median_ms: float
    min_ms: float
    spread_ms: float
    forward_ms: float
    cpu_ms: float
    ns_per_pair: float
    error_p999: float
    error_mean: float
    gradient_error: float


def synthetic_scene(n: int = 50_000, width: int = 640, height: int = 480) -> dict[str, Any]:
    """A cloud of small Gaussians in front of one camera, float32."""
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
    """A splats .npz: means, quats, scales, opacities, colors, features, viewmat, K, width, height."""
    import numpy as np
    import torch

    try:
        data = np.load(path)
        scene: dict[str, Any] = {k: torch.from_numpy(data[k].astype(np.float32)) for k in SPLAT_KEYS}
        scene["viewmats"], scene["Ks"] = (torch.from_numpy(data[k].astype(np.float32))[None] for k in ("viewmat", "K"))
        scene["width"], scene["height"] = int(data["width"]), int(data["height"])
    except (OSError, KeyError, ValueError) as error:
        raise InputError(
            f"{path}: not a splats file ({error}); expected an .npz with {', '.join(SPLAT_KEYS)}"
        ) from None
    return scene


def _render(scene: dict[str, Any], rich: bool, **options: Any) -> tuple[Any, list[Tensor], list[Tensor]]:
    from perception.gaussians.rasterize import rasterize

    inputs = {**scene, "features": scene["features"] if rich else None}
    leaves = [inputs[k].detach().clone().requires_grad_() for k in SPLAT_KEYS if inputs[k] is not None]
    inputs.update(zip([k for k in SPLAT_KEYS if inputs[k] is not None], leaves, strict=True))
    out = rasterize(**inputs, depth=rich, variance=rich, **options)
    images = [out.colors, out.features, out.feature_variance] if rich else [out.colors]
    return out, images, leaves  # type: ignore[return-value]


def _cotangents(images: list[Tensor]) -> list[Tensor]:
    """Noise in [-1, 1], the same for both precisions."""
    import torch

    g = torch.Generator().manual_seed(1)
    return [(torch.rand(t.shape, generator=g, dtype=torch.float64) * 2 - 1).to(t.dtype) for t in images]


def _once(scene: dict[str, Any], rich: bool, **options: Any) -> tuple[float, float, float]:
    """Seconds of forward, forward + backward, and CPU time."""
    import torch

    cpu = time.process_time()
    start = time.perf_counter()
    _, images, leaves = _render(scene, rich, **options)
    middle, cpu_middle = time.perf_counter(), time.process_time()
    cotangents = _cotangents(images)
    again, cpu_again = time.perf_counter(), time.process_time()
    torch.autograd.grad(images, leaves, cotangents)
    end, cpu_end = time.perf_counter(), time.process_time()
    return middle - start, middle - start + end - again, cpu_middle - cpu + cpu_end - cpu_again


def _errors(scene: dict[str, Any], rich: bool, **options: Any) -> tuple[float, float, float]:
    """p99.9 and mean absolute error of the images, and the relative L2 error of the gradients, to float64."""
    import torch

    def run(dtype: Any) -> tuple[Tensor, Tensor]:
        cast = {k: v.to(dtype) if isinstance(v, torch.Tensor) else v for k, v in scene.items()}
        _, images, leaves = _render(cast, rich, **options)
        grads = torch.autograd.grad(images, leaves, _cotangents(images))
        return torch.cat([t.detach().double().flatten() for t in images]), torch.cat(
            [g.double().flatten() for g in grads]
        )

    (image, grad), (exact, exact_grad) = run(torch.float32), run(torch.float64)
    error = (image - exact).abs()
    p999 = float(error.kthvalue(max(1, int(0.999 * error.numel()))).values)
    return p999, float(error.mean()), float((grad - exact_grad).norm() / exact_grad.norm())


def measure(scene: dict[str, Any], rounds: int = 9, threads: tuple[int, ...] = (1, 2)) -> dict[str, Any]:
    """All levels × threads × {RGB, RGB + features + variance}, interleaved; a JSON-able report."""
    import torch

    from perception.gaussians.rasterize import simd_levels

    keys = [(s, t, rich) for s in simd_levels() for t in threads for rich in (False, True)]
    times: dict[Any, list[tuple[float, float, float]]] = {k: [] for k in keys}
    for i in range(rounds + 1):  # the first round warms up
        for key in keys:
            seconds = _once(scene, key[2], simd=key[0], threads=key[1])
            if i:
                times[key].append(seconds)
    pairs = max(1, _render(scene, False)[0].stats.contributing_pairs)
    cases = []
    for simd, n, rich in keys:
        total = [t[1] * 1e3 for t in times[simd, n, rich]]
        cpu = min(t[2] for t in times[simd, n, rich]) * 1e3
        cases.append(
            Case(
                simd, n, f"RGB+{scene['features'].shape[1]}+var" if rich else "RGB",
                statistics.median(total), min(total), max(total) - min(total),
                statistics.median(t[0] * 1e3 for t in times[simd, n, rich]), cpu, cpu * 1e6 / pairs,
                *_errors(scene, rich, simd=simd),
            )
        )  # fmt: skip
    return {
        "gaussians": scene["means"].shape[0], "width": scene["width"], "height": scene["height"],
        "pairs": pairs,
        "rounds": rounds, "machine": platform.processor() or platform.machine(), "torch": torch.__version__,
        "cases": [asdict(c) for c in cases],
    }  # fmt: skip


def table(report: dict[str, Any]) -> str:
    """The report as text."""
    size = f"{report['width']}×{report['height']}"
    head = f"{report['gaussians']} Gaussians, {size}, {report['pairs'] / 1e6:.2f} M pairs"
    names = f"{'simd':9}{'thr':>4}{'channels':>12}{'median':>9}{'min':>8}{'spread':>8}{'fwd':>7}{'cpu':>8}"
    lines = [head, f"{names}{'ns/pair':>9}{'p99.9':>10}{'mean':>10}{'grad':>10}"]
    for c in report["cases"]:
        lines.append(
            f"{c['simd']:9}{c['threads']:4}{c['channels']:>12}{c['median_ms']:9.1f}{c['min_ms']:8.1f}{c['spread_ms']:8.1f}"
            f"{c['forward_ms']:7.1f}{c['cpu_ms']:8.1f}{c['ns_per_pair']:9.2f}{c['error_p999']:10.1e}{c['error_mean']:10.1e}"
            f"{c['gradient_error']:10.1e}"
        )
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Command line; prints the table and writes the JSON where asked."""
    parser = argparse.ArgumentParser(prog="perception.bench.rasterizer", description=__doc__)
    parser.add_argument("scenes", nargs="*", type=Path, help="splats .npz files; a synthetic scene when absent")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(argv)
    reports = {}
    for path in args.scenes or [None]:
        scene = load_scene(path) if path else synthetic_scene()
        name = path.stem if path else "synthetic"
        reports[name] = measure(scene, args.rounds, tuple(args.threads))
        sys.stdout.write(f"{name}: {table(reports[name])}\n")
    if args.json:
        args.json.write_text(json.dumps(reports, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
