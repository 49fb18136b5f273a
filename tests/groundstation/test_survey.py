"""A folder of flights is one analysis: every flight a row, a bad one told and skipped, the fleet as a whole."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from json_schemas import valid
from pyarrow import parquet
from simulated import VEHICLE
from widths import whole_at_every_width

from trueflight.groundstation.commands.app import app
from trueflight.groundstation.evaluate.survey import (
    Estimate,
    Row,
    fleet_of,
    survey,
    survey_files,
    survey_flight,
)
from trueflight.models.design import load_design
from trueflight.models.errors import InputError, run_command_line
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import Hidden, choose
from trueflight.sim_bridge.truth.sensors import Noise

DRAG = {"one": 0.20, "two": 0.30}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five short flights each of two vehicles with different drag, and two files that are no flights."""
    root = tmp_path_factory.mktemp("fleet")
    believed = load_vehicle(VEHICLE)
    design = load_design(VEHICLE.with_name("design.json"), believed)
    flown = trajectory("lemniscate", speed=2.5, laps=1)
    for name, drag in DRAG.items():
        vehicle = replace(believed, name=name)
        (root / name).mkdir()
        for number in range(1, 6):
            hidden = choose([f"rotor_drag:{drag + 0.005 * number}"], vehicle, 1)
            plan = Plan(vehicle, replace(design, vehicle=name), flown, hidden, number, noise=Noise())
            record(plan, root / name / f"2026-05-{number:02d}.mcap")
    (root / "notes.csv").write_text("t,position_x\n0,nonsense\n")
    cut = (root / "one" / "2026-05-01.mcap").read_bytes()[:2500]
    (root / "two" / "cut.mcap").write_bytes(cut)
    # a card's log whose beginning is damaged, and a photograph: nothing tells that they are logs
    (root / "two" / "log00").write_bytes(b"\x00\x01\x02" + bytes(500))
    (root / "photo.jpg").write_bytes(b"no log")
    (root / "LOG00001.BFL").write_bytes(b"H Product:Blackbox flight data recorder by Nicholas Sherlock")
    return root


def run(capsys, monkeypatch, *arguments) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["groundstation", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped, whole_at_every_width():
        run_command_line(app)
    told = capsys.readouterr()
    return int(stopped.value.code or 0), told.out, told.err


def test_every_flight_is_a_row_and_a_bad_file_is_skipped(folder, tmp_path, capsys, monkeypatch) -> None:
    pytest.importorskip("distributed")
    code, out, _ = run(
        capsys, monkeypatch, "survey", folder, "--save", tmp_path, "--jobs", 2, "--memory", "1GB", "--json"
    )
    assert code == 0
    result = valid("groundstation survey", json.loads(out))
    assert len(result["flights"]) == 12
    failed = [r for r in result["flights"] if r["error"]]
    assert {os.path.basename(r["file"]) for r in failed} == {"notes.csv", "cut.mcap"}
    assert all("\n" not in r["error"] for r in failed)
    fleet = result["fleet"]
    assert (fleet["flights"], fleet["failed"], fleet["vehicles"]) == (12, 2, ["one", "two"])
    assert fleet["passed_over"] == 3
    assert all(r["seconds"] > 0.0 for r in result["flights"])
    drag = next(e for e in fleet["effects"] if e["effect"] == "rotor_drag")
    assert drag["counts"]["missing"] >= 9
    spread = next(p for p in fleet["parameters"] if (p["effect"], p["parameter"]) == ("rotor_drag", "x"))
    # two vehicles whose drag is 0.1 1/s apart, and 0.005 1/s more a day
    assert spread["between_vehicles"] == pytest.approx(0.1 / np.sqrt(2.0), rel=0.2)
    assert spread["between_flights"] < 0.3 * spread["between_vehicles"]
    assert spread["trend_per_day"] == pytest.approx(0.005, abs=0.003)

    table = parquet.read_table(tmp_path / "survey.parquet").to_pydict()
    assert len(table["file"]) == 12
    assert table["verdict_rotor_drag"].count("missing") == drag["counts"]["missing"]
    assert json.loads((tmp_path / "fleet.json").read_text()) == fleet

    # interrupted in the middle of a line, it goes on with what is left
    lines = (tmp_path / "survey.jsonl").read_text().splitlines()
    (tmp_path / "survey.jsonl").write_text("\n".join(lines[:-3]) + "\n" + lines[-3][:40])
    seen = []
    monkeypatch.setattr(
        "trueflight.groundstation.evaluate.survey.survey_flight",
        lambda file, *task: seen.append(file) or survey_flight(file, *task),
    )
    code, out, _ = run(capsys, monkeypatch, "survey", folder, "--save", tmp_path, "--jobs", 1, "--each-alone")
    assert code == 0
    assert len(seen) < 8
    assert "10 of 12 flights could be used, of 2 vehicles" in " ".join(out.split())
    said = " ".join(out.split())
    assert "2 files are no logs, by ending and beginning, and passed over: two/log00, photo.jpg" in said
    assert "LOG00001.BFL is a Betaflight blackbox: convert it by `blackbox_decode" in said


def test_a_worker_that_dies_costs_its_file_only(folder, tmp_path, monkeypatch) -> None:
    pytest.importorskip("distributed")
    files = survey_files(folder)[:4]
    monkeypatch.setattr("trueflight.groundstation.evaluate.survey.survey_flight", _dies_on_the_second)
    rows = list(survey(files, jobs=2))
    assert len(rows) == 4
    assert [r.file for r in rows if r.error] == [str(files[1].resolve())]


def _dies_on_the_second(file, *task):
    if file.endswith("2026-05-01.mcap") and f"{os.sep}one{os.sep}" in file:
        os._exit(9)
    return Row(file, "", "")


def test_no_scheduler_and_no_flights_are_told_in_one_line(folder, tmp_path, capsys, monkeypatch) -> None:
    code, _, err = run(capsys, monkeypatch, "survey", tmp_path)
    assert (code, err.count("\n")) == (2, 1)
    with pytest.raises(InputError, match="no such folder"):
        survey_files(tmp_path / "nowhere")


def rows_of(values: dict[str, list[float]], half: float) -> list[Row]:
    return [
        Row(
            f"{vehicle}{i}", "", f"2026-06-{i + 1:02d}", vehicle,
            verdicts={"thrust_gain": "missing"},
            estimates=(Estimate("thrust_gain", "gain", x, x - half, x + half, "1"),),
        )
        for vehicle, column in values.items()
        for i, x in enumerate(column)
    ]  # fmt: skip


def test_spread_is_parted_into_vehicles_flights_and_fits() -> None:
    rng = np.random.default_rng(4)
    values = {
        f"v{k}": (1.0 + rng.normal(0, 0.05) + rng.normal(0, 0.02, 20) + rng.normal(0, 0.01, 20)).tolist()
        for k in range(25)
    }
    (spread,) = fleet_of(rows_of(values, 1.96 * 0.01)).parameters
    assert spread.between_vehicles == pytest.approx(0.05, rel=0.3)
    assert spread.between_flights == pytest.approx(0.02, rel=0.15)
    assert spread.uncertainty == pytest.approx(0.01)
    assert spread.trend_p > 0.001


def test_a_trend_is_seen_beside_what_parts_the_vehicles() -> None:
    values = {v: (level - 0.01 * np.arange(12) + 0.002 * np.sin(np.arange(12))).tolist() for v, level in
              {"a": 1.0, "b": 1.5}.items()}  # fmt: skip
    (spread,) = fleet_of(rows_of(values, 0.01)).parameters
    assert spread.trend_per_day == pytest.approx(-0.01, rel=0.05)
    assert spread.trend_p < 1e-6


def test_what_changed_since_the_last_good_flight_is_told_with_its_day(tmp_path, capsys, monkeypatch) -> None:
    vehicle = load_vehicle(VEHICLE)
    design = load_design(VEHICLE.with_name("design.json"), vehicle)
    flown = trajectory("lemniscate", speed=2.5, laps=2)
    weak = Hidden("rotor_damage", {"loss": 0.06, "rotor": 3.0})
    for seed, (day, hidden) in enumerate((("03-10", ()), ("03-12", ()), ("04-02", (weak,)))):
        record(Plan(vehicle, design, flown, hidden, seed, noise=Noise()), tmp_path / f"log-2026-{day}.mcap")
    code, out, _ = run(capsys, monkeypatch, "survey", tmp_path, "--jobs", 1, "--json")
    assert code == 0
    (history,) = valid("groundstation survey", json.loads(out))["fleet"]["histories"]
    assert [os.path.basename(f) for f in history["flights"]] == [
        f"log-2026-{day}.mcap" for day in ("03-10", "03-12", "04-02")
    ]
    (change,) = history["changes"]
    told = "compared with 12 March 2026 (log-2026-03-12.mcap), rotor 3 has lost 6 % of its thrust"
    assert change["text"] == told
    assert (os.path.basename(change["since"]), change["parameter"]) == ("log-2026-04-02.mcap", "loss_3")
    assert change["after"]["value"] == pytest.approx(0.06, abs=0.005)
    code, out, _ = run(capsys, monkeypatch, "survey", tmp_path, "--jobs", 1, "--each-alone")
    assert code == 0 and "compared with" not in out
