"""Attitude, position and velocity of a PX4 log, as its estimator told them, in ENU and FLU."""

from __future__ import annotations

import numpy as np

from trueflight.groundstation.reading.px4_airborne import RATE, Airborne, ground_level, held
from trueflight.groundstation.reading.px4_log import Log, Topic
from trueflight.groundstation.reading.uniform import continuous_quaternion
from trueflight.models.errors import InputError
from trueflight.models.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd, rotate

ATTITUDE = tuple(f"q[{i}]" for i in range(4))
BODY_FRAME = 3  # vehicle_odometry.velocity_frame


def attitude_of(log: Log, air: Airborne) -> tuple[np.ndarray, list[str]]:
    """Attitude (N, 4), body FLU to world ENU, on the clock. Raises `InputError` for a log without one."""
    topic = log.topic("vehicle_attitude", *ATTITUDE) or log.topic("vehicle_odometry", *ATTITUDE)
    if topic is None:
        raise InputError(f"{log.origin}: {log.name_of('vehicle_attitude')} is not in the log; {log.advice}")
    q = topic.stack(*ATTITUDE)
    good = np.abs(np.linalg.norm(q, axis=1) - 1.0) < 0.02
    if good.sum() < 2:
        raise InputError(f"{log.origin}: {topic.name} holds no attitude (the estimator did not start)")
    turned = continuous_quaternion(enu_flu_from_ned_frd(q[good]))
    at = np.stack([np.interp(air.clock, topic.t[good], c) for c in turned.T], -1)
    notes = [] if topic.name == "vehicle_attitude" else ["attitude is that of vehicle_odometry"]
    notes += _slow(log, topic, air, "attitude")
    return at / np.linalg.norm(at, axis=1, keepdims=True), notes


def motion_of(
    log: Log, air: Airborne, attitude: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    """Position, velocity and the position that was followed, ENU; heights above the ground at each takeoff. And where
    (N,) the estimate can be used."""
    clock = air.clock
    references, log = _references(log.of("position_reference"), air), log.of("position")
    local = log.topic("vehicle_local_position", "x", "y", "z")
    usable = np.ones(len(clock), dtype=bool)
    notes: list[str] = []
    if local is not None and (notes_of := _invalid(local, air)) is not None:
        notes.append(notes_of)
        local = None
    if local is not None:
        topic, position = local, local.stack("x", "y", "z")
        velocity = local.first_of(("vx", "vy", "vz"))
        usable, notes = _valid(local, air)
    else:
        odometry = _odometry(log, air, attitude)
        if odometry is None:
            return {}, usable, notes or ["the log has no position"]
        topic, position, velocity = odometry
        notes.append("position and velocity are those of vehicle_odometry")
    notes += _slow(log, topic, air, "position")
    at = {
        name: enu_from_ned(np.stack([np.interp(clock, topic.t, c) for c in ned.T], -1))
        for name, ned in (("position", position), ("velocity", velocity))
        if ned is not None
    }
    at |= references
    ground, said = ground_level(at["position"][:, 2], air)
    at["position"][:, 2] -= ground
    if "position_reference" in at:
        at["position_reference"][:, 2] -= ground
    return at, usable, notes + said


def _references(log: Log, air: Airborne) -> dict[str, np.ndarray]:
    """Reference position, where one was followed for most of the flight (offboard by body rates has none)."""
    for name in ("trajectory_setpoint", "vehicle_local_position_setpoint"):
        topic = log.topic(name)
        if topic is None:
            continue
        found = topic.first_of(tuple(f"position[{i}]" for i in range(3)), ("x", "y", "z"))
        if found is None:
            continue
        known = np.all(np.isfinite(found), axis=1)
        if known.sum() > 2 and np.mean(held(topic.t, known, air.clock)[air.in_air]) > 0.5:
            wanted, t = enu_from_ned(found[known]), topic.t[known]
            return {"position_reference": np.stack([np.interp(air.clock, t, c) for c in wanted.T], -1)}
    return {}


def _invalid(local: Topic, air: Airborne) -> str | None:
    """Why the estimate of position and velocity cannot be used at all, if so."""
    flags = [name for name in ("v_xy_valid", "v_z_valid") if local.has(name)]
    if not flags:
        return None
    valid = np.all(local.stack(*flags) > 0, axis=1)
    share = float(np.mean(held(local.t, valid, air.clock)[air.in_air]))
    return (
        None
        if share >= 0.5
        else "the estimator had no horizontal velocity: position and velocity are left out"
    )


def _valid(local: Topic, air: Airborne) -> tuple[np.ndarray, list[str]]:
    """Where (N,) the estimator vouches for its estimate."""
    notes: list[str] = []
    usable = np.ones(len(air.clock), dtype=bool)
    if flags := [name for name in ("v_xy_valid", "v_z_valid", "xy_valid", "z_valid") if local.has(name)]:
        valid = np.all(local.stack(*flags) > 0, axis=1)
        if local.has("xy_valid") and np.mean(local.fields["xy_valid"] > 0) < 0.5:
            # Optical flow: velocity without a position. What has drifted is still a motion.
            valid = np.all(local.stack(*(f for f in flags if f.startswith("v_"))) > 0, axis=1)
        usable = held(local.t, valid, air.clock)
        if (bad := np.sum(air.in_air & ~usable) / RATE) > 0:
            notes.append(
                f"{bad:.1f} s in the air without a valid estimate of position or velocity are left out"
            )
    return usable, notes


def _odometry(log: Log, air: Airborne, attitude: np.ndarray) -> tuple[Topic, np.ndarray, np.ndarray] | None:
    """Position and velocity (M, 3), NED, of `vehicle_odometry`: field names and frames changed with 1.14."""
    topic = log.topic("vehicle_odometry")
    if topic is None:
        return None
    position = topic.first_of(tuple(f"position[{i}]" for i in range(3)), ("x", "y", "z"))
    velocity = topic.first_of(tuple(f"velocity[{i}]" for i in range(3)), ("vx", "vy", "vz"))
    if position is None or velocity is None or not np.any(np.isfinite(position) & np.isfinite(velocity)):
        return None
    frame = topic.fields.get("velocity_frame")
    if frame is not None and np.median(frame) == BODY_FRAME:
        at = np.stack([np.interp(topic.t, air.clock, c) for c in continuous_quaternion(attitude).T], -1)
        at /= np.linalg.norm(at, axis=1, keepdims=True)
        velocity = enu_from_ned(rotate(at, flu_from_frd(velocity)))
    good = np.all(np.isfinite(position) & np.isfinite(velocity), axis=1)
    kept = Topic(topic.name, topic.t[good], {n: v[good] for n, v in topic.fields.items()}, topic.instance)
    return kept, position[good], velocity[good]


def _slow(log: Log, topic: Topic, air: Airborne, what: str) -> list[str]:
    """A note where a topic is logged more slowly than a manoeuvre lasts."""
    rate = topic.rate_within(*air.span)
    if rate >= 0.9 * RATE / 2:
        return []
    return [f"{what} is logged at {rate:.0f} Hz and interpolated; {log.faster}"]
