"""A study of calibration counts what it says it counts, and flies what it says it flies."""

import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from json_schemas import valid
from simulated import VEHICLE
from widths import whole_at_every_width

from trueflight.groundstation.commands.app import app
from trueflight.groundstation.evaluate.calibration import (
    ABSENT,
    MISSING,
    NOT_EXCITED,
    NOTHING,
    POSSIBLE,
    Case,
    Claim,
    Estimated,
    Said,
    calibrate,
    claims_of,
    posterior,
    proportion,
    reliability,
    wrongs,
)
from trueflight.groundstation.output.as_json import calibration_table
from trueflight.groundstation.output.calibration_tables import print_calibration
from trueflight.groundstation.report.calibration import CHARTS, render_calibration
from trueflight.groundstation.study.batch import table_text
from trueflight.groundstation.study.calibration_study import (
    STRENGTHS,
    TOP,
    Study,
    flight_rows,
    hideable,
    path_of,
    setpoints,
    sorties,
)
from trueflight.groundstation.study.cases import begins_of, truth_of
from trueflight.groundstation.study.logged import lagged, thinned
from trueflight.models.effects import catalogue
from trueflight.models.errors import run_command_line
from trueflight.models.flight import Flight
from trueflight.models.reference import trajectory_from_csv
from trueflight.models.terminal import Terminal
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.truth.effects import EFFECTS

NAMES = ("thrust_gain", "rotor_drag", "wind", "ceiling_effect", "vortex_ring", "com_offset")


def said(name: str, verdict: str, rank=None, p=1.0, group=(), estimates=(), share=0.5, **more) -> Said:
    return Said(name, verdict, rank, share, p, tuple(group), tuple(estimates), **more)


def case(number: int, truth: tuple[str, ...], *told: Said, **more) -> Case:
    """A flight of which all that is not told is denied."""
    rest = [said(n, ABSENT) for n in NAMES if n not in {s.name for s in told}]
    given = {"kind": "survey", "seconds": 90.0, "noise": 1.0, "rotor_speeds": True, "vehicle": "quad5"} | more
    return Case(number, truth=truth, said=(*told, *rest), rms=(1.0, 0.1, 0.1), diagnosis_seconds=1.0, **given)


FOUND = case(1, ("rotor_drag",), said("rotor_drag", MISSING, 1, 1e-9))
CLEAN = case(2, ())
ALARM = case(3, (), said("wind", MISSING, 1, 1e-4))
SWAPPED = case(4, ("wind",), said("com_offset", MISSING, 1, 1e-9))
GROUP = case(
    5,
    ("thrust_gain",),
    said("rotor_drag", POSSIBLE, 1, 1e-6, ["thrust_gain"]),
    said("thrust_gain", POSSIBLE, None, 1e-6, ["rotor_drag"]),
)
UNSEEN = case(
    6, ("com_offset", "rotor_drag"), said("rotor_drag", MISSING, 1, 0.0), said("com_offset", NOT_EXCITED)
)
STANDS_FOR = case(
    7, ("com_offset",), said("thrust_gain", MISSING, 1, 0.0, ["com_offset"]), said("com_offset", NOT_EXCITED)
)
DENIED = case(8, ("ceiling_effect",))
EVERY = (FOUND, CLEAN, ALARM, SWAPPED, GROUP, UNSEEN, STANDS_FOR, DENIED)


def test_share_has_wilsons_interval() -> None:
    found = proportion([True] * 8 + [False] * 2)
    # Brown, Cai, DasGupta 2001 (Statistical Science 16), Wilson interval, 8 of 10
    assert (found.count, found.of, found.share) == (8, 10, 0.8)
    assert (found.low, found.high) == pytest.approx((0.490, 0.943), abs=5e-4)
    assert math.isnan(proportion([]).share)


@pytest.mark.parametrize(
    ("flight", "effect", "outcome"),
    [
        (FOUND, "rotor_drag", MISSING),
        (GROUP, "thrust_gain", POSSIBLE),
        (STANDS_FOR, "com_offset", POSSIBLE),
        (UNSEEN, "com_offset", NOT_EXCITED),
        (SWAPPED, "wind", ABSENT),
        (DENIED, "ceiling_effect", ABSENT),
    ],
)
def test_outcome_of_a_hidden_effect(flight: Case, effect: str, outcome: str) -> None:
    assert flight.outcome(effect) == outcome


@pytest.mark.parametrize(
    ("flight", "exact", "right", "honest"),
    [
        (FOUND, True, True, True),
        (CLEAN, True, True, True),
        (ALARM, False, False, False),
        (SWAPPED, False, False, False),
        (GROUP, False, True, True),
        (STANDS_FOR, False, True, True),
        (UNSEEN, False, False, True),
        (DENIED, False, False, False),
    ],
)
def test_when_a_flight_is_right(flight: Case, exact: bool, right: bool, honest: bool) -> None:
    assert (flight.exact, flight.right, flight.honest) == (exact, right, honest)


def test_a_group_excuses_nothing_that_is_found_beside_it() -> None:
    both = case(
        1,
        ("rotor_drag",),
        said("rotor_drag", MISSING, 1, 0.0),
        said("wind", MISSING, 2, 1e-5, ["rotor_drag"]),
    )
    assert both.false(MISSING) == ("wind",)


def test_confusion_matrix_adds_up() -> None:
    result = calibrate(EVERY)
    rows = {row.effect: row for row in result.confusion}
    assert rows["wind"].instead == {"com_offset": 1}
    assert rows["rotor_drag"].outcomes == {MISSING: 2, POSSIBLE: 0, NOT_EXCITED: 0, ABSENT: 0}
    assert rows[NOTHING].instead == {"wind": 1}
    assert all(sum(row.outcomes.values()) == row.hidden for row in result.confusion if row.effect != NOTHING)
    assert sum(row.hidden for row in result.confusion if row.effect != NOTHING) == sum(
        len(c.truth) for c in EVERY
    )


def test_false_alarms_are_counted_where_nothing_is_hidden() -> None:
    result = calibrate(EVERY)
    assert (result.false_alarm.count, result.false_alarm.of) == (1, 2)
    assert (result.false_effects.count, result.false_effects.of) == (2, 8)
    assert (result.exact.count, result.right.count, result.honest.count) == (2, 4, 5)
    assert {name: share.count for name, share in result.by["hidden effects"].items()} == {
        "0": 1,
        "1": 3,
        "2": 0,
    }


def test_a_flight_that_was_not_finished_or_not_diagnosed_is_told_and_not_counted() -> None:
    result = calibrate([FOUND, replace(CLEAN, said=()), replace(CLEAN, said=(), error="ValueError: no")])
    assert (result.flights, result.not_flown, result.failed, result.exact.of) == (3, 1, 1, 1)
    assert [w.why for w in result.wrong] == ["ValueError: no"]


def test_an_effect_that_begins_in_flight_is_explained_only_with_the_moment() -> None:
    def begun(moments: tuple[float, ...], **more) -> Case:
        told = said("rotor_drag", MISSING, 1, 0.0, (), moments=moments)
        return case(1, ("rotor_drag",), told, begins={"rotor_drag": 40.0}, **more)

    on_time, late, untold = begun((41.0,)), begun((20.0, 44.0)), begun(())
    assert [c.untimed() for c in (on_time, late, untold)] == [(), ("rotor_drag",), ("rotor_drag",)]
    assert [c.wrong for c in (on_time, late, untold)] == [False, True, True]
    doubted = begun((), unexplained=True)
    assert (doubted.wrong, doubted.flagged) == (True, True)
    result = calibrate([on_time, late, untold, doubted])
    assert (result.timed.count, result.timed.of) == (1, 4)
    assert (result.unflagged.count, result.unflagged.of) == (2, 4)
    assert result.by["begins in flight"]["one"].of == 4
    assert ["begins at 40 s, told: 20.0 s, 44.0 s" in w.why for w in wrongs(late)] == [True, False]
    # a wind that comes with its drag is timed by the drag
    drag, wind = untold.said[0], said("wind", MISSING, 2, 0.0)
    together = {"rotor_drag": 40.0, "wind": 40.0}
    for moments, untimed in (((40.0,), ()), ((), ("rotor_drag", "wind"))):
        both = case(1, tuple(together), replace(drag, moments=moments), wind, begins=together)
        assert both.untimed() == untimed
    # one that was never named is denied, not untimed
    assert case(2, ("wind",), begins={"wind": 40.0}).untimed() == ()


def test_wrong_explanations_are_flagged_by_what_is_unexplained_or_only_possible() -> None:
    assert [c.number for c in EVERY if c.wrong] == [3, 4, 8]
    assert calibrate(EVERY).unflagged.count == 3
    doubts = [replace(c, unexplained=True) for c in EVERY]
    assert calibrate(doubts).unflagged.count == 0


def test_intervals_of_what_begins_in_flight_count_where_the_moment_is_told() -> None:
    drag = [Estimated("x", 0.3, 0.2, 0.4, 0.31)]
    for moments, counted in (((40.5,), 1), ((), 0)):
        told = said("rotor_drag", MISSING, 1, 0.0, (), drag, moments=moments)
        flight = case(1, ("rotor_drag",), told, begins={"rotor_drag": 40.0})
        assert len(calibrate([flight]).coverage) == 2 * counted


def test_coverage_and_the_factor_that_intervals_lack() -> None:
    flights = [
        case(
            k,
            ("rotor_drag",),
            said(
                "rotor_drag",
                MISSING,
                1,
                0.0,
                (),
                [Estimated("x", 1.0 + 0.1 * k, 0.5 + 0.1 * k, 1.5 + 0.1 * k, 1.0)],
            ),
        )
        for k in range(1, 11)
    ]
    overall, drag = calibrate(flights).coverage
    assert overall.inside == drag.inside
    assert (drag.inside.count, drag.inside.of) == (5, 10)
    assert drag.widen == pytest.approx(2.0)  # the worst of ten is a whole 1.0 away, with half widths of 0.5
    assert drag.error == pytest.approx(0.55)
    assert sum("interval" in w.why for k in flights for w in wrongs(k)) == 5


def test_intervals_beside_what_was_not_found_are_not_counted() -> None:
    off = said("rotor_drag", MISSING, 1, 0.0, (), [Estimated("x", 2.0, 1.9, 2.1, 1.0)])
    assert calibrate([case(1, ("rotor_drag", "wind"), off)]).coverage == ()


@pytest.mark.parametrize(("p", "least"), [(0.05, 0.289), (0.01, 0.111), (0.001, 0.0184)])
def test_a_p_value_makes_no_surer_than_its_calibration(p: float, least: float) -> None:
    # Sellke, Bayarri, Berger 2001, table 1: least probability of the null hypothesis at even odds
    assert 1.0 - posterior(p, 1.0) == pytest.approx(least, abs=6e-4)
    assert posterior(0.9, 3.0) == 0.25
    assert posterior(0.0, 100.0) == pytest.approx(1.0)


def test_claims_are_binned_by_how_sure_they_are() -> None:
    sure = [Claim(k, "wind", True, 0.97, k > 0) for k in range(10)]
    unsure = [Claim(k, "wind", True, 0.3, False) for k in range(3)]
    found = reliability(sure + unsure)
    assert [(b.low, b.high, b.right.count, b.right.of) for b in found.bins] == [
        (0.0, 0.5, 0, 3),
        (0.95, 0.99, 9, 10),
    ]
    assert (found.called_sure.count, found.called_sure.of) == (9, 10)
    assert found.brier == pytest.approx((9 * 0.03**2 + 0.97**2 + 3 * 0.3**2) / 13)
    assert math.isnan(reliability([]).brier)


def test_a_group_claims_that_one_of_it_is_there() -> None:
    present = [c for c in claims_of(GROUP) if c.present]
    assert [(c.effect, c.right) for c in present] == [("rotor_drag", True)]
    denied = [c for c in claims_of(DENIED) if not c.right]
    assert [(c.effect, c.present) for c in denied] == [("ceiling_effect", False)]


def test_a_verdicts_own_confidence_comes_first() -> None:
    told = case(1, ("wind",), said("wind", MISSING, 1, 1e-9, confidence=0.8))
    assert [c.sure for c in claims_of(told) if c.present] == [0.8]


def test_true_values_are_those_of_the_simulator() -> None:
    vehicle = load_vehicle(VEHICLE)
    hidden = {
        "transport_delay": {"extra_delay": 0.02},
        "rotor_damage": {"rotor": 3.0, "loss": 0.1},
        "wind": {"speed": 5.0, "east": 3.0, "north": -4.0, "drag": 0.2},
        "thrust_curve": {"curvature": 0.5},
    }
    told = [{"name": n, "parameters": {k: {"value": v} for k, v in p.items()}} for n, p in hidden.items()]
    true = truth_of(told, vehicle)
    assert true["transport_delay"] == {"delay": vehicle.command_delay + 0.02}
    assert true["rotor_damage"] == {"loss_1": 0.0, "loss_2": 0.0, "loss_3": 0.1, "loss_4": 0.0}
    assert true["wind"] == {"x": 3.0, "y": -4.0}
    assert true["rotor_drag"] == {"x": 0.2, "y": 0.2}, "wind brings the drag that it acts through"
    assert true["thrust_curve"] == {}, "another law: no true value"
    with_drag = [*told, {"name": "parasitic_drag", "parameters": {k: {"value": 0.05} for k in "xyz"}}]
    assert "rotor_drag" not in truth_of(with_drag, vehicle)


def test_what_an_effect_brings_along_begins_with_it() -> None:
    wind = {"name": "wind", "parameters": {}, "begins": {"value": 40.0, "unit": "s"}}
    drag, gain = {"name": "rotor_drag", "parameters": {}}, {"name": "thrust_gain", "parameters": {}}
    assert begins_of([wind, gain], ("wind", "rotor_drag", "thrust_gain")) == {
        "wind": 40.0,
        "rotor_drag": 40.0,
    }
    assert begins_of([wind, drag], ("wind", "rotor_drag")) == {"wind": 40.0}


def test_what_an_effect_calls_its_truth_is_a_number_of_the_simulator() -> None:
    for name, effect in catalogue().items():
        named = {p.truth for p in effect.parameters} | {effect.carrier_truth}
        assert named - {""} <= set(EFFECTS[name].units if name in EFFECTS else ()), name


# --- flights --------------------------------------------------------------------------------------------------------


@pytest.fixture
def study(tmp_path: Path) -> Study:
    beginners = ("thrust_gain", "rotor_drag", "wind")
    return Study(tmp_path, VEHICLE, VEHICLE.with_name("design.json"), 5, 60.0, NAMES, beginners=beginners)


def test_more_flights_begin_with_the_same_and_hide_everything_equally_often(study: Study) -> None:
    many = sorties(study, 100)
    assert many[:7] == sorties(study, 7)
    counts = [len(s.hidden) for s in many]
    assert [counts.count(n) for n in range(5)] == [30, 30, 20, 10, 10]
    hidden = [name for s in many for name in s.hidden]
    assert max(map(hidden.count, NAMES)) - min(map(hidden.count, NAMES)) <= 2
    assert all(len(set(s.hidden)) == len(s.hidden) for s in many)
    assert {s.rotor_speeds for s in many} == {True, False}
    assert sorties(replace(study, seed=6), 7) != many[:7]
    assert {s.strength for s in many} == set(STRENGTHS)
    assert {s.rate for s in many} == {100.0, 25.0}
    late = [s.late for s in many if s.late]
    assert 10 <= len(late) <= 30 and 0.03 <= min(late) <= max(late) <= 0.09
    begun = [s for s in many if s.begins]
    assert len(begun) > 10
    for s in begun:
        ((name, moment),) = s.begins.items()
        assert name in s.hidden and name in study.beginners
        assert 0.3 * s.seconds - 0.1 <= moment <= 0.75 * s.seconds + 0.1
        assert f"{name}@{moment}" in table_text(flight_rows(study, [s]))


def test_flights_are_long_enough_and_stay_below_the_ceiling(study: Study) -> None:
    vehicle = load_vehicle(VEHICLE)
    for sortie in sorties(study, 40):
        path = path_of(sortie, vehicle)
        assert path.duration >= sortie.seconds
        assert path.bounds[0][2] > 0.05
        if sortie.kind == "descent":
            assert "ceiling_effect" not in sortie.hidden
        else:
            assert path.bounds[1][2] <= TOP + 1e-6


def test_setpoints_are_the_path(study: Study) -> None:
    sortie = replace(sorties(study, 1)[0], kind="task")
    path = path_of(sortie, load_vehicle(VEHICLE))
    flown = trajectory_from_csv(setpoints(path))
    for t in (0.0, 7.3, 21.11, path.duration - 1.0):
        assert flown.at(t).position == pytest.approx(path.at(t).position, abs=1e-3)
        assert flown.at(t).velocity == pytest.approx(path.at(t).velocity, abs=2e-2)


def test_the_simulator_hides_all_of_the_catalogue_but_what_needs_no_parameter_or_has_no_law_there() -> None:
    assert set(catalogue()) - set(hideable()) == {"rigid_body", "axial_inflow"}


def test_a_poorer_log_is_late_by_its_lag_and_has_every_other_row() -> None:
    t = np.arange(1000) * 0.01
    ramp = np.column_stack([2.0 * t, 0.0 * t + 3.0, -t])
    flight = Flight("ramp", load_vehicle(VEHICLE), t, position=ramp, thrust_command=t, extra={"note": t})
    behind = lagged(flight, 0.05)
    # a first-order lag is late on a ramp by its time constant, less half of a row that is followed at once
    assert (ramp - behind.position)[-1] == pytest.approx(np.array([2.0, 0.0, -1.0]) * 0.045, abs=1e-3)
    assert behind.position[0] == pytest.approx(ramp[0])
    assert behind.velocity is None
    fewer = thinned(behind, 4)
    assert len(fewer) == len(fewer.position) == len(fewer.thrust_command) == len(fewer.extra["note"]) == 250
    assert fewer.t[1] == pytest.approx(0.04)
    assert lagged(flight, 0.0) is flight


def run(capsys, monkeypatch, *arguments) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["groundstation", "calibrate", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        run_command_line(app)
    told = capsys.readouterr()
    return int(stopped.value.code or 0), told.out, told.err


def test_a_study_is_flown_diagnosed_continued_and_not_mixed_with_another(
    tmp_path, capsys, monkeypatch
) -> None:
    folder = tmp_path / "study"
    words = ("--flights", 1, "--seconds", 40, "--seed", 3, "-o", folder, "--jobs", 1)
    code, out, _ = run(capsys, monkeypatch, *words, "--json")
    assert code == 0
    table = valid("groundstation calibrate", json.loads(out))
    assert table["flights"] == 1
    assert table["failed"] == table["not_flown"] == 0
    assert table == {
        "schema": 1,
        **json.loads((folder / "calibration.json").read_text()),
        "report": str(folder / "report.html"),
    }
    assert (folder / "confusion.png").stat().st_size > 5000
    records = {path: path.stat().st_mtime_ns for path in folder.glob("*.mcap")}
    diagnosed = {path: path.stat().st_mtime_ns for path in folder.glob("*.diagnosis.json")}
    assert len(records) == len(diagnosed) == 1
    # one more flight, that a run before left half-written: the others stay as they are
    (folder / "0002.mcap").write_bytes(b"half")
    code, out, _ = run(capsys, monkeypatch, "--flights", 2, *words[2:])
    assert code == 0
    assert "2 flights" in out
    assert all(path.stat().st_mtime_ns == then for path, then in {**records, **diagnosed}.items())
    told = json.loads((folder / "0002.flight.json").read_text())
    assert sorted(h["name"] for h in told["hidden"]) == sorted(told["sortie"]["hidden"])
    # another seed does not belong here
    code, _, err = run(capsys, monkeypatch, *words[:4], "--seed", 4, "-o", folder)
    assert code == 2
    assert "begun with seed 3, now 4" in err


def test_a_folder_with_other_files_is_not_written_to(tmp_path, capsys, monkeypatch) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    code, _, err = run(capsys, monkeypatch, "--flights", 1, "-o", tmp_path)
    assert code == 2
    assert "no study's" in err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_vehicle_without_design_is_told_how_to_get_one(tmp_path, capsys, monkeypatch) -> None:
    mine = tmp_path / "vehicle.toml"
    mine.write_bytes(VEHICLE.read_bytes())
    code, _, err = run(capsys, monkeypatch, mine, "-o", tmp_path / "study")
    assert code == 2
    assert "groundstation design" in err


def test_every_number_of_the_page_stands_in_the_table() -> None:
    drag = replace(FOUND.said[0], estimates=(Estimated("x", 0.3, 0.2, 0.4, 0.31),))
    cases = (*EVERY, replace(FOUND, said=(drag, *FOUND.said[1:])))
    table = json.loads(json.dumps(calibration_table(calibrate(cases), cases), allow_nan=False))
    table |= {"vehicle": "quad5", "seed": 1}
    page = render_calibration(table)
    found = re.findall(r'<data value="([^"]*)" data-path="([^"]+)"', page)
    assert len(found) > 60
    for value, place in found:
        here = table
        for key in place.split("."):
            here = here[int(key)] if isinstance(here, list) else here[key]
        assert json.loads(value.replace("&#34;", '"')) == here, place
    assert page.count("<svg") == len(CHARTS)
    assert "http://" not in re.sub(r'xmlns(:xlink)?="[^"]+"', "", page)
    assert "com_offset named instead of wind" in page


def test_every_number_is_whole_in_a_terminal(tmp_path: Path) -> None:
    drag = replace(FOUND.said[0], estimates=(Estimated("x", 0.3, 0.2, 0.4, 0.31),))
    with whole_at_every_width() as tables:
        cases = (*EVERY, replace(FOUND, said=(drag, *FOUND.said[1:])))
        print_calibration(Terminal(file=io.StringIO()), calibrate(cases), tmp_path)
    assert len(tables) == 6


def test_page_of_a_study_that_found_nothing_to_tell() -> None:
    table = json.loads(json.dumps(calibration_table(calibrate([CLEAN]), [CLEAN]), allow_nan=False))
    assert "Nothing." in render_calibration({**table, "vehicle": "quad5", "seed": 1})
