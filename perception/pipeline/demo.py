"""`perception demo`: maps the photos of a made scene that comes with the package, and scores the map with its truth."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from perception.config import load_config
from perception.evaluate.instances import evaluate
from perception.export.export_map import export_labels, write_export
from perception.geometry import align_similarity, camera_centres
from perception.language.encoders import make_encoder
from perception.map.outputs import check_empty
from perception.map.write import Map
from perception.pipeline.mapping import build_map
from perception.progress import Progress
from perception.query import QueryMap, load_map
from perception.report.page import map_picture, write_map_report
from perception.types import PointCloud

SCENE = Path(__file__).parents[1] / "demo_scene"  # 40 rendered photos of a table and their truth (tools/worlds/make.py)
SETTINGS = ["train.iterations=1300", "train.budget=40000"]  # for a small scene in under a minute on two cores


@dataclass(frozen=True)
class DemoTruth:
    """Ground truth of the scene, by which the map is scored, never built. Metres.

    prompts: of the demo. queries: every known prompt with the ids of what it means. instances: name of each id.
    centres: camera centre [3] of each photo. points: of the surfaces that two photos see, with normals and colours;
    instance_ids [P] int64: of each point.
    """

    prompts: list[str]
    queries: dict[str, list[int]]
    instances: dict[int, str]
    centres: dict[str, list[float]]
    points: PointCloud
    instance_ids: np.ndarray

    @classmethod
    def read(cls, folder: Path = SCENE) -> DemoTruth:
        """The truth beside the photos in `folder`."""
        facts = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        with np.load(folder / "truth.npz") as stored:
            points = PointCloud(stored["points"], stored["colors"], stored["normals"])
            ids = stored["instance_ids"].astype(np.int64)
        names = {int(number): name for number, name in facts["instances"].items()}
        return cls(facts["asked"], dict(facts["queries"]), names, facts["centres"], points, ids)


def run_demo(output: Path, progress: Progress, seed: int = 0) -> tuple[dict[str, Any], str]:
    """Photos → SfM → masks → map → export → queries, all in `output`; returns figures and a text.
    InputError, before any work, where the extra `demo` is not installed or `output` is not empty."""
    make_encoder("conse")
    check_empty(output)
    try:
        return _run(output, progress, seed)
    except BaseException:  # Ctrl-C among them: a new run wants an empty folder
        shutil.rmtree(output, ignore_errors=True)
        raise


def _run(output: Path, progress: Progress, seed: int) -> tuple[dict[str, Any], str]:
    started = time.monotonic()
    photos, map_path = output / "photos", output / "demo.gsmap"
    shutil.copytree(SCENE / "photos", photos)
    truth = DemoTruth.read()

    build_map(photos, map_path, load_config(None, [*SETTINGS, f"seed={seed}"]), progress=progress)
    gmap = load_map(map_path)

    cloud, scale = truth_in_map_frame(truth, gmap)
    labels = export_labels(gmap.means, gmap.instance_ids, cloud)
    write_export(output / "instances.ply", cloud, labels, {entry["id"]: entry for entry in gmap.instances})
    scored = evaluate(labels, {entry["id"]: entry["score"] for entry in gmap.instances}, truth.instance_ids)
    queries = [_ask(gmap, text, truth, labels) for text in truth.prompts]
    facts = {
        "map": str(map_path),
        "seconds": {"total": round(time.monotonic() - started, 1)},
        "registered": len(gmap.views),
        "photos": len(truth.centres),
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

    Image.fromarray(map_picture(gmap, truth.prompts[0])).save(output / "demo.jpg", quality=88)
    (output / "demo.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return facts, demo_text(facts)


def truth_in_map_frame(truth: DemoTruth, gmap: Map) -> tuple[PointCloud, float]:
    """The true surface points in the map's frame, and the number of map units per metre.

    SfM determines neither scale nor frame, so the true camera centres are aligned with the estimated ones.
    """
    mapped = camera_centres(gmap.poses)
    true = np.array([truth.centres[view.name] for view in gmap.views])
    scale, rotation, shift = align_similarity(mapped, true)
    assert truth.points.normals is not None  # in the file
    points = scale * truth.points.points.astype(np.float64) @ rotation.T + shift
    normals = (truth.points.normals.astype(np.float64) @ rotation.T).astype(np.float32)
    return PointCloud(points.astype(np.float32), truth.points.colors, normals), float(scale)


def _ask(gmap: QueryMap, text: str, truth: DemoTruth, labels: np.ndarray) -> dict[str, Any]:
    """A prompt, its answer, and whether it is correct: the true object of most points of the first hit is compared."""
    hit, true = next(iter(gmap.query(text, top_k=1)), None), None
    if hit is not None and (labels == hit.instance_id).any():
        true = int(np.bincount(truth.instance_ids[labels == hit.instance_id]).argmax())
    ids = truth.queries.get(text, [])
    return {
        "text": text,
        "present": hit is not None,
        "instance_id": None if hit is None else hit.instance_id,
        "score": None if hit is None else hit.score,
        "found": None if true is None else truth.instances.get(true),
        "right": true in ids if ids else hit is None,
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
