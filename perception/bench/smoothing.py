"""What labels of a cloud are worth, with and without smoothing, by graph and by rule: `bench smoothing CLOUD [MAP]`.

CLOUD carries the truth (`instance_id`). With a MAP in the cloud's frame its instances are put onto the cloud by the
nearest mean and by the densest instance, raw and smoothed; without one, made-up Gaussians stand for a map: --gaussians
of the cloud's points moved by --noise units, --wrong of them with another's instance. Class-agnostic AP, protocol
`scannet`; confidences are the map's.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.evaluate.instances import evaluate
from perception.export.labels import ExportOptions, check_overlap, export_labels
from perception.export.smooth import SmoothOptions
from perception.io.cloud import read_cloud
from perception.types import PointCloud


def main(argv: Sequence[str] | None = None) -> None:
    """Prints a table, or one JSON object with --json."""
    parser = argparse.ArgumentParser(prog="perception bench smoothing", description=__doc__)
    parser.add_argument("cloud", type=Path, metavar="CLOUD")
    parser.add_argument("map", type=Path, nargs="?", metavar="MAP")
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--wrong", type=float, default=0.15)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    cloud = read_cloud(args.cloud)
    if "instance_id" not in cloud.labels:
        raise InputError(f"{args.cloud}: has no property instance_id; give a cloud with the truth")
    gaussians, scores = _from_map(args.map) if args.map else _made_up(cloud, args)
    check_overlap(gaussians["means"], cloud.points)
    rows = []
    for name, options, used in variants(cloud, args.map is not None):
        began = time.process_time()
        labels = export_labels(cloud=used, options=options, **gaussians)
        row = {"variant": name, "cpu_seconds": time.process_time() - began}
        result = evaluate(labels, scores, cloud.labels["instance_id"].astype(np.int64))
        rows.append(row | {key: result[key] for key in ("ap", "ap50", "ap25")})
    if args.json:
        arguments = {key: str(value) for key, value in vars(args).items()}
        print(json.dumps({"arguments": arguments, "points": len(cloud.points), "rows": rows}))
        return
    print(f"{len(cloud.points)} points, {len(gaussians['means'])} Gaussians")
    print(f"{'':52}{'AP':>8}{'AP50':>8}{'AP25':>8}{'CPU s':>8}")
    for row in rows:
        print(
            f"{row['variant']:52}" + "".join(f"{row[k]:>8.4f}" for k in ("ap", "ap50", "ap25")),
            f"{row['cpu_seconds']:>7.2f}",
        )


def variants(cloud: PointCloud, with_shapes: bool) -> Iterator[tuple[str, ExportOptions, PointCloud]]:
    """(name, options, the cloud as given or less its normals and colours) of every row."""
    bare = PointCloud(cloud.points)
    colored = PointCloud(cloud.points, cloud.colors)
    graphs = ["knn", "radius"] + (["mesh"] if cloud.faces is not None and len(cloud.faces) else [])
    for rule in ("nearest", "densest") if with_shapes else ("nearest",):
        base = ExportOptions(rule=rule, smooth=False)
        yield f"{rule}, not smoothed", base, cloud
        for graph in graphs:
            options = replace(base, smooth=True, smoothing=SmoothOptions(graph=graph))
            parts = [("", cloud)]
            if rule == "nearest" and graph != "mesh":
                parts += [(", normals estimated", colored), (", neither normals nor colours", bare)]
            for note, used in parts:
                yield f"{rule}, {graph} graph{note}", options, used


def _from_map(path: Path) -> tuple[dict[str, Any], dict[int, float]]:
    from perception.io.store import read_map

    gmap = read_map(path)
    names = ("means", "instance_ids", "opacities", "quats", "scales")
    return {n: getattr(gmap, n) for n in names}, {entry["id"]: entry["score"] for entry in gmap.instances}


def _made_up(cloud: PointCloud, args: argparse.Namespace) -> tuple[dict[str, Any], dict[int, float] | None]:
    rng = np.random.default_rng(0)
    truth = cloud.labels["instance_id"]
    chosen = rng.choice(len(truth), min(args.gaussians, len(truth)), replace=False)
    means = cloud.points[chosen] + rng.normal(0, args.noise, (len(chosen), 3))
    ids = truth[chosen].copy()
    wrong = rng.random(len(ids)) < args.wrong
    ids[wrong] = rng.choice(ids, int(wrong.sum()))
    return {"means": means, "instance_ids": ids, "opacities": None}, None
