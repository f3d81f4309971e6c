"""Rendered photos of synthetic scenes with exact ground truth, for tests, training and measurements."""

from worlds.scene import make_photos
from worlds.truth import DemoTruth

__all__ = ["DemoTruth", "make_photos"]
