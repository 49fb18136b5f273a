"""Rotors of any number: which is weaker, where the weight is, with and without a gyroscope; what each carries."""

from dataclasses import replace

import numpy as np
import pytest
from multirotor import flown, vehicle
from scipy.spatial.transform import Rotation

from trueflight.groundstation.identify.rotation import judge_rotation
from trueflight.groundstation.identify.shares import motor_shares
from trueflight.groundstation.identify.translation import diagnose, or_a_rotor
from trueflight.groundstation.identify.verdicts import MISSING, NOT_EXCITED, NOT_SUPPORTED, POSSIBLE
from trueflight.groundstation.measured.attitude_rate import rate_from_attitude
from trueflight.groundstation.measured.measurement import measure_rotation
from trueflight.groundstation.results import EffectVerdict, ParameterEstimate
from trueflight.models.allocation import leverage
from trueflight.models.effects import effect_named
from trueflight.models.flight import Flight
from trueflight.models.model import rigid_body_model
from trueflight.models.prediction import apply_effects, motion_of_flight


def told(flight: Flight, name: str, healthy: tuple[Flight, ...] = ()) -> EffectVerdict:
    return next(v for v in judge_rotation(flight, healthy=healthy).verdicts if v.name == name)


def by_commands(flight: Flight) -> Flight:
    """The flight of a vehicle that logs motor commands and attitude alone."""
    return replace(flight, rotor_speed=None, angular_velocity=None, specific_force=None)


@pytest.mark.parametrize(("rotors", "weak"), [(4, 3), (6, 2), (8, 7)])
def test_the_weaker_of_any_number_of_rotors_is_named_with_its_loss(rotors: int, weak: int) -> None:
    verdict = told(flown(vehicle(rotors), seed=rotors, losses={weak: 0.15}), "rotor_damage")
    (loss,) = verdict.parameters
    assert (verdict.verdict, loss.name) == ("missing", f"loss_{weak}")
    assert loss.low <= 0.15 <= loss.high and loss.high - loss.low < 0.05


@pytest.mark.parametrize("rotors", [6, 8])
def test_a_centre_of_mass_beside_the_middle_of_any_number_of_rotors_is_found_where_it_is(rotors: int) -> None:
    verdict = told(flown(vehicle(rotors), seed=rotors, centre=(0.012, -0.007)), "com_offset")
    at = {p.name: p for p in verdict.parameters}
    assert verdict.verdict == "missing"
    assert at["x"].low <= 0.012 <= at["x"].high and at["y"].low <= -0.007 <= at["y"].high


def test_by_commands_alone_an_offset_must_be_beyond_what_unequal_motors_do() -> None:
    for centre, said in (((0.004, -0.005), "minor"), ((0.03, -0.02), "missing")):
        flight = replace(flown(vehicle(6), seed=9, centre=centre), rotor_speed=None)
        assert told(flight, "com_offset").verdict == said


def test_what_no_single_rotor_does_is_not_called_one() -> None:
    # two rotors weaker, and a model that believes in one: the axes do not agree on its size
    verdict = told(flown(vehicle(4), seed=10, losses={1: 0.25, 2: 0.15}), "rotor_damage")
    assert verdict.verdict == "possible"


@pytest.mark.parametrize("rotors", [4, 6, 8])
def test_nothing_is_said_of_a_healthy_vehicle(rotors: int) -> None:
    healthy = flown(vehicle(rotors), seed=20 + rotors)
    for flight in (healthy, by_commands(healthy)):
        found = judge_rotation(flight)
        assert not [v.name for v in found.verdicts if v.verdict in ("missing", "possible")]
        assert found.shares is not None and found.shares.rotor == 0


def test_attitude_alone_stands_in_for_the_gyroscope() -> None:
    flight = by_commands(flown(vehicle(4), seed=5, losses={2: 0.25}, lag=0.04))
    found = judge_rotation(flight)
    assert found.rms is not None and found.rms.source == "attitude" and found.rms.bandwidth > 2.0
    verdict = next(v for v in found.verdicts if v.name == "rotor_damage")
    (loss,) = verdict.parameters
    assert (verdict.verdict, loss.name) == ("missing", "loss_2")
    assert loss.value == pytest.approx(0.25, abs=0.04)


def test_rates_of_an_attitude_are_those_of_the_body_whatever_the_sign_of_its_quaternions() -> None:
    t = np.arange(0.0, 10.0, 0.01)

    def turned(t: np.ndarray) -> Rotation:
        return Rotation.from_euler(
            "xyz", np.stack([0.6 * np.sin(2.0 * t), 0.5 * np.cos(1.5 * t), 3.0 * t], axis=1)
        )

    turns, later = turned(t), turned(t + 1e-6)
    true = (turns.inv() * later).as_rotvec() / 1e-6
    quaternion = turns.as_quat(scalar_first=True) * np.where(np.arange(len(t)) % 7 < 3, -1.0, 1.0)[:, None]
    found = rate_from_attitude(quaternion, 0.01, [slice(0, len(t))], 5.0)
    assert found is not None
    assert np.abs(found.rate - true)[20:-20].max() < 0.01


def test_a_noisy_attitude_says_up_to_where_it_holds() -> None:
    flight = by_commands(flown(vehicle(4), seed=6, swing=0.1))
    clean = measure_rotation(flight)
    draw = np.random.default_rng(1)
    shaken = Rotation.from_quat(flight.quaternion, scalar_first=True) * Rotation.from_rotvec(
        0.003 * draw.standard_normal((len(flight), 3))
    )
    noisy = measure_rotation(replace(flight, quaternion=shaken.as_quat(scalar_first=True)))
    assert clean is not None and noisy is not None
    assert noisy.bandwidth < 0.8 * clean.bandwidth
    drowned = Rotation.from_rotvec(0.02 * draw.standard_normal((len(flight), 3)))
    assert measure_rotation(replace(flight, quaternion=drowned.as_quat(scalar_first=True))) is None


def test_an_angle_that_was_not_logged_is_not_differentiated() -> None:
    flight = replace(by_commands(flown(vehicle(4), seed=7, losses={3: 0.3})), unlogged=("pitch",))
    rotation = measure_rotation(flight)
    assert rotation is not None and rotation.axes == (0, 2)
    for name, other in (("rotor_damage", "com_offset"), ("com_offset", "rotor_damage")):
        verdict = told(flight, name)
        assert (verdict.verdict, verdict.indistinguishable_from) == ("possible", (other,))
    assert [p.name for p in told(flight, "rotor_damage").parameters] == ["loss_3"]


@pytest.mark.parametrize(("rotors", "weak", "more"), [(4, 1, 0.2), (6, 4, 0.3), (8, 8, 0.45)])
def test_the_share_of_a_weaker_rotor_against_a_healthy_flight_gives_its_loss(
    rotors: int, weak: int, more: float
) -> None:
    # the more rotors, the less of a loss is made good by the one that has it
    built = {1: -0.04, 2: 0.05, 3: 0.02}  # motors of one set differ
    before = by_commands(flown(vehicle(rotors), seed=30, losses=built, swing=0.03))
    loss = built.get(weak, 0.0) + more
    after = by_commands(flown(vehicle(rotors), seed=31, losses={**built, weak: loss}, swing=0.03))
    lost = 1.0 - (1.0 - loss) / (1.0 - built.get(weak, 0.0))
    shares = motor_shares(after, [before])
    assert shares is not None and shares.rotor == weak
    value, low, high = shares.losses
    assert value == pytest.approx(lost, abs=0.02) and low < lost < high
    assert motor_shares(before, [before]).rotor == 0  # type: ignore[union-attr]


def test_a_weight_moves_the_centre_of_thrust_towards_it_and_leaves_the_yaw_balance() -> None:
    craft = vehicle(4)
    before = by_commands(flown(craft, seed=32, swing=0.03))
    x, y, _ = craft.rotor_positions[2]
    hung = 0.3
    at = tuple(hung / (craft.mass + hung) * c for c in (x, y))
    after = by_commands(flown(craft, seed=33, swing=0.03, payload=hung, centre=at))
    shares = motor_shares(after, [before])
    assert shares is not None and shares.rotor == 3
    assert shares.centre == pytest.approx(at, abs=0.002)
    assert abs(shares.yaw) < 0.005 and shares.collective == pytest.approx(1.0 + hung / craft.mass, rel=0.02)
    weaker = motor_shares(by_commands(flown(craft, seed=34, swing=0.03, losses={3: 0.3})), [before])
    assert weaker is not None and abs(weaker.yaw) > 0.05


@pytest.mark.parametrize("rotors", [4, 6, 8])
def test_without_rotor_data_a_weaker_rotor_costs_what_the_allocation_does_not_make_good(rotors: int) -> None:
    craft, loss = vehicle(rotors), 0.2
    place, turns = np.array(craft.rotor_positions), np.array(craft.rotor_directions)
    allocation = np.stack([np.ones(rotors), place[:, 1], -place[:, 0], -turns])
    strength = np.ones(rotors)
    strength[1] -= loss
    mixer = np.linalg.pinv(allocation)
    asked = np.linalg.solve(allocation @ np.diag(strength) @ mixer, [1.0, 0.0, 0.0, 0.0])
    flight = replace(flown(craft, seconds=1.0), rotor_speed=None, motor_command=None)
    values = {**effect_named("rotor_damage").neutral(craft), "loss_2": loss}
    assert len(values) == rotors and sum(leverage(craft)) == pytest.approx(4.0)
    motion = apply_effects(motion_of_flight(flight), [(effect_named("rotor_damage"), values)])
    np.testing.assert_allclose(motion.thrust, motion_of_flight(flight).thrust / asked[0], rtol=1e-9)


def test_gusts_are_not_asked_of_a_flight_that_has_no_attitude() -> None:
    flight = flown(vehicle(4), seconds=20.0, seed=50)
    draw = np.random.default_rng(51)
    shaken = flight.specific_force + [0.0, 0.0, 1.0] * np.cumsum(
        0.05 * draw.standard_normal((len(flight), 1)), axis=0
    )
    alone = replace(flight, quaternion=None, velocity=None, specific_force=shaken)
    assert diagnose(alone, rigid_body_model(alone.vehicle)).unexplained.verdict


def test_a_centre_of_mass_beside_a_lack_of_thrust_may_be_one_weaker_rotor() -> None:
    """A gentle flight hardly tells a torque in proportion to one rotor's thrust from one in proportion to all."""
    centre = ParameterEstimate("x", 0.0049, 0.0048, 0.005, "m")
    beside = ParameterEstimate("loss_2", 0.12, 0.07, 0.17, "1")
    found = (
        EffectVerdict(
            "com_offset", MISSING, 1, 0.97, 0.0, (centre,), (), "add it", "rotation", confidence=1.0
        ),
        EffectVerdict("rotor_damage", NOT_SUPPORTED, None, 0.0, 1.0, (beside,), (), "", "rotation"),
        EffectVerdict("gyroscopic", NOT_EXCITED, None, 0.0, 1.0, (), (), "", "rotation"),
    )
    com, rotor, other = or_a_rotor(found, {"com_offset": ("rotor_damage",)})
    assert (com.verdict, com.indistinguishable_from, com.parameters) == (
        POSSIBLE,
        ("rotor_damage",),
        (centre,),
    )
    assert (rotor.verdict, rotor.indistinguishable_from, rotor.parameters) == (POSSIBLE, ("com_offset",), ())
    assert other == found[2]
    assert com.confidence == 0.5
    assert or_a_rotor(found, {"com_offset": ()}) == found


def test_rotor_speeds_are_read_where_the_vehicle_file_does_not_say_where_the_rotors_are() -> None:
    craft = vehicle(4)
    flight = flown(craft, seed=1)
    bare = replace(flight, vehicle=replace(craft, rotor_positions=(), rotor_directions=()))
    found = diagnose(bare, rigid_body_model(bare.vehicle))
    assert not np.isnan(found.rms_after)
