"""ScanNet++ instance segmentation of mesh vertices, from the downloaded folder to the table:
`perception bench scannetpp DIR -o WORK`.

DIR (or DIR/data)/<scene>: dslr/resized_images, dslr/colmap (in the mesh's frame), dslr/train_test_lists.json,
scans/mesh_aligned_0.05.ply, segments.json, segments_anno.json and, where there, mesh_aligned_0.05_mask.txt (vertices
to be ignored); DIR/metadata/semantic_benchmark/top100.txt and top100_instance.txt: classes; DIR/splits/<split>.txt.
Every scene is mapped, the mesh's vertices are labelled, and a submission in ScanNet's layout is scored against the
truth; what is finished is kept in WORK, so that a second run goes on. A scene that fails scores 0.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.datasets import (
    Workplace,
    add_arguments,
    chosen_scenes,
    link,
    report,
    run_scenes,
    workplace,
)
from perception.errors import InputError
from perception.evaluate.layouts import run_scannet
from perception.export import ExportOptions, export_labels
from perception.export.formats import write_scannet
from perception.io.atomic import atomic_file
from perception.io.cloud import read_cloud

MESH = "mesh_aligned_0.05"
IGNORED = -2
"""Truth id of vertices that the mask file lists."""


@dataclass(frozen=True)
class Classes:
    """names: all classes in order; class id = index + 1. instance: the classes evaluated as instances."""

    names: list[str]
    instance: set[str]
    source: str


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line entry point; see the module docstring."""
    parser = argparse.ArgumentParser(prog="perception bench scannetpp", description=__doc__)
    add_arguments(parser)
    parser.add_argument("--protocol", default="scannetpp", choices=("scannet", "mask3d", "segment3d", "scannetpp"))
    parser.add_argument("--split", default="nvs_sem_val", help="DIR/splits/SPLIT.txt, where there")
    parser.add_argument(
        "--truth",
        default="instance-classes",
        choices=("instance-classes", "all"),
        help="objects of the 84 instance classes (OpenSplat3D), or all annotations, walls and floors too (Segment3D)",
    )
    parser.add_argument("--smooth", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--max-distance", type=float, metavar="D")
    parser.add_argument("--train-on-test", action=argparse.BooleanOptionalAction, default=True)
    args = parser.parse_args(arguments)
    found = {path.parent.parent.name: path.parent.parent for path in _meshes(args.dataset)}
    if not found:
        raise InputError(f"{args.dataset}: holds no scenes; expected data/<scene>/scans/{MESH}.ply")
    listed = args.dataset / "splits" / f"{args.split}.txt"
    wanted = args.scenes
    if wanted is None and listed.is_file():
        wanted = listed.read_text(encoding="utf-8").split()
    scenes = chosen_scenes(found, wanted, args.dataset)
    place = workplace(args)
    options = ExportOptions(smooth=args.smooth, max_distance=args.max_distance)

    def predict(name: str, scene: Path, target: Path) -> None:
        predict_scene(place, name, scene, target, options, args.train_on_test)

    failed = run_scenes(scenes, place, predict)
    truth = args.output / "truth" / args.truth
    classes = read_classes(args.dataset, scenes)
    for name, scene in scenes.items():
        with atomic_file(truth / f"{name}.txt") as aside:
            np.savetxt(aside, vertex_truth(scene, classes, args.truth == "all"), fmt="%d")
    for stale in set(truth.glob("*.txt")) - {truth / f"{name}.txt" for name in scenes}:
        stale.unlink()
    submission = _gathered(args.output, scenes)
    result, table = run_scannet(submission, truth, args.protocol)
    result["protocol"] |= {
        "truth": "all annotated objects" if args.truth == "all" else "objects of the instance classes",
        "classes": classes.source,
        "several_annotations": "the smallest object holds a vertex",
        "smoothing": "Felzenszwalb-Huttenlocher on the mesh" if args.smooth else "off",
        "max_distance": args.max_distance,
        "test_photos": "trained on" if args.train_on_test else "held out",
    }
    extra = ("truth", "classes", "smoothing", "max_distance", "test_photos")
    table += "\n" + "; ".join(f"{key}: {result['protocol'][key]}" for key in extra)
    report("scannetpp", args, result, table, failed, scenes)


def _meshes(dataset: Path) -> list[Path]:
    for pattern in ("data/*/scans", "*/scans", "scans"):
        found = sorted(path / f"{MESH}.ply" for path in dataset.resolve().glob(pattern))
        if any(path.is_file() for path in found):
            return [path for path in found if path.is_file()]
    return []


def _gathered(work: Path, scenes: dict[str, Path]) -> Path:
    """All scenes' submissions in one folder, the layout that run_scannet reads."""
    folder = work / "submission"
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.txt"):
        old.unlink()
    for name in scenes:
        part = work / "predictions" / name
        if part.is_dir():
            link(part / f"{name}.txt", folder / f"{name}.txt")
            for mask in (part / "predicted_masks").glob("*.txt"):
                link(mask, folder / "predicted_masks" / mask.name)
    return folder


def predict_scene(
    place: Workplace, name: str, scene: Path, target: Path, options: ExportOptions, train_on_test: bool
) -> None:
    """Maps a scene from its DSLR photos and writes the labelled vertices as a submission into `target`."""
    source = place.work / "inputs" / name
    for part, called in (("resized_images", "images"), ("colmap", "sparse")):
        if not (scene / "dslr" / part).is_dir():
            raise InputError(f"{scene / 'dslr' / part}: no such folder; download the scene's DSLR photos and poses")
        link(scene / "dslr" / part, source / called)
    gmap = place.map(name, source, [] if train_on_test else _test_photos(scene))
    mesh = read_cloud(scene / "scans" / f"{MESH}.ply")
    labels = export_labels(gmap.means, gmap.instance_ids, mesh, options)
    write_scannet(target, name, labels, {entry["id"]: entry for entry in gmap.instances})


def _test_photos(scene: Path) -> list[str]:
    path = scene / "dslr" / "train_test_lists.json"
    return [str(name) for name in _json(path).get("test", [])]


def vertex_truth(scene: Path, classes: Classes, all_objects: bool) -> np.ndarray:
    """Truth id [V] of the mesh vertices: 1000 · class + index of the object in the class, 0 = void, −2 = ignored.

    Where annotations overlap the smallest object takes the vertex, as in ScanNet++'s reference preparation.
    """
    scans = scene / "scans"
    segments = np.asarray(_json(scans / "segments.json")["segIndices"], np.int64)
    truth = np.zeros(len(segments), np.int64)
    held = np.full(len(segments), np.iinfo(np.int64).max)
    counts = dict.fromkeys(classes.names, 0)
    for group in _json(scans / "segments_anno.json")["segGroups"]:
        label = group["label"]
        if label not in counts:
            continue
        inside = np.isin(segments, np.asarray(group["segments"], np.int64))
        inside &= inside.sum() < held
        held[inside] = inside.sum()
        counts[label] += 1
        counted = all_objects or label in classes.instance
        truth[inside] = 1000 * (classes.names.index(label) + 1) + counts[label] if counted else 0
    mask = scans / f"{MESH}_mask.txt"
    if mask.is_file():
        truth[np.array(mask.read_text(encoding="ascii").split(), np.int64)] = IGNORED
    return truth


def read_classes(dataset: Path, scenes: dict[str, Path]) -> Classes:
    """The benchmark's classes, or all labels that occur when the metadata folder is absent."""
    folder = dataset / "metadata" / "semantic_benchmark"
    names, instance = folder / "top100.txt", folder / "top100_instance.txt"
    if names.is_file() and instance.is_file():
        lists = [path.read_text(encoding="utf-8").splitlines() for path in (names, instance)]
        return Classes(lists[0], set(lists[1]), f"{len(lists[1])} instance classes of {len(lists[0])}")
    annotations = [_json(scene / "scans" / "segments_anno.json")["segGroups"] for scene in scenes.values()]
    found = sorted({group["label"] for groups in annotations for group in groups})
    stuff = {"wall", "floor", "ceiling"}
    return Classes(found, set(found) - stuff, f"{len(found)} labels that occur (no metadata/), stuff {sorted(stuff)}")


def _json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); download the scene's annotations") from error
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object")
    return data
