"""Controllers after other papers: their parts against plain vector algebra, and what each does to a vehicle that is
pushed."""

import math
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.companion.law import px4_cascade
from trueflight.companion.law.control import ZERO, ControlLaw, ControlStep, State
from trueflight.companion.law.controllers import make_controller
from trueflight.companion.law.hover_thrust import HoverThrust
from trueflight.companion.law.outer_loop import ActingThrust, LowPass, OuterLoop
from trueflight.companion.law.steps import Preview
from trueflight.models import controllers as known
from trueflight.models import frames
from trueflight.models.contract import CONTROLLERS, CORRECTED, GEOMETRIC, INDI, L1_ADAPTIVE, LQR, PX4_CASCADE
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.shipped import QUAD5
from trueflight.models.trajectory import ReferenceSample
from trueflight.models.vehicle import GRAVITY, load_vehicle
from trueflight.sim_bridge.in_process import fly
from trueflight.sim_bridge.plan import Plan, trajectory_of
from trueflight.sim_bridge.truth.hidden import choose

VEHICLE = load_vehicle(QUAD5)
DESIGN = load_design(Path(QUAD5).with_name("design.json"), VEHICLE)
LAW = ControlLaw(VEHICLE, DESIGN)
OTHERS = (INDI, L1_ADAPTIVE, GEOMETRIC, PX4_CASCADE)
DT = 0.01


def reference_at(position=(0.0, 0.0, 1.0), yaw: float = 0.0) -> ReferenceSample:
    return ReferenceSample(position, ZERO, ZERO, yaw, 0.0)


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    w, x, y, z = (float(v) for v in frames.quaternion_from_euler(np.array([roll, pitch, yaw])))
    return w, x, y, z


def at_rest(position=(0.0, 0.0, 1.0), yaw: float = 0.0) -> State:
    attitude = quaternion(0.0, 0.0, yaw)
    return State(position, ZERO, attitude, position[2], 16.0, ZERO, (0.0, 0.0, GRAVITY))


@pytest.mark.parametrize("name", OTHERS)
def test_at_rest_where_it_should_be_it_asks_for_its_weight(name: str) -> None:
    controller = make_controller(name, LAW)
    for _ in range(50):
        step = controller.step(at_rest(yaw=0.7), lambda ahead: reference_at(yaw=0.7), DT)
    assert step.command.thrust == pytest.approx(VEHICLE.weight, rel=1e-9)
    assert step.command.body_rate == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert step.thrust_command == pytest.approx(VEHICLE.hover_thrust)


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_first_answer_has_the_signs_of_the_linear_design(name: str, yaw: float) -> None:
    for off in [(0.3, 0.0, 1.0), (0.0, 0.3, 1.0), (-0.2, 0.1, 1.2), (0.0, 0.0, 0.8)]:
        steps = [
            make_controller(one, LAW).step(at_rest(off, yaw), lambda ahead: reference_at(yaw=yaw), DT)
            for one in (LQR, name)
        ]
        plain, other = (np.array([*s.command.body_rate, s.command.thrust - VEHICLE.weight]) for s in steps)
        moved = np.abs(plain) > 0.02
        assert moved.any()
        assert np.all(np.sign(other[moved]) == np.sign(plain[moved])), (off, plain, other)


@settings(max_examples=60, deadline=None)
@given(*(st.floats(-2.0, 2.0) for _ in range(2)), st.floats(-3.0, 4.0), st.floats(-3.1, 3.1))
def test_attitude_gives_the_acceleration_that_was_asked_for(
    ax: float, ay: float, az: float, yaw: float
) -> None:
    attitude = OuterLoop(LAW).attitude((ax, ay, az), yaw)
    rotation = frames.rotation_matrix(np.array(quaternion(attitude.roll, attitude.pitch, yaw)))
    given_back = rotation[:, 2] * attitude.thrust / VEHICLE.mass - np.array([0.0, 0.0, GRAVITY])
    np.testing.assert_allclose(given_back, [ax, ay, az], atol=1e-9)


def test_acting_thrust_is_what_was_commanded_a_delay_ago_through_the_lag() -> None:
    acting, delay, lag = ActingThrust(LAW), VEHICLE.command_delay, VEHICLE.motor_time_constant
    times, seen = DT * np.arange(60), []
    for _ in times:
        seen.append(acting.step(DT) * VEHICLE.mass)
        acting.commanded(1.5 * VEHICLE.weight)
    share = np.array(seen) / VEHICLE.weight - 1.0
    assert share[times < delay].max(initial=0.0) == 0.0
    after = times[30] - delay  # ticks are whole: within one of them
    low, high = (0.5 * (1.0 - math.exp(-max(0.0, after + d) / lag)) if lag else 0.5 for d in (-DT, DT))
    assert low - 1e-9 <= share[30] <= high + 1e-9


def test_low_pass_keeps_what_is_slow_and_takes_what_is_fast() -> None:
    low, times = LowPass(2.0), DT * np.arange(400)
    slow, fast = np.sin(2 * np.pi * 0.1 * times), np.sin(2 * np.pi * 20.0 * times)
    out = np.array([low.step((s, f, 1.0), DT) for s, f in zip(slow, fast, strict=True)])
    assert np.abs(out[100:, 0]).max() > 0.95
    assert np.abs(out[100:, 1]).max() < 0.03
    np.testing.assert_allclose(out[:, 2], 1.0)


@settings(max_examples=60, deadline=None)
@given(*(st.floats(-0.6, 0.6) for _ in range(4)), st.floats(-3.1, 3.1), st.floats(-0.5, 0.5))
def test_px4_attitude_control_turns_towards_the_attitude_asked_for(
    roll: float, pitch: float, wanted_roll: float, wanted_pitch: float, yaw: float, turn: float
) -> None:
    now, wanted = quaternion(roll, pitch, yaw), quaternion(wanted_roll, wanted_pitch, yaw + turn)
    rates = np.array(px4_cascade._turning(now, wanted))
    between = np.array(px4_cascade._product(px4_cascade._conjugate(now), wanted))
    angle = 2.0 * math.acos(min(1.0, abs(float(between[0]))))
    step = 1e-4
    half = np.array([1.0, *(0.5 * step * rates)])
    turned = px4_cascade._product(now, tuple(half / np.linalg.norm(half)))
    after = np.array(px4_cascade._product(px4_cascade._conjugate(turned), wanted))
    assert 2.0 * math.acos(min(1.0, abs(float(after[0])))) <= angle + 1e-9


@pytest.mark.parametrize("hovers", [0.30, 0.38, 0.46])
def test_px4_s_estimator_finds_the_thrust_that_hovers_and_finds_it_again_with_a_payload(
    hovers: float,
) -> None:
    estimator, noise = HoverThrust(0.38), np.random.default_rng(1)
    for true in (hovers, 1.12 * hovers):
        for tick in range(6000):
            thrust = true * (1.0 + 0.1 * math.sin(0.05 * tick))
            acceleration = GRAVITY * (thrust / true - 1.0) + 0.3 * noise.standard_normal()
            estimator.step(acceleration, thrust, ZERO, DT)
        assert estimator.value == pytest.approx(true, rel=0.01)


def test_px4_s_estimator_says_nothing_before_it_is_sure_and_keeps_to_its_range() -> None:
    estimator = HoverThrust(0.38)
    for _ in range(100):  # less than it waits
        estimator.step(-0.3 * GRAVITY, 0.38, ZERO, DT)
    assert estimator.value == 0.38
    for _ in range(20000):
        estimator.step(-0.9 * GRAVITY, 0.38, ZERO, DT)
    assert estimator.value == pytest.approx(0.58)


def test_px4_s_thrust_does_not_jump_when_it_learns_what_hovers() -> None:
    controller = make_controller(PX4_CASCADE, LAW)
    commands = []
    for _ in range(800):
        sinks = at_rest((0.0, 0.0, 2.0))._replace(specific_force=(0.0, 0.0, 0.9 * GRAVITY))
        commands.append(
            controller.step(sinks, lambda ahead: reference_at((0.0, 0.0, 2.0)), DT).thrust_command
        )
    assert controller._hover.value > 1.05 * VEHICLE.hover_thrust  # type: ignore[attr-defined]
    assert np.abs(np.diff(commands)).max() < 1e-9


def test_px4_attitude_control_has_its_gains_for_small_errors() -> None:
    for axis, gain in enumerate(px4_cascade.TURNING):
        error = [0.0, 0.0, 0.0]
        error[axis] = 1e-3
        rates = px4_cascade._turning((1.0, 0.0, 0.0, 0.0), quaternion(*error))
        assert rates[axis] == pytest.approx(gain * 1e-3, rel=1e-2)


@pytest.mark.parametrize("name", OTHERS)
def test_flown_against_a_wind_it_is_nearer_than_the_linear_design(name: str) -> None:
    hidden, trajectory = choose(["wind:5", "rotor_drag:0.4"], VEHICLE, 3), trajectory_of("hover", [])
    off = {}
    for one in (LQR, name):
        rows = []
        plan = Plan(VEHICLE, DESIGN, trajectory, hidden, 3, controller=one, settle=8.0)
        done = fly(plan, lambda s, rows=rows: rows.append((s.mission, s.position, s.reference.position)))
        assert done.outcome == "finished"
        off[one] = np.mean([np.array(p) - np.array(r) for mission, p, r in rows if mission], axis=0)
    horizontal = {one: math.hypot(*mean[:2]) for one, mean in off.items()}
    assert horizontal[LQR] > 0.1
    assert horizontal[name] < 0.4 * horizontal[LQR]


def test_without_an_accelerometer_indi_still_flies_its_design() -> None:
    controller = make_controller(INDI, LAW)
    aside = at_rest((0.2, 0.0, 1.0))._replace(specific_force=None)
    step = controller.step(aside, lambda ahead: reference_at(), DT)
    plain = make_controller(LQR, LAW).step(aside, lambda ahead: reference_at(), DT)
    assert step.command.body_rate[1] == pytest.approx(plain.command.body_rate[1], rel=0.05)


@pytest.mark.parametrize("name", (INDI, L1_ADAPTIVE, GEOMETRIC))
def test_what_it_adds_is_bounded_whatever_is_measured(name: str) -> None:
    controller = make_controller(name, LAW)
    far = at_rest()._replace(velocity=(50.0, -50.0, 50.0), specific_force=(500.0, -500.0, 500.0))
    for _ in range(300):
        step = controller.step(far, lambda ahead: reference_at(), DT)
    assert all(map(math.isfinite, (*step.command.body_rate, step.command.thrust)))
    low, high = LAW.thrust_limits
    assert low <= step.command.thrust <= high
    for _ in range(3000):  # and it is forgotten again, where the vehicle does what it is asked for
        felt = (0.0, 0.0, step.command.thrust / VEHICLE.mass)
        step = controller.step(at_rest()._replace(specific_force=felt), lambda ahead: reference_at(), DT)
    assert step.command.thrust == pytest.approx(VEHICLE.weight, rel=0.35)


class Mine:
    """A user's own controller: the cascade, a little stronger."""

    def __init__(self, law: ControlLaw) -> None:
        self._law = law

    def start(self) -> None:
        """Nothing."""

    def stop(self) -> None:
        """Nothing."""

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """The cascade."""
        return self._law.step(state, preview(0.0))


class Half:
    """Not a controller."""

    def __init__(self, law: ControlLaw) -> None:
        pass


@pytest.fixture
def installed(monkeypatch):
    def install(value: str) -> None:
        entry = EntryPoint("mine", value, known.GROUP)
        monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [entry])
        known.plug_ins.cache_clear()

    yield install
    monkeypatch.undo()
    known.plug_ins.cache_clear()


def test_controller_of_an_installed_package_is_flown_by_its_name(installed) -> None:
    installed(f"{__name__}:Mine")
    assert known.controllers() == (*CONTROLLERS, "mine")
    plan = Plan(VEHICLE, DESIGN, trajectory_of("hover", ["duration=1"]), controller="mine")
    assert fly(plan, lambda sample: None).outcome == "finished"


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (f"{__name__}:Half", "lacks step, start or stop"),
        ("no_such_module_here:Thing", "ModuleNotFoundError"),
        (f"{__name__}:DT", "TypeError"),
    ],
)
def test_controller_that_cannot_be_used_is_told_in_one_line(installed, value: str, told: str) -> None:
    installed(value)
    with pytest.raises(InputError, match=f"controller 'mine' of .*{told}"):
        make_controller("mine", LAW)


def test_name_that_is_taken_is_refused(installed, monkeypatch) -> None:
    monkeypatch.setattr(
        "importlib.metadata.entry_points", lambda group: [EntryPoint(CORRECTED, "a:b", group)]
    )
    known.plug_ins.cache_clear()
    with pytest.raises(InputError, match="the name is taken"):
        known.controllers()
