"""What a model file may not do: keep weights elsewhere, carry metadata of another kind."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnx_models import drag_model

from trueflight.companion.law.model_check import check_model
from trueflight.companion.law.onnx_structure import why_not_self_contained
from trueflight.models import contract
from trueflight.models.vehicle import load_vehicle

VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")
SECRET = "/etc/passwd"


def elsewhere(name: str = "ext") -> TensorProto:
    tensor = TensorProto(name=name, data_type=TensorProto.UINT8, dims=[1, 3])
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", SECRET), ("offset", "0"), ("length", "3")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    return tensor


def constant(tensor: TensorProto) -> onnx.NodeProto:
    node = helper.make_node("Constant", [], ["c"])
    node.attribute.append(helper.make_attribute("value", tensor))
    return node


def sparse() -> onnx.SparseTensorProto:
    there = numpy_helper.from_array(np.zeros(1, dtype=np.int64), "indices")
    return helper.make_sparse_tensor(elsewhere(), there, [1, 3])


def nested(depth: int, inner: onnx.NodeProto) -> onnx.NodeProto:
    for _ in range(depth):
        graph = helper.make_graph([inner], "body", [], [])
        inner = helper.make_node("If", ["x"], ["y"], then_branch=graph, else_branch=graph)
    return inner


def only_entries(tensor: TensorProto) -> TensorProto:
    tensor.data_location = TensorProto.DEFAULT
    return tensor


def only_location() -> TensorProto:
    tensor = elsewhere()
    del tensor.external_data[:]
    return tensor


PLACES: dict[str, Callable[[onnx.ModelProto], object]] = {
    "initializer": lambda m: m.graph.initializer.append(elsewhere()),
    "entries without the location": lambda m: m.graph.initializer.append(only_entries(elsewhere())),
    "location without entries": lambda m: m.graph.initializer.append(only_location()),
    "sparse initializer": lambda m: m.graph.sparse_initializer.append(sparse()),
    "attribute": lambda m: m.graph.node.append(constant(elsewhere())),
    "tensors of an attribute": lambda m: m.graph.node.add(op_type="X").attribute.append(
        onnx.AttributeProto(name="a", type=onnx.AttributeProto.TENSORS, tensors=[elsewhere()])
    ),
    "sparse attribute": lambda m: m.graph.node.add(op_type="X").attribute.append(
        onnx.AttributeProto(name="a", type=onnx.AttributeProto.SPARSE_TENSOR, sparse_tensor=sparse())
    ),
    "sparse attributes": lambda m: m.graph.node.add(op_type="X").attribute.append(
        onnx.AttributeProto(name="a", type=onnx.AttributeProto.SPARSE_TENSORS, sparse_tensors=[sparse()])
    ),
    "subgraph": lambda m: m.graph.node.append(nested(1, constant(elsewhere()))),
    "subgraphs, five deep": lambda m: m.graph.node.append(nested(5, constant(elsewhere()))),
    "graphs of an attribute": lambda m: m.graph.node.add(op_type="X").attribute.append(
        onnx.AttributeProto(
            name="a",
            type=onnx.AttributeProto.GRAPHS,
            graphs=[helper.make_graph([constant(elsewhere())], "g", [], [])],
        )
    ),
    "function": lambda m: m.functions.add(name="f", domain="d").node.append(constant(elsewhere())),
    "default of a function's attribute": lambda m: m.functions.add(name="f").attribute_proto.append(
        helper.make_attribute("value", elsewhere())
    ),
    "training": lambda m: m.training_info.add().algorithm.initializer.append(elsewhere()),
}


@pytest.mark.parametrize("place", PLACES)
def test_weights_in_another_file_are_refused_before_a_runtime_sees_them(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = onnx.ModelProto.FromString(drag_model(0.1))
    PLACES[place](model)
    monkeypatch.setattr(
        "trueflight.companion.law.model_check.open_session", lambda onnx: pytest.fail("a runtime saw it")
    )
    verdict = check_model(model.SerializeToString(), VEHICLE)
    assert not verdict.accepted
    assert "external data" in verdict.reason
    assert SECRET not in verdict.reason


def test_a_second_graph_appended_to_the_bytes_is_seen_as_well() -> None:
    more = onnx.ModelProto()
    more.graph.initializer.append(elsewhere())
    assert "external data" in why_not_self_contained(drag_model(0.1) + more.SerializeToString())


def within(number: int, payload: bytes) -> bytes:
    """A message as field `number` (below 16) of another, as protobuf writes it."""
    head, size = bytes([number << 3 | 2]), len(payload)
    while size > 127:
        head, size = head + bytes([size & 127 | 128]), size >> 7
    return head + bytes([size]) + payload


@pytest.mark.parametrize(
    ("graphs", "reason"), [(18, ""), (25, "nested more than 64 deep"), (40, "nested too deeply")]
)
def test_graphs_nested_without_end_are_refused(graphs: int, reason: str) -> None:
    """Also where nothing in them is kept elsewhere; protobuf itself gives up at a hundred messages."""
    graph = b""
    for _ in range(graphs):
        graph = within(1, within(5, within(6, graph)))  # node, attribute, g
    told = why_not_self_contained(within(7, graph))
    assert (reason in told) and bool(told) == bool(reason)


def test_another_format_is_refused_and_a_whole_file_is_not() -> None:
    assert "ONNX Runtime itself" in why_not_self_contained(b"\0\0\0\0ORTM" + bytes(100))
    assert why_not_self_contained(drag_model(0.1)) == ""
    said = onnx.ModelProto.FromString(drag_model(0.1))
    said.graph.initializer[0].data_location = TensorProto.DEFAULT  # it says so itself: here
    assert why_not_self_contained(said.SerializeToString()) == ""


KINDS = ["text", 5, 10**400, 1.5, True, None, [], {}, [1, 2, 3], ["a"], [[]], [{}], {"a": 1}, [None] * 4]
RAW = ["", "[" * 5000, "nan", "[NaN]", "1" * 5000, '{"name": ' * 2000, "\x00"]
KEYS = [*contract.REQUIRED_KEYS, contract.KEY_ACTUATION]


@pytest.mark.parametrize("key", KEYS)
def test_metadata_of_every_wrong_kind_are_refused_with_a_reason(key: str) -> None:
    texts = {contract.KEY_NAME, contract.KEY_VERSION, contract.KEY_DATA_HASH}
    for value in [json.dumps(kind) for kind in KINDS] + RAW:
        fits = (key, value) in ((contract.KEY_CHAIN, "[]"), (contract.KEY_ACTUATION, "{}"))
        verdict = check_model(drag_model(0.1, metadata={key: value}), VEHICLE, 0.1)
        if key in texts or fits:
            assert verdict.accepted or "one line" in verdict.reason, (value[:40], verdict.reason)
            continue
        assert not verdict.accepted, value[:40]
        assert "its check failed" not in verdict.reason, (value[:40], verdict.reason)
        assert len(verdict.reason) < 500


@pytest.mark.parametrize(
    "entry", [1, [], {}, {"effect": 5}, {"effect": "x", "parameters": [1]}, None, "drag"]
)
def test_a_chain_of_anything_but_effects_is_refused(entry: object) -> None:
    verdict = check_model(drag_model(0.1, metadata={contract.KEY_CHAIN: [entry]}), VEHICLE, 0.1)
    assert not verdict.accepted
    assert "'chain'" in verdict.reason
