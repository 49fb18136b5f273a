"""What stands between this vehicle and a flight by the companion: arming checks, parameters, rates, hover thrust.

Everything is asked of the autopilot and nothing is changed; `set_parameters` changes what the report says, and
only that, for whoever asks for it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.companion.access import access_findings
from trueflight.companion.commands import Parameters
from trueflight.companion.findings import FAIL, NOTE, OK, WARN, Finding, rows_of
from trueflight.companion.message_rates import Rates, link_too_slow, odometry_too_low
from trueflight.companion.pose import PoseFeed
from trueflight.companion.px4_events import ERROR
from trueflight.companion.required_parameters import Number, RequiredParameter, required_parameters
from trueflight.companion.settings import Settings
from trueflight.companion.vehicle_link import VehicleLink
from trueflight.models.errors import InputError
from trueflight.models.record import read_record
from trueflight.models.vehicle import Vehicle

_SLOW, _TILT = 0.2, 0.1
"""m/s and rad below which a recorded sample counts as hover."""
_HOVER_SECONDS = 2.0
_FUSED_WITHIN = 20.0  # s in which PX4's estimator takes poses up, or never does
_POSE_RATE = 30.0  # Hz that PX4 asks of external vision at least
_PATIENCE = 5.0  # s for a first heartbeat
_HOVER_HEIGHT = 0.5  # m, out of ground effect
_HOVER_NEAR, _HOVER_FAR = 0.10, 0.30
"""Relative difference of hover thrusts that is told, and with which nothing should take off: the cascade has no
integral, so that a thrust wrong by a share e moves the height by e g over the gain on height."""


@dataclass(frozen=True)
class Parameter(Finding):
    """A parameter of the autopilot; `change` is what `set_parameters` would set it to (None: leave it)."""

    change: Number | None = None
    reboot: bool = False


@dataclass(frozen=True)
class Preflight:
    """The whole report; `ready` where nothing has the state `fail`."""

    autopilot: str
    arming: tuple[Finding, ...]
    parameters: tuple[Parameter, ...]
    rates: tuple[Finding, ...]
    hover: tuple[Parameter, ...]
    access: tuple[Finding, ...] = ()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All of them."""
        return (*self.arming, *self.parameters, *self.rates, *self.hover, *self.access)

    @property
    def ready(self) -> bool:
        """Whether a flight may be tried."""
        return all(finding.state != FAIL for finding in self.findings)


def look(
    link: VehicleLink,
    settings: Settings,
    vehicle: Vehicle | None,
    progress: Callable[[str], None] = lambda what: None,
    pose: PoseFeed | None = None,
) -> Preflight:
    """Ask everything of the autopilot; takes some seconds, longer for every parameter that it does not have.

    With a `pose` feed it waits until the estimator has made a position of it. `progress` is told what is being
    looked at. The vehicle must be disarmed: raises `InputError` otherwise.
    """
    end = time.monotonic() + _PATIENCE
    while link.latest.heartbeat == -math.inf:  # until the first one every state is only a default
        if time.monotonic() > end:
            raise InputError(
                f"{link.address}: no heartbeat of the autopilot's own; is the link a one-way one?"
            )
        time.sleep(0.02)
    if link.latest.armed:
        raise InputError("the vehicle is armed; disarm it, then look again")
    progress("message rates")
    link.latest.batteries.nominal = None if vehicle is None else vehicle.nominal_voltage
    link.commands.request_rates(settings.rate)
    time.sleep(0.5)
    rates = link.measure(2.0)
    if link.ambiguous:
        raise InputError(link.ambiguous)
    link.read_capacities()
    if pose is not None:
        progress("mocap poses")
        end = time.monotonic() + _FUSED_WITHIN
        while (pose.why_not or _without_position(link, settings)) and (
            time.monotonic() < (end if pose.status()["passed"] else end - 0.5 * _FUSED_WITHIN)
        ):
            time.sleep(0.1)
    progress("arming checks")
    arming = tuple(_arming(link, settings, vehicle))
    parameters = []
    for required in required_parameters(settings):
        progress(required.name)
        parameters.append(judge(link.parameters.read, required))
    progress("hover thrust")
    records = Path(settings.records)
    hover = list(_hover(link, vehicle, records))
    return Preflight(
        link.commands.autopilot_version(),
        arming,
        tuple(parameters),
        (*_rates(link, settings, rates), *_poses(pose)),
        tuple(hover),
        tuple(access_findings(settings)),
    )


def set_parameters(autopilot: Parameters, parameters: Sequence[Parameter]) -> list[str]:
    """Set every parameter that has a `change`; one line for each: what was done, or why not."""
    lines = []
    for parameter in parameters:
        if parameter.change is None:
            continue
        reason = autopilot.write(parameter.name, parameter.change)
        done = f"{parameter.name}: {parameter.value} -> {_shown(parameter.change)}"
        after = "; acts after the autopilot's restart" if parameter.reboot else ""
        lines.append(f"{parameter.name} not set: {reason}" if reason else done + after)
    return lines


def _arming(link: VehicleLink, settings: Settings, vehicle: Vehicle | None) -> Iterator[Finding]:
    for _ in range(3):  # also turns STATUSTEXT on, which PX4 before 1.13 tells its reasons by
        link.commands.show_as_ground_station()
        time.sleep(0.3)
    report = link.commands.arming_report()
    if report is None:
        texts = [text for text in link.latest.texts if "fail" in text.lower() or "denied" in text.lower()]
        for text in dict.fromkeys(texts):
            yield Finding("arming", text, "", "told by the autopilot", FAIL)
        for what in link.latest.unhealthy:
            yield Finding("health", f"{what} is not well", "", "SYS_STATUS", WARN)
        if not texts:
            yield Finding("arming", "not told", "", "this autopilot does not explain its arming checks", NOTE)
    else:
        for problem in report.problems:
            if problem not in report.reasons(streaming=False) and problem.level <= ERROR:
                continue
            state = FAIL if problem.level <= ERROR else WARN if problem.level == ERROR + 1 else NOTE
            yield Finding("arming", problem.text, "", problem.advice, state)
        if not report.reasons(streaming=False):
            why = "once the companion streams setpoints"
            if _without_position(link, settings):
                why += (
                    "; PX4 arms for Offboard by body rates without a position, the companion does not (below)"
                )
            yield Finding("arming", "PX4 would arm", "", why, OK)
    yield _position(link, settings)
    voltage = link.latest.battery_voltage
    if vehicle is not None:
        low = settings.safety.takeoff_voltage * vehicle.nominal_voltage
        state = NOTE if voltage == 0.0 else OK if voltage >= low else FAIL
        told = f"{voltage:.1f} V" if voltage else "not told"
        yield Finding("battery", told, "", f"a flight needs {low:.1f} V ([safety] takeoff_voltage)", state)
    yield from _several(link)


def _several(link: VehicleLink) -> Iterator[Finding]:
    """Batteries beside the one that decides, and who else speaks on the link."""
    batteries = link.latest.batteries
    if batteries.why_not:
        yield Finding("battery", "not there", "", batteries.why_not, FAIL)
    elif len(batteries.connected) > 1:
        advice = "the lowest that is not left out decides; choose one with --battery"
        yield Finding("batteries", batteries.words, "", advice, NOTE)
    for sender, count in link.others.describe().items():
        yield Finding("heard as well", f"{sender}: {count} messages", "", "nothing of them is used", NOTE)


def _without_position(link: VehicleLink, settings: Settings) -> str:
    estimator = link.latest.estimator
    return "" if estimator is None else estimator.refusal(settings.safety.position_accuracy)


def _position(link: VehicleLink, settings: Settings) -> Finding:
    most, estimator = settings.safety.position_accuracy, link.latest.estimator
    wanted = f"a valid position, known to {most:g} m"
    if estimator is None:
        return Finding(
            "position", "not told", wanted, "no ESTIMATOR_STATUS came; a flight goes without this check", NOTE
        )
    accuracy = estimator.position_accuracy
    value = (
        f"known to {accuracy:.2f} m"
        if math.isfinite(accuracy)
        else "accuracy not told"
        if estimator.has_position
        else "none"
    )
    told = f"the estimator says: {estimator.words}"
    if accuracy <= most:
        return Finding("position", value, wanted, told, OK)
    return Finding("position", value, wanted, f"{told}. Wait for GPS, or give it mocap (EKF2_EV_CTRL)", FAIL)


def _poses(feed: PoseFeed | None) -> Iterator[Finding]:
    if feed is None:
        return
    status, name = feed.status(), "mocap poses"
    if feed.why_not:
        why = f"{feed.why_not}; put them on the key trueflight/<vehicle>/pose"
        yield Finding(name, "none", "", why, FAIL)
        return
    latency = status["latency_ms"]
    late = f"{latency['median']:.1f} ms old when passed on, p99 {latency['p99']:.1f} ms"
    state = OK if status["rate"] >= _POSE_RATE else WARN
    yield Finding(name, f"{status['rate']:.0f} Hz", f"{_POSE_RATE:.0f} Hz", late, state)
    if status["refused"]:
        told = ", ".join(f"{count} {kind}" for kind, count in status["refused"].items())
        yield Finding("poses refused", told, "0", "stale, jumping or no pose at all", WARN)


def _shown(value: Number) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def judge(read: Callable[[str], Number | None], required: RequiredParameter) -> Parameter:
    """What the autopilot has where one is required, and what should become of it; `read` asks it for one by name."""
    value = read(required.name)
    if value is None and required.otherwise is not None:
        return judge(read, required.otherwise)
    if value is None:
        return Parameter(required.name, "not there", required.wanted, required.why, NOTE)
    if required.rule.good(value):
        state = NOTE if required.state == NOTE else OK
        return Parameter(required.name, _shown(value), required.wanted, required.why, state)
    change = required.rule.change(value)
    if change is not None:
        change = type(value)(change)  # PX4 takes an INT32 as an INT32 only
    return Parameter(
        required.name, _shown(value), required.wanted, required.why, required.state, change, required.reboot
    )


def _rates(link: VehicleLink, settings: Settings, rates: Rates) -> Iterator[Finding]:
    reason = odometry_too_low(rates, settings.rate)
    why = reason or "drives the control loop, one setpoint each"
    state = FAIL if reason else OK
    yield Finding("odometry", f"{rates.odometry:.0f} Hz", f"{settings.rate:g} Hz", why, state)
    gap, most = rates.longest_gap, settings.safety.odometry_gap
    state = OK if gap <= most else FAIL
    why = "longest between two odometry messages; a longer one in flight lands"
    yield Finding("gap", f"{1e3 * gap:.0f} ms", f"{1e3 * most:.0f} ms", why, state)
    least = 0.5 * min(settings.rate, 100.0)
    slow = rates.imu < least
    why = link_too_slow("HIGHRES_IMU") if slow else "the accelerometer, which the diagnosis lives on"
    yield Finding("accelerometer", f"{rates.imu:.0f} Hz", f"{least:.0f} Hz", why, FAIL if slow else OK)
    state = OK if rates.battery > 1.0 else WARN
    why = "voltage, for the battery limits and for battery_sag"
    yield Finding("battery", f"{rates.battery:.0f} Hz", "1 Hz", why, state)
    why = "rotor speeds; without them some effects cannot be told apart" + (
        "" if rates.esc else " (DShot telemetry)"
    )
    yield Finding("rotor speeds", f"{rates.esc:.0f} Hz", "any", why, OK if rates.esc else NOTE)


@dataclass(frozen=True)
class Hover:
    """Hover thrust learned from a record: normalised collective at `voltage` V over `seconds` s."""

    thrust: float
    voltage: float
    seconds: float
    record: str


def learned_hover(records: Path, vehicle: Vehicle) -> Hover | None:
    """What the newest record of this vehicle with enough hover in it says; None without one."""
    for path in sorted(records.glob("*.mcap"), reverse=True)[:5]:
        try:
            record = read_record(path)
        except InputError:
            continue
        if record.vehicle is None or record.vehicle.name != vehicle.name:
            continue
        found = hover_of(record.ticks, path.name)
        if found is not None:
            return found
    return None


def hover_of(ticks: dict[str, np.ndarray], name: str) -> Hover | None:
    """The median command while the vehicle stood still in the air and level; None for less than 2 s of that."""
    if len(ticks["t"]) < 2:
        return None
    speed = np.linalg.norm(ticks["velocity"], axis=1)
    _, x, y, _ = ticks["quaternion"].T
    still = (
        ticks["setpoint_sent"] & ticks["armed"] & (speed < _SLOW) & (ticks["position"][:, 2] > _HOVER_HEIGHT)
    )
    still &= 2.0 * (x * x + y * y) < 1.0 - math.cos(_TILT)
    seconds = float(np.sum(ticks["interval"][still]))
    if seconds < _HOVER_SECONDS:
        return None
    thrust, voltage = np.median(ticks["thrust_command"][still]), np.median(ticks["battery_voltage"][still])
    return Hover(float(thrust), float(voltage), seconds, name)


def _hover(link: VehicleLink, vehicle: Vehicle | None, records: Path) -> Iterator[Parameter]:
    theirs = link.parameters.read("MPC_THR_HOVER")
    shown = "not there" if theirs is None else f"{theirs:.2f}"
    if vehicle is None:
        yield Parameter("MPC_THR_HOVER", shown, "", "pass --vehicle to compare it", NOTE)
        return
    ours = vehicle.hover_thrust
    learned = learned_hover(records, vehicle)
    if learned is not None:
        away = learned.thrust / ours - 1.0
        state = FAIL if abs(away) > _HOVER_FAR else WARN if abs(away) > _HOVER_NEAR else OK
        where = f"flown: {learned.seconds:.0f} s of hover at {learned.voltage:.1f} V"
        yield Parameter(
            "hover_thrust, flown", f"{learned.thrust:.3f}", f"{ours:g} (vehicle file)", where, state
        )
    best = learned.thrust if learned is not None else ours
    if theirs is None:
        yield Parameter("MPC_THR_HOVER", shown, f"{best:.2f}", "", NOTE)
        return
    away = theirs / best - 1.0
    state = OK if abs(away) <= _HOVER_NEAR else WARN
    use = link.parameters.read("MPC_USE_HTE")
    why = "PX4's own modes, its Land too, begin with it" + (" and learn it in flight" if use else "")
    change = round(learned.thrust, 2) if learned is not None and state == WARN else None
    yield Parameter("MPC_THR_HOVER", shown, f"{best:.2f}", why, state, change)


def as_json(report: Preflight) -> dict[str, Any]:
    """The report for programs."""
    parameters = [
        {**row, "change": parameter.change}
        for row, parameter in zip(rows_of(report.parameters), report.parameters, strict=True)
    ]
    return {
        "ready": report.ready,
        "autopilot": report.autopilot,
        "arming": rows_of(report.arming),
        "parameters": parameters,
        "rates": rows_of(report.rates),
        "hover_thrust": rows_of(report.hover),
        "access": rows_of(report.access),
    }
