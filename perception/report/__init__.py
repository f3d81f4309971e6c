"""The one-page report of a map."""

from perception.report.page import InstanceRow, QueryRow, ReportData, ViewRow, write_report

__all__ = ["InstanceRow", "QueryRow", "ReportData", "ViewRow", "write_report"]
