"""Bad input, told in one line: what is wrong, where, and what to do."""

from __future__ import annotations

import codecs
import os
import sys
import unicodedata
from collections.abc import Callable
from typing import Any

_LONGEST = 1000
"""Characters of a message; what stands in a damaged file may be of any length."""


class InputError(Exception):
    """Something the user gave cannot be used.

    The message is one line that says what is wrong, where (file, line, column, field), and what to do. Command
    lines print it and exit with code 2; it never carries a traceback to the user.
    """


def shown(value: object, most: int = 60) -> str:
    """What somebody sent, as text for a message: never longer than `most`, never more than a line."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 10**18:
        return "a whole number of more than 18 digits"
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return f"a {type(value).__name__}"
    return text if len(text) <= most else text[: most - 3] + "..."


def run_command_line(app: Callable[[], object], extra: str = "all") -> None:
    """Run a typer application, called with `standalone_mode=False`; an `InputError` becomes one line on standard error
    and exit code 2.

    So do options and arguments that typer refuses, a disk that is full, whatever was being written, and a library that
    is not installed, for which `extra` of the package is named. A terminal that cannot show a character shows the
    nearest that it can.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors=_NEAREST)
    try:
        code = app()
    except InputError as error:
        _end(str(error))
    except ModuleNotFoundError as error:
        library = (error.name or "").split(".")[0]
        if library in ("", "trueflight"):
            raise
        _end(f"{library} is not installed here; pip install 'trueflight[{extra}]'")
    except BrokenPipeError:  # whoever read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        raise SystemExit(1) from None
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _end(f"{place}{error.strerror or error}; free space, or check the permissions")
    except MemoryError:
        _end("not enough memory; give fewer or shorter files")
    except Exception as error:
        if not hasattr(error, "format_message"):  # typer's, which may not be loaded
            raise
        _refuse(error)
    else:
        if type(code) is int and code:
            raise SystemExit(code)


def _refuse(error: Any) -> None:
    """What typer refuses: the command, what is wrong, and where it is told what would be right."""
    message, context = str(error.format_message()), getattr(error, "ctx", None)
    if (
        type(error).__name__ == "NoArgsIsHelpError"
    ):  # the help, which is printed already where it is in frames
        if message:
            print(message, file=sys.stderr)  # noqa: T201
        raise SystemExit(2) from None
    path = context.command_path if context is not None else ""
    told = message.removeprefix("Invalid value for ").rstrip(".")
    told = told[0].lower() + told[1:] if told[1:2].islower() else told
    _end(f"{path}: {told}; see '{path} --help'" if path else told)


def plain_line(message: str) -> str:
    """A message as one line of printable characters, of a length that can be read."""
    line = "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in " ".join(message.split()))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"


def _end(message: str) -> None:
    print(f"error: {plain_line(message)}", file=sys.stderr)  # noqa: T201
    raise SystemExit(2) from None


_NEAREST = "trueflight-nearest"
_PLAIN = {
    "²": "^2",
    "³": "^3",
    "→": "->",
    "−": "-",
    "–": "-",
    "…": "...",
    "·": "*",
    "×": "x",
    "°": " deg",
    "µ": "u",
}


def _nearest(error: UnicodeError) -> tuple[str, int]:
    """What stands for characters that an encoding lacks: an error handler of `codecs`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    out = ""
    for character in error.object[error.start : error.end]:
        plain = _PLAIN.get(character) or unicodedata.normalize("NFKD", character)
        out += "".join(c for c in plain if c.isascii()) or "?"
    return out, error.end


codecs.register_error(_NEAREST, _nearest)
