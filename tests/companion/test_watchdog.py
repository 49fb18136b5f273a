"""The service manager hears of a companion as long as its control thread ticks, and not a moment longer."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rig import Bridge, Companion, free_port, wait_for
from test_silence import HANGS

from trueflight.companion.watchdog import Watchdog, raise_priority

pytestmark = pytest.mark.realtime


class Manager:
    """The receiving end of sd_notify: a datagram socket."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "notify"
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(self.path))
        self.socket.setblocking(False)

    def heard(self) -> list[str]:
        out = []
        with contextlib.suppress(BlockingIOError):
            while True:
                out.append(self.socket.recv(4096).decode())
        return out

    def environment(self, seconds: float) -> dict[str, str]:
        return {"NOTIFY_SOCKET": str(self.path), "WATCHDOG_USEC": str(round(1e6 * seconds))}


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(tmp_path)
    yield manager
    manager.socket.close()


def test_ready_stopping_and_signs_of_life(manager: Manager) -> None:
    watchdog = Watchdog(manager.environment(0.2))
    watchdog.ready("quad5 at 100 Hz")
    assert manager.heard() == ["READY=1\nSTATUS=quad5 at 100 Hz"]
    for _ in range(50):
        watchdog.tick()
    assert manager.heard() == ["WATCHDOG=1"], "a sign of life now and then, not one each tick"
    time.sleep(0.06)
    watchdog.tick()
    watchdog.stopping()
    assert manager.heard() == ["WATCHDOG=1", "STOPPING=1"]


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": ""}, {"WATCHDOG_USEC": "1000000"}])
def test_without_a_manager_it_is_silent(environment: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "socket", lambda *arguments: pytest.fail("somebody would hear it"))
    watchdog = Watchdog(environment)
    watchdog.ready("x")
    watchdog.tick()
    watchdog.stopping()
    assert watchdog.interval == 0.0, "nobody waits for a sign of life"


@pytest.mark.parametrize("abstract", [False, True])
def test_a_manager_that_is_gone_is_no_error_and_hears_the_next_sign_when_it_is_back(
    abstract: bool, tmp_path: Path
) -> None:
    address = f"@{tmp_path}" if abstract else str(tmp_path / "notify")
    watchdog = Watchdog({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1"})
    watchdog.ready("x")
    watchdog.tick()
    watchdog.stopping()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as back:
        back.settimeout(10.0)
        back.bind(address.replace("@", "\0", 1))
        watchdog.tick()
        assert back.recv(4096) == b"WATCHDOG=1"


def test_a_watchdog_meant_for_another_process_is_not_fed(manager: Manager) -> None:
    watchdog = Watchdog({**manager.environment(1.0), "WATCHDOG_PID": str(os.getpid() + 1)})
    watchdog.tick()
    assert manager.heard() == []


def test_a_full_socket_does_not_stop_the_control_thread(manager: Manager) -> None:
    watchdog = Watchdog(manager.environment(1e-6))
    for _ in range(2000):
        watchdog.tick()
    assert 0 < len(manager.heard()) < 2000


def test_only_the_control_tick_feeds_it(manager: Manager, tmp_path: Path) -> None:
    port = free_port()
    bridge = Bridge(port, "--param", "COM_OBL_RC_ACT=4")
    companion = Companion(
        tmp_path, port, before=HANGS.format(kind="asleep"), environment=manager.environment(1.0)
    )
    try:
        assert any(text.startswith("READY=1\nSTATUS=quad5 at") for text in manager.heard())
        companion.fly(trajectory="hover", parameters={"duration": 600.0})
        companion.phase("mission")
        assert "WATCHDOG=1" in manager.heard()
        companion.send(signal.SIGUSR1)  # the control thread hangs from here on, in the air
        wait_for(lambda: companion.told("no_odometry"), "the rest of the companion, which is well")
        manager.heard()
        time.sleep(1.5)
        assert manager.heard() == []
        assert companion.child.poll() is None
        assert companion.ask("status")["vehicle"] == "quad5", "it still answers, and is still not fed"
    finally:
        companion.end(signal.SIGKILL)
        bridge.end()


def test_a_thread_gets_its_priority_or_the_reason_why_not() -> None:
    found: list[tuple[str, int]] = []

    def ask() -> None:
        found.append((raise_priority(20), os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK))

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    ((reason, policy),) = found
    assert (policy == os.SCHED_FIFO) is (reason == "")
    assert reason == "" or "LimitRTPRIO" in reason
    assert os.sched_getscheduler(0) == os.SCHED_OTHER, "no other thread has it"
