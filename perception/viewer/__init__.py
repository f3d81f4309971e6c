"""A map viewer in the browser, with queries, selection and corrections (`perception view`)."""

from perception.viewer.app import Viewer

__all__ = ["Viewer"]
