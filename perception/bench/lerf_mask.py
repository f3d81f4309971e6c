"""LERF-mask (Gaussian Grouping) from the downloaded folder to the table: `perception bench lerf-mask DIR -o WORK`.

DIR/<scene>: images/, sparse/0, images_train/ (photos that may be trained on), test_mask/<view>/<prompt>.png, where
<view> is a photo's name or the number of a test view (sorted by name). Every scene is mapped without its test views,
the instances a prompt selects are rendered with occlusion, and the masks are scored; what is finished is kept in
WORK, so that a second run goes on. A scene that fails scores 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from perception.bench.datasets import (
    InstanceViews,
    Workplace,
    add_arguments,
    by_reference,
    by_words,
    chosen_scenes,
    report,
    run_scenes,
    workplace,
    write_masks,
)
from perception.errors import InputError
from perception.evaluate.layouts import read_mask_folder, run_lerf_mask

RENDERED, SHARE = 0.2, 0.7  # Gaussian Grouping: rendered mask > 0.2; instances > 0.7 inside the reference mask
SELECTION = {
    "query": "the map's own words, top-1 whether or not it says present",
    "truth": "instances inside the TRUE mask of the first test view by > .7: tells segmentation apart from language",
    "reference": "instances inside a detector's mask of the first test view by > .7",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line entry point; see the module docstring."""
    parser = argparse.ArgumentParser(prog="perception bench lerf-mask", description=__doc__)
    add_arguments(parser)
    parser.add_argument(
        "--select", default="query", metavar="HOW", help="query, truth, or reference:DIR with <scene>/<prompt>.png"
    )
    parser.add_argument("--missing", choices=("zero", "skip"), default="zero")
    args = parser.parse_args(arguments)
    kind, _, folder = args.select.partition(":")
    if kind not in SELECTION or (kind == "reference") != bool(folder):
        raise InputError(f"--select is '{args.select}'; expected query, truth or reference:DIR")
    found = {path.parent.name: path.parent for path in sorted(args.dataset.glob("*/test_mask"))}
    if (args.dataset / "test_mask").is_dir():
        found = {args.dataset.name: args.dataset}
    if not found:
        raise InputError(f"{args.dataset}: holds no scenes; expected <scene>/test_mask/<view>/<prompt>.png")
    scenes = chosen_scenes(found, args.scenes, args.dataset)
    place = workplace(args)
    references = Path(folder) if folder else None

    def predict(name: str, scene: Path, target: Path) -> None:
        write_masks(target, predict_scene(place, name, scene, kind, references))

    failed = run_scenes(scenes, place, predict)
    (args.output / "predictions").mkdir(parents=True, exist_ok=True)
    switches = {
        "selection": SELECTION[kind],
        "rendered": f"with occlusion, > {RENDERED}",
        "test_views": "held out of training, unless the map was brought along",
    }
    truth = args.dataset if not args.scenes else _only(args, scenes)
    result, table = run_lerf_mask(args.output / "predictions", truth, missing=args.missing, **switches)
    report("lerf_mask", args, result, table, failed, scenes)


def _only(args: argparse.Namespace, scenes: dict[str, Path]) -> Path:
    """A folder of links to the ground truth of the given scenes."""
    from perception.bench.datasets import link

    folder: Path = args.output / "truth" / "+".join(scenes)
    for name, scene in scenes.items():
        link(scene / "test_mask", folder / name / "test_mask")
    return folder


def predict_scene(
    place: Workplace, name: str, scene: Path, select: str, references: Path | None
) -> dict[tuple[str, str], np.ndarray]:
    """{(view, prompt): bool mask [H, W]} of one scene. Views without a registered pose are absent."""
    truths = read_mask_folder(scene / "test_mask")
    tests = test_photos(scene, sorted({view for view, _ in truths}))
    shown = InstanceViews(place.map(name, scene, sorted(tests.values())))
    views = {label: shown.find(photo) for label, photo in tests.items()}
    first = next(((label, view) for label, view in sorted(views.items()) if view is not None), None)
    if first is None:
        raise InputError(f"{scene}: none of its test views {sorted(tests.values())} is registered in the map")
    ids = shown.ids(first[1]) if select != "query" else None
    masks = {}
    for prompt in sorted({prompt for _, prompt in truths}):
        if ids is None:
            chosen = by_words(shown.gmap, prompt, "top-1")
        else:
            reference = truths.get((first[0], prompt)) if references is None else _reference(references, name, prompt)
            chosen = [] if reference is None else by_reference(ids, reference > 128, SHARE)
        for label, view in views.items():
            if view is not None and (label, prompt) in truths:
                masks[label, prompt] = shown.silhouette(chosen, view, occlusion=True) > RENDERED
    return masks


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


def _reference(folder: Path, scene: str, prompt: str) -> np.ndarray | None:
    import cv2

    image = cv2.imread(str(folder / scene / f"{prompt}.png"), cv2.IMREAD_GRAYSCALE)
    return None if image is None else np.asarray(image)
