"""Camera trajectories of the demo scenes: arcs around the front of a table, and a walk through a room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from support.aimed import look_at

UP = np.array([0, 0, 1.0])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: K [3, 3] pixels (centres at +0.5), camera_from_world [4, 4] (x right, y down, z forward)."""

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


def intrinsics(width: int, height: int, focal_35mm: float) -> np.ndarray:
    """K [3, 3] in pixels for a focal length in 35 mm equivalent (36 mm frame width along the longer side)."""
    focal = focal_35mm / 36 * max(width, height)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def orbit(views: int, width: int, height: int, focal_35mm: float) -> list[Camera]:
    """`views` cameras on three arcs around the front of a table, in capture order. Neighbouring views overlap."""
    K = intrinsics(width, height, focal_35mm)
    arcs = [  # (share of the views, half the swing in degrees, radius, height, aim)
        (0.36, 82.0, 0.98, 0.42, (0.0, 0.02, 0.05)),
        (0.34, 74.0, 0.86, 0.70, (0.0, 0.0, 0.0)),
        (0.30, 64.0, 0.62, 0.34, (0.0, 0.0, 0.05)),
    ]
    counts = [max(1, round(share * views)) for share, *_ in arcs[:-1]]
    counts.append(max(views - sum(counts), 0))
    cameras: list[Camera] = []
    for k, ((_, swing, radius, lift, aim), count) in enumerate(zip(arcs, counts, strict=True)):
        angles = np.radians(np.linspace(-swing, swing, count) if count > 1 else np.zeros(count))
        for i, angle in enumerate(angles[:: -1 if k % 2 else 1]):
            sway = 0.03 * np.sin(2.1 * i + k)  # deviation from the circle, as in hand-held capture
            eye = np.array([(radius + sway) * np.sin(angle), -(radius + sway) * np.cos(angle), lift + 0.6 * sway])
            target = np.array(aim) + np.array([0.12 * np.sin(angle) * (k == 2), 0, 0.4 * sway])
            cameras.append(Camera(K, look_at(eye, target, UP), width, height))
    return cameras[:views]


def walk(views: int, width: int, height: int, focal_35mm: float, half: np.ndarray) -> list[Camera]:
    """`views` cameras at 1.2 to 1.6 m height in a room with half extents `half` [2] in metres, on three rounds: looking
    across the room, close to the walls, and down at the furniture."""
    K = intrinsics(width, height, focal_35mm)
    rounds = [  # (share of the views, eye position from centre 0 to wall 1, eye height, target position, target height)
        (0.40, 0.46, 1.45, -0.75, 0.75),
        (0.36, 0.20, 1.30, 1.00, 0.95),
        (0.24, 0.42, 1.58, 0.85, 0.25),
    ]
    counts = [round(share * views) for share, *_ in rounds[:-1]]
    counts.append(views - sum(counts))
    cameras = []
    for k, ((_, out, lift, aim, level), count) in enumerate(zip(rounds, counts, strict=True)):
        for i in range(count):
            angle = 2 * np.pi * (i + 0.35 * k) / max(count, 1)
            heading = np.array([np.cos(angle), np.sin(angle)])
            sway = 0.04 * np.sin(2.1 * i + k)  # deviation from the ellipse, as in hand-held capture
            eye = np.array([*(out + sway) * half * heading, lift + 0.8 * sway])
            across = angle + 0.25 * np.sin(3 * angle + k)  # varies the heading left and right
            target = np.array([*aim * half * [np.cos(across), np.sin(across)], level + 2 * sway])
            cameras.append(Camera(K, look_at(eye, target, UP), width, height))
    return cameras
