"""Calibration boards and detection of their corners, refined to 0.05 pixels by the known printed pattern.

OpenCV refines a corner in the few white pixels between it and the markers, which biases it by 0.1 pixels. Here the
pattern around each corner, including markers, is warped into the image by the homography of nearby corners. It is then
aligned by Lucas-Kanade with gain and offset (4 unknowns).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from perception.errors import InputError

_HALF, _SAMPLES = 0.3, 17  # half side of the patch in squares; samples along a side
_NEAR = 1.6  # squares: distance of the corners used for the homography
_ITERATIONS = 8
_MOST = 1.5  # pixels: if a corner moves farther, the detection is kept


def refine(
    picture: np.ndarray,
    board_points: np.ndarray,
    pixels: np.ndarray,
    square: float,
    texture: np.ndarray,
    per_square: float,
    margin: float,
) -> np.ndarray:
    """Refined pixels [N, 2] of board points [N, 3] detected at `pixels` in a grey image.

    texture: printed pattern with `per_square` pixels a square; the board's origin is `margin` pixels from its corner.
    """
    image = picture.astype(np.float32)
    slopes = [cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0)]
    flat = board_points[:, :2].astype(np.float64)
    offsets = np.linspace(-_HALF, _HALF, _SAMPLES) * square
    patch = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    refined = np.array(pixels, np.float64)
    smooth = {}
    for i, corner in enumerate(flat):
        near = np.abs(flat - corner).max(axis=1) < _NEAR * square
        near = near if near.sum() >= 5 else np.ones(len(flat), bool)
        laid = cv2.findHomography(flat[near], pixels[near].astype(np.float64), 0)[0]
        if laid is None:
            continue
        at = _apply(laid, corner + patch)
        base, right, down = _apply(laid, corner + np.array([[0, 0], [square, 0], [0, square]]))
        side = np.sqrt(np.abs(np.linalg.det([right - base, down - base])))  # of a square in the image, pixels
        # A pixel averages over its area: the texture is blurred accordingly, in steps of a quarter octave.
        blur = float(2 ** (np.round(4 * np.log2(max(0.5 * per_square / max(side, 1), 0.3))) / 4))
        if blur not in smooth:
            smooth[blur] = cv2.GaussianBlur(texture.astype(np.float32), (0, 0), blur)
        template = _sample(smooth[blur], (corner + patch) / square * per_square + margin - 0.5)
        shift = _fit(image, slopes, at, template)
        moved = None if shift is None else _apply(laid, corner[None])[0] + shift
        if moved is not None and np.linalg.norm(moved - pixels[i]) <= _MOST:
            refined[i] = moved
    return refined


def _fit(image: np.ndarray, slopes: list[np.ndarray], at: np.ndarray, template: np.ndarray) -> np.ndarray | None:
    """The shift [2] that aligns the image at positions `at` [S, 2] with the template; None if it diverges."""
    if not ((at > 2) & (at < np.array(image.shape[::-1]) - 3)).all():
        return None
    shift = np.zeros(2)
    for _ in range(_ITERATIONS):
        here = at + shift
        # image(at + shift) = gain · template + offset − slopes · step
        columns = np.column_stack([template, np.ones(len(template)), *(-_sample(s, here) for s in slopes)])
        gain, _, *step = np.linalg.lstsq(columns, _sample(image, here), rcond=None)[0]
        shift += step
        if gain <= 0 or np.abs(shift).max() > _MOST:
            return None
        if np.abs(step).max() < 1e-3:
            break
    return shift


def _sample(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear values [S] at positions [S, 2] (x, y), pixel centres at integers."""
    where = np.ascontiguousarray(at, np.float32).reshape(-1, 1, 2)
    return cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel().astype(np.float64)  # type: ignore[call-overload]


def _apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


MIN_CORNERS = 8
"""Minimum number of corners per image. The pose alone needs three."""
PER_SQUARE, MARGIN = 60, 30
"""Pixels of a square, and of the white margin, of the pattern that corners are aligned with."""


@dataclass(frozen=True)
class Detection:
    """The board in one image. name: of the image; board_points [N, 3] float32 in the board frame (its unit, z = 0);
    pixels [N, 2] float32 in OpenCV's convention: the centre of the first pixel is (0, 0)."""

    name: str
    board_points: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Board:
    """A printed board. kind: "charuco" or "checkerboard"; squares: (columns, rows) of squares, not of corners;
    square, marker: side lengths in metres (or any unit); dictionary: OpenCV's name of the marker dictionary."""

    kind: str
    squares: tuple[int, int]
    square: float
    marker: float = 0.0
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        if self.kind not in ("charuco", "checkerboard"):
            raise InputError(f"--board is '{self.kind}'; expected charuco or checkerboard")
        least = 4 if self.kind == "checkerboard" else 3  # OpenCV finds no fewer
        corners = (self.squares[0] - 1) * (self.squares[1] - 1)
        if min(self.squares) < least or corners < MIN_CORNERS or not 1e-9 < self.square < 1e9:
            what = f"board of {self.squares[0]}x{self.squares[1]} squares of {self.square}: too small or too large"
            raise InputError(f"{what}; expected {least}x{least} or more with {MIN_CORNERS} corners between them")
        if self.kind == "checkerboard":
            return
        if not 0 < self.marker < self.square:
            raise InputError(f"--marker is {self.marker}; expected a length above 0, under the square's {self.square}")
        if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            raise InputError(f"--dictionary '{self.dictionary}' is not known; expected OpenCV's, such as 5X5_100")
        needed, held = self.squares[0] * self.squares[1] // 2, len(self._words().bytesList)
        if needed > held:
            raise InputError(
                f"--dictionary '{self.dictionary}' has {held} markers, a board of {self.squares[0]}x{self.squares[1]} "
                f"squares needs {needed}; give the one that it was printed with"
            )

    def _words(self) -> Any:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    @classmethod
    def from_text(cls, text: str) -> Board:
        """The board of "KIND:COLSxROWS:SQUARE[:MARKER[:DICTIONARY]]"; the marker is 3/4 of the square by default."""
        parts = text.split(":")
        try:
            kind, squares, square, marker, dictionary = parts + [""] * (5 - len(parts))
            columns, rows = (int(side) for side in squares.lower().split("x"))
            sides = float(square), float(marker or 0.75 * float(square))
        except ValueError as error:
            expected = "expected KIND:COLSxROWS:SQUARE[:MARKER[:DICTIONARY]] such as charuco:8x11:0.02"
            raise InputError(f"board: found '{text}', {expected}") from error
        return cls(kind, (columns, rows), *sides, dictionary or "5X5_100")

    def __str__(self) -> str:
        markers = f", markers {self.dictionary}" if self.kind == "charuco" else ""
        return f"{self.kind} of {self.squares[0]}x{self.squares[1]} squares{markers}"

    def detect(self, name: str, picture: np.ndarray) -> Detection | None:
        """Detects the board in a grey image [H, W] uint8; None with fewer than MIN_CORNERS corners."""
        found = self._charuco(picture) if self.kind == "charuco" else self._checkerboard(picture)
        if found is None or len(found[0]) < MIN_CORNERS:
            return None
        spread = (found[0] - found[0].mean(axis=0))[:, :2]
        if int(np.linalg.matrix_rank(spread, tol=1e-6)) < 2:  # all corners lie on a line
            return None
        return Detection(name, found[0].astype(np.float32), found[1].astype(np.float32))

    @cached_property
    def _detectors(self) -> list[tuple[Any, np.ndarray, np.ndarray]]:
        """(detector, corners, texture) of the current ChArUco pattern, and of the legacy pattern (OpenCV before 4.6),
        which differs for an even number of rows."""
        size, found = tuple(squares * PER_SQUARE + 2 * MARGIN for squares in self.squares), []
        for legacy in (False, True):
            board = cv2.aruco.CharucoBoard(self.squares, self.square, self.marker, self._words())
            board.setLegacyPattern(legacy)
            texture = np.asarray(board.generateImage(size, None, MARGIN))
            found.append((cv2.aruco.CharucoDetector(board), np.asarray(board.getChessboardCorners()), texture))
        return found

    def _charuco(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        for detector, corners, texture in self._detectors:
            pixels, ids, _, _ = detector.detectBoard(picture)
            if ids is not None and len(ids) >= MIN_CORNERS:
                points, pixels = corners[np.ravel(ids)], np.reshape(pixels, (-1, 2))
                return points, refine(picture, points, pixels, self.square, texture, PER_SQUARE, MARGIN)
        return None

    def _checkerboard(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        columns, rows = self.squares[0] - 1, self.squares[1] - 1
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        seen, pixels = cv2.findChessboardCornersSB(picture, (columns, rows), flags=flags)
        corners = [(column, row, 0) for row in range(rows) for column in range(columns)]
        return (np.array(corners) * self.square, np.reshape(pixels, (-1, 2))) if seen else None
