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
from trueflight.companion.findings import FAIL, NOTE, OK, WARN, Finding, rows_of
from trueflight.companion.message_rates import Rates, link_too_slow, odometry_too_low
from trueflight.companion.pose import PoseFeed
from trueflight.companion.px4_events import ERROR
from trueflight.companion.settings import Settings
from trueflight.companion.vehicle_link import VehicleLink
from trueflight.models.errors import InputError
from trueflight.models.record import read_record
from trueflight.models.vehicle import Vehicle

Number = int | float

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


@dataclass(frozen=True)
class RequiredParameter:
    """What a parameter should be: `good` tells whether a value is, `change` makes one of what is there.

    `state` is how bad it is where it is not; `otherwise` is looked at in a PX4 that does not have the parameter.
    """

    name: str
    wanted: str
    why: str
    good: Callable[[Number], bool]
    change: Callable[[Number], Number | None]
    state: str = FAIL
    reboot: bool = False
    otherwise: RequiredParameter | None = None


def required_parameters(settings: Settings) -> list[RequiredParameter]:
    """The parameters that a flight with these settings needs, in the order of their weight.

    Source: PX4's parameter reference; the first two decide what happens when the companion falls silent.
    """
    fence = settings.safety
    across, up = math.ceil(1.5 * fence.fence_radius), math.ceil(1.5 * fence.fence_height)
    out = [
        RequiredParameter(
            "COM_OF_LOSS_T",
            "0.2 to 1 s",
            "how long PX4 flies on after the companion fell silent",
            lambda v: 0.2 <= v <= 1.0,
            lambda v: 0.5,
        ),
        RequiredParameter(
            "COM_OBL_RC_ACT",
            "4 (Land), 3 (Return) or 5 (Hold)",
            "what it does then; 0 to 2 need a pilot and end in a blind descent without one",
            lambda v: v in (3, 4, 5),
            lambda v: 4,
        ),
        RequiredParameter(
            "COM_RC_OVERRIDE",
            "bit 1 (2 or 3)",
            "moving the sticks takes over in Offboard as well",
            lambda v: bool(int(v) & 2),
            lambda v: int(v) | 2,
            WARN,
            otherwise=RequiredParameter(
                "MAN_OVERRIDE_SPD",
                "0 or more",
                "moving the sticks this fast takes over; negative: never (PX4 1.18)",
                lambda v: v >= 0.0,
                lambda v: 1.0,
                WARN,
            ),
        ),
        RequiredParameter(
            "COM_RCL_EXCEPT",
            "0 with a radio, bit 2 (4) without",
            "bit 2: losing the radio does not end Offboard",
            lambda v: True,
            lambda v: None,
            NOTE,
        ),
        RequiredParameter(
            "EKF2_NOAID_TOUT",
            "at most 1000000 us",
            "how long PX4 1.16 and later calls a position without GPS or mocap valid, and drifts",
            lambda v: v <= 1_000_000,
            lambda v: 1_000_000,
            WARN,
        ),
        RequiredParameter(
            "COM_LOW_BAT_ACT",
            "2 (Land) or 3 (Return)",
            "what PX4 does at a critical battery; 0 only warns",
            lambda v: v in (1, 2, 3),
            lambda v: 2,
            WARN,
        ),
        RequiredParameter(
            "GF_MAX_HOR_DIST",
            f"about {across:d} m",
            f"PX4's own fence, outside the companion's {fence.fence_radius:g} m; 0 is none",
            lambda v: fence.fence_radius < v <= 10.0 * fence.fence_radius,
            lambda v: float(across),
            WARN,
        ),
        RequiredParameter(
            "GF_MAX_VER_DIST",
            f"about {up:d} m",
            f"PX4's own ceiling, above the companion's {fence.fence_height:g} m; 0 is none",
            lambda v: fence.fence_height < v <= 10.0 * fence.fence_height,
            lambda v: float(up),
            WARN,
        ),
        RequiredParameter(
            "GF_ACTION",
            "2 (Hold), 3 (Return) or 5 (Land)",
            "what PX4 does outside of it; 1 only warns",
            lambda v: v in (2, 3, 5),
            lambda v: 2,
            WARN,
        ),
    ]
    if settings.rate > 100.0:
        period = int(1e6 / settings.rate)
        out.append(
            RequiredParameter(
                "EKF2_PREDICT_US",
                f"at most {period} us",
                f"the estimator gives odometry no faster than this; {settings.rate:g} Hz are asked for",
                lambda v: v <= period,
                lambda v: period // 1000 * 1000 or 1000,
                reboot=True,
            )
        )
    if settings.pose.enabled:
        out += [
            RequiredParameter(
                "EKF2_EV_CTRL",
                "bits 0, 1 and 3 (11)",
                "takes position, height and yaw from mocap or vision",
                lambda v: int(v) & 11 == 11,
                lambda v: int(v) | 11,
            ),
            RequiredParameter(
                "EKF2_HGT_REF",
                "3 (vision)",
                "height is that of mocap or vision",
                lambda v: v == 3,
                lambda v: 3,
                WARN,
                True,
            ),
            RequiredParameter(
                "EKF2_GPS_CTRL",
                "0",
                "GPS would pull against mocap or vision",
                lambda v: v == 0,
                lambda v: 0,
                WARN,
            ),
            RequiredParameter(
                "EKF2_MAG_TYPE",
                "5 (none)",
                "the compass would pull against the yaw of mocap or vision",
                lambda v: v == 5,
                lambda v: 5,
                WARN,
                True,
            ),
            RequiredParameter(
                "EKF2_EV_DELAY",
                "about 0 ms",
                "poses carry the time when they were taken ([pose] latency)",
                lambda v: v <= 20.0,
                lambda v: 0.0,
                WARN,
                True,
            ),
        ]
    return out


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
    link.request_rates(settings.rate)
    time.sleep(0.5)
    rates = link.measure(2.0)
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
        parameters.append(judge(link, required))
    progress("hover thrust")
    records = Path(settings.records)
    hover = list(_hover(link, vehicle, records))
    return Preflight(
        link.autopilot_version(),
        arming,
        tuple(parameters),
        (*_rates(link, settings, rates), *_poses(pose)),
        tuple(hover),
        tuple(access_findings(settings)),
    )


def set_parameters(link: VehicleLink, parameters: Sequence[Parameter]) -> list[str]:
    """Set every parameter that has a `change`; one line for each: what was done, or why not."""
    lines = []
    for parameter in parameters:
        if parameter.change is None:
            continue
        reason = link.set_parameter(parameter.name, parameter.change)
        done = f"{parameter.name}: {parameter.value} -> {_shown(parameter.change)}"
        after = "; acts after the autopilot's restart" if parameter.reboot else ""
        lines.append(f"{parameter.name} not set: {reason}" if reason else done + after)
    return lines


def _arming(link: VehicleLink, settings: Settings, vehicle: Vehicle | None) -> Iterator[Finding]:
    for _ in range(3):  # also turns STATUSTEXT on, which PX4 before 1.13 tells its reasons by
        link.show_as_ground_station()
        time.sleep(0.3)
    report = link.arming_report()
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


def judge(link: VehicleLink, required: RequiredParameter) -> Parameter:
    """What the autopilot has where one is required, and what should become of it."""
    value = link.parameter(required.name)
    if value is None and required.otherwise is not None:
        return judge(link, required.otherwise)
    if value is None:
        return Parameter(required.name, "not there", required.wanted, required.why, NOTE)
    if required.good(value):
        state = NOTE if required.state == NOTE else OK
        return Parameter(required.name, _shown(value), required.wanted, required.why, state)
    change = required.change(value)
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
    theirs = link.parameter("MPC_THR_HOVER")
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
    use = link.parameter("MPC_USE_HTE")
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
