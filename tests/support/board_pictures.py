"""Pictures of a calibration board taken by a camera that is known exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from perception.calibration.board import Board

_PER_SQUARE, _MARGIN = 60, 30  # texture pixels
_SAMPLES = 2  # a side, within a pixel


@dataclass(frozen=True)
class KnownCamera:
    """model and values as in `solve.NAMES`; size (width, height)."""

    model: str
    values: np.ndarray
    size: tuple[int, int]

    @cached_property
    def rays(self) -> np.ndarray:
        """Directions [H * s, W * s, 2] (x / z, y / z) that s × s samples of every pixel see; NaN beyond the lens."""
        width, height = self.size
        across, down = ((np.arange(n * _SAMPLES) + 0.5) / _SAMPLES - 0.5 for n in (width, height))
        local = (np.stack(np.meshgrid(across, down), axis=-1) - self.values[2:4]) / self.values[:2]
        if self.model == "pinhole":
            return self._undistorted(local)
        radius = np.linalg.norm(local, axis=-1)
        angle = self._angle(radius)
        with np.errstate(divide="ignore", invalid="ignore"):
            stretch = np.where(radius > 0, np.tan(angle) / radius, 1.0)
        return np.where((angle < np.radians(80))[..., None], local * stretch[..., None], np.nan)

    def _undistorted(self, local: np.ndarray) -> np.ndarray:
        """The x, y that plumb_bob takes to `local` [..., 2], by fixed-point iteration (for mild distortion)."""
        k1, k2, p1, p2, k3 = self.values[4:]
        x, y = local[..., 0], local[..., 1]
        for _ in range(25):
            squared = x * x + y * y
            radial = 1 + squared * (k1 + squared * (k2 + squared * k3))
            dx = 2 * p1 * x * y + p2 * (squared + 2 * x * x)
            dy = p1 * (squared + 2 * y * y) + 2 * p2 * x * y
            x, y = (local[..., 0] - dx) / radial, (local[..., 1] - dy) / radial
        return np.stack([x, y], axis=-1)

    def _angle(self, radius: np.ndarray) -> np.ndarray:
        """θ of r = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), by table (steps of 1e-4 rad, linear between)."""
        angles = np.arange(0, np.radians(89), 1e-4)
        squared = angles**2
        k1, k2, k3, k4 = self.values[4:]
        radii = angles * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))
        rising = np.concatenate(([True], np.diff(radii) > 0)).cumprod().astype(bool)
        return np.interp(radius, radii[rising], angles[rising], right=np.pi)


def board_views(board: Board, camera: KnownCamera, count: int, seed: int = 0, reach: float = 0.8) -> list[np.ndarray]:
    """Poses camera_from_board [6] that put the board all over the picture, tilted up to 45 degrees to all sides.

    reach: share of the picture over which the board's middle wanders; the board is cut by the picture's edge then.
    """
    rng = np.random.default_rng(seed)
    columns, rows = board.squares
    middle = np.array([columns, rows, 0]) * board.square / 2
    rays = camera.rays
    poses = []
    for number in range(count):
        tilt = np.radians(rng.uniform(15, 45)) * np.array([np.cos(2.4 * number), np.sin(2.4 * number), 0])
        rotation = cv2.Rodrigues(tilt)[0] @ cv2.Rodrigues(np.array([0, 0, rng.uniform(-0.4, 0.4)]))[0]
        # The board's middle goes to a place of the picture that moves over a 3 x 3 grid.
        place = (np.array([number % 3, number // 3 % 3]) + 0.5 + rng.uniform(-0.2, 0.2, 2)) / 3
        place = 0.5 + (place - 0.5) * reach
        y, x = (place[::-1] * rays.shape[:2]).astype(int)
        ray = rays[y, x]
        ray = ray if np.isfinite(ray).all() else rays[rays.shape[0] // 2, rays.shape[1] // 2]
        span = np.linalg.norm(middle) * 2
        field = 2 * np.nanmax(np.abs(rays[rays.shape[0] // 2, :, 0]))
        distance = span / min(field, 2.2) * rng.uniform(1.2, 1.7)
        center = np.array([*ray, 1.0]) / np.linalg.norm([*ray, 1.0]) * distance
        poses.append(np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), center - rotation @ middle]))
    return poses


def board_texture(board: Board, per_square: int = 60, margin: int = 30) -> np.ndarray:
    """The board as an image [H, W] uint8. Its top left square starts `margin` pixels from the image corner."""
    columns, rows = board.squares
    if board.kind == "charuco":
        size = (columns * per_square + 2 * margin, rows * per_square + 2 * margin)
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
        printed = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, words)
        return np.asarray(printed.generateImage(size, None, margin))
    cells = (np.add.outer(np.arange(rows), np.arange(columns)) % 2 * 255).astype(np.uint8)
    return np.pad(np.kron(cells, np.ones((per_square, per_square), np.uint8)), margin, constant_values=255)


def render_board(board: Board, camera: KnownCamera, pose: np.ndarray, seed: int = 0, noise: float = 2.0) -> np.ndarray:
    """The board on grey as the camera sees it [H, W] uint8, lit unevenly, with Gaussian noise (grey levels)."""
    rng = np.random.default_rng(seed)
    texture = board_texture(board, _PER_SQUARE, _MARGIN)
    rotation = cv2.Rodrigues(pose[:3])[0]
    # Where the ray (u, v, 1) meets the board: solve [r1 r2 -ray] (x, y, depth) = -t.
    to_board = np.linalg.inv(np.column_stack([rotation[:, 0], rotation[:, 1], pose[3:]]))
    rays = camera.rays
    hit = rays @ to_board[:, :2].T + to_board[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        at = hit[..., :2] / hit[..., 2:] / board.square * _PER_SQUARE + _MARGIN - 0.5
    at[~(hit[..., 2] > 0)] = -1e4
    at = np.nan_to_num(at, nan=-1e4).clip(-1e4, 3e4).astype(np.float32)
    sampled = cv2.remap(
        texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110
    )
    height, width = camera.size[1], camera.size[0]
    picture = sampled.reshape(height, _SAMPLES, width, _SAMPLES).astype(np.float32).mean(axis=(1, 3))
    slope = np.linspace(0.85, 1.0, width)[None] * np.linspace(1.0, 0.9, height)[:, None]
    picture = 20 + 0.8 * picture * slope + rng.normal(0, noise, picture.shape)
    return np.clip(picture.round(), 0, 255).astype(np.uint8)
