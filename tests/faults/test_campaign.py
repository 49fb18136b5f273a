"""The campaign in miniature, among the long tests. `make faults` is the long form of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from floods import floods, starved
from promise import Row
from rig import PATIENT
from silences import kills

pytestmark = pytest.mark.realtime


def broken(rows: list[Row]) -> list[Row]:
    return [row for row in rows if not row.kept]


@pytest.mark.long
def test_a_flight_goes_on_in_floods_and_obeys_none_of_them(tmp_path: Path) -> None:
    rows = list(floods(tmp_path, 100, 1, gap=10.0, settings=PATIENT))  # a busy machine makes gaps of its own
    assert len(rows) == 10
    assert broken(rows) == []


@pytest.mark.long
def test_a_killed_companion_leaves_a_record_and_a_store_that_the_next_one_uses(tmp_path: Path) -> None:
    _, *left_behind = kills(tmp_path, 1, 1)
    assert len(left_behind) == 3
    assert broken(left_behind) == []


@pytest.mark.long
def test_a_companion_without_memory_leads_nobody_astray(tmp_path: Path) -> None:
    rows = list(starved(tmp_path, 2.0, processors=(), spares=(0,)))
    assert len(rows) == 1
    assert broken(rows) == []
