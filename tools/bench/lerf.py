"""LERF-mask (Gaussian Grouping) and LERF-OVS, 3D selection by OpenGaussian's protocol: `python tools bench.run
lerf-mask` and `lerf-ovs DIR -o WORK`."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.datasets import HELD_OUT, DatasetBench, InstanceViews, by_words
from bench.masks import evaluate_lerf_mask, evaluate_lerf_ovs, read_lerf_polygons, read_mask_folder, scenes_result
from perception.errors import InputError

RENDERED = 0.2  # Gaussian Grouping: rendered mask > 0.2


class LerfMask(DatasetBench):
    """DIR/<scene>: images/, sparse/0, images_train/ (photos that may be trained on), test_mask/<view>/<prompt>.png,
    where <view> is a photo's name or the number of a test view (sorted by name). Every scene is mapped without its test
    views, the instances a prompt selects are rendered with occlusion, and the masks are scored. A scene that fails
    scores 0."""

    name, expected = "lerf-mask", "<scene>/test_mask/<view>/<prompt>.png"

    def scenes(self) -> dict[str, Path]:
        dataset = self.args.dataset
        if (dataset / "test_mask").is_dir():
            return {dataset.name: dataset}
        return {path.parent.name: path.parent for path in sorted(dataset.glob("*/test_mask"))}

    def predict(self, name: str, scene: Path, target: Path) -> None:
        """A bool mask of each prompt in each test view that has a registered pose."""
        truths = read_mask_folder(scene / "test_mask")
        tests = test_photos(scene, sorted({view for view, _ in truths}))
        shown = InstanceViews(self.map(name, scene, sorted(tests.values())), True, RENDERED)
        if not any(shown.find(photo) for photo in tests.values()):
            raise InputError(f"{scene}: none of its test views {sorted(tests.values())} is registered in the map")
        prompts = sorted({prompt for _, prompt in truths})
        shown.write(target, truths, tests, {prompt: by_words(shown.gmap, prompt, "top-1") for prompt in prompts})

    def score(self, scenes: Mapping[str, Path]) -> tuple[dict[str, Any], str]:
        switches = {
            "selection": "the map's own words, top-1 whether or not it says present",
            "rendered": f"with occlusion, > {RENDERED}",
            "test_views": HELD_OUT,
        }
        results = {
            name: evaluate_lerf_mask(self.predicted(name), read_mask_folder(scene / "test_mask"), **switches)
            for name, scene in scenes.items()
        }
        return scenes_result(results, ("miou", "mbiou"))


def test_photos(scene: Path, labels: Sequence[str]) -> dict[str, str]:
    """{label: photo name} of the test views. A label is a photo's stem or its number among the test photos."""
    photos = {path.stem: path.name for path in sorted((scene / "images").iterdir())}
    trained = scene / "images_train"
    stems = {path.stem for path in trained.iterdir()} if trained.is_dir() else set()
    tests = [name for stem, name in photos.items() if stem not in stems] if stems else []
    found = {}
    for label in labels:
        if label in photos:
            found[label] = photos[label]
        elif label.isdigit() and int(label) < len(tests):
            found[label] = tests[int(label)]
        else:
            raise InputError(
                f"{scene / 'test_mask' / label}: is no photo of images/ and no number of a test view; "
                f"images_train/ leaves {len(tests)} test views"
            )
    return found


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
