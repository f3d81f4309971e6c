"""LERF-mask (Gaussian Grouping): `perception bench lerf-mask DIR -o WORK`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from perception.bench.datasets import HELD_OUT, DatasetBench, InstanceViews, by_words
from perception.errors import InputError
from perception.evaluate.layouts import read_mask_folder, scenes_result
from perception.evaluate.masks import evaluate_lerf_mask

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


main = LerfMask.main
