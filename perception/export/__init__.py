"""From the instances of a Gaussian map to the points of clouds and meshes, and into other programs' files."""

from perception.export.formats import write_export
from perception.export.transfer import ExportOptions, check_overlap, export_labels

__all__ = ["ExportOptions", "check_overlap", "export_labels", "write_export"]
