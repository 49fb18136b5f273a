"""Flights of the library: read from any log, looked at, handed on to pandas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from trueflight.groundstation.library.shown import Summary, answering, data_frame, summary_of
from trueflight.groundstation.reading.mapping import Given
from trueflight.models import flight as columns
from trueflight.models.vehicle import Vehicle

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console


@dataclass(frozen=True, repr=False)
class Flight(columns.Flight):
    """One flight, in columns of N rows: `t` (N,) s, `position` (N, 3) m, `velocity` (N, 3) m/s, `quaternion` (N, 4),
    `thrust_command` (N,) of full collective, ...; a column that was not logged is None.

    World ENU, body FLU, quaternion w, x, y, z body to world, SI units: `models.flight.COLUMNS` lists them all.
    `vehicle` is what its owner believes of it, `notes` what the reader had to do,
    `extra` the log's further columns. Everything in trueflight that takes a
    `models.flight.Flight` takes this one.
    """

    def summary(self) -> Summary:
        """What was recorded, how much of it is flown, and what the reader had to do."""
        return summary_of(self._print)

    def to_pandas(self) -> pd.DataFrame:
        """The columns as a pandas table of N rows, indexed by `t` (s), named as in the project's own CSV
        (`position_x`, ...; units as in `models.flight.COLUMNS`).

        Raises `InputError` where pandas is not installed.
        """
        from trueflight.groundstation.reading.writing import own_table

        return data_frame(own_table(self), index="t")

    def write(self, path: str | Path) -> Path:
        """Write the flight to `path` (.csv or .parquet) in the project's own format, its vehicle file beside it.

        Returns `path`. Raises `InputError` for another ending, or a place that cannot be written.
        """
        from trueflight.groundstation.reading.writing import write_flight

        write_flight(self, Path(path))
        return Path(path)

    def __repr__(self) -> str:
        return f"<Flight {self.name}: {self._size()}; {', '.join(self._recorded())}>"

    def _repr_html_(self) -> str:
        return f"<b>{escape(self.name)}</b>{self.summary().html}"

    def _recorded(self) -> list[str]:
        return [name for name in columns.COLUMNS if self.has(name)]

    def _size(self) -> str:
        return f"{self.vehicle.name}, {self.duration:.1f} s at {1.0 / self.dt:.0f} Hz, {len(self)} samples"

    def _print(self, console: Console) -> None:
        from rich.markup import escape as plain

        from trueflight.models.terminal import Table

        table = Table(title=plain(f"{self.name}: {self._size()}"))
        for heading in ("column", "shape", "unit", "what"):
            table.add_column(heading)
        for name in self._recorded():
            _, unit, what = columns.COLUMNS[name]
            table.add_row(name, str(self.column(name).shape), "" if unit == "1" else unit, what)
        console.print(table)
        if self.flying is not None:
            console.print(
                f"in the air {self.flying.sum() * self.dt:.1f} s of {self.duration:.1f} s", highlight=False
            )
        for note in self.notes:
            console.print(f"note: {plain(note)}", highlight=False)


def read(path: str | Path, vehicle: str | Path | Vehicle | None = None, mapping: Given = None) -> Flight:
    """Read the flight at `path`, of any kind: PX4 ULog, MCAP of the companion or of ROS 2, CSV or Parquet.

    `vehicle` is the vehicle as you believe it to be, or its vehicle.toml; None takes the file beside the flight, or
    what a record of the companion carries. `mapping` is a TOML file that names your columns and their units; None takes
    the one beside the flight where the table is not in the project's own format. The flight that comes back has columns
    of N rows in SI units, World ENU and body FLU, whatever the log had.

    Raises `InputError`, one line, for whatever makes the file unfit for analysis.
    """
    from trueflight.groundstation.reading import read_flight

    return answering(Flight, read_flight(path, vehicle, mapping))


def read_all(
    paths: str | Path | Sequence[str | Path],
    vehicle: str | Path | Vehicle | None = None,
    mapping: Given = None,
) -> list[Flight]:
    """Read several flights: the files among `paths`, and every flight in the folders among them, ordered by name.

    `vehicle` and `mapping` as for `read`, for all of them; columns in SI units. Raises `InputError` as `read` does, and
    for a folder without flights.
    """
    from trueflight.groundstation.reading.several import flights_in

    given = [paths] if isinstance(paths, str | Path) else paths
    return [read(path, vehicle, mapping) for path in flights_in([Path(path) for path in given])]
