"""Photos by ray casting: analytic ray-surface intersections; the nearest surface gives the colour of a sample."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from worlds.cameras import Camera
from worlds.light import Body, Lamp, Part, corners
from worlds.shapes import to_local, to_world


@dataclass
class Picture:
    """rgb [H, W, 3] uint8; ids, parts [H, W] uint16: index of the visible body (from 1; 0 = none), its part (from 0);
    depth [H, W] float32 metres along the optical axis, inf = none."""

    rgb: np.ndarray
    ids: np.ndarray
    parts: np.ndarray
    depth: np.ndarray


def cast(bodies: list[Body], lamp: Lamp, camera: Camera, samples: int = 2) -> Picture:
    """A noise-free image with samples × samples rays per pixel. ids, parts and depth are reduced from the finer grid.
    lamp: the lamp that produces highlights."""
    height, width = camera.height * samples, camera.width * samples
    rotation = camera.camera_from_world[:3, :3]
    x = ((np.arange(width) + 0.5) / samples - camera.K[0, 2]) / camera.K[0, 0]
    y = ((np.arange(height) + 0.5) / samples - camera.K[1, 2]) / camera.K[1, 1]
    grid = np.stack([*np.meshgrid(x, y), np.ones((height, width))], -1)
    rays = (grid @ rotation).astype(np.float32)  # unit depth along the optical axis, so t equals the z-depth
    depth = np.full((height, width), np.inf, np.float32)
    seen = np.zeros((height, width), np.uint16)
    color = np.full((height, width, 3), 40, np.uint8)
    owners, places = [0], [0]  # of each part: number of its body, and its index there
    for number, body in enumerate(bodies, start=1):
        for place, part in enumerate(body.parts):
            owners.append(number)
            places.append(place)
            window = _window(part, camera, samples)
            if window is not None:
                images = (depth[window], seen[window], color[window])
                _paint(part, camera.center, lamp, len(owners) - 1, rays[window], images)
    rgb = cv2.resize(color, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    part_blocks, depth_blocks = _blocks(seen, samples), _blocks(depth, samples)
    id_blocks = np.array(owners, np.uint16)[part_blocks]
    # The second smallest of four ids is the majority wherever three agree. Most blocks hold one id only.
    middle, mean, parts = id_blocks[:, :, 0].copy(), depth_blocks.mean(-1), part_blocks[:, :, 0].copy()
    mixed = (id_blocks != middle[..., None]).any(-1)
    middle[mixed] = np.sort(id_blocks[mixed], -1)[:, (samples * samples - 1) // 2]
    same = id_blocks[mixed] == middle[mixed][:, None]
    mean[mixed] = np.where(same, depth_blocks[mixed], 0).sum(-1) / same.sum(-1)
    parts[mixed] = np.take_along_axis(part_blocks[mixed], same.argmax(-1)[:, None], -1)[:, 0]
    return Picture(rgb, middle, np.array(places, np.uint16)[parts], mean.astype(np.float32))


def _blocks(image: np.ndarray, samples: int) -> np.ndarray:
    height, width = image.shape[0] // samples, image.shape[1] // samples
    grid = image.reshape(height, samples, width, samples).transpose(0, 2, 1, 3)
    return grid.reshape(height, width, samples * samples)


def _window(part: Part, camera: Camera, samples: int) -> tuple[slice, slice] | None:
    """The window of the fine grid that contains the part, from its projected bounds; None = not visible."""
    world = to_world(part.shape, corners(part.shape))
    pixels, z = camera.project(world)
    if (z <= 0.02).all():
        return None
    if (z <= 0.02).any():  # partly behind the camera: projected bounds are invalid, use the frustum's sides
        local = world @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
        across = local[:, :2] * [camera.K[0, 0], camera.K[1, 1]] + local[:, 2:] * camera.K[:2, 2]
        beyond = local[:, 2:] * [camera.width, camera.height]
        hidden = (across < 0).all(0).any() or (across > beyond).all(0).any()
        return None if hidden else (slice(None), slice(None))
    low, high = np.floor(pixels.min(0) * samples).astype(int) - 1, np.ceil(pixels.max(0) * samples).astype(int) + 1
    low, high = np.maximum(low, 0), np.minimum(high, np.array([camera.width, camera.height]) * samples)
    return (slice(low[1], high[1]), slice(low[0], high[0])) if (high > low).all() else None


def _paint(
    part: Part, eye: np.ndarray, lamp: Lamp, number: int, rays: np.ndarray, images: tuple[np.ndarray, ...]
) -> None:
    """Intersects rays [h, w, 3] from `eye` with a part and shades the hits: updates depth, seen (with `number`) and
    color in place where the part is nearest."""
    depth, seen, color = images
    origin = to_local(part.shape, eye[None])[0].astype(np.float32)
    local = rays @ part.shape.rotation.astype(np.float32)
    t, u, v = part.shape.hit(np.broadcast_to(origin, local.shape), local)
    rows, columns = np.nonzero(t < depth)
    if not len(rows):
        return
    t, u, v = (array[rows, columns] for array in (t, u, v))
    height, width = part.lit.shape[:2]
    map_y = np.clip(v * height - 0.5, 0, height - 1).astype(np.float32)
    sampled = _sample(part.lit, (u * width - 0.5).astype(np.float32), map_y)
    depth[rows, columns] = t
    seen[rows, columns] = number
    if part.gloss:
        sampled = np.clip(sampled + _highlight(part, eye, lamp, u, v), 0, 255).astype(np.uint8)
    color[rows, columns] = sampled


def _highlight(part: Part, eye: np.ndarray, lamp: Lamp, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Blinn-Phong highlight of the lamp at chart coordinates [N], [N, 1] in 8-bit steps."""
    points, normals = part.shape.point_normal(u, v)
    points, normals = to_world(part.shape, points), normals @ part.shape.rotation.T
    half = sum((at - points) / np.linalg.norm(at - points, axis=1, keepdims=True) for at in (lamp.center, eye))
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return 110 * (part.gloss * np.maximum(np.einsum("nk,nk->n", half, normals), 0) ** 60)[:, None]


def _sample(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear lookup at [N] positions. OpenCV remaps at most 32767 rows, so the list is reshaped into a square."""
    side = int(np.ceil(np.sqrt(len(x))))
    map_x, map_y = (np.pad(a, (0, side * side - len(a))).reshape(side, side) for a in (x, y))
    return cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).reshape(-1, 3)[: len(x)]
