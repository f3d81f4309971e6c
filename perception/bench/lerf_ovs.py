"""LERF-OVS, 3D selection (OpenGaussian's protocol), from the downloaded folder to the table:
`perception bench lerf-ovs DIR -o WORK`.

DIR/<scene>: images/ and sparse/0; DIR/label/<scene>/frame_*.json: polygons by category. Every scene is mapped
without its labelled frames, the Gaussians a category selects are rendered, and the silhouettes are scored; what is
finished is kept in WORK, so that a second run goes on. A scene that fails scores 0.
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
    by_words,
    chosen_scenes,
    link,
    report,
    run_scenes,
    workplace,
    write_masks,
)
from perception.errors import InputError
from perception.evaluate.layouts import read_lerf_polygons, run_lerf_ovs

SELECTION = {
    "top-1": "top-1 by the map's own words: best instance whether or not it says present",
    "relative": "relative by the map's own words: all instances >= .85 of the best score after shifting the least to 0",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line entry point; see the module docstring."""
    parser = argparse.ArgumentParser(prog="perception bench lerf-ovs", description=__doc__)
    add_arguments(parser)
    parser.add_argument("--select", choices=tuple(SELECTION), default="top-1")
    parser.add_argument("--occlusion", action="store_true", help="render with the other Gaussians in front")
    parser.add_argument("--train-on-test", action="store_true", help="labelled frames are trained on, as LangSplat")
    args = parser.parse_args(arguments)
    labels = args.dataset / "label"
    found = {path.name: path for path in sorted(labels.iterdir()) if path.is_dir()} if labels.is_dir() else {}
    if not found:
        raise InputError(f"{args.dataset}: holds no labels; expected label/<scene>/frame_*.json")
    scenes = chosen_scenes(found, args.scenes, args.dataset)
    place = workplace(args)

    def predict(name: str, label: Path, target: Path) -> None:
        source = args.dataset / name
        held = not args.train_on_test
        write_masks(target, predict_scene(place, name, source, label, args.select, args.occlusion, held))

    failed = run_scenes(scenes, place, predict)
    (args.output / "predictions").mkdir(parents=True, exist_ok=True)
    truth = args.dataset
    if args.scenes:
        truth = args.output / "truth" / "+".join(scenes)
        for name, label in scenes.items():
            link(label, truth / "label" / name)
    switches = {
        "selection": SELECTION[args.select],
        "occlusion": "on" if args.occlusion else "off",
        "test_views": "trained on" if args.train_on_test else "held out of training, unless the map was brought along",
    }
    result, table = run_lerf_ovs(args.output / "predictions", truth, **switches)
    report("lerf_ovs", args, result, table, failed, scenes)


def predict_scene(
    place: Workplace, name: str, source: Path, label: Path, select: str, occlusion: bool, held_out: bool
) -> dict[tuple[str, str], np.ndarray]:
    """{(frame, category): silhouette [H, W] in [0, 1]} of one scene. Frames without a registered pose are absent."""
    if not source.is_dir():
        raise InputError(f"{source}: no such folder; expected the scene's images/ and sparse/ there")
    truths = read_lerf_polygons(label)
    frames = sorted({frame for frame, _ in truths})
    shown = InstanceViews(place.map(name, source, frames if held_out else []))
    selected = {prompt: by_words(shown.gmap, prompt, select) for prompt in sorted({prompt for _, prompt in truths})}
    masks = {}
    for frame, prompt in truths:
        view = shown.find(frame)
        if view is not None:
            masks[frame, prompt] = shown.silhouette(selected[prompt], view, occlusion)
    return masks
