"""Flights in-process: the record, its honesty, and its repeatability."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trueflight.models.design import Design
from trueflight.models.errors import InputError
from trueflight.models.record import read_record
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.in_process import Sample, fly, record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import choose
from trueflight.sim_bridge.truth.sensors import NO_NOISE, Noise


def believed_thrust(vehicle: Vehicle, times: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """Thrust over mass that the vehicle file promises: held commands, delay, first-order lag of rotor
    speed.
    """
    fine = 0.0005
    grid = np.arange(0.0, times[-1], fine)
    held = np.searchsorted(times, grid - vehicle.command_delay + 1e-9, side="right") - 1
    target = np.sqrt(
        np.where(held >= 0, commands[np.maximum(held, 0)], vehicle.hover_thrust) / vehicle.hover_thrust
    )
    speed, out = 1.0, np.empty_like(grid)
    follow = 1.0 - np.exp(-fine / vehicle.motor_time_constant)
    for i, wanted in enumerate(target):
        out[i] = speed
        speed += follow * (wanted - speed)
    # The accelerometer speaks of the physics step that has just ended: on average 1 ms ago.
    return GRAVITY * np.interp(times - 0.001, grid, out**2)


def residual(vehicle: Vehicle, design: Design, noise: Noise | None) -> np.ndarray:
    samples: list[Sample] = []
    # Well above the ground: the cascade sinks a little where it banks.
    plan = Plan(vehicle, design, trajectory("excitation", low=0.5), seed=4, noise=noise)
    flown = fly(plan, samples.append)
    assert (flown.outcome, flown.touching) == ("finished", 0)
    times = np.array([sample.estimate.time_us for sample in samples]) * 1e-6
    commands = np.array([sample.step.thrust_command for sample in samples])
    force = np.array([sample.estimate.specific_force for sample in samples])
    force[:, 2] -= believed_thrust(vehicle, times, commands)
    return force[10:]


def test_with_nothing_hidden_the_flight_is_what_the_owner_believes(vehicle: Vehicle, design: Design) -> None:
    rms = np.sqrt((residual(vehicle, design, NO_NOISE) ** 2).mean(0))
    assert np.all(rms < 0.01)  # m/s²; what is left is the grid of this test and differential rotor speeds


def test_with_nothing_hidden_the_residual_is_the_sensors_noise(vehicle: Vehicle, design: Design) -> None:
    left = residual(vehicle, design, None)
    assert left.std(0) == pytest.approx(np.full(3, Noise().accelerometer), rel=0.06)
    assert np.all(np.abs(left.mean(0)) < 0.01)


def test_a_record_holds_what_was_flown(vehicle: Vehicle, design: Design, tmp_path: Path) -> None:
    plan = Plan(
        vehicle, design, trajectory("circle", height=1.5, laps=1.0), choose(["rotor_drag:0.3"], vehicle, 1), 2
    )
    samples: list[Sample] = []
    flown = record(plan, tmp_path / "one.mcap", tmp_path / "one.csv", samples.append)
    read = read_record(tmp_path / "one.mcap")
    ticks = read.ticks
    assert not read.truncated and read.vehicle == vehicle and read.design == design
    assert len(ticks["t"]) == flown.ticks == len(samples)
    assert np.diff(ticks["t"]) == pytest.approx(0.01)
    assert ticks["position"] == pytest.approx(np.array([s.position for s in samples]))
    assert ticks["thrust_command"] == pytest.approx(np.array([s.step.thrust_command for s in samples]))
    assert ticks["rotor_speed"] == pytest.approx(np.array([s.estimate.rotor_speed for s in samples]))
    assert set(ticks["phase"]) == {"mission"} and np.all(ticks["setpoint_sent"])
    with (tmp_path / "one.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == flown.ticks
    assert [float(row["position_z"]) for row in rows] == pytest.approx(ticks["position"][:, 2], abs=1e-6)
    # Drag sends the vehicle behind: with it the circle is flown with a larger error than without.
    assert flown.rms_error[0] != fly(replace(plan, hidden=()), lambda sample: None).rms_error[0]


def test_the_record_does_not_tell_what_was_hidden(vehicle: Vehicle, design: Design, tmp_path: Path) -> None:
    hidden = choose(["random"], vehicle, 11)
    record(Plan(vehicle, design, trajectory("hover", duration=1.0), hidden, 11), tmp_path / "two.mcap")
    read = read_record(tmp_path / "two.mcap")
    told = " ".join([*read.metadata.values(), *(event.text for event in read.events)])
    assert hidden[0].name not in told and "seed" not in read.metadata


def test_the_same_plan_is_the_same_flight(vehicle: Vehicle, design: Design) -> None:
    plan = Plan(vehicle, design, trajectory("step_x"), choose(["random"], vehicle, 5), 5)
    flights: list[list[Sample]] = [[], []]
    for samples in flights:
        fly(plan, samples.append)
    assert [s.estimate for s in flights[0]] == [s.estimate for s in flights[1]]
    other: list[Sample] = []
    fly(replace(plan, seed=6), other.append)
    assert other[-1].estimate != flights[0][-1].estimate


def test_a_flight_that_repeats_goes_back_to_its_start(vehicle: Vehicle, design: Design) -> None:
    samples: list[Sample] = []
    plan = Plan(vehicle, design, trajectory("low_pass", passes=1.0, low=0.6), repeat=2)
    assert fly(plan, samples.append).outcome == "finished"
    jumps = np.diff(np.array([s.reference.position for s in samples]), axis=0)
    assert np.abs(jumps).max() < 0.05


def test_a_rate_that_does_not_divide_is_refused(vehicle: Vehicle, design: Design) -> None:
    with pytest.raises(InputError, match="must divide"):
        fly(Plan(vehicle, design, trajectory("hover"), rate=120.0), lambda sample: None)


def test_a_flight_that_cannot_begin_leaves_no_record(
    vehicle: Vehicle, design: Design, tmp_path: Path
) -> None:
    path = tmp_path / "x.mcap"
    for plan, why in (
        (Plan(vehicle, design, trajectory("hover"), model=b"no model"), "refused"),
        (
            Plan(vehicle, replace(design, integral=None), trajectory("hover"), controller="lqr_integral"),
            "no gains",
        ),
    ):
        with pytest.raises(InputError, match=why):
            record(plan, path)
        assert not path.exists()


def test_a_flight_that_is_lost_ends(vehicle: Vehicle, design: Design) -> None:
    hidden = choose(["wind:15"], vehicle, 1)
    plan = Plan(vehicle, design, trajectory("hover", height=5.0, duration=60.0), hidden)
    # A cascade without integral is blown away for good; four metres are enough to know.
    strong = tuple(replace(one, parameters={**one.parameters, "drag": 2.0}) for one in hidden)
    flown = fly(replace(plan, hidden=strong), lambda sample: None)
    assert flown.outcome == "lost"
    assert flown.simulated < 60.0


def test_a_record_without_rotor_speeds_is_otherwise_the_same(
    vehicle: Vehicle, design: Design, tmp_path: Path
) -> None:
    plan = Plan(vehicle, design, trajectory("hover", duration=1.0), seed=2)
    for name, one in (("with", plan), ("without", replace(plan, rotor_speeds=False))):
        record(one, tmp_path / f"{name}.mcap", tmp_path / f"{name}.csv")
    told, silent = (read_record(tmp_path / f"{name}.mcap").ticks for name in ("with", "without"))
    assert np.all(told["rotor_speed"] > 100.0)
    assert not np.any(np.nan_to_num(silent.get("rotor_speed", np.zeros(1))))
    assert np.array_equal(told["specific_force"], silent["specific_force"])
    columns = [
        (tmp_path / f"{name}.csv").read_text().splitlines()[0].split(",") for name in ("with", "without")
    ]
    assert set(columns[0]) - set(columns[1]) == {f"rotor_speed_{i}" for i in range(1, 5)}
    assert len((tmp_path / "without.csv").read_text().splitlines()[-1].split(",")) == len(columns[1])
