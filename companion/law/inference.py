"""Deployed models as they fly: a model that answers rows of features, by a straight line or by ONNX Runtime.

What stands before that is in `companion.law.model_check`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation
from trueflight.companion.law.adaptation import Learning
from trueflight.companion.law.straight_line import StraightLine
from trueflight.companion.law.watch import ZERO, GuardLimits, Range, Vector, Watch
from trueflight.models import contract
from trueflight.models.learnable import Learnable

if TYPE_CHECKING:
    import onnxruntime

LOOK_ROWS = 4
"""Rows of features that a control tick asks for."""


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


class Refused(Exception):
    """A file that is not taken, with the reason in one line."""


def open_session(onnx: bytes) -> onnxruntime.InferenceSession:
    """A session of ONNX Runtime in one thread; raises `Refused` for bytes that are no model."""
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
        raise Refused(f"not an ONNX model that can be run here ({first})") from None


def cannot_learn(name: str) -> str:
    """Why a model does not fly `corrected_adaptive`, and what to do."""
    return f"nothing of model '{name}' can be learnt in flight; export it with --adaptive, or fly corrected"
