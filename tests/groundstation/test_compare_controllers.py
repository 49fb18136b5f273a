"""Controllers beside each other: flown by the real program, in both measures, kept, and refused by name."""

import json
from pathlib import Path

import programs
import pytest
from json_schemas import valid

from trueflight.groundstation.study import margins as margins_module
from trueflight.groundstation.study.controllers import Cell, chosen_controllers
from trueflight.groundstation.study.disturbances import DISTURBANCES, LIMITS, Disturbance
from trueflight.groundstation.study.margins import ROUNDS, Margin, find_margins
from trueflight.groundstation.study.reproduce import Asked
from trueflight.models.contract import CONTROLLERS
from trueflight.models.shipped import QUAD5
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.plan import trajectory_of
from trueflight.sim_bridge.truth.hidden import choose


def asked(output: Path, *more: str) -> tuple[str, ...]:
    return ("compare-controllers", "-o", str(output), "--seeds", "1", *more)


def test_two_controllers_in_a_wind_are_told_in_both_measures_and_kept(tmp_path: Path) -> None:
    words = asked(
        tmp_path / "study",
        *("--controller", "lqr", "--controller", "geometric", "--disturbance", "eight-4.2"),
        *("--hidden", "rotor_drag:0.4"),
    )
    done = programs.run("groundstation", *words, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = valid("groundstation compare-controllers", json.loads(done.stdout))
    reference = told["median"]["reference"]["eight-4.2"]
    assert 0.0 < reference["geometric"] < 0.7 * reference["lqr"]
    assert told["median"]["linear"]["eight-4.2"]["lqr"] > 0.05  # the wind is no part of the design
    again = programs.run("groundstation", *words, cwd=tmp_path)
    assert again.returncode == 0
    assert f"{100 * reference['lqr']:.1f}" in again.stdout and "to the linear behaviour" in again.stdout
    cells = sorted((tmp_path / "study" / "vehicle-1").glob("*.json"))
    assert len(cells) == 2 and all(Cell(**json.loads(c.read_text())).outcome == "finished" for c in cells)


def test_flight_that_is_lost_at_once_is_told_and_has_no_figures(tmp_path: Path) -> None:
    words = asked(
        tmp_path, "--controller", "lqr", "--disturbance", "eight-12.1", "--hidden", "transport_delay:0.4"
    )
    for _ in range(2):  # flown, and kept
        done = programs.run("groundstation", *words, "--json", cwd=tmp_path)
        told = valid("groundstation compare-controllers", json.loads(done.stdout))
        (flight,) = told["flights"]
        assert flight["outcome"] in ("lost", "crashed") and flight["reference"] is None
        assert told["median"]["linear"]["eight-12.1"] == {}
    assert "lost" in programs.run("groundstation", *words, cwd=tmp_path).stdout


def test_margins_are_found_kept_and_told_with_their_limits(tmp_path: Path, monkeypatch) -> None:
    told: list[int] = []
    asked = Asked(tmp_path, QUAD5, ("rotor_drag:0.3",), 5.0)
    limits = [limit for limit in LIMITS if limit.name == "delay"]

    def found() -> list[Margin]:
        return find_margins(asked, [1], limits, ["lqr"], 1, lambda what, done: told.append(done))

    first = found()
    assert sum(told) == ROUNDS
    assert first[0].size is not None and 0.05 < first[0].size < 0.32 and not first[0].beyond
    assert [path.name for path in (tmp_path / "vehicle-1").iterdir()] == ["margins.json"]
    monkeypatch.setattr(margins_module, "fly_table", None)  # nothing is flown again
    assert found() == first


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--controller", "pid"), "--controller 'pid' is unknown"),
        (("--controller", "corrected_adaptive"), "--controller corrected_adaptive: it flies one by one"),
        (("--disturbance", "rain"), "--disturbance rain: unknown"),
    ],
)
def test_unknown_names_are_refused_in_one_line_and_nothing_is_made(words, told: str, tmp_path: Path) -> None:
    done = programs.run("groundstation", *asked(tmp_path / "study", *words), cwd=tmp_path)
    assert done.returncode == 2 and told in done.stderr
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize(
    "one", [*DISTURBANCES, *(limit.at(size) for limit in LIMITS for size in (limit.least, limit.most))]
)
def test_simulator_knows_every_disturbance(one: Disturbance) -> None:
    vehicle = load_vehicle(QUAD5)
    assert len(choose(list(one.hidden) or ["none"], vehicle, 1)) == len(one.hidden)
    settings = [f"{key}={value:g}" for key, value in one.settings(1).items()]
    assert trajectory_of(one.trajectory, settings).duration > 10.0


def test_every_controller_is_flown_unless_some_are_named() -> None:
    assert {*CONTROLLERS} - {"corrected_adaptive"} <= set(chosen_controllers(None))
    assert len({d.name for d in DISTURBANCES}) == len(DISTURBANCES)
