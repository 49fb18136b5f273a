"""The process that flies: what `companion run` becomes once it has read its command line.

Reading a command line and drawing tables needs libraries that take as much memory as the record and Zenoh together;
so the process begins anew, under the same number, with what was asked for as JSON, and without them.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from trueflight.models.errors import run_command_line

if TYPE_CHECKING:
    from trueflight.companion.app import Companion
    from trueflight.companion.settings import Settings

_CLOSE_PATIENCE = 5.0  # s
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",  # matrices of a few numbers: others would only take memory
    "OMP_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",  # threads share one heap: small boards have little
}


def request(config: str, flags: Mapping[str, Any], zenoh: Mapping[str, Any]) -> str:
    """What is asked for, as JSON: `config` is the configuration's file ('' without), the rest goes over it."""
    return json.dumps({"config": config, "flags": dict(flags), "zenoh": dict(zenoh)})


def fly_instead(asked: str) -> NoReturn:
    """Go on as the process that flies what a `request` asks for."""
    # Modules are found where they are found now: beside a script nothing of the current folder is.
    path = [] if sys.path[0] in ("", os.getcwd()) else ["-P"]
    sys.stdout.flush()
    command = [sys.executable, *path, "-m", "trueflight.companion.flying", asked]
    os.execve(sys.executable, command, {**_ENVIRONMENT, **os.environ})


def fly(asked: str) -> None:
    """Fly what a `request` asks for, in this process. Raises `InputError` where it does not fit."""
    from trueflight.companion.app import Companion

    settings = _settings(asked)
    _serve(Companion(settings), settings.connect)


def _settings(asked: str) -> Settings:
    from trueflight.companion.settings import load_settings

    given = json.loads(asked)
    zenoh: dict[str, Any] = {
        name: tuple(one) if isinstance(one, list) else one for name, one in given["zenoh"].items()
    }
    settings = load_settings(given["config"] or None)
    return replace(settings, **given["flags"], zenoh=replace(settings.zenoh, **zenoh))


def _serve(companion: Companion, address: str) -> None:
    """Tell that it is ready, fly until a signal, and end even where the control thread hangs."""
    from trueflight.companion.zenoh_session import INSECURE

    def stop(number: int, frame: FrameType | None) -> None:
        if companion.director.stopping.is_set():
            os._exit(128 + number)
        companion.stop()

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    rates = companion.readiness.rates
    assert rates is not None
    if companion.access["exposed"]:
        red, plain = ("\x1b[1;31m", "\x1b[0m") if sys.stderr.isatty() else ("", "")
        exposed = " and ".join(companion.access["exposed"])
        print(f"{red}{INSECURE}{plain}; it {exposed}", file=sys.stderr)  # noqa: T201
    where = ", ".join(companion.access["listen"]) or "Zenoh"
    ready = f"{companion.vehicle.name} at {rates.odometry:.0f} Hz on {address}, missions on {where}"
    print(f"ready: {ready}", flush=True)  # noqa: T201
    companion.watchdog.ready(ready)
    try:
        companion.run()
    finally:
        # MAVSDK waits for its callbacks; a control thread that hangs would keep us here for ever.
        closing = threading.Thread(target=companion.close, daemon=True)
        closing.start()
        closing.join(_CLOSE_PATIENCE)
        if closing.is_alive():
            os._exit(1)


if __name__ == "__main__":
    run_command_line(lambda: fly(sys.argv[1]), "companion")
