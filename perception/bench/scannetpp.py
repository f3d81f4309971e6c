"""ScanNet++ instance segmentation of mesh vertices: `perception bench scannetpp DIR -o WORK`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.datasets import DatasetBench, link
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


class ScanNetPP(DatasetBench):
    """DIR (or DIR/data)/<scene>: dslr/resized_images, dslr/colmap (in the mesh's frame), dslr/train_test_lists.json,
    scans/mesh_aligned_0.05.ply, segments.json, segments_anno.json and, where there, mesh_aligned_0.05_mask.txt
    (vertices to be ignored); DIR/metadata/semantic_benchmark/top100.txt and top100_instance.txt: classes;
    DIR/splits/<split>.txt. Every scene is mapped, the mesh's vertices are labelled, and a submission in ScanNet's
    layout is scored against the truth. A scene that fails scores 0."""

    name, expected = "scannetpp", f"data/<scene>/scans/{MESH}.ply"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--protocol", default="scannetpp", choices=("scannet", "mask3d", "segment3d", "scannetpp"))
        parser.add_argument("--split", default="nvs_sem_val", help="DIR/splits/SPLIT.txt, where there")
        parser.add_argument(
            "--truth",
            default="instance-classes",
            choices=("instance-classes", "all"),
            help="objects of the 84 instance classes (OpenSplat3D), or all annotations, walls and floors too",
        )
        parser.add_argument("--smooth", action=argparse.BooleanOptionalAction, default=True)
        parser.add_argument("--max-distance", type=float, metavar="D")
        parser.add_argument("--train-on-test", action=argparse.BooleanOptionalAction, default=True)

    def scenes(self) -> dict[str, Path]:
        for pattern in ("data/*/scans", "*/scans", "scans"):
            found = sorted(self.args.dataset.resolve().glob(f"{pattern}/{MESH}.ply"))
            if found:
                return {mesh.parent.parent.name: mesh.parent.parent for mesh in found}
        return {}

    def listed(self) -> list[str] | None:
        path = self.args.dataset / "splits" / f"{self.args.split}.txt"
        return path.read_text(encoding="utf-8").split() if path.is_file() else None

    def predict(self, name: str, scene: Path, target: Path) -> None:
        """Maps a scene from its DSLR photos and writes the labelled vertices as a submission."""
        source = self.work / "inputs" / name
        for part, called in (("resized_images", "images"), ("colmap", "sparse")):
            if not (scene / "dslr" / part).is_dir():
                raise InputError(f"{scene / 'dslr' / part}: no such folder; download the scene's DSLR photos and poses")
            link(scene / "dslr" / part, source / called)
        tests = [] if self.args.train_on_test else _json(scene / "dslr" / "train_test_lists.json").get("test", [])
        gmap = self.map(name, source, list(map(str, tests)))
        mesh = read_cloud(scene / "scans" / f"{MESH}.ply")
        options = ExportOptions(smooth=self.args.smooth, max_distance=self.args.max_distance)
        labels = export_labels(gmap.means, gmap.instance_ids, mesh, options)
        write_scannet(target, name, labels, {entry["id"]: entry for entry in gmap.instances})

    def score(self, scenes: Mapping[str, Path]) -> tuple[dict[str, Any], str]:
        whole = self.args.truth == "all"
        truth, submission = self.work / "truth" / self.args.truth, self.work / "submission"
        classes = read_classes(self.args.dataset, scenes)
        for stale in (*truth.glob("*.txt"), *submission.glob("*.txt")):  # of other scenes
            stale.unlink()
        submission.mkdir(parents=True, exist_ok=True)
        for name, scene in scenes.items():
            with atomic_file(truth / f"{name}.txt") as aside:
                np.savetxt(aside, vertex_truth(scene, classes, whole), fmt="%d")
            part = self.work / "predictions" / name
            for file in (*part.glob(f"{name}.txt"), *part.glob("predicted_masks/*.txt")):
                link(file, submission / file.relative_to(part))
        result, table = run_scannet(submission, truth, self.args.protocol)
        switches = {
            "truth": "all annotated objects" if whole else "objects of the instance classes",
            "classes": classes.source,
            "smoothing": "Felzenszwalb-Huttenlocher on the mesh" if self.args.smooth else "off",
            "max_distance": self.args.max_distance,
            "test_photos": "trained on" if self.args.train_on_test else "held out",
        }
        result["protocol"] |= {**switches, "several_annotations": "the smallest object holds a vertex"}
        return result, table + "\n" + "; ".join(f"{key}: {value}" for key, value in switches.items())


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


def read_classes(dataset: Path, scenes: Mapping[str, Path]) -> Classes:
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


main = ScanNetPP.main
