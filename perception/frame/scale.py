"""Measurements of a scene's unit in metres, each with a standard error, and their combination."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.depth import load_depth
from perception.types import View

LARGEST_ERROR = 0.2
"""Relative standard error above which a measurement is not used."""
SHARE_OF_VIEW = 200  # points per view whose depth is compared
LEAST_POINTS = 20  # of a view whose depths are compared
SENSOR = 0.005
"""Relative standard error that all depths of a sensor have in common, by its calibration."""


@dataclass(frozen=True)
class Measurement:
    """metres: length of the scene's unit in metres. standard_error: of it, in metres. source: as text."""

    metres: float
    standard_error: float
    source: str

    def to_json(self) -> dict[str, Any]:
        return {"metres_per_unit": self.metres, "source": self.source, "standard_error": self.standard_error}

    def __str__(self) -> str:
        return f"{self.metres:.5g} ± {self.standard_error:.2g} m ({self.source})"


def combined(found: Sequence[Measurement]) -> tuple[Measurement | None, list[str]]:
    """The mean weighted by inverse variance, and warnings; the most precise one where they contradict each other.

    Two measurements contradict each other when they differ by more than three standard errors of the difference.
    """
    if not found:
        return None, []
    logs, errors = np.log([m.metres for m in found]), np.array([m.standard_error / m.metres for m in found])
    best = int(errors.argmin())
    for other in range(len(found)):
        if abs(logs[other] - logs[best]) > 3 * np.hypot(errors[other], errors[best]):
            return found[best], [
                f"the unit is {found[best]} and {found[other]}, which contradict each other; the first is used"
            ]
    if errors[best] == 0:
        return found[best], []
    weights = errors**-2
    metres = float(np.exp(weights @ logs / weights.sum()))
    error = metres / float(np.sqrt(weights.sum()))
    return Measurement(metres, error, "; ".join(m.source for m in found)), []


def scale_of_depth(views: Sequence[View], points: np.ndarray, seed: int = 0) -> Measurement | None:
    """Metres per unit from depth images (scale: metres) and scene points [P, 3]; None without enough of both.

    The ratio of the sensor's depth to a point's is the scale where the point is visible; hidden points give smaller
    ratios. The mode of all ratios is found first, then the median near it; the standard error is by bootstrap over
    views, and SENSOR.
    """
    rng = np.random.default_rng(seed)
    ratios = [r for r in (_depth_ratios(view, points, rng) for view in views if view.depth) if len(r) >= LEAST_POINTS]
    if len(ratios) < 3:
        return None
    everything = np.sort(np.concatenate(ratios))
    half = len(everything) // 4  # the densest quarter of the ratios surrounds the mode
    start = int((everything[half:] - everything[:-half]).argmin())
    mode = float(np.median(everything[start : start + half]))
    for _ in range(5):
        near = everything[np.abs(everything - mode) < 0.1]
        mode = float(np.median(near))
    medians = [float(np.median(r[np.abs(r - mode) < 0.1])) for r in ratios if (np.abs(r - mode) < 0.1).sum() >= 5]
    if len(medians) < 3:
        return None
    drawn = np.median(rng.choice(medians, (500, len(medians))), axis=1)
    metres = float(np.exp(np.median(medians)))
    return Measurement(metres, metres * float(np.hypot(drawn.std(), SENSOR)), f"depth images of {len(medians)} photos")


def _depth_ratios(view: View, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Logarithms of the ratio of measured depth to the depth of points that the view may see."""
    local = points @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (local @ view.K.T)[:, :2] / local[:, 2:]
    inside = (local[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < [view.width, view.height]).all(axis=1)
    rows = rng.permutation(np.flatnonzero(inside))[:SHARE_OF_VIEW]
    if len(rows) < LEAST_POINTS:
        return np.empty(0)
    x, y = pixels[rows].astype(np.int64).T
    measured = load_depth(view, view.width, view.height)[y, x].astype(np.float64)
    return np.log(measured[measured > 0] / local[rows[measured > 0], 2])


@dataclass(frozen=True)
class KnownLength:
    """A length in metres between two places: instances by name, map points [2, 3], or pixels [2, 2] of photos."""

    metres: float
    names: tuple[str, str] | None = None
    points: np.ndarray | None = None
    pixels: dict[str, np.ndarray] | None = None


_NUMBER = r"[-+.\deE]+"
_POINTS = re.compile(rf"({_NUMBER},{_NUMBER},{_NUMBER})\s+({_NUMBER},{_NUMBER},{_NUMBER})")
_PIXELS = re.compile(rf"(.+?)\s+({_NUMBER},{_NUMBER})\s+({_NUMBER},{_NUMBER})")


def known_length(text: str) -> KnownLength:
    """Reads "METRES: A, B" (labels or ids), "METRES: X,Y,Z X,Y,Z" or "METRES: PHOTO X,Y X,Y; PHOTO X,Y X,Y"."""
    expected = 'expected "METRES: LABEL, LABEL", "METRES: X,Y,Z X,Y,Z" or "METRES: PHOTO X,Y X,Y; PHOTO X,Y X,Y"'
    length, colon, rest = text.partition(":")
    try:
        metres = float(length)
    except ValueError:
        metres = np.nan
    if not (colon and rest.strip()) or np.isnan(metres):
        raise InputError(f"known length: found '{text}', {expected}")
    if not 0 < metres < np.inf:
        raise InputError(f"known length: found {metres:g} m, expected a length above 0")
    entries = [_PIXELS.fullmatch(entry.strip()) for entry in rest.split(";") if entry.strip()]
    try:
        if places := _POINTS.fullmatch(rest.strip()):
            return KnownLength(metres, points=_finite([places[1], places[2]]))
        if entries and all(entries):
            return KnownLength(metres, pixels={e[1]: _finite([e[2], e[3]]) for e in entries if e})
    except ValueError as error:
        raise InputError(f"known length: found '{text}', {expected} ({error})") from error
    names = [name.strip() for name in rest.split(",")]
    if len(names) != 2 or not all(names) or ";" in rest:
        raise InputError(f"known length: found '{text}', {expected}")
    return KnownLength(metres, names=(names[0], names[1]))


def _finite(places: list[str]) -> np.ndarray:
    values = np.array([[float(x) for x in place.split(",")] for place in places])
    if not np.isfinite(values).all() or np.array_equal(values[0], values[1]):
        raise ValueError("its ends must be two different places of finite numbers")
    return values
