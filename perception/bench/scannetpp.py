"""ScanNet++ instance segmentation of mesh vertices: `perception bench scannetpp DIR -o WORK`."""

from __future__ import annotations

import argparse
import csv
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
SEVERAL = 3
"""Most annotations of one vertex that the toolkit keeps (its `multilabel_max`)."""


@dataclass(frozen=True)
class Classes:
    """The benchmark's classes. names: in order, a class's id is its index. instance: those evaluated as instances.
    mapped: raw label -> class or another raw label; a label that is not in it counts as not annotated."""

    names: list[str]
    instance: set[str]
    mapped: dict[str, str]


class ScanNetPP(DatasetBench):
    """DIR (or DIR/data)/<scene>: dslr/resized_images, dslr/colmap (in the mesh's frame), dslr/train_test_lists.json,
    scans/mesh_aligned_0.05.ply, segments.json, segments_anno.json and, where there, mesh_aligned_0.05_mask.txt
    (vertices to be ignored); DIR/metadata/semantic_benchmark/top100.txt, top100_instance.txt and map_benchmark.csv:
    classes, and the class of each raw label; DIR/splits/<split>.txt. Every scene is mapped, the mesh's vertices are
    labelled, and a submission in ScanNet's layout is scored against the truth. A scene that fails scores 0."""

    name, expected = "scannetpp", f"data/<scene>/scans/{MESH}.ply"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--protocol", default="scannetpp", choices=("scannet", "mask3d", "segment3d", "scannetpp"))
        parser.add_argument("--split", default="nvs_sem_val", help="DIR/splits/SPLIT.txt, where there")
        parser.add_argument(
            "--truth",
            default="instance-classes",
            choices=("instance-classes", "all"),
            help="objects of the 84 instance classes (the toolkit), or all annotations, walls too (Segment3D)",
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
        tests = [] if self.args.train_on_test else _read(scene / "dslr" / "train_test_lists.json", "test")
        gmap = self.map(name, source, list(map(str, tests)))
        mesh = read_cloud(scene / "scans" / f"{MESH}.ply")
        segments = scene / "scans" / "segments.json"
        options = ExportOptions(max_distance=self.args.max_distance, smooth=self.args.smooth, segments=segments)
        labels = export_labels(gmap.means, gmap.instance_ids, mesh, options)
        write_scannet(target, name, labels, {entry["id"]: entry for entry in gmap.instances})

    def score(self, scenes: Mapping[str, Path]) -> tuple[dict[str, Any], str]:
        whole = self.args.truth == "all"
        truth, submission = self.work / "truth" / self.args.truth, self.work / "submission"
        classes = None if whole else read_classes(self.args.dataset)
        for stale in (*truth.glob("*.txt"), *submission.glob("*.txt")):  # of other scenes
            stale.unlink()
        submission.mkdir(parents=True, exist_ok=True)
        for name, scene in scenes.items():
            with atomic_file(truth / f"{name}.txt") as aside:
                np.savetxt(aside, vertex_truth(scene, classes), fmt="%d")
            part = self.work / "predictions" / name
            for file in (*part.glob(f"{name}.txt"), *part.glob("predicted_masks/*.txt")):
                link(file, submission / file.relative_to(part))
        result, table = run_scannet(submission, truth, self.args.protocol)
        switches = {
            "truth": "all annotations; the last one holds a vertex (Segment3D)"
            if classes is None
            else f"objects of {len(classes.instance)} instance classes of {len(classes.names)}; labels mapped by "
            "map_benchmark.csv; the smallest object holds a vertex; the first annotation is void (toolkit)",
            "smoothing": "the data set's segments (segments.json)" if self.args.smooth else "off",
            "max_distance": self.args.max_distance,
            "test_photos": "trained on" if self.args.train_on_test else "held out",
        }
        result["protocol"] |= switches
        return result, table + "\n" + "; ".join(f"{key}: {value}" for key, value in switches.items())


def vertex_truth(scene: Path, classes: Classes | None) -> np.ndarray:
    """Truth id [V] of the mesh vertices: 1000 · class + index of the annotation, 0 = void, −2 = ignored.

    With classes, the rules of ScanNet++'s toolkit (`MapLabelToIndex`, `GetLabelsOnVertices`, `prepare_semantic_gt`):
    labels are mapped; the annotation with the fewest vertices holds a vertex, an earlier one among equals, and a vertex
    that has SEVERAL counts for no further one; other classes than the instance classes, and the annotation of index 0,
    are void. Without, those of Segment3D's preparation: whatever the label, and the last annotation holds a vertex.
    """
    scans = scene / "scans"
    segments = np.asarray(_read(scans / "segments.json", "segIndices"), np.int64)
    truth, used = np.zeros((2, len(segments)), np.int64)
    smallest = np.full(len(segments), np.iinfo(np.int64).max)
    for index, group in enumerate(_read(scans / "segments_anno.json", "segGroups")):
        inside = np.isin(segments, np.asarray(group["segments"], np.int64))
        if classes is None:
            truth[inside] = 1000 + index
            continue
        name = classes.mapped.get(group["label"])
        if name not in classes.names:
            continue
        inside &= used < SEVERAL
        used += inside
        size = np.count_nonzero(inside)
        inside &= size < smallest
        smallest[inside] = size
        truth[inside] = 1000 * classes.names.index(name) + index if index and name in classes.instance else 0
    mask = scans / f"{MESH}_mask.txt"
    if mask.is_file():
        truth[np.array(mask.read_text(encoding="ascii").split(), np.int64)] = IGNORED
    return truth


def read_classes(dataset: Path) -> Classes:
    """The benchmark's classes. In map_benchmark.csv an empty `semantic_map_to` keeps the label, "None" drops it."""
    folder = dataset / "metadata" / "semantic_benchmark"
    try:
        names, instance = (
            (folder / name).read_text(encoding="utf-8").splitlines() for name in ("top100.txt", "top100_instance.txt")
        )
        with (folder / "map_benchmark.csv").open(encoding="utf-8", newline="") as file:
            targets = [(row["class"], row["semantic_map_to"] or row["class"]) for row in csv.DictReader(file)]
    except (OSError, KeyError) as error:
        raise InputError(
            f"{folder}: expected top100.txt, top100_instance.txt and map_benchmark.csv ({error}); "
            "download the data set's metadata folder"
        ) from error
    return Classes(names, set(instance), {label: target for label, target in targets if target != "None"})


def _read(path: Path, key: str) -> Any:
    """The value of `key` in a JSON file of the download."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))[key]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: expected a JSON object with '{key}' ({error!r}); download the scene's files again"
        ) from error


main = ScanNetPP.main
