"""Scores the instances of a map in the photos of a scene whose things are masked there.

python tools score.photos SCENE MAP

Of each thing of SCENE/scene.json ("things": {ID: NAME}): the largest IoU that one instance of the map, or one of its
parts, has with SCENE/masks_gt/STEM.png (ID; 0 = anything else) over the pixels of all photos. And what map.json has of
held-out photos, depth, poses that were refined, and pixels that stay in the picture.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from perception.export.render import as_gaussians
from perception.instances.silhouettes import render_silhouettes
from perception.io.documents import read_json
from perception.map.map import Map
from perception.map.write import read_map
from perception.masks.label_folder import LabelFolder


def overlaps(gmap: Map, ids: np.ndarray, truths: LabelFolder, things: list[int]) -> np.ndarray:
    """IoU [T, K] of true things with the instances `ids` [N] of the map, of pixels pooled over its views."""
    count, gaussians = int(ids.max(initial=0)) + 1, as_gaussians(gmap)
    both, true, found = np.zeros((len(things), count)), np.zeros((len(things), 1)), np.zeros(count)
    for view in gmap.views:
        pose, K = (torch.from_numpy(array.astype(np.float32)) for array in (view.camera_from_world, view.K))
        shown = render_silhouettes(gaussians, [ids], pose, K, view.width, view.height)[0].ids
        truth = truths.label_image(view, shown)
        found += np.bincount(shown[shown >= 0], minlength=count)
        for row, thing in enumerate(things):
            inside = shown[truth == thing]
            true[row] += len(inside)
            both[row] += np.bincount(inside[inside >= 0], minlength=count)
    return np.asarray(both / np.maximum(true + found - both, 1))


def main() -> None:
    """Prints a line for each thing, and one for each fact of the map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("map", type=Path)
    options = parser.parse_args()
    gmap, named = read_map(options.map), read_json(options.scene / "scene.json")["things"]
    levels = [gmap.instance_ids, *([gmap.parts["ids"]] if gmap.parts else [])]
    truths = LabelFolder(options.scene / "masks_gt")
    scores = [overlaps(gmap, ids, truths, [int(thing) for thing in named]) for ids in levels]
    for row, (thing, name) in enumerate(named.items()):
        print(f"{thing:>5} {name:20} IoU {max(float(score[row].max()) for score in scores):.3f}")
    quality, scene = gmap.info["quality"], gmap.info["scene"]
    facts = {key: quality.get(key) for key in ("psnr", "ssim", "depth")} | {"poses": scene.get("poses")}
    still = scene.get("still")
    facts["still"] = still and {key: still[key] for key in ("photos", "share")}
    print(*(f"{key}: {value}" for key, value in facts.items()), sep="\n")


if __name__ == "__main__":
    main()
