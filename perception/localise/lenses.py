"""The lens of a photo to be localised: given, of the map, or by EXIF; others near it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from perception.localise.pose import GUESSED, KNOWN, LIKELY
from perception.photos.decode import CAMERA_FOLDER, exif_of, open_photo, photo_size
from perception.photos.lens import camera_from_lens, rescale_lens, same_aspect
from perception.photos.views import view_lens
from perception.types import Lens, View

SAME_FOCAL = 0.15
"""Largest relative difference of a photo's focal length in EXIF from that of the map's camera of the same size, for the
map's camera to be taken: EXIF states nominal values."""
USUAL_FOCAL = 1.2
"""Focal length of an unknown camera to start from, in long sides of the picture, as COLMAP takes it."""
OWN, OTHER = (0.02, 0.01), (0.3, 0.1)
"""Standard errors of the focal length of a lens that was not given, as a share of it, and of its principal point, as a
share of the long side, before features tell: of a photo of the size of the map's; of another, which may be cropped."""


def lens_of(photo: Path, given: Lens | None, views: list[View]) -> tuple[Lens, float]:
    """The lens of a photo, and how far it is trusted: given; else the map's camera of the same shape, unless EXIF has
    another focal length; else EXIF's or a usual one."""
    if given is not None:
        return given, KNOWN
    width, height = photo_size(photo)
    stated = _exif_focal(photo, max(width, height))
    for view in views:
        lens = view_lens(view)
        if same_aspect((width, height), (lens.width, lens.height)):
            lens = rescale_lens(lens, width, height)
            focal = camera_from_lens(lens).mean_focal_length()
            if stated is None or abs(stated / focal - 1) <= SAME_FOCAL:
                return lens, LIKELY
    focal = USUAL_FOCAL * max(width, height) if stated is None else stated
    return Lens("SIMPLE_RADIAL", (focal, width / 2, height / 2, 0.0), width, height), GUESSED


def _exif_focal(photo: Path, long_side: int) -> float | None:
    """The focal length in pixels by EXIF's for 35 mm film, whose long side is 36 mm; None where it is not stated."""
    with open_photo(photo) as image:
        millimetres = exif_of(image, photo, CAMERA_FOLDER).get(0xA405)
    if isinstance(millimetres, (int, float)) and 5 <= millimetres <= 500:
        return millimetres / 36 * long_side
    return None


def moved(lens: Lens, focal: float, x: float, y: float) -> Lens:
    """A lens with another focal length, by its logarithm, and another principal point."""
    camera = camera_from_lens(lens)
    params = np.array(lens.params)
    params[list(camera.focal_length_idxs())] *= np.exp(focal)
    params[list(camera.principal_point_idxs())] += x, y
    return replace(lens, params=tuple(params.tolist()))


def median(lenses: Sequence[Lens]) -> Lens:
    """The medians of the parameters of those that have the most frequent model, of several the first by name."""
    models = Counter(sorted(lens.model for lens in lenses))
    model = models.most_common(1)[0][0]
    rows = [lens.params for lens in lenses if lens.model == model]
    middle = np.sort(np.array(rows, np.float64), axis=0)[len(rows) // 2]
    return replace(lenses[0], model=model, params=tuple(middle.tolist()))
