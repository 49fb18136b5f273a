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
from trueflight.companion.law.adaptation import Learning
from trueflight.companion.law.onnx_structure import decoded, why_not_self_contained
from trueflight.companion.law.straight_line import NoStraightLine, StraightLine
from trueflight.companion.law.watch import ZERO, GuardLimits, Range, Vector, Watch
from trueflight.models import contract
from trueflight.models.errors import InputError, shown
from trueflight.models.learnable import MOST, Learnable
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
    """What the metadata of an accepted model say; `features` are the training ranges in the model's order,
    `learnables` what may be learnt in flight, `noise` (m/s²) what the model leaves even of flights that it knows."""

    hash: str
    name: str
    version: str
    features: tuple[Range, ...]
    chain: tuple[dict[str, Any], ...] = field(default=(), compare=False)
    data_hash: str = ""
    actuation: Actuation = ACTS_AT_ONCE
    learnables: tuple[Learnable, ...] = ()
    noise: Vector = ZERO

    @property
    def deployed(self) -> list[float]:
        """The numbers that may be learnt, as they were deployed."""
        return [one.value for one in self.learnables]

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
        self._computes, self._deployed = computes, info.deployed

    def rows(
        self, rows: Sequence[Sequence[float]], parameters: Sequence[float] | None = None
    ) -> Sequence[Sequence[float]]:
        """Error acceleration for each row of features, m/s², heading frame; with the deployed parameters or others."""
        return self._computes(rows, self._deployed if parameters is None else parameters)

    def sensed(
        self, row: Sequence[float], parameters: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float]]:
        """Error acceleration of a row, and its derivative along each parameter, three by three."""
        return self._computes.sensed(row, parameters)

    def __call__(self, features: Sequence[float]) -> Sequence[float]:
        """Error acceleration in m/s², heading frame."""
        return self.rows((features,))[0]

    def watched(self, limits: GuardLimits | None = None, learns: bool = False) -> Watch:
        """A watch over this model, for one flight; one that `learns`, where the model has what may be learnt."""
        info = self.info
        learning = Learning(self, info.learnables, info.noise) if learns and info.learnables else None
        model = self if learning is None else learning
        return Watch(
            model,
            info.features,
            limits,
            info.wants_yaw,
            info.hash,
            actuation=info.actuation,
            learning=learning,
        )


class Runtime:
    """A file as ONNX Runtime computes it: the four rows of a tick in one run where the file can."""

    def __init__(self, session: onnxruntime.InferenceSession, width: int, parameters: int = 0) -> None:
        self._session, self._width, self._parameters = session, width, parameters
        self._bound = {1: _Bound(session, 1, width, parameters)}
        if session.get_inputs()[0].shape[0] != 1:
            self._bound[LOOK_ROWS] = _Bound(session, LOOK_ROWS, width, parameters)

    def __call__(
        self, rows: Sequence[Sequence[float]], parameters: Sequence[float] = ()
    ) -> list[Sequence[float]]:
        """Error acceleration for each row of features, m/s², heading frame."""
        if len(rows) not in self._bound:
            return [self((features,), parameters)[0] for features in rows]
        bound = self._bound[len(rows)]
        bound.run(rows, parameters)
        return list(bound.delta.tolist())

    def sensed(
        self, row: Sequence[float], parameters: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float]]:
        """Error acceleration of a row, and its derivative along each parameter, three by three."""
        bound = self._bound[1]
        bound.run((row,), parameters)
        return bound.delta[0].tolist(), bound.sensitivity[0].tolist()


class _Bound:
    """Buffers for so many rows, bound to the ports of a session once."""

    def __init__(self, session: onnxruntime.InferenceSession, rows: int, width: int, parameters: int) -> None:
        self._session = session
        self._features = np.zeros((rows, width), dtype=np.float32)
        self._parameters = np.zeros((rows, parameters), dtype=np.float32)
        self.delta = np.zeros((rows, 3), dtype=np.float32)
        self.sensitivity = np.zeros((rows, 3 * parameters), dtype=np.float32)
        self._binding = session.io_binding()
        ports = [(contract.INPUT_NAME, self._features), (contract.OUTPUT_NAME, self.delta)]
        if parameters:
            ports += [
                (contract.PARAMETERS_NAME, self._parameters),
                (contract.SENSITIVITY_NAME, self.sensitivity),
            ]
        for number, (name, room) in enumerate(ports):
            bind = self._binding.bind_output if number % 2 else self._binding.bind_input
            bind(name, "cpu", 0, np.float32, room.shape, room.ctypes.data)

    def run(self, rows: Sequence[Sequence[float]], parameters: Sequence[float]) -> None:
        """Compute what the outputs hold then."""
        self._features[:] = rows
        self._parameters[:] = parameters
        self._session.run_with_iobinding(self._binding)


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


def cannot_learn(name: str) -> str:
    """Why a model does not fly `corrected_adaptive`, and what to do."""
    return f"nothing of model '{name}' can be learnt in flight; export it with --adaptive, or fly corrected"


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
                model = Model(StraightLine(onnx, len(info.features), len(info.learnables)), info)
                meta = {bytes(e.key).decode(): bytes(e.value).decode() for e in decoded(onnx).metadata_props}
                _check_golden(model, meta)
                return model
        return Model(Runtime(_open(onnx), len(info.features), len(info.learnables)), info)
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
    learnables, noise = _learnables(meta)
    _check_ports(session, len(ranges), len(learnables))
    info = ModelInfo(
        contract.model_hash(onnx),
        _word(meta, contract.KEY_NAME),
        _word(meta, contract.KEY_VERSION),
        ranges,
        _chain(meta),
        _word(meta, contract.KEY_DATA_HASH),
        _actuation(meta),
        learnables,
        noise,
    )
    model = Model(Runtime(session, len(ranges), len(learnables)), info)
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
        info = reference.info
        model = Model(StraightLine(onnx, len(info.features), len(info.learnables)), info)
    except NoStraightLine:
        return reference
    meta = {bytes(entry.key): bytes(entry.value) for entry in decoded(onnx).metadata_props}
    golden = json.loads(meta[contract.KEY_GOLDEN_FEATURES.encode()])
    for point in [*golden, *_points(info, _BEYOND).tolist()]:
        if not _same(model(point), _run(reference, point)):
            return reference
    for point, parameters in zip(_points(info, _BEYOND), _parameters(info), strict=True):
        ours, theirs = (_sense(one, point.tolist(), parameters.tolist()) for one in (model, reference))
        if not (_same(ours[0], theirs[0]) and _same(ours[1], theirs[1])):
            return reference
    return model


def _same(ours: Sequence[float], theirs: Sequence[float]) -> bool:
    """Whether numbers are those of 32 bits; derivatives may be large, and differ by as many digits."""
    for a, b in zip(ours, theirs, strict=True):
        same = abs(a - b) <= SAME * max(1.0, abs(b)) if math.isfinite(b) else not math.isfinite(a)
        if not same:
            return False
    return True


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


def _check_ports(session: onnxruntime.InferenceSession, features: int, parameters: int) -> None:
    """The graph's inputs and outputs: a second of each where, and only where, its metadata name what may be learnt."""
    given, answered = {contract.INPUT_NAME: features}, {contract.OUTPUT_NAME: 3}
    if parameters:
        given[contract.PARAMETERS_NAME] = parameters
        answered[contract.SENSITIVITY_NAME] = 3 * parameters
    for ports, expected in ((session.get_inputs(), given), (session.get_outputs(), answered)):
        if [port.name for port in ports] != list(expected):
            called = " and ".join(f"'{name}'" for name in expected)
            raise _Refused(
                f"its ports are {shown([port.name for port in ports])}; expected "
                f"{'two' if parameters else 'one'} called {called}"
            )
        for port in ports:
            width, shape = expected[port.name], port.shape
            free = len(shape) == 2 and (shape[0] is None or isinstance(shape[0], str) or shape[0] == 1)
            if port.type != "tensor(float)" or not free or shape[1] not in (width, None):
                raise _Refused(f"'{port.name}' is {port.type} {shape}; expected tensor(float) [N, {width}]")


def _learnables(meta: dict[str, str]) -> tuple[tuple[Learnable, ...], Vector]:
    """What the model says may be learnt in flight, and what it leaves of flights that it knows; nothing where there is
    nothing to learn."""
    if contract.KEY_ADAPTIVE not in meta:
        return (), ZERO
    found = []
    for entry in _json(meta, contract.KEY_ADAPTIVE, list):
        try:
            words = [entry.pop(key) for key in ("effect", "parameter", "unit")]
            if not all(isinstance(w, str) and w.isprintable() and 0 < len(w) <= 60 for w in words):
                raise ValueError("effect, parameter and unit must be words")
            effect, parameter, unit = words
            numbers = [_real(entry[key]) for key in ("value", "low", "high", "spread", "drift")]
            found.append(Learnable(effect, parameter, unit, *numbers))
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise _Refused(f"its metadata '{contract.KEY_ADAPTIVE}': {str(error)[:160]}") from None
    if not 0 < len(found) <= MOST or len({one.name for one in found}) < len(found):
        raise _Refused(
            f"its metadata '{contract.KEY_ADAPTIVE}' must name 1 to {MOST} different parameters, not {len(found)}"
        )
    for key in (contract.KEY_NOISE, contract.KEY_GOLDEN_PARAMETERS, contract.KEY_GOLDEN_SENSITIVITY):
        if key not in meta:
            raise _Refused(f"its metadata lack '{key}'; export it again with --adaptive")
    try:
        x, y, z = (_real(one) for one in _json(meta, contract.KEY_NOISE, list))
    except (TypeError, ValueError, OverflowError):
        x = y = z = math.nan
    if not all(0.0 < one < math.inf for one in (x, y, z)):
        raise _Refused(f"its metadata '{contract.KEY_NOISE}' must be three numbers above 0")
    return tuple(found), (x, y, z)


def _run(model: Model, features: Sequence[float]) -> Sequence[float]:
    try:
        return model(features)
    except Exception as error:  # noqa: BLE001 - a graph may fail in as many ways as it has operators
        first = " ".join(str(error).split())[:160]
        raise _Refused(f"it cannot be evaluated ({first})") from None


def _sense(
    model: Model, features: Sequence[float], parameters: Sequence[float]
) -> tuple[Sequence[float], Sequence[float]]:
    """Answer and derivatives; of a model that learns nothing the answer alone."""
    if not model.info.learnables:
        return _run(model, features), ()
    try:
        return model.sensed(features, parameters)
    except Exception as error:  # noqa: BLE001 - a graph may fail in as many ways as it has operators
        first = " ".join(str(error).split())[:160]
        raise _Refused(f"it cannot be evaluated ({first})") from None


def _golden(meta: dict[str, str], tables: Sequence[tuple[str, int]]) -> list[np.ndarray]:
    """Tables of golden vectors with so many columns each, all of one length."""
    golden = []
    for key, columns in tables:
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
    for other in golden[1:]:
        if len(golden[0]) != len(other):
            raise _Refused(f"it has {len(golden[0])} golden inputs and {len(other)} golden outputs")
    return golden


def _check_golden(model: Model, meta: dict[str, str]) -> None:
    tables = [(contract.KEY_GOLDEN_FEATURES, len(model.info.features)), (contract.KEY_GOLDEN_DELTA, 3)]
    learnt = len(model.info.learnables)
    if learnt:
        tables += [(contract.KEY_GOLDEN_PARAMETERS, learnt), (contract.KEY_GOLDEN_SENSITIVITY, 3 * learnt)]
    inputs, outputs, *more = _golden(meta, tables)
    parameters, slopes = more or (np.zeros((len(inputs), 0)), np.zeros((len(inputs), 0)))
    for features, expected, numbers, derivatives in zip(inputs, outputs, parameters, slopes, strict=True):
        found, along = (np.array(one) for one in _sense(model, features.tolist(), numbers.tolist()))
        error = float(np.max(np.abs(found - expected)))
        if not error <= contract.GOLDEN_TOLERANCE:
            raise _Refused(
                f"a golden vector differs by {error:.2g} m/s^2 (at most {contract.GOLDEN_TOLERANCE:g}): "
                "the file is damaged or this runtime computes something else"
            )
        scale = np.maximum(1.0, np.abs(derivatives))
        if learnt and not np.all(np.abs(along - derivatives) <= contract.GOLDEN_TOLERANCE * scale):
            raise _Refused("its sensitivity differs from that of a golden vector: the file is damaged")
        if learnt:
            _check_slopes(model, features.tolist(), numbers, along)


_STEP = 1e-2
"""Share of a parameter's range over which the derivative is taken as a difference."""
_ALIKE = 0.02
"""Share of the largest effect of a parameter by which difference and derivative may differ: the terms beyond the
first, and 32 bits."""


def _check_slopes(model: Model, features: Sequence[float], parameters: np.ndarray, along: np.ndarray) -> None:
    """The derivatives are those of the model's own answer: central differences say the same."""
    for k, one in enumerate(model.info.learnables):
        half = _STEP * (one.high - one.low)
        ends = []
        for sign in (1.0, -1.0):
            moved = parameters.copy()
            moved[k] += sign * half
            ends.append(np.array(_sense(model, features, moved.tolist())[0]))
        difference, claimed = ends[0] - ends[1], 2.0 * half * along[3 * k : 3 * k + 3]
        allowed = contract.GOLDEN_TOLERANCE + _ALIKE * float(np.max(np.abs(difference)))
        if not np.all(np.abs(difference - claimed) <= allowed):
            raise _Refused(f"its sensitivity to {one.name} is not the derivative of its answer")


def _check_range(model: Model) -> None:
    """Finite at random points of the training range and at its corners, with any parameters that may be learnt."""
    for point, parameters in zip(_points(model.info), _parameters(model.info), strict=True):
        answers = [_run(model, point.tolist()), *_sense(model, point.tolist(), parameters.tolist())]
        if not all(np.all(np.isfinite(one)) for one in answers):
            raise _Refused("it returns numbers that are not finite inside its own training range")


def _parameters(info: ModelInfo) -> np.ndarray:
    """As many random parameters (N, P) as there are points: within their ranges, and at both ends of all of them."""
    low = np.array([one.low for one in info.learnables])
    high = np.array([one.high for one in info.learnables])
    shares = np.random.default_rng(1).uniform(size=(_RANGE_SAMPLES, len(low)))
    shares[0], shares[1] = 0.0, 1.0
    found: np.ndarray = low + shares * (high - low)
    return found


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
