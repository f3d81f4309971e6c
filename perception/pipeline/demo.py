"""`perception demo`: renders photos of a synthetic scene, maps them, and evaluates the map with exact ground truth."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from perception.config import MapConfig, load_config
from perception.demo import DemoTruth, make_photos
from perception.errors import InputError
from perception.evaluate.instances import evaluate
from perception.export.transfer import export_labels, write_export
from perception.geometry import align_similarity, camera_centres
from perception.io.store import Map
from perception.pipeline.mapping import build_map
from perception.pipeline.reporting import map_picture, write_map_report
from perception.progress import Progress
from perception.query import QueryMap, load_map
from perception.types import PointCloud

SETTINGS = ["train.iterations=1300", "train.budget=40000"]
"""Settings of the demo, for a small scene in about a minute on two cores."""


def write_scene(folder: Path, scene: str, seed: int) -> tuple[dict[str, Any], str]:
    """Writes photos of a synthetic scene to `folder`/images, with poses and truth; returns figures and a text."""
    _require_empty(folder)
    truth = make_photos(folder / "images", scene=scene, seed=seed, truth_folder=folder)
    facts = {"scene": str(folder), "photos": len(truth.names), "instances": len(truth.instances)}
    facts |= {"prompts": len(truth.queries), "points": len(truth.points)}
    return facts, "{photos} photos, {instances} instances, {prompts} prompts in {scene}".format(**facts)


def _require_empty(folder: Path) -> None:
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty; choose another folder or remove it first")


def run_demo(
    output: Path, progress: Progress | None = None, scene: str = "tabletop", seed: int = 0
) -> tuple[dict[str, Any], str]:
    """Photos → SfM → masks → map → export → queries, all in `output`; returns figures and a text."""
    progress = progress or Progress()
    started = time.monotonic()
    _require_empty(output)
    photos, map_path = output / "photos", output / "demo.gsmap"
    progress.log(f"making photos of a {scene} in {photos}")
    truth = make_photos(photos, scene=scene, seed=seed)
    made = time.monotonic() - started

    config: MapConfig = load_config(None, SETTINGS)
    build_map(photos, map_path, config, progress=progress)
    gmap = load_map(map_path)

    cloud, scale = truth_in_map_frame(truth, gmap)
    labels = export_labels(gmap.means, gmap.instance_ids, cloud)
    write_export(output / "instances.ply", cloud, labels, {entry["id"]: entry for entry in gmap.instances})
    scored = evaluate(
        labels, {entry["id"]: entry["score"] for entry in gmap.instances}, truth.instance_ids.astype(np.int64)
    )
    answers = dict(truth.queries)
    queries = [_ask(gmap, text, answers.get(text, []), truth, labels) for text in truth.asked]
    facts = {
        "map": str(map_path),
        "seconds": {"photos": round(made, 1), "total": round(time.monotonic() - started, 1)},
        "registered": len(gmap.views),
        "photos": len(truth.names),
        "gaussians": len(gmap),
        "instances": len(gmap.instances),
        "true_instances": len(truth.instances),
        "quality": {name: value for name, value in gmap.info["quality"].items() if name != "views"},
        "ap": {name: scored[name] for name in ("ap", "ap50", "ap25")},
        "queries": queries,
        "units_per_metre": scale,
        "peak_memory_mib": gmap.info["peak_memory_mib"],
    }
    facts["report"] = str(write_map_report(gmap, output / "report.html", [query["text"] for query in queries]))
    from PIL import Image

    Image.fromarray(map_picture(gmap, truth.asked[0])).save(output / "demo.jpg", quality=88)
    (output / "demo.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return facts, demo_text(facts)


def truth_in_map_frame(truth: DemoTruth, gmap: Map) -> tuple[PointCloud, float]:
    """The true surface points in the map's frame, and the number of map units per metre.

    SfM determines neither scale nor frame, so the true camera centres are aligned with the estimated ones.
    """
    by_name = dict(zip(truth.names, truth.cameras, strict=True))
    mapped = camera_centres(gmap.poses)
    true = np.stack([by_name[view.name].center for view in gmap.views])
    scale, rotation, shift = align_similarity(mapped, true)
    points = scale * truth.points.astype(np.float64) @ rotation.T + shift
    normals = (truth.normals.astype(np.float64) @ rotation.T).astype(np.float32)
    return PointCloud(points.astype(np.float32), truth.colors, normals), float(scale)


def _ask(gmap: QueryMap, text: str, ids: list[int], truth: DemoTruth, labels: np.ndarray) -> dict[str, Any]:
    """A prompt, its answer, and whether it is correct: the true object of most points of the first hit is compared."""
    hits = gmap.query(text, top_k=1)
    found = None
    if hits:
        under = truth.instance_ids[labels == hits[0].instance_id]
        if len(under):
            found = int(np.bincount(under).argmax())
    names = {instance.id: instance.name for instance in truth.instances}
    return {
        "text": text,
        "present": bool(hits),
        "instance_id": hits[0].instance_id if hits else None,
        "score": hits[0].score if hits else None,
        "found": names.get(found) if found is not None else None,
        "right": (found in ids) if ids else not hits,
    }


def demo_text(facts: dict[str, Any]) -> str:
    """The results of the demo and the ground truth as text."""
    ap, quality, seconds = facts["ap"], facts["quality"], facts["seconds"]
    lines = [
        "",
        f"{facts['registered']} of {facts['photos']} photos registered; {facts['gaussians']} Gaussians; "
        f"{facts['instances']} instances found, {facts['true_instances']} are there",
        f"held-out PSNR {quality.get('psnr', float('nan')):.2f} dB; instance AP {ap['ap']:.2f}, AP50 {ap['ap50']:.2f}, "
        f"AP25 {ap['ap25']:.2f} against the truth",
    ]
    for query in facts["queries"]:
        if query["present"]:
            answer = f"instance {query['instance_id']} (score {query['score']:.2f}), which is the {query['found']}"
        else:
            answer = "not present"
        lines.append(f'"{query["text"]}": {answer}: {"right" if query["right"] else "wrong"}')
    lines.append(f"{seconds['total']:.0f} s, peak {facts['peak_memory_mib']:.0f} MiB; open {facts['report']}")
    return "\n".join(lines)
