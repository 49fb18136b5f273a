"""Several flights of one vehicle in one fit: what is the vehicle's is shared, the rest each flight's own, and what
differs is told with the flights that disagree."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import programs
import pytest
from json_schemas import valid
from simulated import fly_with

import trueflight as tf
from trueflight.groundstation.identify.differences import agreeing, common_value
from trueflight.groundstation.identify.flights import diagnose_flights
from trueflight.groundstation.identify.ownership import ownership
from trueflight.groundstation.identify.together import check_together, thinned
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.results import Diagnosis, SharedNumber
from trueflight.models.effect import FLIGHT, VEHICLE
from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import rigid_body_model
from trueflight.models.reference import trajectory, trajectory_from_csv
from trueflight.sim_bridge.truth.hidden import Hidden

DRAG = 0.25
KEPT = TemporaryDirectory()
WINDS = ((0.0, 0.0), (4.0, 1.0), (-2.0, 5.0))


def drag_in_wind(east: float, north: float) -> tuple[Hidden, ...]:
    speed = float(np.hypot(east, north))
    wind = Hidden("wind", {"speed": speed, "east": east, "north": north, "drag": DRAG})
    return (Hidden("rotor_drag", {"x": DRAG, "y": DRAG}), *([wind] if speed else []))


@cache
def flown(seed: int, *hidden: str) -> Flight:
    """A survey flight in the wind of this seed; `hidden` is what else differs from the others."""
    more = {"weak": Hidden("rotor_damage", {"loss": 0.08, "rotor": 3.0})}
    path = Path(KEPT.name) / "-".join(hidden) / f"flight-{seed}.mcap"
    path.parent.mkdir(exist_ok=True)
    wind = drag_in_wind(*WINDS[seed % 3])
    fly_with(path, (*wind, *(more[name] for name in hidden)), seed, trajectory("excitation"))
    return read_flight(path)


def diagnosed(*flights: Flight, validation: Flight | None = None, **whose: list[str]) -> Diagnosis:
    return diagnose_flights(flights, rigid_body_model(flights[0].vehicle), validation, **whose)


def asked(d: Diagnosis) -> dict[str, SharedNumber]:
    return {f"{n.effect}.{n.parameter}": n for n in d.shared}


def test_flights_in_three_winds_tell_one_drag_and_each_wind() -> None:
    d = diagnosed(flown(0), flown(1), flown(2), validation=flown(4))
    assert set(d.named("missing")) == {"rotor_drag", "wind"}
    drag = next(e for e in d.effects if e.name == "rotor_drag")
    for p in drag.parameters:
        assert not p.flight
        assert p.low < DRAG < p.high
        assert p.value == pytest.approx(DRAG, rel=0.02)
    wind = next(e for e in d.effects if e.name == "wind")
    for seed, (east, north) in enumerate(WINDS):
        own = {p.name: p for p in wind.parameters if p.flight == f"flight-{seed}"}
        for p, true in zip((own["x"], own["y"]), (east, north), strict=True):
            assert p.low - 0.03 <= true <= p.high + 0.03, (seed, p)
            assert p.high - p.low < 0.2
    assert not d.differing
    assert set(asked(d)) == {"rotor_drag.x", "rotor_drag.y"}
    # the vehicle's model has the drag; the held-out flight has a wind of its own
    assert d.set_aside == ("wind",)
    assert d.model.names() == ("rigid_body", "rotor_drag")
    assert d.validation_after is not None
    assert d.validation_after < 1.2 * d.noise_floor
    assert d.held_out_model is not None
    found = next(t for t in d.held_out_model.terms if t.effect == "wind").values
    assert (found["x"], found["y"]) == pytest.approx(WINDS[1], abs=0.1)
    assert [f.flight.name for f in d.flights] == ["flight-0", "flight-1", "flight-2"]
    assert all(f.rms_after < 1.2 * f.noise_floor < f.rms_before for f in d.flights)


def test_a_rotor_that_is_weaker_in_the_third_flight_is_named_with_that_flight() -> None:
    d = diagnosed(flown(0), flown(1), flown(2, "weak"))
    assert "rotor_damage" in d.named("missing")
    numbers = asked(d)
    assert numbers["rotor_damage.loss_3"].apart == ("flight-2",)
    assert [v.value for v in numbers["rotor_damage.loss_3"].values] == pytest.approx([0, 0, 0.08], abs=0.005)
    assert not numbers["rotor_drag.x"].differs
    assert [n.parameter for n in d.differing] == ["loss_3"]
    # what the vehicle is now is what it was in the last flight
    held = next(t for t in d.model.terms if t.effect == "rotor_damage").values
    assert held["loss_3"] == pytest.approx(0.08, abs=0.005)


def test_of_estimates_that_disagree_the_odd_one_is_found_and_of_two_that_do_not_none() -> None:
    certain = np.diag([0.01, 0.01, 0.01, 0.01]) ** 2
    assert agreeing(np.array([1.0, 1.01, 0.93, 1.0]), certain, 0.01) == (0, 1, 3)
    assert agreeing(np.array([1.0, 1.01, 0.99, 1.0]), certain, 0.01) == (0, 1, 2, 3)
    assert len(agreeing(np.array([1.0, 0.9]), certain[:2, :2], 0.01)) == 1
    level, spread = common_value(np.array([1.0, 1.02, 5.0]), np.diag([0.01, 0.02, 1.0]) ** 2, (0, 1))
    assert level == pytest.approx(1.004)
    assert spread == pytest.approx(0.01 / np.sqrt(1.25))


def test_two_estimates_that_are_wrong_together_do_not_disagree() -> None:
    together = 0.1**2 * np.ones((2, 2)) + 1e-4 * np.eye(2)
    assert len(agreeing(np.array([1.0, 1.01]), together, 0.01)) == 2
    assert len(agreeing(np.array([1.0, 1.10]), together, 0.01)) == 1


def test_whose_a_number_is_can_be_said_otherwise() -> None:
    gain, wind, drag = (effect_named(n) for n in ("thrust_gain", "wind", "rotor_drag"))
    whose = ownership(["thrust_gain", "rotor_drag.x"], ["wind"])
    assert whose.of(gain, "gain") == FLIGHT
    assert (whose.of(drag, "x"), whose.of(drag, "y")) == (FLIGHT, VEHICLE)
    assert whose.flights(wind) == ()
    assert ownership().flights(wind) == ("x", "y")


@pytest.mark.parametrize(
    ("per_flight", "shared", "told"),
    [
        (["wind"], ["wind.x"], "wind.x is named by --per-flight and by --shared"),
        (
            ["rotor_drag.z"],
            [],
            "--per-flight rotor_drag.z: rotor_drag has no such parameter; it has: rotor_drag.x",
        ),
        (["rigid_body"], [], "--per-flight rigid_body: rigid_body has no such parameter"),
        ([], ["wnd"], "--shared wnd: unknown effect 'wnd'; did you mean wind"),
    ],
)
def test_an_ownership_that_means_nothing_is_one_line(per_flight, shared, told) -> None:
    with pytest.raises(InputError, match=told.split(";")[0]):
        ownership(per_flight, shared)


def of(name: str, digest: str, **changes: object) -> Flight:
    return replace(flown(0), name=name, origin=f"{name}.csv", data_hash=digest, **changes)  # type: ignore[arg-type]


def test_flights_that_do_not_belong_together_are_refused_in_one_line() -> None:
    a, vehicle = of("a", "1"), flown(0).vehicle
    other = replace(vehicle, name="hexa")
    heavier = replace(vehicle, mass=2.0 * vehicle.mass)
    for b, told in (
        (of("a", "1"), "a.csv: given twice; give it once"),
        (of("b", "1"), "b.csv: the same flight as a.csv; give it once"),
        (of("b", "2", vehicle=other), "b.csv is of vehicle 'hexa', a.csv of 'quad5'"),
        (of("b", "2", vehicle=heavier), "b.csv and a.csv believe different things of vehicle 'quad5'"),
        (of("b", "2", battery_voltage=None), "b.csv: battery voltage is missing, which a.csv has"),
        (of("b", "2", accelerometer=False), "b.csv: acceleration was not measured by an accelerometer"),
    ):
        with pytest.raises(InputError, match=told.split(";")[0]):
            check_together([a, b])
    check_together([a, of("b", "2")])


def test_options_of_several_flights_go_with_several_flights() -> None:
    with pytest.raises(InputError, match="--per-flight goes with several flights of one vehicle"):
        diagnosed(flown(0), per_flight=["thrust_gain"])


def test_of_a_long_flight_parts_are_looked_at_and_what_follows_a_cut_does_not_count() -> None:
    flight = flown(0)
    assert thinned(flight, 60.0) is flight
    part = thinned(flight, 20.0)
    assert part.duration > 20.0
    assert len(part) == pytest.approx(20.0 / flight.dt, abs=5)
    gaps = np.flatnonzero(np.diff(part.t) > 2.0 * flight.dt) + 1
    assert len(gaps) == 1
    assert part.flying is not None
    assert not part.flying[gaps[0] : gaps[0] + round(0.4 / flight.dt)].any()


def test_the_command_takes_several_flights_and_says_what_differs(tmp_path: Path) -> None:
    files = [tmp_path / "before.mcap", tmp_path / "after.mcap"]
    gains = (Hidden("thrust_gain", {"gain": 1.0}), Hidden("thrust_gain", {"gain": 0.94}))
    for file, gain, seed in zip(files, gains, (5, 6), strict=True):
        fly_with(file, (gain,), seed, trajectory("lemniscate"))
    done = programs.run("groundstation", "diagnose", *files, "--json", "--save", tmp_path / "both.rrd")
    assert done.returncode == 0, done.stderr
    told = valid("groundstation diagnose", json.loads(done.stdout))
    (number,) = [n for n in told["shared"] if n["differs"]]
    assert (number["effect"], number["apart"]) == ("thrust_gain", ["before", "after"])
    assert number["values"]["after"]["value"] == pytest.approx(0.94, abs=0.01)
    assert [f["name"] for f in told["flights"]] == ["before", "after"]
    effect = next(e for e in told["effects"] if e["name"] == "thrust_gain")
    assert set(effect["per_flight"]) == {"before", "after"} and not effect["parameters"]
    assert [row["name"].split(",")[0] for row in told["side_by_side"]["rows"]] == ["before", "after"]
    assert (tmp_path / "both.rrd").stat().st_size > 100_000
    done = programs.run("groundstation", "diagnose", files[0], files[0])
    assert done.returncode == 2
    assert "before.mcap: given twice; give it once" in done.stderr


def test_the_report_and_the_library_show_all_flights(tmp_path: Path) -> None:
    d = tf.report([flown(3), flown(1)], tmp_path / "both.html")
    page = (tmp_path / "both.html").read_text()
    assert "Numbers of the vehicle, and of each flight" in page
    assert page.count("wind</span> x = ") == 2
    for name in ("flight-3", "flight-1"):
        assert name in page
    assert d.params["wind.x@flight-1"] == pytest.approx(WINDS[1][0], abs=0.1)
    assert set(d.interval("rotor_drag")) == {"x", "y"}
    told = str(d.summary())
    assert "2 flights of quad5" in told and "The same in all flights: rotor_drag x, rotor_drag y" in told
    assert "no part of the vehicle's model: wind" in told.replace("\n", " ")


def test_a_models_version_takes_what_is_the_vehicles_and_says_what_it_left_out(tmp_path: Path) -> None:
    store = ["--store", str(tmp_path / "store")]
    flights = [word for seed in (3, 1) for word in ("--flight", flown(seed).origin)]
    done = programs.run("groundstation", "model", "add", "rotor_drag", *flights, *store, "--json")
    assert done.returncode == 0, done.stderr
    made = valid("groundstation model add", json.loads(done.stdout))
    (drag,) = [e for e in made["effects"] if e["parameters"]]
    assert drag["parameters"]["x"] == pytest.approx(DRAG, rel=0.02)
    # the wind that was fitted beside it, in the flight that had one
    assert made["set_aside"]["wind"]["flight-1"]["x"]["value"] == pytest.approx(WINDS[1][0], abs=0.1)
    assert made["differing"] == []
    done = programs.run("groundstation", "model", "add", "wind", *flights, *store)
    assert done.returncode == 2
    assert "wind is each flight's own, and no part of a vehicle's model" in done.stderr


@pytest.mark.long
def test_what_no_flight_moved_across_stays_undetermined_in_all_of_them(tmp_path: Path) -> None:
    t = np.arange(0.0, 30.0, 0.1)
    fade = np.clip(t / 3.0, 0.0, 1.0) * np.clip((30.0 - t) / 3.0, 0.0, 1.0)
    x = 1.5 * np.sin(2.0 * np.pi * 0.15 * t) * fade
    rows = "\n".join(f"{a:.2f},{b:.4f},0,1.5,0" for a, b in zip(t, x, strict=True))
    along_x = trajectory_from_csv(f"t,x,y,z,yaw\n{rows}\n")
    flights = []
    for seed, east in enumerate((0.0, -4.0)):
        path = tmp_path / f"flight-{seed}.mcap"
        fly_with(path, drag_in_wind(east, 0.0), seed, along_x)
        flights.append(read_flight(path))
    d = diagnosed(*flights)
    found = {e.name: e for e in d.effects if e.verdict in ("missing", "possible")}
    drag = {p.name: p for p in found["rotor_drag"].parameters}
    assert drag["x"].low < DRAG < drag["x"].high
    assert "y" in found["rotor_drag"].undetermined
    own = {(p.name, p.flight): p for p in found["wind"].parameters}
    assert own["x", "flight-1"].value == pytest.approx(-4.0, rel=0.05)
    for flight in ("flight-0", "flight-1"):
        assert own["y", flight].low < 0.0 < own["y", flight].high
