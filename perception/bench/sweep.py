"""Parameter sweeps of `bench map` and `bench scaling`: one scene is loaded once, many settings are trained on it.

Each row is written to disk when it is measured. Its key covers the scene, the settings, the threads and the source code
that makes a map. A stopped sweep therefore resumes, and rows of another version of the code are never reused.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.memory import fresh_peak
from perception.bench.output import bench_parser
from perception.config import MapConfig, load_config
from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.types import View

_CODE = ("gaussians", "instances", "export", "evaluate", "config.py", "_core*")
QUICK = {"shorten": 6.0, "max_side": 320, "budget": 20_000}
"""--quick: a sixth of the iterations on small photos. It shows tendencies only; quote figures from a full run."""
TRUTH_CLOUD, TRUTH_MASKS = "gt_points.ply", "masks_gt"


@dataclass(frozen=True)
class Variant:
    """One cell of a sweep: the varied setting (group), its value (name), and the settings that produce it.

    settings: KEY=VALUE pairs applied over the preset. masks: folder of label images in the scene; None = photos only.
    threads: 0 = all processors.
    """

    group: str
    name: str
    settings: tuple[str, ...] = ()
    masks: str | None = "labels"
    threads: int = 0
    preset: str = "default"


@dataclass(frozen=True)
class Limits:
    """Limits that shorten every variant of a sweep. Iterations are divided by `shorten`; other fields are maxima."""

    shorten: float = 1.0
    iterations: int | None = None
    max_side: int | None = None
    budget: int | None = None
    settings: tuple[str, ...] = ()

    def config(self, variant: Variant) -> MapConfig:
        """The variant's settings within these limits. The number of densification steps is kept in a shorter run."""
        pairs = [*self.settings, *variant.settings, "language.encoder=none"]
        config = load_config(None, pairs, variant.preset)
        train, side = config.train, config.photos.max_side
        iterations = max(1, round((self.iterations or train.iterations) / self.shorten))
        every = max(20, round(config.densify.every * min(1.0, iterations / train.iterations)))
        pairs += [f"train.iterations={iterations}", f"densify.every={every}"]
        pairs += [f"train.budget={min(train.budget, self.budget or train.budget)}"]
        pairs += [f"photos.max_side={min(side, self.max_side or side)}"]
        return load_config(None, pairs, variant.preset)


@dataclass
class SweepScene:
    """A scene with photos and label images. Only the size requested last is kept, so that a variant's memory does not
    include images of another size. work: folder for cached results.
    """

    folder: Path
    work: Path
    held_out_every: int = 8
    _views: dict[Any, Any] = field(default_factory=dict)
    _scene: Any = None

    @property
    def name(self) -> str:
        return self.folder.parent.name if self.folder.suffix == ".json" else self.folder.name

    @property
    def root(self) -> Path:
        """The folder that holds label images and truth."""
        return self.folder.parent if self.folder.suffix == ".json" else self.folder

    def scene(self) -> Any:
        """The posed photos and the sparse cloud (perception.types.Scene)."""
        from perception.io.inputs import load_scene
        from perception.io.scene_cache import load_saved_scene, save_scene

        if self._scene is None:
            self._scene = load_saved_scene(self.work / "scene")
        if self._scene is None:
            self._scene = load_scene(self.folder, self.work / "sfm")
            save_scene(self.work / "scene", self._scene)
        return self._scene

    def photos(self, max_side: int) -> tuple[list[Any], list[Any]]:
        """(training, held-out) views without labels."""
        from perception.pipeline.photos import load_all, split_views
        from perception.progress import Progress

        if max_side not in self._views:
            self._views = {}
            parts = split_views(self.scene().views, self.held_out_every)
            self._views[max_side] = tuple(load_all(part, max_side, Progress(quiet=True)) for part in parts)
        return self._views[max_side]

    def training(self, max_side: int, masks: str | None) -> list[Any]:
        """Training views with the label images of folder `masks`. Without that folder, views without labels."""
        if masks is None or not (self.root / masks).is_dir():
            return self.photos(max_side)[0]
        if (max_side, masks) not in self._views:
            labelled = self._labelled(max_side, masks)  # may first remove cached views of another size
            self._views[max_side, masks] = labelled
        return self._views[max_side, masks]

    def _labelled(self, max_side: int, masks: str) -> list[Any]:
        from perception.io.photos import load_photo
        from perception.masks import make_source
        from perception.masks.label_images import compute_masks
        from perception.pipeline.photos import split_views, with_labels

        views, _ = split_views(self.scene().views, self.held_out_every)
        folder = self.work / f"{masks}-{max_side}"
        source = make_source(f"labels:{self.root / masks}")
        compute_masks(views, source, lambda view: load_photo(view, max_side), folder)
        decoded = self.photos(max_side)[0]
        return [with_labels(view, of, folder) for view, of in zip(decoded, views, strict=True)]


def run_variant(scene: SweepScene, variant: Variant, config: MapConfig) -> dict[str, Any]:
    """Trains one variant in this process and scores it. Returns a JSON-serialisable row."""
    import torch

    from perception.gaussians.train import Trainer
    from perception.pipeline.instances import describe, group_gaussians
    from perception.pipeline.mapping import initial_gaussians, score_views
    from perception.pipeline.photos import split_views
    from perception.pipeline.record import PeakMemory, Stages
    from perception.progress import Progress

    before = torch.get_num_threads()
    torch.set_num_threads(variant.threads or os.cpu_count() or 1)
    try:
        views = scene.training(config.photos.max_side, variant.masks)
        held = scene.photos(config.photos.max_side)[1]
        fresh_peak()
        peak, stages = PeakMemory(), Stages()
        trainer = Trainer(initial_gaussians(scene.scene(), config), views, config, held)
        began, cpu = time.monotonic(), time.process_time()
        with stages("train"):
            trainer.run()
        cpu = time.process_time() - cpu
        with stages("instances"):
            quiet = Progress(quiet=True)
            grouped = group_gaussians(trainer.gaussians, views, config, quiet)
            found = describe(trainer.gaussians, grouped, views, config.language, None, quiet)
        seconds = time.monotonic() - began
        quality = score_views(trainer.gaussians, held)
        record = trainer.record
        row: dict[str, Any] = {
            "pixels": int(views[0].photo.shape[0] * views[0].photo.shape[1]),
            "iterations": record.iterations,
            "gaussians": len(trainer.gaussians),
            "sh_degree": trainer.gaussians.sh_degree,
            "seconds": round(seconds, 2),
            "train_seconds": stages.seconds["train"],
            "cpu_seconds": round(cpu, 2),
            "seconds_per_1000": round(1000 * cpu / max(1, record.iterations), 2),
            "wall_per_1000": round(1000 * stages.seconds["train"] / max(1, record.iterations), 2),
            "peak_mib": peak.mib(),
            "psnr": quality.get("psnr"),
            "ssim": quality.get("ssim"),
            "decisions": record.decisions,
            "curve": record.curve,
            "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        }
        held_views = split_views(scene.scene().views, scene.held_out_every)[1]
        return row | _instance_scores(scene, trainer.gaussians, found, held_views)
    finally:
        torch.set_num_threads(before)


def _instance_scores(scene: SweepScene, gaussians: Any, found: Any, held: Sequence[View]) -> dict[str, Any]:
    """AP of the exported true cloud (protocol scannet, class-agnostic), and mIoU of the instances rendered in the
    held-out views against the true masks. {} without ground truth or without instances.
    """
    from perception.evaluate.instances import evaluate
    from perception.evaluate.rendered import rendered_miou
    from perception.export.transfer import export_labels
    from perception.io.cloud import read_cloud

    file = scene.root / TRUTH_CLOUD
    if not file.is_file() or found.report.get("count", 0) == 0:
        return {}
    cloud = read_cloud(file)
    labels = export_labels(gaussians.means.numpy(), found.ids, cloud)
    confidence = {entry["id"]: entry["score"] for entry in found.instances}
    result = evaluate(labels, confidence, cloud.labels["instance_id"])
    figures = {key: result[key] for key in ("ap", "ap50", "ap25")}
    if held and (scene.root / TRUTH_MASKS).is_dir():
        figures["miou"] = rendered_miou(gaussians, found.ids, held, scene.root / TRUTH_MASKS)
    return figures | {"instances": found.report["count"], "noise_share": found.report["noise_share"]}


class Sweep:
    """Rows of a sweep in `folder`/rows.json. Each row is written as soon as it is measured."""

    def __init__(self, folder: Path, limits: Limits, tell: Callable[[str], None]):
        self.folder, self.limits, self.tell = folder, limits, tell
        self.file = folder / "rows.json"
        self.rows: dict[str, dict[str, Any]] = {}
        if self.file.is_file():
            try:
                self.rows = json.loads(self.file.read_text(encoding="utf-8"))
            except ValueError as error:
                raise InputError(f"{self.file}: not valid JSON ({error}); remove it to start over") from error
        self._code = code_digest()

    def run(self, scene: SweepScene, variants: Sequence[Variant]) -> list[dict[str, Any]]:
        """The rows of `variants`, in order. Rows on disk are reused, and equal settings are trained once."""
        rows = []
        for number, variant in enumerate(variants, start=1):
            config = self.limits.config(variant)
            key = self._key(scene, variant, config)
            known = key in self.rows
            if not known:
                self.rows[key] = run_variant(scene, variant, config)
                with atomic_file(self.file) as aside:
                    aside.write_text(json.dumps(self.rows, indent=1), encoding="utf-8")
            row = {"scene": scene.name, **asdict(variant), "config": config.to_json(), **self.rows[key]}
            rows.append(row)
            self.tell(f"{scene.name} {number}/{len(variants)} {variant.group} {variant.name}: {_brief(row, known)}")
        return rows

    def _key(self, scene: SweepScene, variant: Variant, config: MapConfig) -> str:
        parts = [str(scene.folder.resolve()), variant.masks, variant.threads, config.to_json(), self._code]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def sweep_parser(name: str, about: str | None) -> argparse.ArgumentParser:
    """An argument parser with the options of a sweep over one scene."""
    parser = bench_parser(name, about)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="input of `map`")
    parser.add_argument("--quick", action="store_true", help="a sixth of the iterations, 320 pixels, 20 k Gaussians")
    parser.add_argument("--shorten", type=float, metavar="F", help="divide every variant's iterations by F")
    parser.add_argument("--iterations", type=int, metavar="N")
    parser.add_argument("--max-side", type=int, metavar="PX", help="most pixels a side, for every variant")
    parser.add_argument("--budget", type=int, metavar="N", help="most Gaussians, for every variant")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    parser.add_argument("--masks", default="labels", metavar="DIR", help="label images inside SCENE, or none")
    parser.add_argument("--only", metavar="TEXT", help="only variants with TEXT in their group or name")
    return parser


def limits_of(options: argparse.Namespace) -> Limits:
    """Limits from --quick and from the options that override it."""
    quick = QUICK if options.quick else {}
    given = {key: getattr(options, key) for key in ("shorten", "iterations", "max_side", "budget")}
    values: dict[str, Any] = {**quick, **{key: value for key, value in given.items() if value is not None}}
    if values.get("shorten", 1) <= 0:
        raise InputError(f"--shorten: found {values['shorten']}, expected above 0")
    return Limits(**values, settings=tuple(options.pairs))


def prepare(options: argparse.Namespace) -> tuple[Sweep, SweepScene, str | None]:
    """The sweep, its scene, and the folder of masks (None: photos only). Progress goes to stderr."""
    if not options.scene.exists():
        raise InputError(f"{options.scene}: does not exist; give a scene as `perception map` takes it")
    sweep = Sweep(options.output, limits_of(options), lambda text: print(text, file=sys.stderr, flush=True))
    scene = SweepScene(options.scene, Path())
    scene.work = options.output / "scenes" / scene.name
    masks = options.masks if (scene.root / options.masks).is_dir() else None
    return sweep, scene, masks


def chosen(variants: Sequence[Any], only: str | None) -> list[Any]:
    """The variants whose group or name contains `only`, and always the first one, which is the reference."""
    return [v for i, v in enumerate(variants) if i == 0 or only is None or only in f"{v.group} {v.name}"]


def with_minutes(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Adds minutes of mapping (training and clustering) and CPU minutes of training."""
    return [r | {"minutes": r["seconds"] / 60, "cpu_minutes": r["cpu_seconds"] / 60} for r in rows]


def code_digest() -> str:
    """Digest of the source files that can change a row."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for pattern in _CODE:
        for path in sorted(root.glob(pattern)):
            for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
                digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def _brief(row: dict[str, Any], known: bool) -> str:
    figures = [f"{row['psnr']:.2f} dB"] if row.get("psnr") is not None else []
    figures += [f"AP {row['ap']:.3f}"] if row.get("ap") is not None else []
    return f"{', '.join(figures)}, {row['seconds']:.0f} s{' (kept)' if known else ''}"


def pareto(points: Sequence[tuple[float, float | None]]) -> list[int]:
    """Indices of the Pareto-optimal (cost, value) pairs by rising cost: lower cost and higher value are better."""
    kept: list[int] = []
    best = -np.inf
    for _, loss, index in sorted((cost, -value, i) for i, (cost, value) in enumerate(points) if value is not None):
        if -loss > best:
            kept.append(index)
            best = -loss
    return kept
