"""Many flights by one program: a table with a row a flight, as `sim-bridge fly-many --flights` reads it."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trueflight.groundstation.operate.processes import run_json
from trueflight.models.whole_file import write_whole

Row = Mapping[str, object]
"""A flight by the columns of the table; all rows of one table have the same."""


def table_text(rows: Sequence[Row]) -> str:
    """The table, CSV, of one row or more."""
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def fly_rows(rows: Sequence[Row], folder: Path, vehicle: Path, *more: object) -> dict[str, dict[str, Any]]:
    """Fly all rows into `folder`, where an interrupted run may have left records: the simulator's report of each
    flight, by name. `more` are further words for `sim-bridge fly-many`."""
    if not rows:
        return {}
    for row in rows:
        (folder / f"{row['name']}.mcap").unlink(missing_ok=True)
    table = folder / "flights.csv"
    write_whole(table, table_text(rows), "the table of flights")
    words = [
        "sim-bridge",
        "fly-many",
        "--flights",
        table,
        "--vehicle",
        vehicle,
        *more,
        "-o",
        folder,
        "--json",
    ]
    reports = {report["name"]: report for report in run_json(words)["flights"]}
    table.unlink()
    return reports
