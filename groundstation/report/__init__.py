"""One self-contained HTML page of an analysis, for those who were not there."""

from trueflight.groundstation.report.page import (
    SECTIONS,
    Section,
    chosen,
    render,
    render_side_by_side,
    write_report,
)

__all__ = ["SECTIONS", "Section", "chosen", "render", "render_side_by_side", "write_report"]
