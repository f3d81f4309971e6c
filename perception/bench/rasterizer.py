"""Speed against error of the rasterizer: `perception bench rasterizer [SCENE.npz ...] [-o FOLDER]`.

Times forward + backward to the 3D parameters on every SIMD level this processor has, every case once a round
(interleaved, so that a busy machine is equally unkind to all). A pair is one Gaussian contributing to one pixel. Its
nanoseconds are CPU time of all threads: of the median round, and of the least disturbed one. `--device cuda` adds
torch's current GPU, and gsplat on it where that is installed, with the square of each feature for its variance.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.bench.output import Column, bench_parser, finish, table
from perception.errors import InputError
from perception.io.arrays import read_npz
from perception.io.documents import refusing

if TYPE_CHECKING:
    from torch import Tensor

GPU, ON_GPU = "cuda", ("cuda", "gsplat")
SPLAT_KEYS = ("means", "quats", "scales", "opacities", "colors", "features")
STAGES = ("project", "sort", "bin", "blend", "blend_backward", "reduce")
COLUMNS: tuple[Column, ...] = (
    ("ms", "median_ms", ".1f"),
    ("fwd", "forward_ms", ".1f"),
    ("CPU ms", "cpu_ms", ".1f"),
    ("ns/pair", "ns_per_pair", ".2f"),
    ("least", "least_ns_per_pair", ".2f"),
    ("x 1 thread", "times_one_thread", ".2f"),
    ("x baseline", "times_baseline", ".1f"),
    ("x gsplat", "times_gsplat", ".2f"),
    ("max error", "error_max", ".1e"),
    ("grad", "gradient_error", ".1e"),
    *((stage.replace("blend_backward", "back"), f"share_{stage}", ".0%") for stage in STAGES),
)
HEADS = ("scene", "simd", "dtype", "channels", "threads")


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
    import torch

    expected = f"an .npz with {', '.join(SPLAT_KEYS)}, viewmat, K, width, height"
    with refusing(f"{path}: not a splats file ({{why}}); expected {expected}"):
        data = read_npz(path, path, f"expected {expected}")
        scene: dict[str, Any] = {k: torch.from_numpy(data[k].astype(np.float32)) for k in SPLAT_KEYS}
        scene["viewmats"], scene["Ks"] = (torch.from_numpy(data[k].astype(np.float32))[None] for k in ("viewmat", "K"))
        return {**scene, "width": int(data["width"]), "height": int(data["height"])}


@dataclass(frozen=True)
class Case:
    """One timed configuration. simd: a SIMD level, or of ON_GPU. rich: RGB, features and their variance, else RGB."""

    simd: str
    dtype: str
    rich: bool
    threads: int


@dataclass
class Turn:
    """One forward and backward pass: seconds of wall time and, in `cpu`, of CPU time of all threads."""

    forward: float
    total: float
    cpu: float
    stages: dict[str, float]


def _run(scene: dict[str, Any], case: Case, dtype: str) -> tuple[Turn, Any, list[Tensor]]:
    """One pass: its times, the rasterizer's statistics, and images and gradients, flattened to float64."""
    import torch

    from perception.rasterizer.rasterize import RasterizationStats, rasterize

    on_gpu = case.simd in ON_GPU and dtype == case.dtype
    device = torch.device(GPU if on_gpu else "cpu")
    inputs = {k: v.to(device, getattr(torch, dtype)) if hasattr(v, "dtype") else v for k, v in scene.items()}
    names = [k for k in SPLAT_KEYS if case.rich or k != "features"]
    inputs |= {k: inputs[k].detach().requires_grad_() for k in names} | ({} if case.rich else {"features": None})
    channels = 3 + (2 * scene["features"].shape[1] if case.rich else 0)
    g = torch.Generator().manual_seed(1)
    pulls = torch.rand((1, scene["height"], scene["width"], channels), generator=g, dtype=torch.float64) * 2 - 1
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    wait()
    cpu, start = time.process_time(), time.perf_counter()
    if on_gpu and case.simd == "gsplat":
        stats, images = RasterizationStats(torch.empty(0)), _gsplat(inputs)
    else:
        simd = "auto" if case.simd in ON_GPU else case.simd
        out = rasterize(**inputs, depth=False, variance=case.rich, threads=case.threads, simd=simd)
        stats = out.stats
        images = [image for image in (out.colors, out.features, out.feature_variance) if image is not None]
    wait()
    middle, spent = time.perf_counter(), time.process_time() - cpu
    cotangents = [pull.to(images[0]) for pull in pulls.split([image.shape[-1] for image in images], dim=-1)]
    wait()
    cpu, again = time.process_time(), time.perf_counter()
    gradients = torch.autograd.grad(images, [inputs[k] for k in names], cotangents)
    wait()
    total, spent = middle - start + time.perf_counter() - again, spent + time.process_time() - cpu
    flat = [torch.cat([t.detach().cpu().double().flatten() for t in tensors]) for tensors in (images, gradients)]
    return Turn(middle - start, total, spent, stats.seconds), stats, flat


def _gsplat(inputs: dict[str, Any]) -> list[Tensor]:
    """gsplat's images of the arguments of `rasterize`."""
    import torch
    from gsplat import rasterization

    colors, features = inputs["colors"], inputs["features"]
    channels = [colors] if features is None else [colors, features, features.square()]
    names = ("means", "quats", "scales", "opacities", "viewmats", "Ks", "width", "height")
    rendered, _, _ = rasterization(**{name: inputs[name] for name in names}, colors=torch.cat(channels, dim=1))
    image, *more = rendered.split([part.shape[1] for part in channels], dim=-1)
    return [image, more[0], more[1] - more[0].square()] if more else [image]


def cases(threads: Sequence[int], dtypes: Sequence[str], device: str = "cpu") -> list[Case]:
    """Every SIMD level × precision × {RGB, rich} × number of threads; float32 on the GPU."""
    from perception.gaussians.device import choose_device
    from perception.rasterizer.cpu import simd_levels

    both = (False, True)
    chosen = [Case(s, d, rich, t) for d in dtypes for rich in both for s in simd_levels() for t in threads]
    if device == "cuda":
        choose_device("cuda")
        here = ON_GPU if importlib.util.find_spec("gsplat") else ON_GPU[:1]
        chosen += [Case(name, "float32", rich, 1) for rich in both for name in here]
    return chosen


def measure(name: str, scene: dict[str, Any], chosen: Sequence[Case], rounds: int) -> list[dict[str, Any]]:
    """One row per case. The first round is a warm-up and is not counted."""
    turns = [{case: _run(scene, case, case.dtype)[0] for case in chosen} for _ in range(rounds + 1)][1:]

    def times_faster(case: Case, other: Case) -> float | None:
        """Median over the rounds of (wall time of `other` / wall time of `case`); None where `other` was not timed."""
        return statistics.median(t[other].total / t[case].total for t in turns) if other in chosen else None

    return [
        {
            **_row(name, scene, case, [turn[case] for turn in turns]),
            "times_one_thread": times_faster(case, replace(case, threads=1)),
            "times_baseline": times_faster(case, replace(case, simd="baseline")),
            "times_gsplat": times_faster(case, replace(case, simd="gsplat")),
        }
        for case in chosen
    ]


def _row(name: str, scene: dict[str, Any], case: Case, turns: list[Turn]) -> dict[str, Any]:
    """Times, and the largest absolute image error and relative L2 gradient error against the float64 build."""
    _, stats, (image, grad) = _run(scene, case, case.dtype)
    _, exact_stats, (exact, exact_grad) = _run(scene, case, "float64")
    stats = exact_stats if case.simd in ON_GPU else stats  # pairs are not counted there
    pairs, cpu = max(1, stats.contributing_pairs), [t.cpu for t in turns]
    seconds = {stage: statistics.median(t.stages.get(stage, 0.0) for t in turns) for stage in STAGES}
    total = max(sum(seconds.values()), 1e-12)
    return {
        "scene": name, "simd": case.simd, "dtype": case.dtype, "threads": case.threads,
        "channels": f"RGB+{scene['features'].shape[1]}+var" if case.rich else "RGB",
        "gaussians": len(scene["means"]), "width": scene["width"], "height": scene["height"],
        "evaluated_pairs": stats.evaluated_pairs, "contributing_pairs": stats.contributing_pairs,
        "median_ms": 1e3 * statistics.median(t.total for t in turns),
        "forward_ms": 1e3 * statistics.median(t.forward for t in turns), "cpu_ms": 1e3 * statistics.median(cpu),
        "ns_per_pair": 1e9 * statistics.median(cpu) / pairs, "least_ns_per_pair": 1e9 * min(cpu) / pairs,
        "error_max": float((image - exact).abs().max()),
        "gradient_error": float((grad - exact_grad).norm() / exact_grad.norm().clamp(min=1e-300)),
        **{f"share_{stage}": seconds[stage] / total for stage in STAGES},
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None, kind: type[argparse.ArgumentParser] = argparse.ArgumentParser) -> None:
    """Prints the table; JSON goes to the output folder. kind: of the parser of the arguments."""
    parser = bench_parser("rasterizer", __doc__, kind)
    parser.add_argument("scenes", nargs="*", type=Path, help="splats .npz files; a synthetic scene when absent")
    parser.add_argument("--rounds", type=int, default=7, help="counted rounds, at least 1 (default 7)")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--dtypes", nargs="+", default=["float32", "float64"], choices=("float32", "float64"))
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="cuda: the GPU too (default cpu)")
    options = parser.parse_args(arguments)
    if options.rounds < 1 or min(options.threads) < 1:
        raise InputError(f"bench rasterizer: found {options.rounds} rounds and threads {options.threads}, expected ≥ 1")
    chosen, rows, lines = cases(options.threads, options.dtypes, options.device), [], []
    for path in options.scenes or [None]:
        scene = load_scene(path) if path else synthetic_scene()
        first, *more = measure(path.stem if path else "synthetic", scene, chosen, options.rounds)
        rows += [first, *more]
        pairs, evaluated = first["contributing_pairs"] / 1e6, first["evaluated_pairs"] / 1e6
        size = f"{first['gaussians']} Gaussians, {first['width']}×{first['height']}"
        lines.append(f"{first['scene']}: {size}, {pairs:.2f} M pairs contribute of {evaluated:.2f} M evaluated")
    finish("rasterizer", options, {"rows": rows}, "\n".join([*lines, table(rows, COLUMNS, HEADS)]))
