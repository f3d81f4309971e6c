"""Counts what `perception update` calls changed in places where nothing changed.

python tools score.unchanged WORK SCENE ... [--stretch N] [--set KEY=VALUE ...]

SCENE: a folder with a transforms.json, of real photos too. Of its photos, by name, every other stretch of N (5) is the
visit; the map of the others is made in WORK with the built-in masks and without language, and kept. Everything that the
update says to have moved, gone or come is an error. A row for each scene, with the Gaussians that left, the PSNR of
held-out photos of the visit, and of those of the map, each in its own light, before and after the update.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.config import load_config
from perception.gaussians.model import as_gaussians
from perception.gaussians.views import render
from perception.map.checksums import is_map
from perception.map.write import Map, read_map
from perception.photos.decode import load_photo, scaled_K
from perception.pipeline.mapping import build_map
from perception.progress import Progress
from perception.visits.scene import update_settings
from perception.visits.update import update_map
from score.visits import kept

SETTINGS = ("masks=builtin", "language.encoder=none", "language.texts=off", "photos.max_side=480")
FILES = ("file_path", "mask_path", "depth_file_path", "ply_file_path")
"""Keys of transforms.json and of its frames that name files."""


def part(scene: Path, folder: Path, stretch: int, odd: bool) -> Path:
    """`folder` with a transforms.json of every other stretch of the photos of a scene."""
    data = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    frames = sorted(data["frames"], key=lambda frame: str(frame["file_path"]))
    chosen = [frame for n, frame in enumerate(frames) if (n // stretch) % 2 == odd]
    written = located({**data, "frames": [located(frame, scene) for frame in chosen]}, scene)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(written), encoding="utf-8")
    return folder


def located(entry: dict[str, Any], scene: Path) -> dict[str, Any]:
    """The entry with absolute paths."""
    return {key: str((scene / value).resolve()) if key in FILES else value for key, value in entry.items()}


def shown(gmap: Map) -> float:
    """Mean PSNR in dB of the held-out photos of visit 0, each with the brightness and hue that fit best."""
    gaussians, found = as_gaussians(gmap), []
    for view in (view for view in gmap.views if view.held_out and view.visit == 0):
        photo = torch.from_numpy(load_photo(view, gmap.setting("photos", "max_side", 480)) / 255.0)
        height, width = photo.shape[:2]
        pose, K = (
            torch.from_numpy(a.astype(np.float32)) for a in (view.camera_from_world, scaled_K(view, width, height))
        )
        image = render(gaussians, pose, K, width, height, harmonics=True).colors[0].double()
        light = (image * photo).sum(dim=(0, 1)) / (image * image).sum(dim=(0, 1))
        found.append(-10 * np.log10(float(((light * image - photo) ** 2).mean())))
    return float(np.mean(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--stretch", type=int, default=5)
    parser.add_argument("--set", action="append", default=[], dest="pairs")
    args = parser.parse_args()
    for scene in args.scenes:
        first, second = (part(scene, args.work / f"{scene.name}-{n}", args.stretch, bool(n)) for n in (0, 1))
        before, after = (args.work / f"{scene.name}{end}.gsmap" for end in ("", "-updated"))
        if not is_map(before):
            build_map(first, before, load_config(None, [*SETTINGS, *args.pairs]), progress=Progress())
        shutil.rmtree(after, ignore_errors=True)
        update_map(before, second, after, update_settings(before, None, []), progress=Progress())
        gmap, old = read_map(after), read_map(before)
        states = [entry["state"] for entry in gmap.instances]
        counts = ", ".join(f"{states.count(state)} {state}" for state in ("moved", "removed", "added", "unseen"))
        things = len(states) - states.count("added")
        views = f"{gmap.info['quality'].get('psnr', 0):.2f} dB, of the map {shown(old):.2f} and {shown(gmap):.2f} dB"
        left = f"{np.sum(~kept(old, gmap))} of {len(old)} Gaussians left"
        print(f"{scene.name}: {counts} of {things} instances; {left}; {views}", flush=True)


if __name__ == "__main__":
    main()
