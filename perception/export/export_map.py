"""`perception export`: transfers the instances of a map to a cloud, or to the map's own surface points. A scan from
another frame is aligned with the map by a known transform, or by registration.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.colors import instance_palette, rgb8_from_sh
from perception.errors import InputError
from perception.export.neighbors import nearest_gaussian, scattered
from perception.export.smooth import read_segments, segment_cloud, vote
from perception.export.spz import position_bits, write_spz
from perception.frame.recentre import map_from_input
from perception.geometry import check_similarity, move_points, scale_of, sums_by
from perception.io.atomic import write_file
from perception.io.cloud import left_out, read_cloud, write_cloud
from perception.io.documents import refusing
from perception.map.history import is_removed
from perception.map.write import Map, read_map
from perception.photos.view_json import frame_facts, refuse_other_frame
from perception.types import PointCloud

if TYPE_CHECKING:
    from perception.export.depth_views import DepthView

MOST_VIEWS, LONG_SIDE = 90, 320  # views rendered for a registration, and their size in pixels

SCANNET = Path("scannet")
BESIDE = 0.1  # distance in diagonals of a map up to which a scan beside its bounds may be of its outermost things
SPZ_ROUNDED = 2e-3  # rounding of positions in a .spz that is told, in map units
LONE = 0.25
"""Share of a thing's spread by which a point is too far from all others to be smoothed with them."""


@dataclass(frozen=True)
class ExportOptions:
    """How labels are transferred; the defaults are the paper's.

    max_distance: in map units, beyond which points stay unlabelled; None = no limit.
    smooth: superpoint vote, on or off. segments: a ScanNet *.segs.json to use instead of our own segmentation, or
    SCANNET for the one that ScanNet's segmentator makes of a mesh. InputError for a negative distance.

    >>> ExportOptions(max_distance=0.05, smooth=False)
    ExportOptions(max_distance=0.05, smooth=False, segments=None)
    """

    max_distance: float | None = None
    smooth: bool = True
    segments: Path | None = None

    def __post_init__(self) -> None:
        if self.max_distance is not None and not self.max_distance >= 0:
            raise InputError(f"max_distance is {self.max_distance}; expected a length that is not negative")


def rendered_depth(gmap: Map, most: int, long_side: int) -> list[DepthView]:
    """Depth from up to `most` of the map's views, evenly chosen, in the map's frame. InputError without views."""
    from perception.export.depth_views import depth_views
    from perception.export.render import map_views
    from perception.gaussians.model import as_gaussians

    views = map_views(gmap, held_out=False)
    if not views:
        raise InputError(f"{gmap.path}: holds no views, and depth is rendered from those; map again from photos")
    return depth_views(as_gaussians(gmap), views[:: -(-len(views) // most)], long_side)


def aligned(gmap: Map, scan: PointCloud, name: str) -> tuple[np.ndarray, dict[str, Any]]:
    """(map_from_scan [4, 4], facts); InputError naming the scan if refused.

    With a scale where the map's unit is not known to be the metre.
    """
    from perception.export.align import align

    found = align(rendered_depth(gmap, MOST_VIEWS, LONG_SIDE), scan, similar=not gmap.metric)
    if found.refusal is not None:
        raise InputError(f"{name}: cannot be aligned with the map: {found.refusal}; give --transform FILE")
    names = ("scale", "agreement", "overlap", "cover", "rms", "rival")
    return found.map_from_scan, {"verdict": "accepted", **{key: round(getattr(found, key), 6) for key in names}}


def read_transform(path: Path, gmap: Map) -> np.ndarray:
    """map_from_scan [4, 4] float64: four rows of four numbers as text or JSON, or a JSON object that holds them as
    `map_from_scan`, as `export` writes. InputError unless it is a rotation, a positive scale and a translation, and
    where `export` wrote it for another map, or the map has another unit since."""
    with refusing(f"{path}: expected a 4 × 4 matrix as text or JSON ({{why}})"):
        text = path.read_text(encoding="utf-8-sig")
        if text.lstrip()[:1] in ("[", "{"):
            rows = json.loads(text)
            if isinstance(rows, dict):
                of_map = rows.get("map_unit", {})
                refuse_other_frame(path, of_map, gmap.info, gmap.views, "align the scan again")
                rows = rows["map_from_scan"]
        else:
            lines = (line.replace(",", " ").split() for line in text.splitlines())
            rows = [[float(number) for number in line] for line in lines if line]
    return check_similarity(rows, str(path))


SUFFIXES = (".ply", ".pcd", ".npz", ".spz")
SURFACE_OPACITY = 0.5  # Gaussians of at least this opacity are the surface points of a map


def side_file(output: Path) -> Path:
    """The file that `export_map` writes beside `output`: ids of compressed Gaussians, or facts of the instances."""
    return output.with_suffix(".npy" if output.suffix.lower() == ".spz" else ".json")


def export_map(
    map_path: Path,
    output: Path,
    points: Path | None,
    options: ExportOptions,
    color: str = "original",
    pose: Path | bool = False,
    granularity: str = "default",
) -> tuple[dict[str, Any], str]:
    """Labels a cloud, writes it and its sidecar JSON, and returns (JSON-able facts, table).

    Without `points` the map's opaque Gaussians are the cloud and keep their own instance ids. `points` and the
    result are in the coordinates of the map's input (`map_from_input`). Without `points` they are the map's, or the
    input's if that was only shifted.

    color: of the written points, "original" or "instance". pose: `points` lie in a frame of their own: True registers
    them (`export.align`), a path names a file with map_from_scan [4, 4]. The result keeps that frame; the sidecar and
    the facts hold `map_from_scan` and `map_unit`. granularity: see `at_granularity`.

    InputError for a kind of file that is not written, and for a scan that does not overlap the map or is not aligned.

    >>> facts, table = export_map(Path("kitchen.gsmap"), Path("labelled.ply"), Path("scan.ply"), ExportOptions())
    >>> facts["points"], facts["labelled"], sorted(facts["instances"])[:3]
    (900, 900, ['0', '1', '2'])
    """
    if output.suffix.lower() == ".spz":
        return _export_spz(map_path, output, points)
    if output.suffix.lower() not in SUFFIXES:
        raise InputError(f"{output}: unknown kind of cloud '{output.suffix}', expected one of {', '.join(SUFFIXES)}")
    if pose and points is None:
        raise InputError("--align and --transform need a scan; give it with --points")
    gmap = Map.open(map_path)
    known = None if isinstance(pose, bool) else read_transform(pose, gmap)
    gmap.load()
    ids, instances = at_granularity(gmap, granularity)
    cloud = None if points is None else read_cloud(points)
    map_from_cloud = map_from_input(map_path, gmap.info)
    if points is None and not np.array_equal(map_from_cloud[:3, :3], np.eye(3)):
        map_from_cloud = np.eye(4)
    facts: dict[str, Any] = {}
    if known is not None:
        map_from_cloud = known
    elif pose and cloud is not None:
        map_from_cloud, facts["alignment"] = aligned(gmap, cloud, str(points))
    if pose:
        facts |= {"map_from_scan": map_from_cloud.tolist(), "map_unit": frame_facts(gmap.info, gmap.views)}
    moved = not np.array_equal(map_from_cloud, np.eye(4))
    means = move_points(np.linalg.inv(map_from_cloud), gmap.means.astype(np.float64)) if moved else gmap.means
    began = time.perf_counter()
    if cloud is None:
        rows, options = np.flatnonzero(gmap.opacities >= SURFACE_OPACITY), ExportOptions(smooth=False)
        if not len(rows):
            raise InputError(f"{map_path}: has no surface: none of its Gaussians has an opacity of {SURFACE_OPACITY}")
        cloud = PointCloud(means[rows], rgb8_from_sh(gmap.sh[rows, 0]))
        labels = ids[rows].astype(np.int32)
    else:
        limit = None if options.max_distance is None else options.max_distance / scale_of(map_from_cloud)
        labels = export_labels(means, ids, cloud, replace(options, max_distance=limit))
    inside = check_overlap(means, cloud.points)
    if color == "instance":
        cloud = replace(cloud, colors=instance_palette(labels))
    if others := left_out(output, cloud):
        facts["left_out"] = others
    sidecar = write_export(output, cloud, labels, instances, facts)  # last: where it is, everything was written
    result = {
        "points": len(labels),
        "labelled": int((labels >= 0).sum()),
        "inside_map": inside,
        "seconds": time.perf_counter() - began,
        "max_distance": options.max_distance,
        "metric": gmap.metric and abs(scale_of(map_from_cloud) - 1) < 1e-9,
        "smoothed": options.smooth,
        **sidecar,
    }
    return result, _table(result)


def _export_spz(map_path: Path, output: Path, points: Path | None) -> tuple[dict[str, Any], str]:
    """All Gaussians of the map, for viewers in the browser."""
    if points is not None:
        raise InputError(f"{output}: .spz holds the map's Gaussians; labels of a scan go to .ply, .pcd or .npz")
    gmap, ids = read_map(map_path), side_file(output)
    write_spz(output, gmap)
    size = output.stat().st_size
    share = size / max((map_path / "gaussians.ply").stat().st_size, 1)
    text = f"{output}: {len(gmap)} Gaussians, {share:.0%} of the PLY's size; instance ids in {ids}"
    if (rounded := 2.0 ** -(position_bits(gmap.means) + 1)) > SPZ_ROUNDED:
        far = f"a Gaussian is {np.abs(gmap.means).max():.3g} from the origin"
        text += f"\npositions are rounded by up to {rounded:.2g}, as {far}; a .ply holds them exactly"
    return {"spz": str(output), "gaussians": len(gmap), "bytes": size, "instance_ids": str(ids)}, text


def at_granularity(gmap: Map, granularity: str) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
    """Ids [N] int32, −1 = none, and the entry of each id: of "parts" (and instances, for what is in none), "default",
    or "groups", with the id of the first of their `instances`. InputError where the map has no such level."""
    entries = {entry["id"]: entry for entry in gmap.instances}
    if granularity == "default":
        return gmap.instance_ids, entries
    if granularity == "parts" and "ids" in gmap.parts:
        parts = {part["id"]: part for entry in gmap.instances for part in entry.get("parts", [])}
        return np.where(np.isin(gmap.parts["ids"], list(parts)), gmap.parts["ids"], gmap.instance_ids), entries | parts
    gone = [n for n, entry in zip(gmap.groups.get("of", ()), gmap.instances, strict=False) if is_removed(entry)]
    groups = np.where(np.isin(gmap.group_ids, gone), -1, gmap.group_ids)  # one that lost a member is none
    if granularity != "groups" or not (groups >= 0).any():
        why = "only built-in masks that were unsure make them (parts also: photos that disagree)"
        raise InputError(f"{gmap.path}: holds no {granularity} of instances; {why}; leave out --granularity")
    ids = gmap.instance_ids.copy()
    for group in np.unique(groups[groups >= 0]):
        members, score = np.unique(ids[groups == group]).tolist(), float(gmap.groups["scores"][group])
        ids[groups == group] = members[0]
        entries[members[0]] = {"label": None, "score": score, "instances": members}
    return ids, entries


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
    if "left_out" in result:
        lines.append(f"columns that the format cannot hold are left out: {', '.join(result['left_out'])}")
    if result["inside_map"] < 0.5:
        lines.append(f"only {result['inside_map']:.0%} of the points lie inside the map: same frame and unit?")
    return "\n".join(lines)


def typical_spread(means: np.ndarray, ids: np.ndarray) -> float:
    """Root mean square distance of the means [N, 3] of an instance, ids [N], from their centre, in the median."""
    number, count = np.unique(ids, return_inverse=True, return_counts=True)[1:]
    centers = sums_by(number, means, len(count)) / count[:, None]
    squared = ((means - centers[number]) ** 2).sum(axis=1)
    return float(np.median(np.sqrt(np.bincount(number, squared) / count)))


def export_labels(
    means: np.ndarray, instance_ids: np.ndarray, cloud: PointCloud, options: ExportOptions | None = None
) -> np.ndarray:
    """Instance of each point [P] int32, −1 = none: that of the nearest mean (OpenSplat3D, point cloud transfer).
    means [N, 3] in the cloud's frame, instance_ids [N] int32 (−1 = noise, ignored as in the released code). Lengths
    of the options are in the cloud's unit."""
    options = options or ExportOptions()
    limit = options.max_distance
    used = np.isfinite(means).all(axis=1) & (instance_ids >= 0)
    nearest = nearest_gaussian(cloud.points, means[used], max_distance=limit)
    labels = np.append(instance_ids[used], -1).astype(np.int32)[nearest]
    if not options.smooth or not (labels >= 0).any():
        return labels
    if options.segments in (None, SCANNET):
        segments = segment_cloud(cloud, scannet=options.segments is not None)
    else:
        segments = read_segments(options.segments, len(labels))
    inside = labels >= 0  # points beyond the map have no vote and stay unlabelled
    if options.segments is None and (cloud.faces is None or not len(cloud.faces)):
        inside &= ~scattered(cloud.points, LONE * typical_spread(means[used], instance_ids[used]))
    labels[inside] = vote(labels[inside], segments[inside])
    return labels


def check_overlap(means: np.ndarray, points: np.ndarray) -> float:
    """Share of the finite points inside the map's bounds (1st to 99th percentile of its means).
    InputError when they lie farther from the bounds than BESIDE: the cloud has another frame or unit."""
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        raise InputError(f"cloud: of its {len(points)} points none is finite; nothing can be labelled")
    means = means[np.isfinite(means).all(axis=1)]
    if len(means) == 0:
        raise InputError("map: holds no Gaussians; nothing can be labelled")
    low, high = np.percentile(means, [1, 99], axis=0)
    cloud_low, cloud_high = finite.min(axis=0), finite.max(axis=0)
    gap = np.maximum(np.maximum(low - cloud_high, cloud_low - high), 0)
    if np.linalg.norm(gap) > BESIDE * np.linalg.norm(high - low):
        boxes = f"cloud {_box(cloud_low, cloud_high)}, map {_box(low, high)}"
        found = f"does not overlap the map: it lies {np.linalg.norm(gap):.3g} units away ({boxes})"
        raise InputError(f"cloud: {found}; bring it into the map's frame")
    return float(((finite >= low) & (finite <= high)).all(axis=1).mean())


def _box(low: np.ndarray, high: np.ndarray) -> str:
    return " x ".join(f"{a:.3g}..{b:.3g}" for a, b in zip(low, high, strict=True))


def write_export(
    path: Path,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Mapping[int, Mapping[str, Any]],
    facts: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes the cloud with `instance_id` and its sidecar JSON (same stem), which names it; returns the sidecar.

    labels [P] int32, −1 = none. instances: {id: entry} of the map, of which "score" and "label" are written with
    "num_points"; of parts also their `parent`, of groups the `instances` in them, after several visits `state` and
    `last_seen`. facts: further keys of the sidecar.
    """
    rows = {}
    ids, counts = np.unique(labels[labels >= 0], return_counts=True)
    for i, n in zip(ids.tolist(), counts.tolist(), strict=True):
        known = instances.get(i, {})
        row = {"score": float(known.get("score", 1.0)), "label": known.get("label"), "num_points": n}
        rows[str(i)] = row | {key: known[key] for key in ("parent", "instances", "state", "last_seen") if key in known}
    sidecar = {"cloud": path.name, **(facts or {}), "instances": rows}
    write_file(path.with_suffix(".json"), json.dumps(sidecar, indent=1))
    labelled = {"instance_id": labels.astype(np.int32)}
    write_cloud(path, replace(cloud, labels=labelled | {n: v for n, v in cloud.labels.items() if n not in labelled}))
    return sidecar
