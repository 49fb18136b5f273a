"""Tables of numbers from CSV and Parquet files, and the project's own column names."""

from __future__ import annotations

import difflib
import io
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.groundstation.reading.csv_text import read_csv_text
from trueflight.groundstation.reading.rows import possible
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS, MOST_ROTORS, column_names
from trueflight.models.outside import shown, unreadable

OWN_NAMES = tuple(name for attribute in COLUMNS for name in column_names(attribute, MOST_ROTORS))
"""Names of all columns of the project's own CSV, besides `t` and `flying`."""
NOTHING = [
    "",
    "nan",
    "NaN",
    "NAN",
    "-nan",
    "null",
    "NULL",
    "none",
    "None",
    "NA",
    "N/A",
    "n/a",
    "#N/A",
    "-",
    "--",
]
"""What stands for a missing value."""
MOST_VALUES = 200_000_000
"""Numbers of a table: 1.6 GB, five hours of 100 columns at 100 Hz. A Parquet file tells before it is read."""
MOST_RAGGED = 0.02
"""Share of lines with too few or too many values above which a file is no table."""
WORD = re.compile(r"[A-Za-z_][\w|]*")
"""A label, or several: FAILSAFE, GPS_FIX|GPS_FIX_HOME."""


@dataclass(frozen=True)
class Table:
    """Columns (N,) of floats by name; missing values are nan. `origin` names the file in messages; row i of a
    CSV is line i + `first_line` of the file, but for the lines that were `left_out`; a Parquet row has no line. Columns
    that hold text or lists are not read; `text` names them."""

    origin: str
    columns: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()
    first_line: int | None = 2
    left_out: tuple[int, ...] = ()
    text: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def place(self, row: int) -> str:
        """Where a row stands, for a message."""
        if not self.first_line:
            return f"{self.origin}, row {row + 1}"
        line = row + self.first_line
        for left_out in sorted(self.left_out):
            line += left_out <= line
        return f"{self.origin}, line {line}"

    def column(self, name: str, wanted_by: str = "") -> np.ndarray:
        """A column by name; raises `InputError` with the nearest names where it is missing."""
        if name in self.columns:
            return self.columns[name]
        close = difflib.get_close_matches(name, self.columns, 1)
        hint = (
            f"did you mean '{close[0]}'?"
            if close
            else f"the file has: {', '.join(name or '(no name)' for name in list(self.columns)[:30])}"
        )
        texts = (
            f"; {', '.join(self.text[:9])} hold text or lists, which are not read: one number a column"
            if self.text
            else ""
        )
        raise InputError(f"{self.origin}: column '{name}'{wanted_by} is missing; {hint}{texts}")


def read_table(path: Path) -> Table:
    """Read a CSV or Parquet file of numbers.

    Raises `InputError` for an unreadable or empty file and for a value that is not a number. A last line cut
    short (the logger lost power) is left out with a note.
    """
    if path.suffix.lower() in (".parquet", ".pq"):
        return _read_parquet(path)
    return _read_csv(path)


def _text_columns(arrow: Any) -> list[str]:
    """Names of columns that hold text, or lists."""
    import pyarrow as pa

    numeric = (
        pa.types.is_integer,
        pa.types.is_floating,
        pa.types.is_boolean,
        pa.types.is_temporal,
        pa.types.is_null,
    )
    pairs = zip(arrow.column_names, arrow.columns, strict=True)
    return [
        name.strip().lstrip("#").strip() for name, c in pairs if not any(kind(c.type) for kind in numeric)
    ]


def own_columns(table: Table) -> dict[str, np.ndarray]:
    """The groups of `models.flight.COLUMNS` that a table in the project's own format holds, by attribute.

    Raises `InputError` for a group of which some columns are missing, or a file without any known column.
    """
    groups: dict[str, np.ndarray] = {}
    for attribute, (four, _, what) in COLUMNS.items():
        every = column_names(attribute, MOST_ROTORS)
        present = [name for name in every if name in table.columns]
        names = every[: max(len(four), every.index(present[-1]) + 1 if present else 0)]
        if not present:
            continue
        if len(present) < len(names):
            missing = ", ".join(f"'{name}'" for name in names if name not in present)
            raise InputError(
                f"{table.origin}: {missing} is missing beside {', '.join(present)} ({what}); "
                "add it, or remove the others"
            )
        columns = [table.columns[name] for name in names]
        groups[attribute] = columns[0] if len(names) == 1 else np.stack(columns, -1)
    if not groups or "t" not in table.columns:
        missing_name = "t" if groups else "thrust_command"
        table.column(missing_name, " (or --mapping FILE to name your own columns)")
    return groups


def unknown_columns(table: Table) -> dict[str, np.ndarray]:
    """Columns that the project has no name for. Raises `InputError` for one that looks like a misspelt
    name."""
    unknown = {k: v for k, v in table.columns.items() if k not in OWN_NAMES and k not in ("t", "flying")}
    for name in unknown:
        close = difflib.get_close_matches(name, OWN_NAMES, 1, cutoff=0.92)
        if close and close[0] not in table.columns:
            raise InputError(
                f"{table.origin}: unknown column '{name}'; did you mean '{close[0]}'? Rename one or remove it"
            )
    return unknown


def _read_csv(path: Path) -> Table:
    from pyarrow import csv as arrow_csv

    text = read_csv_text(path)
    ragged: list[int] = []

    def without(row: Any) -> str:
        ragged.append(row.number - 2 + text.first_line if row.number is not None else 0)
        return "skip"

    with unreadable(path, "the flight", "correct that line", "not a table of comma-separated values"):
        arrow = arrow_csv.read_csv(
            io.BytesIO(text.content),
            read_options=arrow_csv.ReadOptions(use_threads=False),  # rows are only numbered in one thread
            parse_options=arrow_csv.ParseOptions(delimiter=text.delimiter, invalid_row_handler=without),
            convert_options=arrow_csv.ConvertOptions(
                null_values=NOTHING, strings_can_be_null=True, decimal_point=text.decimal
            ),
        )
    notes = list(text.notes)
    if ragged:
        if len(ragged) > MOST_RAGGED * len(arrow):
            most = len(ragged) > 0.5 * (len(ragged) + len(arrow)) and text.delimiter == ","
            hint = (
                " (decimal commas between commas? export it with points, or with semicolons)" if most else ""
            )
            raise InputError(
                f"{path}, line {ragged[0]}: {len(ragged)} of {len(arrow) + len(ragged)} lines have another number of "
                f"values than the header has names ({arrow.num_columns}){hint}; correct that line"
            )
        lines = "line" if len(ragged) == 1 else "lines"
        notes.append(f"{len(ragged)} {lines} without all values left out, the first is line {ragged[0]}")
    names = [name.strip().lstrip("#").strip() for name in arrow.column_names]
    for name, count in Counter(names).items():
        if name and count > 1:
            raise InputError(f"{path}: two columns are named {shown(name)}; rename or remove one")
    return Table(
        str(path),
        _numbers(str(path), arrow, text.first_line),
        tuple(notes),
        text.first_line,
        tuple(ragged),
        tuple(_text_columns(arrow)),
    )


def _read_parquet(path: Path) -> Table:
    from pyarrow import parquet as arrow_parquet

    with unreadable(path, "the flight", "export it again", "not a whole Parquet file"):
        about = arrow_parquet.read_metadata(path)
        # Of its columns nothing is asked: pyarrow (26) ends the whole process over some damaged ones.
        if about.num_rows < 0 or about.num_rows * about.num_columns > MOST_VALUES:
            raise InputError(
                f"{path}: claims {about.num_rows} rows of {about.num_columns} columns; export it again"
            )
        arrow = arrow_parquet.ParquetFile(path).read()  # read_table() loads pandas
        return Table(str(path), _numbers(str(path), arrow, None), (), None, (), tuple(_text_columns(arrow)))


def _numbers(origin: str, arrow: object, first_line: int | None) -> dict[str, np.ndarray]:
    import pyarrow as pa

    columns: dict[str, np.ndarray] = {}
    for name, column in zip(arrow.column_names, arrow.columns, strict=True):  # type: ignore[attr-defined]
        if pa.types.is_null(column.type):
            continue
        if pa.types.is_temporal(column.type) and not pa.types.is_duration(column.type):
            columns[name.strip().lstrip("#").strip()] = _seconds(column)
            continue
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            _reject_text(origin, name, column.to_pylist(), first_line)
        if not (
            pa.types.is_integer(column.type)
            or pa.types.is_floating(column.type)
            or pa.types.is_boolean(column.type)
        ):
            continue
        clean = name.strip().lstrip("#").strip()
        numbers = column.cast(pa.int8()) if pa.types.is_boolean(column.type) else column
        columns[clean] = possible(_floats(numbers))
    if not columns or len(next(iter(columns.values()))) == 0:
        raise InputError(
            f"{origin}: no rows of numbers in it; a header line and one row for each sample are needed"
        )
    return columns


def _floats(column: Any) -> np.ndarray:
    """Numbers (N,) of a column, NaN where one is missing; from its buffers, for `to_numpy` of pyarrow loads pandas."""
    import pyarrow as pa

    pieces = [np.empty(0)]
    for chunk in column.cast(pa.float64()).chunks:
        known, values = chunk.buffers()
        rows = slice(chunk.offset, chunk.offset + len(chunk))
        piece = np.frombuffer(values, float, rows.stop)[rows] if len(chunk) else np.empty(0)
        if chunk.null_count:
            bits = np.unpackbits(np.frombuffer(known, np.uint8), count=rows.stop, bitorder="little")
            piece = np.where(bits[rows] == 1, piece, np.nan)
        pieces.append(piece)
    return np.concatenate(pieces)


def _seconds(column: Any) -> np.ndarray:
    """Dates and times of day as seconds (N,) from the first on."""
    import pyarrow as pa

    if pa.types.is_time(column.type):
        ticks = column.cast(pa.time64("ns")).cast(pa.int64())
    else:
        ticks = column.cast(pa.timestamp("ns")).cast(pa.int64())
    first = ticks.drop_null()[0].as_py() if ticks.null_count < len(ticks) else 0
    since = np.array(ticks.fill_null(first).to_numpy(), dtype=np.int64) - first
    return np.where(np.array(ticks.is_valid()), 1e-9 * since, np.nan)


def _reject_text(origin: str, name: str, values: list[str | None], first_line: int | None) -> None:
    """Name the first value that is not a number; a column of texts only is a label and is left out, and so is one of
    words beside a number that means none of them ("ANGLE_MODE", 0)."""
    bad = []
    for row, value in enumerate(values):
        try:
            float(value) if value is not None else None
        except ValueError:
            bad.append((row, value))
    known = name.strip() in OWN_NAMES or name.strip() == "t"
    label = all(WORD.fullmatch(str(text).strip()) for _, text in bad) and _at_most_one_number(values, bad)
    if bad and (known or (len(bad) < len(values) / 2 and not label)):
        row, value = bad[0]
        place = f"line {row + first_line}" if first_line else f"row {row + 1}"
        mixed = first_line and re.fullmatch(r"[+-]?\d*[.,]\d+", str(value).strip())
        hint = " here: decimal points and commas are mixed, write one of them throughout" if mixed else ""
        raise InputError(
            f"{origin}, {place}: column '{name}' holds '{value}', which is not a number{hint}; correct it"
        )


def _at_most_one_number(values: list[str | None], bad: list[tuple[int, str | None]]) -> bool:
    texts = {text for _, text in bad}
    return len({float(value) for value in set(values) - texts if value is not None}) <= 1
