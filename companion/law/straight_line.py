"""A model without a runtime: the graph of its ONNX file written out as straight-line arithmetic.

Effects are some 140 operations on single numbers, and ONNX Runtime takes longer to go from one to the next than to
compute it. Here each becomes one line of Python, on 64-bit floats, and a network's layers become products of numpy,
on 32-bit ones. What is compiled is made from the closed list of operators below alone: variables are numbered,
constants are printed numbers, and no text of the file ever gets into it. A graph with anything else has no straight
line, and ONNX Runtime flies it.

The arithmetic is IEEE 754's, as the runtime's is: what divides by nothing is infinite, what has no root is not a
number, and nothing raises; the watch over the model decides what becomes of such an answer. That it computes what the
runtime does is not believed but tried, whenever a model is checked, by `companion.law.inference`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from struct import Struct
from typing import Any, NamedTuple

import numpy as np

from trueflight.companion.law.onnx_structure import decoded
from trueflight.models import contract

_MOST_NODES = 2000
_FLOAT32, _INT64 = 1, 7  # onnx.TensorProto.DataType
_LARGEST = 3.0e38  # of 32 bits: what is larger is infinite for the runtime

Rows = Sequence[Sequence[float]]


class NoStraightLine(Exception):
    """The graph holds something that is not written out here; the reason in words."""


def _quotient(a: float, b: float) -> float:
    if b != 0.0:
        return a / b
    if a == 0.0 or a != a:
        return math.nan
    return math.copysign(math.inf, a) * math.copysign(1.0, b)


def _root(a: float) -> float:
    return math.sqrt(a) if a >= 0.0 else math.nan


def _logarithm(a: float) -> float:
    if a > 0.0:
        return math.log(a)
    return -math.inf if a == 0.0 else math.nan


def _exponential(a: float) -> float:
    return (
        math.exp(a) if a < 88.7 else (math.inf if a == a else math.nan)
    )  # the runtime's own, of 32 bits, ends there


def _arc_sine(a: float) -> float:
    return math.asin(a) if -1.0 <= a <= 1.0 else math.nan


def _sine(a: float) -> float:
    return math.sin(a) if abs(a) < _LARGEST else math.nan


def _cosine(a: float) -> float:
    return math.cos(a) if abs(a) < _LARGEST else math.nan


_FUNCTIONS: dict[str, Callable[..., float]] = {
    "quotient": _quotient,
    "root": _root,
    "logarithm": _logarithm,
    "exponential": _exponential,
    "arc_sine": _arc_sine,
    "sine": _sine,
    "cosine": _cosine,
}
_OPERATORS: dict[str, tuple[int, str]] = {
    "Add": (2, "{0} + {1}"),
    "Sub": (2, "{0} - {1}"),
    "Mul": (2, "{0} * {1}"),
    "Div": (2, "{0} / {1} if {1} else quotient({0}, {1})"),
    "Neg": (1, "-{0}"),
    "Reciprocal": (1, "1.0 / {0} if {0} else quotient(1.0, {0})"),
    "Sqrt": (1, "root({0})"),
    "Log": (1, "logarithm({0})"),
    "Exp": (1, "exponential({0})"),
    "Asin": (1, "arc_sine({0})"),
    "Sin": (1, "sine({0})"),
    "Cos": (1, "cosine({0})"),
    "Identity": (1, "{0}"),
    "Greater": (2, "{0} > {1}"),
    "Less": (2, "{0} < {1}"),
    "And": (2, "{0} and {1}"),
    "Where": (3, "{1} if {0} else {2}"),
}
"""What may be written out for columns of single numbers; `Clip`, `Gather`, `Unsqueeze` and `Concat` beside them."""


class StraightLine:
    """The graph of one file; call it with rows of features for three accelerations each (m/s², heading frame).

    A graph of a model that learns takes as many `parameters`, and has a second output, `sensed`. One thread at a time.
    Raises `NoStraightLine` where the graph holds what is not written out.
    """

    def __init__(self, onnx: bytes, width: int, parameters: int = 0) -> None:
        graph = _Graph(decoded(onnx).graph, width, parameters)
        self._known, self._slopes = graph.function(), graph.slopes()
        layers, self._fades = graph.layers, graph.fades
        self._network = _Network(layers, width) if layers else None

    def __call__(self, rows: Rows, parameters: Sequence[float] = ()) -> Sequence[Sequence[float]]:
        """Three accelerations for each row."""
        learnt: Sequence[Sequence[float]]
        known, network = self._known, self._network
        if network is None:
            return [known(row, parameters) for row in rows]
        learnt = network.rows(rows)
        if self._fades:
            learnt = [_faded(*row) for row in learnt]
        if known is _nothing:
            return learnt
        both: list[Sequence[float]] = []
        for row, (u, v, w) in zip(rows, learnt, strict=True):
            x, y, z = known(row, parameters)
            both.append((x + u, y + v, z + w))
        return both

    def sensed(
        self, row: Sequence[float], parameters: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float]]:
        """Three accelerations of a row, and their derivatives along each parameter, three by three."""
        assert self._slopes is not None
        x, y, z, *slopes = self._slopes(row, parameters)
        if self._network is not None:
            (learnt,) = self._network.rows((row,))
            u, v, w = _faded(*learnt) if self._fades else learnt
            x, y, z = x + u, y + v, z + w
        return (x, y, z), slopes


def _nothing(row: Sequence[float], parameters: Sequence[float]) -> Sequence[float]:
    return 0.0, 0.0, 0.0


def _faded(x: float, y: float, z: float, share: float) -> tuple[float, float, float]:
    if share <= 0.0:  # false for NaN: that stays it, and so does what is infinite
        share = 0.0
    return share * x, share * y, share * z


Layer = tuple[np.ndarray, np.ndarray, bool]
"""Weights (F, K), biases (K,), and whether a rectifier follows."""


class _Network:
    """Layers on rows of features, in 32 bits, the last one with three outputs or, where it fades, four; biases are a
    last row of the weights, for inputs that end with 1."""

    def __init__(self, layers: Sequence[Layer], width: int) -> None:
        self._layers = []
        for number, (weights, biases, rectified) in enumerate(layers):
            last = number == len(layers) - 1
            inputs, units = weights.shape
            whole = np.zeros((inputs + 1, units + (not last)), dtype=np.float32)
            whole[:inputs, :units], whole[inputs, :units] = weights, biases
            if not last:
                whole[inputs, units] = 1.0
            self._layers.append((whole, rectified))
        self._width = width
        self._rooms: dict[int, _Room] = {}

    def rows(self, rows: Rows) -> list[list[float]]:
        """The last layer's outputs for each row."""
        room = self._rooms.get(len(rows))
        if room is None:
            room = self._rooms[len(rows)] = _Room(self._layers, self._width, len(rows))
        return room.answer(rows)


class _Room:
    """A network's numbers for so many rows: nothing is made anew while it flies."""

    def __init__(self, layers: Sequence[tuple[np.ndarray, bool]], width: int, rows: int) -> None:
        given = np.ones((rows, width + 1), dtype=np.float32)
        self._given = memoryview(given.data).cast("B")
        self._pack = Struct(f"{given.size}f").pack_into  # half the time of an assignment
        self._steps = []
        for weights, rectified in layers:
            then = np.zeros((rows, weights.shape[1]), dtype=np.float32)
            self._steps.append((given.dot, weights, then, np.zeros_like(then) if rectified else None))
            given = then
        self._answer = given.tolist

    def answer(self, rows: Rows) -> list[list[float]]:
        """The last layer's outputs for each row."""
        flat: list[float] = []
        for row in rows:
            flat += row
            flat.append(1.0)
        self._pack(self._given, 0, *flat)
        for dot, weights, then, zero in self._steps:
            dot(weights, then)
            if zero is not None:
                np.maximum(then, zero, out=then)
        return self._answer()


Columns = Callable[[Sequence[float], Sequence[float]], Sequence[float]]
"""A function of a row of features and of parameters."""


class _Line(NamedTuple):
    """One line of code: a variable, what it is, and the variables in that."""

    name: str
    text: str
    uses: tuple[str, ...]


class _Graph:
    """What a graph is made of: columns of single numbers as lines of code, and one chain of layers."""

    def __init__(self, graph: Any, width: int, parameters: int = 0) -> None:
        self._width, self._parameters = width, parameters
        self._constants = {bytes(tensor.name): tensor for tensor in graph.initializer}
        self._lines: list[_Line] = []
        self._columns: dict[bytes, str] = {}
        self._matrices: dict[bytes, list[Layer]] = {contract.INPUT_NAME.encode(): []}
        self._unsqueezed: dict[bytes, str] = {}
        self._stacks: dict[bytes, list[str]] = {}
        self._faded: dict[bytes, list[Layer]] = {}
        self._sum: tuple[list[str], bytes] | None = None
        if graph.sparse_initializer or not 0 < len(graph.node) <= _MOST_NODES:
            raise NoStraightLine(f"a graph of {len(graph.node)} nodes, or with sparse constants")
        for node in graph.node:
            self._take(node)
        self._stack, learnt = self._answer()
        self.fades = learnt in self._faded
        self.layers = self._ended(learnt) if learnt else []

    def function(self) -> Columns:
        """From one row of features, and parameters, to what the columns add to the answer."""
        return self._written(self._stack) if self._stack else _nothing

    def slopes(self) -> Columns | None:
        """The same followed by its derivatives; None where the graph has no parameters."""
        if not self._parameters:
            return None
        slopes = self._stacks.get(contract.SENSITIVITY_NAME.encode(), [])
        if not self._stack or len(slopes) != 3 * self._parameters:
            raise NoStraightLine("a sensitivity of other than three columns for each parameter")
        return self._written([*self._stack, *slopes])

    def _written(self, columns: Sequence[str]) -> Columns:
        """A function of the lines that these columns need."""
        needed, lines = set(columns), []
        for line in reversed(self._lines):
            if line.name in needed:
                needed.update(line.uses)
                lines.append(f"{line.name} = {line.text}")
        text = "\n    ".join(["def known(f, p):", *reversed(lines), f"return {', '.join(columns)}"])
        names: dict[str, Any] = {"__builtins__": {}, **_FUNCTIONS}
        exec(compile(text, "<straight line>", "exec"), names)  # of the operators above alone
        known: Columns = names["known"]
        return known

    def _answer(self) -> tuple[list[str], bytes]:
        """The three columns, and the name of the network, whose sum is the graph's output."""
        name = contract.OUTPUT_NAME.encode()
        if self._sum is not None:
            return self._sum
        if name in self._stacks:
            return self._stacks[name], b""
        if self._matrices.get(name) or name in self._faded:
            return [], name
        raise NoStraightLine("an output that is neither three columns nor a chain of layers")

    def _ended(self, name: bytes) -> list[Layer]:
        """The layers of a network of this name: three outputs, and the share of one that fades."""
        if name in self._faded:
            return self._faded[name]
        layers = self._matrices[name]
        if layers[-1][0].shape[1] != 3:
            raise NoStraightLine("a network with other than three outputs")
        return layers

    def _take(self, node: Any) -> None:
        kind = bytes(node.op_type).decode("ascii", "replace")
        given = [bytes(name) for name in node.input]
        if node.domain or len(node.output) != 1 or not given:
            raise NoStraightLine(f"a node {kind} that is not a plain operator")
        out = bytes(node.output[0])
        taken = (self._columns, self._matrices, self._faded, self._stacks, self._constants)
        if any(out in names for names in taken):
            raise NoStraightLine("a name that is given twice")
        options = {bytes(one.name): one for one in node.attribute}
        if kind == "Gather":
            self._gather(out, given, options)
        elif kind == "Unsqueeze":
            self._unsqueeze(out, given)
        elif kind == "Concat":
            self._concat(out, given, options)
        elif any(name in self._matrices or name in self._stacks or name in self._faded for name in given):
            self._matrix(kind, out, given, options)
        else:
            self._column(kind, out, given, options)

    def _gather(self, out: bytes, given: list[bytes], options: dict[bytes, Any]) -> None:
        """One feature or one parameter: `features[:, i]`."""
        whole = self._whole(given[1]) if len(given) == 2 else None
        along = set(options) == {b"axis"} and options[b"axis"].i == 1
        inputs = {
            contract.INPUT_NAME.encode(): ("f", self._width),
            contract.PARAMETERS_NAME.encode(): ("p", self._parameters),
        }
        letter, width = inputs.get(given[0], ("", 0))
        if not along or whole is None or len(whole) != 1 or not 0 <= whole[0] < width:
            raise NoStraightLine("a Gather of other than one feature or parameter")
        if self._constants[given[1]].dims:
            raise NoStraightLine("a Gather that keeps the axis")
        self._define(out, f"{letter}[{whole[0]}]")

    def _unsqueeze(self, out: bytes, given: list[bytes]) -> None:
        if len(given) != 2 or given[0] not in self._columns or self._whole(given[1]) not in ([-1], [1]):
            raise NoStraightLine("an Unsqueeze of other than a column")
        self._unsqueezed[out] = self._columns[given[0]]

    def _concat(self, out: bytes, given: list[bytes], options: dict[bytes, Any]) -> None:
        axis = set(options) == {b"axis"} and options[b"axis"].i in (-1, 1)
        width = 3 * self._parameters if out == contract.SENSITIVITY_NAME.encode() else 3
        if not axis or len(given) != width or not all(name in self._unsqueezed for name in given):
            raise NoStraightLine(f"a Concat of other than {width} columns")
        self._stacks[out] = [self._unsqueezed[name] for name in given]

    def _matrix(self, kind: str, out: bytes, given: list[bytes], options: dict[bytes, Any]) -> None:
        """Another layer, what follows one, or the sum of the three columns and the layers."""
        before = self._matrices.get(given[0])
        if kind == "Add" and len(given) == 2:
            stack, other = (given[0], given[1]) if given[0] in self._stacks else (given[1], given[0])
            whole = self._matrices.get(other) or other in self._faded
            if stack in self._stacks and whole and out == contract.OUTPUT_NAME.encode():
                self._sum = self._stacks[stack], other
                return
        if kind == "Mul" and len(given) == 2 and given[1] in self._matrices:
            self._fade(out, self._matrices.get(given[0], []), self._matrices[given[1]])
            return
        if before is None:
            raise NoStraightLine(f"{kind} of a matrix")
        if kind == "Relu" and len(given) == 1 and before and not before[-1][2]:
            weights, biases, _ = before[-1]
            self._matrices[out] = [*before[:-1], (weights, biases, True)]
        elif (kind == "Gemm" and len(given) in (2, 3)) or (kind == "MatMul" and len(given) == 2):
            layer = self._gemm(given, options if kind == "Gemm" else {})
            if layer[0].shape[0] != (before[-1][0].shape[1] if before else self._width):
                raise NoStraightLine("layers that do not fit to each other")
            self._matrices[out] = [*before, layer]
        elif kind == "Add" and len(given) == 2 and before and not before[-1][2]:
            weights, biases, _ = before[-1]
            more = self._numbers(given[1], 1)
            if more.shape != biases.shape:
                raise NoStraightLine("an Add of another shape")
            self._matrices[out] = [*before[:-1], (weights, biases + more, False)]
        else:
            raise NoStraightLine(f"{kind} of a matrix")

    def _fade(self, out: bytes, network: list[Layer], share: list[Layer]) -> None:
        """Three outputs times a fourth, rectified one: the heads of the same layers, in this order."""
        heads = bool(network) and bool(share) and len(network) == len(share)
        if not heads or any(a is not b for a, b in zip(network[:-1], share[:-1], strict=True)):
            raise NoStraightLine("a product of networks that are not the same up to their last layer")
        (weights, biases, rectified), (more, bias, cut) = network[-1], share[-1]
        if (len(biases), len(bias)) != (3, 1) or rectified or not cut:
            raise NoStraightLine("a product of other than three outputs and a rectified fourth")
        last = np.concatenate([weights, more], axis=1), np.concatenate([biases, bias]), False
        self._faded[out] = [*network[:-1], last]

    def _gemm(self, given: list[bytes], options: dict[bytes, Any]) -> Layer:
        """Weights and biases; `alpha` and `beta` of 1, which torch leaves out or, with them, 0 as `i` and 1 as `f`."""
        if not set(options) <= {b"alpha", b"beta", b"transA", b"transB"}:
            raise NoStraightLine("a Gemm with unknown options")
        if any(options[name].f != 1.0 for name in (b"alpha", b"beta") if name in options):
            raise NoStraightLine("a Gemm that scales")
        if b"transA" in options and options[b"transA"].i:
            raise NoStraightLine("a Gemm of a turned input")
        weights = self._numbers(given[1], 2)
        if b"transB" in options and options[b"transB"].i:
            weights = np.ascontiguousarray(weights.T)
        biases = self._numbers(given[2], 1) if len(given) == 3 else np.zeros(weights.shape[1], np.float32)
        if biases.shape != weights.shape[1:]:
            raise NoStraightLine("a Gemm with biases of another shape")
        return weights, biases, False

    def _column(self, kind: str, out: bytes, given: list[bytes], options: dict[bytes, Any]) -> None:
        if options:
            raise NoStraightLine(f"a {kind} with options")
        if kind == "Clip":
            self._clip(out, given)
            return
        if kind not in _OPERATORS or _OPERATORS[kind][0] != len(given):
            raise NoStraightLine(f"the operator {kind}")
        operands = [self._operand(name) for name in given]
        self._define(out, _OPERATORS[kind][1].format(*operands), operands)

    def _clip(self, out: bytes, given: list[bytes]) -> None:
        if not 1 <= len(given) <= 3:
            raise NoStraightLine("a Clip without an input")
        value = self._operand(given[0])
        bounds = [self._operand(name) if name else "" for name in (*given[1:], b"", b"")][:2]
        text = value
        if bounds[1]:
            text = f"{bounds[1]} if {value} > {bounds[1]} else {text}"
        if bounds[0]:  # what is not a number stays it
            text = f"{bounds[0]} if {value} < {bounds[0]} else {text}"
        self._define(out, text, [value, *bounds])

    def _define(self, out: bytes, text: str, uses: Sequence[str] = ()) -> None:
        name = f"v{len(self._columns)}"
        self._lines.append(_Line(name, text, tuple(uses)))
        self._columns[out] = name

    def _operand(self, name: bytes) -> str:
        """A variable, or a constant as a printed number."""
        if name in self._columns:
            return self._columns[name]
        (value,) = self._numbers(name, 0).tolist()
        return f"({value!r})"

    def _whole(self, name: bytes) -> list[int] | None:
        """A short constant of whole numbers; None where it is none."""
        tensor = self._constants.get(name)
        if tensor is None or tensor.data_type != _INT64 or len(tensor.dims) > 1 or tensor.external_data:
            return None
        if len(tensor.raw_data) > 64 or len(tensor.raw_data) % 8:
            return None
        return np.frombuffer(tensor.raw_data, "<i8").tolist() if tensor.raw_data else list(tensor.int64_data)

    def _numbers(self, name: bytes, axes: int) -> np.ndarray:
        """A finite constant of 32-bit numbers with so many axes (0: one number, as an array (1,))."""
        tensor = self._constants.get(name)
        if tensor is None or tensor.data_type != _FLOAT32 or tensor.external_data or len(tensor.dims) > 2:
            raise NoStraightLine("an operand that is neither a column nor a constant of 32-bit numbers")
        shape = tuple(int(size) for size in tensor.dims)
        given = tensor.raw_data or np.array(tensor.float_data, "<f4").tobytes()
        if any(size < 1 for size in shape) or 4 * math.prod(shape) != len(given):
            raise NoStraightLine("a constant with another count of numbers than its shape")
        numbers = np.frombuffer(given, "<f4").astype(np.float32)
        fits = len(shape) == axes if axes else numbers.size == 1 and len(shape) < 2
        if not fits or not np.all(np.isfinite(numbers)):
            raise NoStraightLine("a constant of another shape, or that is not finite")
        return numbers.reshape(shape) if axes else numbers.reshape(1)
