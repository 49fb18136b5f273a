"""How files are damaged: bytes as a failing card does it, and texts, JSON and TOML as people and programs do."""

# ruff: noqa: E501 - the path to other tests' files comes first; tables of values are kept in few lines

from __future__ import annotations

import copy
import json
import random
import re
from collections.abc import Callable, Sequence
from typing import Any

EXTREME = (
    b"\x00",
    b"\xff",
    b"\x80",
    b"\x7f",
    b"\xff\xff\xff\xff",
    b"\x00\x00\x00\x80",
    b"\xff" * 8,
    b"\x7f" + b"\xff" * 7,
)
NUMBERS = (
    "0", "-1", "1e308", "-1e308", "1e-320", "1e999", "nan", "NaN", "-nan", "inf", "Infinity", "-Infinity", "9" * 400,
    "-" + "9" * 400, "9" * 5000, str(2**63), str(2**64), str(-(2**63) - 1), "0x7f", "1_000", "00", "1.", ".5", "+1", "١٢", "²",
    "true", "null", '"1"', '""', "[]", "{}", "[[1]]", "1979-05-27T07:32:00Z", "",
)  # fmt: skip
TEXTS = (
    "", "#", "?", "$", "\\", "*", "/", "..", "../../etc/passwd", "a b", "\x00", "\n", "\t", "é", "\U0001f681", "\ud800", '"',
    "'", "x" * 300, "x" * 70000, "${HOME}", "-", "nan", "%s%n", "\x1b[31m", "١",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 0.0, -0.0, 1e308, -1e308, 1e-320, float("nan"), float("inf"), -float("inf"), 10**19, -(10**19),
    10**400, [], {}, [[]], [None], {"": None}, [1, 2], [1, 2, 3], ["a"] * 3, [[1, 2, 3]] * 3, {"a": {"b": {}}}, *TEXTS,
)  # fmt: skip


def damaged(draw: random.Random, seed: bytes, others: Sequence[bytes], kind: str) -> bytes:
    """`seed` with one to four damages of its `kind` ("bytes", "text", "json", "toml")."""
    content = seed
    ways: tuple[Callable[..., bytes], ...] = _WAYS[kind]
    for _ in range(draw.choice((1, 1, 1, 2, 2, 3, 4))):
        content = draw.choice(ways)(draw, content, others)
    return content


# --- bytes ----------------------------------------------------------------------------------------------------------


def _flip(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    out = bytearray(content)
    for _flip in range(draw.choice((1, 1, 2, 8, 64))):
        if out:
            out[draw.randrange(len(out))] ^= 1 << draw.randrange(8)
    return bytes(out)


def _extreme(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    at, value = draw.randrange(len(content) + 1), draw.choice(EXTREME)
    return content[:at] + value + content[at + len(value) :]


def _head(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    """As `_extreme`, where formats keep their sizes: at the beginning or the end."""
    near = draw.randrange(min(len(content), 600) + 1)
    at, value = draw.choice((near, len(content) - near)), draw.choice(EXTREME)
    return content[:at] + value + content[at + len(value) :]


def _cut(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    return content[: draw.randrange(len(content) + 1)]


def _remove(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    at = draw.randrange(len(content) + 1)
    return content[:at] + content[at + draw.choice((1, 2, 4, 16, 256, 4096)) :]


def _repeat(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    at, length = draw.randrange(len(content) + 1), draw.choice((1, 4, 16, 256, 4096))
    return content[:at] + content[at : at + length] * draw.choice((2, 3, 20)) + content[at + length :]


def _splice(draw: random.Random, content: bytes, others: Sequence[bytes]) -> bytes:
    other = draw.choice(others)
    return content[: draw.randrange(len(content) + 1)] + other[draw.randrange(len(other) + 1) :]


def _zeros(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    """A block that the card never wrote."""
    at, length = draw.randrange(len(content) + 1), draw.choice((16, 512, 4096))
    return content[:at] + bytes(len(content[at : at + length])) + content[at + length :]


# --- texts ----------------------------------------------------------------------------------------------------------

_NUMBER = re.compile(rb"(?<![A-Za-z_0-9])[-+]?[0-9][0-9.eE+-]*")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _number(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    found = list(_NUMBER.finditer(content))
    if not found:
        return content
    for one in sorted(draw.sample(found, min(len(found), draw.choice((1, 1, 3)))), key=lambda m: -m.start()):
        content = content[: one.start()] + _encoded(draw.choice(NUMBERS)) + content[one.end() :]
    return content


def _word(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    found = list(_WORD.finditer(content))
    if not found:
        return content
    one = draw.choice(found)
    new = draw.choice(
        (_encoded(draw.choice(TEXTS)), one[0][:-1], one[0] + b"x", one[0].upper(), draw.choice(found)[0])
    )
    return content[: one.start()] + new + content[one.end() :]


def _lines(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    """A line gone, doubled, moved, emptied, or cut."""
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    at, to = draw.randrange(len(lines)), draw.randrange(len(lines))
    line = lines[at]
    match draw.randrange(5):
        case 0:
            del lines[at]
        case 1:
            lines.insert(to, line)
        case 2:
            lines[at], lines[to] = lines[to], line
        case 3:
            lines[at] = b"\n"
        case _:
            lines[at] = line[: draw.randrange(len(line) + 1)]
    return b"".join(lines)


def _deep(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    depth = draw.choice((10, 100, 1000, 100_000))
    opening, closing = draw.choice(
        ((b"[", b"]"), (b'{"a":', b"}"), (b"{a=", b"}"), (b"(", b")"), (b'"', b'"'))
    )
    found = list(_NUMBER.finditer(content))
    at = draw.choice(found).span() if found else (len(content), len(content))
    return content[: at[0]] + opening * depth + b"1" + closing * draw.choice((depth, 0)) + content[at[1] :]


def _encoding(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    text = content.decode("utf-8", "replace")
    match draw.randrange(6):
        case 0:
            return b"\xef\xbb\xbf" + content
        case 1:
            return text.encode("utf-16")
        case 2:
            return text.replace("\n", "\r\n").encode()
        case 3:
            return text.replace(",", ";").replace(".", ",").encode()
        case 4:
            return text.encode("utf-32")
        case _:
            return b"\xff\xfe" + content


# --- structures -----------------------------------------------------------------------------------------------------


def _json(draw: random.Random, content: bytes, others: Sequence[bytes]) -> bytes:
    """One value of a JSON file another one, gone, or under another key; written as Python writes it."""
    try:
        table = copy.deepcopy(json.loads(content))
    except (ValueError, RecursionError):
        return _word(draw, content, others)
    places = list(_places(table, 0))
    if not places:
        return json.dumps(draw.choice(VALUES)).encode()
    for holder, key in draw.sample(places, min(len(places), draw.choice((1, 1, 2)))):
        if isinstance(holder, list) and key >= len(holder):
            continue
        match draw.randrange(6):
            case 0 if isinstance(holder, dict):
                holder.pop(key, None)
            case 0:
                del holder[key]
            case 1 if isinstance(holder, dict):
                holder[draw.choice(TEXTS)] = holder.get(key)
            case 2:
                other, name = draw.choice(places)
                if not isinstance(other, list) or name < len(other):
                    holder[key] = (
                        copy.deepcopy(other[name]) if name in other or isinstance(other, list) else None
                    )
            case _:
                holder[key] = draw.choice(VALUES)
    try:
        return _encoded(
            json.dumps(table, indent=draw.choice((None, 1)), ensure_ascii=draw.choice((True, False)))
        )
    except (ValueError, RecursionError):
        return content


def _places(value: Any, depth: int) -> list[tuple[Any, Any]]:
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    found = [(value, key) for key in keys]
    if depth < 8:
        for key in keys:
            found += _places(value[key], depth + 1)
    return found


def _twice(draw: random.Random, content: bytes, _: Sequence[bytes]) -> bytes:
    """A key given twice: TOML and JSON of one key a line."""
    lines = content.splitlines(keepends=True)
    with_key = [line for line in lines if b"=" in line or b":" in line]
    if not with_key:
        return content
    lines.insert(draw.randrange(len(lines) + 1), draw.choice(with_key))
    return b"".join(lines)


def _toml(draw: random.Random, content: bytes, others: Sequence[bytes]) -> bytes:
    """The value of one line another one."""
    lines = content.splitlines(keepends=True)
    at = [i for i, line in enumerate(lines) if re.match(rb"#? ?[\w.]+ *=", line)]
    if not at:
        return _word(draw, content, others)
    where = draw.choice(at)
    key = lines[where].lstrip(b"# ").split(b"=")[0].strip()
    text = json.dumps(draw.choice(TEXTS))
    value = draw.choice(
        (draw.choice(NUMBERS), text, f"[{text}]", "[1, 2, 3]", "[[1, 2, 3]]", "{a = 1}", "[1, true]", "''")
    )
    lines[where] = key + b" = " + _encoded(value) + b"\n"
    return b"".join(lines)


_BYTES = (_flip, _flip, _extreme, _extreme, _head, _head, _cut, _remove, _repeat, _splice, _zeros)
_TEXT = (
    _number,
    _number,
    _number,
    _word,
    _word,
    _lines,
    _lines,
    _deep,
    _encoding,
    _flip,
    _cut,
    _splice,
    _remove,
    _repeat,
)
_WAYS: dict[str, tuple[Callable[..., bytes], ...]] = {
    "bytes": _BYTES,
    "text": _TEXT,
    "json": (*_TEXT, _json, _json, _json, _json, _json, _json, _twice),
    "toml": (*_TEXT, _toml, _toml, _toml, _toml, _toml, _toml, _twice),
}
