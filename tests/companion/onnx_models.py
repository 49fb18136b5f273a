"""Small ONNX models made with the onnx package, as the ground would deliver them or worse."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from trueflight.companion.store import ModelStore
from trueflight.models import contract

RANGES = {
    "z": (0.0, 4.0),
    "cos_phi": (0.7, 1.0),
    "sin_phi": (-0.7, 0.7),
    "cos_theta": (0.7, 1.0),
    "sin_theta": (-0.7, 0.7),
    "vx": (-5.0, 5.0),
    "vy": (-5.0, 5.0),
    "vz": (-4.0, 4.0),
    "u_batt": (13.0, 17.0),
    "T": (1.0, 17.0),
    "cos_psi": (-1.0, 1.0),
    "sin_psi": (-1.0, 1.0),
}
VEHICLE = {"name": "quad5", "mass": 0.75, "hover_thrust": 0.38}


def linear_model(
    weights: np.ndarray,
    bias: Sequence[float] = (0.0, 0.0, 0.0),
    metadata: dict[str, Any] | None = None,
    drop: str = "",
    extra_nodes: int = 0,
    input_name: str = contract.INPUT_NAME,
    golden_error: float = 0.0,
) -> bytes:
    """`delta = features @ weights + bias` with metadata; `metadata` replaces, `drop` removes one."""
    weights = np.asarray(weights, dtype=np.float32)
    width = len(weights)
    nodes = [helper.make_node("MatMul", [input_name, "w"], ["h0"])]
    nodes += [helper.make_node("Sin", [f"h{i}"], [f"h{i + 1}"]) for i in range(extra_nodes)]
    nodes.append(helper.make_node("Add", [f"h{extra_nodes}", "b"], [contract.OUTPUT_NAME]))

    def values(features: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            delta = features @ weights
        for _ in range(extra_nodes):
            delta = np.sin(delta)
        return delta + np.asarray(bias, dtype=np.float32) + golden_error

    constants = {"w": weights, "b": np.asarray(bias, dtype=np.float32)}
    return packed(nodes, constants, values, width, metadata, drop, input_name)


def packed(
    nodes: list[Any],
    constants: dict[str, np.ndarray],
    values_of: Callable[[np.ndarray], np.ndarray],
    width: int = len(contract.FEATURES),
    metadata: dict[str, Any] | None = None,
    drop: str = "",
    input_name: str = contract.INPUT_NAME,
) -> bytes:
    """A graph as a file of the contract; `values_of` computes its golden outputs from its golden inputs."""
    names = [*contract.FEATURES, *contract.YAW_FEATURES][:width]
    units = {**contract.FEATURES, **contract.YAW_FEATURES}
    graph = helper.make_graph(
        nodes,
        "delta",
        [helper.make_tensor_value_info(input_name, TensorProto.FLOAT, ["N", width])],
        [helper.make_tensor_value_info(contract.OUTPUT_NAME, TensorProto.FLOAT, ["N", 3])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    features = np.random.default_rng(3).uniform(
        [RANGES[n][0] for n in names], [RANGES[n][1] for n in names], size=(4, width)
    )
    delta = values_of(features.astype(np.float32))
    values = {
        contract.KEY_CONTRACT: contract.CONTRACT_VERSION,
        contract.KEY_NAME: "linear",
        contract.KEY_VERSION: "1",
        contract.KEY_VEHICLE: VEHICLE,
        contract.KEY_FEATURES: [
            {"name": n, "unit": units[n], "low": RANGES[n][0], "high": RANGES[n][1]} for n in names
        ],
        contract.KEY_CHAIN: [{"effect": "rotor_drag", "parameters": {"x": 0.2}}],
        contract.KEY_DATA_HASH: "0" * 64,
        contract.KEY_GOLDEN_FEATURES: features.tolist(),
        contract.KEY_GOLDEN_DELTA: delta.tolist(),
        **(metadata or {}),
    }
    for key, value in values.items():
        if key != drop:
            entry = model.metadata_props.add()
            entry.key, entry.value = key, value if isinstance(value, str) else json.dumps(value)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def constant_model(x: float, y: float, z: float, **changes: Any) -> bytes:
    """A model that always returns the same error acceleration (m/s², heading frame)."""
    return linear_model(np.zeros((len(contract.FEATURES), 3)), (x, y, z), **changes)


def drag_model(drag: float, **changes: Any) -> bytes:
    """A model of linear drag in the heading frame: `delta = -drag (vx, vy, 0)`."""
    weights = np.zeros((len(contract.FEATURES), 3))
    names = list(contract.FEATURES)
    weights[names.index("vx"), 0] = weights[names.index("vy"), 1] = -drag
    return linear_model(weights, **changes)


def nan_model(drag: float, limit: float) -> bytes:
    """Drag that becomes not a number where vx is above `limit` (m/s), the end of its stated training range."""
    names = list(contract.FEATURES)
    weights = np.zeros((len(names), 3), dtype=np.float32)
    weights[names.index("vx"), 0] = weights[names.index("vy"), 1] = -drag
    pick = np.zeros((len(names), 1), dtype=np.float32)
    pick[names.index("vx")] = -1.0
    nodes = [
        helper.make_node("MatMul", [contract.INPUT_NAME, "pick"], ["backward"]),
        helper.make_node("Add", ["backward", "limit"], ["left"]),
        helper.make_node("Sqrt", ["left"], ["root"]),
        helper.make_node("Mul", ["root", "nothing"], ["none"]),
        helper.make_node("MatMul", [contract.INPUT_NAME, "w"], ["drag"]),
        helper.make_node("Add", ["drag", "none"], [contract.OUTPUT_NAME]),
    ]
    constants = {
        "pick": pick,
        "limit": np.array([limit], dtype=np.float32),
        "nothing": np.zeros((1, 3), dtype=np.float32),
        "w": weights,
    }
    golden = np.zeros((3, len(names)))
    ranges = [
        {
            "name": name,
            "unit": unit,
            "low": -limit if name == "vx" else RANGES[name][0],
            "high": limit if name == "vx" else RANGES[name][1],
        }
        for name, unit in contract.FEATURES.items()
    ]
    metadata = {
        contract.KEY_FEATURES: ranges,
        contract.KEY_GOLDEN_FEATURES: golden.tolist(),
        contract.KEY_GOLDEN_DELTA: np.zeros((3, 3)).tolist(),
    }
    return packed(nodes, constants, lambda features: features @ weights, metadata=metadata)


def bang_bang_model(size: float) -> bytes:
    """A damper that knows two answers: `size` m/s² against the direction of flight, however slow it is."""
    names = list(contract.FEATURES)
    weights = np.zeros((len(names), 3), dtype=np.float32)
    weights[names.index("vx"), 0] = weights[names.index("vy"), 1] = 20.0
    nodes = [
        helper.make_node("MatMul", [contract.INPUT_NAME, "w"], ["h"]),
        helper.make_node("Tanh", ["h"], ["side"]),
        helper.make_node("Mul", ["side", "size"], [contract.OUTPUT_NAME]),
    ]
    constants = {"w": weights, "size": np.array([-size], dtype=np.float32)}
    return packed(nodes, constants, lambda features: -size * np.tanh(features @ weights))


def deep_model(width: int = 800, depth: int = 40) -> bytes:
    """A network of `depth` equal layers: it keeps to the contract, and takes milliseconds."""
    rng = np.random.default_rng(5)
    constants = {
        "first": rng.normal(size=(len(contract.FEATURES), width)).astype(np.float32) / 10.0,
        "layer": rng.normal(size=(width, width)).astype(np.float32) / width**0.5,
        "last": np.zeros((width, 3), dtype=np.float32),
    }
    nodes = [helper.make_node("MatMul", [contract.INPUT_NAME, "first"], ["h0"])]
    for i in range(depth):
        nodes.append(helper.make_node("MatMul", [f"h{i}", "layer"], [f"m{i}"]))
        nodes.append(helper.make_node("Tanh", [f"m{i}"], [f"h{i + 1}"]))
    nodes.append(helper.make_node("MatMul", [f"h{depth}", "last"], [contract.OUTPUT_NAME]))
    return packed(nodes, constants, lambda features: np.zeros((len(features), 3)))


def endless_model() -> bytes:
    """A graph that counts to 2^62 before it answers."""
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["go_on"]),
            helper.make_node("Identity", ["held"], ["kept"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("held", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("kept", TensorProto.FLOAT, None),
        ],
    )
    nodes = [
        helper.make_node("MatMul", [contract.INPUT_NAME, "w"], ["h"]),
        helper.make_node("Loop", ["often", "", "h"], [contract.OUTPUT_NAME], body=body),
    ]
    constants = {
        "w": np.zeros((len(contract.FEATURES), 3), dtype=np.float32),
        "often": np.array(2**62, dtype=np.int64),
    }
    return packed(nodes, constants, lambda features: np.zeros((len(features), 3)))


def greedy_model() -> bytes:
    """A graph that wants 40 GB to answer."""
    nodes = [
        helper.make_node("Expand", ["one", "shape"], ["much"]),
        helper.make_node("ReduceSum", ["much"], ["sum"], keepdims=0),
        helper.make_node("Mul", ["sum", "zero"], ["nothing"]),
        helper.make_node("MatMul", [contract.INPUT_NAME, "w"], ["h"]),
        helper.make_node("Add", ["h", "nothing"], [contract.OUTPUT_NAME]),
    ]
    constants = {
        "one": np.ones(1, dtype=np.float32),
        "shape": np.array([10**5, 10**5], dtype=np.int64),
        "zero": np.zeros(1, dtype=np.float32),
        "w": np.zeros((len(contract.FEATURES), 3), dtype=np.float32),
    }
    return packed(nodes, constants, lambda features: np.zeros((len(features), 3)))


def make_live(store: ModelStore, onnx: bytes) -> str:
    """Stage a model and commit it, as a flight does in which it has proved itself; its hash."""
    finding = store.stage(onnx)
    assert finding.accepted, finding.reason
    name = contract.model_hash(onnx)
    assert store.commit(name) == ""
    return name
