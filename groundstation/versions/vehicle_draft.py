"""A vehicle file drafted from the log of a vehicle: what its parameters and its flight tell, and what they do not.

Autopilots need neither mass nor propeller, so they know neither; geometry they need only up to its scale. A draft says
of each value where it is from, and marks what its owner has to weigh, measure or check.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading.ardupilot_log import load_dataflash
from trueflight.groundstation.reading.flight_file import DATAFLASH, TELEMETRY, ULOGS
from trueflight.groundstation.reading.mavlink_log import load_tlog
from trueflight.groundstation.reading.px4_airborne import (
    RATE,
    Airborne,
    airborne,
    battery_in_use,
    check_multirotor,
    ground_level,
    motor_count,
    period_mean,
)
from trueflight.groundstation.reading.px4_flight import ACCELEROMETER, FAST, FILTERED, XYZ
from trueflight.groundstation.reading.px4_log import Log, load_ulog
from trueflight.groundstation.reading.px4_thrust import commanded_thrust
from trueflight.models.errors import InputError
from trueflight.models.outside import toml_table, unreadable
from trueflight.models.vehicle import GRAVITY, Vehicle, vehicle_from_table
from trueflight.models.whole_file import write_whole

STAND_IN_MASS = 1.0  # kg
CELL = 3.7  # V, a lithium cell in the middle of its discharge
SLOW = 1.0  # m/s; below it drag is small beside the thrust
CLEAR = 0.5  # m above the ground
SETTLED = 3.0  # s of slow flight from which a hover thrust is measured
PROPELLER = 0.45
"""Radius of a propeller in distances of neighbouring rotors, usual for a quadrotor whose propellers nearly touch."""
GAINS = ("MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D", "MC_ROLLRATE_K", "MC_ROLLRATE_MAX",
         "MC_YAWRATE_P", "MC_YAWRATE_MAX", "ATC_RAT_RLL_P", "ATC_RAT_RLL_I", "ATC_RAT_RLL_D",
         "ATC_RAT_YAW_P")  # fmt: skip


NAMED = "give it your own name (it is part of Zenoh keys)"
LOADERS: dict[str, Callable[[Path], Log]] = {
    **dict.fromkeys(ULOGS, load_ulog),
    **dict.fromkeys(DATAFLASH, load_dataflash),
    **dict.fromkeys(TELEMETRY, load_tlog),
}
"""What reads the logs that hold parameters, by their ending."""


@dataclass(frozen=True)
class Line:
    """One value of a draft: key and TOML value, unit, where it is from; `complete` is False for what its owner has to
    measure, and `stated` False for a line that is only suggested, in a comment."""

    key: str
    value: str
    unit: str
    source: str
    complete: bool = True
    stated: bool = True


@dataclass(frozen=True)
class Draft:
    """A drafted vehicle file: its lines, its text, and the vehicle it loads as."""

    lines: tuple[Line, ...]
    text: str
    vehicle: Vehicle

    @property
    def to_complete(self) -> tuple[str, ...]:
        """Keys that the log cannot tell."""
        return tuple(line.key for line in self.lines if not line.complete)


def draft_vehicle(log: Log, mass: float | None = None) -> Draft:
    """The vehicle of an autopilot's log, as far as it tells; `mass` in kg as its owner weighed it. Raises `InputError`
    for the log of anything but a multirotor."""
    check_multirotor(log)
    try:
        air, _ = airborne(log)
    except InputError:
        air = None
    simulated = bool(log.parameter("SIH_MASS")) and (
        log.parameter("SYS_HITL") == 2 or "SITL" in log.hardware or not log.hardware
    )
    lines = (
        _name(log),
        _mass(log, mass, simulated),
        *_inertia(log, simulated),
        *_rotors(log, simulated),
        *_thrust(log, air),
        *_dynamics(log, simulated),
    )
    text = _text(log, lines)
    return Draft(
        lines,
        text,
        vehicle_from_table(toml_table(text, "draft"), f"{log.origin}: the vehicle drafted from it"),
    )


def draft_of(file: Path, target: Path, mass: float | None = None) -> Draft:
    """The vehicle drafted from the log `file`, not yet written at `target`. Raises `InputError` for another kind of
    file, and where `target` is there already."""

    load = LOADERS.get(file.suffix.lower())
    if load is None:
        raise InputError(
            f"{file}: only an autopilot's log ({', '.join(LOADERS)}) holds the parameters that a vehicle file is "
            "drafted from"
        )
    if target.exists():
        raise InputError(f"{target}: there is a file already; a draft never replaces one, name another")
    log = load(file)
    with unreadable(file, "the log", "copy it from the vehicle's card again"):
        return draft_vehicle(log, mass)


def write_draft(draft: Draft, path: Path) -> None:
    """Write a draft to a new file, whole or not at all. Raises `InputError` where there is one already."""
    if path.exists():
        raise InputError(f"{path}: there is a vehicle file already; a draft never replaces one, name another")
    write_whole(path, draft.text, "the draft", "choose another place", new=True)


def _name(log: Log) -> Line:
    if log.frame is not None:
        name = log.autopilot.lower()
        return Line("name", f'"{name}"', "", f"{log.frame.source}; {NAMED}")
    airframe = log.parameter("SYS_AUTOSTART")
    name = f"px4-{airframe:.0f}" if airframe else "px4"
    source = f"SYS_AUTOSTART {airframe:.0f}" if airframe else "the log names no airframe"
    return Line("name", f'"{name}"', "", f"{source}; {NAMED}")


def _mass(log: Log, mass: float | None, simulated: bool) -> Line:
    if mass is not None:
        return Line("mass", _number(mass), "kg", "as given with --mass")
    if simulated:
        return Line("mass", _number(log.parameters["SIH_MASS"]), "kg", "SIH_MASS, the simulated vehicle's")
    return Line(
        "mass", _number(STAND_IN_MASS), "kg",
        f"NOT KNOWN TO {log.autopilot.upper()}, a stand-in: WEIGH the vehicle with its battery. Accelerations do "
        "not depend on it, all forces in newtons do", complete=False,
    )  # fmt: skip


def _inertia(log: Log, simulated: bool) -> tuple[Line, ...]:
    names = ("SIH_IXX", "SIH_IYY", "SIH_IZZ")
    if simulated and all(name in log.parameters for name in names):
        moments = ", ".join(_number(log.parameters[name]) for name in names)
        return (Line("inertia", f"[{moments}]", "kg m^2, diagonal", "SIH_IXX, SIH_IYY, SIH_IZZ"),)
    return (
        Line(
            "inertia",
            "[0.0, 0.0, 0.0]",
            "kg m^2",
            f"not known to {log.autopilot}; only effects of torques need it",
            False,
            False,
        ),
    )


def _rotors(log: Log, simulated: bool) -> tuple[Line, ...]:
    count = motor_count(log)
    keys = [f"CA_ROTOR{i}_{axis}" for i in range(count) for axis in ("PX", "PY", "PZ", "KM")]
    found = [log.parameter(key) for key in keys]
    unknown = f"not known to {log.autopilot}"
    radius = Line("rotor_radius", "0.1", "m", f"{unknown}: MEASURE, half a propeller's diameter", False)
    if log.frame is not None and log.frame.places:
        return (
            radius,
            Line("rotor_positions", _rows(np.array(log.frame.places)), "m, FLU",
                 f"{log.frame.source}: their directions, on arms of a metre: MEASURE", False, False),
            Line("rotor_directions", str(list(log.frame.turns)), "1: counter-clockwise from above", log.frame.source,
                 True, False),
        )  # fmt: skip
    if any(value is None for value in found):
        airframe = log.parameter("SYS_AUTOSTART")
        why = (
            f"the log does not tell where its {count} motors are ({log.frame.source if log.frame else 'CA_ROTOR*'}): "
            "MEASURE, one row a motor"
            if count != 4 or log.frame is not None
            else "not in the log: before 1.13 a mixer file stands for it "
            f"(SYS_AUTOSTART {airframe or 0:.0f}, MAV_TYPE {log.parameter('MAV_TYPE') or 0:.0f}): MEASURE. Shown is "
            "the order of PX4's quad-x: front right, rear left, front left, rear right"
        )
        shown = "[[0.1, -0.1, 0.0], [-0.1, 0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, -0.1, 0.0]]"
        return (
            radius,
            Line("rotor_positions", shown, "m, FLU", why, False, False),
            Line("rotor_directions", "[1, 1, -1, -1]", "1: counter-clockwise from above", why, False, False),
        )
    values = np.array(found, dtype=float).reshape(count, 4)
    positions = values[:, :3] * [1.0, -1.0, -1.0] + 0.0
    directions = np.where(values[:, 3] >= 0, 1, -1)
    square = np.allclose(np.abs(positions[:, :2]), np.abs(positions[0, 0]), atol=1e-6)
    unit = np.allclose(np.linalg.norm(positions[:, :2], axis=1), 1.0, atol=0.02)
    relative = bool(unit or (square and abs(positions[0, 0]) >= 0.5))
    gaps = [np.linalg.norm(a - b) for i, a in enumerate(positions) for b in positions[:i]]
    arms = [log.parameter("SIH_L_PITCH"), log.parameter("SIH_L_ROLL")]
    if relative and simulated and count == 4 and None not in arms:
        return (
            radius,
            Line("rotor_positions", _rows(np.sign(positions) * [*arms, 0.0]), "m, FLU",
                 "SIH_L_PITCH, SIH_L_ROLL in the order of CA_ROTOR*"),
            Line("rotor_directions", str(directions.tolist()), "", "the signs of CA_ROTOR*_KM"),
        )  # fmt: skip
    if relative:
        where = Line(
            "rotor_positions", _rows(positions), "m, FLU",
            "CA_ROTOR*_PX, _PY, _PZ hold equal arms of a metre, which PX4 takes for proportions only: MEASURE",
            False, False,
        )  # fmt: skip
        turning = Line(
            "rotor_directions", str(directions.tolist()), "", "the signs of CA_ROTOR*_KM", True, False
        )
        return radius, where, turning
    radius = Line(
        "rotor_radius", _number(float(f"{PROPELLER * min(gaps):.2g}")), "m",
        f"{unknown}: MEASURE, half a propeller's diameter ({min(gaps) / 2:.2g} m would touch the neighbour)",
        False,
    )  # fmt: skip
    return (
        radius,
        Line("rotor_positions", _rows(positions), "m, FLU",
             "CA_ROTOR*_PX, _PY, _PZ (y and z turned from FRD); CHECK, PX4 flies as well with another scale"),
        Line("rotor_directions", str(directions.tolist()), "", "the signs of CA_ROTOR*_KM"),
    )  # fmt: skip


def _thrust(log: Log, air: Airborne | None) -> tuple[Line, ...]:
    hovering, bent = (
        ("MPC_THR_HOVER", "THR_MDL_FAC") if log.frame is None else ("MOT_THST_HOVER", "MOT_THST_EXPO")
    )
    believed = log.parameter(hovering)
    said = f"{hovering} is {believed:g}" if believed is not None else f"the log holds no {hovering}"
    factor = log.parameter(bent)
    cells = next((n for p in ("BAT1_N_CELLS", "BAT_N_CELLS") if (n := log.parameter(p) or 0) > 0), 0)
    hover, how = _hover(log, air)
    estimate = _estimate(log, air)
    if hover is not None:
        also = "" if estimate is None else f"; hover_thrust_estimate {estimate:.3f}"
        source = f"{how}; {said}{also}. A flight cannot show that its own hover thrust is wrong"
    elif estimate is not None:
        hover, source = estimate, f"hover_thrust_estimate, median in the air; {said}"
    elif believed is not None:
        hover, source = believed, f"{hovering}: what {log.autopilot} was told, not what was flown"
    else:
        hover, source = 0.5, f"{said}, nor a flight: a stand-in, FLY A HOVER"
    curve = Line(
        "thrust_model", '"linear"', "",
        f"what {log.autopilot} assumes of this command"
        + (f", with {bent} {factor:g}" if factor else
           f"; {f'the log holds no {bent}' if factor is None else f'{bent} is 0'}, real propellers are nearer "
           'to "quadratic": the effect thrust_curve tells'),
    )  # fmt: skip
    voltage = None
    if air is not None and (battery := battery_in_use(log, air)[0]) is not None:
        flown = (battery.t >= air.span[0]) & (battery.t <= air.span[1])
        voltage = float(np.median(np.asarray(battery.fields["voltage_v"])[flown]))
    capacity = next(
        (c for p in ("BAT1_CAPACITY", "BAT_CAPACITY", "BATT_CAPACITY") if (c := log.parameter(p) or 0) > 0), 0
    )
    pack = ", ".join(
        word
        for word in (f"{cells:.0f} cells" if cells else "", f"{capacity:.0f} mAh" if capacity else "")
        if word
    )
    aside = f" ({pack})" if pack else ""
    if voltage is not None:
        volts = Line(
            "nominal_voltage", f"{voltage:.2f}", "V", f"median in the air, where hover_thrust holds{aside}"
        )
    elif cells:
        volts = Line(
            "nominal_voltage",
            f"{CELL * cells:.1f}",
            "V",
            f"{CELL:g} V a cell, no voltage in the log{aside}",
            False,
        )
    else:
        volts = Line("nominal_voltage", "16.0", "V", "no battery in the log, a stand-in: MEASURE", False)
    known = not source.endswith("FLY A HOVER")
    return Line("hover_thrust", _number(hover), "of full collective", source, known), curve, volts


def _hover(log: Log, air: Airborne | None) -> tuple[float | None, str]:
    """The command that carried the vehicle in slow flight, and how it was measured."""
    if air is None:
        return None, ""
    thrust = commanded_thrust(log, *air.span, motor_count(log))
    if thrust is None or thrust.relative:
        return None, ""
    command = np.interp(air.clock, thrust.t, thrust.values)
    rows = air.in_air & (command > 0.02) & (command < 0.98)
    local = log.topic("vehicle_local_position", "z", "vx", "vy", "vz")
    slow = rows
    if local is not None:
        speed = np.interp(air.clock, local.t, np.linalg.norm(local.stack("vx", "vy", "vz"), axis=1))
        height = -np.interp(air.clock, local.t, local.fields["z"])
        # On the ground the accelerometer feels gravity whatever the rotors do.
        slow = rows & (speed < SLOW) & (height - ground_level(height, air)[0] > CLEAR)
    if slow.sum() < SETTLED * RATE:
        return None, ""
    fields = ACCELEROMETER
    felt = log.topic("sensor_combined", *fields)
    if felt is None and log.filtered:
        felt, fields = log.topic("vehicle_acceleration", *XYZ), XYZ
    if felt is None or felt.rate_within(*air.span) < (FILTERED if log.filtered else FAST):
        return float(np.median(command[slow])), f"median command of {slow.sum() / RATE:.0f} s of slow flight"
    force = -float(np.median(period_mean(felt.t, felt.stack(*fields), air.clock)[slow, 2]))
    if not 0.5 * GRAVITY < force < 2.0 * GRAVITY:
        return None, ""
    hover = float(np.median(command[slow])) * GRAVITY / force
    return hover, f"measured over {slow.sum() / RATE:.0f} s of slow flight, against the accelerometer"


def _estimate(log: Log, air: Airborne | None) -> float | None:
    """PX4's own estimate of the hover thrust, median in the air; None where it has none."""
    topic = log.topic("hover_thrust_estimate", "hover_thrust")
    if topic is None or air is None:
        return None
    flown = (topic.t >= air.span[0]) & (topic.t <= air.span[1]) & np.isfinite(topic.fields["hover_thrust"])
    if topic.has("valid"):
        flown &= topic.fields["valid"] > 0
    return float(np.median(topic.fields["hover_thrust"][flown])) if flown.sum() > 5 else None


def _dynamics(log: Log, simulated: bool) -> tuple[Line, ...]:
    lag = log.parameter("SIH_T_TAU") if simulated else None
    gains = ", ".join(f"{name} {value:g}" for name in GAINS if (value := log.parameter(name)) is not None)
    motor = (
        Line("motor_time_constant", _number(lag), "s", "SIH_T_TAU, the simulated motors'")
        if lag
        else Line(
            "motor_time_constant", "0.0", "s", f"not known to {log.autopilot}; the effect motor_lag tells"
        )
    )
    return (
        Line("command_delay", "0.0", "s", f"not known to {log.autopilot}; the effect transport_delay tells"),
        motor,
        Line(
            "rate_time_constant",
            "0.0",
            "s",
            f"the effect rate_loop_lag tells{f' ({gains})' if gains else ''}",
        ),
    )


def _text(log: Log, lines: tuple[Line, ...]) -> str:
    words = " ".join(
        word for word in (log.autopilot, log.version, log.hardware and f"on {log.hardware}") if word
    )
    missing = [line.key for line in lines if not line.complete]
    head = [
        f"# Drafted from {Path(log.origin).name} ({words}), world ENU, body FLU, SI units.",
        "# It can be used as it is; what follows TO COMPLETE the log cannot tell:",
        *_wrapped("TO COMPLETE: " + ", ".join(missing)),
        "",
    ]
    body: list[str] = []
    for line in lines:
        unit = f"{line.unit}: " if line.unit else ""
        marked = "" if line.complete else "TO COMPLETE. "
        body += _wrapped(f"{marked}{unit}{line.source}")
        body.append(f"{'' if line.stated else '# '}{line.key} = {line.value}")
    return "\n".join([*head, *body]) + "\n"


def _wrapped(text: str, width: int = 108) -> list[str]:
    return [f"# {piece}" for piece in textwrap.wrap(text, width)]


def _number(value: float) -> str:
    """A TOML float of four digits."""
    text = f"{value:.4g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def _rows(positions: np.ndarray) -> str:
    return "[" + ", ".join("[" + ", ".join(_number(x) for x in row) + "]" for row in positions) + "]"
