"""One self-contained HTML page of an analysis, for those who were not there."""

from groundstation.report.page import SECTIONS, Section, render, write_report

__all__ = ["SECTIONS", "Section", "render", "write_report"]
