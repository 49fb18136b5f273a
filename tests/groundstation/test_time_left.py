"""The time that a survey tells it will still take, on the durations of a real one."""

import csv
from pathlib import Path

import pytest

from trueflight.groundstation.evaluate.time_left import TimeLeft, in_words, kind_of, mixed

RECORDED = Path(__file__).with_name("survey_durations.csv")
"""Ending, bytes and seconds of a worker of 821 logs, whole and damaged, in the order of their names."""
WORKERS = 2


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory) -> dict[Path, float]:
    """Files as large as those were, and what each took."""
    folder = tmp_path_factory.mktemp("logs")
    found = {}
    for number, row in enumerate(csv.DictReader(RECORDED.read_text().splitlines())):
        path = folder / f"{number:04d}{row['ending']}"
        with path.open("wb") as file:
            file.truncate(int(row["bytes"]))
        found[path] = float(row["seconds"])
    return found


def flown_through(order: list[Path], seconds: dict[Path, float]) -> list[tuple[float, float | None]]:
    """Time, and time left as it was told, at each file that two workers have done; ends with what was true."""
    time_left = TimeLeft([kind_of(f) for f in order])
    free, done = [0.0] * WORKERS, []
    for file in order:
        worker = free.index(min(free))
        free[worker] += seconds[file]
        done.append((free[worker], file))
    told = []
    for at, file in sorted(done):
        time_left.done(kind_of(file), seconds[file])
        told.append((at, time_left.left(at)))
    return told


def test_the_time_left_is_about_right_from_early_on(surveyed: dict[Path, float]) -> None:
    told = flown_through(mixed(list(surveyed)), surveyed)
    end = told[-1][0]
    first = next(at for at, left in told if left is not None)
    assert first < 0.1 * end
    for at, left in told:
        if at > first and end - at > 0.1 * end:
            assert left is not None, at
            # by their names, at the mean rate so far, it is up to 2.4 times what is left
            assert 1 / 1.6 < left / (end - at) < 1.6, (at, left, end - at)
    assert told[-1][1] == 0.0


def test_nothing_is_told_before_enough_was_seen(surveyed: dict[Path, float]) -> None:
    told = flown_through(mixed(list(surveyed)), surveyed)
    assert all(left is None for _, left in told[:24])
    assert TimeLeft([(".bin", 4)] * 1000).left(10.0) is None


def test_an_order_is_the_same_each_time_and_its_beginning_has_all_kinds(surveyed: dict[Path, float]) -> None:
    files = list(surveyed)
    order = mixed(files)
    assert sorted(order) == sorted(files) and mixed(files[::-1]) == order
    for ending in (".bin", ".ulg", ".csv", ".mcap"):
        share = sum(f.suffix == ending for f in order[:100]) / 100
        assert share == pytest.approx(sum(f.suffix == ending for f in files) / len(files), abs=0.05)


@pytest.mark.parametrize(
    "seconds, words",
    [(None, "time left not known yet"), (3.0, "a few seconds left"), (42.0, "about 40 s left"),
     (246.0, "about 4 min left"), (9000.0, "about 2.5 h left")],
)  # fmt: skip
def test_the_time_is_told_as_well_as_it_is_known(seconds: float | None, words: str) -> None:
    assert in_words(seconds) == words
