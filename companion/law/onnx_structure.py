"""A look at the structure of an ONNX file without any runtime: weights must be in the file itself.

ONNX lets a tensor say that its numbers are in another file ("external data"), and a runtime then reads that
one. A tensor may stand in many places, nested without end; here each of them is visited. Only the fields that
lead to tensors, and those that `companion.law.straight_line` reads, are declared, by their numbers in `onnx.proto`, so
that protobuf itself decodes as the runtime will, and the onnx package is not needed on board.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

_DEEPEST = 64
"""Graphs within graphs: those of this project have none."""
_REPEATED, _OPTIONAL = 3, 1
_MESSAGE, _INT32, _BYTES, _INT64, _FLOAT = 11, 5, 12, 3, 2
_PLAIN = {"": _INT32, "bytes": _BYTES, "int64": _INT64, "float": _FLOAT}
_FIELDS: dict[str, tuple[tuple[str, int, int, str], ...]] = {
    "Tensor": (
        ("dims", 1, _REPEATED, "int64"),
        ("data_type", 2, _OPTIONAL, ""),
        ("float_data", 4, _REPEATED, "float"),
        ("int64_data", 7, _REPEATED, "int64"),
        ("name", 8, _OPTIONAL, "bytes"),
        ("raw_data", 9, _OPTIONAL, "bytes"),
        ("external_data", 13, _REPEATED, "Entry"),
        ("data_location", 14, _OPTIONAL, ""),
    ),
    "Entry": (("key", 1, _OPTIONAL, "bytes"), ("value", 2, _OPTIONAL, "bytes")),
    "SparseTensor": (("values", 1, _OPTIONAL, "Tensor"), ("indices", 2, _OPTIONAL, "Tensor")),
    "Attribute": (
        ("name", 1, _OPTIONAL, "bytes"),
        ("f", 2, _OPTIONAL, "float"),
        ("i", 3, _OPTIONAL, "int64"),
        ("t", 5, _OPTIONAL, "Tensor"),
        ("g", 6, _OPTIONAL, "Graph"),
        ("tensors", 10, _REPEATED, "Tensor"),
        ("graphs", 11, _REPEATED, "Graph"),
        ("sparse_tensor", 22, _OPTIONAL, "SparseTensor"),
        ("sparse_tensors", 23, _REPEATED, "SparseTensor"),
    ),
    "Node": (
        ("input", 1, _REPEATED, "bytes"),
        ("output", 2, _REPEATED, "bytes"),
        ("op_type", 4, _OPTIONAL, "bytes"),
        ("attribute", 5, _REPEATED, "Attribute"),
        ("domain", 7, _OPTIONAL, "bytes"),
    ),
    "Graph": (
        ("node", 1, _REPEATED, "Node"),
        ("initializer", 5, _REPEATED, "Tensor"),
        ("sparse_initializer", 15, _REPEATED, "SparseTensor"),
    ),
    "Function": (("node", 7, _REPEATED, "Node"), ("attribute_proto", 11, _REPEATED, "Attribute")),
    "Training": (("initialization", 1, _OPTIONAL, "Graph"), ("algorithm", 2, _OPTIONAL, "Graph")),
    "Model": (
        ("graph", 7, _OPTIONAL, "Graph"),
        ("metadata_props", 14, _REPEATED, "Entry"),
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
            if kind in _PLAIN:
                entry.type = _PLAIN[kind]
            else:
                entry.type, entry.type_name = _MESSAGE, f".structure.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("structure.Model"))


_MODEL = _declare()


def decoded(onnx: bytes) -> Any:
    """The file as the message `Model` of `onnx.proto`, with the fields declared here.

    Raises `DecodeError`, `RecursionError` or `MemoryError` for bytes that are none.
    """
    return _MODEL.FromString(onnx)


def why_not_self_contained(onnx: bytes) -> str:
    """'' where an ONNX file holds all its numbers itself, otherwise the reason why it is refused."""
    if onnx[4:8] == b"ORTM":
        return "it is in the format of ONNX Runtime itself; send an ONNX file"
    try:
        model = decoded(onnx)
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
