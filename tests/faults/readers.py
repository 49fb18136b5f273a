"""Every reader of files from outside, with small whole files of its kind to damage."""

# ruff: noqa: E402, E501 - the path to other tests' files comes first; tables of values are kept in few lines

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as Ros2Writer
from pyarrow import csv as arrow_csv
from pyarrow import parquet as arrow_parquet

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "groundstation"))

from dataflash_writer import copter
from px4_layouts import flown
from ros_bag_writer import Bag, as_db3, ros_messages
from test_mavlink_logs import save as save_tlog
from test_mavlink_logs import telemetry
from ulog_writer import TYPES, Written

from trueflight.companion.settings import load_settings as companion_settings
from trueflight.companion.store import live_file
from trueflight.groundstation.operate.settings import load_settings as ground_settings
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.mapping import load_mapping
from trueflight.groundstation.reading.px4_log import load_ulog
from trueflight.groundstation.study.calibration_study import Study
from trueflight.groundstation.study.kept_survey import kept_rows
from trueflight.groundstation.study.reproduce import _told
from trueflight.groundstation.versions.store import find, newest, save, versions
from trueflight.groundstation.versions.vehicle_draft import draft_vehicle
from trueflight.models.database import Collection
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd
from trueflight.models.model import Model, Term, read_model
from trueflight.models.network import Network
from trueflight.models.outside import unreadable
from trueflight.models.record import EVENT_TOPIC, TICK_TOPIC, FlightRecorder, read_record, vehicle_to_toml
from trueflight.models.record_pb2 import DESCRIPTOR, Event, Tick
from trueflight.models.vehicle import Vehicle, load_vehicle
from trueflight.sim_bridge.seal import reveal, seal
from trueflight.sim_bridge.settings import load_settings as bridge_settings

QUAD5 = ROOT / "models" / "vehicles" / "quad5"
CRAZYFLIE = ROOT / "samples" / "crazyflie"


STUDY = Study(Path("study"), QUAD5 / "vehicle.toml", QUAD5 / "design.json", 1, 10.0, ("rotor_drag",))


@dataclass(frozen=True)
class Reader:
    """One reader: `read` takes a file's path and returns, or raises `InputError`; `kind` of damage; `weight` is how
    often it comes up beside the others."""

    name: str
    suffix: str
    kind: str
    seeds: tuple[bytes, ...]
    read: Callable[[Path], object]
    weight: float = 1.0


def _foreign(folder: Path, vehicle: Vehicle) -> tuple[Reader, ...]:
    """Logs of other autopilots and recorders."""
    one = flown()
    dataflash = copter(one, imu=25, attitude=10, rate=10).bytes()
    tlog = save_tlog(folder / "flight.tlog", telemetry(one, rate=10)).read_bytes()
    db3 = as_db3(ros_messages(Bag(folder / "bag.mcap")), folder / "bag.db3").read_bytes()
    card = (CRAZYFLIE / "card" / "log08").read_bytes()
    flier = load_vehicle(CRAZYFLIE / "crazyswarm2_log08.vehicle.toml")
    return (
        Reader("dataflash", ".bin", "bytes", (dataflash,), lambda p: read_flight(p, vehicle), 0.6),
        Reader("telemetry", ".tlog", "bytes", (tlog,), lambda p: read_flight(p, vehicle), 0.6),
        Reader("ros bag in sqlite", ".db3", "bytes", (db3,), lambda p: read_flight(p, vehicle), 0.6),
        Reader("card", "", "bytes", (card,), lambda p: read_flight(p, flier), 0.6),
    )


def readers(folder: Path) -> tuple[Reader, ...]:
    """All of them; `folder` is theirs to write to."""
    vehicle, mapping = load_vehicle(QUAD5 / "vehicle.toml"), CRAZYFLIE / "crazypad.mapping.toml"
    crazypad = load_vehicle(CRAZYFLIE / "crazypad.vehicle.toml")
    columns = _columns()
    log, cut = _ulog(folder, columns), (ROOT / "samples" / "px4" / "sih_lemniscate.ulg").read_bytes()[:60_000]
    record, plain = _record(folder, vehicle, columns), _plain_record(vehicle, columns)
    bag = _bag(folder, columns)
    lines = (CRAZYFLIE / "crazypad_normal_E9_log03.csv").read_bytes().splitlines(keepends=True)
    foreign = b"".join([lines[0], *lines[250:950]])
    csv, parquet = _table(folder, columns)
    model = _model_text(folder, vehicle)
    store = folder / "store" / vehicle.name
    store.mkdir(parents=True)

    def in_store(path: Path) -> None:
        """The same file as the newest version of a store with a whole one."""
        (store / "v0002-drag.json").write_bytes(path.read_bytes())
        newest(folder / "store", vehicle)
        find(folder / "store", vehicle.name, "v2")

    def survey(path: Path) -> None:
        (folder / "survey").mkdir(exist_ok=True)
        (folder / "survey" / "survey.jsonl").write_bytes(path.read_bytes())
        kept_rows(folder / "survey", [path])

    def collection(path: Path) -> None:
        (folder / "collection").mkdir(exist_ok=True)
        (folder / "collection" / "collection.json").write_bytes(path.read_bytes())
        Collection(folder / "collection", {"seed": 1})

    def deployed(path: Path) -> None:
        (folder / "history.json").write_bytes(path.read_bytes())
        live_file(folder)

    def draft(path: Path) -> None:
        log = load_ulog(path)
        with unreadable(path, "the log", "copy it again"):  # as the command does
            draft_vehicle(log)

    def study(path: Path) -> None:
        (folder / "study").mkdir(exist_ok=True)
        (folder / "study" / "study.json").write_bytes(path.read_bytes())
        (folder / "study" / "1.flight.json").write_text("{}")
        replace(STUDY, folder=folder / "study").open()

    def setpoints(path: Path) -> None:
        from trueflight.models.reference import trajectory_from_csv

        trajectory_from_csv(path.read_bytes().decode("utf-8", "replace"), str(path))

    def pose(path: Path) -> None:
        from trueflight.models.pose import pose_from_json

        try:
            pose_from_json(path.read_bytes())
        except ValueError as error:  # what it promises to raise
            raise InputError(str(error)) from None

    sealed = folder / "answer.sealed"
    seal((), "quad5", 1, sealed)
    told = {"files": {"effects": "effects.onnx"}, "found": ["rotor_drag"], "figures": {"minutes": 5.0}}
    row = {
        "file": "a", "stamp": "1 1", "day": "", "vehicle": "quad5", "duration": 1.0, "rms_before": 1.0, "rms_after": 1.0,
        "noise_floor": 1.0, "verdicts": {"rotor_drag": "missing"}, "estimates": [], "unexplained": [], "error": "",
    }  # fmt: skip
    return (
        Reader("csv", ".csv", "text", (csv,), lambda p: read_flight(p, vehicle), 2.0),
        Reader("csv mapped", ".csv", "text", (foreign,), lambda p: read_flight(p, crazypad, mapping)),
        Reader("parquet", ".parquet", "bytes", (parquet,), lambda p: read_flight(p, vehicle), 2.0),
        Reader("ulog", ".ulg", "bytes", (log,), lambda p: read_flight(p, vehicle), 1.0),
        Reader("ulog draft", ".ulg", "bytes", (log, cut), draft, 0.6),
        Reader("record", ".mcap", "bytes", (record, plain), lambda p: read_flight(p), 2.0),
        Reader("record alone", ".mcap", "bytes", (record, plain), read_record),
        Reader("ros bag", ".mcap", "bytes", (bag,), lambda p: read_flight(p, vehicle), 1.0),
        *_foreign(folder, vehicle),
        Reader("vehicle", ".toml", "toml", ((QUAD5 / "vehicle.toml").read_bytes(),), load_vehicle, 3.0),
        Reader("design", ".json", "json", ((QUAD5 / "design.json").read_bytes(),), load_design, 3.0),
        Reader("model", ".json", "json", (model,), read_model, 3.0),
        Reader("model in a store", ".json", "json", (model,), in_store, 2.0),
        Reader("mapping", ".toml", "toml", (mapping.read_bytes(), (CRAZYFLIE / "ddsysid.mapping.toml").read_bytes()),
               load_mapping, 2.0),
        Reader("companion settings", ".toml", "toml", ((ROOT / "companion" / "companion.toml").read_bytes(),),
               lambda p: replace(companion_settings(p), vehicle="vehicle.toml").checked(), 2.0),
        Reader("ground settings", ".toml", "toml", ((ROOT / "groundstation" / "groundstation.toml").read_bytes(),),
               ground_settings, 2.0),
        Reader("bridge settings", ".toml", "toml", ((ROOT / "sim_bridge" / "sim-bridge.toml").read_bytes(),),
               lambda p: bridge_settings(p, {}), 2.0),
        Reader("setpoints", ".csv", "text", (b"t,x,y,z,yaw\n0,0,0,1,0\n1,0.5,0,1,0\n2,1,0,1.5,0.3\n3,1,1,1,0\n",), setpoints),
        Reader("pose", ".json", "json", (b'{"position": [1, 2, 3], "quaternion": [1, 0, 0, 0], "time_ns": 5}',), pose),
        Reader("deployed models", ".json", "json", (b'["0123456789ab", "123456789abc"]',), deployed),
        Reader("sealed answer", ".sealed", "text", (sealed.read_bytes(),), reveal, 0.5),
        Reader("collection", ".json", "json", (b'{"settings": {"seed": 1}, "flights": {"001-a.mcap": {"seconds": 1}}}',),
               collection, 0.5),
        Reader("survey", ".jsonl", "json", (json.dumps(row).encode(),), survey, 0.5),
        Reader("study", ".json", "json", (_study(),), study, 0.5),
        Reader("reproduction", ".json", "json", (json.dumps(told).encode(),),
               lambda p: _told(p, {"files": dict, "found": list, "figures": dict}), 0.5),
    )  # fmt: skip


def _study() -> bytes:
    return json.dumps(STUDY.settings()).encode()


# --- whole files ----------------------------------------------------------------------------------------------------


def _columns() -> dict[str, np.ndarray]:
    """Four seconds of a simulated flight at 50 Hz in the project's own columns."""
    table = arrow_parquet.read_table(ROOT / "samples" / "rotorpy" / "rotor_drag" / "identify.parquet")
    rows = slice(1000, 1400, 2)
    return {name: table[name].to_numpy()[rows].astype(float) for name in table.column_names}


def _table(folder: Path, columns: dict[str, np.ndarray]) -> tuple[bytes, bytes]:
    table = pa.table({name: np.round(values, 4) for name, values in columns.items()})
    arrow_csv.write_csv(table, folder / "whole.csv")
    arrow_parquet.write_table(table, folder / "whole.parquet", compression="snappy")
    return (folder / "whole.csv").read_bytes(), (folder / "whole.parquet").read_bytes()


def _group(columns: dict[str, np.ndarray], *names: str) -> np.ndarray:
    return np.stack([columns[name] for name in names], -1)


def _written(columns: dict[str, np.ndarray]) -> Written:
    """The topics of PX4 1.14, as far as a reader needs them."""
    t, n = columns["t"] - columns["t"][0] + 60.0, len(columns["t"])
    v, x = (
        _group(columns, "velocity_x", "velocity_y", "velocity_z"),
        _group(columns, "position_x", "position_y", "position_z"),
    )
    f = _group(columns, "specific_force_x", "specific_force_y", "specific_force_z")
    w = _group(columns, "angular_velocity_x", "angular_velocity_y", "angular_velocity_z")
    q = _group(columns, "quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z")
    # Each of these is its own inverse.
    v, x, f, w, q = (
        enu_from_ned(v),
        enu_from_ned(x),
        flu_from_frd(f),
        flu_from_frd(w),
        enu_flu_from_ned_frd(q),
    )
    log = Written(
        {"MPC_THR_HOVER": 0.4, "SYS_AUTOSTART": 4001, "MAV_TYPE": 2, "THR_MDL_FAC": 0.0, "CA_ROTOR_COUNT": 4,
         "BAT1_N_CELLS": 4, **{f"CA_ROTOR{i}_{a}": 0.1 * (-1) ** (i // k) for i in range(4) for k, a in ((1, "PX"), (2, "PY"), (9, "PZ"), (2, "KM"))}},
        {"ver_hw": "PX4_FMU_V5", "ver_sw_release": 0x010E00FF},
        changes=[(61.0, "MPC_THR_HOVER", 0.41)], dropouts=[(62.0, 20)],
    )  # fmt: skip
    ones = np.ones(n)
    log.add("vehicle_status", t[::10], arming_state=("B", 2 * ones[::10].astype(int)), nav_state=("B", 14 * ones[::10].astype(int)),
            system_type=("B", 2 * ones[::10].astype(int)))  # fmt: skip
    log.add("actuator_armed", t[::10], armed=("?", ones[::10].astype(bool)))
    log.add("vehicle_land_detected", t[::10], landed=("?", np.zeros(len(t[::10]), bool)))
    log.add("vehicle_attitude", t, q=("f", q))
    log.add("vehicle_local_position", t, x=("f", x[:, 0]), y=("f", x[:, 1]), z=("f", x[:, 2]), vx=("f", v[:, 0]),
            vy=("f", v[:, 1]), vz=("f", v[:, 2]))  # fmt: skip
    log.add("sensor_combined", t, gyro_rad=("f", w), accelerometer_m_s2=("f", f))
    log.add("vehicle_angular_velocity", t, xyz=("f", w))
    log.add("vehicle_rates_setpoint", t, roll=("f", w[:, 0]), pitch=("f", w[:, 1]), yaw=("f", w[:, 2]),
            thrust_body=("f", np.stack([0 * t, 0 * t, -columns["thrust_command"]], -1)))  # fmt: skip
    log.add("vehicle_thrust_setpoint", t, xyz=("f", np.stack([0 * t, 0 * t, -columns["thrust_command"]], -1)))
    log.add("battery_status", t[::10], connected=("?", ones[::10].astype(bool)), voltage_v=("f", 15.5 * ones[::10]),
            current_a=("f", 10.0 * ones[::10]))  # fmt: skip
    return log


def _ulog(folder: Path, columns: dict[str, np.ndarray]) -> bytes:
    return _written(columns).save(folder / "whole.ulg").read_bytes()


def _bag(folder: Path, columns: dict[str, np.ndarray]) -> bytes:
    """The same topics as ROS 2 records them."""
    names = {"float": "float32", "double": "float64"} | {
        k: k.removesuffix("_t") for k in TYPES.values() if k.endswith("_t")
    }
    pending = []
    for name, _, t, fields in _written(columns).topics:
        kind = "px4_msgs/msg/" + "".join(word.capitalize() for word in name.split("_"))
        lines = ["uint64 timestamp"]
        for key, (code, values) in fields.items():
            size = f"[{values.shape[1]}]" if values.ndim > 1 else ""
            lines.append(f"{names.get(TYPES[code], TYPES[code])}{size} {key}")
        for row, when in enumerate(t):
            values = {key: np.asarray(v)[row].tolist() for key, (_, v) in fields.items()}
            message = SimpleNamespace(timestamp=round(1e6 * when), **values)
            pending.append((when, f"/fmu/out/{name}", kind, "\n".join(lines), message))
    with (folder / "whole.bag.mcap").open("wb") as stream:
        writer = Ros2Writer(stream, chunk_size=1 << 15, compression=CompressionType.NONE, enable_crcs=False)
        schemas = {}
        for when, topic, kind, definition, message in sorted(pending, key=lambda entry: entry[0]):
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(kind, definition)
            writer.write_message(topic, schemas[kind], message, log_time=round(1e9 * when))
        writer.finish()
    return (folder / "whole.bag.mcap").read_bytes()


def _ticks(columns: dict[str, np.ndarray]) -> list[Tick]:
    out = []
    for i, t in enumerate(columns["t"]):
        tick = Tick(
            vehicle_time_us=round(1e6 * t), host_time_ns=round(1e9 * t), thrust_command=columns["thrust_command"][i],
            battery_voltage=15.5, phase="mission", armed=True, setpoint_sent=True, controller="lqr", guard="off",
            flight_mode="OFFBOARD", trajectory="circle",
        )  # fmt: skip
        for name in ("position", "velocity", "angular_velocity", "specific_force"):
            for axis in "xyz":
                setattr(getattr(tick, name), axis, columns[f"{name}_{axis}"][i])
        for axis in "wxyz":
            setattr(tick.quaternion, axis, columns[f"quaternion_{axis}"][i])
        out.append(tick)
    return out


def _record(folder: Path, vehicle: Vehicle, columns: dict[str, np.ndarray]) -> bytes:
    """A flight record as the companion writes it: compressed, with checksums."""
    path = folder / "whole.mcap"
    with FlightRecorder(path, vehicle, load_design(QUAD5 / "design.json"), {"controller": "lqr"}) as recorder:
        for tick in _ticks(columns):
            recorder.tick(tick, tick.vehicle_time_us, tick.host_time_ns)
        recorder.event(Event(vehicle_time_us=1, level="info", kind="finished", text="finished"))
    return path.read_bytes()


def _plain_record(vehicle: Vehicle, columns: dict[str, np.ndarray]) -> bytes:
    """The same without compression and checksums, so that damage reaches the messages."""
    import io

    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    out = io.BytesIO()
    writer = McapWriter(out, chunk_size=1 << 14, compression=CompressionType.NONE, enable_crcs=False)
    writer.start(profile="trueflight", library="trueflight")
    schemas = FileDescriptorSet()
    DESCRIPTOR.CopyToProto(schemas.file.add())
    ids = []
    for topic, kind in ((TICK_TOPIC, Tick), (EVENT_TOPIC, Event)):
        schema = writer.register_schema(kind.DESCRIPTOR.full_name, "protobuf", schemas.SerializeToString())
        ids.append(writer.register_channel(topic, "protobuf", schema))
    writer.add_metadata("flight", {"vehicle": vehicle.name, "created_ns": "1700000000000000000"})
    writer.add_attachment(1, 1, "vehicle.toml", "application/toml", vehicle_to_toml(vehicle).encode())
    writer.add_attachment(1, 1, "design.json", "application/json", (QUAD5 / "design.json").read_bytes())
    for tick in _ticks(columns):
        writer.add_message(ids[0], 1000 * tick.vehicle_time_us, tick.SerializeToString(), 1, 1)
    writer.add_metadata("end", {"dropped": "0"})
    writer.finish()
    return out.getvalue()


def _model_text(folder: Path, vehicle: Vehicle) -> bytes:
    """A version with effects and a small network."""
    draw = np.random.default_rng(1)
    names = ("z", "vx", "T")
    layers = tuple(
        (draw.normal(size=(o, i)).astype("f4"), draw.normal(size=o).astype("f4")) for i, o in ((3, 4), (4, 3))
    )
    one = np.ones(3, dtype="f4")
    network = Network(names, one, one, layers, one, -one, one, "00", 1, "default", {"train_rms": 0.1})
    terms = (
        Term("rigid_body", {}),
        Term("rotor_drag", {"x": 0.3, "y": 0.4}, {"x": (0.2, 0.4), "y": (0.3, 0.5)}),
    )
    model = Model(vehicle, terms, created="2026-01-01", fit={"rms": 0.2}, network=network)
    _, path = save(folder / "versions", replace(model, parent=None), None)
    assert versions(folder / "versions", vehicle.name) == [path]
    return path.read_bytes()
