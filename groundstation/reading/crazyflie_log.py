"""Logs of a Crazyflie's micro-SD deck: a table of the firmware's log variables, and what each of them is.

Format: bitcraze's `cfusdlog` (crazyflie-firmware, `tools/usdlog`), versions 1 and 2. Files have no ending (`log00`).
Units and signs are those of the firmware's `LOG_ADD`s: angles in degrees with pitch inverted ("legacy CF2 body
coordinate system"), accelerometer in g; `stateEstimateZ` and `ctrltargetZ` are whole numbers in mm, mm/s and mrad/s.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading.mapping import Mapping
from trueflight.groundstation.reading.rows import possible
from trueflight.groundstation.reading.table import Table
from trueflight.models.errors import InputError
from trueflight.models.outside import unreadable

MAGIC = 0xBC
VERSIONS = {1: ("<HI", 1e-3), 2: ("<HQ", 1e-6)}
"""How a row begins, by version: number of its event and time, and the unit of that in s."""
TYPES = {
    "B": "u1",
    "b": "i1",
    "H": "<u2",
    "h": "<i2",
    "I": "<u4",
    "i": "<i4",
    "f": "<f4",
    "Q": "<u8",
    "q": "<i8",
    "e": "<f2",
}
"""numpy's types of the variables' (`struct`'s letters)."""
MOST_EVENTS, LONGEST_NAME = 1000, 200
TIME = "time_s"
ADVICE = "log stateEstimate, acc, gyro, controller.cmd_thrust and pm.vbat (config.txt of the card), and copy it whole"


@dataclass(frozen=True)
class Event:
    """What is written at once: names and types of its variables, and where its rows begin."""

    name: str
    variables: tuple[str, ...]
    row: np.dtype[np.void]
    places: list[int]


def is_usd_log(path: Path) -> bool:
    """Whether a file begins as these logs do."""
    try:
        with path.open("rb") as stream:
            start = stream.read(3)
    except OSError:
        return False
    return len(start) == 3 and start[0] == MAGIC and int.from_bytes(start[1:], "little") in VERSIONS


def read_usd_log(path: Path) -> Table:
    """The variables of a log on the clock of the event that was written most often, `time_s` in s; those of others are
    interpolated. Raises `InputError` for a file that is none, or holds no rows."""
    with unreadable(path, "the log", ADVICE, "no whole log of a Crazyflie"):
        data = path.read_bytes()
        version, at, events = _header(path, data)
        whole = len(data) >= at + 4 and zlib.crc32(data[:-4]) == int.from_bytes(data[-4:], "little")
        end = len(data) - 4 if whole else len(data)
        head, unit = VERSIONS[version]
        stopped = _index(data, at, end, struct.Struct(head), events)
        found = [event for event in events.values() if len(event.places) > 1]
        if not found:
            raise InputError(f"{path}: the log of a Crazyflie holds no rows; {ADVICE}")
        notes = (
            ()
            if whole
            else ("the log is cut short or damaged (its checksum is wrong): read as far as it goes",)
        )
        if stopped < end and whole:
            notes = ("the log holds what is no row: read as far as it goes",)
        columns = _joined(np.frombuffer(data, dtype=np.uint8), found, struct.calcsize(head), unit)
        return Table(str(path), columns, notes, first_line=None)


def _header(path: Path, data: bytes) -> tuple[int, int, dict[int, Event]]:
    """Version, where the rows begin, and the events by number. Raises `InputError` for another kind of file."""
    if len(data) < 5 or data[0] != MAGIC:
        raise InputError(f"{path}: no log of a Crazyflie's card; {ADVICE}")
    version, count = struct.unpack_from("<HH", data, 1)
    if version not in VERSIONS or count > MOST_EVENTS:
        raise InputError(
            f"{path}: a Crazyflie's log of version {version}; known are {', '.join(map(str, VERSIONS))}"
        )
    at = 5
    events = {}
    for _ in range(count):
        (number,) = struct.unpack_from("<H", data, at)
        name, at = _text(data, at + 2)
        (variables,) = struct.unpack_from("<H", data, at)
        at += 2
        fields = []
        for _ in range(min(variables, MOST_EVENTS)):
            written, at = _text(data, at)  # as in acc.x(f)
            fields.append((written[:-3] if written[-3:-2] == "(" else written, TYPES[written[-2]]))
        names = tuple(name for name, _ in fields)
        layout = np.dtype([(f"{i}", kind) for i, (_, kind) in enumerate(fields)])
        events[number] = Event(name, names, layout, [])
    return version, at, events


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at, at + LONGEST_NAME)
    return data[at:end].decode("utf-8"), end + 1


def _index(data: bytes, at: int, end: int, head: struct.Struct, events: dict[int, Event]) -> int:
    """Where the rows of each event begin; up to where the file is made of rows."""
    sizes = {number: head.size + event.row.itemsize for number, event in events.items()}
    while at + head.size <= end:
        number = int.from_bytes(data[at : at + 2], "little")
        size = sizes.get(number)
        if size is None or at + size > end:
            break
        events[number].places.append(at)
        at += size
    return at


def _joined(raw: np.ndarray, events: list[Event], head: int, unit: float) -> dict[str, np.ndarray]:
    """Every variable on the clock of the event with most rows."""
    events = sorted(events, key=lambda event: -len(event.places))
    clock = np.zeros(0)
    columns: dict[str, np.ndarray] = {}
    for event in events:
        places = np.array(event.places, dtype=np.int64)
        stamp = raw[places[:, None] + np.arange(2, head)].copy().view(f"<u{head - 2}")[:, 0]
        t = stamp.astype(float) * unit
        if not len(clock):
            clock = t
            columns[TIME] = t - t[0]
        if not event.variables:
            continue
        rows = raw[places[:, None] + head + np.arange(event.row.itemsize)].copy().view(event.row)[:, 0]
        for i, name in enumerate(event.variables):
            with np.errstate(invalid="ignore"):  # a damaged file holds what is no number
                column = possible(rows[str(i)].astype(float))
            if name == "stateEstimateZ.quat":
                for letter, part in zip("xyzw", _unpacked(rows[str(i)].astype(np.uint64)).T, strict=True):
                    columns.setdefault(f"{name}.{letter}", part if t is clock else np.interp(clock, t, part))
            columns.setdefault(name, column if t is clock else np.interp(clock, t, column))
    return columns


def _unpacked(packed: np.ndarray) -> np.ndarray:
    """Quaternions (M, 4) x, y, z, w of a Crazyflie's 32 bits: which is the largest, and nine bits and a sign of each of
    the others (`quatcompress.h`)."""
    out = np.zeros((len(packed), 4))
    largest = (packed >> np.uint64(30)).astype(int)
    rest = packed.astype(np.int64) & ((1 << 30) - 1)
    for i in (3, 2, 1, 0):
        here = largest != i
        size = np.sqrt(0.5) * (rest & 511) / 511.0
        out[here, i] = np.where(rest >> 9 & 1, -size, size)[here]
        rest = np.where(here, rest >> 10, rest)
    rows = np.arange(len(packed))
    out[rows, largest] = np.sqrt(np.maximum(1.0 - np.sum(out**2, axis=1), 0.0))
    return out


def _xyz(group: str, *names: str) -> list[str]:
    return [f"{group}.{name}" for name in names or ("x", "y", "z")]


def _motors(group: str, form: str) -> list[str]:
    return [f"{group}.{form.format(i)}" for i in (1, 2, 3, 4)]


KNOWN: tuple[tuple[str, dict[str, object]], ...] = (
    ("position", {"columns": _xyz("stateEstimate")}),
    ("position", {"columns": _xyz("stateEstimateZ"), "unit": "mm"}),
    ("position", {"columns": _xyz("kalman", "stateX", "stateY", "stateZ")}),
    ("position", {"columns": _xyz("locSrv")}),
    ("velocity", {"columns": _xyz("stateEstimate", "vx", "vy", "vz")}),
    ("velocity", {"columns": _xyz("stateEstimateZ", "vx", "vy", "vz"), "unit": "mm/s"}),
    ("quaternion", {"columns": _xyz("stateEstimate", "qx", "qy", "qz", "qw"), "order": "xyzw"}),
    ("quaternion", {"columns": _xyz("stateEstimateZ.quat", "x", "y", "z", "w"), "order": "xyzw"}),
    ("quaternion", {"columns": _xyz("kalman", "q0", "q1", "q2", "q3")}),
    ("quaternion", {"columns": _xyz("ctrlLee", "rpyx", "rpyy", "rpyz")}),
    ("quaternion", {"columns": _xyz("stateEstimate", "roll", "pitch", "yaw"), "unit": "deg", "sign": [1, -1, 1]}),
    ("quaternion", {"columns": _xyz("stabilizer", "roll", "pitch", "yaw"), "unit": "deg", "sign": [1, -1, 1]}),
    ("quaternion", {"columns": _xyz("locSrv", "qx", "qy", "qz", "qw"), "order": "xyzw"}),
    ("angular_velocity", {"columns": _xyz("gyro"), "unit": "deg/s"}),
    ("angular_velocity", {"columns": _xyz("ctrlLee", "omegax", "omegay", "omegaz")}),
    ("angular_velocity", {"columns": _xyz("stateEstimateZ", "rateRoll", "ratePitch", "rateYaw"), "unit": "mrad/s",
                          "sign": [1, -1, 1]}),
    ("specific_force", {"columns": _xyz("acc"), "unit": "g"}),
    ("thrust_command", {"columns": ["ctrlLee.thrustSI"], "unit": "N"}),
    ("thrust_command", {"columns": ["controller.cmd_thrust"], "unit": "u16"}),
    ("thrust_command", {"columns": ["stabilizer.thrust"], "unit": "u16"}),
    ("motor_command", {"columns": _motors("motor", "m{}"), "unit": "u16"}),
    ("motor_command", {"columns": _motors("pwm", "m{}_pwm"), "unit": "u16"}),
    ("rotor_speed", {"columns": _motors("rpm", "m{}"), "unit": "rpm"}),
    ("rotor_speed", {"columns": _motors("motor", "m{}_rpm"), "unit": "rpm"}),
    ("battery_voltage", {"columns": ["pm.vbat"]}),
    ("battery_voltage", {"columns": ["pm.vbatMV"], "unit": "mV"}),
    ("body_rate_command", {"columns": _xyz("ctrlLee", "omegarx", "omegary", "omegarz")}),
    ("body_rate_command", {"columns": _xyz("controller", "rollRate", "pitchRate", "yawRate"), "unit": "deg/s",
                           "sign": [1, -1, 1]}),
    ("position_reference", {"columns": _xyz("ctrltarget")}),
    ("position_reference", {"columns": _xyz("ctrltargetZ"), "unit": "mm"}),
)  # fmt: skip
"""The firmware's variables that tell a quantity, best first."""


def usd_mapping(table: Table) -> Mapping:
    """What the variables of a log are. One that never changes was logged and not filled in: another is taken."""
    quantities: dict[str, dict[str, object]] = {"time": {"column": TIME}}
    spelt = {name.lower(): name for name in table.columns}  # thrustSI, thrustSi
    for quantity, known in KNOWN:
        names = known["columns"]
        names = [spelt.get(name.lower(), "") for name in names] if isinstance(names, list) else []
        entry = {**known, "columns": names}
        if quantity in quantities or not all(names):
            continue
        if not any(np.ptp(table.columns[n]) > 0 for n in names):
            continue
        if quantity == "quaternion" and len(names) == 3:
            if "attitude" not in quantities:
                axes = dict(zip(("roll", "pitch", "yaw"), names, strict=True))
                quantities["attitude"] = {**axes, **{k: v for k, v in entry.items() if k != "columns"}}
            continue
        if not (quantity == "quaternion" and "attitude" in quantities):
            quantities[quantity] = dict(entry)
    return Mapping("the Crazyflie's variables", "", quantities)
