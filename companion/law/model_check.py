"""Deployed models: an ONNX file from the ground is checked against the contract before anything flies with
it."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from trueflight.companion.law import model_metadata as metadata
from trueflight.companion.law.inference import Model, ModelInfo, Refused, Runtime, open_session
from trueflight.companion.law.onnx_structure import decoded, why_not_self_contained
from trueflight.companion.law.straight_line import NoStraightLine, StraightLine
from trueflight.models import contract
from trueflight.models.errors import InputError, shown
from trueflight.models.vehicle import Vehicle

if TYPE_CHECKING:
    import onnxruntime

MAX_BYTES = 4 << 20
"""The networks meant here have tens of kilobytes; anything near this is not one of them."""
TIMING_RUNS = 200
_TIMING_LIMIT = 0.5  # s; a model that is that slow needs no exact figure
_RANGE_SAMPLES = 64
SAME = 1e-4
"""m/s²: how far a straight line may be from the runtime's answer, whose numbers have 32 bits; a tenth of what golden
vectors may differ by."""
_BEYOND = 0.25
"""Shares of the training range by which it is left on either side where the two are compared: as far as a watch lets a
model act."""
_STEP = 1e-2
"""Share of a parameter's range over which the derivative is taken as a difference."""
_ALIKE = 0.02
"""Share of the largest effect of a parameter by which difference and derivative may differ: the terms beyond the
first, and 32 bits."""


@dataclass(frozen=True)
class Verdict:
    """Whether a model was accepted; `reason` is one line, `seconds` the median and the worst time of one
    inference."""

    accepted: bool
    reason: str
    model: Model | None = None
    median: float = math.nan
    worst: float = math.nan


def check_model(onnx: bytes, vehicle: Vehicle, deadline: float = 0.002) -> Verdict:
    """Check an ONNX file against `models.contract` and the vehicle; never raises, whatever the bytes.

    `deadline` in s is what one inference may take: the median of many runs must stay below half of it.
    """
    try:
        return _check(onnx, vehicle, deadline)
    except Refused as refusal:
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
    with contextlib.suppress(Refused):
        open_session(b"")


def open_model(onnx: bytes, info: ModelInfo, straight: bool = False) -> Model:
    """Open a file that was checked before, elsewhere; `straight` where its straight line was found to be the same.

    The golden vectors must come out here too, otherwise the runtime is loaded for it. Raises `InputError` where it does
    not open.
    """
    if contract.model_hash(onnx) != info.hash:
        raise InputError(f"model {info.hash}: the file on board is another one; deploy it again")
    try:
        if straight:
            with contextlib.suppress(NoStraightLine, Refused):
                model = Model(StraightLine(onnx, len(info.features), len(info.learnables)), info)
                meta = {bytes(e.key).decode(): bytes(e.value).decode() for e in decoded(onnx).metadata_props}
                _check_golden(model, meta)
                return model
        return Model(Runtime(open_session(onnx), len(info.features), len(info.learnables)), info)
    except Refused as refusal:
        raise InputError(f"model {info.hash}: {refusal}") from None


def _check(onnx: bytes, vehicle: Vehicle, deadline: float) -> Verdict:
    if len(onnx) > MAX_BYTES:
        raise Refused(f"the file has {len(onnx)} bytes; at most {MAX_BYTES} are accepted")
    reason = why_not_self_contained(onnx)
    if reason:
        raise Refused(reason)
    session = open_session(onnx)
    try:
        meta = dict(session.get_modelmeta().custom_metadata_map)
    except UnicodeDecodeError:
        raise Refused("its metadata are no text (UTF-8); export it again") from None
    for key in contract.REQUIRED_KEYS:
        if key not in meta:
            raise Refused(f"its metadata lack '{key}'; export it with `groundstation deploy`")
    if meta[contract.KEY_CONTRACT] != contract.CONTRACT_VERSION:
        raise Refused(
            f"it follows contract {shown(meta[contract.KEY_CONTRACT])}; this companion knows "
            f"{contract.CONTRACT_VERSION!r}"
        )
    metadata.check_vehicle(metadata.json_of(meta, contract.KEY_VEHICLE, dict), vehicle)
    ranges = metadata.ranges(metadata.json_of(meta, contract.KEY_FEATURES, list))
    learnables, noise = metadata.learnables(meta)
    _check_ports(session, len(ranges), len(learnables))
    info = ModelInfo(
        contract.model_hash(onnx),
        metadata.word(meta, contract.KEY_NAME),
        metadata.word(meta, contract.KEY_VERSION),
        ranges,
        metadata.chain(meta),
        metadata.word(meta, contract.KEY_DATA_HASH),
        metadata.actuation(meta),
        learnables,
        noise,
    )
    model = Model(Runtime(session, len(ranges), len(learnables)), info)
    _check_golden(model, meta)
    _check_range(model)
    model = _straightened(onnx, model)
    median, worst = _time(model)
    if not median <= 0.5 * deadline:
        raise Refused(
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


def _check_ports(session: onnxruntime.InferenceSession, features: int, parameters: int) -> None:
    """The graph's inputs and outputs: a second of each where, and only where, its metadata name what may be learnt."""
    given, answered = {contract.INPUT_NAME: features}, {contract.OUTPUT_NAME: 3}
    if parameters:
        given[contract.PARAMETERS_NAME] = parameters
        answered[contract.SENSITIVITY_NAME] = 3 * parameters
    for ports, expected in ((session.get_inputs(), given), (session.get_outputs(), answered)):
        if [port.name for port in ports] != list(expected):
            called = " and ".join(f"'{name}'" for name in expected)
            raise Refused(
                f"its ports are {shown([port.name for port in ports])}; expected "
                f"{'two' if parameters else 'one'} called {called}"
            )
        for port in ports:
            width, shape = expected[port.name], port.shape
            free = len(shape) == 2 and (shape[0] is None or isinstance(shape[0], str) or shape[0] == 1)
            if port.type != "tensor(float)" or not free or shape[1] not in (width, None):
                raise Refused(f"'{port.name}' is {port.type} {shape}; expected tensor(float) [N, {width}]")


def _run(model: Model, features: Sequence[float]) -> Sequence[float]:
    try:
        return model(features)
    except Exception as error:  # noqa: BLE001 - a graph may fail in as many ways as it has operators
        first = " ".join(str(error).split())[:160]
        raise Refused(f"it cannot be evaluated ({first})") from None


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
        raise Refused(f"it cannot be evaluated ({first})") from None


def _check_golden(model: Model, meta: dict[str, str]) -> None:
    tables = [(contract.KEY_GOLDEN_FEATURES, len(model.info.features)), (contract.KEY_GOLDEN_DELTA, 3)]
    learnt = len(model.info.learnables)
    if learnt:
        tables += [(contract.KEY_GOLDEN_PARAMETERS, learnt), (contract.KEY_GOLDEN_SENSITIVITY, 3 * learnt)]
    inputs, outputs, *more = metadata.golden(meta, tables)
    parameters, slopes = more or (np.zeros((len(inputs), 0)), np.zeros((len(inputs), 0)))
    for features, expected, numbers, derivatives in zip(inputs, outputs, parameters, slopes, strict=True):
        found, along = (np.array(one) for one in _sense(model, features.tolist(), numbers.tolist()))
        error = float(np.max(np.abs(found - expected)))
        if not error <= contract.GOLDEN_TOLERANCE:
            raise Refused(
                f"a golden vector differs by {error:.2g} m/s^2 (at most {contract.GOLDEN_TOLERANCE:g}): "
                "the file is damaged or this runtime computes something else"
            )
        scale = np.maximum(1.0, np.abs(derivatives))
        if learnt and not np.all(np.abs(along - derivatives) <= contract.GOLDEN_TOLERANCE * scale):
            raise Refused("its sensitivity differs from that of a golden vector: the file is damaged")
        if learnt:
            _check_slopes(model, features.tolist(), numbers, along)


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
            raise Refused(f"its sensitivity to {one.name} is not the derivative of its answer")


def _check_range(model: Model) -> None:
    """Finite at random points of the training range and at its corners, with any parameters that may be learnt."""
    for point, parameters in zip(_points(model.info), _parameters(model.info), strict=True):
        answers = [_run(model, point.tolist()), *_sense(model, point.tolist(), parameters.tolist())]
        if not all(np.all(np.isfinite(one)) for one in answers):
            raise Refused("it returns numbers that are not finite inside its own training range")


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
