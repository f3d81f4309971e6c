"""The runner of the dataset benchmarks: a map of each scene, predictions from it, and the table of the scores."""

from __future__ import annotations

import argparse
import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from bench.masks import Masks, read_mask_folder
from perception.bench.output import bench_parser, finish
from perception.config import MapConfig, load_config
from perception.errors import InputError
from perception.export.render import as_gaussians, map_views, write_picture
from perception.io.atomic import atomic_directory, atomic_file
from perception.map.files import read_info
from perception.map.write import Map, read_map
from perception.pipeline.mapping import build_map
from perception.progress import Progress
from perception.query import QueryMap
from perception.types import View

HELD_OUT = "held out of training, unless the map was brought along"


class DatasetBench(ABC):
    """One dataset benchmark, `python tools bench.run NAME DIR -o WORK`: a subclass says how the download is read.

    What is finished is kept in WORK, so that a second run goes on. args: the parsed arguments.
    """

    name: str
    expected: str
    """The layout of a scene in DIR, for the message when there is none."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.work = args, args.output
        self.maps = args.maps or args.output / "maps"
        self.progress = Progress(quiet=args.json)
        self.config("scene")  # invalid settings raise before the first scene

    @classmethod  # noqa: B027
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Adds the options of this benchmark alone."""

    @abstractmethod
    def scenes(self) -> dict[str, Path]:
        """The folder of each scene of the download; empty when it is not this dataset."""

    def listed(self) -> list[str] | None:
        """The scenes to run when --scenes is not given; None = all."""
        return None

    @abstractmethod
    def predict(self, name: str, scene: Path, target: Path) -> None:
        """Writes the predictions of a scene into the empty folder `target`. InputError: the scene scores 0."""

    @abstractmethod
    def score(self, scenes: Mapping[str, Path]) -> tuple[dict[str, Any], str]:
        """The scores of WORK/predictions and their table."""

    @classmethod
    def main(cls, arguments: Sequence[str] | None = None) -> None:
        """Command line entry point; prints the table or JSON, and writes WORK/NAME.json."""
        parser = bench_parser(cls.name, cls.__doc__)
        parser.prog = f"python tools bench.run {cls.name}"
        parser.add_argument("dataset", type=Path, metavar="DIR", help="the dataset as downloaded")
        parser.add_argument("--maps", type=Path, metavar="DIR", help="finished maps <scene>.gsmap (default WORK/maps)")
        parser.add_argument("--scenes", type=lambda text: text.split(","), metavar="A,B", help="only these")
        parser.add_argument("--masks", default="auto", metavar="SOURCE", help="as of `map`; {scene}: the scene's name")
        parser.add_argument("--preset", default="default")
        parser.add_argument("--config", type=Path, metavar="FILE.toml")
        parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
        cls.add_arguments(parser)
        bench = cls(parser.parse_args(arguments))
        found = bench.scenes()
        if not found:
            raise InputError(f"{bench.args.dataset}: holds no scenes; expected {cls.expected}")
        wanted = bench.args.scenes or bench.listed() or list(found)
        for name in wanted:
            if name not in found:
                raise InputError(f"{bench.args.dataset}: holds no scene '{name}'; found {', '.join(found)}")
        scenes = {name: folder for name, folder in found.items() if name in wanted}
        failed = bench._predict_all(scenes)
        (bench.work / "predictions").mkdir(parents=True, exist_ok=True)
        result, table = bench.score(scenes)
        maps = {name: _map_facts(bench.maps / f"{name}.gsmap") for name in scenes}
        lines = [table] + [f"{name} failed and scores 0: {why}" for name, why in failed.items()]
        facts = {"failed": failed, "maps": maps, "result": result}
        finish(cls.name.replace("-", "_"), bench.args, facts, "\n".join(lines))

    def config(self, scene: str, more: Sequence[str] = ()) -> MapConfig:
        """The settings of a scene's map."""
        pairs = [*more, f"masks={self.args.masks.replace('{scene}', scene)}", *self.args.pairs]
        return load_config(self.args.config, pairs, self.args.preset)

    def map(self, scene: str, source: Path, held_out: Sequence[str] | None = None, settings: Sequence[str] = ()) -> Map:
        """The scene's map: read from `maps` if it is there, else built. An interrupted build is resumed.

        held_out: names of photos excluded from training. settings: KEY=VALUE pairs of the data set, which --set
        overrides. Neither has an effect on a map that already exists.
        """
        path = self.maps / f"{scene}.gsmap"
        if path.exists():
            self.progress.log(f"{scene}: using {path}")
            return read_map(path)
        more = list(settings)
        if held_out is not None:
            listed = self.work / "held_out" / f"{scene}.txt"
            text = "".join(f"{name}\n" for name in held_out)
            if not listed.is_file() or listed.read_text(encoding="utf-8") != text:  # a new file would be another input
                with atomic_file(listed, parents=True) as aside:
                    aside.write_text(text, encoding="utf-8")
            more.append(f"photos.held_out={listed}")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.progress.log(f"{scene}: mapping {source}")
        return build_map(source, path, self.config(scene, more), resume=True, progress=self.progress)

    def _predict_all(self, scenes: Mapping[str, Path]) -> dict[str, str]:
        """Predicts each scene that has no predictions yet; returns the reason of failure by scene name."""
        failed = {}
        for name, folder in scenes.items():
            target = self.work / "predictions" / name
            if target.exists():
                self.progress.log(f"{name}: predictions are there already")
                continue
            try:
                with atomic_directory(target) as aside:
                    self.predict(name, folder, aside)
            except InputError as error:
                failed[name] = str(error)
                self.progress.log(f"warning: {name} failed and scores 0: {error}")
        return failed

    def predicted(self, name: str) -> Masks:
        """The masks that `predict` wrote for a scene; none for a scene that failed."""
        folder = self.work / "predictions" / name
        return read_mask_folder(folder) if folder.is_dir() else {}


def _map_facts(path: Path) -> dict[str, Any]:
    info = read_info(path) if (path / "map.json").is_file() else {}
    kept = ("num_gaussians", "num_instances", "seed", "config", "seconds", "masks", "quality")
    return {key: info[key] for key in kept if key in info}


class InstanceViews:
    """Renders a map's instances as silhouettes in the map's own views, or as masks where they exceed `threshold`.

    occlusion: the other Gaussians of the map can hide them; without it the instances are rendered alone.
    """

    def __init__(self, gmap: Map, occlusion: bool, threshold: float | None = None) -> None:
        self.gmap, self.occlusion, self.threshold = gmap, occlusion, threshold
        self.gaussians = as_gaussians(gmap)
        self.views = {view.name: view for view in map_views(gmap, held_out=False)}

    def find(self, name: str) -> View | None:
        """The view of a photo given with or without its folder and suffix; None when it is not registered."""
        wanted = PurePosixPath(name)
        for view in self.views.values():
            have = PurePosixPath(view.name)
            if name in (view.name, have.name, have.stem) or wanted.stem == have.stem:
                return view
        return None

    def silhouette(self, instances: list[int], view: View) -> np.ndarray:
        """Accumulated rendering weight [H, W] float32 in [0, 1] of the instances' Gaussians, or the bool mask."""
        import torch

        from perception.gaussians.views import render

        own = torch.from_numpy(np.isin(self.gmap.instance_ids, instances))
        if not own.any():
            return np.zeros((view.height, view.width), np.float32)
        used = torch.arange(len(own)) if self.occlusion else own.nonzero()[:, 0]
        camera, K = (torch.from_numpy(matrix.astype(np.float32)) for matrix in (view.camera_from_world, view.K))
        shown = own[used].float()[:, None]
        with torch.no_grad():
            out = render(self.gaussians.rows(used), camera, K, view.width, view.height, features=shown)
        assert out.features is not None  # they were given
        weight: np.ndarray = out.features[0, ..., 0].numpy()
        return weight if self.threshold is None else weight > self.threshold

    def write(self, target: Path, truths: Masks, photos: Mapping[str, str], chosen: Mapping[str, list[int]]) -> None:
        """<target>/<view>/<prompt>.png for each (view, prompt) of `truths` whose photo is registered: 255 × the
        silhouette, or mask, of the instances `chosen` for the prompt. photos: photo name by view."""
        for label, prompt in truths:
            if (view := self.find(photos[label])) is not None:
                image = np.clip(np.round(self.silhouette(chosen[prompt], view) * 255.0), 0, 255).astype(np.uint8)
                write_picture(target / label / f"{prompt}.png", image)


def by_words(gmap: Map, prompt: str, rule: str, scoring: str = "calibrated") -> list[int]:
    """Ids of the instances that a prompt selects by the map's own embeddings, whether or not it is present.

    rule: "top-1", or "relative": all instances with (score − minimum) ≥ 0.85 (maximum − minimum). scoring: the scores
    are those of `query`, or with "cosine" the similarities of prompt and instance, for which the rules were published.
    """
    opened, count = QueryMap.of(gmap), len(gmap.instances)
    if not count:
        return []
    if scoring == "cosine":
        found = zip(opened.ranker.similarity([prompt])[0].tolist(), gmap.instances, opened.ranker.seen, strict=True)
        ranked = sorted(((score, entry["id"]) for score, entry, seen in found if seen), key=lambda pair: -pair[0])
    else:
        ranked = [(hit.score, hit.instance_id) for hit in opened.query(prompt, top_k=count, min_score=0.0)]
    if rule == "top-1" or not ranked:
        return [i for _, i in ranked[:1]]
    best, least = ranked[0][0], ranked[-1][0]
    return [i for score, i in ranked if score - least >= 0.85 * (best - least)]


def link(source: Path, target: Path) -> None:
    """Creates `target` as a symbolic link to `source`, or as a copy where links are not supported."""
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.symlink_to(source.resolve(), target_is_directory=source.is_dir())
    except OSError:
        (shutil.copytree if source.is_dir() else shutil.copy2)(source, target)  # type: ignore[operator]
