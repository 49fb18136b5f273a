"""Where commands print: words, names and numbers are whole at every width, and a pipe has any width."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, ConsoleDimensions, ConsoleOptions, RenderResult
from rich.segment import Segment
from rich.table import Table as RichTable
from rich.text import Text

PIPE = 10_000
"""Columns of what is no terminal: whoever reads a pipe breaks lines, or wants each whole."""
EASY = 18
"""Columns that prose needs to be read without effort; a narrower column stands in no table."""
GAP = "   "


class Terminal(Console):
    """A console that never cuts a word: a name that is longer than a line stands whole on a line of its own.

    As wide as the terminal, or as COLUMNS says; where it is neither, lines are as long as what they tell.
    """

    @property
    def size(self) -> ConsoleDimensions:
        """Columns and lines."""
        if self._width is None and not self.is_terminal and not self.is_jupyter:
            told = os.environ.get("COLUMNS", "")
            return ConsoleDimensions(int(told) if told.isdigit() and int(told) else PIPE, 25)
        return super().size

    @size.setter
    def size(self, asked: tuple[int, int]) -> None:
        self._width, self._height = asked

    def print(self, *objects: Any, **how: Any) -> None:
        """As `rich.console.Console.print`, without its cutting."""
        if objects and all(isinstance(one, (str, Text)) for one in objects) and not how.get("soft_wrap"):
            (told,) = objects if len(objects) == 1 else (Text(" ").join(map(self._text, objects)),)
            told = told if isinstance(told, Text) else self._text(told, how)
            if _longest(told.plain) > self.width:
                objects, how = (_wrapped(told, self.width),), {**how, "soft_wrap": True, "highlight": False}
        super().print(*objects, **{"crop": False, **how})

    def _text(self, told: str | Text, how: dict[str, Any] | None = None) -> Text:
        if isinstance(told, Text):
            return told
        asked = how or {}
        return self.render_str(told, markup=asked.get("markup"), highlight=asked.get("highlight"))


class Table(RichTable):
    """A table that fits: with prose wrapped, or with less air, or as one paragraph a row; no cell is ever cut.

    Columns of numbers (to the right) and those with `no_wrap` keep each cell on one line; one without any is left out.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """What fits of the three."""
        if self.title:
            yield _said(console, options, self.title, self.title_style or "table.title")
        told = copy.copy(self)
        told.columns = [column for column in self.columns if any(column.cells) or not self.row_count]
        for tight in (False, True):
            laid = copy.copy(told)
            laid.title = laid.caption = None
            if tight and self.box is not None:
                laid.box, laid.padding, laid.pad_edge = SIMPLE_HEAD, (0, 1, 0, 0), False
            if widths := _widths(laid, console, options.max_width):
                laid.columns = [copy.copy(column) for column in told.columns]
                for column, width in zip(laid.columns, widths, strict=True):
                    column.width, column.min_width, column.max_width = width, None, None
                    column.overflow = "fold"
                yield from _without_ends(RichTable.__rich_console__(laid, console, options), console, options)
                break
        else:
            yield from _stacked(told, console, options.max_width)
        if self.caption:
            yield _said(console, options, self.caption, self.caption_style or "table.caption")


def _said(console: Console, options: ConsoleOptions, told: Any, style: Any) -> Text:
    text = told if isinstance(told, Text) else console.render_str(str(told), style=style, highlight=False)
    return _whole(_wrapped(text, options.max_width))


def _without_ends(drawn: RenderResult, console: Console, options: ConsoleOptions) -> Iterator[Segment]:
    """The same without the blanks at the ends of lines, which a narrower window would break into lines of their own."""
    plain = (
        s for one in drawn for s in ([one] if isinstance(one, Segment) else console.render(one, options))
    )
    for line in Segment.split_lines(plain):
        while line and not line[-1].text.strip():
            line.pop()
        if line:
            *before, last = line
            yield from [*before, Segment(last.text.rstrip(), last.style)]
        yield Segment.line()


def _cells(table: RichTable, console: Console) -> list[list[Text]]:
    """Columns of cells, the headings first."""
    columns = []
    for column in table.columns:
        cells = [column.header] * table.show_header + list(column.cells)
        columns.append([c if isinstance(c, Text) else console.render_str(str(c)) for c in cells])
    return columns


def _longest(text: str) -> int:
    return max(map(cell_len, text.split()), default=0)


def _widths(table: RichTable, console: Console, room: int) -> list[int] | None:
    """Columns' widths in which every word is whole and prose is easy to read; None where there is no such."""
    columns = _cells(table, console)
    whole = [
        max((cell_len(line) for c in cells for line in c.plain.split("\n")), default=0) for cells in columns
    ]
    least = [
        full
        if column.no_wrap or column.justify == "right"
        else max(min(full, EASY), max((_longest(c.plain) for c in cells), default=0))
        for column, cells, full in zip(table.columns, columns, whole, strict=True)
    ]
    for k, column in enumerate(table.columns):  # headings of numbers may wrap
        if column.justify == "right" and table.show_header and not column.no_wrap:
            body = max((cell_len(line) for c in columns[k][1:] for line in c.plain.split("\n")), default=0)
            least[k] = max(body, _longest(columns[k][0].plain))
    left = room - _air(table) - sum(least)
    if left < 0:
        return None
    widths = list(least)
    while left > 0 and (short := [k for k in range(len(widths)) if widths[k] < whole[k]]):
        widths[max(short, key=lambda k: whole[k] / widths[k])] += 1
        left -= 1
    return widths


def _air(table: RichTable) -> int:
    """Columns of a table's width that are no cell's."""
    _, right, _, left = table.padding
    count = len(table.columns)
    between = sum((0 if table.collapse_padding and k else left) + right for k in range(count)) - (
        0 if table.pad_edge else left + right
    )
    lines = (count - 1 + 2 * table.show_edge) if table.box is not None else 0
    return between + lines


def _stacked(table: RichTable, console: Console, room: int) -> Iterator[Text]:
    """A paragraph for each row: its first cell, then every other one behind its heading."""
    columns = _cells(table, console)
    heads = [c[0].plain.replace("\n", " ") if table.show_header else "" for c in columns]
    rows = zip(*(c[int(table.show_header) :] for c in columns), strict=True)
    for first, *cells in rows:
        name = Text.assemble((f"{heads[0]}: " if heads[0] else "", "dim"), first, style="bold")
        yield _whole(_wrapped(name, room))
        line = Text("")
        for head, cell in zip(heads[1:], cells, strict=True):
            if not cell.plain:
                continue
            pair = Text.assemble((f"{head}: " if head else "", "dim"), cell)
            alone = "\n" in cell.plain or len(pair) > room // 2
            if line and (alone or len(line) + len(GAP) + len(pair) + 2 > room):
                yield _whole(Text("  ") + line)
                line = Text("")
            if alone:
                yield _whole(_indented(_wrapped(pair, room - 4)))
            else:
                line = line + GAP + pair if line else pair
        if line:
            yield _whole(Text("  ") + line)


def _indented(text: Text) -> Text:
    return Text("\n").join(Text("    " if k else "  ") + part for k, part in enumerate(text.split("\n")))


def _whole(text: Text) -> Text:
    text.no_wrap, text.overflow = True, "ignore"
    return text


def _wrapped(text: Text, width: int) -> Text:
    """`text` broken between words alone."""
    lines: list[Text] = []
    for line in text.split("\n"):
        cuts, start, place = [], 0, 0
        for word in line.plain.split(" "):
            if place > start and place + len(word) - start > width:
                cuts.append(place)
                start = place
            place += len(word) + 1
        lines += line.divide(cuts)
    for line in lines:
        line.rstrip()
    return Text("\n").join(lines)
