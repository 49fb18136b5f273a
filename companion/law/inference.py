"""Deployed models: an ONNX file from the ground is checked against the contract before anything flies with
it."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation
from trueflight.companion.law.onnx_structure import decoded, why_not_self_contained
from trueflight.companion.law.straight_line import NoStraightLine, StraightLine
from trueflight.companion.law.watch import GuardLimits, Range, Watch
from trueflight.models import contract
from trueflight.models.errors import InputError, shown
from trueflight.models.vehicle import Vehicle

if TYPE_CHECKING:
    import onnxruntime

MAX_BYTES = 4 << 20
"""The networks meant here have tens of kilobytes; anything near this is not one of them."""
TIMING_RUNS = 200
LOOK_ROWS = 4
"""Rows of features that a control tick asks for."""
_TIMING_LIMIT = 0.5  # s; a model that is that slow needs no exact figure
_RANGE_SAMPLES = 64
SAME = 1e-4
"""m/s²: how far a straight line may be from the runtime's answer, whose numbers have 32 bits; a tenth of what golden
vectors may differ by."""
_BEYOND = 0.25
"""Shares of the training range by which it is left on either side where the two are compared: as far as a watch lets a
model act."""


@dataclass(frozen=True)
class ModelInfo:
    """What the metadata of an accepted model say; `features` are the training ranges in the model's order."""

    hash: str
    name: str
    version: str
    features: tuple[Range, ...]
    chain: tuple[dict[str, Any], ...] = field(default=(), compare=False)
    data_hash: str = ""
    actuation: Actuation = ACTS_AT_ONCE

    @property
    def wants_yaw(self) -> bool:
        """Whether the features end with cos psi, sin psi."""
        return len(self.features) > len(contract.FEATURES)


class Model:
    """An accepted model: call it with the features (list of F floats) for three accelerations (m/s², heading
    frame).

    It computes by a straight line where that was shown to be what the runtime computes, otherwise by the runtime: one
    thread, input and output bound to buffers once. Not to be called from two threads at a time.
    """

    def __init__(self, computes: StraightLine | Runtime, info: ModelInfo) -> None:
        self.info = info
        self.straight = isinstance(computes, StraightLine)
        self.rows = computes
        """Error acceleration for each row of features, m/s², heading frame."""

    def __call__(self, features: Sequence[float]) -> Sequence[float]:
        """Error acceleration in m/s², heading frame."""
        return self.rows((features,))[0]

    def watched(self, limits: GuardLimits | None = None) -> Watch:
        """A watch over this model, for one flight."""
        info = self.info
        return Watch(self, info.features, limits, info.wants_yaw, info.hash, actuation=info.actuation)


class Runtime:
    """A file as ONNX Runtime computes it: the four rows of a tick in one run where the file can."""

    def __init__(self, session: onnxruntime.InferenceSession, width: int) -> None:
        self._session, self._width = session, width
        self._bound = {1: self._bind(1)}
        if session.get_inputs()[0].shape[0] != 1:
            self._bound[LOOK_ROWS] = self._bind(LOOK_ROWS)

    def __call__(self, rows: Sequence[Sequence[float]]) -> list[Sequence[float]]:
        """Error acceleration for each row of features, m/s², heading frame."""
        if len(rows) not in self._bound:
            return [self((features,))[0] for features in rows]
        given, answer, binding = self._bound[len(rows)]
        given[:] = rows
        self._session.run_with_iobinding(binding)
        found: list[Sequence[float]] = answer.tolist()
        return found

    def _bind(self, rows: int) -> tuple[np.ndarray, np.ndarray, onnxruntime.IOBinding]:
        given = np.zeros((rows, self._width), dtype=np.float32)
        answer = np.zeros((rows, 3), dtype=np.float32)
        binding = self._session.io_binding()
        binding.bind_input(contract.INPUT_NAME, "cpu", 0, np.float32, given.shape, given.ctypes.data)
        binding.bind_output(contract.OUTPUT_NAME, "cpu", 0, np.float32, answer.shape, answer.ctypes.data)
        return given, answer, binding


@dataclass(frozen=True)
class Verdict:
    """Whether a model was accepted; `reason` is one line, `seconds` the median and the worst time of one
    inference."""

    accepted: bool
    reason: str
    model: Model | None = None
    median: float = math.nan
    worst: float = math.nan


class _Refused(Exception):
    """Carries the reason out of the checks."""


def check_model(onnx: bytes, vehicle: Vehicle, deadline: float = 0.002) -> Verdict:
    """Check an ONNX file against `models.contract` and the vehicle; never raises, whatever the bytes.

    `deadline` in s is what one inference may take: the median of many runs must stay below half of it.
    """
    try:
        return _check(onnx, vehicle, deadline)
    except _Refused as refusal:
        return Verdict(False, str(refusal))
    except MemoryError:
        return Verdict(False, "its check needs too much memory")
    except Exception as error:  # noqa: BLE001 - what no check above foresaw is refused as well
        return Verdict(False, f"its check failed ({type(error).__name__}): the file is hostile or damaged")


def warm_up() -> None:
    """Load what is loaded on first use, for a process that will soon be allowed to open no more files."""
    np.random.default_rng(0).uniform(size=2)
    np.median(np.ones(2))
    json.loads("{}")
    with contextlib.suppress(_Refused):
        _open(b"")


def open_model(onnx: bytes, info: ModelInfo, straight: bool = False) -> Model:
    """Open a file that was checked before, elsewhere; `straight` where its straight line was found to be the same.

    The golden vectors must come out here too, otherwise the runtime is loaded for it. Raises `InputError` where it does
    not open.
    """
    if contract.model_hash(onnx) != info.hash:
        raise InputError(f"model {info.hash}: the file on board is another one; deploy it again")
    try:
        if straight:
            with contextlib.suppress(NoStraightLine, _Refused):
                model = Model(StraightLine(onnx, len(info.features)), info)
                meta = {bytes(e.key).decode(): bytes(e.value).decode() for e in decoded(onnx).metadata_props}
                _check_golden(model, meta)
                return model
        return Model(Runtime(_open(onnx), len(info.features)), info)
    except _Refused as refusal:
        raise InputError(f"model {info.hash}: {refusal}") from None


def _check(onnx: bytes, vehicle: Vehicle, deadline: float) -> Verdict:
    if len(onnx) > MAX_BYTES:
        raise _Refused(f"the file has {len(onnx)} bytes; at most {MAX_BYTES} are accepted")
    reason = why_not_self_contained(onnx)
    if reason:
        raise _Refused(reason)
    session = _open(onnx)
    try:
        meta = dict(session.get_modelmeta().custom_metadata_map)
    except UnicodeDecodeError:
        raise _Refused("its metadata are no text (UTF-8); export it again") from None
    for key in contract.REQUIRED_KEYS:
        if key not in meta:
            raise _Refused(f"its metadata lack '{key}'; export it with `groundstation deploy`")
    if meta[contract.KEY_CONTRACT] != contract.CONTRACT_VERSION:
        raise _Refused(
            f"it follows contract {shown(meta[contract.KEY_CONTRACT])}; this companion knows "
            f"{contract.CONTRACT_VERSION!r}"
        )
    _check_vehicle(_json(meta, contract.KEY_VEHICLE, dict), vehicle)
    ranges = _ranges(_json(meta, contract.KEY_FEATURES, list))
    _check_ports(session, len(ranges))
    info = ModelInfo(
        contract.model_hash(onnx),
        _word(meta, contract.KEY_NAME),
        _word(meta, contract.KEY_VERSION),
        ranges,
        _chain(meta),
        _word(meta, contract.KEY_DATA_HASH),
        _actuation(meta),
    )
    model = Model(Runtime(session, len(ranges)), info)
    _check_golden(model, meta)
    _check_range(model)
    model = _straightened(onnx, model)
    median, worst = _time(model)
    if not median <= 0.5 * deadline:
        raise _Refused(
            f"one inference takes {1e3 * median:.2f} ms; at most {500 * deadline:.2f} ms are accepted"
        )
    text = f"{info.name} {info.version}, {1e6 * median:.0f} us an inference"
    return Verdict(True, text, model, median, worst)


def _straightened(onnx: bytes, reference: Model) -> Model:
    """The model by its straight line, where that gives what the runtime does: at the golden vectors, in the training
    range and around it.
    """
    try:
        model = Model(StraightLine(onnx, len(reference.info.features)), reference.info)
    except NoStraightLine:
        return reference
    meta = {bytes(entry.key): bytes(entry.value) for entry in decoded(onnx).metadata_props}
    golden = json.loads(meta[contract.KEY_GOLDEN_FEATURES.encode()])
    for point in [*golden, *_points(reference.info, _BEYOND).tolist()]:
        ours, theirs = model(point), _run(reference, point)
        for a, b in zip(ours, theirs, strict=True):
            same = abs(a - b) <= SAME if math.isfinite(b) else not math.isfinite(a)
            if not same:
                return reference
    return model


def _open(onnx: bytes) -> onnxruntime.InferenceSession:
    import onnxruntime  # late: a companion whose models have straight lines never needs it

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    # The arena keeps what it once took; these networks need a few kilobytes.
    options.enable_cpu_mem_arena = False
    try:
        return onnxruntime.InferenceSession(onnx, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - ONNX Runtime raises many kinds for bytes that are no model
        first = " ".join(str(error).split())[:160]
        raise _Refused(f"not an ONNX model that can be run here ({first})") from None


def _json(meta: dict[str, str], key: str, kind: type) -> Any:
    try:
        value = json.loads(meta[key])
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, kind):
        raise _Refused(f"its metadata '{key}' is not a JSON {'object' if kind is dict else 'list'}")
    return value


def _word(meta: dict[str, str], key: str) -> str:
    """A metadata text that people are shown: short, and one line."""
    if len(meta[key]) > contract.LONGEST_WORD or not meta[key].isprintable():
        raise _Refused(f"its metadata '{key}' is not one line of at most {contract.LONGEST_WORD} characters")
    return meta[key]


def _chain(meta: dict[str, str]) -> tuple[dict[str, Any], ...]:
    """The effects that a model says it is made of: objects with a name and named numbers (or lists of them)."""
    chain = _json(meta, contract.KEY_CHAIN, list)
    for entry in chain:
        if not isinstance(entry, dict) or not isinstance(entry.get("effect"), str):
            raise _Refused(
                f"its metadata '{contract.KEY_CHAIN}' must hold objects with 'effect' and 'parameters', not "
                f"{shown(entry)}"
            )
        if not isinstance(entry.get("parameters", {}), dict):
            raise _Refused(
                f"its metadata '{contract.KEY_CHAIN}': the parameters of {shown(entry['effect'])} are no object"
            )
    return tuple(chain)


def _actuation(meta: dict[str, str]) -> Actuation:
    if contract.KEY_ACTUATION not in meta:
        return ACTS_AT_ONCE
    numbers = _json(meta, contract.KEY_ACTUATION, dict)
    try:
        return Actuation(**{str(name): _real(value) for name, value in numbers.items()})
    except (TypeError, ValueError, OverflowError) as error:
        raise _Refused(f"its metadata '{contract.KEY_ACTUATION}': {str(error)[:160]}") from None


def _real(value: object) -> float:
    """A number of JSON as a float; raises `TypeError` for anything else, `OverflowError` for what is too large."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{shown(value)} is no number")
    return float(value)


def _check_vehicle(stated: dict[str, Any], vehicle: Vehicle) -> None:
    name = stated.get("name")
    if name != vehicle.name:
        raise _Refused(f"made for vehicle {shown(name)}, this one is '{vehicle.name}'")
    for key, ours in (("mass", vehicle.mass), ("hover_thrust", vehicle.hover_thrust)):
        value = stated.get(key)
        try:
            fits = abs(_real(value) - ours) <= 0.01 * ours
        except (TypeError, OverflowError):
            fits = False
        if not fits:
            raise _Refused(f"made for {key} {shown(value)}, this vehicle has {ours:g}; refit it")


def _ranges(entries: list[Any]) -> tuple[Range, ...]:
    ranges = []
    for entry in entries:
        try:
            one = Range(str(entry["name"]), str(entry["unit"]), _real(entry["low"]), _real(entry["high"]))
        except (KeyError, TypeError, ValueError, OverflowError):
            raise _Refused("its metadata 'features' need name, unit, low and high in each entry") from None
        if not (math.isfinite(one.low) and math.isfinite(one.high) and one.low <= one.high):
            raise _Refused(f"the training range of feature {shown(one.name)} is {one.low} to {one.high}")
        ranges.append(one)
    given = {one.name: one.unit for one in ranges}
    base = list(contract.FEATURES.items())
    if list(given.items()) not in (base, base + list(contract.YAW_FEATURES.items())):
        raise _Refused(
            f"its features are {shown(', '.join(given)) if given else 'none'}; expected {', '.join(contract.FEATURES)} "
            f"with their units, and optionally {', '.join(contract.YAW_FEATURES)}"
        )
    return tuple(ranges)


def _check_ports(session: onnxruntime.InferenceSession, features: int) -> None:
    inputs, outputs = session.get_inputs(), session.get_outputs()
    for ports, name, width in ((inputs, contract.INPUT_NAME, features), (outputs, contract.OUTPUT_NAME, 3)):
        if [port.name for port in ports] != [name]:
            raise _Refused(
                f"its ports are {shown([port.name for port in ports])}; expected one called '{name}'"
            )
        shape = ports[0].shape
        free = len(shape) == 2 and (shape[0] is None or isinstance(shape[0], str) or shape[0] == 1)
        if ports[0].type != "tensor(float)" or not free or shape[1] not in (width, None):
            raise _Refused(f"'{name}' is {ports[0].type} {shape}; expected tensor(float) [N, {width}]")


def _run(model: Model, features: Sequence[float]) -> Sequence[float]:
    try:
        return model(features)
    except Exception as error:  # noqa: BLE001 - a graph may fail in as many ways as it has operators
        first = " ".join(str(error).split())[:160]
        raise _Refused(f"it cannot be evaluated ({first})") from None


def _check_golden(model: Model, meta: dict[str, str]) -> None:
    width = len(model.info.features)
    golden = []
    for key, columns in ((contract.KEY_GOLDEN_FEATURES, width), (contract.KEY_GOLDEN_DELTA, 3)):
        try:
            values = np.array(_json(meta, key, list), dtype=float)
        except (TypeError, ValueError, OverflowError):
            values = np.empty(0)
        if (
            values.ndim != 2
            or values.shape[1] != columns
            or len(values) < 3
            or not np.all(np.isfinite(values))
        ):
            raise _Refused(f"its metadata '{key}' must hold at least 3 rows of {columns} finite numbers")
        golden.append(values)
    if len(golden[0]) != len(golden[1]):
        raise _Refused(f"it has {len(golden[0])} golden inputs and {len(golden[1])} golden outputs")
    for features, expected in zip(*golden, strict=True):
        error = float(np.max(np.abs(np.array(_run(model, features.tolist())) - expected)))
        if not error <= contract.GOLDEN_TOLERANCE:
            raise _Refused(
                f"a golden vector differs by {error:.2g} m/s^2 (at most {contract.GOLDEN_TOLERANCE:g}): "
                "the file is damaged or this runtime computes something else"
            )


def _check_range(model: Model) -> None:
    """Finite at random points of the training range and at its corners."""
    for point in _points(model.info):
        if not np.all(np.isfinite(_run(model, point.tolist()))):
            raise _Refused("it returns numbers that are not finite inside its own training range")


def _points(info: ModelInfo, beyond: float = 0.0) -> np.ndarray:
    """Random points (N, F) of the training range and its corners; `beyond` shares of it are added on either side."""
    low = np.array([one.low for one in info.features])
    width = np.array([one.high for one in info.features]) - low
    points = np.random.default_rng(0).uniform(size=(_RANGE_SAMPLES, len(low)))
    points[0], points[1] = 0.0, 1.0
    found: np.ndarray = low + ((1.0 + 2.0 * beyond) * points - beyond) * width
    return found


def _time(model: Model) -> tuple[float, float]:
    """Median and worst time of one inference in s, of this thread's processor: what others take from it says
    nothing of the model.
    """
    middle = [0.5 * (one.low + one.high) for one in model.info.features]
    seconds: list[float] = []
    while len(seconds) < TIMING_RUNS and sum(seconds) < _TIMING_LIMIT:
        begin = time.thread_time()
        model(middle)
        seconds.append(time.thread_time() - begin)
    return float(np.median(seconds)), max(seconds)
