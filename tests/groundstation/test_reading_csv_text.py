"""A CSV file is the same flight however its logger or a spreadsheet wrote it down."""

import io

import numpy as np
import pytest
from simulated import simulated

from trueflight.groundstation.reading import read_flight, segments
from trueflight.groundstation.reading.csv_text import read_csv_text
from trueflight.groundstation.reading.writing import own_table
from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle

VEHICLE = Vehicle("quad5", mass=0.75, hover_thrust=0.38)


@pytest.fixture(scope="module")
def columns():
    table = own_table(simulated(3, "rotor_drag:0.4", kind="circle"))
    keep = (
        "t",
        "position",
        "velocity",
        "quaternion",
        "angular_velocity",
        "specific_force",
        "thrust",
        "battery",
    )
    return {name: np.asarray(c, dtype=float) for name, c in table.items() if name.startswith(keep)}


def text(columns):
    out = io.StringIO()
    np.savetxt(out, np.stack(list(columns.values()), -1), delimiter=",", fmt="%.9g")
    return ",".join(columns) + "\n" + out.getvalue()


def read(content, tmp_path):
    path = tmp_path / "flight.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_flight(path, VEHICLE)


def dated(whole):
    head, *rows = whole.splitlines()
    times = [f"2026-05-01 12:00:{float(row.split(',')[0]):09.6f}" for row in rows]
    return (
        "\n".join([head, *(f"{t},{row.split(',', 1)[1]}" for t, row in zip(times, rows, strict=True))]) + "\n"
    )


WRITTEN = {
    "a byte order mark": lambda s: s.encode("utf-8-sig"),
    "UTF-16": lambda s: s.encode("utf-16"),
    "carriage returns": lambda s: s.replace("\n", "\r\n"),
    "semicolons": lambda s: s.replace(",", ";"),
    "semicolons and decimal commas": lambda s: s.replace(",", ";").replace(".", ","),
    "tabs": lambda s: s.replace(",", "\t"),
    "blanks": lambda s: s.replace(",", "  "),
    "blanks after commas": lambda s: s.replace(",", ", "),
    "comments above": lambda s: "# log of a flight\n# board 7, 2 cells\n\n" + s,
    "names in a comment": lambda s: "# " + s,
    "units below the names": lambda s: s.replace("\n", "\ns" + ",m" * s.split("\n")[0].count(",") + "\n", 1),
    "blank lines": lambda s: s.replace("\n", "\n\n"),
    "quotes": lambda s: "\n".join(",".join(f'"{c}"' for c in row.split(",")) for row in s.splitlines()) + "\n",
    "a comma too many": lambda s: s.replace("\n", ",\n"),
    "dates": dated,
    "decimal commas in quotes": lambda s: "\n".join(
        ",".join('"' + c.replace(".", ",") + '"' for c in row.split(",")) for row in s.splitlines()
    ) + "\n",
    "decimal commas beside dates with points": lambda s: "\n".join(
        row.replace(",", ";").replace(".", ",") + (";27.11.2026" if k else ";day")
        for k, row in enumerate(s.splitlines())
    ) + "\n",
}  # fmt: skip


@pytest.mark.parametrize("way", WRITTEN)
def test_a_table_is_read_however_it_is_written(way, columns, tmp_path):
    plain = read(text(columns), tmp_path)
    other = read(WRITTEN[way](text(columns)), tmp_path)
    for name in ("t", "position", "quaternion", "thrust_command", "battery_voltage"):
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), atol=2e-6)


def test_decimal_commas_may_begin_late(tmp_path):
    path = tmp_path / "late.csv"
    path.write_text("t;x\n" + "".join(f"{k};0\n" for k in range(40)) + "41,5;0,25\n")
    assert read_csv_text(path).decimal == ","
    path.write_text("t;x\n" + "".join(f"{k};0\n" for k in range(40)) + "41.5;0.25\n")
    assert read_csv_text(path).decimal == "."


def test_latin_letters_in_a_name_are_no_obstacle(columns, tmp_path):
    content = text({**columns, "Neigung_°": columns["t"]}).encode("latin-1")
    flight = read(content, tmp_path)
    assert "Neigung_°" in flight.extra
    assert any("Latin-1" in note for note in flight.notes)


def test_a_line_that_is_no_row_is_left_out_and_named(columns, tmp_path):
    lines = text(columns).splitlines()
    flight = read("\n".join([*lines[:200], "ERROR buffer overflow", *lines[200:]]) + "\n", tmp_path)
    assert len(flight) == len(columns["t"])
    assert any("the first is line 201" in note for note in flight.notes)
    many = [line if row % 10 else "ERROR" for row, line in enumerate(lines, 1)]
    with pytest.raises(InputError, match="line 10: "):
        read("\n".join(many) + "\n", tmp_path)


def test_rows_out_of_order_are_sorted(columns, tmp_path):
    order = np.random.default_rng(1).permutation(len(columns["t"]))
    flight = read(text({name: column[order] for name, column in columns.items()}), tmp_path)
    assert any("not in order of time" in note for note in flight.notes)
    np.testing.assert_allclose(flight.position, read(text(columns), tmp_path).position)


def test_a_logger_that_started_again_is_not_sorted_together(columns, tmp_path):
    twice = {name: np.concatenate([column, column[:600]]) for name, column in columns.items()}
    twice["t"] = twice["t"] + np.where(np.arange(len(twice["t"])) < len(columns["t"]), 0.0, 3.004)
    with pytest.raises(InputError, match="time goes back"):
        read(text(twice), tmp_path)


def test_missing_values_in_a_row_are_a_gap_and_every_other_one_is_filled(columns, tmp_path):
    hole = {name: column.copy() for name, column in columns.items()}
    hole["velocity_x"][300:500] = np.nan
    flight = read(text(hole), tmp_path)
    assert len(segments(flight.t)) == 2 and len(flight) == len(columns["t"]) - 200
    slow = {name: column.copy() for name, column in columns.items()}
    for name in slow:
        if name.startswith(("position", "quaternion")):
            slow[name][np.arange(len(slow[name])) % 4 != 0] = np.nan
    flight = read(text(slow), tmp_path)
    assert any("interpolated between them" in note for note in flight.notes)
    same = slice(0, 1000)
    whole = read(text(columns), tmp_path)
    assert np.sqrt(np.mean((flight.position[same] - whole.position[same]) ** 2)) < 0.005
    np.testing.assert_allclose(np.linalg.norm(flight.quaternion, axis=1), 1.0, atol=1e-9)
    assert np.abs(np.sum(flight.quaternion[same] * whole.quaternion[same], axis=1)).min() > 0.999


def test_signs_of_a_quaternion_and_its_zeros_before_the_estimator_starts_do_no_harm(columns, tmp_path):
    random = np.random.default_rng(2)
    odd = {name: column.copy() for name, column in columns.items()}
    signs = np.where(random.random(len(odd["t"])) < 0.5, -1.0, 1.0)
    for axis in "wxyz":
        odd[f"quaternion_{axis}"] *= signs
        odd[f"quaternion_{axis}"][:20] = 0.0
    flight = read(text(odd), tmp_path)
    assert len(flight) == len(columns["t"]) - 20
    assert np.abs(np.diff(flight.quaternion, axis=0)).max() < 0.1
