"""How numbers and remarks are written into the files of others."""

from __future__ import annotations

import re
from collections.abc import Iterable


def numbers(values: Iterable[float]) -> str:
    """Numbers with a blank between, nine digits each."""
    return " ".join(f"{value:.9g}" for value in values)


def one_line(text: str) -> str:
    """A remark on one line, whatever blanks and line ends it came with."""
    return " ".join(text.split())


def hash_comment(said: Iterable[str]) -> str:
    """Remarks as comments of Python, TOML and parameter files."""
    return "".join(f"# {one_line(text)}\n" for text in said)


def xml_comment(said: Iterable[str]) -> str:
    """Remarks as one XML comment, in which two hyphens must not stand together."""
    inside = "\n".join(f"    {re.sub('-{2,}', '-', one_line(text))}" for text in said)
    return f"  <!--\n{inside}\n  -->"
