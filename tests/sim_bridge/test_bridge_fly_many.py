"""`sim-bridge fly-many`: what a table asks for is flown, by name, as `fly` would; what is wrong in it is told in a
line."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
from bridge_process import QUAD5
from typer.testing import CliRunner

from trueflight.models.errors import InputError
from trueflight.models.record import read_record
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.cli import app
from trueflight.sim_bridge.many.batches import AT_ONCE, WORTH_IT, batched, record_all, seconds_of
from trueflight.sim_bridge.many.variations import Row, of_seeds, rows_of, varied
from trueflight.sim_bridge.truth.hidden import choose

VEHICLE = QUAD5 / "vehicle.toml"
USUAL = Row(trajectory="hover", set=("duration=0.5",), vehicle=str(VEHICLE))


def table(folder: Path, text: str) -> Path:
    path = folder / "flights.csv"
    path.write_text(text)
    return path


def test_a_row_says_what_differs(tmp_path: Path, vehicle: Vehicle) -> None:
    text = "name,hidden,seed,set,rotor-speeds\nwindy,wind:4@1;rotor_drag,7,duration=2;height=1.5,no\n,,,,\nusual,,,,\n"
    windy, usual = varied(rows_of(table(tmp_path, text), USUAL))
    assert windy.plan.hidden == choose(["wind:4@1", "rotor_drag"], vehicle, 7)
    assert (windy.plan.seed, windy.plan.trajectory.duration, windy.plan.rotor_speeds) == (7, 2.0, False)
    assert (usual.plan.seed, usual.plan.trajectory.duration, usual.plan.rotor_speeds) == (0, 0.5, True)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "is empty"),
        ("sed\n1\n", "column 'sed' is no option"),
        ("seed,seed\n1,2\n", "stands there twice"),
        ("seed\nx\n", "row 2: seed is 'x'; it must be a whole number"),
        ("seed,noise\n1\n", "row 2: has 1 cells, the first row 2"),
        ("rotor_speeds\nmaybe\n", "write true or false"),
        ("seed\n", "has 0 flights"),
        ("name\na/b\n", "no file's"),
        ("name\na\na\n", "taken by an earlier one"),
        ("hidden\nwnd\n", "flight '0001': --hidden wnd: unknown effect"),
        ("charge\n7\n", "--charge 7 is outside"),
        ("settle\n-1\n", "--settle -1 is outside"),
        ("rate\n120\n", "must divide"),
        ("model\nnone.onnx\n", "cannot read it"),
        ("trajectory\nnone.csv\n", "cannot read it"),
    ],
)
def test_a_wrong_table_is_told_in_one_line(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(InputError) as caught:
        varied(rows_of(table(tmp_path, text), USUAL))
    assert told in str(caught.value) and "\n" not in str(caught.value)


def test_batches_hold_flights_of_one_rate_and_similar_length() -> None:
    rows = (
        of_seeds(USUAL, 2 * AT_ONCE + 10)
        + [Row(**{**USUAL.__dict__, "rate": 50.0, "set": ("duration=9",)})] * 3
    )
    flights = varied(rows)
    batches = batched(flights, 2)
    assert sorted(one.name for batch in batches for one in batch) == [one.name for one in flights]
    assert all(len({one.plan.rate for one in batch}) == 1 and len(batch) <= AT_ONCE for batch in batches)
    assert [len(batch) for batch in batched(flights[: WORTH_IT + 1], 2)] == [13, 12]
    mixed = varied([Row(**{**USUAL.__dict__, "set": (f"duration={1 + i % 7}",)}) for i in range(40)])
    lengths = [[seconds_of(one.plan) for one in batch] for batch in batched(mixed, 4)]
    assert all(min(one) >= max(other) for one, other in itertools.pairwise(lengths))


def test_the_command_flies_each_as_fly_does_and_overwrites_nothing(tmp_path: Path) -> None:
    words = ["--vehicle", str(VEHICLE), "--trajectory", "hover", "--set", "duration=0.5", "--hidden", "any"]
    many = CliRunner().invoke(
        app,
        [
            "fly-many",
            *words,
            "--seeds",
            "25",
            "--seed",
            "4",
            "--jobs",
            "1",
            "-o",
            str(tmp_path / "all"),
            "--json",
        ],
    )
    told = json.loads(many.stdout)["flights"]
    assert [one["outcome"] for one in told] == 25 * ["finished"]
    alone = tmp_path / "alone.mcap"
    assert CliRunner().invoke(app, ["fly", *words, "--seed", "6", "-o", str(alone)]).exit_code == 0
    one, other = read_record(alone), read_record(told[2]["record"])
    assert one.ticks["specific_force"] == pytest.approx(other.ticks["specific_force"], abs=1e-9)
    answers = [
        CliRunner().invoke(app, ["reveal", str(path), "--json"]).stdout
        for path in (alone.with_suffix(".sealed"), told[2]["sealed"])
    ]
    assert answers[0] == answers[1]
    with pytest.raises(InputError, match="never overwritten"):
        list(record_all(varied(of_seeds(USUAL, 2)), tmp_path / "all", 1))
    for wrong in ([], ["--seeds", "1", "--flights", "x.csv"]):
        refused = CliRunner().invoke(app, ["fly-many", *words, *wrong, "-o", str(tmp_path / "none")])
        assert isinstance(refused.exception, InputError) and not (tmp_path / "none").exists()
