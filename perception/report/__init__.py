"""A one-page report of a map: one HTML file that opens offline."""

from perception.report.data import InstanceRow, QueryRow, ReportData, ViewRow
from perception.report.page import write_report

__all__ = ["InstanceRow", "QueryRow", "ReportData", "ViewRow", "write_report"]
