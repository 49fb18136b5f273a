"""A model's straight line computes what ONNX Runtime does, or there is none."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper
from onnx_models import RANGES, deep_model, drag_model, linear_model, packed

from trueflight.companion.law.inference import ModelInfo, Runtime, open_session
from trueflight.companion.law.model_check import SAME, check_model, open_model
from trueflight.companion.law.straight_line import NoStraightLine, StraightLine
from trueflight.models import contract
from trueflight.models.vehicle import load_vehicle

VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")
WIDTH = len(contract.FEATURES)
UNARY = ("Neg", "Reciprocal", "Sqrt", "Log", "Exp", "Asin", "Sin", "Cos", "Identity")
BINARY = ("Add", "Sub", "Mul", "Div")


class Drawn:
    """A graph of random operators on columns, as an export has them: features, constants, three columns out."""

    def __init__(self, seed: int, steps: int, network: bool, operators: tuple[str, ...] = ()) -> None:
        self._draw = np.random.default_rng(seed)
        self.nodes: list[Any] = []
        self.constants: dict[str, np.ndarray] = {"one": np.array([1], dtype=np.int64)}
        self.columns: list[str] = []
        for i in range(WIDTH):
            self.constants[f"i{i}"] = np.array(i, dtype=np.int64)
            self._add("Gather", [contract.INPUT_NAME, f"i{i}"], axis=1)
        known = (*UNARY, *BINARY, "Clip")
        for number in range(steps):
            self._operate(operators[number % len(operators)] if operators else str(self._draw.choice(known)))
        for i, name in enumerate(self._draw.choice(self.columns[-4:], 3)):
            self.nodes.append(helper.make_node("Unsqueeze", [name, "one"], [f"u{i}"]))
        out = "stack" if network else contract.OUTPUT_NAME
        self.nodes.append(helper.make_node("Concat", ["u0", "u1", "u2"], [out], axis=-1))
        if network:
            self._network()

    def file(self) -> bytes:
        """As an ONNX file of the contract; its golden vectors are what the runtime says."""
        onnx_file = packed(self.nodes, self.constants, lambda features: np.zeros((len(features), 3)))
        model = onnx.load_from_string(onnx_file)
        meta = {entry.key: entry for entry in model.metadata_props}
        golden = json.loads(meta[contract.KEY_GOLDEN_FEATURES].value)
        delta = Runtime(open_session(onnx_file), WIDTH)(golden)
        meta[contract.KEY_GOLDEN_DELTA].value = json.dumps([list(row) for row in delta])
        return bytes(model.SerializeToString())

    def _add(self, kind: str, given: list[str], **options: Any) -> None:
        name = f"c{len(self.columns)}"
        self.nodes.append(helper.make_node(kind, given, [name], **options))
        self.columns.append(name)

    def _operand(self) -> str:
        if self._draw.uniform() < 0.2:
            name = f"k{len(self.constants)}"
            self.constants[name] = np.array(self._draw.choice([0.0, 1.0, -0.5, 9.81]), dtype=np.float32)
            return name
        return str(self._draw.choice(self.columns))

    def _operate(self, kind: str) -> None:
        if kind in UNARY:
            self._add(kind, [str(self._draw.choice(self.columns))])
        elif kind in BINARY:
            self._add(kind, [str(self._draw.choice(self.columns)), self._operand()])
        else:
            self.constants |= {"low": np.array(-1.0, np.float32), "high": np.array(1.0, np.float32)}
            bounds = [["low", "high"], ["low"], ["", "high"]][self._draw.integers(3)]
            self._add(kind, [str(self._draw.choice(self.columns)), *bounds])

    def _network(self) -> None:
        sizes = (WIDTH, 7, 3)
        for number, (a, b) in enumerate(((sizes[0], sizes[1]), (sizes[1], sizes[2]))):
            self.constants[f"w{number}"] = self._draw.normal(size=(b, a)).astype(np.float32)
            self.constants[f"b{number}"] = self._draw.normal(size=b).astype(np.float32)
        self.nodes += [
            helper.make_node("Gemm", [contract.INPUT_NAME, "w0", "b0"], ["h0"], transB=1),
            helper.make_node("Relu", ["h0"], ["h1"]),
            helper.make_node("Gemm", ["h1", "w1", "b1"], ["h2"], transB=1),
            helper.make_node("Add", ["stack", "h2"], [contract.OUTPUT_NAME]),
        ]


def features(count: int, seed: int = 0) -> list[list[float]]:
    """Rows in the training range and well around it, where roots of negative numbers and the like come up."""
    low, high = np.array(list(RANGES.values())[:WIDTH]).T
    share = np.random.default_rng(seed).uniform(-0.5, 1.5, size=(count, WIDTH))
    found: list[list[float]] = (low + share * (high - low)).tolist()
    return found


@pytest.mark.parametrize("network", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_a_straight_line_answers_as_the_runtime_does_what_is_not_finite_included(
    seed: int, network: bool
) -> None:
    onnx_file = Drawn(seed, 14, network).file()
    straight, runtime = StraightLine(onnx_file, WIDTH), Runtime(open_session(onnx_file), WIDTH)
    for count in (1, 3):
        rows = features(30 * count, seed)
        for begin in range(0, len(rows), count):
            some = rows[begin : begin + count]
            for ours, theirs in zip(straight(some), runtime(some), strict=True):
                for a, b in zip(ours, theirs, strict=True):
                    if abs(b) < 1e4:  # beyond, 32 bits are too few to be compared, and no watch lets it pass
                        assert a == pytest.approx(b, rel=1e-3, abs=1e-3)
                    else:
                        assert not abs(a) < 5e3


def test_every_operator_of_the_list_was_tried() -> None:
    everything = (*UNARY, *BINARY, "Clip")
    onnx_file = Drawn(3, len(everything), False, everything).file()
    assert {node.op_type for node in onnx.load_from_string(onnx_file).graph.node} >= set(everything)
    StraightLine(onnx_file, WIDTH)


@pytest.mark.parametrize(
    ("file", "straight"),
    [
        (drag_model(0.2), True),
        (linear_model(np.full((WIDTH, 3), 0.01), extra_nodes=2), False),  # a sine of a matrix
        (deep_model(8, 2), False),  # tanh
    ],
)
def test_the_check_finds_a_straight_line_where_there_is_one_and_takes_the_runtime_otherwise(
    file: bytes, straight: bool
) -> None:
    model = check_model(file, VEHICLE).model
    assert model is not None and model.straight is straight
    rows = features(3)
    np.testing.assert_allclose(model.rows(rows), Runtime(open_session(file), WIDTH)(rows), atol=SAME)


def changed(file: bytes, change: Any) -> bytes:
    model = onnx.load_from_string(file)
    change(model.graph)
    return bytes(model.SerializeToString())


def test_names_in_a_file_never_get_into_what_is_compiled() -> None:
    def rename(graph: Any) -> None:
        wicked = "v0; __import__('os')._exit(3) #"
        for node in graph.node:
            for names in (node.input, node.output):
                for i, name in enumerate(names):
                    names[i] = wicked if name == "c12" else name

    file = Drawn(4, 10, False).file()
    again = StraightLine(changed(file, rename), WIDTH)
    assert repr(again(features(3))) == repr(StraightLine(file, WIDTH)(features(3)))


@pytest.mark.parametrize(
    "change",
    [
        lambda graph: graph.node[0].attribute[0].__setattr__("i", 0),  # a Gather along the rows
        lambda graph: graph.node[WIDTH].__setattr__("op_type", "Erf"),
        lambda graph: graph.node[WIDTH].__setattr__("domain", "com.microsoft"),
        lambda graph: graph.node[WIDTH].output.__setitem__(0, "c0"),
        lambda graph: graph.initializer[1].dims.append(2),
        lambda graph: graph.initializer[1].__setattr__("raw_data", (99).to_bytes(8, "little")),
    ],
)
def test_what_is_not_on_the_list_has_no_straight_line(change: Any) -> None:
    file = Drawn(5, 3, False, ("Mul", "Add", "Neg")).file()
    StraightLine(file, WIDTH)
    with pytest.raises(NoStraightLine):
        StraightLine(changed(file, change), WIDTH)


def fading_file(
    share: tuple[str, ...] = ("Gemm", "Relu"), order: tuple[str, str] = ("three", "share"), width: int = 1
) -> bytes:
    """A network times the share of it that acts, which comes from the same layer."""
    draw = np.random.default_rng(0)
    constants = {
        "w": 0.1 * draw.normal(size=(7, WIDTH)), "d": draw.normal(size=(3, 7)), "s": draw.normal(size=(width, 7)),
        "c": np.full(width, 0.5), "b": np.zeros(3),
    }  # fmt: skip
    nodes = [
        helper.make_node("Gemm", [contract.INPUT_NAME, "w"], ["h0"], transB=1),
        helper.make_node("Relu", ["h0"], ["h"]),
        helper.make_node("Gemm", ["h", "d", "b"], ["three"], transB=1),
        helper.make_node("Gemm", ["h", "s", "c"], ["s0" if len(share) > 1 else "share"], transB=1),
    ]
    nodes += [helper.make_node(kind, ["s0"], ["share"]) for kind in share[1:]]
    nodes.append(helper.make_node("Mul", list(order), [contract.OUTPUT_NAME]))
    floats = {name: np.asarray(value, dtype=np.float32) for name, value in constants.items()}
    return packed(nodes, floats, lambda features: np.zeros((len(features), 3)))


def test_a_network_that_fades_is_a_straight_line_and_what_only_looks_like_one_is_not() -> None:
    rows = features(60)
    wanted = np.array([Runtime(open_session(fading_file()), WIDTH)([row])[0] for row in rows])
    np.testing.assert_allclose(StraightLine(fading_file(), WIDTH)(rows), wanted, atol=1e-4)
    assert np.any(np.all(wanted == 0.0, axis=1)) and np.any(wanted != 0.0)
    for other in (
        fading_file(("Gemm",)),
        fading_file(order=("share", "three")),
        fading_file(order=("three", "three")),
        fading_file(width=3),
    ):
        with pytest.raises(NoStraightLine):
            StraightLine(other, WIDTH)

    def from_the_features(graph: Any) -> None:
        graph.node[3].input[0] = contract.INPUT_NAME

    with pytest.raises(NoStraightLine):
        StraightLine(changed(fading_file(), from_the_features), WIDTH)


def test_constants_that_are_not_finite_have_no_straight_line() -> None:
    drawn = Drawn(6, 1, False, ("Neg",))
    drawn.constants["bad"] = np.array(math.inf, dtype=np.float32)
    drawn.nodes[WIDTH] = helper.make_node("Add", ["c0", "bad"], [drawn.nodes[WIDTH].output[0]])
    file = packed(drawn.nodes, drawn.constants, lambda features: np.zeros((len(features), 3)))
    with pytest.raises(NoStraightLine):
        StraightLine(file, WIDTH)


def test_golden_vectors_that_do_not_come_out_bring_the_runtime_back() -> None:
    file = linear_model(
        np.zeros((WIDTH, 3)), golden_error=1.0
    )  # what the check in its own process would refuse
    info = ModelInfo(contract.model_hash(file), "", "", check_ranges())
    assert not open_model(file, info, straight=True).straight
    fine = drag_model(0.1)
    assert open_model(fine, ModelInfo(contract.model_hash(fine), "", "", check_ranges()), True).straight


def check_ranges() -> Any:
    model = check_model(drag_model(0.1), VEHICLE).model
    assert model is not None
    return model.info.features


def test_a_checked_model_flies_without_the_runtime_in_the_process(tmp_path: Path) -> None:
    (tmp_path / "model.onnx").write_bytes(drag_model(0.1))
    code = f"""
import sys
from pathlib import Path
from trueflight.companion.store import ModelStore
from trueflight.models.contract import model_hash
from trueflight.models.vehicle import load_vehicle
onnx = Path({str(tmp_path / "model.onnx")!r}).read_bytes()
store = ModelStore(Path({str(tmp_path / "models")!r}), load_vehicle({str(VEHICLE.source)!r}), 0.01)
assert store.stage(onnx).accepted and store.commit(model_hash(onnx)) == ""
assert store.live.watched().look([[1.0] * {WIDTH}] * 4, 0.02, 0.01)
assert store.live.straight and "onnxruntime" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120.0)
