"""A map in the browser: walk through it, ask, pick, correct, save (`perception view`)."""

from perception.viewer.app import Viewer, start_viewer

__all__ = ["Viewer", "start_viewer"]
