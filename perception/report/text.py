"""Output of `perception map`, `info` and `query`: JSON, text, and the points of query hits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception.map.checksums import IGNORED
from perception.query import Hit, QueryMap


def map_facts(path: Path | str, info: dict[str, Any]) -> dict[str, Any]:
    """The JSON output of `perception map`; info: content of map.json."""
    training = info["training"]
    return {
        "map": str(path),
        "gaussians": info["num_gaussians"],
        "instances": info["num_instances"],
        **{key: info[key] for key in ("quality", "seconds", "peak_memory_mib", "scene")},
        **{key: training[key] for key in ("iterations", "decisions")},
        "profile": shares(training),
    }


def shares(training: dict[str, Any]) -> dict[str, float]:
    """Share of the training time of each part, largest first; "other" is the unattributed rest."""
    total, parts = max(training.get("seconds", 0.0), 1e-9), training.get("profile", {})
    parts = {**parts, "other": max(0.0, total - sum(parts.values()))}
    return {name: round(seconds / total, 4) for name, seconds in sorted(parts.items(), key=lambda part: -part[1])}


SHARP, BLURRED = 25.0, 20.0
"""Held-out PSNR in dB from which a map is called sharp, and below which poor."""


def info_text(path: Path, info: dict[str, Any], texts: dict[int, list[dict[str, Any]]] | None = None) -> str:
    """Summary of map.json as text, for `perception info`: what the map is, how good it is, what to do next, then its
    details. texts: those printed on each instance, by its id."""
    quality, training, scene = info.get("quality", {}), info.get("training", {}), info.get("scene", {})
    seconds, trained = info.get("seconds", {}), max(training.get("seconds", 0.0), 1e-9)
    left_out = [f"left out: {entry['name']} ({entry['why']})" for entry in scene.get("left_out", [])]
    warnings = [f"warning: {text}" for text in scene.get("warnings", [])]
    unit = "in metres" if info.get("metric") else "without a metric scale"
    lines = [
        f"{path}: {info['num_instances']} instances in {info['num_gaussians']:,} Gaussians, "
        f"from {len(info.get('views', []))} photos, {unit}",
        _verdict(quality, len(left_out), len(warnings)),
        "next: " + _next_step(path, info),
        f"made from {info.get('source')} (seed {info.get('seed')}) in {seconds.get('total', 0):.0f} s: "
        + ", ".join(f"{name} {value:.0f}" for name, value in seconds.items() if name != "total"),
        f"trained {training.get('iterations')} iterations ({training.get('pairs', 0) / trained / 1e6:.1f} M pairs/s), "
        f"harmonics of degree {info['sh_degree']}; peak memory {info.get('peak_memory_mib')} MiB",
    ]
    lines += frame_lines(info)
    if still := scene.get("still"):
        what = f"{still['share']:.1%} of the pixels of {still['photos']} photos"
        lines.append(f"ignored, as it stays in the picture while the camera moves: {what} ({path / IGNORED})")
    if training.get("profile"):
        lines.append("of training: " + ", ".join(f"{name} {share:.0%}" for name, share in shares(training).items()))
    if depth := info.get("depth"):
        lines.append(f"depth images: {depth['views']}, measured in {depth['measured']:.0%} of their pixels")
    lines += [f"printed on {i}: " + ", ".join(f'"{e["text"]}"' for e in read) for i, read in (texts or {}).items()]
    lines += [f"decision: {text}" for text in training.get("decisions", [])]
    return "\n".join([*lines, *left_out, *warnings])


def _verdict(quality: dict[str, Any], left_out: int, warnings: int) -> str:
    """The quality of the map in one line."""
    if quality.get("psnr") is None:
        parts = ["not measured, as no photo was held out"]
    else:
        psnr = quality["psnr"]
        grade = "sharp" if psnr >= SHARP else "blurred in places" if psnr >= BLURRED else "poor"
        parts = [f"{grade}: PSNR {psnr:.2f} dB, SSIM {quality['ssim']:.3f}, held-out photos: {len(quality['views'])}"]
    if quality.get("depth"):
        parts.append(depth_text(quality["depth"]))
    parts += [f"{what}: {count}" for what, count in (("photos left out", left_out), ("warnings", warnings)) if count]
    return "quality: " + ", ".join(parts)


def _next_step(path: Path, info: dict[str, Any]) -> str:
    """The command that helps most."""
    if not info["num_instances"]:
        return "no instance was found; give masks (perception map --masks) or more photos"
    if not info.get("metric"):
        return f'perception scale {path} --known-length "METRES: ID, ID" for metres; perception query {path} "mug"'
    return f'perception query {path} "mug", or perception view {path}'


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


def depth_figures(errors: dict[str, Any]) -> tuple[str, str, str]:
    """Of `depth_errors`: the median error, the share of pixels within the tolerance, and the tolerance."""
    unit = "cm" if errors["unit"] == "m" else "%"
    return f"{100 * errors['median']:.2g} {unit}", f"{errors['close']:.0%}", f"{100 * errors['tolerance']:.2g} {unit}"


def depth_text(errors: dict[str, Any]) -> str:
    """`depth_errors` as a phrase."""
    median, share, tolerance = depth_figures(errors)
    return f"depth error {median} in the median, {share} within {tolerance}"


def query_text(
    answers: list[tuple[str, list[Hit]]], metric: bool | None, guessed: Mapping[int, str] | None = None
) -> str:
    """Ranked hits of each prompt in aligned columns, or "not present". metric: whether positions are in metres.
    guessed: instance id -> likely name, for instances that nobody has named."""
    lines = []
    for text, hits in answers:
        lines.append(f'"{text}": {f"{len(hits)} found" if hits else "not present"}')
        rows = [_hit_row(rank, hit, metric, guessed or {}) for rank, hit in enumerate(hits, start=1)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines += ["  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    return "\n".join(lines)


def guessed_names(opened: QueryMap) -> dict[int, str]:
    """Instance id -> likeliest name; empty without an encoder."""
    if opened.problem is not None:
        return {}
    pairs = zip(opened.instances, opened.likely_names(1), strict=True)
    return {int(entry["id"]): names[0] for entry, names in pairs if names}


def _hit_row(rank: int, hit: Hit, metric: bool | None, guessed: Mapping[int, str]) -> list[str]:
    """Rank, name, score, position, size and id of a hit, as the cells of a row."""
    in_metres = metric if hit.metric is None else hit.metric
    name = hit.label or (f"{guessed[hit.instance_id]} (guessed)" if hit.instance_id in guessed else "no name")
    x, y, z = hit.centroid
    scale, unit, length = (100.0, " cm", " m") if in_metres else (1.0, "", "")
    sides = " x ".join(f"{scale * side:.{0 if in_metres else 3}f}" for side in hit.obb.extent)
    ident = f"instance {hit.instance_id}"
    ident += "" if hit.part is None else f", part {hit.part}"
    ident += f", together {', '.join(map(str, hit.instances))}" if hit.instances else ""
    ident += "" if hit.map is None else f" in {hit.map}"
    position = f"at {x:.2f} {y:.2f} {z:.2f}{length}" if in_metres else f"at {x:.3f} {y:.3f} {z:.3f}"
    return [f"{rank}.", name, f"score {hit.score:.2f}", position, f"size {sides}{unit}", ident]


def write_hits(path: Path, hits: list[Hit]) -> None:
    """Writes the points of all hits as one cloud, with `instance_id` and the colours of the map."""
    from perception.io.cloud import write_cloud
    from perception.types import PointCloud

    hits = list({(hit.instance_id, hit.part, hit.instances): hit for hit in hits}.values())
    points = np.concatenate([np.zeros((0, 3), np.float32), *(hit.points for hit in hits)])
    colors = np.concatenate([np.zeros((0, 3), np.uint8), *(hit.colors() for hit in hits if hit.colors is not None)])
    ids = np.repeat(np.array([hit.instance_id for hit in hits], np.int32), [len(hit.points) for hit in hits])
    write_cloud(path, PointCloud(points, colors, labels={"instance_id": ids}))
