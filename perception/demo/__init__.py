"""Rendered photos of synthetic scenes with exact ground truth, for `perception demo` and the tests."""

from perception.demo.scene import DemoTruth, load_truth, make_photos

__all__ = ["DemoTruth", "load_truth", "make_photos"]
