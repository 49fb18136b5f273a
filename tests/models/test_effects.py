"""Each effect against plain vector algebra, one sample at a time, and the rules that every effect keeps."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.models.effect import FLIGHT, Effect, Motion, Parameter, Stage
from trueflight.models.effects import catalogue, effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS, Flight
from trueflight.models.frames import quaternion_from_euler
from trueflight.models.prediction import apply_effects, motion_of_flight, specific_force
from trueflight.models.vehicle import GRAVITY, Vehicle

VEHICLE = Vehicle(
    name="test",
    mass=0.9,
    hover_thrust=0.4,
    rotor_radius=0.1,
    rotor_positions=((0.12, -0.12, 0.02), (-0.12, 0.12, 0.02), (0.12, 0.12, 0.02), (-0.12, -0.12, 0.02)),
    rotor_directions=(1, 1, -1, -1),
)
angle = st.floats(-0.8, 0.8)
yaw = st.floats(-3.1, 3.1)
speed = st.floats(-6, 6)
command = st.floats(0.1, 0.9)
height = st.floats(0.3, 3.0)
voltage = st.floats(13.0, 17.0)


def rotation(phi: float, theta: float, psi: float) -> np.ndarray:
    """Body to world, as the product of three elementary rotations."""
    cx, sx, cy, sy, cz, sz = (f(a) for a in (phi, theta, psi) for f in (math.cos, math.sin))
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return rz @ ry @ rx


def sample(phi: float, theta: float, psi: float, v: tuple, u: float, z: float, volts: float) -> Flight:
    """Three equal samples in those conditions."""
    n = 3
    return Flight(
        "one",
        VEHICLE,
        np.arange(n) * 0.01,
        position=np.tile([0.0, 0.0, z], (n, 1)),
        velocity=np.tile(v, (n, 1)),
        quaternion=np.tile(quaternion_from_euler(np.array([phi, theta, psi])), (n, 1)),
        specific_force=np.zeros((n, 3)),
        thrust_command=np.full(n, u),
        battery_voltage=np.full(n, volts),
    )


def reading(flight: Flight, *chain: tuple[str, dict[str, float]]) -> np.ndarray:
    """Specific force that the chain predicts for the middle sample, body axes."""
    effects = [(effect_named(name), values) for name, values in (("rigid_body", {}), *chain)]
    return specific_force(apply_effects(motion_of_flight(flight), effects))[1]


def drag_linear(r: np.ndarray, v: np.ndarray, t: float, p: dict) -> np.ndarray:
    b = r.T @ v
    return np.array([0, 0, t]) - math.sqrt(t / GRAVITY) * np.array([p["x"] * b[0], p["y"] * b[1], 0.0])


def drag_quadratic(r: np.ndarray, v: np.ndarray, t: float, p: dict) -> np.ndarray:
    b = r.T @ v
    return np.array([0, 0, t]) - np.array([p["x"], p["y"], p["z"]]) * b * np.linalg.norm(b)


def near_ground(r: np.ndarray, v: np.ndarray, t: float, p: dict, z: float) -> np.ndarray:
    factors = []
    for arm in VEHICLE.rotor_positions:
        h = z + (r @ np.array(arm))[2]
        factors.append(1.0 / (1.0 - min(0.6, (p["rho"] * VEHICLE.rotor_radius / (4.0 * h)) ** 2)))
    return np.array([0, 0, t * np.mean(factors)])


def below_a_ceiling(r: np.ndarray, t: float, p: dict, z: float) -> np.ndarray:
    factors = []
    for arm in VEHICLE.rotor_positions:
        d = p["ceiling"] - z - (r @ np.array(arm))[2]
        near = min(0.6, (p["rho"] * VEHICLE.rotor_radius / (4.0 * max(d, 1e-3))) ** 2) if d > 0 else 0.0
        factors.append(1.0 / (1.0 - near))
    return np.array([0, 0, t * np.mean(factors)])


def in_its_own_wake(r: np.ndarray, v: np.ndarray, t: float, p: dict) -> np.ndarray:
    b = r.T @ v
    induced = math.sqrt(VEHICLE.weight / 4 / (2 * 1.225 * math.pi * VEHICLE.rotor_radius**2))
    sinking, edgewise = -b[2] / induced, math.hypot(b[0], b[1]) / induced
    ring = math.exp(-(((sinking - 0.9) / 0.35) ** 2)) * math.exp(-((edgewise / 0.6) ** 2))
    return np.array([0, 0, t * (1.0 - p["loss"] * ring)])


# effect -> the same physics written out for one sample: (R, v, specific thrust, parameters, height, volts)
PLAIN: dict[str, Callable[..., np.ndarray]] = {
    "thrust_gain": lambda r, v, t, p, z, volts: np.array([0, 0, t * p["gain"]]),
    "thrust_curve": lambda r, v, t, p, z, volts: np.array(
        [0, 0, t + p["curvature"] * t * (t - GRAVITY) / GRAVITY]
    ),
    "battery_sag": lambda r, v, t, p, z, volts: np.array([0, 0, t * (volts / 16.0) ** p["exponent"]]),
    "ground_effect": lambda r, v, t, p, z, volts: near_ground(r, v, t, p, z),
    "rotor_drag": lambda r, v, t, p, z, volts: drag_linear(r, v, t, p),
    "parasitic_drag": lambda r, v, t, p, z, volts: drag_quadratic(r, v, t, p),
    "accelerometer_bias": lambda r, v, t, p, z, volts: np.array([p["x"], p["y"], t + p["z"]]),
    "axial_inflow": lambda r, v, t, p, z, volts: np.array(
        [0, 0, t - p["slope"] * (r.T @ v)[2] * math.sqrt(t / GRAVITY)]
    ),
    "translational_lift": lambda r, v, t, p, z, volts: np.array(
        [0, 0, t + p["lift"] * (np.dot(r.T @ v, r.T @ v) - (r.T @ v)[2] ** 2)]
    ),
    "ceiling_effect": lambda r, v, t, p, z, volts: below_a_ceiling(r, t, p, z),
    "vortex_ring": lambda r, v, t, p, z, volts: in_its_own_wake(r, v, t, p),
    "thrust_misalignment": lambda r, v, t, p, z, volts: (
        t * np.array([p["x"], p["y"], math.sqrt(1.0 - p["x"] ** 2 - p["y"] ** 2)])
    ),
    "rigid_body": lambda r, v, t, p, z, volts: np.array([0, 0, t]),
}


@pytest.mark.parametrize("name", sorted(PLAIN))
@settings(max_examples=40, deadline=None)
@given(angle, angle, yaw, speed, speed, speed, command, height, voltage, st.data())
def test_effect_is_plain_vector_algebra(name, phi, theta, psi, vx, vy, vz, u, z, volts, data) -> None:
    effect = effect_named(name)
    values = {p.name: data.draw(st.floats(max(p.low, -5), min(p.high, 5))) for p in effect.parameters}
    flight = sample(phi, theta, psi, (vx, vy, vz), u, z, volts)
    chain = () if name == "rigid_body" else ((name, values),)
    expected = PLAIN[name](
        rotation(phi, theta, psi),
        np.array([vx, vy, vz]),
        GRAVITY * u / VEHICLE.hover_thrust,
        values,
        z,
        volts,
    )
    np.testing.assert_allclose(reading(flight, *chain), expected, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(angle, angle, yaw, speed, speed, command, speed, speed)
def test_wind_is_velocity_taken_from_the_vehicle(phi, theta, psi, vx, vy, u, wx, wy) -> None:
    drag = ("rotor_drag", {"x": 0.2, "y": 0.3})
    in_wind = reading(
        sample(phi, theta, psi, (vx, vy, 0.0), u, 1.0, 16.0), ("wind", {"x": wx, "y": wy}), drag
    )
    in_still_air = reading(sample(phi, theta, psi, (vx - wx, vy - wy, 0.0), u, 1.0, 16.0), drag)
    np.testing.assert_allclose(in_wind, in_still_air, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(angle, angle, yaw, speed, speed, speed)
def test_drag_never_feeds_energy(phi, theta, psi, vx, vy, vz) -> None:
    flight = sample(phi, theta, psi, (vx, vy, vz), 0.4, 1.0, 16.0)
    still = reading(flight)
    for name, values in (
        ("rotor_drag", {"x": 0.2, "y": 0.3}),
        ("parasitic_drag", {"x": 0.1, "y": 0.2, "z": 0.3}),
    ):
        force = rotation(phi, theta, psi) @ (reading(flight, (name, values)) - still)
        assert force @ np.array([vx, vy, vz]) <= 1e-9


def step_response(**chain: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    n, dt = 200, 0.005
    flight = Flight(
        "step",
        VEHICLE,
        np.arange(n) * dt,
        quaternion=np.tile([1.0, 0, 0, 0], (n, 1)),
        thrust_command=np.where(np.arange(n) < 50, 0.4, 0.6),
    )
    effects = [(effect_named("rigid_body"), {}), *((effect_named(k), v) for k, v in chain.items())]
    return flight.t, specific_force(apply_effects(motion_of_flight(flight), effects))[:, 2]


def test_motor_lag_is_a_first_order_response_of_rotor_speed() -> None:
    t, force = step_response(motor_lag={"tau": 0.05})
    low, high = math.sqrt(GRAVITY), math.sqrt(1.5 * GRAVITY)
    # the command ramps between two samples, so the step sits in the middle of that period
    since = t - (t[50] - 0.5 * 0.005)
    expected = np.where(since > 0.005, (high + (low - high) * np.exp(-since / 0.05)) ** 2, np.nan)
    np.testing.assert_allclose(force[52:], expected[52:], rtol=2e-3)
    np.testing.assert_allclose(force[:50], GRAVITY, rtol=1e-6)


def test_transport_delay_shifts_the_thrust_in_time() -> None:
    _, now = step_response()
    _, later = step_response(transport_delay={"delay": 0.035})
    np.testing.assert_allclose(later[7:], now[:-7], rtol=1e-9)


def turning(rate: np.ndarray, acceleration: np.ndarray, speeds: np.ndarray) -> Flight:
    """Three samples around one with those body rates, angular accelerations and rotor speeds."""
    dt = 0.01
    return Flight(
        "turning",
        VEHICLE,
        np.arange(3) * dt,
        quaternion=np.tile([1.0, 0, 0, 0], (3, 1)),
        angular_velocity=rate + np.outer([-dt, 0.0, dt], acceleration),
        thrust_command=np.full(3, VEHICLE.hover_thrust),
        rotor_speed=np.tile(speeds, (3, 1)),
    )


vector = st.tuples(*[st.floats(-8, 8)] * 3).map(np.array)
speeds = st.tuples(*[st.floats(300, 900)] * 4).map(np.array)


def torque(flight: Flight, *chain: tuple[str, dict[str, float]]) -> np.ndarray:
    """Torque that the chain predicts for the middle sample, body axes; about z over the drag-torque length."""
    motion = motion_of_flight(flight).with_(torque=np.zeros((3, 3)))
    return apply_effects(motion, [(effect_named(n), v) for n, v in chain]).torque[1]


@settings(max_examples=40, deadline=None)
@given(vector, vector, st.tuples(*[st.floats(-0.4, 0.4)] * 3).map(np.array))
def test_imu_lever_arm_is_the_acceleration_of_a_point_of_the_body(rate, acceleration, arm) -> None:
    flight = turning(rate, acceleration, np.full(4, 500.0))
    added = reading(flight, ("imu_lever_arm", dict(zip("xyz", arm, strict=True)))) - reading(flight)
    expected = np.cross(acceleration, arm) + np.cross(rate, np.cross(rate, arm))
    np.testing.assert_allclose(added, expected, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(speeds, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_com_offset_is_the_torque_of_the_thrusts_about_another_point(speeds, x, y) -> None:
    thrusts = speeds**2 / np.sum(speeds**2) * VEHICLE.weight
    expected = sum(
        np.cross(np.array(arm) - [x, y, 0.0], [0.0, 0.0, f])
        for arm, f in zip(VEHICLE.rotor_positions, thrusts, strict=True)
    )
    flight = turning(np.zeros(3), np.zeros(3), speeds)
    np.testing.assert_allclose(torque(flight, ("com_offset", {"x": x, "y": y}))[:2], expected[:2], atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(speeds, st.integers(0, 3), st.floats(0.0, 0.6))
def test_rotor_damage_takes_thrust_and_torque_from_one_rotor(speeds, rotor, loss) -> None:
    values = {f"loss_{i + 1}": loss if i == rotor else 0.0 for i in range(4)}
    flight = turning(np.zeros(3), np.zeros(3), speeds)
    thrusts = speeds**2 / np.sum(speeds**2) * VEHICLE.weight
    lost = loss * thrusts[rotor]
    difference = torque(flight, ("rotor_damage", values)) - torque(flight)
    arm = np.array(VEHICLE.rotor_positions[rotor])
    np.testing.assert_allclose(difference[:2], -np.cross(arm, [0, 0, lost])[:2], atol=1e-9)
    assert difference[2] == pytest.approx(VEHICLE.rotor_directions[rotor] * lost, abs=1e-9)
    share = lost / VEHICLE.weight
    np.testing.assert_allclose(
        reading(flight, ("rotor_damage", values)), [0, 0, GRAVITY * (1 - share)], atol=1e-9
    )


def test_rotor_damage_without_rotor_data_is_what_a_balanced_vehicle_loses() -> None:
    # roll, pitch and yaw balanced by driving the damaged rotor harder: all give the same thrust f, the damaged one
    # commanded f / (1 - loss); 3 f + f / (1 - loss) is the commanded thrust and 4 f what acts
    loss = 0.2
    values = {"loss_1": 0.0, "loss_2": loss, "loss_3": 0.0, "loss_4": 0.0}
    flight = sample(0.0, 0.0, 0.0, (0.0, 0.0, 0.0), 0.4, 1.0, 16.0)
    f = GRAVITY / (3.0 + 1.0 / (1.0 - loss))
    np.testing.assert_allclose(reading(flight, ("rotor_damage", values)), [0, 0, 4 * f], atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(vector, speeds, st.floats(0.0, 1e-3))
def test_gyroscopic_torque_is_the_change_of_the_rotors_momentum(rate, speeds, inertia) -> None:
    flight = turning(rate, np.zeros(3), speeds)
    momentum = inertia * np.dot(VEHICLE.rotor_directions, speeds)
    difference = torque(flight, ("gyroscopic", {"inertia": inertia})) - torque(flight)
    np.testing.assert_allclose(difference, -np.cross(rate, [0, 0, momentum]), atol=1e-9)
    assert difference @ rate == pytest.approx(0.0, abs=1e-9)  # it does no work


def test_rate_loop_lag_is_a_first_order_response_after_a_delay() -> None:
    from trueflight.groundstation.identify.actuation import respond

    dt, lag, delay = 0.002, 0.06, 0.03
    t = np.arange(300) * dt
    command = np.where(np.arange(300) >= 50, 1.0, 0.0)[:, None]
    rate = respond(command, dt, delay, lag, 0.0)[:, 0]
    since = t - t[50] - delay
    expected = np.where(since > 0.0, 1.0 - np.exp(-np.maximum(since, 0.0) / lag), 0.0)
    np.testing.assert_allclose(rate, expected, atol=1e-6)
    acted = apply_effects(
        motion_of_flight(sample(0.0, 0.0, 0.0, (0, 0, 0), 0.4, 1.0, 16.0)),
        [(effect_named("rate_loop_lag"), {"lag": lag, "delay": delay})],
    )
    assert (acted.rate_lag, acted.rate_delay) == (lag, delay)


OWN_PROPERTY = {
    "wind": test_wind_is_velocity_taken_from_the_vehicle,
    "motor_lag": test_motor_lag_is_a_first_order_response_of_rotor_speed,
    "transport_delay": test_transport_delay_shifts_the_thrust_in_time,
    "imu_lever_arm": test_imu_lever_arm_is_the_acceleration_of_a_point_of_the_body,
    "com_offset": test_com_offset_is_the_torque_of_the_thrusts_about_another_point,
    "rotor_damage": test_rotor_damage_takes_thrust_and_torque_from_one_rotor,
    "gyroscopic": test_gyroscopic_torque_is_the_change_of_the_rotors_momentum,
    "rate_loop_lag": test_rate_loop_lag_is_a_first_order_response_after_a_delay,
}
"""The test of an effect that is not in `PLAIN`."""


@pytest.mark.parametrize("effect", catalogue().values(), ids=lambda e: e.name)
def test_catalogue_entry_is_complete(effect: Effect) -> None:
    assert effect.title and effect.manoeuvre
    assert len(effect.citation) > 20, "name the source"
    assert (effect.formula.__doc__ or "").strip(), "the formula is written in its docstring"
    assert "`" in (effect.formula.__doc__ or ""), "the formula itself stands in the docstring"
    assert (effect.name in PLAIN) != (effect.name in OWN_PROPERTY), "exactly one property test"
    assert effect.needs or effect.needs_any
    assert {*effect.needs, *effect.needs_any} <= set(COLUMNS)
    assert effect.confounded_with or effect.unconfounded, "name its confounders, or why there are none"
    for p in effect.parameters:
        assert p.unit and p.meaning
        assert np.isfinite([p.low, p.high]).all()
        assert p.low <= p.typical <= p.high
        assert p.low < p.high
        assert p.low <= p.neutral_for(VEHICLE) <= p.high
        assert p.structural or p.typical != p.neutral_for(VEHICLE)
    for other in (*effect.confounded_with, *effect.acts_through, *effect.generalises, *effect.seen_as):
        assert other in catalogue(), f"{effect.name} names the unknown effect {other}"
    if effect.stage in (Stage.COMMAND, Stage.TORQUE, Stage.RATE):
        assert not effect.exports, "a correction is a static map to an acceleration"


def test_catalogue_holds_every_standard_name() -> None:
    standard = {
        *(
            "rigid_body",
            "thrust_gain",
            "thrust_curve",
            "battery_sag",
            "motor_lag",
            "transport_delay",
            "rotor_drag",
        ),
        *(
            "parasitic_drag",
            "axial_inflow",
            "translational_lift",
            "ground_effect",
            "ceiling_effect",
            "vortex_ring",
        ),
        *("wind", "accelerometer_bias", "imu_lever_arm", "thrust_misalignment", "com_offset", "rotor_damage"),
        *("rate_loop_lag", "gyroscopic"),
    }
    assert set(catalogue()) == standard


@pytest.mark.parametrize("effect", [e for e in catalogue().values() if e.parameters], ids=lambda e: e.name)
def test_neutral_effect_changes_nothing(effect: Effect) -> None:
    flight = sample(0.2, -0.3, 1.0, (2.0, -1.0, 0.5), 0.5, 0.5, 15.0)
    turned = turning(np.array([1.0, -2.0, 0.5]), np.array([3.0, 1.0, -1.0]), np.array([500.0, 510, 520, 530]))
    flight = replace(flight, angular_velocity=turned.angular_velocity, rotor_speed=turned.rotor_speed)
    np.testing.assert_allclose(
        torque(flight, (effect.name, effect.neutral(VEHICLE))), torque(flight), atol=1e-9
    )
    drag = [("rotor_drag", {"x": 0.2, "y": 0.2})] if effect.acts_through else []
    with_it = reading(flight, *drag, (effect.name, effect.neutral(VEHICLE)))
    np.testing.assert_allclose(with_it, reading(flight, *drag), atol=1e-5)


def test_users_effect_is_one_file(tmp_path) -> None:
    (tmp_path / "tether.py").write_text(
        "from trueflight.models.effect import Effect, Motion, Parameter, Stage\n"
        "def formula(motion, *, pull):\n"
        "    'A constant pull along body x.'\n"
        "    return motion.with_(force=motion.force + pull * motion.rotation[:, 2, :] * 0.0 + pull)\n"
        "EFFECT = Effect('tether', 'pull of a tether', Stage.FORCE, formula,\n"
        "    (Parameter('pull', 'm/s^2', 'pull over mass', 0.0, 0.1, -5.0, 5.0),), ('quaternion',), 'hover', 'own')\n"
    )
    assert "tether" in catalogue(str(tmp_path))
    motion = motion_of_flight(sample(0.1, 0.1, 0.0, (0, 0, 0), 0.4, 1.0, 16.0))
    acted = apply_effects(motion, [(effect_named("tether", str(tmp_path)), {"pull": 0.5})])
    assert isinstance(acted, Motion)
    np.testing.assert_allclose(acted.force, 0.5)


@pytest.mark.parametrize("text", ["x = 1\n", "import nothing_of_the_kind\n", "EFFECT = 3\n"])
def test_unusable_users_effect_is_told_in_one_line(tmp_path, text: str) -> None:
    (tmp_path / "bad.py").write_text(text)
    with pytest.raises(InputError, match=r"bad\.py"):
        catalogue(str(tmp_path))


def test_unknown_effect_is_told_with_the_nearest_name() -> None:
    with pytest.raises(InputError, match="rotor_drag"):
        effect_named("rotordrag")


def test_a_number_is_the_vehicles_unless_it_is_of_the_day_the_place_or_the_sensor() -> None:
    own = {(e.name, p.name) for e in catalogue().values() for p in e.parameters if p.belongs_to == FLIGHT}
    assert own == {
        ("wind", "x"),
        ("wind", "y"),
        *(("accelerometer_bias", axis) for axis in "xyz"),
        ("ceiling_effect", "ceiling"),
    }


def test_whose_a_number_is_has_two_answers() -> None:
    with pytest.raises(ValueError, match="'pull' belongs_to 'day'; it is VEHICLE or FLIGHT"):
        Parameter("pull", "1", "pull", 0.0, 1.0, 0.0, 2.0, belongs_to="day")
