"""A look at the structure of an ONNX file before any runtime opens it: weights must be in the file itself.

ONNX lets a tensor say that its numbers are in another file ("external data"), and a runtime then reads that
one. A tensor may stand in many places, nested without end; here each of them is visited. Only the fields that
lead to tensors are declared, by their numbers in `onnx.proto`, so that protobuf itself decodes as the runtime
will, and the onnx package is not needed on board.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

_DEEPEST = 64
"""Graphs within graphs: those of this project have none."""
_REPEATED, _OPTIONAL = 3, 1
_MESSAGE, _INT32, _BYTES = 11, 5, 12
_FIELDS: dict[str, tuple[tuple[str, int, int, str], ...]] = {
    "Tensor": (("external_data", 13, _REPEATED, "Entry"), ("data_location", 14, _OPTIONAL, "")),
    "Entry": (),
    "SparseTensor": (("values", 1, _OPTIONAL, "Tensor"), ("indices", 2, _OPTIONAL, "Tensor")),
    "Attribute": (
        ("t", 5, _OPTIONAL, "Tensor"),
        ("g", 6, _OPTIONAL, "Graph"),
        ("tensors", 10, _REPEATED, "Tensor"),
        ("graphs", 11, _REPEATED, "Graph"),
        ("sparse_tensor", 22, _OPTIONAL, "SparseTensor"),
        ("sparse_tensors", 23, _REPEATED, "SparseTensor"),
    ),
    "Node": (("attribute", 5, _REPEATED, "Attribute"),),
    "Graph": (
        ("node", 1, _REPEATED, "Node"),
        ("initializer", 5, _REPEATED, "Tensor"),
        ("sparse_initializer", 15, _REPEATED, "SparseTensor"),
    ),
    "Function": (("node", 7, _REPEATED, "Node"), ("attribute_proto", 11, _REPEATED, "Attribute")),
    "Training": (("initialization", 1, _OPTIONAL, "Graph"), ("algorithm", 2, _OPTIONAL, "Graph")),
    "Model": (
        ("graph", 7, _OPTIONAL, "Graph"),
        ("training_info", 20, _REPEATED, "Training"),
        ("functions", 25, _REPEATED, "Function"),
    ),
}


def _declare() -> Any:
    file = descriptor_pb2.FileDescriptorProto(name="structure.proto", package="structure", syntax="proto2")
    for name, fields in _FIELDS.items():
        message = file.message_type.add(name=name)
        for field, number, label, kind in fields:
            entry = message.field.add(name=field, number=number, label=label)
            if kind:
                entry.type, entry.type_name = _MESSAGE, f".structure.{kind}"
            else:
                entry.type = _INT32
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("structure.Model"))


_MODEL = _declare()


def why_not_self_contained(onnx: bytes) -> str:
    """'' where an ONNX file holds all its numbers itself, otherwise the reason why it is refused."""
    if onnx[4:8] == b"ORTM":
        return "it is in the format of ONNX Runtime itself; send an ONNX file"
    try:
        model = _MODEL.FromString(onnx)
    except (DecodeError, RecursionError, MemoryError):
        return "not an ONNX model: its bytes are no ONNX protobuf, or nested too deeply"
    waiting: list[tuple[Any, int]] = [(model, 0)]
    while waiting:
        message, depth = waiting.pop()
        if depth > _DEEPEST:
            return f"its graphs are nested more than {_DEEPEST} deep"
        if message.DESCRIPTOR.name == "Tensor" and (message.external_data or message.data_location != 0):
            return "it keeps weights in another file (ONNX external data); export it as one file"
        for field, value in message.ListFields():
            if field.message_type is not None:
                several = value if field.is_repeated else (value,)
                waiting.extend((one, depth + 1) for one in several)
    return ""
