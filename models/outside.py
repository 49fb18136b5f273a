"""What comes from outside as text: its size known before it is read, then decoded and parsed, each in one place.

Whatever is wrong with a file becomes one `InputError`; no other exception leaves a reader. Readers of other formats
(MCAP, ULog, Parquet, ONNX) hold their library's exceptions with `unreadable`.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trueflight.models.errors import InputError

if TYPE_CHECKING:
    import numpy as np

MOST_TEXT = 64 << 20
"""Bytes of a settings, vehicle, design or model file; the largest network allowed in one has less."""
_WIDEST = 1 << 64
"""Whole numbers reach to here, as TOML's and every clock's do; a longer one is damage, and no float may hold it."""


@contextmanager
def unreadable(where: str | Path, what: str, advice: str, damage: str = "") -> Iterator[None]:
    """Turn whatever a library raises over a damaged file into one line: `what` cannot be read, or its `damage` ("not a
    whole ULog"), and what to do.

    Libraries raise what their parsers happen to meet: struct.error, OverflowError, KeyError, RecursionError, ...
    """
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        reason = error.strerror or _reason(error)
        raise InputError(f"{where}: cannot read {what} ({reason}); {advice}") from None
    except Exception as error:
        damage = damage or f"cannot read {what}: it is damaged"
        raise InputError(f"{where}: {damage} ({_reason(error)}); {advice}") from error


def read_text(path: Path, what: str, advice: str) -> str:
    """The text of a UTF-8 file, a byte order mark left out. Raises `InputError` for what is no text, or is too long."""
    with unreadable(path, what, advice):
        if path.stat().st_size > MOST_TEXT:
            raise InputError(
                f"{path}: has {path.stat().st_size} bytes, which is too long for {what}; {advice}"
            )
        try:
            return path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(
                f"{path}: not {what}: not text in UTF-8 (byte {error.start + 1} is no part of one); {advice}"
            ) from None


def read_toml(path: Path, what: str, advice: str = "check the path") -> dict[str, Any]:
    """A TOML file's table; `what` names it in messages ("the mapping"). Raises `InputError` for a missing file or bad
    syntax."""
    return toml_table(read_text(path, what, advice), str(path))


def toml_table(text: str, where: str, advice: str = "correct that line") -> dict[str, Any]:
    """The table of a TOML text. Raises `InputError` for bad syntax, and for numbers that TOML does not allow."""
    try:
        table = tomllib.loads(text)
        _check_numbers(table, "")
    except RecursionError:
        raise InputError(f"{where}: not valid TOML: nested too deeply; {advice}") from None
    except ValueError as error:
        raise InputError(f"{where}: not valid TOML: {_reason(error)}; {advice}") from None
    return table


def json_value(text: str | bytes, where: str, advice: str) -> Any:
    """The value of a JSON text. Raises `InputError` for bad syntax, a key given twice, whole numbers beyond 64 bits,
    or nesting beyond all sense."""
    try:
        if isinstance(text, bytes):
            text = text.decode("utf-8-sig")
        return json.loads(text, parse_int=_whole, object_pairs_hook=_object)
    except RecursionError:
        raise InputError(f"{where}: not valid JSON: nested too deeply; {advice}") from None
    except ValueError as error:
        raise InputError(f"{where}: not valid JSON: {_reason(error)}; {advice}") from None


def json_object(text: str | bytes, where: str, advice: str) -> dict[str, Any]:
    """As `json_value`, where only an object makes sense."""
    table = json_value(text, where, advice)
    if not isinstance(table, dict):
        raise InputError(f"{where}: holds {shown(table)} where an object is expected; {advice}")
    return table


def is_number(value: object) -> bool:
    """Whether a value of a parsed file is a finite number that a float can hold; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def numbers(value: object, shape: tuple[int | None, ...]) -> np.ndarray | None:
    """Nested lists of finite numbers, `value`, as an array of this `shape`, (N, 3) as (None, 3); None where they are
    anything else."""
    import numpy as np  # texts are read by commands that compute nothing

    if not shape:
        return np.array(float(value)) if is_number(value) else None  # type: ignore[arg-type]
    if not isinstance(value, list | tuple) or shape[0] not in (None, len(value)):
        return None
    rows = [row for one in value if (row := numbers(one, shape[1:])) is not None]
    if len(rows) < len(value) or len({row.shape for row in rows}) > 1:
        return None
    return np.array(rows, dtype=float).reshape(
        len(rows), *(rows[0].shape if rows else [n or 0 for n in shape[1:]])
    )


def shown(value: object, most: int = 60) -> str:
    """A `value` of a damaged file for a message, in at most `most` characters, however long it is."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of more digits than Python prints
        text = f"a {type(value).__name__} of absurd size"
    return text if len(text) <= most else text[:most] + "..."


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split())
    kind = type(error).__name__
    if isinstance(error, KeyError):
        text = f"no {text}"
    return f"{text[:200]}" if len(text) > 3 else f"{kind} {text}".strip()


def _whole(digits: str) -> int:
    if len(digits) > 20 or abs(int(digits)) >= _WIDEST:
        raise ValueError(f"a whole number of {len(digits.lstrip('-'))} digits is too large")
    return int(digits)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {shown(twice)} is given twice")
    return table


def _check_numbers(value: object, at: str) -> None:
    if isinstance(value, dict):
        for key, one in value.items():
            _check_numbers(one, f"{at}.{key}" if at else key)
    elif isinstance(value, list):
        for one in value:
            _check_numbers(one, at)
    elif isinstance(value, int) and abs(value) >= _WIDEST:
        raise ValueError(f"'{at}' is a whole number of more than 64 bits")
