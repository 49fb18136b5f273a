"""The state machine of a flight on the linear vehicle: phases, and every reason to stop."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from trueflight.companion.flight import FlightStateMachine
from trueflight.companion.latest import Latest
from trueflight.companion.law.control import ControlLaw
from trueflight.companion.law.guard import Guard
from trueflight.companion.law.watch import Range, Watch
from trueflight.companion.mission import Mission
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import IDLE, LANDING, MISSION, SILENT, TAKEOFF, Outcome
from trueflight.companion.stopping import Safety
from trueflight.models.contract import FEATURES
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import GRAVITY, load_vehicle

QUAD5 = Path(__file__).parents[2] / "models" / "vehicles" / "quad5"
VEHICLE = load_vehicle(QUAD5 / "vehicle.toml")
DESIGN = load_design(QUAD5 / "design.json")
DT_US = 10_000
START = (3.0, -2.0, 0.4)


@dataclass
class Rig:
    """A flight and a vehicle that moves as (9): accelerations follow the attitude, attitude the rates.

    `push` is an acceleration (m/s², world) that nobody told the cascade of; the ground is where it starts. What is told
    of it trembles by a micrometre, as no estimate in use stands still. `moved`, `turned` (rad, heading) and `counter`
    are resets of the estimate, `age` is that of the odometry, and while `still` it is repeated with new times.
    """

    safety: Safety = field(default_factory=Safety)
    events: list[tuple[str, str]] = field(default_factory=list)
    latest: Latest = field(default_factory=lambda: Latest(battery_voltage=16.0, flight_mode="OFFBOARD"))
    push: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_us: int = 5_000_000
    position: list[float] = field(default_factory=lambda: list(START))
    velocity: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    tilt: list[float] = field(default_factory=lambda: [0.0, 0.0])
    moved: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turned: float = 0.0
    counter: int = 0
    age: float = 0.0
    still: bool = False
    _told: Odometry | None = None

    def __post_init__(self) -> None:
        law = ControlLaw(VEHICLE, DESIGN)
        self.flight = FlightStateMachine(
            law, self.safety, lambda level, kind, text: self.events.append((kind, text))
        )

    def tick(self, dt_us: int = DT_US) -> Outcome:
        self.time_us += dt_us
        roll, pitch = self.tilt
        tremble = 1e-6 * (1 if self.time_us // DT_US % 2 else -1)
        c, k = math.cos(0.5 * self.turned), math.sin(0.5 * self.turned)
        w, i, j = math.cos(roll / 2) * math.cos(pitch / 2), math.sin(roll / 2), math.sin(pitch / 2) + tremble
        quaternion = (c * w, c * i - k * j, c * j + k * i, k * w)
        size = math.hypot(*quaternion)
        odometry = Odometry(
            self.time_us,
            0,
            tuple(x + dx + tremble for x, dx in zip(self.position, self.moved, strict=True)),
            tuple(x + tremble for x in self.velocity),
            tuple(x / size for x in quaternion),
            (0.0, 0.0, 0.0),
            self.counter,
            self.age,
        )
        if self.still and self._told is not None:
            odometry = self._told._replace(vehicle_time_us=self.time_us)
        self._told = odometry
        out = self.flight.tick(odometry, self.latest)
        self.flight.watch(self.latest)
        if out.step is not None and self.latest.armed:
            dt, command = 1e-6 * DT_US, out.step.command
            self.tilt = [self.tilt[0] + dt * command.body_rate[0], self.tilt[1] + dt * command.body_rate[1]]
            ax, ay = GRAVITY * self.tilt[1], -GRAVITY * self.tilt[0]
            az = command.thrust / VEHICLE.mass - GRAVITY
            for i, a in enumerate((ax, ay, az)):
                self.velocity[i] += dt * (a + self.push[i])
                self.position[i] += dt * self.velocity[i]
            if self.position[2] < START[2]:
                self.position[2], self.velocity[2] = START[2], 0.0
        return out

    def run(self, seconds: float) -> list[Outcome]:
        return [self.tick() for _ in range(round(seconds * 1e6 / DT_US))]

    def until(self, phase: str, limit: float = 60.0) -> list[Outcome]:
        out = []
        while not out or out[-1].phase != phase:
            out.append(self.tick())
            assert len(out) < limit * 1e6 / DT_US, f"never reached {phase}"
        return out

    def take_off(self, mission: Mission) -> None:
        self.tick()
        self.flight.prepare(mission)
        idle = self.run(0.5)
        assert all(out.step is not None and out.step.thrust_command == 0.0 for out in idle)
        self.latest.armed = True
        self.flight.take_off()


def fly(name: str = "hover", **parameters: float | str) -> Mission:
    return Mission("m1", trajectory(name, **parameters))


def kinds(rig: Rig) -> list[str]:
    return [kind for kind, _ in rig.events]


def test_a_flight_goes_through_its_phases_and_follows_its_references() -> None:
    rig = Rig()
    rig.take_off(fly("lemniscate"))
    up = rig.until(MISSION)
    assert {out.phase for out in up[:-1]} == {TAKEOFF}
    flown = rig.until(LANDING)
    for out in flown[:-1]:
        assert out.reference is not None
        assert math.dist(out.position, out.reference.position) < 0.2
        assert out.trajectory == "lemniscate"
    assert flown[0].position == pytest.approx((0.0, 0.0, 1.2), abs=0.2), "home frame: z is above ground"
    down = rig.run(12.0)
    assert rig.flight.wants_land
    assert down[-1].reference is not None
    assert down[-1].position == pytest.approx((0.0, 0.0, 0.4), abs=0.1)
    rig.latest.flight_mode = "LAND"
    assert rig.tick().step is None, "the autopilot lands by itself"
    rig.latest.armed = False
    rig.latest.flight_mode = "HOLD"
    assert rig.tick().phase == IDLE
    assert rig.flight.outcome == "finished"
    assert kinds(rig) == ["takeoff", "mission_started", "mission_flown"]


def test_the_clock_is_the_vehicle_s() -> None:
    """Messages twice as far apart: the reference goes on by the vehicle's time, not by the count."""
    rig = Rig()
    rig.take_off(fly("circle"))
    rig.until(MISSION)
    begin, first = rig.time_us, rig.tick().reference
    rig.tick(2 * DT_US)
    out = rig.tick(2 * DT_US)
    assert out.interval == pytest.approx(0.02)
    path = trajectory("circle")
    assert out.reference is not None
    assert first is not None
    elapsed = 1e-6 * (rig.time_us - begin)
    expected = path.at(elapsed).position
    assert out.reference.position == pytest.approx(expected, abs=1e-9)


def test_repeats_go_back_to_the_start_in_between() -> None:
    rig = Rig()
    path = trajectory("circle", laps=0.5)
    rig.take_off(Mission("m1", path, repeat=2))
    phases = [out.phase for out in rig.until(LANDING)]
    changes = [b for a, b in zip(["", *phases[:-1]], phases, strict=True) if a != b]
    assert changes == [TAKEOFF, MISSION, TAKEOFF, MISSION, LANDING]


@pytest.mark.parametrize("mode", ["POSCTL", "MANUAL", "HOLD", "LAND", "UNKNOWN"])
@pytest.mark.parametrize("phase", [TAKEOFF, MISSION, LANDING])
def test_the_pilot_wins_in_every_phase_and_for_good(mode: str, phase: str) -> None:
    rig = Rig()
    rig.take_off(fly())
    rig.until(phase)
    rig.run(0.3)
    rig.latest.flight_mode = mode
    assert rig.tick().step is None
    assert rig.flight.phase == SILENT
    rig.latest.flight_mode = "OFFBOARD"  # the pilot gives it back: not taken
    assert all(out.step is None for out in rig.run(2.0))
    assert rig.events[-1][0] == "pilot_takeover"
    assert mode in rig.events[-1][1]
    rig.latest.armed = False
    assert rig.tick().phase == IDLE
    # What was flown to its end stays flown, whoever lands.
    assert rig.flight.outcome == ("finished" if phase == LANDING else rig.events[-1][1])


def test_a_pilot_also_wins_over_our_own_landing() -> None:
    rig = Rig()
    rig.take_off(fly("hover", duration=1.0))
    rig.until(LANDING)
    while not rig.flight.wants_land:
        rig.tick()
    rig.latest.flight_mode = "LAND"
    rig.run(0.2)
    rig.latest.flight_mode = "POSCTL"
    rig.tick()
    assert rig.flight.phase == SILENT


def test_nothing_is_sent_once_the_autopilot_lands_even_if_its_mode_comes_back() -> None:
    """PX4 falls back to Offboard when it disarms after a landing of its own, before its heartbeat says disarmed."""
    rig = Rig()
    rig.take_off(fly("hover", duration=1.0))
    rig.until(LANDING)
    while not rig.flight.wants_land:
        rig.tick()
    rig.latest.flight_mode = "LAND"
    rig.run(0.2)
    rig.latest.flight_mode = "OFFBOARD"
    assert all(rig.tick().step is None for _ in range(20))


@pytest.mark.parametrize(
    ("trouble", "kind"),
    [
        (lambda rig: rig.tick(300_000), "odometry_gap"),
        (lambda rig: rig.tick(-50_000), "odometry_gap"),
        (lambda rig: rig.position.__setitem__(0, rig.position[0] + 1.5), "position_jump"),
        (lambda rig: rig.velocity.__setitem__(2, 4.0), "geofence"),
        (lambda rig: rig.latest.__setattr__("battery_voltage", 12.0), "battery_low"),
    ],
)
def test_trouble_ends_the_flight_with_a_landing(trouble, kind: str) -> None:
    rig = Rig(Safety(fence_height=2.0, battery_patience=0.5))
    rig.take_off(fly("hover", height=1.5, duration=30.0))
    rig.until(MISSION)
    rig.run(0.5)
    trouble(rig)
    rig.run(0.6)
    assert kinds(rig)[-1] == kind
    assert rig.flight.phase == LANDING
    assert rig.flight.outcome != "finished"


def test_a_vehicle_that_leaves_its_reference_is_landed() -> None:
    rig = Rig(Safety(lost=0.5))
    rig.take_off(fly("hover", duration=30.0))
    rig.until(MISSION)
    for _ in range(100):  # blown away
        rig.position[1] += 0.05
        rig.tick()
    assert "lost" in kinds(rig)
    assert rig.flight.wants_land


def test_a_moment_of_low_voltage_is_forgiven() -> None:
    rig = Rig()
    rig.take_off(fly("hover", duration=30.0))
    rig.until(MISSION)
    for _ in range(5):
        rig.latest.battery_voltage = 12.0
        rig.run(1.0)
        rig.latest.battery_voltage = 16.0
        rig.run(0.1)
    assert rig.flight.phase == MISSION


def test_an_order_to_land_brings_it_home_or_down_where_it_is() -> None:
    for home in (True, False):
        rig = Rig()
        rig.take_off(fly("circle", radius=2.0, laps=5.0))
        rig.until(MISSION)
        rig.run(4.0)
        rig.flight.land("told to", return_home=home)
        before = rig.tick().position
        while not rig.flight.wants_land:
            rig.tick()
        after = rig.run(1.0)[-1]
        assert after.reference is not None
        if home:
            assert after.position[:2] == pytest.approx((0.0, 0.0), abs=0.15)
        else:
            assert math.dist(after.reference.position, before) < 0.3
        assert rig.flight.outcome == "told to"


@pytest.mark.parametrize(("killed", "mode"), [(True, "OFFBOARD"), (False, "TERMINATION")])
def test_cut_motors_are_the_end_although_the_vehicle_stays_armed(killed: bool, mode: str) -> None:
    """PX4 stays armed and in Offboard for some seconds after the kill switch: flipped back, motors would turn."""
    rig = Rig()
    rig.take_off(fly())
    rig.until(MISSION)
    rig.latest.killed, rig.latest.flight_mode = killed, mode
    assert rig.tick().step is None
    assert rig.flight.phase == SILENT
    assert rig.events[-1][0] == "kill_switch"
    rig.latest.killed, rig.latest.flight_mode = False, "OFFBOARD"
    assert all(out.step is None for out in rig.run(1.0)), "and it never comes back"


def test_a_failsafe_is_told_apart_from_a_pilot_and_with_its_reason() -> None:
    rig = Rig()
    rig.take_off(fly())
    rig.until(MISSION)
    rig.latest.notices.append((time.monotonic(), "failsafe: battery critical, Land"))
    rig.latest.failsafe, rig.latest.flight_mode = True, "LAND"
    assert rig.tick().step is None
    kind, text = rig.events[-1]
    assert kind == "failsafe"
    assert "battery critical" in text


def test_disarmed_in_flight_is_the_end() -> None:
    rig = Rig()
    rig.take_off(fly())
    rig.until(MISSION)
    rig.latest.armed = False
    out = rig.tick()
    assert out.step is None
    assert out.phase == IDLE
    assert "disarmed" in rig.flight.outcome


def test_cancelled_before_takeoff_it_streams_no_more() -> None:
    rig = Rig()
    rig.tick()
    rig.flight.prepare(fly())
    assert rig.tick().step is not None
    rig.flight.cancel("the autopilot refused to arm")
    assert rig.tick().step is None
    assert rig.flight.phase == IDLE
    rig.flight.take_off()
    assert rig.tick().step is None, "nothing to take off for"


def test_the_correction_is_on_when_the_mission_begins_and_off_after_it() -> None:
    ranges = [Range(name, unit, -100.0, 100.0) for name, unit in FEATURES.items()]
    guard = Guard(Watch(lambda features: (1.0, 0.0, 0.0), ranges, name="abc"))
    rig = Rig()
    rig.take_off(Mission("m1", trajectory("hover", duration=6.0), "corrected", 1, guard))
    climb = rig.run(1.0)
    assert all(out.step is not None and out.step.correction == (0.0, 0.0, 0.0) for out in climb)
    assert rig.until(MISSION)[-1].guard == "active"  # faded in on the way to the start
    rig.push = (1.0, 0.0, 0.0)
    flown = rig.until(LANDING)
    assert flown[-2].guard == "active"
    assert flown[-2].step is not None
    of_model = np.subtract(flown[-2].step.correction, flown[-2].step.trim)
    assert of_model == pytest.approx((1.0, 0.0, 0.0))
    assert flown[-2].model == "abc"
    # (22): the vehicle leans against the push of 1 m/s² along x and stays on its reference.
    assert rig.tilt[1] == pytest.approx(-1.0 / GRAVITY, abs=0.01)
    assert flown[-2].position == pytest.approx((0.0, 0.0, 1.2), abs=0.03)
    landing = rig.run(2.0)
    assert landing[-1].guard == "off"
    assert landing[-1].step is not None
    assert landing[-1].step.correction == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("name", "has"), [("lqr", False), ("lqr_integral", False), ("indi", True)])
def test_controllers_that_measure_acceleration_get_the_accelerometer(name: str, has: bool) -> None:
    rig = Rig()
    rig.latest.imu = json.dumps(
        dict.fromkeys(("time_usec", "yacc", "xgyro", "ygyro", "zgyro"), 0) | {"xacc": 1.0, "zacc": -9.8}
    )
    rig.take_off(Mission("m1", trajectory("hover", duration=6.0), name))
    controller, told = rig.flight._phases.controller, []
    assert controller is not None
    step = controller.step
    controller.step = lambda state, *more: told.append(state.specific_force) or step(state, *more)
    rig.run(0.1)
    assert told
    assert set(told) == {(1.0, 0.0, 9.8) if has else None}


def test_a_vehicle_on_its_back_gets_no_more_setpoints() -> None:
    rig = Rig()
    rig.take_off(Mission("m1", trajectory("hover", duration=20.0)))
    rig.until(MISSION)
    rig.run(1.0)
    for _ in range(60):
        rig.tilt = [3.0, 0.0]
        out = rig.tick()
    assert out.phase == SILENT
    assert out.step is None
    assert "tumbled" in [kind for kind, _ in rig.events]


def test_the_fence_is_checked_before_flying() -> None:
    safety = Safety(fence_radius=3.0, fence_height=2.0)
    assert safety.check_trajectory(trajectory("circle", radius=2.0)) == ""
    assert "fence ends at 3 m" in safety.check_trajectory(trajectory("circle", radius=4.0))
    assert "fence ends at 2 m" in safety.check_trajectory(trajectory("hover", height=3.0))


def test_a_mission_needs_a_model_for_its_correction() -> None:
    with pytest.raises(InputError, match="needs a deployed model"):
        Mission("m1", trajectory("hover"), "corrected")
    with pytest.raises(InputError, match="unknown"):
        Mission("m1", trajectory("hover"), "pid")
