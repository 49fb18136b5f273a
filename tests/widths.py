"""What commands print, printed again at other widths: nothing that stands in a pipe may be missing in a terminal."""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.table import Table as RichTable
from rich.text import Text

from trueflight.models.terminal import PIPE, Table, Terminal

WIDTHS = (60, 80, 100, 160)
WORD = re.compile(r"[^\s\u2500-\u259f]+")


@contextmanager
def whole_at_every_width() -> Iterator[list[RichTable]]:
    """Meanwhile each thing that a command prints is held against itself at `WIDTHS`; yields the tables among it."""
    plain, tables = Terminal.print, []

    def also_narrow(self: Terminal, *objects: Any, **how: Any) -> None:
        plain(self, *objects, **how)
        if not objects or not all(isinstance(one, (str, Text, RichTable)) for one in objects):
            return  # progress, which is gone when it is done
        tables.extend(one for one in objects if isinstance(one, RichTable))
        assert all(isinstance(one, Table) for one in objects if isinstance(one, RichTable))
        piped = words(_printed(plain, PIPE, *objects, **how))
        for width in WIDTHS:
            text = _printed(plain, width, *objects, **how)
            lost = piped - words(text)
            assert not lost, f"at {width} columns {dict(lost)} is lost of:\n{text}"
            long = [
                line for line in text.splitlines() if len(line.rstrip()) > width and len(line.split()) > 2
            ]
            assert how.get("soft_wrap") or not long, f"at {width} columns:\n" + "\n".join(long)

    Terminal.print = also_narrow  # type: ignore[method-assign,assignment]
    try:
        yield tables
    finally:
        Terminal.print = plain  # type: ignore[method-assign]


def words(text: str) -> Counter[str]:
    """The words of what was printed, frames and bars left out."""
    return Counter(word.rstrip(":") for word in WORD.findall(text) if word.rstrip(":"))


def _printed(plain: Any, width: int, *objects: Any, **how: Any) -> str:
    page = io.StringIO()
    plain(Terminal(width=width, file=page), *objects, **how)
    return page.getvalue()
