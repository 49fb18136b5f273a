"""ArduPilot dataflash logs as the vehicle writes them, for tests: by pymavlink's own formats.

`copter` is a simulated flight as ArduCopter 4 logs it, at the rates of fast attitude and fast IMU or slower ones.
"""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from px4_layouts import Flown, frd, motors, ned
from pymavlink.DFReader import FORMAT_TO_STRUCT

from trueflight.models.frames import enu_flu_from_ned_frd, euler_from_quaternion

PARAMETERS = {
    "FRAME_CLASS": 1, "FRAME_TYPE": 1, "MOT_PWM_MIN": 1000, "MOT_PWM_MAX": 2000, "MOT_SPIN_MIN": 0.15,
    "MOT_SPIN_MAX": 0.95, "MOT_THST_EXPO": 0.65, "MOT_THST_HOVER": 0.36, "SERVO1_FUNCTION": 33, "SERVO2_FUNCTION": 34,
    "SERVO3_FUNCTION": 35, "SERVO4_FUNCTION": 36, "AHRS_EKF_TYPE": 3, "BATT_CAPACITY": 3300, "ATC_RAT_RLL_P": 0.135,
}  # fmt: skip
HEALTHY = 0b0011_0111_1111 & ~0b1000_0000
"""`XKF4.SS` of an estimator that has everything."""


@dataclass
class Dataflash:
    """What a log is to hold: `add` messages, then `save`."""

    kinds: dict[str, tuple[int, str, str]] = field(default_factory=dict)
    rows: list[tuple[float, bytes]] = field(default_factory=list)

    def add(self, name: str, code: str, columns: str, t, *values) -> None:
        """Messages of a name at times `t` (M,) in s, their fields (M,) or one value each, in the format's units."""
        number, code, _ = self.kinds.setdefault(name, (10 + len(self.kinds), code, columns))
        layout = "<" + "".join(FORMAT_TO_STRUCT[c][0] for c in code)
        t = np.atleast_1d(t)
        full = [np.round(1e6 * t).astype(np.int64), *(v if np.ndim(v) else [v] * len(t) for v in values)]
        for when, row in zip(t, zip(*full, strict=True), strict=True):
            packed = [_value(c, v) for c, v in zip(code, row, strict=True)]
            self.rows.append((when, b"\xa3\x95" + bytes([number]) + struct.pack(layout, *packed)))

    def bytes(self) -> bytes:
        out = bytearray(_format(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"))
        for name, (number, code, columns) in self.kinds.items():
            out += _format(number, name, code, columns)
        for _, row in sorted(self.rows, key=lambda pair: pair[0]):
            out += row
        return bytes(out)

    def save(self, path: Path) -> Path:
        path.write_bytes(self.bytes())
        return path


def _value(code: str, value):
    factor = FORMAT_TO_STRUCT[code][1]
    if code in "nNZ":
        return str(value).encode()
    if code in "fdge":
        return float(value) if factor is None else round(float(value) / factor)
    return round(float(value) / (factor or 1.0))


def _format(number: int, name: str, code: str, columns: str) -> bytes:
    length = 3 + struct.calcsize("<" + "".join(FORMAT_TO_STRUCT[c][0] for c in code))
    body = struct.pack("<BB4s16s64s", number, length, name.encode(), code.encode(), columns.encode())
    return b"\xa3\x95\x80" + body


def pulses(thrust: np.ndarray, expo: float = 0.65, least: float = 0.15, most: float = 0.95) -> np.ndarray:
    """What an ESC is sent for a thrust of 0 to 1: ArduPilot's curve, written the other way round."""
    share = np.linspace(0.0, 1.0, 2001)
    given = np.interp(thrust, (1 - expo) * share + expo * share**2, share)
    return 1000.0 + 1000.0 * np.where(thrust > 0, least + (most - least) * given, 0.0)


def copter(
    one: Flown, *, imu: float = 100, rate: float = 100, attitude: float = 100, firmware: str = "ArduCopter V4.5.7",
    parameters: dict[str, float] | None = None, leave_out: tuple[str, ...] = (),
) -> Dataflash:  # fmt: skip
    """A flight as ArduCopter logs it, with rates (Hz) of IMU, of RATE, RCOU and ESC, and of attitude and estimate."""
    log = Dataflash()
    every = {**PARAMETERS, **(parameters or {})}

    def add(name, *rest):
        if name not in leave_out:
            log.add(name, *rest)

    add("MSG", "QZ", "TimeUS,Message", one.t[0], f"{firmware} (abcdef01)")
    for name, value in every.items():
        add("PARM", "QNff", "TimeUS,Name,Value,Default", one.t[0], name, value, value)
    for edges, rise, fall in ((one.armed, 10, 11), (~one.landed, 28, 18)):
        ends = np.flatnonzero(np.diff(edges.astype(int)))
        add("EV", "QB", "TimeUS,Id", one.t[ends + 1], np.where(edges[ends + 1], rise, fall))
    add("MODE", "QMBB", "TimeUS,Mode,ModeNum,Rsn", one.t[0], 5, 5, 1)
    rows = one.rows(imu)
    add("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", one.t[rows], 0,
        *frd(one.angular_velocity[rows]).T, *frd(one.specific_force[rows]).T)  # fmt: skip
    rows = one.rows(attitude)
    roll, pitch, yaw = np.degrees(euler_from_quaternion(enu_flu_from_ned_frd(one.quaternion[rows]))).T
    add("ATT", "QccccCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF", one.t[rows], 0, roll, 0, pitch, 0,
        yaw % 360, 3)  # fmt: skip
    for core in (0, 1):  # the second one is elsewhere: it must not be read
        offset = 40.0 * core
        add("XKF1", "QBccCffffffff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX", one.t[rows], core, roll, pitch,
            yaw % 360, *ned(one.velocity[rows]).T, 0, *(ned(one.position[rows]) + offset).T, 0)  # fmt: skip
        add("XKF4", "QBBH", "TimeUS,C,PI,SS", one.t[rows], core, 0, HEALTHY)
    rows = one.rows(rate)
    wanted = np.degrees(frd(one.body_rate_command[rows])).T
    felt = np.degrees(frd(one.angular_velocity[rows])).T
    add("RATE", "Qffffffffffff", "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut", one.t[rows],
        wanted[0], felt[0], 0, wanted[1], felt[1], 0, wanted[2], felt[2], 0, 0, 0, one.thrust[rows])  # fmt: skip
    add("RCOU", "QHHHH", "TimeUS,C1,C2,C3,C4", one.t[rows], *pulses(motors(one, rows)).T)
    for i in range(4):
        add("ESC", "QBfff", "TimeUS,Instance,RPM,Volt,Curr", one.t[rows] + 1e-4 * i, i,
            one.rotor_speed[rows, i] * 30 / np.pi, one.voltage[rows], 5.0)  # fmt: skip
    rows = one.rows(10)
    add(
        "BAT",
        "QBfff",
        "TimeUS,Inst,Volt,VoltR,Curr",
        one.t[rows],
        0,
        one.voltage[rows],
        one.voltage[rows],
        20.0,
    )
    return log
