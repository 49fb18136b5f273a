"""What a diagnosis tells in a terminal: nothing cut at any width, and a next step that can be pasted."""

import shlex
from dataclasses import replace
from pathlib import Path

import programs
import pytest
from rich.console import Console

from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.output.ranking import next_command, print_diagnosis
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.results import Change, Diagnosis, OverTime, Stretch
from trueflight.groundstation.versions.store import add_effect
from trueflight.models.model import read_model, rigid_body_model

DRAG = Path(__file__).parents[2] / "samples" / "rotorpy" / "rotor_drag"


@pytest.fixture(scope="module")
def diagnosis() -> Diagnosis:
    flight = read_flight(DRAG / "identify.parquet")
    return diagnose(flight, rigid_body_model(flight.vehicle))


def told(d: Diagnosis, width: int, everything: bool = False) -> str:
    console = Console(width=width, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    print_diagnosis(console, d, everything, DRAG / "validate.parquet")
    return console.export_text()


def long_one(d: Diagnosis) -> Diagnosis:
    """The same with a course over time and many rivals, which need room."""
    (found,) = [e for e in d.effects if e.verdict == "missing"]
    course = OverTime(
        (Stretch(0.0, 41.2, found.parameters), Stretch(41.2, 90.0, found.parameters)),
        (Change(41.2, 40.9, 41.6),),
    )
    other = replace(found, over_time=course, indistinguishable_from=("thrust_misalignment", "imu_lever_arm"))
    return replace(d, effects=tuple(other if e is found else e for e in d.effects))


@pytest.mark.parametrize("width", [60, 80, 100, 160])
@pytest.mark.parametrize("everything", [False, True])
def test_no_number_and_no_name_is_cut_at_any_width(
    diagnosis: Diagnosis, width: int, everything: bool
) -> None:
    text = told(long_one(diagnosis), width, everything)
    assert "…" not in text
    lines = [line.rstrip() for line in text.splitlines() if not line.startswith("next: ")]
    assert max(map(len, lines)) <= width
    joined = " ".join(" ".join(lines).split())
    for e in diagnosis.effects:
        assert e.name in joined or (e.verdict in ("included", "not_supported") and not everything)
    x = next(e for e in diagnosis.effects if e.verdict == "missing").parameters[0]
    assert f"x = {x.value:.3g} [{x.low:.3g}, {x.high:.3g}] 1/s until 41.20 s [40.90, 41.60]" in joined


def test_the_next_step_can_be_pasted_and_adds_what_is_missing(diagnosis: Diagnosis, tmp_path: Path) -> None:
    line = next(x for x in told(diagnosis, 80).splitlines() if x.startswith("next: "))
    words = shlex.split(line.removeprefix("next: "))
    assert words[:4] == ["groundstation", "model", "add", "rotor_drag"]
    done = programs.run(*words, "--store", tmp_path)
    assert done.returncode == 0, done.stderr
    (version,) = tmp_path.rglob("*.json")
    assert read_model(version).names() == ("rigid_body", "rotor_drag")


def test_what_ended_in_flight_is_not_added(diagnosis: Diagnosis) -> None:
    (found,) = [e for e in diagnosis.effects if e.verdict == "missing"]
    gone = OverTime(
        (Stretch(0.0, 41.2, found.parameters), Stretch(41.2, 90.0, (), True)), (Change(41.2, 40.9, 41.6),)
    )
    ended = replace(diagnosis, effects=(replace(found, over_time=gone),))
    assert diagnosis.to_add == ("rotor_drag",) and ended.to_add == ()
    assert next_command(ended) == ""
    assert told(ended, 80).startswith(
        "identify: nothing is missing at its end; rotor_drag was until 41.2 s\n"
    )


def test_effects_that_are_missing_together_are_added_together(tmp_path: Path) -> None:
    flight = read_flight(DRAG / "identify.parquet")
    both = add_effect(rigid_body_model(flight.vehicle), ["wind", "rotor_drag"], [flight])
    assert both.names() == ("rigid_body", "rotor_drag", "wind")  # wind acts through drag
    store = tmp_path / "store"
    told = programs.run(
        "groundstation", "model", "add", "--missing", "--flight", DRAG / "identify.parquet", "--store", store
    )
    assert told.returncode == 0, told.stderr
    assert "rotor_drag x = " in told.stdout
    again = programs.run(
        "groundstation", "model", "add", "--missing", "--flight", DRAG / "identify.parquet", "--store", store
    )
    assert again.returncode == 2 and "nothing is missing" in again.stderr
    for words in ([], ["rotor_drag", "--missing"]):
        wrong = programs.run("groundstation", "model", "add", *words, "--flight", "x.csv", "--store", store)
        assert wrong.returncode == 2 and "not both" in wrong.stderr
