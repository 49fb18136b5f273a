"""A promise that the campaign looks at, and the table of all of them."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.table import Table

COLUMNS = ("what was done", "times", "promised", "seen", "")


@dataclass(frozen=True)
class Row:
    """One promise: what was done, how often, what was promised, what was seen, and whether it was kept."""

    done: str
    times: int
    promised: str
    seen: str
    kept: bool

    @property
    def cells(self) -> tuple[str, ...]:
        """The row as text, in the order of `COLUMNS`."""
        return self.done, str(self.times), self.promised, self.seen, "kept" if self.kept else "BROKEN"


def spread(values: Iterable[float], unit: str, scale: float = 1.0, digits: int = 2) -> str:
    """'MEDIAN, worst WORST UNIT', in `scale` of the measurements' own unit; one number where all are the same."""
    numbers = [scale * value for value in values]
    if not numbers:
        return "none"
    middle, worst = (f"{x:.{digits}g}" for x in (statistics.median(numbers), max(numbers)))
    return f"{worst} {unit}" if middle == worst else f"{middle}, worst {worst} {unit}"


def counted(words: Iterable[str]) -> str:
    """Words with how often each came: 'late 3, stale 1'."""
    known: dict[str, int] = {}
    for word in words:
        known[word] = known.get(word, 0) + 1
    if len(known) == 1:
        return next(iter(known))
    return ", ".join(f"{word} {n}" for word, n in sorted(known.items(), key=lambda item: -item[1]))


def markdown(parts: dict[str, Sequence[Row]]) -> str:
    """All rows as one Markdown table, a line in bold above those of each part."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    for part, rows in parts.items():
        lines.append(f"| **{part}** |" + " |" * (len(COLUMNS) - 1))
        lines += ["| " + " | ".join(cell.replace("|", "/") for cell in row.cells) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def on_screen(parts: dict[str, Sequence[Row]]) -> Table:
    """The same table for a terminal."""
    table = Table(*COLUMNS, title="promises")
    for part, rows in parts.items():
        table.add_section()
        table.add_row(f"[bold]{part}[/bold]")
        for row in rows:
            colour = "green" if row.kept else "bold red"
            table.add_row(*row.cells[:-1], f"[{colour}]{row.cells[-1]}[/]")
    return table


def save(path: Path, parts: dict[str, Sequence[Row]]) -> None:
    """Write rows to a JSON file, beside those of other parts that it holds already."""
    kept = {**load(path), **parts} if path.exists() else parts
    path.write_text(
        json.dumps({part: [asdict(row) for row in rows] for part, rows in kept.items()}, indent=1)
    )


def load(path: Path) -> dict[str, Sequence[Row]]:
    """The rows of a file that `save` wrote."""
    return {part: [Row(**row) for row in rows] for part, rows in json.loads(path.read_text()).items()}
