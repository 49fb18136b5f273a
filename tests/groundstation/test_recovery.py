"""Every effect of the catalogue is found by name when it is there, and its interval holds the truth.

The truth is flown by the simulator, whose formulas are its own. Where its law is another one (images of all rotors
near the ground, a raised cosine in descent), only the name is asked for there, and the effect's own formula on a made
flight gives the number.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from trueflight.groundstation.identify.fitting import MeasuredFlights, fit
from trueflight.groundstation.identify.rotors import thrust_from_rotors
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.results import Diagnosis, EffectVerdict
from trueflight.models.design import load_design
from trueflight.models.effects import catalogue, effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import quaternion_from_euler
from trueflight.models.model import Term, rigid_body_model
from trueflight.models.prediction import apply_effects, motion_of_flight, specific_force
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import GRAVITY, Vehicle, load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import Hidden, choose

FOLDER = Path(__file__).parents[2] / "models" / "vehicles" / "quad5"


@cache
def flown(folder: Path, hidden: str, seed: int = 21) -> tuple[Flight, tuple[Hidden, ...]]:
    """A survey flight of the simulator with that hidden in it."""
    vehicle = load_vehicle(FOLDER / "vehicle.toml")
    plan = Plan(
        vehicle,
        load_design(FOLDER / "design.json", vehicle),
        trajectory("excitation"),
        choose([hidden], vehicle, seed),
        seed,
    )
    path = folder / f"{hidden.replace(':', '-')}-{seed}.mcap"
    assert record(plan, path).outcome == "finished"
    return read_flight(path), plan.hidden


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("flights")


def diagnosis(flight: Flight) -> Diagnosis:
    return diagnose(flight, rigid_body_model(flight.vehicle))


def verdict(result: Diagnosis, name: str) -> EffectVerdict:
    return next(e for e in result.effects if e.name == name)


def a_big_slow_quadrotor() -> Flight:
    """A made flight that descends through its own wake: induced velocity 2.7 m/s."""
    positions = ((0.2, -0.2, 0.0), (-0.2, 0.2, 0.0), (0.2, 0.2, 0.0), (-0.2, -0.2, 0.0))
    vehicle = Vehicle(
        "big", 0.9, 0.4, rotor_radius=0.2, rotor_positions=positions, rotor_directions=(1, 1, -1, -1)
    )
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 60.0, 0.01)
    n = len(t)
    climb = 2.4 * np.sin(0.5 * t) + 0.4 * np.sin(1.9 * t)
    made = Flight(
        "made",
        vehicle,
        t,
        position=np.stack([0 * t, 0 * t, 15.0 + np.cumsum(climb) * 0.01], axis=1),
        velocity=np.stack([1.2 * np.sin(0.3 * t), 0.8 * np.sin(0.41 * t), climb], axis=1),
        quaternion=quaternion_from_euler(
            np.stack([0.1 * np.sin(0.7 * t), 0.12 * np.cos(0.9 * t), 0.2 * np.sin(0.2 * t)], axis=1)
        ),
        thrust_command=0.4 * (1.0 + 0.12 * np.sin(1.7 * t)),
        specific_force=rng.normal(0, 0.1, (n, 3)),
    )
    return made


def below_a_ceiling() -> Flight:
    """A made flight that goes up to 2.5 m, again and again."""
    made = a_big_slow_quadrotor()
    height = 1.6 + 0.9 * np.sin(0.4 * made.t)
    position = np.stack([0 * height, 0 * height, height], axis=1)
    velocity = np.stack([*made.velocity[:, :2].T, 0.36 * np.cos(0.4 * made.t)], axis=1)
    return replace(made, position=position, velocity=velocity)


MADE = {
    "vortex_ring": (a_big_slow_quadrotor, {"loss": 0.25}),
    "ceiling_effect": (below_a_ceiling, {"rho": 1.6, "ceiling": 2.9}),
    "ground_effect": (below_a_ceiling, {"rho": 1.4}),
}
"""Effects whose law in the simulator is another one: a flight, and the parameters that the formula puts into it."""

FLOWN = tuple(name for name in catalogue() if name in EFFECTS and name != "vortex_ring")
"""Effects that the simulator hides and a survey flight shows."""

NOT_HIDDEN = {
    "axial_inflow": (a_big_slow_quadrotor, {"slope": 0.3}),
    "vortex_ring": MADE["vortex_ring"],
}
"""Effects that no survey flight of the simulator shows."""

WITHOUT = {"rigid_body"}
"""It has no parameter to recover."""


def test_every_effect_is_recovered_somewhere() -> None:
    assert set(FLOWN) | set(NOT_HIDDEN) | WITHOUT == set(catalogue())


@pytest.mark.parametrize("name", FLOWN)
def test_hidden_effect_is_found_and_its_interval_holds_the_truth(folder, name: str) -> None:
    flight, hidden = flown(folder, name)
    result = diagnosis(flight)
    assert set(result.named("missing")) == ({"rotor_drag", "wind"} if name == "wind" else {name})
    # one axis of a bias goes with the thrust; the simulator's thrust curve is of another family
    open_still = {
        "accelerometer_bias": {"thrust_gain"},
        "thrust_curve": {"thrust_gain", "accelerometer_bias"},
    }
    assert set(result.named("possible")) <= open_still.get(name, set())
    true = effect_named(name).truth(hidden[0].parameters, flight.vehicle)
    found = {parameter.name: parameter for parameter in verdict(result, name).parameters}
    held = [
        (found[one], truth) for one, truth in true.items() if one in found
    ]  # of four rotors one is damaged
    assert held or not true
    for parameter, truth in held:
        # two discretisations of one law: beyond the statistics, half a percent and the sensors' resolution
        slack = 0.005 * abs(truth) + (0.002 if parameter.unit == "m/s^2" else 0.0)
        assert parameter.low - slack <= truth <= parameter.high + slack, parameter


def test_damaged_rotor_is_named_with_its_loss_and_no_thrust_gain_beside_it(folder) -> None:
    flight, hidden = flown(folder, "rotor_damage")
    result = diagnosis(flight)
    (parameter,) = verdict(result, "rotor_damage").parameters
    assert parameter.name == f"loss_{round(hidden[0].parameters['rotor'])}"
    assert parameter.low - 1e-4 <= hidden[0].parameters["loss"] <= parameter.high + 1e-4
    assert result.rotational.after < 1.3 * result.rotational.noise_floor < result.rotational.before
    assert [t.effect for t in result.model.terms] == ["rigid_body", "rotor_damage"]


def test_without_rotor_data_a_damaged_rotor_is_a_thrust_gain_that_names_it(folder) -> None:
    flight, _ = flown(folder, "rotor_damage")
    result = diagnosis(replace(flight, rotor_speed=None, motor_command=None))
    assert result.named("missing") == ("thrust_gain",)
    assert "rotor_damage" in verdict(result, "thrust_gain").indistinguishable_from
    told = verdict(result, "rotor_damage")
    assert told.verdict == "not_excited"
    assert "rotor_speed or motor_command" in told.advice
    assert result.rotational is None


def test_without_rotor_data_an_offset_centre_of_mass_cannot_be_seen(folder) -> None:
    flight, _ = flown(folder, "com_offset")
    result = diagnosis(replace(flight, rotor_speed=None, motor_command=None))
    assert result.named("missing") == result.named("possible") == ()
    assert verdict(result, "com_offset").verdict == "not_excited"
    assert "integral" in verdict(result, "com_offset").advice


def test_motor_commands_serve_where_rotor_speeds_are_missing_but_motors_differ(folder) -> None:
    flight, hidden = flown(folder, "com_offset")
    train = (flight.rotor_speed / np.mean(flight.rotor_speed)) ** 2
    commands = flight.vehicle.hover_thrust * train  # as an autopilot logs them, on a linear thrust model
    result = diagnosis(replace(flight, rotor_speed=None, motor_command=commands))
    assert verdict(result, "com_offset").verdict == "minor"  # motors of one set that differ do as much
    found = {p.name: p for p in verdict(result, "com_offset").parameters}
    for axis in "xy":
        assert found[axis].value == pytest.approx(hidden[0].parameters[axis], rel=0.02, abs=1e-5)
    assert verdict(result, "gyroscopic").verdict == "not_excited"


def test_rate_loop_as_slow_as_believed_is_not_missing(folder) -> None:
    flight, _ = flown(folder, "none")
    told = verdict(diagnosis(flight), "rate_loop_lag")
    assert told.verdict == "not_supported"
    assert {p.name for p in told.parameters} == {"lag", "delay"}
    slow = verdict(diagnosis(flown(folder, "rate_loop_lag")[0]), "rate_loop_lag")
    assert slow.parameters[0].value + slow.parameters[1].value > 1.4 * sum(p.value for p in told.parameters)


def test_hover_cannot_tell_which_torque_it_is(folder) -> None:
    flight, _ = flown(folder, "none")
    rng = np.random.default_rng(1)
    n = len(flight)
    hover = replace(
        flight,
        velocity=rng.normal(0, 0.01, (n, 3)),
        quaternion=np.tile([1.0, 0, 0, 0], (n, 1)),
        angular_velocity=rng.normal(0, 0.005, (n, 3)),
        body_rate_command=np.zeros((n, 3)),
        rotor_speed=rng.normal(1000.0, 1.0, (n, 4)),
        thrust_command=np.full(n, flight.vehicle.hover_thrust),
        specific_force=rng.normal(0, 0.1, (n, 3)) + [0.0, 0.0, GRAVITY],
    )
    result = diagnosis(hover)
    assert result.named("missing") == result.named("possible") == ()
    for name in ("gyroscopic", "rate_loop_lag"):
        assert verdict(result, name).verdict == "not_excited", name


@pytest.mark.parametrize("name", sorted({*MADE, *NOT_HIDDEN}))
def test_made_effect_is_found_and_its_interval_holds_the_truth(name: str) -> None:
    make, values = (MADE | NOT_HIDDEN)[name]
    flight = make()
    chain = [(effect_named("rigid_body"), {}), (effect_named(name), values)]
    truth = specific_force(apply_effects(motion_of_flight(flight), chain))
    flight = replace(flight, specific_force=truth + flight.specific_force)
    assert diagnosis(flight).named("missing") == (name,)
    fitted = fit(MeasuredFlights((measure(flight),)), [Term("rigid_body", {}), Term(name, {})])
    for i in fitted.of(name):
        low, high = fitted.interval(i)
        assert low <= values[fitted.free[i].parameter.name] <= high


def test_slow_rotors_are_not_taken_for_a_slow_rate_loop(folder) -> None:
    # so much noise that the thrust's lag cannot be seen in the acceleration, while the rates follow late because of it
    flight, _ = flown(folder, "motor_lag:0.05", 22)
    noise = np.random.default_rng(3).normal(0, 3.0, (len(flight), 3))
    quick = replace(flight.vehicle, rate_time_constant=0.035)
    noisy = replace(flight, vehicle=quick, specific_force=flight.specific_force + noise)
    assert diagnosis(noisy).named("missing") == ()  # the rotors' speeds tell
    alone = diagnosis(replace(noisy, rotor_speed=None))
    assert alone.named("missing") == ()
    assert "motor_lag" in verdict(alone, "rate_loop_lag").indistinguishable_from


def test_thrust_of_the_rotors_leaves_only_what_lies_beyond_them(folder) -> None:
    flight, _ = flown(folder, "motor_lag:0.05", 22)
    assert diagnosis(thrust_from_rotors(flight)).named("missing") == ()
    flight, hidden = flown(folder, "rotor_drag")
    result = diagnosis(thrust_from_rotors(flight))
    assert result.named("missing") == ("rotor_drag",)
    assert verdict(result, "rotor_drag").parameters[0].value == pytest.approx(
        hidden[0].parameters["x"], rel=0.03
    )


def test_thrust_of_rotors_that_nobody_recorded_is_refused(folder) -> None:
    flight, _ = flown(folder, "none")
    with pytest.raises(InputError, match="rotor_speed_1"):
        thrust_from_rotors(replace(flight, rotor_speed=None))
