"""Bad input, told in one line: what is wrong, where, and what to do."""

from __future__ import annotations

import sys
from collections.abc import Callable


class InputError(Exception):
    """Something the user gave cannot be used.

    The message is one line that says what is wrong, where (file, line, column, field), and what to do. Command
    lines print it and exit with code 2; it never carries a traceback to the user.
    """


def run_command_line(app: Callable[[], object]) -> None:
    """Run a typer application; an `InputError` becomes one line on standard error and exit code 2."""
    try:
        app()
    except InputError as error:
        print("error: " + " ".join(str(error).split()), file=sys.stderr)  # noqa: T201
        raise SystemExit(2) from None
