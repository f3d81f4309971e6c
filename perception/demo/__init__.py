"""Rendered photos of synthetic scenes with exact ground truth, for `perception demo` and the tests."""

from perception.demo.scene import DemoTruth, make_photos

__all__ = ["DemoTruth", "make_photos"]
