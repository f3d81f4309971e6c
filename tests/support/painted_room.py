"""A box room with painted walls in closed form: photos by ray casting with exact poses, and its depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from perception.map.write import write_map
from perception.photos.view_json import stored_view
from perception.types import View
from support.aimed import look_at
from support.viewer_maps import small_map

SIDES = np.array([4.0, 3.0, 2.4])
SIZE = (400, 300)
FOCAL = 300.0
PIXELS = 220
"""Of paint in a metre."""
K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])


class PaintedRoom:
    """seed: of the paint. Walls 2 a, 2 a + 1 lie at the low and high end of axis a. same: pairs of opposite walls that
    look the same from inside; bare: walls without paint."""

    def __init__(self, seed: int, same: tuple[tuple[int, int], ...] = (), bare: tuple[int, ...] = ()) -> None:
        rng = np.random.default_rng(seed)
        self.paint = [_paint(rng, np.delete(SIDES, wall // 2)) for wall in range(6)]
        for one, other in same:
            self.paint[other] = np.ascontiguousarray(self.paint[one][:, ::-1])
        for wall in bare:
            self.paint[wall] = np.full_like(self.paint[wall], 128)

    def photo(self, pose: np.ndarray, K: np.ndarray = K, size: tuple[int, int] = SIZE) -> tuple[np.ndarray, np.ndarray]:
        """[h, w, 3] uint8, and the depth [h, w] along the axis in metres, of camera_from_world."""
        x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1) @ pose[:3, :3]
        center = -pose[:3, :3].T @ pose[:3, 3]
        with np.errstate(divide="ignore"):
            ends = (np.where(rays > 0, SIDES, 0) - center) / rays
        depth, axis = ends.min(axis=-1), ends.argmin(axis=-1)
        hit, image = center + rays * depth[..., None], np.zeros((*depth.shape, 3), np.uint8)
        for wall, paint in enumerate(self.paint):
            mine = (axis == wall // 2) & ((rays > 0).astype(int) == wall % 2)[..., wall // 2]
            u, v = (np.delete(hit, wall // 2, axis=-1) * PIXELS - 0.5).astype(np.float32).transpose(2, 0, 1)
            image[mine] = cv2.remap(paint, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[mine]
        return image, depth

    def view(self, folder: Path, name: str, pose: np.ndarray) -> View:
        """A photo written to `folder`, and its view."""
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), self.photo(pose)[0][..., ::-1])
        return View(name, folder / name, K, *SIZE, pose)


def _paint(rng: np.random.Generator, sides: np.ndarray) -> np.ndarray:
    """[u, v] as image rows v: blots of all sizes, smooth enough to be seen without aliasing."""
    width, height = np.ceil(sides * PIXELS).astype(int)
    image = np.zeros((height, width, 3), np.float32)
    for cell, strength in ((64, 1.0), (24, 1.0), (10, 1.0)):
        grid = rng.normal(size=(height // cell + 2, width // cell + 2, 3)).astype(np.float32)
        image += strength * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * image, 0, 255).astype(np.uint8)


def pose_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """camera_from_world of a camera at `eye` that looks at `target`, upright."""
    return look_at(np.array(eye), np.array(target), np.array([0, 0, 1.0]))


def walk(wall: int, count: int, shift: float = 0.0) -> list[np.ndarray]:
    """Cameras that walk along a wall of axis 0 or 1, 2 m before it, and look at it."""
    axis, high = divmod(wall, 2)
    poses = []
    for share in np.linspace(0.2, 0.8, count):
        eye, target = SIDES * share, SIDES * (0.3 + 0.4 * share)
        eye[axis] = (SIDES[axis] - 2.0 + shift) if high else 2.0 - shift
        target[axis] = SIDES[axis] * high
        eye[2], target[2] = 1.2 + 0.4 * (share - 0.5) + shift, 1.2
        poses.append(pose_at(tuple(eye), tuple(target)))
    return poses


def difference(pose: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Distance of two cameras, and the angle between their axes in degrees."""
    centers = [-each[:3, :3].T @ each[:3, 3] for each in (pose, truth)]
    turn = pose[:3, :3] @ truth[:3, :3].T
    angle = np.degrees(np.arctan2(np.linalg.norm(turn - turn.T) / np.sqrt(8), (np.trace(turn) - 1) / 2))
    return float(np.linalg.norm(centers[0] - centers[1])), float(angle)


def write_room_map(path: Path, room: PaintedRoom, poses: list[np.ndarray], photos: Path) -> Path:
    """A map of Gaussians before wall 1, whose views have their photos in the folder `photos`."""
    gmap = small_map()
    gmap.means = (0.3 * gmap.means[:, [2, 0, 1]] + (1.5, 1.5, 1.2)).astype(np.float32)
    gmap.views = [stored_view(room.view(photos, f"{n}.png", pose), path) for n, pose in enumerate(poses)]
    write_map(path, gmap)
    return path
