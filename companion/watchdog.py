"""The service manager's watchdog, fed by the control tick alone, and the control thread's priority.

systemd restarts a service that says nothing for WatchdogSec. Here nothing but a control tick says anything, so that a
control thread that hangs, or an autopilot that is gone, is noticed although every other thread is well. Protocol:
sd_notify(3), datagrams to the Unix socket that NOTIFY_SOCKET names.
"""

from __future__ import annotations

import os
import socket
import time

_SHARE = 0.25
"""Of the watchdog's time, between two signs of life: three may be lost."""


class Watchdog:
    """Speaks to the service manager; without one every method does nothing.

    No method raises or blocks: a full or vanished socket loses the sign of life, and the next one comes soon.
    """

    def __init__(self, environment: dict[str, str] | None = None) -> None:
        environment = dict(os.environ) if environment is None else environment
        self._address = environment.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):
            self._address = "\0" + self._address[1:]  # an abstract socket
        self._socket: socket.socket | None = None
        self.interval = 0.0
        """Seconds between two signs of life; 0 where nobody waits for them."""
        self._next = 0.0
        if not self._address:
            return
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        period = environment.get("WATCHDOG_USEC", "")
        if mine and period.isdigit():
            self.interval = _SHARE * 1e-6 * int(period)

    def ready(self, text: str) -> None:
        """The service has started; `text` is shown by `systemctl status`."""
        self._notify(f"READY=1\nSTATUS={text}")

    def stopping(self) -> None:
        """The service is about to end."""
        self._notify("STOPPING=1")

    def tick(self) -> None:
        """A control tick has passed; belongs to the control thread."""
        if self.interval == 0.0:
            return
        now = time.monotonic()
        if now >= self._next:
            self._next = now + self.interval
            self._notify("WATCHDOG=1")

    def _notify(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError:
            return


def raise_priority(priority: int) -> str:
    """Give the calling thread a real-time priority (SCHED_FIFO, 1 to 99); '' or why not.

    Threads and processes that it starts do not inherit it.
    """
    if not hasattr(os, "sched_setscheduler"):
        return "this system has no SCHED_FIFO"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return "not allowed; the service needs LimitRTPRIO, a user an entry 'rtprio' in limits.conf"
    except OSError as error:
        return str(error.strerror)
    return ""
