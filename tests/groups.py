"""Which tests one worker runs as a whole, one after the other."""

from __future__ import annotations

from functools import cache
from pathlib import Path


@cache
def realtime(file: Path) -> bool:
    """Whether a file of tests says that it flies in real time."""
    return "pytestmark = pytest.mark.realtime" in file.read_text()


def group_of(nodeid: str, root: Path) -> str:
    """All that flies in real time is one group, so that no two flights starve each other; else a file is one, for its
    fixtures."""
    file = nodeid.partition("::")[0]
    return "flights" if realtime(root / file) else file
