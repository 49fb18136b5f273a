"""One flight with a real PX4: listening, checking, flying, telling."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.seal import hidden_text, seal_where_asked
from trueflight.sim_bridge.settings import Settings
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.sitl.allocation import expected_parameters
from trueflight.sim_bridge.sitl.check import (
    HOVER,
    NO_GPS,
    OWN_BATTERY,
    VISION_ESTIMATOR,
    AllocationCheck,
    State,
)
from trueflight.sim_bridge.sitl.lockstep import Ending, Lockstep, Progress, listen
from trueflight.sim_bridge.sitl.messages import Offer, Position
from trueflight.sim_bridge.sitl.px4_link import PAYLOAD_PORT, Px4Link
from trueflight.sim_bridge.sitl.sensors import RawNoise, RawSensors
from trueflight.sim_bridge.sitl.truth_table import TruthTable
from trueflight.sim_bridge.truth.hidden import Hidden

FIRST_PORT = 4560
_INSTANCES = 10

_INSIDE = {"rate_loop_lag": "filters the commanded body rates inside the stand-in's autopilot"}
"""Hidden effects that a PX4 from outside cannot be given, and why."""


@dataclass(frozen=True)
class Request:
    """What `sim-bridge sitl` was asked for, beside the settings that it shares with `run`."""

    host: str
    port: int
    link_port: int | None
    position: Position
    vision_rate: float
    set_params: bool
    truth: Path | None

    @property
    def px4_port(self) -> int:
        """The UDP port for PX4's parameters, 0 for none: that of the instance which the TCP port belongs to."""
        if self.link_port is not None:
            return self.link_port
        instance = self.port - FIRST_PORT
        return PAYLOAD_PORT + instance if 0 <= instance < _INSTANCES else 0


def check_hidden(hidden: tuple[Hidden, ...]) -> None:
    """Raise `InputError` where an effect acts inside the stand-in's autopilot, which does not fly here."""
    for one in hidden:
        if one.name in _INSIDE:
            raise InputError(
                f"--hidden: '{one.name}' {_INSIDE[one.name]}, and here PX4 flies; hide another effect or draw with "
                "another seed"
            )


def parameter_lines(vehicle: Vehicle, position: Position) -> list[str]:
    """The commands of PX4's shell (or lines of its `px4-rc.params`) that make its control allocation the vehicle's."""
    lines = [f"param set {one.name} {one.value:.6g}" for one in expected_parameters(vehicle)]
    lines.append(f"param set {HOVER} {vehicle.hover_thrust:.6g}")
    wished = {**OWN_BATTERY, **estimator_parameters(position)}
    return lines + [f"param set {name} {value}" for name, value in wished.items()]


def estimator_parameters(position: Position) -> dict[str, int]:
    """What EKF2 needs to be for a source of position."""
    if position is Position.GPS:
        return {}
    return VISION_ESTIMATOR if position is Position.BOTH else {**VISION_ESTIMATOR, **NO_GPS}


class Teller(Protocol):
    """Whoever is told what happens."""

    def tell(self, event: str, text: str, **more: Any) -> None:
        """One thing that happened."""

    def note(self, text: str) -> None:
        """A remark."""

    def live(self, text: str) -> None:
        """What is going on just now."""

    def differences(self, vehicle: Vehicle, values: dict[str, int | float]) -> None:
        """What PX4 has (`values`) where its control allocation is another vehicle's."""


def fly(
    vehicle: Vehicle,
    hidden: tuple[Hidden, ...],
    settings: Settings,
    request: Request,
    stopped: Callable[[], bool],
    teller: Teller,
) -> None:
    """Simulate for one PX4 until it goes, or the user stops, or the duration is over.

    The answer is sealed once nothing can fail any more. Raises `InputError` for what cannot be simulated, for another
    vehicle in PX4, and for a PX4 that vanishes in flight.
    """
    check_hidden(hidden)
    simulator = Simulator(vehicle, hidden, settings.seed, settings.sensor_noise, settings.battery)
    raw = simulator.sensors
    sensors = RawSensors(RawNoise().times(settings.noise), settings.seed, raw.accelerometer_bias)
    offer = Offer(request.position, request.vision_rate, raw.delay)
    with ExitStack() as stack:
        lockstep = Lockstep(
            simulator, sensors, listen(request.host, request.port), teller.note, settings.speed, offer
        )
        stack.callback(lockstep.close)
        check = _allocation_check(vehicle, simulator, request, stack)
        table = stack.enter_context(TruthTable(request.truth, simulator)) if request.truth else None
        answer = seal_where_asked(settings, hidden, vehicle.name, Path(f"hidden-seed-{settings.seed}.sealed"))
        _tell_ready(vehicle, settings, request, answer, teller)
        if not lockstep.accept(lambda: not stopped()):
            teller.tell("stopped", "stopped; no PX4 came")
            return
        teller.tell("connected", f"connected: {lockstep.peer}", peer=lockstep.peer)
        watch = _Watch(vehicle, lockstep, check, table, teller)
        end_us = settings.duration * 1e6 or float("inf")
        ending = lockstep.run(
            lambda: not stopped() and lockstep.progress.simulated * 1e6 < end_us, watch.each_step
        )
        _conclude(ending, lockstep.progress, check, teller)


def _allocation_check(
    vehicle: Vehicle, simulator: Simulator, request: Request, stack: ExitStack
) -> AllocationCheck | None:
    """What compares PX4's control allocation with the vehicle; None where the request has no port for it."""
    if not request.px4_port:
        return None
    link = Px4Link(request.px4_port)
    stack.callback(link.close)
    wished = estimator_parameters(request.position)
    return AllocationCheck(vehicle, link, simulator.airframe.battery, request.set_params, wished)


def _tell_ready(
    vehicle: Vehicle, settings: Settings, request: Request, answer: Path | None, teller: Teller
) -> None:
    pace = f"{settings.speed:g} times real time" if settings.speed else "as fast as it goes"
    address, hidden = f"TCP {request.host}:{request.port}", hidden_text(settings, answer)
    teller.tell(
        "ready",
        f"ready: {vehicle.name} waits for PX4 on {address}, {pace}; {hidden}",
        vehicle=vehicle.name,
        port=request.port,
        link_port=request.px4_port,
        speed=settings.speed,
        sealed=str(answer) if answer else None,
    )
    teller.live(f"waiting for PX4 on TCP port {request.port}")


class _Watch:
    """What happens beside the flight after each of PX4's steps."""

    def __init__(
        self,
        vehicle: Vehicle,
        lockstep: Lockstep,
        check: AllocationCheck | None,
        table: TruthTable | None,
        teller: Teller,
    ) -> None:
        self._vehicle, self._lockstep, self._check = vehicle, lockstep, check
        self._table, self._teller = table, teller
        self._ticks = 0
        self._told_check = False

    def each_step(self, time_us: int) -> None:
        """The check and the truth twice a second and every other step; the live line."""
        self._ticks += 1
        progress = self._lockstep.progress
        if self._table is not None and self._ticks % 2 == 0:
            self._table.row(time_us)
        if self._ticks % 25 == 0:
            if self._check is not None:
                self._align(self._check, time_us)
            state = "armed" if progress.armed else "disarmed"
            height = self._lockstep.simulator.world.position[2]
            self._teller.live(
                f"{progress.simulated:.0f} s, {progress.times_real_time:.2f} times real time, {state}, "
                f"height {height:.1f} m"
            )

    def _align(self, check: AllocationCheck, time_us: int) -> None:
        try:
            check.step(time_us)
        except InputError:
            has = {one.name: value for one, value in check.rows() if value is not None}
            self._teller.differences(self._vehicle, has)
            raise
        if check.state is State.WAITING or self._told_check:
            return
        self._told_check = True
        if check.state is State.AGREES:
            changed = f"; set: {', '.join(check.changed)}" if check.changed else ""
            self._teller.tell(
                "checked",
                f"PX4's control allocation is the vehicle's ({len(self._vehicle.rotor_positions)} rotors){changed}",
                changed=check.changed,
            )
        for text in check.notes:
            self._teller.note(text)


def _conclude(ending: Ending, progress: Progress, check: AllocationCheck | None, teller: Teller) -> None:
    if progress.answers == 0:
        hint = "; PX4 never drove its outputs: look at its console" if progress.simulated > 1.0 else ""
    else:
        times = np.array(progress.answer_times) * 1e3
        hint = (
            f"; {progress.answers} steps answered in {np.median(times):.2f} ms (median), "
            f"{np.percentile(times, 99):.1f} ms (99 %), {progress.late} late"
            if len(times)
            else ""
        )
    text = (
        f"{ending.value} after {progress.simulated:.1f} s of simulated time, "
        f"{progress.times_real_time:.2f} times real time{hint}"
    )
    if ending is not Ending.STOPPED and progress.armed and progress.airborne:
        raise InputError(f"{text}; it was armed and in the air. Start both again: PX4 does not reconnect")
    teller.tell(
        "stopped",
        text,
        ending=ending.name.lower(),
        simulated=progress.simulated,
        times_real_time=progress.times_real_time,
        answers=progress.answers,
        late=progress.late,
        refused=progress.refused,
        armed=progress.armed,
        allocation=check.state.value if check else State.UNKNOWN.value,
    )
