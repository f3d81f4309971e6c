"""The record of a run in map.json: settings, times, memory, and quality in views held out of training."""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from typing import Any

import numpy as np

from perception.evaluate.images import ssim
from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView, depth_image, psnr, render_view
from perception.machine import peak_memory_mib
from perception.pipeline.checkpoint import fingerprint
from perception.pipeline.optimise import Optimised, Run
from perception.tasks.folder import versions
from perception.types import Scene

CLOSE_METRES, CLOSE_SHARE = 0.05, 0.025  # errors that count as close: in metres, or relative where the unit is unknown
FRAME_FACTS = ("map_from_input", "scale", "gravity")  # entries of a scene's report that map.json holds at its top level


def finite(value: Any) -> Any:
    """JSON-able `value` with None for every float that is NaN or infinite, which JSON cannot hold."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def run_record(
    run: Run, scene: Scene, optimised: Optimised, instances: dict[str, Any], quality: dict[str, Any]
) -> dict[str, Any]:
    """The facts of map.json but for its views and files. instances: report of grouping and description."""
    seconds = {**run.seconds, "total": time.monotonic() - run.started}
    facts = {
        "frame": scene.frame,
        "metric": scene.metric,
        **{key: scene.report[key] for key in FRAME_FACTS if key in scene.report},
        "source": str(run.source.absolute()),
        "seed": run.config.seed,
        "fingerprint": fingerprint(run.source, run.config),
        "config": run.config.to_json(),
        "versions": versions(),
        "scene": {key: fact for key, fact in scene.report.items() if key not in FRAME_FACTS},
        "masks": optimised.masks,
        "depth": depth_used(optimised.photos.views),
        "training": asdict(optimised.record),
        "instances": instances,
        "quality": quality,
        "seconds": {name: round(value, 2) for name, value in seconds.items()},
        "peak_memory_mib": peak_memory_mib(),
    }
    return facts | ({"blocks": optimised.blocks} if optimised.blocks else {}) | {"inputs": run.inputs}


def scored(run: Run, optimised: Optimised, metric: bool) -> tuple[Gaussians, dict[str, Any]]:
    """The Gaussians on the CPU, and their quality in the held-out views."""
    with run.stage("score"):
        gaussians = optimised.nearby.gaussians.to("cpu")
        return gaussians, score_views(gaussians, optimised.photos.held, metric)


def score_views(gaussians: Gaussians, views: list[TrainingView], metric: bool = False) -> dict[str, Any]:
    """PSNR and SSIM of each view without ignored pixels, and their means; empty without views.

    Depth is compared where it was measured; metric: the unit is the metre.
    """
    per_view = {}
    for view in views:
        image = render_view(gaussians, view)
        weight = None if view.weight is None else view.weight.numpy()
        similarity = ssim(image.numpy(), view.photo.numpy().astype(np.float64) / 255, weight)
        per_view[view.name] = {"psnr": psnr(image, view.photo, view.weight), "ssim": similarity}
    if not per_view:
        return {"views": {}}
    means = {name: float(np.mean([entry[name] for entry in per_view.values()])) for name in ("psnr", "ssim")}
    depth = depth_errors(gaussians, views, metric)
    return {**means, **({"depth": depth} if depth else {}), "views": per_view}


def depth_used(views: list[TrainingView]) -> dict[str, Any] | None:
    """Number of training views with a depth image and the share of their pixels that has depth; None without any."""
    shares = [float((view.depth > 0).double().mean()) for view in views if view.depth is not None]
    return {"views": len(shares), "measured": round(float(np.mean(shares)), 4)} if shares else None


def depth_errors(gaussians: Gaussians, views: list[TrainingView], metric: bool) -> dict[str, Any] | None:
    """Errors of the rendered depth where a sensor measured, over all `views`; None when no pixel has both.

    median: absolute error in units of the map, or relative to the depth (unit "relative") where that is not the metre.
    close: share of the measured pixels with an error of at most `tolerance`; rendered: share that the map covers.
    """
    errors, measured = [], 0
    for view in views:
        if view.depth is None:
            continue
        rendered = depth_image(gaussians, view.camera_from_world, view.K, *view.photo.shape[1::-1]).numpy()
        known = view.depth.numpy() > 0
        measured += int(known.sum())
        both = known & (rendered > 0)
        true = view.depth.numpy()[both].astype(np.float64)
        errors.append(np.abs(rendered[both] - true) / (1 if metric else true))
    if not errors or not sum(map(len, errors)):
        return None
    error, tolerance = np.concatenate(errors), CLOSE_METRES if metric else CLOSE_SHARE
    return {
        "median": round(float(np.median(error)), 5),
        "close": round(float((error <= tolerance).sum() / measured), 4),
        "tolerance": tolerance,
        "unit": "m" if metric else "relative",
        "rendered": round(len(error) / measured, 4),
    }
