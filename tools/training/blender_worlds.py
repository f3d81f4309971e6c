"""Renders path-traced worlds of modelled things in Blender, to train the built-in masks on.

BLENDER tools/training/blender_worlds.py WORK MODELS

BLENDER is a Python 3.11 with PyPI's bpy 4.5.15 and numpy 1.26.4; MODELS has one folder for each unpacked .sh3f of
Debian's sweethome3d-furniture. By seed: tables and shelves full of small things, many almost touching, some alike, some
in a tray, rows of books, and furnished rooms from a robot's height. WORK/furnished_SEED gets images/, surface.npz
(triangles with ids) and cameras.json; `training.masks` makes the rest. 15 minutes of two cores with `--part 0 2` and
`--part 1 2` side by side.
"""

# Runs in Blender's environment: nothing of this project may be imported here.
from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from blender_looks import pattern, printed
from blender_scene import VIEWS, Scene

FIRST = 5000  # seed of the first world
LIBRARIES = ("BlendSwap-CC-0", "BlendSwap-CC-BY", "KatorLegaz", "Scopia")
ROOMS = ("Living room", "Kitchen", "Miscellaneous", "Bedroom", "Bathroom", "Office", "Lights")
LARGEST_FILE = 5e6  # bytes of a model
UNFIT = re.compile(
    r"plug|switch|socket|wall|ceiling|hanging|dispenser|hood|curtain|carpet|screen|fireplace|radiator|chimney|upper",
    re.I,
)
# Models of scenes that are kept for evaluation, by library
KEPT = {
    "BlendSwap-CC-0": "9 11 19 22 26 27 38 43 51 69 73 76 77 78 81 82 107 111 124 126 128 139 144 145 153 165 168 172",
    "BlendSwap-CC-BY": "2 9 25 27 55 58 69 75 82 93 99 102 106 118",
    "KatorLegaz": "55 65 67 72 80 84 85 90",
    "Scopia": "33 44 49 54 70 84 86 87 114 119 123 128 136 138 146 149 174 186 255 258 282 302 342 377 395",
}


def catalogue(models: Path) -> list[dict[str, Any]]:
    """Name, sizes in metres and file of each model that may be used."""
    found = []
    for library in LIBRARIES:
        entries: dict[int, dict[str, str]] = {}
        text = (models / library / "PluginFurnitureCatalog.properties").read_text(encoding="latin1")
        for key, number, value in re.findall(r"^(\w+)#(\d+)\s*=\s*(.*?)\s*$", text, re.M):
            entries.setdefault(int(number), {})[key] = value
        for number, entry in entries.items():
            file = models / library / entry["model"].lstrip("/")
            kept = str(number) in KEPT[library].split()
            fit = entry.get("category") in ROOMS and not UNFIT.search(entry["name"])
            if kept or not fit or not file.is_file() or file.suffix != ".obj" or file.stat().st_size > LARGEST_FILE:
                continue
            size = np.array([float(entry[side]) / 100 for side in ("width", "depth", "height")])
            rotation = entry.get("modelRotation", "1 0 0 0 1 0 0 0 1")
            turn = np.array([float(value) for value in rotation.split()]).reshape(3, 3)
            found.append({"name": f"{library}#{number} {entry['name']}", "size": size, "file": file, "turn": turn})
    return found


def shell(scene: Scene, wide: float, deep: float, high: float) -> None:
    """Floor, walls and ceiling, metres inside."""
    thick = 0.05
    plain = [pattern(scene.rng, size=0.3, contrast=scene.rng.uniform(0.05, 0.4)) for _ in range(2)]
    look = pattern(scene.rng, size=scene.rng.uniform(0.05, 0.5), contrast=scene.rng.uniform(0.1, 0.8))
    scene.put(scene.box((wide, deep, thick), look), "floor", (0, 0, -thick))
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        size = (thick, deep, high) if x else (wide, thick, high)
        where = (x * (wide + thick) / 2, y * (deep + thick) / 2, 0)
        scene.put(scene.box(size, plain[0 if k else 1]), f"wall {k}", where)
    scene.put(scene.box((wide, deep, thick), pattern(scene.rng, 1)), "ceiling", (0, 0, high))


def pictures(scene: Scene, count: int, wide: float, deep: float) -> None:
    for _ in range(count):
        x, y = [(1, 0), (-1, 0), (0, 1), (0, -1)][scene.rng.integers(4)]
        w, h, along = scene.rng.uniform(0.25, 0.9), scene.rng.uniform(0.25, 0.7), scene.rng.uniform(-0.35, 0.35)
        size = (0.02, w, h) if x else (w, 0.02, h)
        at = (x * (wide / 2 - 0.011) + y * along * wide, y * (deep / 2 - 0.011) + x * along * deep)
        low, high = np.array(at) - np.array(size[:2]) / 2, np.array(at) + np.array(size[:2]) / 2
        clear = all(
            (low > t["high"][:2]).any() or (high < t["low"][:2]).any() for t in scene.things if "picture" in t["name"]
        )
        if clear:
            scene.put(scene.box(size, printed(scene.rng)), "picture", (*at, scene.rng.uniform(1.0, 1.6)))


def table(scene: Scene) -> None:
    shell(scene, 4, 4, 2.6)
    pictures(scene, 3, 4, 4)
    wide, deep, high = scene.rng.uniform([0.8, 0.6, 0.6], [1.6, 0.9, 0.8])
    thick = 0.03
    wood = pattern(scene.rng, size=scene.rng.uniform(0.03, 0.2), contrast=scene.rng.uniform(0.1, 0.9))
    parts = [(scene.box((wide, deep, thick), wood), (0, 0, high - thick))]
    for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        parts.append((scene.box((0.05, 0.05, high - thick), wood), (x * (wide / 2 - 0.04), y * (deep / 2 - 0.04), 0)))
    scene.put(scene.union(parts), "table top", (0, 0, 0))
    far = np.array([wide / 2, deep / 2]) - 0.02
    low = -far
    if scene.rng.uniform() < 0.4:  # a tray at one end
        size = scene.rng.uniform([0.2, 0.2, 0.03], [0.35, 0.35, 0.09])
        centre = np.array([low[0] + size[0] / 2, scene.rng.uniform(-0.1, 0.1)])
        scene.put(tray(scene, size), "tray", (*centre, high + 1e-3))
        inner = size[:2] / 2 - 0.015
        scene.scatter(6, centre - inner, centre + inner, high + 0.008, 0.2)
        low = np.array([low[0] + size[0] + 0.005, low[1]])
    scene.scatter(int(scene.rng.integers(10, 24)), low, far, high, 0.45)
    scene.around((0, 0, high), (0.8, 1.6), (0.2, 0.9))


def tray(scene: Scene, size: np.ndarray) -> Any:
    look, thin = pattern(scene.rng), 0.006
    parts = [(scene.box((size[0], size[1], thin), look), (0, 0, 0))]
    for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        side = (thin, size[1], size[2]) if x else (size[0], thin, size[2])
        parts.append((scene.box(side, look), (x * (size[0] - thin) / 2, y * (size[1] - thin) / 2, 0)))
    return scene.union(parts)


def shelf(scene: Scene) -> None:
    shell(scene, 4, 4, 2.6)
    pictures(scene, 2, 4, 4)
    wide, deep = scene.rng.uniform([0.6, 0.24], [1.3, 0.42])
    levels, thick = int(scene.rng.integers(2, 5)), 0.02
    gap = scene.rng.uniform(0.22, 0.36)
    look = pattern(scene.rng, size=0.1, contrast=scene.rng.uniform(0.05, 0.8))
    high = levels * (gap + thick) + thick
    base = scene.rng.uniform(0, 0.6)
    parts = [(scene.box((wide, deep, thick), look), (0, 0, k * (gap + thick))) for k in range(levels + 1)]
    parts += [(scene.box((thick, deep, high), look), (x * (wide + thick) / 2, 0, 0)) for x in (-1, 1)]
    if scene.rng.uniform() < 0.7:
        parts.append((scene.box((wide, 0.01, high), look), (0, deep / 2 + 0.005, 0)))
    back = 2 - deep / 2 - 0.02
    scene.put(scene.union(parts), "shelf", (0, back, base))
    for k in range(levels + 1):
        z, free = base + k * (gap + thick) + thick, gap if k < levels else 0.4
        low = np.array([-wide / 2 + 0.01, back - deep / 2 + 0.01])
        far = np.array([wide / 2 - 0.01, back + deep / 2 - 0.02])
        if k < levels and scene.rng.uniform() < 0.4:
            low[0] = books(scene, low, far, z, free)
        scene.scatter(int(scene.rng.integers(4, 12)), low, far, z, free)
    scene.scatter(3, (-1.5, 0.8), (1.5, 1.4), 0, 0.5)
    scene.around((0, back - deep / 2, base + high / 2), (0.9, 1.7), (-0.15, 0.5), front=True)


def books(scene: Scene, low: np.ndarray, high: np.ndarray, z: float, free: float) -> float:
    """A row of upright books from the left; its end."""
    x = float(low[0])
    for _ in range(scene.rng.integers(3, 14)):
        size = scene.rng.uniform([0.012, 0.5, 0.6], [0.05, 0.95, 0.95]) * [1, (high - low)[1], free]
        if x + size[0] > high[0]:
            break
        scene.put(scene.box(size, printed(scene.rng)), "book", (x + size[0] / 2, low[1] + size[1] / 2 + 0.01, z + 2e-4))
        x += size[0] + 3e-4
    return x + 0.01


def room(scene: Scene) -> None:
    wide, deep = scene.rng.uniform(3, 4.6, 2)
    shell(scene, wide, deep, 2.6)
    pictures(scene, 5, wide, deep)
    taken: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(14):
        entry = scene.of_size(0.45, 2.2)
        quarter = int(scene.rng.integers(4))
        half = entry["size"][[0, 1]] / 2 if quarter % 2 == 0 else entry["size"][[1, 0]] / 2
        for _ in range(30):
            spot = scene.rng.uniform(-1, 1, 2) * (np.array([wide, deep]) / 2 - half - 0.03)
            if scene.rng.uniform() < 0.7:  # along a wall
                axis = scene.rng.integers(2)
                spot[axis] = scene.rng.choice([-1, 1]) * (np.array([wide, deep]) / 2 - half - 0.03)[axis]
            fits = (2 * half < np.array([wide, deep]) - 0.1).all()
            if fits and not any((spot - half < b + 0.02).all() and (spot + half > a - 0.02).all() for a, b in taken):
                taken.append((spot - half, spot + half))
                drop = 2.5 - entry["size"][2]
                made = scene.put(scene.model(entry), entry["name"], (*spot, 0), quarter * math.pi / 2, drop)
                top = float(made["high"][2])
                if 0.3 < top < 1.2 and half.min() > 0.15:
                    count = int(scene.rng.integers(0, 6))
                    scene.scatter(count, spot - 0.7 * half, spot + 0.7 * half, top, 0.5)
                break
    for _ in range(VIEWS[1]):
        for _ in range(200):
            eye = np.array([*(scene.rng.uniform(-0.47, 0.47, 2) * [wide, deep]), scene.rng.uniform(0.4, 1.7)])
            aim = scene.rng.uniform(-0.45, 0.45, 2) * [wide, deep]
            if scene.look(eye, np.array([*aim, scene.rng.uniform(0.1, 1.1)]), 0.5):
                break


def worlds(work: Path, models: list[dict[str, Any]], seeds: Sequence[int]) -> Iterator[Path]:
    for seed in seeds:
        folder = work / f"furnished_{seed}"
        if not (folder / "cameras.json").is_file():
            (folder / "images").mkdir(parents=True, exist_ok=True)
            scene = Scene(seed, models)
            (table, shelf, room)[seed % 3](scene)
            scene.render(folder)
        yield folder


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, metavar="WORK")
    parser.add_argument("models", type=Path, metavar="MODELS", help="one folder for each unpacked .sh3f")
    parser.add_argument("--worlds", type=int, default=56, metavar="N")
    parser.add_argument(
        "--part", type=int, nargs=2, default=(0, 1), metavar=("K", "N"), help="every N-th world from the K-th on"
    )
    options = parser.parse_args(arguments)
    seeds = range(FIRST, FIRST + options.worlds)[options.part[0] :: options.part[1]]
    for folder in worlds(options.work, catalogue(options.models), seeds):
        print(folder, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
