"""The unit of a scene from the GPS positions in the EXIF data of its photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.frame.scale import LARGEST_ERROR, Measurement
from perception.geometry import align_similarity, camera_centres
from perception.io.lens import load_pycolmap
from perception.io.photos import DECODE_ERRORS, exif_of, open_photo
from perception.types import View

LEAST = 6  # photos with a position
_GPS_FOLDER, _LATITUDE, _LONGITUDE, _ALTITUDE = 0x8825, 1, 3, 5  # EXIF tags; the values follow the references


def photo_position(photo: Path) -> np.ndarray | None:
    """Latitude and longitude in degrees and altitude in metres [3] from EXIF; None without them or out of range."""
    try:
        with open_photo(photo) as image:
            tags = exif_of(image, photo).get_ifd(_GPS_FOLDER)
        angles = []
        for tag, negative in ((_LATITUDE, "S"), (_LONGITUDE, "W")):
            degrees, minutes, seconds = (float(x) for x in tags[tag + 1])
            angle = degrees + minutes / 60 + seconds / 3600
            angles.append(-angle if str(tags[tag]).strip("\0 ").upper() == negative else angle)
        below = tags.get(_ALTITUDE) in (1, b"\x01")
        place = np.array([*angles, float(tags[_ALTITUDE + 1]) * (-1 if below else 1)])
    except (InputError, *DECODE_ERRORS):
        return None
    known = np.isfinite(place).all() and abs(place[0]) <= 90 and abs(place[1]) <= 180 and place[:2].any()
    return place if known else None


def earth_positions(places: np.ndarray) -> np.ndarray:
    """Metres [N, 3] from the first of places [N, 3] (WGS84 degrees and metres), in axes fixed to the Earth."""
    metres = np.asarray(load_pycolmap().GPSTransform().ellipsoid_to_ecef(places))
    return metres - metres[0]


def scale_of_gps(views: Sequence[View], seed: int = 0) -> tuple[Measurement | None, list[str]]:
    """Metres per unit from the photos' GPS positions, and notes; None with too few, or of too large an error."""
    places = [photo_position(view.photo) for view in views]
    rows = [row for row, place in enumerate(places) if place is not None]
    if len(rows) < LEAST:
        return None, []
    centres = camera_centres(np.stack([views[row].camera_from_world for row in rows]))
    return scale_of_positions(centres, earth_positions(np.stack([p for p in places if p is not None])), seed)


def scale_of_positions(centres: np.ndarray, metres: np.ndarray, seed: int = 0) -> tuple[Measurement | None, list[str]]:
    """Metres per unit from camera centres [N, 3] and their measured positions [N, 3] with outliers, and notes.

    The similarity metres = s R centres + t of least median residual over triples (LMedS) is refined on its inliers.
    The standard error is a jackknife estimate: the scale is computed once for each photo that is left out, and their
    spread gives the error. An error that all photos share is not part of it.
    """
    inside = _inliers(centres, metres, np.random.default_rng(seed))
    count = int(inside.sum())
    if count < LEAST:
        return None, [f"the GPS positions of {len(centres)} photos do not fit their poses and are not used"]
    a, b = metres[inside], centres[inside]
    scale = align_similarity(a, b)[0]
    each = np.array([align_similarity(np.delete(a, i, axis=0), np.delete(b, i, axis=0))[0] for i in range(count)])
    error = float(np.sqrt((count - 1) / count * ((each - each.mean()) ** 2).sum()))
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
