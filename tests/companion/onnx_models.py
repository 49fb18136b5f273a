"""Small ONNX models made with the onnx package, as the ground would deliver them or worse."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from models import contract

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
    names = [*contract.FEATURES, *contract.YAW_FEATURES][:width]
    units = {**contract.FEATURES, **contract.YAW_FEATURES}
    nodes = [helper.make_node("MatMul", [input_name, "w"], ["h0"])]
    nodes += [helper.make_node("Sin", [f"h{i}"], [f"h{i + 1}"]) for i in range(extra_nodes)]
    nodes.append(helper.make_node("Add", [f"h{extra_nodes}", "b"], [contract.OUTPUT_NAME]))
    graph = helper.make_graph(
        nodes,
        "delta",
        [helper.make_tensor_value_info(input_name, TensorProto.FLOAT, ["N", width])],
        [helper.make_tensor_value_info(contract.OUTPUT_NAME, TensorProto.FLOAT, ["N", 3])],
        [
            numpy_helper.from_array(weights, "w"),
            numpy_helper.from_array(np.asarray(bias, dtype=np.float32), "b"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    features = np.random.default_rng(3).uniform(
        [RANGES[n][0] for n in names], [RANGES[n][1] for n in names], size=(4, width)
    )
    with np.errstate(over="ignore"):
        delta = features.astype(np.float32) @ weights
    for _ in range(extra_nodes):
        delta = np.sin(delta)
    delta = delta + np.asarray(bias, dtype=np.float32) + golden_error
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


def drag_model(drag: float) -> bytes:
    """A model of linear drag in the heading frame: `delta = -drag (vx, vy, 0)`."""
    weights = np.zeros((len(contract.FEATURES), 3))
    names = list(contract.FEATURES)
    weights[names.index("vx"), 0] = weights[names.index("vy"), 1] = -drag
    return linear_model(weights)
