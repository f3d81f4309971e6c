"""Rendered photos of synthetic scenes with exact ground truth, for `perception demo` and the tests."""

from perception.demo.scene import make_photos
from perception.demo.truth import DemoTruth

__all__ = ["DemoTruth", "make_photos"]
