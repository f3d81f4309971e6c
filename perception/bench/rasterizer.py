"""Speed against error of the rasterizer: `perception bench rasterizer [SCENE.npz ...] [-o FOLDER]`.

Times forward + backward to the 3D parameters on every SIMD level this processor has, every case once a round
(interleaved, so that a busy machine is equally unkind to all). A pair is one Gaussian contributing to one pixel. Its
nanoseconds are CPU time of all threads: of the median round, and of the least disturbed one.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perception.bench.output import Column, bench_parser, finish, save_plot, table
from perception.bench.processes import fresh_peak, status_mib
from perception.bench.splats import SPLAT_KEYS, load_scene, synthetic_scene
from perception.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

STAGES = ("project", "sort", "bin", "blend", "blend_backward", "reduce")
COLUMNS: tuple[Column, ...] = (
    ("ms", "median_ms", ".1f"),
    ("IQR", "iqr_ms", ".1f"),
    ("fwd", "forward_ms", ".1f"),
    ("CPU ms", "cpu_ms", ".1f"),
    ("ns/pair", "ns_per_pair", ".2f"),
    ("least", "least_ns_per_pair", ".2f"),
    ("x 1 thread", "times_one_thread", ".2f"),
    ("x baseline", "times_baseline", ".1f"),
    ("p99.9", "error_p999", ".1e"),
    ("mean", "error_mean", ".1e"),
    ("max", "error_max", ".1e"),
    ("grad", "gradient_error", ".1e"),
    ("peak MiB", "peak_mib", ".0f"),
    *((stage.replace("blend_backward", "back"), f"share_{stage}", ".0%") for stage in STAGES),
)
HEADS = ("scene", "simd", "dtype", "channels", "threads")


@dataclass(frozen=True)
class Case:
    """One timed configuration. rich: features and their variance are rendered in addition to RGB."""

    simd: str
    dtype: str
    rich: bool
    threads: int


@dataclass
class Turn:
    """One forward and backward pass."""

    forward: float  # seconds of wall time
    total: float
    cpu: float  # seconds of CPU time, all threads
    stages: dict[str, float]


def _render(scene: dict[str, Any], rich: bool, dtype: Any, **options: Any) -> tuple[Any, list[Tensor], list[Tensor]]:
    """The rasterizer's result, the list of its images, and the leaf tensors that receive gradients."""
    from perception.gaussians.rasterize import rasterize

    inputs = {k: v.to(dtype) if hasattr(v, "dtype") else v for k, v in scene.items()}
    names = [k for k in SPLAT_KEYS if rich or k != "features"]
    inputs |= {k: inputs[k].detach().requires_grad_() for k in names} | ({} if rich else {"features": None})
    out = rasterize(**inputs, depth=False, variance=rich, **options)
    images = [out.colors, out.features, out.feature_variance] if rich else [out.colors]
    return out, images, [inputs[k] for k in names]  # type: ignore[return-value]


def _cotangents(images: list[Tensor]) -> list[Tensor]:
    """Cotangents drawn uniformly from [-1, 1], equal for both precisions."""
    import torch

    g = torch.Generator().manual_seed(1)
    return [(torch.rand(t.shape, generator=g, dtype=torch.float64) * 2 - 1).to(t.dtype) for t in images]


def _turn(scene: dict[str, Any], case: Case, cotangents: list[Tensor]) -> Turn:
    import torch

    cpu, start = time.process_time(), time.perf_counter()
    out, images, leaves = _render(scene, case.rich, getattr(torch, case.dtype), simd=case.simd, threads=case.threads)
    middle = time.perf_counter()
    torch.autograd.grad(images, leaves, cotangents)
    end = time.perf_counter()
    return Turn(middle - start, end - start, time.process_time() - cpu, out.stats.seconds)


def _errors(scene: dict[str, Any], case: Case) -> dict[str, float]:
    """Absolute image error and relative L2 gradient error against the float64 build of the same level."""
    import torch

    def run(dtype: Any) -> tuple[Tensor, Tensor]:
        _, images, leaves = _render(scene, case.rich, dtype, simd=case.simd)
        grads = torch.autograd.grad(images, leaves, _cotangents(images))
        flat = [torch.cat([t.detach().double().flatten() for t in tensors]) for tensors in (images, grads)]
        return flat[0], flat[1]

    (image, grad), (exact, exact_grad) = run(getattr(torch, case.dtype)), run(torch.float64)
    error = (image - exact).abs()
    p999 = float(error.kthvalue(max(1, int(0.999 * error.numel()))).values)
    relative = float((grad - exact_grad).norm() / exact_grad.norm())
    figures = {"error_p999": p999, "error_mean": float(error.mean()), "error_max": float(error.max())}
    return figures | {"gradient_error": relative}


def _peak_mib(scene: dict[str, Any], case: Case) -> float | None:
    """MiB that a first forward and backward pass adds, including images and gradients; None where it is not Linux."""
    import torch

    fresh_peak()
    before = status_mib("VmRSS")
    if math.isnan(before):
        return None
    _, images, leaves = _render(scene, case.rich, getattr(torch, case.dtype), simd=case.simd, threads=case.threads)
    torch.autograd.grad(images, leaves, [torch.ones_like(t) for t in images])
    return status_mib("VmHWM") - before


def cases(threads: Sequence[int], dtypes: Sequence[str]) -> list[Case]:
    """Every SIMD level × precision × {RGB, rich} × number of threads."""
    from perception.gaussians.rasterize import simd_levels

    return [Case(s, d, rich, t) for d in dtypes for rich in (False, True) for s in simd_levels() for t in threads]


def measure(name: str, scene: dict[str, Any], chosen: Sequence[Case], rounds: int) -> list[dict[str, Any]]:
    """One row per case. The first round is a warm-up and is not counted."""
    import torch

    turns: dict[Case, list[Turn]] = {case: [] for case in chosen}
    cotangents = {}
    for case in chosen:
        key = case.dtype, case.rich
        if key not in cotangents:
            cotangents[key] = _cotangents(_render(scene, case.rich, getattr(torch, case.dtype))[1])
    for i in range(rounds + 1):
        for case in chosen:
            turn = _turn(scene, case, cotangents[case.dtype, case.rich])
            if i:
                turns[case].append(turn)
    rows = [_row(name, scene, case, turns[case]) for case in chosen]
    for case, row in zip(chosen, rows, strict=True):
        row["times_one_thread"] = times_faster(turns, case, replace(case, threads=1))
        row["times_baseline"] = times_faster(turns, case, replace(case, simd="baseline"))
    return rows


def times_faster(turns: dict[Case, list[Turn]], case: Case, other: Case) -> float | None:
    """Median over the rounds of (wall time of `other` / wall time of `case`); None where `other` was not timed."""
    if other not in turns:
        return None
    return statistics.median(b.total / a.total for a, b in zip(turns[case], turns[other], strict=True))


def _row(name: str, scene: dict[str, Any], case: Case, turns: list[Turn]) -> dict[str, Any]:
    import torch

    stats = _render(scene, case.rich, getattr(torch, case.dtype), simd=case.simd)[0].stats
    pairs = max(1, stats.contributing_pairs)
    total, cpu = sorted(1e3 * t.total for t in turns), [t.cpu for t in turns]
    quarter = max(1, len(total) // 4)
    seconds = {stage: statistics.median(t.stages[stage] for t in turns) for stage in STAGES}
    whole = max(sum(seconds.values()), 1e-12)
    return {
        "scene": name, "simd": case.simd, "dtype": case.dtype, "threads": case.threads,
        "channels": f"RGB+{scene['features'].shape[1]}+var" if case.rich else "RGB",
        "gaussians": len(scene["means"]), "width": scene["width"], "height": scene["height"],
        "evaluated_pairs": stats.evaluated_pairs, "contributing_pairs": stats.contributing_pairs,
        "median_ms": statistics.median(total), "least_ms": total[0], "iqr_ms": total[-quarter] - total[quarter - 1],
        "forward_ms": 1e3 * statistics.median(t.forward for t in turns), "cpu_ms": 1e3 * statistics.median(cpu),
        "ns_per_pair": 1e9 * statistics.median(cpu) / pairs, "least_ns_per_pair": 1e9 * min(cpu) / pairs,
        "peak_mib": _peak_mib(scene, case), **_errors(scene, case),
        **{f"share_{stage}": seconds[stage] / whole for stage in STAGES},
    }  # fmt: skip


def _draw(rows: list[dict[str, Any]]) -> Any:
    def draw(figure: Any) -> None:
        axis = figure.subplots()
        labels = [" ".join(str(row[head]) for head in HEADS) for row in rows]
        left = [0.0] * len(rows)
        for stage in STAGES:
            widths = [row["ns_per_pair"] * row[f"share_{stage}"] for row in rows]
            axis.barh(labels, widths, left=left, label=stage.replace("_", " "))
            left = [a + b for a, b in zip(left, widths, strict=True)]
        axis.invert_yaxis()
        axis.set_xlabel("CPU nanoseconds per contributing pair, forward + backward")
        axis.legend()

    return draw


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table; JSON and a plot go to the output folder."""
    parser = bench_parser("rasterizer", __doc__)
    parser.add_argument("scenes", nargs="*", type=Path, help="splats .npz files; a synthetic scene when absent")
    parser.add_argument("--rounds", type=int, default=7, help="counted rounds, at least 1 (default 7)")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--dtypes", nargs="+", default=["float32", "float64"], choices=("float32", "float64"))
    options = parser.parse_args(arguments)
    if options.rounds < 1 or min(options.threads) < 1:
        raise InputError(f"bench rasterizer: found {options.rounds} rounds and threads {options.threads}, expected ≥ 1")
    rows: list[dict[str, Any]] = []
    for path in options.scenes or [None]:
        scene = load_scene(path) if path else synthetic_scene()
        rows += measure(
            path.stem if path else "synthetic", scene, cases(options.threads, options.dtypes), options.rounds
        )
    heads = {row["scene"]: row for row in rows}.values()
    text = "\n".join(
        f"{row['scene']}: {row['gaussians']} Gaussians, {row['width']}×{row['height']}, "
        f"{row['contributing_pairs'] / 1e6:.2f} M pairs contribute of {row['evaluated_pairs'] / 1e6:.2f} M evaluated"
        for row in heads
    )
    finish("rasterizer", options, {"rows": rows}, f"{text}\n{table(rows, COLUMNS, HEADS)}")
    save_plot(options.output / "rasterizer.png", _draw(rows), (9, 1 + 0.28 * len(rows)))
