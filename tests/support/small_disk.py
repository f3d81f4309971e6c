"""What every writer does on a disk that is full or read-only, in a mount namespace of its own; prints JSON.

unshare -rm python small_disk.py DISK MAP      (DISK: an empty folder, MAP: a map to work with)
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.edit.editor import Editor
from perception.errors import InputError
from perception.export.export_map import ExportOptions, export_map
from perception.map.write import read_map, set_labels, verify_map, write_map
from perception.masks.label_files import write_labels
from perception.photos.scene_file import save_scene
from perception.pipeline.checkpoint import save_checkpoint
from perception.types import Scene

DONE = "done"
ROOMS = (0, 4, 24, 96)
"""KiB that are left free, one after another."""


def writers(disk: Path) -> dict[str, Callable[[], Any]]:
    """What is tried, by name. Each writes more than one page of the disk."""
    path, gmap = disk / "a.gsmap", read_map(disk / "a.gsmap")
    edited = Editor(path)
    edited.rename(gmap.instances[1]["id"], "renamed")
    scene = Scene([], np.zeros((3000, 3)), np.zeros((3000, 3), np.uint8), False, "f", {"left_out": ["x" * 9000]})
    state = {"values": torch.arange(20_000)}
    return {
        "write_map": lambda: write_map(path, gmap),
        "labels": lambda: set_labels(path, {gmap.instances[0]["id"]: "a name"}),
        "editor": edited.save,
        "export": lambda: export_map(path, disk / "out.ply", None, ExportOptions()),
        "checkpoint": lambda: save_checkpoint(disk / "checkpoint.pt", state, "mark"),
        "scene": lambda: save_scene(disk / "scene", scene),
        "masks": lambda: write_labels(disk / "m.png", np.random.default_rng(0).integers(0, 9, (200, 200))),
    }


def attempt(disk: Path, write: Callable[[], Any]) -> str:
    """What the writer said, or "done"; the map must open with all its checksums afterwards, and nothing lie about."""
    try:
        write()
        said = DONE
    except InputError as error:
        said = str(error)
    read_map(disk / "a.gsmap")
    assert set(verify_map(disk / "a.gsmap").values()) == {"ok"}
    aside = [str(file) for file in disk.rglob(".*")]
    assert not aside, aside
    return said


def main() -> None:
    disk, original = Path(sys.argv[1]), Path(sys.argv[2])
    told: dict[str, dict[str, str]] = {}
    for name in list(_fresh(disk, original)):
        told[name] = {}
        for room in ROOMS:
            write = _fresh(disk, original)[name]
            ballast = disk / "ballast"
            ballast.write_bytes(bytes(max(0, shutil.disk_usage(disk).free - room * 1024)))
            told[name][f"{room} KiB"] = attempt(disk, write)
            ballast.unlink()
            told[name][f"after {room} KiB"] = attempt(disk, write)
        write = _fresh(disk, original)[name]
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        told[name]["read-only"] = attempt(disk, write)
        subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
    print(json.dumps(told))


def _fresh(disk: Path, original: Path) -> dict[str, Callable[[], Any]]:
    """A new disk of 8 MiB with the map on it, and the writers."""
    subprocess.run(["umount", str(disk)], check=False, capture_output=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)], check=True)
    shutil.copytree(original, disk / "a.gsmap")
    return writers(disk)


if __name__ == "__main__":
    main()
