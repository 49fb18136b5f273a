"""Columns in another unit, at the end of their range or running away: which, since when, how far, and a line that
reads the rest, which it does."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from simulated import VEHICLE, simulated

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.writing import write_flight
from trueflight.models.errors import InputError

SIXTEEN_G = 16 * 9.80665


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], np.ndarray]:
    """Names and numbers of a good flight in the project's own format."""
    path = tmp_path_factory.mktemp("good") / "flight.csv"
    write_flight(simulated(3, kind="lemniscate"), path)
    lines = path.read_text().splitlines()
    return lines[0].replace('"', "").split(","), np.loadtxt(lines[1:], delimiter=",")


def written(path: Path, names: list[str], numbers: np.ndarray) -> Path:
    np.savetxt(path, numbers, "%.6f", ",", header=",".join(names), comments="")
    return path


def refused(path: Path, *mapping: str) -> str:
    with pytest.raises(InputError) as caught:
        read_flight(path, VEHICLE, list(mapping))
    return str(caught.value)


@pytest.mark.parametrize(
    ("column", "worth", "says"),
    [
        ("specific_force_x", 300.0, "specific_force_x is beyond 157 m/s^2 (16 g)"),
        ("specific_force_z", SIXTEEN_G, "specific_force_z is beyond 157 m/s^2 (16 g)"),
        ("angular_velocity_y", 200.0, "angular_velocity_y is beyond 60 rad/s"),
        ("thrust_command", 12.0, "thrust_command is beyond full throttle"),
    ],
)
def test_what_runs_away_is_told_with_its_time_and_the_line_reads_the_rest(
    column: str, worth: float, says: str, table: tuple[list[str], np.ndarray], tmp_path: Path
) -> None:
    names, good = table
    numbers, t = good.copy(), good[:, names.index("t")]
    since = t[0] + 0.6 * np.ptp(t)
    numbers[t > since, names.index(column)] = worth
    path = written(tmp_path / "away.csv", names, numbers)
    line = refused(path)
    assert says in line
    assert f"from t = {since:.1f} s on" in line or f"from t = {since + 0.1:.1f} s on" in line
    assert f"up to {worth:.4g}" in line
    cut = re.search(r"--mapping '(time\.until = [\d.]+)'", line)
    assert cut is not None
    flight = read_flight(path, VEHICLE, [cut[1]])
    assert flight.t[-1] <= since
    assert any(note.startswith("cut to t = ") for note in flight.notes)


def test_what_is_left_out_is_as_if_it_had_not_been_logged(
    table: tuple[list[str], np.ndarray], tmp_path: Path
) -> None:
    names, good = table
    numbers = good.copy()
    numbers[:, names.index("specific_force_x")] = 300.0
    path = written(tmp_path / "away.csv", names, numbers)
    assert "in 100 % of the flight" in (line := refused(path))
    assert "specific_force.leave_out = true" in line
    assert read_flight(path, VEHICLE, ["specific_force.leave_out = true"]).specific_force is None
    assert "no thrust_command" in refused(path, "thrust_command.leave_out = true")


@pytest.mark.parametrize(
    ("mapping", "says"),
    [
        ("time.until = -5", "nothing is left"),
        ('time.until = "end"', "must be a number (s)"),
        ("specific_force.leave_out = 3", "must be true or false"),
        ("time.leave_out = true", "unknown key 'leave_out'"),
    ],
)
def test_a_cut_that_cannot_be_is_told(
    mapping: str, says: str, table: tuple[list[str], np.ndarray], tmp_path: Path
) -> None:
    assert says in refused(written(tmp_path / "flight.csv", *table), mapping)


@pytest.mark.parametrize("quantity", ["thrust_command", "motor_command"])
@pytest.mark.parametrize(
    ("unit", "factor", "offset"),
    [("percent", 100, 0), ("pwm", 1000, 1000), ("dshot", 1999, 48), ("u16", 65535, 0)],
)
def test_commands_in_another_unit_are_told_with_the_line_that_reads_them(
    quantity: str,
    unit: str,
    factor: float,
    offset: float,
    table: tuple[list[str], np.ndarray],
    tmp_path: Path,
) -> None:
    names, good = table
    command = good[:, names.index("thrust_command")]
    if quantity == "motor_command":
        names = [*names, *(f"motor_command_{k}" for k in range(1, 5))]
        numbers = np.column_stack([good, *[factor * command + offset] * 4])
    else:
        numbers = good.copy()
        numbers[:, names.index("thrust_command")] = factor * command + offset
    path = written(tmp_path / "flight.csv", names, numbers)
    line = f'{quantity}.unit = "{unit}"'
    assert f"--mapping '{line}'" in refused(path)
    flight = read_flight(path, VEHICLE, [line])
    assert np.nanmax(getattr(flight, quantity)) < 1.0
