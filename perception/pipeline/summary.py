"""Results in words: what `map`, `info` and `query` print, and the points a query writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.io.store import GaussianMap
from perception.query import Hit


def map_facts(path: Path, info: dict[str, Any], gaussians: int, instances: int) -> dict[str, Any]:
    """The JSON answer of `perception map`."""
    scene = info["scene"]
    return {
        "map": str(path),
        "gaussians": gaussians,
        "instances": instances,
        "quality": info["quality"],
        "seconds": info["seconds"],
        "peak_memory_mib": info["peak_memory_mib"],
        "iterations": info["training"]["iterations"],
        "scene": scene,
    }


def info_text(path: Path, info: dict[str, Any]) -> str:
    """map.json for a person."""
    quality, training, scene = info.get("quality", {}), info.get("training", {}), info.get("scene", {})
    seconds = info.get("seconds", {})
    lines = [
        f"{path}: {info['num_gaussians']} Gaussians (harmonics degree {info['sh_degree']}), "
        f"{info['num_instances']} instances, {'metres' if info.get('metric') else 'units of the reconstruction'}",
        f"made from {info.get('source')} (seed {info.get('seed')}) in {seconds.get('total', 0):.0f} s: "
        + ", ".join(f"{name} {value:.0f}" for name, value in seconds.items() if name != "total"),
        f"trained {training.get('iterations')} iterations; peak memory {info.get('peak_memory_mib')} MiB",
    ]
    if "psnr" in quality:
        lines.append(
            f"held-out views: PSNR {quality['psnr']:.2f} dB, SSIM {quality['ssim']:.4f} over {len(quality['views'])}"
        )
    lines += [f"decision: {text}" for text in training.get("decisions", [])]
    lines += [f"left out: {entry['name']} ({entry['why']})" for entry in scene.get("left_out", [])]
    lines += [f"warning: {text}" for text in scene.get("warnings", [])]
    return "\n".join(lines)


def query_text(answers: list[tuple[str, list[Hit]]], metric: bool) -> str:
    """Ranked hits, or "not present", a line each."""
    unit = " m" if metric else ""
    lines = []
    for text, hits in answers:
        if not hits:
            lines.append(f'"{text}": not present')
        for rank, hit in enumerate(hits, start=1):
            x, y, z = hit.centroid
            a, b, c = hit.obb.extent
            name = f" ({hit.label})" if hit.label else ""
            lines.append(
                f'"{text}" {rank}. instance {hit.instance_id}{name}  score {hit.score:.2f}'
                f"  at {x:.3f} {y:.3f} {z:.3f}{unit}"
                f"  size {a:.3f} x {b:.3f} x {c:.3f}{unit}  {len(hit.points)} points"
            )
    return "\n".join(lines)


def write_hits(path: Path, gmap: GaussianMap, hits: list[Hit]) -> None:
    """The hits' points as one cloud with `instance_id` and the map's colours."""
    from perception.gaussians.model import SH_C0
    from perception.io.cloud import write_cloud
    from perception.types import PointCloud

    rows = np.flatnonzero(np.isin(gmap.instance_ids, [hit.instance_id for hit in hits]))
    colors = np.clip((gmap.sh[rows, 0] * SH_C0 + 0.5) * 255 + 0.5, 0, 255).astype(np.uint8)
    write_cloud(path, PointCloud(gmap.means[rows], colors, labels={"instance_id": gmap.instance_ids[rows]}))
