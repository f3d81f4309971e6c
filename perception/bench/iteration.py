"""A whole training iteration, and what each part of it costs; used by the `training` bench.

The trainer itself runs; its parts are timed where it calls the compiled code. "torch" is what is left: activations,
autograd, sums and statistics.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

PARTS = ("rasterizer", "SSIM + L1", "instance", "variance", "Adam", "torch")


def make_trainer(scene: dict[str, Any], labels: int, sh_degree: int, losses: bool) -> Any:
    """A trainer of the scene's Gaussians on one photo of them with noise; every iteration has all losses if `losses`.

    scene: as `perception.bench.splats.load_scene` reads it.
    """
    import torch

    from perception.config import load_config
    from perception.gaussians.model import SH_C0, Gaussians
    from perception.gaussians.train import Trainer, TrainingView, render_view

    count, generator = len(scene["means"]), torch.Generator().manual_seed(0)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (scene["colors"] - 0.5) / SH_C0
    gaussians = Gaussians(
        scene["means"], scene["quats"], scene["scales"].log(), scene["opacities"].clamp(1e-4, 0.9999).logit(), sh,
        0.1 * torch.randn(count, 8, generator=generator),
    )  # fmt: skip
    height, width = scene["height"], scene["width"]
    blank = torch.zeros(height, width, 3, dtype=torch.uint8)
    image = (torch.arange(height * width) * labels // (height * width) + 1).reshape(height, width).int()
    view = TrainingView("photo", blank, image if losses else None, scene["Ks"][0], scene["viewmats"][0])
    noise = 0.1 * torch.randn(height, width, 3, generator=generator)
    photo = ((render_view(gaussians, view) + noise).clamp(0, 1) * 255).to(torch.uint8)
    always = ["losses.start=0", "losses.every=1", "losses.half_resolution=false", "train.coarse_until=0"]
    still = ["densify.every=1000000", "train.iterations=1000000", f"train.sh_degree={sh_degree}"]
    view = TrainingView(view.name, photo, view.labels, view.K, view.camera_from_world)
    return Trainer(gaussians, [view], load_config(None, [*always, *still]), [])


@contextmanager
def timed_parts(seconds: dict[str, float]) -> Iterator[None]:
    """Adds the wall-clock seconds of each part's compiled calls to `seconds` while it is open."""
    from perception import _core
    from perception.gaussians import rasterize

    kernels = _core.training  # type: ignore[attr-defined]
    calls: list[tuple[str, Any, list[str]]] = [
        ("rasterizer", rasterize, ["rasterize_forward", "rasterize_backward"]),
        ("SSIM + L1", kernels, ["photometric"]),
        ("instance", kernels, ["assign", "prototypes", "spread", "separation"]),
        ("variance", kernels, ["sum", "scale"]),
        ("Adam", kernels, ["adam"]),
    ]

    def clocked(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                seconds[part] += time.perf_counter() - start

        return run

    with ExitStack() as stack:
        for part, owner, names in calls:
            for name in names:
                stack.enter_context(patch.object(owner, name, clocked(part, getattr(owner, name))))
        yield


def measure_iteration(trainer: Any, turns: int) -> dict[str, float]:
    """Median milliseconds of every part and of the whole ("total") over `turns` iterations after two to warm up."""
    import numpy as np

    rows = []
    for turn in range(turns + 2):
        seconds = dict.fromkeys(PARTS, 0.0)
        start = time.perf_counter()
        with timed_parts(seconds):
            trainer.step()
        total = time.perf_counter() - start
        seconds["torch"] = total - sum(seconds.values())
        if turn >= 2:
            rows.append([*seconds.values(), total])
    medians = 1e3 * np.median(np.array(rows), axis=0)
    return {name: float(ms) for name, ms in zip((*PARTS, "total"), medians, strict=True)}


def measure_iterations(
    scene: dict[str, Any], threads: tuple[int, ...], turns: int, labels: int = 60
) -> list[dict[str, Any]]:
    """One row per harmonics' degree, number of threads and {all losses, photometric only}, each in milliseconds."""
    import torch

    from perception import _core

    rows: list[dict[str, Any]] = []
    for degree in (0, 3):
        for losses in (True, False):
            for count in threads:
                torch.set_num_threads(count)
                _core.training.set_threads(count)  # type: ignore[attr-defined]
                parts = measure_iteration(make_trainer(scene, labels, degree, losses), turns)
                share = parts["rasterizer"] / parts["total"]
                row: dict[str, Any] = {"sh_degree": degree, "losses": "all" if losses else "photometric"}
                rows.append(row | {"threads": count, "ms": parts, "rasterizer_share": share})
    return rows


def iteration_table(rows: list[dict[str, Any]]) -> str:
    """The rows as text, milliseconds."""
    lines = [f"{'losses':13}{'SH':>3}{'thr':>4}" + "".join(f"{part:>12}" for part in (*PARTS, "total")) + "  share"]
    for row in rows:
        head = f"{row['losses']:13}{row['sh_degree']:>3}{row['threads']:>4}"
        values = "".join(f"{row['ms'][part]:12.2f}" for part in (*PARTS, "total"))
        lines.append(f"{head}{values}{row['rasterizer_share']:7.0%}")
    return "\n".join(lines)


def draw_iterations(rows: list[dict[str, Any]]) -> Callable[[Any], None]:
    """What draws the rows as stacked bars on a figure."""

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        labels = [f"{row['losses']}, SH {row['sh_degree']}, {row['threads']} thr" for row in rows]
        left = [0.0] * len(rows)
        for part in PARTS:
            widths = [row["ms"][part] for row in rows]
            axis.barh(labels, widths, left=left, label=part)
            left = [a + b for a, b in zip(left, widths, strict=True)]
        axis.invert_yaxis()
        axis.set_xlabel("milliseconds an iteration")
        axis.legend()

    return draw


def default_scene(path: Path | None) -> dict[str, Any]:
    """The splats at `path`, or 54,000 synthetic Gaussians before a camera of 270 × 480."""
    from perception.bench.splats import load_scene, synthetic_scene

    return load_scene(path) if path else synthetic_scene(54_000, 270, 480)
