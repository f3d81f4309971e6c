"""Training in milliseconds: losses and Adam beside plain torch and OpenCV, and the whole iteration by its parts.

Every ratio is taken within one run: contenders take turns; printed are the median over turns and its
quartiles. Forward and backward are timed together, at the sizes of a photo and a map in training.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from perception.bench.iteration import default_scene, draw_iterations, iteration_table, measure_iterations
from perception.bench.sweep_cli import Column, finish, save_plot, table
from perception.errors import InputError

Contenders = dict[str, Callable[[], Any]]


def interleaved(contenders: Contenders, turns: int) -> dict[str, dict[str, float]]:
    """name -> median and quartiles in ms over `turns` turns after two warm-up turns."""
    import numpy as np

    times: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(turns + 2):
        for name, run in contenders.items():
            start = time.perf_counter()
            run()
            if turn >= 2:
                times[name].append(1e3 * (time.perf_counter() - start))
    quartiles = {name: np.percentile(t, [25, 50, 75]) for name, t in times.items()}
    return {n: {"median": float(q[1]), "q25": float(q[0]), "q75": float(q[2])} for n, q in quartiles.items()}


def _torch_photometric(x: Any, y: Any, beta: float) -> Any:
    """Plain torch with separable convolutions, the usual way."""
    import torch
    from torch.nn.functional import conv2d

    taps = torch.exp(-0.5 * ((torch.arange(11.0) - 5) / 1.5) ** 2)
    row = (taps / taps.sum())[None, None, None].expand(15, 1, 1, 11)
    a, b = x.permute(2, 0, 1), y.permute(2, 0, 1)
    maps = torch.cat([a, b, a * a, b * b, a * b])[None]
    maps = conv2d(conv2d(maps, row, padding=(0, 5), groups=15), row.transpose(2, 3), padding=(5, 0), groups=15)
    mx, my, xx, yy, xy = maps[0].split(3)
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
    ssim = ssim / ((mx * mx + my * my + c1) * (xx + yy - mx * mx - my * my + c2))
    return (1 - beta) * (x - y).abs().mean() + beta * (1 - ssim.mean())


def _cv2_photometric(x: Any, y: Any, beta: float) -> tuple[float, Any]:
    """Value and gradient with OpenCV's separable filter on numpy images [H, W, 3]."""
    import cv2
    import numpy as np

    taps = cv2.getGaussianKernel(11, 1.5, cv2.CV_32F)
    blur = lambda image: cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_CONSTANT)  # noqa: E731
    mx, my = blur(x), blur(y)
    product, squares = mx * my, mx * mx + my * my
    a1, a2 = 2 * product + 1e-4, 2 * (blur(x * y) - product) + 9e-4
    b1, b2 = squares + 1e-4, blur(x * x + y * y) - squares + 9e-4
    inverse = 1 / (b1 * b2)
    ssim = a1 * a2 * inverse
    mean = 2 * inverse * (my * (a2 - a1) + mx * ssim * (b1 - b2))
    gradient = blur(mean) - 2 * x * blur(ssim / b2) + y * blur(2 * a1 * inverse)
    d = x - y
    value = (1 - beta) * np.abs(d).mean() + beta * (1 - ssim.mean())
    return float(value), ((1 - beta) * np.sign(d) - beta * gradient) / d.size


def _torch_instance(features: Any, labels: Any, count: int) -> Any:
    """L_pos + L_neg of the paper with index_add and pdist; labels [P] int64, 0 = unlabelled."""
    import torch

    flat = features.reshape(-1, features.shape[2])
    pixels = torch.bincount(labels, minlength=count + 1).clamp(min=1)[:, None]
    z = torch.zeros(count + 1, flat.shape[1]).index_add(0, labels, flat) / pixels
    share = (1 / (count * pixels[:, 0])).index_fill(0, torch.tensor([0]), 0.0)
    pos = (((flat - z[labels]) ** 2).sum(1) * share[labels]).sum()
    return pos + torch.relu(1 - torch.nn.functional.pdist(z[1:]) ** 2).mean()


def photometric_case(height: int, width: int) -> Contenders:
    """L_RGB at β = .2 of random images, forward and backward."""
    import torch

    from perception.gaussians.losses import photometric_loss

    photo = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8)
    render, target = torch.rand(height, width, 3, requires_grad=True), photo.float() / 255
    as_numpy = render.detach().numpy(), target.numpy()
    return {
        "compiled": lambda: torch.autograd.grad(photometric_loss(render, photo), render),
        "compiled, L1 only": lambda: torch.autograd.grad(photometric_loss(render, photo, 0.0), render),
        "cv2 sepFilter2D": lambda: _cv2_photometric(*as_numpy, 0.2),
        "torch separable": lambda: torch.autograd.grad(_torch_photometric(render, target, 0.2), render),
    }


def instance_case(height: int, width: int, depth: int, count: int) -> Contenders:
    """L_inst2D on square patches of labels, forward and backward."""
    import torch

    from perception.gaussians.losses import assign_labels, instance_loss

    features = (0.3 * torch.randn(height, width, depth)).requires_grad_()
    labels = torch.arange(height * width).reshape(height, width) * count // (height * width) + 1
    flat, image = labels.reshape(-1), labels.int()
    assigned = assign_labels(image)
    return {
        "compiled": lambda: torch.autograd.grad(instance_loss(features, image).value, features),
        "compiled, labels kept": lambda: torch.autograd.grad(instance_loss(features, assigned).value, features),
        "torch index_add": lambda: torch.autograd.grad(_torch_instance(features, flat, count), features),
    }


def variance_case(height: int, width: int, depth: int) -> Contenders:
    """L_var, forward and backward."""
    import torch

    from perception.gaussians.losses import variance_loss

    variance = torch.rand(height, width, depth, requires_grad=True)
    return {
        "compiled": lambda: torch.autograd.grad(0.5 * variance_loss(variance), variance),
        "torch": lambda: torch.autograd.grad(0.5 * (variance**2).sum(2).mean(), variance),
    }


def adam_case(rows: int) -> Contenders:
    """One step of a map of `rows` Gaussians with SH degree 3 and 8 features (67 numbers each)."""
    import torch

    from perception.gaussians.optimiser import SparseAdam

    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (16, 3), "features": (8,)}
    grads = {name: 1e-3 * torch.randn(rows, *shape) for name, shape in shapes.items()}
    ours = SparseAdam({n: torch.zeros(rows, *s) for n, s in shapes.items()}, dict.fromkeys(shapes, 1e-3))
    theirs = [torch.zeros(rows, *shape, requires_grad=True) for shape in shapes.values()]
    for param, grad in zip(theirs, grads.values(), strict=True):
        param.grad = grad
    dense = torch.optim.Adam(theirs, lr=1e-3, eps=1e-15)
    fused = torch.optim.Adam([p.detach().requires_grad_() for p in theirs], lr=1e-3, eps=1e-15, fused=True)
    for param, grad in zip(fused.param_groups[0]["params"], grads.values(), strict=True):
        param.grad = grad
    half = torch.rand(rows) < 0.5
    near = torch.arange(rows) < rows // 2
    return {
        "compiled, all": lambda: ours.step(None, grads),
        "compiled, half, scattered": lambda: ours.step(half, grads),
        "compiled, half, in one run": lambda: ours.step(near, grads),
        "torch Adam": lambda: dense.step(),
        "torch Adam fused": lambda: fused.step(),
    }


COLUMNS: tuple[Column, ...] = (("ms", "median", ".2f"), ("q25", "q25", ".2f"), ("q75", "q75", ".2f"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the tables; JSON and a plot of the whole iteration go to the output folder."""
    parser = argparse.ArgumentParser(prog="perception bench training", description=__doc__)
    parser.add_argument(
        "scene", nargs="?", type=Path, help="splats .npz for the whole iteration; synthetic when absent"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("bench-training"), help="folder for figures")
    parser.add_argument("--height", type=int, default=480, help="of the losses' photo")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--depth", type=int, default=8, help="feature channels")
    parser.add_argument("--labels", type=int, default=60)
    parser.add_argument("--gaussians", type=int, default=54000, help="rows of Adam's tensors")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="the losses run on the largest")
    parser.add_argument("--turns", type=int, default=11)
    options = parser.parse_args(arguments)
    if options.turns < 1 or min(options.threads) < 1:
        raise InputError(f"bench training: found {options.turns} turns, threads {options.threads}, expected at least 1")

    # Idle workers of torch's OpenMP pool spin and would take the processor from the contender after torch.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    scene = default_scene(options.scene)
    operations = measure_operations(options)
    iterations = measure_iterations(scene, tuple(options.threads), options.turns, options.labels)
    size = f"{len(scene['means'])} Gaussians, {scene['width']}×{scene['height']}"
    text = f"{table(operations, COLUMNS)}\n\nWhole iteration, ms: {size}\n{iteration_table(iterations)}"
    options.output.mkdir(parents=True, exist_ok=True)
    finish("training", options, {"operations": operations, "iterations": iterations}, text)
    save_plot(options.output / "training.png", draw_iterations(iterations))


def measure_operations(options: argparse.Namespace) -> list[dict[str, Any]]:
    """One row a contender: group, name, quartiles in ms."""
    import cv2
    import torch

    from perception import _core

    torch.manual_seed(0)
    threads = max(options.threads)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    _core.training.set_threads(threads)  # type: ignore[attr-defined]
    cases = {
        "photometric": photometric_case(options.height, options.width),
        "instance": instance_case(options.height, options.width, options.depth, options.labels),
        "variance": variance_case(options.height, options.width, options.depth),
        "adam": adam_case(options.gaussians),
    }
    return [
        {"group": group, "name": name, "threads": threads, **figures}
        for group, case in cases.items()
        for name, figures in interleaved(case, options.turns).items()
    ]
