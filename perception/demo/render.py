"""Photos by ray casting: every surface is hit analytically, the nearest one colours the sample."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.demo.light import LAMP_CENTER, Body, Part, corners
from perception.demo.shapes import to_local, to_world


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: K [3, 3] pixels (centres at +0.5), camera_from_world [4, 4] (x right, y down, z
    forward)."""

    K: np.ndarray
    camera_from_world: np.ndarray
    width: int
    height: int

    @property
    def center(self) -> np.ndarray:
        rotation = self.camera_from_world[:3, :3]
        return -rotation.T @ self.camera_from_world[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points [N, 3] -> pixels [N, 2], depth [N] along the optical axis."""
        local = points @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            return (local @ self.K.T)[:, :2] / local[:, 2:], local[:, 2]


@dataclass
class Picture:
    """rgb [H, W, 3] uint8; ids [H, W] uint16, 0 = nothing; depth [H, W] float32 along the optical axis, inf
    = nothing."""

    rgb: np.ndarray
    ids: np.ndarray
    depth: np.ndarray


def cast(bodies: list[Body], camera: Camera, samples: int = 2) -> Picture:
    """A noise-free picture with samples × samples rays a pixel; ids and depth at the finer grid are
    reduced."""
    height, width = camera.height * samples, camera.width * samples
    rotation = camera.camera_from_world[:3, :3]
    x = ((np.arange(width) + 0.5) / samples - camera.K[0, 2]) / camera.K[0, 0]
    y = ((np.arange(height) + 0.5) / samples - camera.K[1, 2]) / camera.K[1, 1]
    grid = np.stack([*np.meshgrid(x, y), np.ones((height, width))], -1)
    rays = (grid @ rotation).astype(np.float32)  # unit depth along the optical axis: t is the z-depth
    depth = np.full((height, width), np.inf, np.float32)
    ids = np.zeros((height, width), np.uint16)
    color = np.full((height, width, 3), 40, np.uint8)
    for body in bodies:
        for part in body.parts:
            window = _window(part, camera, samples)
            if window is not None:
                _paint(part, body.id, camera.center, rays[window], depth[window], ids[window], color[window])
    rgb = cv2.resize(color, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    id_blocks, depth_blocks = _blocks(ids, samples), _blocks(depth, samples)
    # The second smallest of four ids is the majority wherever three agree; most blocks hold one id only.
    middle, mean = id_blocks[:, :, 0].copy(), depth_blocks.mean(-1)
    mixed = (id_blocks != middle[..., None]).any(-1)
    middle[mixed] = np.sort(id_blocks[mixed], -1)[:, (samples * samples - 1) // 2]
    same = id_blocks[mixed] == middle[mixed][:, None]
    mean[mixed] = np.where(same, depth_blocks[mixed], 0).sum(-1) / same.sum(-1)
    return Picture(rgb, middle, mean.astype(np.float32))


def _blocks(image: np.ndarray, samples: int) -> np.ndarray:
    height, width = image.shape[0] // samples, image.shape[1] // samples
    grid = image.reshape(height, samples, width, samples).transpose(0, 2, 1, 3)
    return grid.reshape(height, width, samples * samples)


def _window(part: Part, camera: Camera, samples: int) -> tuple[slice, slice] | None:
    """The part of the fine grid where the part can be seen, from its projected bounds; None = out of
    sight."""
    pixels, z = camera.project(to_world(part.shape, corners(part.shape)))
    if (z <= 0.02).all():
        return None
    if (z <= 0.02).any():  # reaches behind the camera: projected bounds mean nothing
        return slice(None), slice(None)
    low, high = (
        np.floor(pixels.min(0) * samples).astype(int) - 1,
        np.ceil(pixels.max(0) * samples).astype(int) + 1,
    )
    low, high = np.maximum(low, 0), np.minimum(high, np.array([camera.width, camera.height]) * samples)
    return (slice(low[1], high[1]), slice(low[0], high[0])) if (high > low).all() else None


# type: ignore[no-untyped-def]
def _paint(
    part: Part,
    id: int,
    eye: np.ndarray,
    rays: np.ndarray,
    depth: np.ndarray,
    ids: np.ndarray,
    color: np.ndarray,
) -> None:
    """Casts the rays [h, w, 3] of a window at one part and writes where it is nearest (depth, ids, color in
    place)."""
    shape = part.shape
    origin = to_local(shape, eye[None])[0].astype(np.float32)
    local = rays @ shape.rotation.astype(np.float32)
    t, u, v = shape.hit(np.broadcast_to(origin, local.shape), local)
    rows, columns = np.nonzero(t < depth)
    if not len(rows):
        return
    t, u, v = (array[rows, columns] for array in (t, u, v))
    height, width = part.lit.shape[:2]
    map_x = (u * width - 0.5).astype(np.float32)
    map_y = np.clip(v * height - 0.5, 0, height - 1).astype(np.float32)
    sampled = _sample(part.lit, map_x, map_y)
    if part.gloss:
        sampled = _add_highlight(part, sampled, u, v, eye)
    depth[rows, columns] = t
    ids[rows, columns] = id
    color[rows, columns] = sampled


def _sample(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear lookup at [N] positions. OpenCV remaps at most 32767 rows, so the list is folded into a
    square."""
    side = int(np.ceil(np.sqrt(len(x))))
    map_x, map_y = (np.pad(a, (0, side * side - len(a))).reshape(side, side) for a in (x, y))
    return cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).reshape(-1, 3)[: len(x)]


def _add_highlight(part: Part, sampled: np.ndarray, u: np.ndarray, v: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Blinn-Phong gleam of the lamp, only where the baked light says that the lamp is seen."""
    points, normals = part.shape.point_normal(u, v)
    points, normals = to_world(part.shape, points), normals @ part.shape.rotation.T
    to_lamp, to_eye = LAMP_CENTER - points, eye - points
    half = to_lamp / np.linalg.norm(to_lamp, axis=1, keepdims=True)
    half += to_eye / np.linalg.norm(to_eye, axis=1, keepdims=True)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    gleam = part.gloss * np.maximum(np.einsum("nk,nk->n", half, normals), 0) ** 60
    return np.clip(sampled + 110 * gleam[:, None], 0, 255).astype(np.uint8)
