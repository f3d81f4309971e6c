"""LERF-mask (Gaussian Grouping): `perception bench lerf-mask DIR -o WORK`."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2

from perception.bench.datasets import HELD_OUT, DatasetBench, InstanceViews, by_reference, by_words
from perception.errors import InputError
from perception.evaluate.layouts import read_mask_folder, run_lerf_mask

RENDERED, SHARE = 0.2, 0.7  # Gaussian Grouping: rendered mask > 0.2; instances > 0.7 inside the reference mask
SELECTION = {
    "query": "the map's own words, top-1 whether or not it says present",
    "truth": "instances inside the TRUE mask of the first test view by > .7: tells segmentation apart from language",
    "reference": "instances inside a detector's mask of the first test view by > .7",
}


class LerfMask(DatasetBench):
    """DIR/<scene>: images/, sparse/0, images_train/ (photos that may be trained on), test_mask/<view>/<prompt>.png,
    where <view> is a photo's name or the number of a test view (sorted by name). Every scene is mapped without its test
    views, the instances a prompt selects are rendered with occlusion, and the masks are scored. A scene that fails
    scores 0."""

    name, expected = "lerf-mask", "<scene>/test_mask/<view>/<prompt>.png"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        how = "query, truth, or reference:DIR with <scene>/<prompt>.png"
        parser.add_argument("--select", default="query", metavar="HOW", help=how)
        parser.add_argument("--missing", choices=("zero", "skip"), default="zero")

    def __init__(self, args: argparse.Namespace) -> None:
        super().__init__(args)
        self.select, _, self.references = args.select.partition(":")
        if self.select not in SELECTION or (self.select == "reference") != bool(self.references):
            raise InputError(f"--select is '{args.select}'; expected query, truth or reference:DIR")

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
        found = ((label, shown.find(photo)) for label, photo in sorted(tests.items()))
        first = next(((label, view) for label, view in found if view is not None), None)
        if first is None:
            raise InputError(f"{scene}: none of its test views {sorted(tests.values())} is registered in the map")
        ids = shown.ids(first[1]) if self.select != "query" else None
        chosen = {}
        for prompt in sorted({prompt for _, prompt in truths}):
            if ids is None:
                chosen[prompt] = by_words(shown.gmap, prompt, "top-1")
            else:
                reference: Any = truths.get((first[0], prompt))
                if self.references:
                    reference = cv2.imread(str(Path(self.references) / name / f"{prompt}.png"), cv2.IMREAD_GRAYSCALE)
                chosen[prompt] = [] if reference is None else by_reference(ids, reference > 128, SHARE)
        shown.write(target, truths, tests, chosen)

    def score(self, scenes: Mapping[str, Path]) -> tuple[dict[str, Any], str]:
        switches = {
            "selection": SELECTION[self.select],
            "rendered": f"with occlusion, > {RENDERED}",
            "test_views": HELD_OUT,
        }
        truth = self.chosen_truth({f"{name}/test_mask": scene / "test_mask" for name, scene in scenes.items()})
        return run_lerf_mask(self.work / "predictions", truth, missing=self.args.missing, **switches)


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


main = LerfMask.main
