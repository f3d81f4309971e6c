"""Output of `perception map`, `info` and `query`: JSON, text, and the points of query hits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.query import Hit


def map_facts(path: Path | str, info: dict[str, Any]) -> dict[str, Any]:
    """The JSON output of `perception map`; info: content of map.json."""
    scene = info["scene"]
    return {
        "map": str(path),
        "gaussians": info["num_gaussians"],
        "instances": info["num_instances"],
        "quality": info["quality"],
        "seconds": info["seconds"],
        "peak_memory_mib": info["peak_memory_mib"],
        "iterations": info["training"]["iterations"],
        "profile": shares(info["training"]),
        "decisions": info["training"]["decisions"],
        "scene": scene,
    }


def shares(training: dict[str, Any]) -> dict[str, float]:
    """Share of the training time of each part, largest first; "other" is the unattributed rest."""
    total = max(training.get("seconds", 0.0), 1e-9)
    parts = dict(training.get("profile", {}))
    parts["other"] = max(0.0, total - sum(parts.values()))
    return {name: round(parts[name] / total, 4) for name in sorted(parts, key=lambda name: -parts[name])}


def info_text(path: Path, info: dict[str, Any], texts: dict[int, list[dict[str, Any]]] | None = None) -> str:
    """Summary of map.json as text, for `perception info`; texts: those printed on each instance, by its id."""
    quality, training, scene = info.get("quality", {}), info.get("training", {}), info.get("scene", {})
    seconds, trained = info.get("seconds", {}), max(training.get("seconds", 0.0), 1e-9)
    lines = [
        f"{path}: {info['num_gaussians']} Gaussians (harmonics degree {info['sh_degree']}), "
        f"{info['num_instances']} instances, {'metres' if info.get('metric') else 'units of the reconstruction'}",
        f"made from {info.get('source')} (seed {info.get('seed')}) in {seconds.get('total', 0):.0f} s: "
        + ", ".join(f"{name} {value:.0f}" for name, value in seconds.items() if name != "total"),
        f"trained {training.get('iterations')} iterations ({training.get('pairs', 0) / trained / 1e6:.1f} M pairs/s); "
        f"peak memory {info.get('peak_memory_mib')} MiB",
    ]
    lines += frame_lines(info)
    if training.get("profile"):
        lines.append("of training: " + ", ".join(f"{name} {share:.0%}" for name, share in shares(training).items()))
    if None not in (psnr := quality.get("psnr"), similarity := quality.get("ssim")):
        count = len(quality.get("views", {}))
        lines.append(f"held-out views: PSNR {psnr:.2f} dB, SSIM {similarity:.4f} over {count}")
    if info.get("depth"):
        lines.append(
            f"depth images: {info['depth']['views']}, measured in {info['depth']['measured']:.0%} of their pixels"
        )
    if quality.get("depth"):
        lines.append(f"held-out views: {depth_text(quality['depth'])}")
    lines += [f"printed on {i}: " + ", ".join(f'"{e["text"]}"' for e in found) for i, found in (texts or {}).items()]
    lines += [f"decision: {text}" for text in training.get("decisions", [])]
    lines += [f"left out: {entry['name']} ({entry['why']})" for entry in scene.get("left_out", [])]
    lines += [f"warning: {text}" for text in scene.get("warnings", [])]
    return "\n".join(lines)


def frame_lines(info: dict[str, Any]) -> list[str]:
    """What is known of a map's frame, one line each: unit, gravity, place in the input's frame; info: map.json."""
    lines, scale, gravity = [], info.get("scale"), info.get("gravity")
    if scale:
        unit = "1" if info.get("metric") else f"{scale['metres_per_unit']:.4g}"
        error = "" if scale["standard_error"] is None else f" ± {scale['standard_error']:.2g} m"
        lines.append(f"scale: a unit is {unit} m{error}, by {scale['source']}")
    if gravity:
        down = ", ".join(f"{x:.3f}" for x in gravity["direction"])
        lines.append(f"gravity: down is {down} ± {gravity['standard_error_deg']:.1f}°, by {gravity['source']}")
    if "map_from_input" in info:
        origin = np.linalg.inv(info["map_from_input"])[:3, 3]
        lines.append(f"the map's origin lies at {origin.round(6).tolist()} of its input")
    return lines


def depth_text(errors: dict[str, Any]) -> str:
    """`depth_errors` as a phrase."""
    in_metres = errors["unit"] == "m"
    median, tolerance = ((f"{100 * errors[key]:.2g} {'cm' if in_metres else '%'}") for key in ("median", "tolerance"))
    return f"depth error {median} in the median, {errors['close']:.0%} within {tolerance}"


def query_text(answers: list[tuple[str, list[Hit]]], metric: bool | None) -> str:
    """Ranked hits of each prompt, one per line, or "not present"."""
    lines = []
    for text, hits in answers:
        if not hits:
            lines.append(f'"{text}": not present')
        for rank, hit in enumerate(hits, start=1):
            x, y, z = hit.centroid
            a, b, c = hit.obb.extent
            unit = " m" if (metric if hit.metric is None else hit.metric) else ""
            name = f" ({hit.label})" if hit.label else ""
            name += "" if hit.part is None else f", part {hit.part}"
            name += f", together {', '.join(map(str, hit.instances))}" if hit.instances else ""
            lines.append(
                f'"{text}" {rank}. instance {hit.instance_id}{name}  score {hit.score:.2f}'
                f"  at {x:.3f} {y:.3f} {z:.3f}{unit}"
                f"  size {a:.3f} x {b:.3f} x {c:.3f}{unit}  {hit.num_points} points"
                + ("" if hit.map is None else f"  in {hit.map}")
            )
    return "\n".join(lines)


def write_hits(path: Path, hits: list[Hit]) -> None:
    """Writes the points of all hits as one cloud, with `instance_id` and the colours of the map."""
    from perception.io.cloud import write_cloud
    from perception.types import PointCloud

    hits = list({(hit.instance_id, hit.part, hit.instances): hit for hit in hits}.values())
    points = np.concatenate([np.zeros((0, 3), np.float32), *(hit.points for hit in hits)])
    colors = np.concatenate([np.zeros((0, 3), np.uint8), *(hit.colors() for hit in hits if hit.colors is not None)])
    ids = np.repeat(np.array([hit.instance_id for hit in hits], np.int32), [len(hit.points) for hit in hits])
    write_cloud(path, PointCloud(points, colors, labels={"instance_id": ids}))
