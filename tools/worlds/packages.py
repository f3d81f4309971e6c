"""Writes a scene of printed words with exact truth.

python tools worlds.packages FOLDER [SEED] [VIEWS]

A table with packages, tins and books that bear words: across, downwards, around a tin, on a spine, partly hidden. Seeds
select places and turns. The folder then holds what tools/worlds/make.py writes; scene.json has 20 prompts
with a word in capitals, and as `absent` six whose words are on nothing. `python tools score.queries MAP FOLDER`
scores them on a map of FOLDER/transforms.json.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from worlds import scene, things
from worlds.cameras import orbit
from worlds.light import Body, Scene, bake_all
from worlds.shapes import placed, spin
from worlds.tabletop import FOCAL_35MM, LIGHTING, POINTS, VIEWS, room_around, spots

__all__ = ["FOCAL_35MM", "POINTS", "VIEWS", "build"]

CARTONS: dict[str, tuple[things.Printed, str]] = {
    word: ((color, name, word, extent), prompt)
    for word, color, name, extent, prompt in (
        ("OATS", "#d9782d", "cereal box", (0.125, 0.055, 0.19), "the box that says OATS"),
        ("MILK", "#2d6fb0", "milk carton", (0.075, 0.075, 0.18), "carton with the word MILK"),
        ("RICE", "#a83246", "rice box", (0.11, 0.05, 0.16), "the box that says RICE"),
        ("SALT", "#3f7d5c", "salt box", (0.10, 0.06, 0.12), "the box that says SALT"),
        ("BUTTER", "#5b4a9c", "butter box", (0.07, 0.07, 0.15), "package labelled BUTTER"),
        ("BISCUITS", "#7a3b1d", "biscuit box", (0.09, 0.06, 0.22), "the box that says BISCUITS"),
        ("BATTERIES", "#2b2f36", "battery box", (0.08, 0.05, 0.20), "the box of BATTERIES"),
    )
}
ABSENT = [
    "the box that says SOAP", "tin labelled TUNA", "book titled GARDENS", "bottle with the word VINEGAR",
    "the book that says BOATS", "package with the word FLOUR",
]  # fmt: skip
STANDING = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # turns a lying book onto its lower edge


def make_packages(
    folder: Path, seed: int = 0, views: int = 32, width: int = 640, height: int = 480, rays: int = 12
) -> None:
    """Writes the photos and truth of a scene; see `make_photos`. rays: per texel of the light maps."""
    scene.SCENES["packages"] = sys.modules[__name__]
    options = {"views": views, "width": width, "height": height, "light_samples": rays}
    scene.make_photos(folder / "images", scene="packages", seed=seed, truth_folder=folder, **options)
    path = folder / "scene.json"
    truth = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**truth, "absent": ABSENT}, indent=1), encoding="utf-8")
    path = folder / "transforms.json"
    frames = json.loads(path.read_text(encoding="utf-8"))
    for frame in frames["frames"]:  # so that built-in masks can be scored without stereo
        frame["depth_file_path"] = f"depth/{Path(frame['file_path']).stem}.png"
    path.write_text(json.dumps(frames), encoding="utf-8")


def build(seed: int, light_samples: int = 20) -> Scene:
    """The painted and lit scene. light_samples: rays per texel of the light maps."""
    rng = np.random.default_rng((seed, 40))
    bodies = packages(rng) + room_around(rng, seed != 0)
    bake_all(bodies, LIGHTING, rng, light_samples)
    return Scene(bodies, LIGHTING, partial(orbit, focal_35mm=FOCAL_35MM), [])


def packages(rng: np.random.Generator) -> list[Body]:
    """The things on the table, with their prompts."""
    row = [_book(rng, "red book", "the book that says EMBERS OF AUTUMN", "book titled EMBERS")]
    row.append(_book(rng, "yellow book", "book titled BREAD AND SALT", "the cook book that says BREAD"))
    for k, book in enumerate(row):  # standing side by side, the spines to the front
        shift = np.array([0.038 * k, 0, 0.1025])
        parts = [replace(part, shape=placed(part.shape, spin(90) @ STANDING, shift)) for part in book.parts]
        row[k] = replace(book, parts=parts)
    cover = _book(rng, "blue book", "the book that says OCEANS", "atlas titled OCEANS")
    cocoa = _asked(things.tin(rng, "cocoa tin", "COCOA"), 'the tin that reads "COCOA"')
    groups = [  # radius of the footprint, bodies about the origin
        (0.135, [cover, cocoa.placed(0, np.array([0.04, -0.06, 0.036]))]),  # the tin hides the end of the title
        (0.130, [_book(rng, "green book", "book titled BIRDS", "the book labelled BIRDS OF THE NORTH")]),
        (0.110, row),
        *((0.075, [_asked(things.carton(rng, printed), prompt)]) for printed, prompt in CARTONS.values()),
        (0.040, [_asked(things.tin(rng, "rice tin", "RICE"), "the tin that says RICE", "something labelled RICE")]),
        (0.040, [_asked(things.tin(rng, "pea tin", "CHICKPEAS"), "the tin labelled CHICKPEAS")]),
        (0.040, [_asked(things.bottle(rng, "oil bottle", "#5d6b2a", "OLIVE OIL"), "bottle that says OLIVE OIL")]),
    ]
    bodies = []
    for (_, group), spot in zip(groups, spots(rng, [radius for radius, _ in groups]), strict=True):
        turn = rng.uniform(-60, 60)
        bodies += [body.placed(turn, np.array([*spot, 0.0])) for body in group if spot is not None]
    for body in bodies:
        if body.name == "rice box":  # RICE is on the box and on the tin
            body.prompts.append("something labelled RICE")
    return bodies


def _asked(body: Body, *prompts: str) -> Body:
    return replace(body, prompts=[*body.prompts, *prompts])


def _book(rng: np.random.Generator, name: str, *prompts: str) -> Body:
    return _asked(things.book(rng, name), *prompts)


if __name__ == "__main__":
    make_packages(Path(sys.argv[1]), *(int(number) for number in sys.argv[2:]))
