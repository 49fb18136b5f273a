"""The text of a CSV file as loggers and spreadsheets write it: encoding, separator, decimal comma, comments, units."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from pathlib import Path

from trueflight.models.errors import InputError
from trueflight.models.outside import unreadable

MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)


@dataclass(frozen=True)
class CsvText:
    """A table's text in UTF-8 from its header on. `first_line` is the line of the file that holds row 0; `notes` tell
    what had to be done."""

    content: bytes
    delimiter: str
    decimal: str
    first_line: int
    notes: tuple[str, ...]


def read_csv_text(path: Path) -> CsvText:
    """Read the text of a table. Raises `InputError` for a file that cannot be read or is empty."""
    with unreadable(path, "the flight", "check the path"):
        raw = path.read_bytes()
    text, notes = _decoded(raw)
    if not text.strip():
        raise InputError(f"{path}: the file is empty; log the flight again or pass another file")
    lines = text.splitlines(keepends=True)
    header = _header(lines)
    first = lines[header].lstrip("#").strip()
    delimiter = _delimiter(first)
    body = lines[header + 1 :]
    if delimiter == " ":
        delimiter = "\t"
        first, body = "\t".join(first.split()), ["\t".join(line.split()) + "\n" for line in body]
    below = header + 2
    rows = [line for line in body[:20] if line.strip()]
    if (
        rows
        and not any(NUMBER.fullmatch(cell.strip().strip('"')) for cell in rows[0].split(delimiter))
        and len(rows) > 1
    ):
        skipped = body.index(rows[0]) + 1
        body, below = body[skipped:], below + skipped
        notes.append("the line below the names holds no number (units?) and was left out")
        rows = rows[1:]
    if body and not body[-1].endswith(("\n", "\r")) and body[-1].count(delimiter) < first.count(delimiter):
        body.pop()
        notes.append("the last line is cut short and was left out")
    decimal = _decimal(body, delimiter)
    content = "".join([first, "\n", *body]).encode()
    return CsvText(content, delimiter, decimal, below, tuple(notes))


def _decimal(lines: list[str], delimiter: str) -> str:
    """The decimal mark of the first number that has one: the first rows may hold whole numbers only, and texts or dates
    in other columns any mark. Between commas only a quoted number can have a comma."""
    quoted = '"' if delimiter == "," else '"?'
    mark = re.escape(delimiter)
    number = re.compile(
        rf"(?:^|{mark})[ ]*(?:{quoted}[+-]?\d*(,)\d+(?:[eE][+-]?\d+)?{quoted}|\"?[+-]?\d*(\.)\d+(?:[eE][+-]?\d+)?\"?)"
        rf"[ ]*(?={mark}|$)"
    )
    for line in lines:
        if "." in line or "," in line:
            found = number.search(line.rstrip("\r\n"))
            if found:
                return found[1] or found[2]
    return "."


def _decoded(raw: bytes) -> tuple[str, list[str]]:
    for mark, encoding in MARKS:
        if raw.startswith(mark):
            return raw.decode(encoding, "replace").lstrip("\ufeff"), []
    try:
        return raw.decode("utf-8"), []
    except UnicodeDecodeError:
        return raw.decode("latin-1"), ["the file is not in UTF-8; it was read as Latin-1"]


def _header(lines: list[str]) -> int:
    """The line that names the columns: the first one that is no comment, or the last comment where numbers follow."""
    last = -1
    for index, line in enumerate(lines):
        if not line.strip():
            continue
        if line.startswith("#"):
            last = index
            continue
        first = re.split(r"[,;\t ]", line.strip())[0].strip('"')
        return last if last >= 0 and NUMBER.fullmatch(first) else index
    return max(last, 0)


def _delimiter(header: str) -> str:
    counts = {mark: header.count(mark) for mark in (",", ";", "\t")}
    best = max(counts, key=lambda mark: counts[mark])
    return best if counts[best] else (" " if len(header.split()) > 1 else ",")
