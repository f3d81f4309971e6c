"""Transfers instance labels of a map to point clouds and meshes, and writes them in formats of other programs."""

from perception.export.formats import write_export
from perception.export.transfer import ExportOptions, check_overlap, export_labels

__all__ = ["ExportOptions", "check_overlap", "export_labels", "write_export"]
