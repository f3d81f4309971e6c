"""A map viewer in the browser, with queries, selection and corrections (`perception view`)."""

from perception.viewer.app import Viewer, start_viewer

__all__ = ["Viewer", "start_viewer"]
