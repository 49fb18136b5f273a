"""ULog files as PX4 writes them, for tests: any topic, any layout.

Format: PX4 user guide, "ULog File Format".
"""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

TYPES = {"f": "float", "d": "double", "B": "uint8_t", "b": "int8_t", "H": "uint16_t", "I": "uint32_t",
         "i": "int32_t", "Q": "uint64_t", "?": "bool"}  # fmt: skip


@dataclass
class Written:
    """What a log is to hold: `add` topics, then `save`."""

    parameters: dict[str, float] = field(default_factory=dict)
    info: dict[str, str | int] = field(default_factory=dict)
    changes: list[tuple[float, str, float]] = field(default_factory=list)
    dropouts: list[tuple[float, int]] = field(default_factory=list)
    topics: list[tuple[str, int, np.ndarray, dict[str, tuple[str, np.ndarray]]]] = field(default_factory=list)

    def add(self, name: str, t: np.ndarray, instance: int = 0, **fields: tuple[str, np.ndarray]) -> None:
        """A topic at times `t` (M,) in s; each field is a struct code with values (M,) or (M, k)."""
        self.topics.append((name, instance, t, fields))

    def save(self, path: Path) -> Path:
        out = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))
        out += _message("B", bytes(40))
        for name, _, _, fields in {topic[0]: topic for topic in self.topics}.values():
            layout = "".join(f"{_type(*value)} {key};" for key, value in fields.items())
            out += _message("F", f"{name}:uint64_t timestamp;{layout}".encode())
        for key, value in self.info.items():
            text = isinstance(value, str)
            name = f"char[{len(value)}] {key}" if text else f"uint32_t {key}"
            out += _message("I", _key(name) + (value.encode() if text else struct.pack("<I", value)))
        for name, value in self.parameters.items():
            out += _message("P", _parameter(name, value))
        for number, (name, instance, _, _) in enumerate(self.topics):
            out += _message("A", struct.pack("<BH", instance, number) + name.encode())
        for _, piece in sorted(self._pieces(), key=lambda pair: pair[0]):
            out += piece
        path.write_bytes(out)
        return path

    def _pieces(self):
        for number, (_, _, t, fields) in enumerate(self.topics):
            columns = [(code, np.asarray(values).reshape(len(t), -1)) for code, values in fields.values()]
            for row, when in enumerate(t):
                body = struct.pack("<HQ", number, round(1e6 * when))
                for code, values in columns:
                    body += struct.pack(f"<{values.shape[1]}{code}", *values[row].tolist())
                yield when, _message("D", body)
        for when, name, value in self.changes:
            yield when, _message("P", _parameter(name, value))
        for when, milliseconds in self.dropouts:
            yield when, _message("O", struct.pack("<H", milliseconds))


def _type(code: str, values: np.ndarray) -> str:
    values = np.asarray(values)
    return TYPES[code] if values.ndim == 1 else f"{TYPES[code]}[{values.shape[1]}]"


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def _key(name: str) -> bytes:
    return struct.pack("<B", len(name)) + name.encode()


def _parameter(name: str, value: float) -> bytes:
    whole = isinstance(value, int)
    return _key(f"{'int32_t' if whole else 'float'} {name}") + struct.pack("<i" if whole else "<f", value)
