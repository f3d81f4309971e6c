"""LERF-OVS, 3D selection (OpenGaussian's protocol): `perception bench lerf-ovs DIR -o WORK`."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from perception.bench.datasets import HELD_OUT, DatasetBench, InstanceViews, by_words
from perception.errors import InputError
from perception.evaluate.layouts import read_lerf_polygons, scenes_result
from perception.evaluate.masks import evaluate_lerf_ovs

SELECTION = {
    "top-1": "top-1: best instance whether or not the map says present",
    "relative": "relative: all instances >= .85 of the best score after shifting the least to 0",
}
SCORING = {"calibrated": "the scores of query", "cosine": "cosine of prompt and instance"}


class LerfOvs(DatasetBench):
    """DIR/<scene>: images/ and sparse/0; DIR/label/<scene>/frame_*.json: polygons by category. Every scene is mapped
    without its labelled frames, the Gaussians a category selects are rendered, and the silhouettes are scored. A scene
    that fails scores 0."""

    name, expected = "lerf-ovs", "label/<scene>/frame_*.json"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--select", choices=tuple(SELECTION), default="top-1")
        parser.add_argument("--scoring", choices=tuple(SCORING), default="calibrated", help="of instances for a prompt")
        parser.add_argument("--occlusion", action="store_true", help="render with the other Gaussians in front")
        parser.add_argument("--train-on-test", action="store_true", help="labelled frames are trained on, as LangSplat")

    def scenes(self) -> dict[str, Path]:
        return {path.name: path for path in sorted(self.args.dataset.glob("label/*")) if path.is_dir()}

    def predict(self, name: str, scene: Path, target: Path) -> None:
        """Silhouettes in [0, 1] of each category in each labelled frame that has a registered pose."""
        source = self.args.dataset / name
        if not source.is_dir():
            raise InputError(f"{source}: no such folder; expected the scene's images/ and sparse/ there")
        truths = read_lerf_polygons(scene)
        frames = sorted({frame for frame, _ in truths})
        shown = InstanceViews(self.map(name, source, [] if self.args.train_on_test else frames), self.args.occlusion)
        how = (self.args.select, self.args.scoring)
        selected = {text: by_words(shown.gmap, text, *how) for text in sorted({text for _, text in truths})}
        shown.write(target, truths, dict(zip(frames, frames, strict=True)), selected)

    def score(self, scenes: Mapping[str, Path]) -> tuple[dict[str, Any], str]:
        switches = {
            "selection": f"{SELECTION[self.args.select]}, by {SCORING[self.args.scoring]}",
            "occlusion": "on" if self.args.occlusion else "off",
            "test_views": "trained on" if self.args.train_on_test else HELD_OUT,
        }
        results = {}
        for name, label in scenes.items():
            silhouettes = {key: mask / 255.0 for key, mask in self.predicted(name).items()}
            results[name] = evaluate_lerf_ovs(silhouettes, read_lerf_polygons(label), **switches)
        return scenes_result(results, ("miou", "macc25"))


main = LerfOvs.main
