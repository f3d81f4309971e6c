"""Materials by chance for `blender_worlds`: procedural patterns and printed pictures."""

# Runs in Blender's environment: nothing of this project may be imported here.
from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np


def colour_of(rng: np.random.Generator) -> tuple[float, ...]:
    hue, value = rng.uniform(0, 1), rng.uniform(0.05, 0.9)
    saturation = rng.choice([0, 0.3, 0.8]) * rng.uniform(0.3, 1)
    rgb = [value * (1 - saturation * (0.5 - 0.5 * math.cos(2 * math.pi * (hue + k / 3)))) for k in range(3)]
    return (*rgb, 1.0)


def pattern(rng: np.random.Generator, colours: int = 2, size: float = 0.1, contrast: float = 1.0) -> Any:
    """A procedural pattern of two colours. size: of its features, metres."""
    material = bpy.data.materials.new("pattern")
    material.use_nodes = True
    tree = material.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = float(rng.uniform(0.25, 0.9))
    shader.inputs["Metallic"].default_value = float(rng.uniform() < 0.05)
    base = np.array(colour_of(rng))
    if colours == 1:
        shader.inputs["Base Color"].default_value = base
        return material
    kind = rng.choice(["Noise", "Wave", "Voronoi", "Checker", "Brick", "Magic"], p=[0.4, 0.25, 0.1, 0.1, 0.1, 0.05])
    texture = tree.nodes.new(f"ShaderNodeTex{kind}")
    texture.inputs["Scale"].default_value = float(rng.uniform(0.5, 2) / size)
    if kind in ("Noise", "Wave"):
        texture.inputs["Detail"].default_value = 6
        texture.inputs["Distortion"].default_value = float(rng.uniform(0, 6))
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.35, 0.65
    ramp.color_ramp.elements[0].color = base
    ramp.color_ramp.elements[1].color = base + contrast * (np.array(colour_of(rng)) - base)
    place = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(place.outputs["Object"], texture.inputs["Vector"])
    values = next(out for out in texture.outputs if out.name in ("Fac", "Distance", "Color"))
    tree.links.new(values, ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    return material


def printed(rng: np.random.Generator) -> Any:
    """A material with a printed picture: fields, lines as of text, a disc."""
    side = 96
    picture = np.ones((side, side, 4), np.float32) * np.array(colour_of(rng))
    for _ in range(rng.integers(2, 6)):
        a, b = np.sort(rng.integers(0, side, (2, 2)), axis=0)
        picture[a[0] : b[0] + 1, a[1] : b[1] + 1] = colour_of(rng)
    rows, columns = np.mgrid[:side, :side]
    centre, radius = rng.integers(20, 76, 2), rng.integers(5, 25)
    picture[(rows - centre[0]) ** 2 + (columns - centre[1]) ** 2 < radius**2] = colour_of(rng)
    ink, left = colour_of(rng), rng.integers(4, 40)
    for row in range(int(rng.integers(5, 60)), side - 6, int(rng.integers(5, 12))):
        words = np.repeat(rng.uniform(size=side // 3 + 1) < 0.75, 3)[:side]
        line = (columns[0] > left) & (columns[0] < side - 6) & words
        picture[row : row + 3, line] = ink
    image = bpy.data.images.new("print", side, side)
    image.pixels.foreach_set(picture.astype(np.float32).ravel())
    image.pack()
    material = bpy.data.materials.new("print")
    material.use_nodes = True
    tree = material.node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = float(rng.uniform(0.2, 0.8))
    tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    return material
