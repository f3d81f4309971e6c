"""ScanNet++ instance segmentation of mesh vertices: `python tools bench.run scannetpp DIR -o WORK`."""

from __future__ import annotations

import argparse
import csv
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bench.datasets import DatasetBench, link
from bench.scannet import run_scannet, write_scannet
from perception.errors import InputError
from perception.evaluate.instances import instances_table
from perception.export.export_map import ExportOptions, export_labels
from perception.io.atomic import atomic_file
from perception.io.cloud import read_cloud, write_cloud
from perception.photos.decode import photo_size
from perception.query import QueryMap
from perception.types import PointCloud

MESH = "mesh_aligned_0.05"
FRAMES, POINTS = 300, 750_000  # of a scene, in the paper
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
    classes, and the class of each raw label; DIR/splits/<split>.txt. Every scene is mapped as in the paper, unless
    --set says otherwise: 300 photos at half resolution, from up to 750 000 vertices of the mesh; pixels that are black
    in dslr/resized_anon_masks are ignored. The vertices are labelled, and a submission in ScanNet's layout is scored,
    without classes and, if the maps describe their instances, by class. A scene that fails scores 0."""

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
        """Maps a scene from its DSLR photos; writes the labelled vertices as a submission, and classes.json: the class
        of each instance, where the map describes them."""
        named = None if self.args.truth == "all" else self.classes.names
        photos, tests = self._link_photos(name, scene / "dslr")
        mesh = read_cloud(scene / "scans" / f"{MESH}.ply")
        gmap = self.map(name, photos[0].parent.parent, tests, self._settings(name, scene, photos[0], mesh))
        segments = scene / "scans" / "segments.json"
        options = ExportOptions(smooth=self.args.smooth, segments=segments)
        labels = export_labels(gmap.means, gmap.instance_ids, mesh, options)
        classes = None
        if named is not None and gmap.instances and (opened := QueryMap.of(gmap)).problem is None:
            best = opened.ranker.similarity(named).argmax(axis=0).tolist()
            classes = {entry["id"]: index for entry, index in zip(gmap.instances, best, strict=True)}
            (target / "classes.json").write_text(json.dumps({i: named[index] for i, index in classes.items()}))
        write_scannet(target, name, labels, {entry["id"]: entry for entry in gmap.instances}, classes)

    def _link_photos(self, name: str, dslr: Path) -> tuple[list[Path], list[str]]:
        """The photos to map, FRAMES of them evenly chosen by name, in a new COLMAP workspace; the names held out."""
        for part in ("resized_images", "colmap"):
            if not (dslr / part).is_dir() or not any((dslr / part).iterdir()):
                raise InputError(f"{dslr / part}: missing or empty; download the scene's DSLR photos and poses")
        tests = [] if self.args.train_on_test else list(map(str, _read(dslr / "train_test_lists.json", "test")))
        trained = sorted(path for path in (dslr / "resized_images").iterdir() if path.name not in tests)
        even = np.linspace(0, len(trained) - 1, min(FRAMES, len(trained))).round().astype(int)
        source = self.work / "workspaces" / name
        shutil.rmtree(source, ignore_errors=True)  # another choice
        link(dslr / "colmap", source / "sparse")
        photos = [trained[i] for i in even] + [dslr / "resized_images" / test for test in tests]
        for photo in photos:
            link(photo, source / "images" / photo.name)
        return [source / "images" / photo.name for photo in photos], tests

    def _settings(self, name: str, scene: Path, photo: Path, mesh: PointCloud) -> list[str]:
        """The paper's for this data set: half resolution, up to POINTS vertices to start from, no anonymised pixels."""
        start = scene / "scans" / f"{MESH}.ply"
        if len(mesh.points) > POINTS:
            rows = np.sort(np.random.default_rng(0).choice(len(mesh.points), POINTS, replace=False))
            start = self.work / "points" / f"{name}.ply"
            start.parent.mkdir(parents=True, exist_ok=True)
            if not start.is_file():  # a new file would be another input
                write_cloud(start, PointCloud(mesh.points[rows], None if mesh.colors is None else mesh.colors[rows]))
        masks = scene / "dslr" / "resized_anon_masks"
        given = [f"photos.ignore_masks={masks}"] if any(masks.glob("*.png")) else []
        return [*given, f"photos.max_side={max(photo_size(photo)) // 2}", f"photos.init_points={start}"]

    @cached_property
    def classes(self) -> Classes:
        return read_classes(self.args.dataset)

    def score(self, scenes: Mapping[str, Path]) -> tuple[dict[str, Any], str]:
        classes = None if self.args.truth == "all" else self.classes
        truth, submission = self.work / "truth" / self.args.truth, self.work / "submission"
        for stale in (*truth.glob("*.txt"), *submission.glob("*.txt")):  # of other scenes
            stale.unlink()
        submission.mkdir(parents=True, exist_ok=True)
        parts = [self.work / "predictions" / name for name in scenes]
        for part, (name, scene) in zip(parts, scenes.items(), strict=True):
            with atomic_file(truth / f"{name}.txt", parents=True) as aside:
                np.savetxt(aside, vertex_truth(scene, classes), fmt="%d")
            for file in (*part.glob(f"{name}.txt"), *part.glob("predicted_masks/*.txt")):
                link(file, submission / file.relative_to(part))
        result, table = run_scannet(submission, truth, self.args.protocol)
        if classes is not None and all((part / "classes.json").is_file() for part in parts if part.is_dir()):
            valid = tuple(index for index, name in enumerate(classes.names) if name in classes.instance)
            named, _ = run_scannet(submission, truth, self.args.protocol, by_class=True, valid_classes=valid)
            named["classes"] = {classes.names[int(index)]: row for index, row in named["classes"].items()}
            result["open_vocabulary"] = named
            table += "\n\nby class, each instance the most similar of the class names (cosine):\n" + instances_table(
                named
            )
        switches = {
            "truth": "all annotations; the last one holds a vertex (Segment3D)"
            if classes is None
            else f"objects of {len(classes.instance)} instance classes of {len(classes.names)}; labels mapped by "
            "map_benchmark.csv; the smallest object holds a vertex; the first annotation is void (toolkit)",
            "smoothing": "the data set's segments (segments.json)" if self.args.smooth else "off",
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
