"""Measurements of a scene's unit in metres, by depth images and GPS, each with a standard error; their combination."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import align_similarity, camera_centres
from perception.photos.decode import GPS_FOLDER, exif_of, open_photo
from perception.photos.depth import load_depth
from perception.photos.lens import load_pycolmap
from perception.types import View

LARGEST_ERROR = 0.2
"""Relative standard error above which a measurement is not used."""
LEAST_POINTS, MOST_POINTS = 20, 200  # of a view, whose depth is compared
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


def jackknife_error(each: np.ndarray) -> float:
    """Standard error of an estimate, from its values `each` [n] without one of n observations:
    √((n − 1) / n · Σ (each − mean)²) (Efron 1982, The Jackknife, equation 3.2)."""
    return float(np.sqrt((len(each) - 1) / len(each) * ((each - each.mean()) ** 2).sum()))


def combined(found: Sequence[Measurement]) -> tuple[Measurement | None, list[str]]:
    """The mean weighted by inverse variance, and warnings; the most precise one where they contradict each other.
    Two measurements contradict each other when they differ by more than three standard errors of the difference."""
    if not found:
        return None, []
    logs, errors = np.log([m.metres for m in found]), np.array([m.standard_error / m.metres for m in found])
    best = int(errors.argmin())
    for other in range(len(found)):
        if abs(logs[other] - logs[best]) > 3 * np.hypot(errors[other], errors[best]):
            both = f"{found[best]} and {found[other]}"
            return found[best], [f"the unit is {both}, which contradict each other; the first is used"]
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
    rows = rng.permutation(np.flatnonzero(inside))[:MOST_POINTS]
    if len(rows) < LEAST_POINTS:
        return np.empty(0)
    x, y = pixels[rows].astype(np.int64).T
    measured = load_depth(view, view.width, view.height)[y, x].astype(np.float64)
    return np.log(measured[measured > 0] / local[rows[measured > 0], 2])


@dataclass(frozen=True)
class KnownLength:
    """A length in metres between two ends: instances by name, map points [2, 3], or pixels [2, 2] of photos."""

    metres: float
    names: tuple[str, str] | None = None
    points: np.ndarray | None = None
    pixels: dict[str, np.ndarray] | None = None


_NUMBER = r"[-+.\deE]+"
_POINTS = re.compile(rf"({_NUMBER},{_NUMBER},{_NUMBER})\s+({_NUMBER},{_NUMBER},{_NUMBER})")
_PIXEL = re.compile(f"{_NUMBER},{_NUMBER}")


def known_length(text: str) -> KnownLength:
    """Reads "METRES: A, B" (labels or ids), "METRES: X,Y,Z X,Y,Z" or "METRES: PHOTO X,Y X,Y; PHOTO X,Y X,Y"."""
    expected = 'expected "METRES: LABEL, LABEL", "METRES: X,Y,Z X,Y,Z" or "METRES: PHOTO X,Y X,Y; PHOTO X,Y X,Y"'
    length, _, rest = (part.strip() for part in text.partition(":"))
    entries = [entry.rsplit(maxsplit=2) for entry in rest.split(";") if entry.strip()]
    names = [name.strip() for name in rest.split(",")]
    try:
        if np.isnan(metres := float(length)):
            raise ValueError("its length is no number")
        if ends := _POINTS.fullmatch(rest):
            found = KnownLength(metres, points=_finite([ends[1], ends[2]]))
        elif entries and all(len(e) == 3 and all(map(_PIXEL.fullmatch, e[1:])) for e in entries):
            found = KnownLength(metres, pixels={photo.strip(): _finite(pair) for photo, *pair in entries})
        elif len(names) == 2 and all(names) and ";" not in rest:
            found = KnownLength(metres, names=(names[0], names[1]))
        else:
            raise ValueError("its ends are no two names, points or pixels")
    except ValueError as error:
        raise InputError(f"known length: found '{text}', {expected} ({error})") from error
    if not 0 < metres < np.inf:
        raise InputError(f"known length: found {metres:g} m, expected a length above 0")
    return found


def _finite(ends: list[str]) -> np.ndarray:
    values = np.array([[float(x) for x in end.split(",")] for end in ends])
    if not np.isfinite(values).all() or np.array_equal(values[0], values[1]):
        raise ValueError("its ends must be two different points of finite numbers")
    return values


LEAST = 6  # photos with a position
_LATITUDE, _LONGITUDE, _ALTITUDE = 1, 3, 5  # EXIF tags; the values follow the references


def photo_position(photo: Path) -> np.ndarray | None:
    """Latitude and longitude in degrees and altitude in metres [3] from EXIF; None without them or out of range."""
    try:
        with open_photo(photo) as image:
            tags = exif_of(image, photo, GPS_FOLDER)
        angles = []
        for tag, negative in ((_LATITUDE, "S"), (_LONGITUDE, "W")):
            degrees, minutes, seconds = (float(x) for x in tags[tag + 1])
            angle = degrees + minutes / 60 + seconds / 3600
            angles.append(-angle if str(tags[tag]).strip("\0 ").upper() == negative else angle)
        below = tags.get(_ALTITUDE) in (1, b"\x01")
        position = np.array([*angles, float(tags[_ALTITUDE + 1]) * (-1 if below else 1)])
    except Exception:  # damaged tags raise errors of many classes
        return None
    latitude, longitude, _ = position
    known = np.isfinite(position).all() and abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude or longitude)
    return position if known else None


def earth_positions(positions: np.ndarray) -> np.ndarray:
    """Metres [N, 3] from the first of positions [N, 3] (WGS84 degrees and metres), in axes fixed to the Earth."""
    metres = np.asarray(load_pycolmap().GPSTransform().ellipsoid_to_ecef(positions))
    return metres - metres[0]


def scale_of_gps(views: Sequence[View], seed: int = 0) -> tuple[Measurement | None, list[str]]:
    """Metres per unit from the photos' GPS positions, and notes; None with too few, or of too large an error."""
    known = [(view, position) for view in views if (position := photo_position(view.photo)) is not None]
    if len(known) < LEAST:
        return None, []
    centres = camera_centres(np.stack([view.camera_from_world for view, _ in known]))
    return scale_of_positions(centres, earth_positions(np.stack([position for _, position in known])), seed)


def scale_of_positions(centres: np.ndarray, metres: np.ndarray, seed: int = 0) -> tuple[Measurement | None, list[str]]:
    """Metres per unit from camera centres [N, 3] and their measured positions [N, 3] with outliers, and notes.
    The similarity metres = s R centres + t of least median residual over triples (LMedS) is refined on its inliers. The
    standard error is a jackknife estimate over photos. An error that all photos share is not part of it."""
    inside = _inliers(centres, metres, np.random.default_rng(seed))
    count = int(inside.sum())
    if count < LEAST:
        return None, [f"the GPS positions of {len(centres)} photos do not fit their poses and are not used"]
    a, b = metres[inside], centres[inside]
    scale = align_similarity(a, b)[0]
    each = np.array([align_similarity(np.delete(a, i, axis=0), np.delete(b, i, axis=0))[0] for i in range(count)])
    error = jackknife_error(each)
    if not (scale > 0 and error / scale <= LARGEST_ERROR):
        return None, [f"GPS is too coarse for the way the camera went ({count} photos) and is not used"]
    left = f", {len(centres) - count} outliers left out" if count < len(centres) else ""
    return Measurement(scale, error, f"GPS of {count} photos{left}"), []


def _inliers(centres: np.ndarray, metres: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[N] bool: positions within three robust deviations of the best similarity."""

    def residuals(rows: np.ndarray) -> np.ndarray:
        scale, rotation, shift = align_similarity(metres[rows], centres[rows])
        return np.asarray(np.linalg.norm(metres - (scale * centres @ rotation.T + shift), axis=1))

    best = np.full(len(centres), np.inf)
    for _ in range(500):
        rows = rng.choice(len(centres), 4, replace=False)
        if np.ptp(centres[rows], axis=0).max() > 0:
            found = residuals(rows)
            best = found if np.median(found) < np.median(best) else best
    inside = best <= np.median(best)
    for _ in range(20):
        if not np.isfinite(best).any() or np.ptp(centres[inside], axis=0).max() == 0:
            return np.zeros(len(centres), bool)
        found = residuals(np.flatnonzero(inside))
        deviation = float(np.median(found)) / 1.538  # the median length of a 3D normal vector
        now = found <= 3.4 * deviation + 1e-9 * float(np.ptp(metres, axis=0).max())  # 99 % of such vectors
        if np.array_equal(now, inside):
            break
        inside = now
    return inside
