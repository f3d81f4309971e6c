"""Where the photographer stands: three arcs around the front of the table, at three heights, then closer
looks."""

from __future__ import annotations

import numpy as np

from perception.demo.render import Camera

FOCAL_35MM = 32  # written into the photos' EXIF


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[4, 4] camera_from_world of an upright camera at `eye` that looks at `target` (z up in the world)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose


def intrinsics(width: int, height: int) -> np.ndarray:
    """[3, 3] of a phone-like lens: 32 mm on a 36 mm wide frame."""
    focal = FOCAL_35MM / 36 * max(width, height)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def orbit(views: int, width: int, height: int) -> list[Camera]:
    """`views` cameras in the order they were taken, neighbours overlapping."""
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
            sway = 0.03 * np.sin(2.1 * i + k)  # nobody's hand draws a perfect circle
            eye = np.array([(radius + sway) * np.sin(angle), -(radius + sway) * np.cos(angle), lift + 0.6 * sway])
            target = np.array(aim) + np.array([0.12 * np.sin(angle) * (k == 2), 0, 0.4 * sway])
            cameras.append(Camera(intrinsics(width, height), look_at(eye, target), width, height))
    return cameras[:views]
