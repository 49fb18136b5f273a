"""Flights without MAVLink: the same world and inner autopilot, flown by the companion's own control law.

Many times faster than real time, and the same every time: what a flight becomes depends on the plan alone.
"""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from trueflight.companion.law.adaptation import Told
from trueflight.companion.law.control import ControlLaw, ControlStep, State
from trueflight.companion.law.controllers import Preview, make_controller
from trueflight.companion.law.guard import Guard
from trueflight.companion.law.inference import cannot_learn
from trueflight.companion.law.model_check import check_model
from trueflight.models.contract import CORRECTED_ADAPTIVE
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS
from trueflight.models.record import FlightRecorder
from trueflight.models.record_pb2 import Event, Tick
from trueflight.models.trajectory import ReferenceSample, Trajectory
from trueflight.models.whole_file import whole_file
from trueflight.sim_bridge.plan import Plan, legs_of
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.sensors import Estimate
from trueflight.sim_bridge.world import PHYSICS_STEP

LOST = 4.0
"""m from the reference at which a flight is given up, as the companion does."""
FALLEN = 0.6
"""Share of the standing height below which a vehicle that touches the ground lies on its side or its back."""
OUTCOME_LEVELS = {"finished": "info", "lost": "error", "crashed": "error"}


class Sample(NamedTuple):
    """One control tick: what the vehicle knew (home frame), what was asked, what was commanded."""

    estimate: Estimate
    position: tuple[float, float, float]
    reference: ReferenceSample
    step: ControlStep
    motors: list[float]
    guard: str
    inference: float
    mission: bool
    learning: Told | None = None


@dataclass(frozen=True)
class Flown:
    """How a flight went. Errors are RMS of position against the reference, m, per axis of the world.

    `touching` counts the ticks at which the vehicle touched the ground, where no model of flight holds.
    """

    outcome: str
    ticks: int
    simulated: float
    wall: float
    rms_error: tuple[float, float, float]
    guard: str
    touching: int = 0

    @property
    def times_real_time(self) -> float:
        """Simulated over wall time, everything included."""
        return self.simulated / self.wall if self.wall > 0 else math.inf


def fly(plan: Plan, on_sample: Callable[[Sample], None]) -> Flown:
    """Fly a plan from hover at the start of its trajectory; `on_sample` is called once a control tick.

    Positions are in the home frame: origin where the vehicle's centre of mass is when it stands on the
    ground, z up, axes of the world. The control law knows what has been reported, which may be old, and takes
    the reference of the moment that it tells of. Raises `InputError` for a design or a model that belongs to another
    vehicle.
    """
    guard, steps = _guard(plan), plan.steps_per_tick
    law = ControlLaw(plan.vehicle, plan.design)
    controller = make_controller(plan.controller, law, guard, plan.trim, plan.observer)
    simulator = _in_hover(plan)
    ground = simulator.world.standing_height
    period = steps * PHYSICS_STEP
    squares = [0.0, 0.0, 0.0]
    ticks, touching, outcome = 0, 0, "finished"
    if guard is not None:
        guard.start()
    waiting = math.ceil(plan.settle / period - 1e-9)
    controller.start()
    reported, step = simulator.reported, simulator.step
    status, inference, learning = "off", 0.0, None
    begin = time.perf_counter()
    for preview in _previews(plan, period):
        reference = preview(0.0)
        if ticks == waiting and waiting:
            controller.start()
        now = reported()
        px, py, pz = now.position
        position = (px, py, pz - ground)
        state = _state(now, position)
        control = controller.step(state, preview, period if ticks else 0.0)
        if guard is not None:
            status, inference = guard.status, guard.inference_time
            learning = guard.learning.told if guard.learning is not None else None
        mission = ticks >= waiting
        on_sample(
            Sample(now, position, reference, control, simulator.motors, status, inference, mission, learning)
        )
        ticks += 1
        rx, ry, rz = reference.position
        ex, ey, ez = px - rx, py - ry, position[2] - rz
        squares[0] += ex * ex
        squares[1] += ey * ey
        squares[2] += ez * ez
        if ex * ex + ey * ey + ez * ez > LOST * LOST:
            outcome = "lost"
            break
        if simulator.world.touching:
            touching += 1
            if pz < FALLEN * ground:
                outcome = "crashed"
                break
        command = control.thrust_command
        p, q, r = control.command.body_rate
        for _ in range(steps):
            step(command, p, q, r)
    wall = time.perf_counter() - begin
    a, b, c = (math.sqrt(total / ticks) for total in squares)
    return Flown(outcome, ticks, ticks * period, wall, (a, b, c), status, touching)


def _in_hover(plan: Plan) -> Simulator:
    simulator = Simulator(plan.vehicle, plan.hidden, plan.seed, plan.noise, plan.battery)
    x, y, z, yaw = plan.trajectory.start
    simulator.start_in_hover((x, y, z + simulator.world.standing_height), yaw)
    return simulator


def _state(now: Estimate, position: tuple[float, float, float]) -> State:
    """What the control law takes of an estimate, with the position in the home frame."""
    return State(
        position,
        now.velocity,
        now.quaternion,
        position[2],
        now.battery_voltage,
        now.angular_velocity,
        now.specific_force,
    )


def _guard(plan: Plan) -> Guard | None:
    if plan.model is None:
        return None
    verdict = check_model(plan.model, plan.vehicle)
    if verdict.model is None:
        raise InputError(f"--model: refused: {verdict.reason}")
    learns = plan.controller == CORRECTED_ADAPTIVE
    if learns and not verdict.model.info.learnables:
        raise InputError(f"--model: {cannot_learn(verdict.model.info.name)}")
    return Guard(verdict.model.watched(learns=learns))


def _previews(plan: Plan, period: float) -> Iterator[Preview]:
    """The reference ahead of each tick: the trajectory as often as asked, with a transfer from end to start between."""
    trajectory, legs = plan.trajectory, legs_of(plan)
    offset, tick = plan.settle, 0
    while tick * period < plan.settle - 1e-9:
        yield partial(_ahead, trajectory, tick * period - plan.settle)
        tick += 1
    for leg in legs:
        while tick * period - offset < leg.duration:
            yield partial(_ahead, leg, tick * period - offset)
            tick += 1
        offset += leg.duration


def _ahead(leg: Trajectory, t: float, ahead: float) -> ReferenceSample:
    return leg.at(t + ahead)


def record(
    plan: Plan, path: Path, table: Path | None = None, on_sample: Callable[[Sample], None] | None = None
) -> Flown:
    """Fly a plan into a flight record (MCAP), and into a CSV with the project's column names where asked.

    `on_sample` is called after each tick was taken down. Raises `InputError` where a file cannot be written.
    """
    tick = _TickWriter(plan)
    rows: list[tuple[float, ...]] = []

    takers: list[Callable[[Sample], None]] = [tick]
    if table is not None:
        takers.append(lambda sample: rows.append(_row(sample)))
    if on_sample is not None:
        takers.append(on_sample)

    def each(sample: Sample) -> None:
        for take in takers:
            take(sample)

    with whole_file(path, "the flight record", "choose another -o", new=True) as partial:
        flown = fly(plan, each if len(takers) > 1 else tick)
        _write_record(plan, tick, flown, partial)
        if table is not None:
            _write_csv(table, rows, plan.rotor_speeds)
    return flown


def _write_record(plan: Plan, tick: _TickWriter, flown: Flown, path: Path) -> None:
    """Write the record after the flight: the recorder's thread would share the interpreter with the simulation and
    halve its speed."""
    metadata = record_metadata(plan)
    # All of the flight has room in the queue, so that nothing is dropped.
    recorder = FlightRecorder(
        path, plan.vehicle, plan.design, metadata, queue_limit=len(tick.messages) + 100, simulated=True
    )
    try:
        for message, time_us, host in tick.messages:
            recorder.tick(message, time_us, host)
        level = OUTCOME_LEVELS[flown.outcome]
        recorder.event(
            Event(vehicle_time_us=tick.time_us, level=level, kind=flown.outcome, text=flown.outcome)
        )
    finally:
        recorder.close(timeout=60.0)
    if recorder.error:
        raise InputError(recorder.error.replace(str(path), "the flight record"))


def record_metadata(plan: Plan) -> dict[str, str]:
    """What a record tells of its flight; nothing of what is hidden."""
    parameters = {f"parameter.{key}": str(value) for key, value in plan.trajectory.parameters.items()}
    flown = {"trajectory": plan.trajectory.name, "controller": plan.controller}
    return {"created_by": "sim-bridge", **flown, **parameters}


def constant_tick(plan: Plan) -> Tick:
    """What is the same in every tick of a flight."""
    tick = Tick(
        controller=plan.controller,
        trajectory=plan.trajectory.name,
        flight_mode="OFFBOARD",
        armed=True,
        setpoint_sent=True,
        interval=1.0 / plan.rate,
    )
    if plan.model is not None:
        from trueflight.models.contract import model_hash

        tick.model = model_hash(plan.model)
    return tick


class _TickWriter:
    """Turns samples into the protobuf ticks that the companion writes: `messages` with both clocks (us,
    ns), which are one: simulated time.
    """

    def __init__(self, plan: Plan) -> None:
        self.messages: list[tuple[bytes, int, int]] = []
        self._rotor_speeds = plan.rotor_speeds
        # What is the same in every tick is set once; each tick then overwrites all the rest.
        self._tick = constant_tick(plan)
        self.time_us = 0

    def __call__(self, sample: Sample) -> None:
        """Write one tick."""
        tick, now, control, reference = self._tick, sample.estimate, sample.step, sample.reference
        self.time_us = tick.vehicle_time_us = now.time_us
        tick.host_time_ns = host = 1000 * now.time_us
        v = tick.position
        v.x, v.y, v.z = sample.position
        v = tick.velocity
        v.x, v.y, v.z = now.velocity
        q = tick.quaternion
        q.w, q.x, q.y, q.z = now.quaternion
        v = tick.angular_velocity
        v.x, v.y, v.z = now.angular_velocity
        v = tick.specific_force
        v.x, v.y, v.z = now.specific_force
        v = tick.position_reference
        v.x, v.y, v.z = reference.position
        v = tick.velocity_reference
        v.x, v.y, v.z = reference.velocity
        v = tick.acceleration_reference
        v.x, v.y, v.z = reference.acceleration
        tick.yaw_reference = reference.yaw
        feedback = control.feedback
        tick.feedback.thrust = feedback.thrust
        v = tick.feedback.body_rate
        v.x, v.y, v.z = feedback.body_rate
        v = tick.correction
        v.x, v.y, v.z = control.correction
        v = tick.correction_raw
        v.x, v.y, v.z = control.correction_raw
        v = tick.trim
        v.x, v.y, v.z = control.trim
        tick.thrust_command = control.thrust_command
        v = tick.body_rate_command
        v.x, v.y, v.z = control.command.body_rate
        tick.battery_voltage = now.battery_voltage
        if self._rotor_speeds:
            tick.rotor_speed[:] = now.rotor_speed
        tick.guard = sample.guard
        tick.phase = "mission" if sample.mission else "takeoff"
        tick.inference = sample.inference
        if sample.learning is not None:
            sample.learning.write(tick)
        self.messages.append((tick.SerializeToString(), now.time_us, host))


_TABLE_COLUMNS = (
    *("position", "velocity", "quaternion", "angular_velocity", "specific_force", "thrust_command"),
    *(
        "body_rate_command",
        "battery_voltage",
        "position_reference",
        "velocity_reference",
        "acceleration_reference",
    ),
    *("yaw_reference", "rotor_speed", "motor_command"),
)


def _row(sample: Sample) -> tuple[float, ...]:
    now, control, reference = sample.estimate, sample.step, sample.reference
    return (
        now.time_us * 1e-6,
        *(*sample.position, *now.velocity, *now.quaternion, *now.angular_velocity, *now.specific_force),
        *(control.thrust_command, *control.command.body_rate, now.battery_voltage),
        *(*reference.position, *reference.velocity, *reference.acceleration, reference.yaw),
        *(*now.rotor_speed, *sample.motors),
    )


def _write_csv(path: Path, rows: list[tuple[float, ...]], rotor_speeds: bool) -> None:
    names = ["t"] + [name for column in _TABLE_COLUMNS for name in COLUMNS[column][0]]
    kept = [i for i, name in enumerate(names) if rotor_speeds or name not in COLUMNS["rotor_speed"][0]]
    with (
        whole_file(path, "the table", "choose another --csv") as partial,
        partial.open("w", newline="", encoding="utf-8") as stream,
    ):
        writer = csv.writer(stream)
        writer.writerow([names[i] for i in kept])
        writer.writerows([f"{row[i]:.7g}" for i in kept] for row in rows)
