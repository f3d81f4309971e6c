"""From the instances of a Gaussian map to the points of clouds and meshes, and into other programs' files."""

from perception.export.labels import ExportOptions, check_overlap, export_labels
from perception.export.run import Outputs, run_export, write_export

__all__ = ["ExportOptions", "Outputs", "check_overlap", "export_labels", "run_export", "write_export"]
