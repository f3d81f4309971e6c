"""Which way is up in a finished Gaussian scene, which has no cameras that were held level."""

from __future__ import annotations

import numpy as np

from perception.errors import InputError
from perception.frame.gravity import Gravity

LEVEL = np.cos(np.radians(12))
"""Cosine of the angle up to which a surface is parallel to a plane."""
FLAT = 8
"""Power of the mean normal's length with which a voxel counts: 0.6 of one whose normals are off by 20°."""
LOWER, WALLS = 0.3, 0.06
"""Weight of where things stand against the open side; share of the scene's extent, at each end of its main directions,
that is left out of them as walls, floor and ceiling."""
USUAL, NEAR = 0.1, np.cos(np.radians(15))
"""Evidence for a direction near one that files have up, and the cosine of the angle that is near."""
CONE = np.cos(np.radians(40))
"""Cosine of the angle around a direction in which rays are counted that see nothing."""
GUESSED, FOUND, LEAST = 20.0, 2.0, 0.12
"""Standard error in degrees of a direction taken from the file's convention, and of one found; its least evidence."""


def direction(text: str) -> np.ndarray:
    """The unit vector [3] of x, -y, +z, …, or of three numbers with commas between them."""
    axis = text.strip().lower().lstrip("+-")
    try:
        if axis in ("x", "y", "z"):
            return np.eye(3)["xyz".index(axis)] * (-1 if text.strip().startswith("-") else 1)
        vector = np.array([float(part) for part in text.split(",")])
        if vector.shape == (3,) and np.isfinite(vector).all() and (length := float(np.linalg.norm(vector))) > 0:
            return np.asarray(vector / length)
    except ValueError:
        pass
    raise InputError(f"--up: found '{text}', expected an axis such as z or -y, or three numbers such as 0,-0.9,0.1")


def gravity_of(normals: np.ndarray, means: np.ndarray, open_rays: np.ndarray, rays: np.ndarray) -> Gravity:
    """Which way is down. normals [V, 3]: of the surface's voxels, of length 0 to 1 as they are flat, towards the free
    space from which they are seen; means [N, 3]: of the Gaussians; open_rays [R]: share of the places from which the
    ray of direction rays [R, 3] hits nothing. Candidates are the normals of the main planes.

    A candidate u has the evidence O + LOWER A + U: O the share of open rays within CONE of u, less that around −u; A
    the share of the Gaussians between the walls that lie in the lower half of the heights, less one half; U is USUAL
    for one of the directions that files have up. Photos seldom show the sky or a ceiling, and things stand on floors.
    """
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    convention = np.array([0.0, -1.0, 0.0])
    length = np.linalg.norm(normals, axis=1)
    found = [(0.0, convention)]
    main = planes(normals / np.maximum(length, 1e-300)[:, None], length**FLAT)
    inner = np.ones(len(means), bool)
    for plane in main[:3]:
        low, high = np.quantile(means @ plane, [0.01, 0.99])
        inner &= np.abs(means @ plane - (low + high) / 2) < (0.5 - WALLS) * (high - low)
    things = means[inner] if inner.mean() > 0.02 else means
    for up in (sign * plane for plane in main for sign in (1.0, -1.0)):
        opened = float(open_rays[rays @ up > CONE].mean() - open_rays[rays @ up < -CONE].mean())
        low, high = np.quantile(means @ up, [0.01, 0.99])
        lower = float(np.mean(things @ up < (low + high) / 2)) - 0.5
        usual = USUAL if max(-up[1], up[1], up[2]) > NEAR else 0.0
        found.append((opened + LOWER * lower + usual, up))
    best, up = max(found, key=lambda each: each[0])
    if best < LEAST:
        return Gravity(-convention, GUESSED, "the usual axes of such files, as none was found; --up gives it")
    return Gravity(-up, FOUND, f"the planes and the open side of the scene (evidence {best:.2f})")


def planes(normals: np.ndarray, areas: np.ndarray, most: int = 6) -> list[np.ndarray]:
    """The main directions [3] of normals [M, 3], of either sign, weighted by areas [M], largest first."""
    normals, left, found = normals[areas > 0], areas[areas > 0], list[np.ndarray]()
    trial, least = normals[np.argsort(-left, kind="stable")[:400]], 0.05 * left.sum()
    while len(found) < most and left.sum() > least:
        start = max(trial, key=lambda one: float(left[np.abs(normals @ one) > LEVEL].sum()))
        for _ in range(5):
            cosine = normals @ start
            weights = left * (np.abs(cosine) > LEVEL) * np.sign(cosine)
            if not weights.any():
                return found
            start = (weights[:, None] * normals).sum(axis=0)
            start = start / np.linalg.norm(start)
        found.append(start)
        left[np.abs(normals @ start) > LEVEL] = 0
    return found
