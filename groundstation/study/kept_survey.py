"""What a survey leaves in its folder: a line a flight as they are done, so that it goes on where it was interrupted,
and the tables at its end."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from trueflight.groundstation.evaluate.survey import (
    SAVED_TABLE,
    Fleet,
    Row,
    row_from_table,
    row_table,
    stamp_of,
    write_table,
)
from trueflight.groundstation.output.as_json import fleet_table, plain
from trueflight.models.errors import InputError
from trueflight.models.whole_file import write_whole


def kept_rows(save: Path, files: Sequence[Path], tell: Callable[[str], None] = lambda _: None) -> list[Row]:
    """Rows of an earlier run on the same files; `tell` is told of damaged lines."""
    path = save / "survey.jsonl"
    if not path.is_file():
        return []
    now = {str(f.resolve()): stamp_of(f) for f in files}
    found: dict[str, Row] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        try:
            row = row_from_table(json.loads(line))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            # the last line of a run that was killed may be half a line
            tell(f"{path}: line {number} is damaged; its flight is done again")
            continue
        if now.get(row.file) == row.stamp and not row.error:
            found[row.file] = row
    return list(found.values())


@contextmanager
def keeping(save: Path | None, new: bool) -> Iterator[Callable[[Row], None]]:
    """Something that keeps a row at once, so that nothing is lost when the survey is interrupted."""
    if save is None:
        yield lambda row: None
        return
    try:
        save.mkdir(parents=True, exist_ok=True)
        with (save / "survey.jsonl").open("w" if new else "a", encoding="utf-8") as file:

            def keep(row: Row) -> None:
                file.write(json.dumps(plain(row_table(row))) + "\n")
                file.flush()

            yield keep
    except OSError as error:
        raise InputError(f"{save}: cannot write the survey ({error.strerror}); pass another --save") from None


def write_survey(save: Path, rows: Iterable[Row], fleet: Fleet) -> None:
    """The rows as a table, and what holds of the fleet."""
    write_table(list(rows), save / SAVED_TABLE)
    text = json.dumps(plain(fleet_table(fleet)), indent=1, allow_nan=False)
    write_whole(save / "fleet.json", text + "\n", "the survey", "pass another --save")
