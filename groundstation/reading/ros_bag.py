"""Recordings of ROS 2, in MCAP or SQLite: PX4's messages, and the usual ones of ROS brought to PX4's.

Of `px4_msgs` every topic that a ULog has is read, whatever its namespace (`/fmu/out/vehicle_attitude`,
`/px4_1/fmu/out/vehicle_status_v1`). `nav_msgs/Odometry`, `geometry_msgs/PoseStamped`, `sensor_msgs/Imu`,
`sensor_msgs/BatteryState` and MAVROS' `AttitudeTarget`, `State` and `ExtendedState` stand in where PX4's own are
missing: ENU and FLU (REP 103), unless their frame is named NED.
"""

from __future__ import annotations

import io
import re
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Header, Message, Schema

from trueflight.groundstation.reading import ros_db3
from trueflight.groundstation.reading.clocks import drift_of, of_one_clock
from trueflight.groundstation.reading.px4_log import TOPICS, Log, collect
from trueflight.groundstation.reading.ros_choice import choose
from trueflight.groundstation.reading.ros_vehicles import Fields, Source
from trueflight.groundstation.reading.rows import possible
from trueflight.groundstation.reading.sources import Sources
from trueflight.groundstation.reading.uniform import continuous_quaternion
from trueflight.models.errors import InputError
from trueflight.models.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd, rotate
from trueflight.models.mcap_records import mcap_records

ADVICE = "record it with `ros2 bag record --storage mcap`, with the px4_msgs workspace sourced"
DB3 = ".db3"
"""How a bag in SQLite ends."""
ADVICE_DB3 = "bags from before Iron hold none: `ros2 bag convert` to MCAP, with the workspace of these messages sourced"
OTHER_CLOCK = 0.5
"""s; stamps further apart from the times of receipt than others count another clock: since boot, not since 1970, or
that of a computer that was not synchronised."""
_ONE_AT_A_TIME = threading.Lock()
VELOCITY = ("twist.twist.linear.x", "twist.twist.linear.y", "twist.twist.linear.z")


@dataclass
class _Recorded:
    """One topic as recorded: its type, times of receipt (us), and the numbers of its messages."""

    topic: str
    kind: str
    frame: str = ""
    received: list[int] = field(default_factory=list)
    names: tuple[str, ...] = ()
    rows: list[tuple[float, ...]] = field(default_factory=list)
    shift: float | np.ndarray = 0.0

    def columns(self) -> dict[str, np.ndarray]:
        """Fields (M,) by name."""
        return (
            dict(zip(self.names, possible(np.array(self.rows, dtype=float)).T, strict=True))
            if self.rows
            else {}
        )


def is_ros_bag(path: Path) -> bool:
    """Whether a file holds ROS 2 messages: MCAP by what is in it, SQLite by its ending."""
    if path.suffix.lower() == DB3:
        return True
    try:
        with path.open("rb") as stream:
            for record in mcap_records(stream, []):
                if isinstance(record, Header) and record.profile == "ros2":
                    return True
                if isinstance(record, Channel):
                    return record.message_encoding == "cdr"
    except Exception:  # noqa: BLE001 - whatever it is, it is no such recording; reading it will tell why
        return False
    return False


def load_ros_bag(path: Path, wanted: Sources | None = None) -> Log:
    """Read a recording, also one that was cut off, into the topics of a PX4 log: those of one vehicle, as `wanted`.

    Raises `InputError` for one that holds none of them, and where nothing tells which of several to take.
    """
    recorded, seen, notes = _read_db3(path) if path.suffix.lower() == DB3 else _read(path)
    notes += _one_clock(recorded)
    chosen = choose(str(path), [_source(one) for one in recorded], wanted or Sources())
    notes += chosen.notes
    topics = collect((name, 0, fields) for name, fields in chosen.parts)
    if not topics:
        has = "; ".join([seen or "no messages", *notes[:1]])
        raise InputError(
            f"{path}: none of the topics of a PX4 flight is in the recording (it has {has}); {ADVICE}"
        )
    asked = {
        quantity: topic
        for quantity, (name, fields) in chosen.asked.items()
        for topic in collect([(name, 0, fields)]).get(name, ())
    }
    advice = ADVICE
    if len(chosen.vehicles) > 1:
        listed = ", ".join(vehicle or "/" for vehicle in chosen.vehicles)
        advice = (
            f"of {len(chosen.vehicles)} vehicles ({listed}) the first is read: choose another with "
            f"--vehicle-namespace, or {ADVICE}"
        )
    return Log(
        str(path),
        topics,
        hardware="",
        notes=tuple(notes),
        faster="record the topic faster",
        advice=advice,
        chosen=asked,
    )


def _read(path: Path) -> tuple[list[_Recorded], str, list[str]]:
    """Every topic that can be used, a list of what is there, and what there is to say."""
    from mcap_ros2.decoder import DecoderFactory

    factory = DecoderFactory()
    schemas: dict[int, Schema] = {}
    channels: dict[int, tuple[_Recorded, Callable[[bytes], Any]]] = {}
    seen: dict[str, str] = {}
    unreadable: list[str] = []
    damaged: list[str] = []
    cut = ""
    try:
        with path.open("rb") as stream:
            for record in mcap_records(stream, damaged):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    schema = schemas.get(record.schema_id)
                    kind = schema.name if schema is not None else ""
                    seen[record.topic] = kind
                    if record.id in channels or not _usable(record.topic, kind):
                        continue
                    decode = _decoder(factory, record.message_encoding, schema)
                    if decode is None:
                        unreadable.append(record.topic)
                        continue
                    channels[record.id] = _Recorded(record.topic, kind), decode
                elif isinstance(record, Message) and record.channel_id in channels:
                    one, decode = channels[record.channel_id]
                    _append(one, record.log_time // 1000, decode(record.data))
    except OSError as error:
        raise InputError(f"{path}: cannot read the recording ({error.strerror}); check the path") from None
    except EndOfFile:
        cut = "it is cut off"
    except Exception as error:  # noqa: BLE001 - each decoder raises its own kind
        cut = f"it is damaged ({str(error) or type(error).__name__})"
    notes = [f"the recording is not whole: {cut}; what came before was read"] if cut else []
    if damaged:
        notes.append(f"{len(damaged)} damaged parts of the recording were skipped")
    if unreadable:
        notes.append(f"no readable definition of {', '.join(unreadable[:4])} in the recording; {ADVICE}")
    kept = [one for one, _ in channels.values() if len(one.rows) > 1]
    shown = ", ".join(sorted(seen)[:8]) + (" ..." if len(seen) > 8 else "")
    return kept, shown, notes


def _read_db3(path: Path) -> tuple[list[_Recorded], str, list[str]]:
    """As `_read`, of a bag in SQLite."""
    from mcap_ros2.decoder import DecoderFactory

    factory = DecoderFactory()
    found: dict[int, tuple[_Recorded, Callable[[bytes], Any]]] = {}
    unreadable: list[str] = []
    seen: list[str] = []
    garbled: dict[str, int] = {}
    cut = ""
    try:
        with ros_db3.opened(path) as bag:
            for topic in ros_db3.topics(bag):
                seen.append(topic.name)
                if not _usable(topic.name, topic.kind):
                    continue
                schema = Schema(topic.number, topic.definition.encode(), "ros2msg", topic.kind)
                decode = _decoder(factory, "cdr", schema) if topic.definition else None
                if decode is None:
                    unreadable.append(topic.name)
                    continue
                found[topic.number] = _Recorded(topic.name, topic.kind), decode
            for number, received, data in ros_db3.messages(bag, list(found)):
                one, decode = found[number]
                try:
                    _append(one, received, decode(data))
                except Exception:  # noqa: BLE001 - a message of another definition, or damaged: the others are whole
                    garbled[one.topic] = garbled.get(one.topic, 0) + 1
    except sqlite3.Error as error:
        if not found:
            raise InputError(
                f"{path}: no ROS 2 bag ({str(error) or type(error).__name__}); {ADVICE}"
            ) from None
        cut = f"it is damaged ({str(error) or type(error).__name__})"
    notes = [f"the recording is not whole: {cut}; what came before was read"] if cut else []
    if unreadable:
        notes.append(f"no readable definition of {', '.join(unreadable[:4])} in the recording; {ADVICE_DB3}")
    notes += [
        f"{count} messages of {topic} do not fit their definition: left out"
        for topic, count in garbled.items()
    ]
    shown = ", ".join(sorted(seen)[:8]) + (" ..." if len(seen) > 8 else "")
    return [one for one, _ in found.values() if len(one.rows) > 1], shown, notes


def _usable(topic: str, kind: str) -> bool:
    if kind.startswith("px4_msgs/"):
        return _px4_name(topic) in TOPICS
    return kind in _TRANSLATED


def _px4_name(topic: str) -> str:
    """PX4's name of a topic; from 1.16 on the ROS one ends with the version of its message."""
    return re.sub(r"_v\d+$", "", topic.rsplit("/", 1)[-1])


def _decoder(factory: Any, encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
    try:
        # the parser of definitions prints a line of its own before it raises; stderr is the process's: one at a time
        with _ONE_AT_A_TIME, redirect_stderr(io.StringIO()):
            decode: Callable[[bytes], Any] | None = factory.decoder_for(encoding, schema)
    except Exception:  # noqa: BLE001 - a definition that does not parse raises whatever its parser meets
        return None
    return decode


def _append(one: _Recorded, received: int, message: Any) -> None:
    numbers = list(_numbers("", message))
    if not one.names:
        one.names = tuple(name for name, _ in numbers)
        header = getattr(message, "header", None)
        one.frame = str(getattr(header, "frame_id", ""))
    if len(numbers) == len(one.names):
        one.received.append(received)
        one.rows.append(tuple(value for _, value in numbers))


def _numbers(prefix: str, value: Any) -> Iterator[tuple[str, float]]:
    """Every number of a message, named as in `pose.pose.position.x` and `control[3]`; covariances are left out."""
    if isinstance(value, bool | int | float):
        yield prefix, float(value)
    elif isinstance(value, str | bytes):
        return
    elif hasattr(value, "__slots__") or hasattr(value, "__dict__"):
        names = getattr(value, "__dict__", None) or value.__slots__
        for name in names:
            if not name.startswith("_") and "covariance" not in name:
                yield from _numbers(f"{prefix}.{name}" if prefix else name, getattr(value, name))
    elif len(value) <= 16:
        for index, element in enumerate(value):
            yield from _numbers(f"{prefix}[{index}]", element)


def _one_clock(recorded: list[_Recorded]) -> list[str]:
    """Bring the stamps of all topics onto one clock by their times of receipt; messages of a second clock in one topic
    are left out. What was done."""
    notes = []
    for one in recorded:
        own = of_one_clock(1e-6 * _stamp(one), 1e-6 * np.array(one.received))
        if not np.all(own):
            notes.append(
                f"{np.sum(~own)} of {len(own)} messages of {one.topic} count another clock than the others: left out"
            )
            one.rows = [row for row, kept in zip(one.rows, own, strict=True) if kept]
            one.received = [when for when, kept in zip(one.received, own, strict=True) if kept]
    drifts = [drift_of(1e-6 * _stamp(one), 1e-6 * np.array(one.received)) for one in recorded]
    offsets = [float(np.median(np.array(one.received) - _stamp(one))) for one in recorded]
    common = min(offsets, key=abs, default=0.0)
    moved, ran = [], []
    for one, drift, offset in zip(recorded, drifts, offsets, strict=True):
        one.shift = 1e6 * drift
        if np.any(drift):
            ran.append(one.topic)
        if abs(offset - common) > OTHER_CLOCK * 1e6:
            one.shift = one.shift + (offset - common)
            moved.append((one.topic, 1e-6 * (offset - common)))
    if moved:
        topic, most = max(moved, key=lambda pair: abs(pair[1]))
        notes.append(
            f"{len(moved)} topics count another clock and were shifted by their times of receipt ({topic} "
            f"by {most:.4g} s)"
        )
    if ran:
        notes.append(f"the clock of {', '.join(ran[:3])} drifts and was brought to the times of receipt")
    return notes


def _stamp(one: _Recorded) -> np.ndarray:
    """Times (M,) in us: PX4's own, the header's, or where neither is set that of receipt."""
    columns = one.columns()
    if "timestamp" in columns:
        stamp = columns["timestamp"]
    elif "header.stamp.sec" in columns:
        stamp = 1e6 * columns["header.stamp.sec"] + 1e-3 * columns["header.stamp.nanosec"]
    else:
        stamp = np.zeros(len(one.rows))
    return np.asarray(stamp if np.all(stamp > 0) else np.array(one.received, dtype=float))


def _source(one: _Recorded) -> Source:
    """A topic as PX4's own would be: times of one clock, NED and FRD."""
    fields, stamp = one.columns(), _stamp(one) + one.shift
    if not one.kind.startswith("px4_msgs/"):
        made = _TRANSLATED[one.kind](one, fields)
        return Source(one.topic, one.kind, 1e-6 * stamp, {n: {"timestamp": stamp, **f} for n, f in made})
    if "timestamp_sample" in fields:
        sample = fields["timestamp_sample"]
        fields["timestamp_sample"] = np.where(sample > 0, sample + one.shift, 0)
    return Source(one.topic, one.kind, 1e-6 * stamp, {_px4_name(one.topic): {**fields, "timestamp": stamp}})


def _odometry(one: _Recorded, columns: Fields) -> list[tuple[str, Fields]]:
    made = _pose(one, columns, "pose.pose")
    if not all(name in columns for name in VELOCITY):
        return made
    position, velocity = _vectors(columns, "pose.pose.position"), _vectors(columns, "twist.twist.linear")
    attitude = _attitude(columns, "pose.pose.orientation")
    turned = rotate(attitude, velocity) if attitude is not None else velocity
    # The twist is the child's frame by its definition; many senders fill in the world's.
    stamp = 1e-6 * _stamp(one)
    if _off(stamp, position, velocity) > 0.8 * _off(stamp, position, turned):
        velocity = turned
    world = velocity if _is_ned(one) else enu_from_ned(velocity)
    made[0][1].update(dict(zip(("vx", "vy", "vz"), world.T, strict=True)))
    return made


def _off(t: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> float:
    """How far (m, median) half a second of velocities (M, 3) leads away from the positions (M, 3) there."""
    way = np.zeros_like(position)
    way[1:] = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t)[:, None], axis=0)
    later = np.searchsorted(t, t + 0.5)
    rows = np.flatnonzero(later < len(t))
    moved, led = position[later[rows]] - position[rows], way[later[rows]] - way[rows]
    return float(np.median(np.linalg.norm(moved - led, axis=1))) if len(rows) else 0.0


def _stamped_pose(one: _Recorded, columns: Fields) -> list[tuple[str, Fields]]:
    return _pose(one, columns, "pose")


def _pose(one: _Recorded, columns: Fields, where: str) -> list[tuple[str, Fields]]:
    position = _vectors(columns, f"{where}.position")
    ned = position if _is_ned(one) else enu_from_ned(position)
    made = [("vehicle_local_position", dict(zip("xyz", ned.T, strict=True)))]
    attitude = _attitude(columns, f"{where}.orientation")
    if attitude is not None:
        q = attitude if _is_ned(one) else enu_flu_from_ned_frd(attitude)
        made.append(("vehicle_attitude", {f"q[{i}]": q[:, i] for i in range(4)}))
    return made


def _imu(one: _Recorded, columns: Fields) -> list[tuple[str, Fields]]:
    turn = (lambda v: v) if _is_ned(one) else flu_from_frd
    force, rates = turn(_vectors(columns, "linear_acceleration")), turn(_vectors(columns, "angular_velocity"))
    made: list[tuple[str, Fields]] = []
    sensor = {f"gyro_rad[{i}]": rates[:, i] for i in range(3)}
    if np.median(np.linalg.norm(force, axis=1)) > 1.0:  # some drivers leave it empty
        sensor |= {f"accelerometer_m_s2[{i}]": force[:, i] for i in range(3)}
    made.append(("sensor_combined", sensor))
    attitude = _attitude(columns, "orientation")
    if attitude is not None:
        q = attitude if _is_ned(one) else enu_flu_from_ned_frd(attitude)
        made.append(("vehicle_attitude", {f"q[{i}]": q[:, i] for i in range(4)}))
    return made


def _battery(one: _Recorded, columns: Fields) -> list[tuple[str, Fields]]:
    made = {"voltage_v": columns["voltage"]}
    if "current" in columns:  # negative while it gives, by the message's definition
        made["current_a"] = np.abs(columns["current"])
    return [("battery_status", made)]


def _target(one: _Recorded, columns: Fields) -> list[tuple[str, Fields]]:
    rates = flu_from_frd(_vectors(columns, "body_rate"))
    named = dict(zip(("roll", "pitch", "yaw"), rates.T, strict=True))
    return [("vehicle_rates_setpoint", {**named, "thrust_body[2]": -columns["thrust"]})]


def _state(one: _Recorded, columns: Fields) -> list[tuple[str, Fields]]:
    return [("actuator_armed", {"armed": columns["armed"]})]


def _landed(one: _Recorded, columns: Fields) -> list[tuple[str, Fields]]:
    return [("vehicle_land_detected", {"landed": (columns["landed_state"] == 1).astype(float)})]


_TRANSLATED: dict[str, Callable[[_Recorded, Fields], list[tuple[str, Fields]]]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/PoseStamped": _stamped_pose,
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/BatteryState": _battery,
    "mavros_msgs/msg/AttitudeTarget": _target,
    "mavros_msgs/msg/State": _state,
    "mavros_msgs/msg/ExtendedState": _landed,
}
"""What ROS' own messages become, best source of motion first."""


def _is_ned(one: _Recorded) -> bool:
    return "ned" in re.split(r"[^a-z]+", one.frame.lower())


def _vectors(columns: Fields, name: str) -> np.ndarray:
    return np.stack([columns[f"{name}.{axis}"] for axis in "xyz"], -1)


def _attitude(columns: Fields, name: str) -> np.ndarray | None:
    """Quaternions (M, 4) w, x, y, z; None where the message has none (all zero, or never turned)."""
    q = np.stack([columns[f"{name}.{axis}"] for axis in "wxyz"], -1)
    if np.mean(np.abs(np.linalg.norm(q, axis=1) - 1.0) < 0.02) < 0.9 or np.ptp(q, axis=0).max() < 1e-6:
        return None
    return continuous_quaternion(q)
