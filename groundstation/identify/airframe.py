"""The numbers of a vehicle that its rotation shows: inertia, torque constant, and how late its rotors act.

The angular acceleration is explained by the torque of the rotors' thrusts, as `identify.torque` has it, in a wider
band: a closed rate loop answers slow disturbances with torque that turns nothing, so that below its bandwidth gains
come out too small. Thrust is scaled by the weight (or the accelerometer), so an inertia is as true as the mass.
Intervals are those of correlated residuals (`identify.fitting.robust_covariance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from trueflight.groundstation.identify.fitting import SCALE, robust_covariance
from trueflight.groundstation.identify.torque import Turning, turning_of
from trueflight.groundstation.measured.measurement import Rotation
from trueflight.groundstation.results import Identified, VehicleNumber
from trueflight.models.flight import Flight
from trueflight.models.lag import delayed, lagged
from trueflight.models.prediction import motion_of_flight

BANDWIDTH = 15.0
"""Hz of the angular acceleration that is looked at: beyond the bandwidth of a rate loop, below most vibration."""
WELL_EXPLAINED = 0.75
"""Part of the variance about an axis from which its numbers are told. With less, something else turns the vehicle as
much as its rotors do, and the rate loop answers it: gains come out too small, and inertias too large."""
STARTS = tuple((delay, lag) for delay in (0.0, 0.01, 0.025, 0.05) for lag in (0.01, 0.03, 0.06, 0.12))
"""s of delay and lag that a fit may begin from."""
LATEST = 0.4
"""s, the most that a delay or a lag is looked for; an interval that reaches it has no end."""
SPEEDS = "from command to rotor speed"
HELD = 0.01
"""Relative 95 % uncertainty where rotors are seen through their commands: a log does not say when, within a sample, a
command changed. In 20 seeded flights of four to eight rotors gains were then off by up to 4 %."""
STEPS = 2
"""Gauss-Newton steps from the delay and lag that a coarse search has found."""
STEP = 1e-3
"""s by which delay and lag are moved to see what they do."""
FLAT = "inertia z is that of a flat body, x plus y: the vehicle file tells none"


@dataclass(frozen=True)
class _Measured:
    """One rotation, as a fit needs it."""

    rotation: Rotation

    @property
    def measurements(self) -> Sequence[Rotation]:
        return (self.rotation,)

    def unit(self) -> float:
        return 1.0


@dataclass(frozen=True)
class _Speeds:
    """The rotor speeds of a flight at times `t` (N,), s, of which `used` (N,) are compared, as a fit needs them."""

    t: np.ndarray
    used: np.ndarray

    @property
    def measurements(self) -> Sequence[_Speeds]:
        return (self,)

    def unit(self) -> float:
        return 1.0


@dataclass(frozen=True)
class _Solution:
    """Estimates by name with their covariance and the factor of a 95 % interval; `explained` (A,) of the variance."""

    names: tuple[str, ...]
    estimate: np.ndarray
    covariance: np.ndarray
    critical: float
    explained: np.ndarray

    def interval(self, name: str) -> tuple[float, float, float]:
        i = self.names.index(name)
        half = float(
            np.hypot(self.critical * np.sqrt(max(self.covariance[i, i], 0.0)), SCALE * self.estimate[i])
        )
        value = float(self.estimate[i])
        return value, value - half, value + half


def identify(flight: Flight, bandwidth: float = BANDWIDTH) -> Identified | None:
    """Inertia, torque constant, delay and lag of the rotors as `flight` shows them; None where it has no rotor data, or
    no rotation to hold against it."""
    turning = turning_of(flight, bandwidth)
    if turning is None:
        return None
    rotation = turning.rotation
    if turning.actuation is not None:
        turning = min(map(partial(_acting, turning), (turning.actuation, *STARTS)), key=_misfit)
    found = _solve(turning)
    for _ in range(STEPS if turning.actuation is not None else 0):
        stepped = _acting(turning, found.estimate[-2:])
        better = _solve(stepped)
        if float(np.sum(better.explained)) < float(np.sum(found.explained)):
            break
        turning, found = stepped, better
    axes = tuple("xyz"[a] for a in rotation.axes)
    explained = dict(zip(axes, (float(x) for x in found.explained), strict=True))
    told = {a for a, share in explained.items() if share > WELL_EXPLAINED}
    numbers = [*_inertia(turning, found, axes), *_torque_constant(turning, found, axes)]
    numbers += _lateness(rotation.flight, found)
    kept = [n for n in numbers if _determined(n, told)]
    return Identified(
        flight.name,
        tuple(kept),
        tuple(n.name for n in numbers if n not in kept),
        axes,
        tuple(explained.values()),
        rotation.bandwidth,
        rotation.source,
    )


def _determined(number: VehicleNumber, told: set[str]) -> bool:
    """Whether the axes that show it are well explained, and its interval has ends."""
    axis = {"inertia_x": {"x"}, "inertia_y": {"y"}, "rotor_lag": {"x", "y"}, "rotor_delay": {"x", "y"}}
    shown = number.told == SPEEDS or bool(axis.get(number.name, {"z"}) & told)
    ends = bool(np.isfinite(number.low) and np.isfinite(number.high))
    return shown and ends and (number.unit != "s" or number.high < LATEST)


def _misfit(turning: Turning) -> float:
    """What the rotors' torques alone leave of the angular acceleration about x and y, (rad/s²)²."""
    tilts = [i for i, axis in enumerate(turning.rotation.axes) if axis < 2]
    seen, measured = turning.control[:, tilts], turning.measured[:, tilts]
    seen, measured = seen - seen.mean(axis=0), measured - measured.mean(axis=0)
    gain = np.sum(seen * measured, axis=0) / np.maximum(np.sum(seen**2, axis=0), 1e-12)
    return float(np.sum((measured - np.maximum(gain, 0.0) * seen) ** 2))


def _solve(turning: Turning, without_delay: bool = False) -> _Solution:
    """Gains about each axis, damping, and, where commands were logged, delay and lag, linearised where they are.

    A delay that came out below nothing is held there (`without_delay`), and the lag found again."""
    late = turning.actuation is not None
    kept = [(n, c) for n, c in turning.nuisances if not (late and n.startswith("shift_"))]
    names, columns = [n for n, _ in kept], [c for _, c in kept]
    measured = turning.measured
    weight = np.ones(measured.shape[1])
    for _ in range(2):
        flat = np.stack(columns, axis=2) * weight[None, :, None]
        solution = np.linalg.lstsq(flat.reshape(-1, len(names)), (measured * weight).ravel(), rcond=None)[0]
        left = measured - np.stack(columns, axis=2) @ solution
        weight = 1.0 / np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-9)
    if turning.actuation is not None:
        gains = np.array([solution[names.index(f"gain_{'xyz'[a]}")] for a in turning.rotation.axes])
        for name, moved in zip(("delay", "lag"), np.eye(2) * STEP, strict=True):
            names.append(name)
            there = _acting(turning, np.array(turning.actuation) + moved)
            held = name == "delay" and without_delay
            columns.append((there.control - turning.control) * gains * (0.0 if held else 1.0 / STEP))
    jacobian = np.stack(columns, axis=2) * weight[None, :, None]
    flat = jacobian.reshape(-1, len(names))
    size = np.maximum(np.linalg.norm(flat, axis=0), 1e-12)
    x = np.linalg.lstsq(flat / size, (measured * weight).ravel(), rcond=1e-10)[0] / size
    left = measured * weight - jacobian @ x
    covariance, critical = robust_covariance(
        _Measured(turning.rotation), jacobian, left, np.zeros(len(names))
    )
    if turning.actuation is not None:
        x[-2:] += turning.actuation
        if x[-2] < 0.0 and not without_delay:
            return _solve(_acting(turning, (0.0, turning.actuation[1])), without_delay=True)
    spread = np.var(measured * weight, axis=0)
    return _Solution(tuple(names), x, covariance, critical, 1.0 - np.mean(left**2, axis=0) / spread)


def _acting(turning: Turning, late: Sequence[float] | np.ndarray) -> Turning:
    """The same rotation with the rotors' thrusts after another delay and lag (2,), s."""
    delay, lag = (float(v) for v in np.clip(late, 0.0, 0.4))
    motion = motion_of_flight(turning.rotation.flight)
    speeds = np.sqrt(np.clip(motion.rotor_thrust, 0.0, None))
    each = [lagged(delayed(c, delay, motion.dt), lag, motion.dt) ** 2 for c in speeds.T]
    acting = turning.motion.with_(rotor_thrust=np.stack(each, axis=1))
    return replace(turning, motion=acting, actuation=(delay, lag))


def _inertia(turning: Turning, found: _Solution, axes: Sequence[str]) -> list[VehicleNumber]:
    numbers = []
    for i, axis in enumerate(axes):
        if axis == "z":
            continue
        believed = turning.motion.vehicle.inertia[turning.rotation.axes[i]]
        gain, low, high = found.interval(f"gain_{axis}")
        assumed = float(turning.inertia[turning.rotation.axes[i]])
        ends = [assumed / g if g > 0.0 else np.inf for g in (gain, high, low)]
        numbers.append(_number(f"inertia_{axis}", ends, "kg m^2", believed or None, ""))
    return numbers


def _torque_constant(turning: Turning, found: _Solution, axes: Sequence[str]) -> list[VehicleNumber]:
    """Drag torque over thrust of a rotor: about z only its ratio to the inertia is seen."""
    if "z" not in axes:
        return []
    gain, low, high = found.interval("gain_z")
    ratio = [g / float(turning.inertia[2]) for g in (gain, low, high)]
    numbers = [_number("torque_constant_over_inertia_z", ratio, "1/(kg m)", None, "")]
    inertia, beside = turning.motion.vehicle.inertia[2], "at the believed inertia z"
    if inertia <= 0.0:
        if not {"x", "y"} <= set(axes):
            return numbers
        inertia = sum(n.value for n in _inertia(turning, found, axes))
        beside = FLAT
    constant = [inertia * r for r in ratio]
    numbers.append(_number("torque_constant", constant, "m", None, beside))
    return numbers


def _number(name: str, ends: Sequence[float], unit: str, believed: float | None, told: str) -> VehicleNumber:
    """A number with its value and the ends of its interval."""
    value, low, high = ends
    return VehicleNumber(name, value, low, high, unit, believed, told)


def _lateness(flight: Flight, found: _Solution) -> list[VehicleNumber]:
    """Delay and lag from command to rotors: in the rotation, or in the speeds of the rotors themselves."""
    vehicle = flight.vehicle
    if "lag" in found.names:
        told = ""
        ends = {n: found.interval(n) for n in ("lag", "delay")}
    else:
        ends, told = _from_speeds(flight), SPEEDS
    believed = {"lag": vehicle.motor_time_constant, "delay": vehicle.command_delay}
    # a command that is held for a sample looks half a sample late and smoothed, and no log's clock is better
    clock = {"lag": 0.5 * flight.dt, "delay": flight.dt}
    return [
        _number(
            f"rotor_{n}",
            [max(v, 0.0), max(low - clock[n], 0.0), max(high + clock[n], 0.0)],
            "s",
            believed[n],
            told,
        )
        for n, (v, low, high) in ends.items()
    ]


def _from_speeds(flight: Flight) -> dict[str, tuple[float, float, float]]:
    """Lag and delay (value, low, high in s) with which the rotor speeds follow their commands, or their mean the
    collective."""
    from scipy import optimize  # dear to load

    assert flight.rotor_speed is not None
    used = np.ones(len(flight), bool) if flight.flying is None else flight.flying
    speeds, command = np.nan_to_num(flight.rotor_speed), flight.motor_command
    if command is None or command.shape != speeds.shape:
        speeds, command = speeds.mean(axis=1, keepdims=True), flight.column("thrust_command")[:, None]
    wanted = np.sqrt(np.clip(flight.vehicle.thrust(np.nan_to_num(command)), 0.0, None))
    scale = np.maximum(np.std(speeds[used], axis=0), 1e-9)

    def left(x: np.ndarray) -> np.ndarray:
        out = []
        for speed, sent in zip((speeds / scale).T, wanted.T, strict=True):
            follows = lagged(delayed(sent, x[0], flight.dt), x[1], flight.dt)[used]
            a = np.stack([follows, np.ones(len(follows))], axis=1)
            out.append(speed[used] - a @ np.linalg.lstsq(a, speed[used], rcond=None)[0])
        return np.concatenate(out)

    found = optimize.least_squares(left, [0.01, 0.03], bounds=([0.0, 0.0], [0.3, 0.4]), diff_step=0.02)
    count = len(scale)
    jacobian = np.moveaxis(found.jac.reshape(count, -1, 2), 0, 1)
    sampled = _Speeds(flight.t, used)
    covariance, critical = robust_covariance(sampled, jacobian, found.fun.reshape(count, -1).T, np.zeros(2))
    half = critical * np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    delay, lag = (float(v) for v in found.x)
    return {
        "lag": (lag, lag - float(half[1]), lag + float(half[1])),
        "delay": (delay, delay - float(half[0]), delay + float(half[0])),
    }
