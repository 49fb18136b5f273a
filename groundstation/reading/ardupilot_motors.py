"""What ArduCopter's motors were told: collective, each motor's command, rotor speeds, and where the motors are.

ArduCopter hands its motors one throttle of 0 to 1 that is linear in thrust as it believes it (`AP_MotorsMulticopter`):

* with `MOT_BAT_VOLT_MAX` the throttle is raised as the voltage falls: divided by `MOTB.BatVolt`, on the motor's side of
  the curve, as `apply_thrust_curve_and_volt_scaling` does;
* thrust = (1 - e) r + e r² for the share r of the way from `MOT_SPIN_MIN` to `MOT_SPIN_MAX`, e = `MOT_THST_EXPO`;
* pulses from `MOT_PWM_MIN` to `MOT_PWM_MAX`, or `RC3_MIN` to `RC3_MAX` where these are 0; DShot's are 1000 to 2000.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.reading.dataflash import Dataflash
from trueflight.groundstation.reading.px4_log import Fields, Frame

MOTOR_1, MOTOR_9 = 33, 82
"""`SERVOn_FUNCTION` of the first and the ninth motor."""
DSHOT = (4, 5, 6, 7)
"""Values of `MOT_PWM_TYPE` that are DShot."""
DEFAULT_EXPO, DEFAULT_SPIN_MIN, DEFAULT_SPIN_MAX = 0.65, 0.15, 0.95
"""`MOT_THST_EXPO`, `MOT_SPIN_MIN` and `MOT_SPIN_MAX` of a log that does not hold them (Copter 4)."""
CCW, CW = 1, -1
Scaling = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""What the motors got, of times (us) and throttle."""


@dataclass(frozen=True)
class Layout:
    """Motors of a frame in ArduPilot's order: degrees from ahead, clockwise, and which way each turns from above."""

    degrees: tuple[float, ...]
    turns: tuple[int, ...]


QUAD_X = Layout((45, -135, -45, 135), (CCW, CCW, CW, CW))
LAYOUTS = {
    (1, 0): Layout((90, -90, 0, 180), (CCW, CCW, CW, CW)),
    (1, 1): QUAD_X,
    (1, 3): Layout(QUAD_X.degrees, (CW, CW, CCW, CCW)),
    (1, 12): Layout((135, 45, -135, -45), (CW, CCW, CCW, CW)),
    (1, 13): Layout((45, -45, -135, 135), (CCW, CW, CCW, CW)),
    (1, 14): Layout((45, 135, -135, -45), (CCW, CW, CCW, CW)),
    (1, 18): Layout((135, 45, -135, -45), (CCW, CW, CW, CCW)),
    (2, 0): Layout((0, 180, -120, 60, -60, 120), (CW, CCW, CW, CCW, CCW, CW)),
    (2, 1): Layout((90, -90, -30, 150, 30, -150), (CW, CCW, CW, CCW, CCW, CW)),
    (3, 0): Layout((0, 180, 45, 135, -45, -135, -90, 90), (CW, CW, CCW, CCW, CCW, CCW, CW, CW)),
    (3, 1): Layout((22.5, -157.5, 67.5, 157.5, -22.5, -112.5, -67.5, 112.5), (CW, CW, CCW, CCW, CCW, CCW, CW, CW)),
    (4, 0): Layout((0, -90, 180, 90, -90, 0, 90, 180), (CCW, CW, CCW, CW, CCW, CW, CCW, CW)),
    (4, 1): Layout((45, -45, -135, 135, -45, 45, 135, -135), (CCW, CW, CCW, CW, CCW, CW, CCW, CW)),
}  # fmt: skip
"""Layouts by `FRAME_CLASS` and `FRAME_TYPE` (`AP_MotorsMatrix::setup_motors`)."""
COUNTS = {1: 4, 2: 6, 3: 8, 4: 8, 5: 6, 7: 3, 12: 12, 14: 10}
"""Motors by `FRAME_CLASS`."""
OTHER_FRAMES = {6: "helicopter", 8: "single-rotor copter", 9: "coaxial copter", 10: "tailsitter", 11: "helicopter",
                13: "helicopter"}  # fmt: skip
SAID = {"QUAD": 1, "HEXA": 2, "OCTA": 3, "OCTA_QUAD": 4, "Y6": 5, "TRI": 7, "HELI": 6, "SINGLE": 8, "COAX": 9,
        "DODECA_HEXA": 12, "DECA": 14}  # fmt: skip
"""`FRAME_CLASS` by the text "Frame: QUAD/X"."""


def frame_of(parameters: dict[str, float], said: list[str]) -> Frame | str:
    """How many motors there are and where; what flies instead, where that is no multirotor.

    `FRAME_CLASS` is from 3.5 on; before, the firmware itself was of one class and `FRAME` its type.
    """
    kind = int(parameters.get("FRAME_CLASS", 0))
    for text in said:
        if not kind and (found := re.match(r"Frame: ([A-Z0-9_]+)", text)):
            kind = SAID.get(found[1], 0)
    if kind in OTHER_FRAMES:
        return OTHER_FRAMES[kind]
    kind = kind or 1
    shape = int(parameters.get("FRAME_TYPE", parameters.get("FRAME", 1)))
    count = COUNTS.get(kind, 4)
    name = f"FRAME_CLASS {kind}, FRAME_TYPE {shape}"
    layout = LAYOUTS.get((kind, shape))
    if layout is None:
        return Frame(count, name)
    ahead = np.radians(layout.degrees)
    places = np.stack([np.cos(ahead), -np.sin(ahead), np.zeros(count)], -1)
    return Frame(count, name, tuple(tuple(row) for row in places.round(6).tolist()), layout.turns)


def thrust_topics(
    log: Dataflash, parameters: dict[str, float]
) -> tuple[list[tuple[str, int, Fields]], list[str]]:
    """The collective that the motors were handed: RATE.AOut, and CTUN.ThO for where that is missing or slower."""
    parts: list[tuple[str, int, Fields]] = []
    notes: list[str] = []
    rate, control = log.messages("RATE"), log.messages("CTUN")
    scale, said = _scaling(log, parameters)
    if rate is not None and (out := rate.field("AOut")) is not None and np.any(out > 0):
        parts.append(
            ("vehicle_thrust_setpoint", 0, {"timestamp": rate.t, "xyz[2]": -scale(rate.t, _unit(out))})
        )
    if control is not None and (out := control.field("ThO", "ThrOut")) is not None and np.any(out > 0):
        thrust = -scale(control.t, _unit(out))
        parts.append(("vehicle_attitude_setpoint", 0, {"timestamp": control.t, "thrust_body[2]": thrust}))
    if parts:
        notes += said
    return parts, notes


def _unit(out: np.ndarray) -> np.ndarray:
    """Throttle of 0 to 1; to 3.3 it was told in thousandths."""
    return out / 1000.0 if np.nanmax(out) > 2.0 else out


def _scaling(log: Dataflash, parameters: dict[str, float]) -> tuple[Scaling, list[str]]:
    """How throttle becomes what the motors got where the voltage is made up for, and what to say of it."""
    supply = log.messages("MOTB")
    ratio = supply.field("BatVolt") if supply is not None else None
    if not parameters.get("MOT_BAT_VOLT_MAX", 0) > 0 or supply is None or ratio is None:
        return (lambda t, out: out), []
    good = np.isfinite(ratio) & (ratio > 0.1)
    if good.sum() < 2 or np.all(ratio[good] == 1.0):
        return (lambda t, out: out), []
    expo = parameters.get("MOT_THST_EXPO", DEFAULT_EXPO)

    def applied(t: np.ndarray, out: np.ndarray) -> np.ndarray:
        share = _share(out, expo) / np.interp(t, supply.t[good], ratio[good])
        return _thrust(np.minimum(share, 1.0), expo)

    return applied, [
        "it is what the motors got after the voltage was made up for (MOT_BAT_VOLT_MAX, MOTB.BatVolt)"
    ]


def _thrust(share: np.ndarray, expo: float) -> np.ndarray:
    """Thrust, of 1, of a motor that is given a share of its range."""
    return (1.0 - expo) * share + expo * share**2


def _share(thrust: np.ndarray, expo: float) -> np.ndarray:
    """The share of its range that a motor is given for a thrust."""
    if abs(expo) < 1e-6:
        return thrust
    return ((expo - 1.0) + np.sqrt((1.0 - expo) ** 2 + 4.0 * expo * np.maximum(thrust, 0.0))) / (2.0 * expo)


def _channels(parameters: dict[str, float], count: int) -> list[int]:
    """Output (from 0) of each motor: by `SERVOn_FUNCTION`, otherwise the first ones."""
    by_function = {
        int(value): channel
        for channel in range(32)
        if (
            value := parameters.get(
                f"SERVO{channel + 1}_FUNCTION", parameters.get(f"RC{channel + 1}_FUNCTION")
            )
        )
    }
    wanted = [MOTOR_1 + m if m < 8 else MOTOR_9 + m - 8 for m in range(count)]
    return [by_function.get(function, motor) for motor, function in enumerate(wanted)]


def motor_commands(log: Dataflash, parameters: dict[str, float], count: int) -> list[tuple[str, int, Fields]]:
    """What each motor was told, linear in thrust, 0 to 1, in ArduPilot's order; none where outputs were not logged."""
    outputs = log.messages("RCOU")
    if outputs is None:
        return []
    columns = {c: outputs.field(f"C{c + 1}", f"Ch{c + 1}", f"Chan{c + 1}") for c in range(32)}
    return of_pulses(outputs.t, {c: v for c, v in columns.items() if v is not None}, parameters, count)


def of_pulses(
    t: np.ndarray, outputs: dict[int, np.ndarray], parameters: dict[str, float], count: int
) -> list[tuple[str, int, Fields]]:
    """Motor commands at times `t` (M,) in us of the pulses (M,) of each output, from 0 on."""
    channels = _channels(parameters, count)
    if not all(channel in outputs for channel in channels):
        return []
    low, high = parameters.get("MOT_PWM_MIN", 0.0), parameters.get("MOT_PWM_MAX", 0.0)
    if int(parameters.get("MOT_PWM_TYPE", 0)) in DSHOT:
        low, high = 1000.0, 2000.0
    elif not (low > 0 and high > low):
        low, high = parameters.get("RC3_MIN", 1000.0), parameters.get("RC3_MAX", 2000.0)
    if not high > low:
        return []
    pulse = np.stack([outputs[channel] for channel in channels], -1)
    signal = (pulse - low) / (high - low)
    if "MOT_SPIN_MIN" in parameters or "MOT_SPIN_MAX" in parameters:  # from 3.5 on
        least = parameters.get("MOT_SPIN_MIN", DEFAULT_SPIN_MIN)
        signal = (signal - least) / max(parameters.get("MOT_SPIN_MAX", DEFAULT_SPIN_MAX) - least, 0.1)
    thrust = _thrust(np.clip(signal, 0.0, 1.0), parameters.get("MOT_THST_EXPO", 0.0))
    fields: Fields = {"timestamp": t, **{f"control[{i}]": thrust[:, i] for i in range(count)}}
    return [("actuator_motors", 0, fields)]


def rotor_speeds(log: Dataflash, parameters: dict[str, float], count: int) -> list[tuple[str, int, Fields]]:
    """Rotor speeds, rpm, of each motor's ESC on the clock of the first; none where one is missing."""
    every = log.messages("ESC")
    escs = every.by_instance("Instance", "Inst", "I") if every is not None else {}
    if len(escs) < 2:  # before 4.1 each had a message of its own
        escs = {i: one for i in range(12) if (one := log.messages(f"ESC{i + 1}")) is not None}
    wanted = _channels(parameters, count)
    chosen = wanted if all(channel in escs for channel in wanted) else list(range(count))
    if not all(one in escs and len(escs[one]) > 2 and escs[one].has("RPM") for one in chosen):
        return []
    clock = escs[chosen[0]].t
    fields: Fields = {"timestamp": clock}
    for motor, number in enumerate(chosen):
        speed = escs[number].field("RPM")
        if speed is not None:
            fields[f"esc[{motor}].esc_rpm"] = np.interp(clock, escs[number].t, speed)
    return [("esc_status", 0, fields)]
