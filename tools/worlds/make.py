"""Writes a made scene with exact truth, or the scene that the package ships for `perception demo`.

python tools worlds.make tabletop|room|trifles FOLDER [--seed N]
python tools worlds.make shipped perception/demo_scene
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from worlds import DemoTruth, make_photos


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", choices=("tabletop", "room", "trifles", "shipped"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="another N makes another scene")
    given = parser.parse_args()
    if given.folder.exists() and any(given.folder.iterdir()):
        parser.error(f"{given.folder} is not empty")
    if given.scene == "shipped":
        ship(given.folder)
        return
    truth = make_photos(given.folder / "images", scene=given.scene, seed=given.seed, truth_folder=given.folder)
    counts = f"{len(truth.names)} photos, {len(truth.instances)} instances, {len(truth.queries)} prompts"
    print(f"{counts} in {given.folder}")


def ship(folder: Path) -> None:
    """The tabletop of seed 0: its photos, and what scoring needs of its truth."""
    import tempfile

    with tempfile.TemporaryDirectory() as aside:
        write_truth(folder, make_photos(folder / "photos", truth_folder=Path(aside)))


def write_truth(folder: Path, truth: DemoTruth) -> None:
    """truth.json and truth.npz, as `pipeline.demo` reads them."""
    facts = {
        "asked": truth.asked,
        "queries": [[text, ids] for text, ids in truth.queries],
        "instances": {instance.id: instance.name for instance in truth.instances},
        "centres": {name: camera.center.tolist() for name, camera in zip(truth.names, truth.cameras, strict=True)},
    }
    (folder / "truth.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    np.savez_compressed(
        folder / "truth.npz",
        points=truth.points,
        normals=truth.normals,
        colors=truth.colors,
        instance_ids=truth.instance_ids.astype(np.uint8),
    )


if __name__ == "__main__":
    main()
