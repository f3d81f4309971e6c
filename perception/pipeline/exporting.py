"""`perception export`: transfers the instances of a map to a cloud, or to the map's own surface points."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.colors import instance_palette, rgb8_from_sh
from perception.errors import InputError
from perception.export.formats import write_export, write_scannet
from perception.export.transfer import ExportOptions, check_overlap, export_labels, resolved
from perception.geometry import move_points, scale_of
from perception.io.cloud import read_cloud
from perception.io.recentre import map_from_input
from perception.io.store import Map, read_map
from perception.pipeline.placing import aligned, read_transform
from perception.types import PointCloud

SUFFIXES = (".ply", ".pcd", ".npz")
SURFACE_OPACITY = 0.5
"""Gaussians of at least this opacity are the surface points of a map."""


def export_map(
    map_path: Path,
    output: Path,
    points: Path | None,
    options: ExportOptions,
    color: str = "original",
    scannet: Path | None = None,
    place: Path | bool = False,
    granularity: str = "default",
) -> tuple[dict[str, Any], str]:
    """Labels a cloud, writes it and its sidecar JSON, and returns (JSON-able facts, table).

    Without `points` the map's opaque Gaussians are the cloud and keep their own instance ids. `points` and the
    result are in the coordinates of the map's input (`map_from_input`). Without `points` they are the map's, or the
    input's if that was only shifted.

    color: of the written points, "original" or "instance". scannet: folder of a submission, too (scene = the output's
    stem). place: `points` lie in a frame of their own: True registers them (`export.align`), a path names a file with
    map_from_scan [4, 4]. The result keeps that frame; the sidecar and the facts hold `map_from_scan`. granularity: see
    `at_granularity`.
    """
    if output.suffix.lower() not in SUFFIXES:
        raise InputError(f"{output}: unknown kind of cloud '{output.suffix}', expected one of {', '.join(SUFFIXES)}")
    if color not in ("original", "instance"):
        raise InputError(f"color is '{color}'; expected original or instance")
    if place and points is None:
        raise InputError("--align and --transform place a scan in the map; give it with --points")
    known = None if isinstance(place, bool) else read_transform(place)
    gmap = read_map(map_path)
    ids, instances = at_granularity(gmap, granularity)
    given = None if points is None else read_cloud(points)
    placed = map_from_input(map_path, gmap.info)
    if points is None and not np.array_equal(placed[:3, :3], np.eye(3)):
        placed = np.eye(4)
    facts: dict[str, Any] = {}
    if known is not None:
        placed = known
    elif place and given is not None:
        placed, facts["alignment"] = aligned(gmap, given, str(points))
    if place:
        facts["map_from_scan"] = placed.tolist()
    moved = not np.array_equal(placed, np.eye(4))
    means = move_points(np.linalg.inv(placed), gmap.means.astype(np.float64)) if moved else gmap.means
    began = time.perf_counter()
    if given is None:  # every point is its own nearest Gaussian
        cloud, options = surface_points(gmap, means), ExportOptions(drop_noise=False, smooth=False)
    else:
        cloud, options = given, resolved(options, means, ids)
    inside = check_overlap(means, cloud.points)
    labels = export_labels(means, ids, cloud, options)
    if color == "instance":
        cloud = replace(cloud, colors=instance_palette(labels))
    if scannet is not None:
        write_scannet(scannet, output.stem, labels, instances)
    sidecar = write_export(output, cloud, labels, instances, facts)  # last: where it is, everything was written
    result = {
        "points": len(labels),
        "labelled": int((labels >= 0).sum()),
        "inside_map": inside,
        "seconds": time.perf_counter() - began,
        "max_distance": options.max_distance,
        "metric": gmap.metric and abs(scale_of(placed) - 1) < 1e-9,
        "smoothed": options.smooth,
        **sidecar,
    }
    return result, _table(result)


def at_granularity(gmap: Map, granularity: str) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
    """Ids [N] int32, −1 = none, and the entry of each id: of "parts" (and instances, for what is in none), "default",
    or "groups", with the id of the first of their `instances`. InputError where the map has no such level."""
    entries = {entry["id"]: entry for entry in gmap.instances}
    if granularity == "default":
        return gmap.instance_ids, entries
    if granularity == "parts" and "ids" in gmap.parts:
        parts = {part["id"]: part for entry in gmap.instances for part in entry.get("parts", [])}
        return np.where(np.isin(gmap.parts["ids"], list(parts)), gmap.parts["ids"], gmap.instance_ids), entries | parts
    groups = gmap.group_ids
    if granularity != "groups" or not (groups >= 0).any():
        why = "only built-in masks that were unsure make them (parts also: photos that disagree)"
        raise InputError(f"{gmap.path}: holds no {granularity} of instances; {why}; leave out --granularity")
    ids = gmap.instance_ids.copy()
    for group, score in enumerate(gmap.groups["scores"].tolist()):
        members = np.unique(ids[groups == group]).tolist()
        ids[groups == group] = members[0]
        entries[members[0]] = {"label": None, "score": score, "instances": members}
    return ids, entries


def surface_points(gmap: Map, means: np.ndarray | None = None) -> PointCloud:
    """The means of opaque Gaussians with their colours; means [N, 3] replaces those of the map."""
    rows = np.flatnonzero(gmap.opacities >= SURFACE_OPACITY)
    return PointCloud((gmap.means if means is None else means)[rows], rgb8_from_sh(gmap.sh[rows, 0]))


def _table(result: dict[str, Any]) -> str:
    lines = [f"{'id':>6}{'points':>12}{'score':>8}  label"]
    rows = sorted(result["instances"].items(), key=lambda row: -row[1]["num_points"])
    lines += [f"{i:>6}{r['num_points']:>12}{r['score']:>8.3f}  {r['label'] or ''}" for i, r in rows]
    unit = "metres" if result["metric"] else "units of the reconstruction"
    lines.append(f"{result['labelled']} of {result['points']} points labelled, in {unit}, {result['seconds']:.1f} s")
    if "alignment" in result:
        lines.append("aligned: " + ", ".join(f"{key} {value}" for key, value in result["alignment"].items()))
    if result["max_distance"] is not None:
        lines.append(f"points farther than {result['max_distance']:.4g} from every Gaussian are -1")
    if result["inside_map"] < 0.5:
        lines.append(f"only {result['inside_map']:.0%} of the points lie inside the map: same frame and unit?")
    return "\n".join(lines)
