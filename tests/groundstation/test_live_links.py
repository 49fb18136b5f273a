"""Links that break while a flight is watched, and several vehicles: real sessions, routers and processes."""

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from dropped import QUAD5, dropped_payload
from json_schemas import valid
from processes import with_parent

from trueflight.companion.telemetry import Telemetry
from trueflight.companion.zenoh_session import ZenohSettings, open_session
from trueflight.groundstation.live.sources import FromLink
from trueflight.groundstation.live.watch import Watch
from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.settings import Settings
from trueflight.groundstation.output.live_lines import JsonLines
from trueflight.models.model import rigid_body_model
from trueflight.models.record import read_messages
from trueflight.models.vehicle import load_vehicle

pytestmark = pytest.mark.realtime

PATIENCE = 90.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    return dropped_payload(tmp_path_factory.mktemp("flown") / "dropped.mcap", rate=100.0)


ROUTER = """
import sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
session = zenoh.open(config)
print("ready", flush=True)
time.sleep(600)
"""


def router(endpoint):
    child = subprocess.Popen(
        [sys.executable, "-c", ROUTER, endpoint], stdout=subprocess.PIPE, text=True, preexec_fn=with_parent
    )
    assert child.stdout.readline() == "ready\n"
    return child


def free_endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def companion(name, records, **how):
    """The companion's end of Zenoh, serving records, with no autopilot behind it."""
    return Telemetry(
        open_session(ZenohSettings(**how)),
        name,
        {"status": lambda payload, parameters: {"accepted": True, "phase": "mission"}},
        records,
    )


def wait_for(condition, step=lambda: None):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        step()
        time.sleep(0.02)


def test_a_hole_that_a_dead_router_left_is_filled_from_the_companions_record(flown, tmp_path):
    ticks, _ = read_messages(flown)
    on_board = tmp_path / "on_board"
    on_board.mkdir()
    os.link(flown, on_board / "flight.mcap")
    endpoint = free_endpoint()
    first = router(endpoint)
    told: queue.SimpleQueue[dict] = queue.SimpleQueue()
    telemetry = companion("quad5", on_board, connect=(endpoint,), listen=(), mode="client")
    try:
        with Link(Settings(connect=(endpoint,), mode="client", timeout=10.0)) as link:
            source = FromLink(link)
            watch = Watch([source], [JsonLines(told.put)], None, rigid_body_model, 60.0)

            def send(part):
                for tick in part:
                    telemetry.tick(tick.SerializeToString())
                    time.sleep(0.0002)

            def begin():  # what is published before the router knows who listens reaches nobody
                send(ticks[:1])
                watch.round()

            wait_for(lambda: watch.seen > 0, begin)
            send(ticks[1:200])
            wait_for(lambda: watch.seen >= 200, watch.round)
            first.send_signal(signal.SIGKILL)
            first.wait()
            watch.round()
            seen = watch.seen
            send(ticks[200:1350])  # more than the companion keeps for a link that comes back
            second = router(endpoint)
            rest = iter(ticks[1350:])

            def go_on():
                watch.round()
                time.sleep(0.1)
                send([next(rest)])

            wait_for(lambda: watch.seen > seen, go_on)
            filled: list[dict] = []

            def look():
                watch.round()
                filled.extend(
                    one for one in (told.get() for _ in range(told.qsize())) if one["kind"] == "filled"
                )

            wait_for(lambda: filled, look)
            assert source.vehicle == replace(load_vehicle(QUAD5), source=source.vehicle.source)
            source.close()
            second.kill()
    finally:
        telemetry.close()
        first.kill()
    start, stop = filled[0]["vehicle_time"]
    assert stop - start > 0.5 and filled[0]["ticks"] == pytest.approx(100 * (stop - start), abs=2)


def test_two_vehicles_are_watched_at_once(flown, tmp_path):
    ticks, _ = read_messages(flown)
    ends = {name: free_endpoint() for name in ("one", "two")}
    served = {name: companion(name, tmp_path, listen=(end,)) for name, end in ends.items()}
    program = str(Path(sys.executable).parent / "groundstation")
    arguments = ["monitor", "--json", "--vehicle", str(QUAD5), "--save", str(tmp_path / "both.rrd")]
    for end in ends.values():
        arguments += ["-e", end]
    child = subprocess.Popen([program, *arguments], stdout=subprocess.PIPE, text=True, preexec_fn=with_parent)
    try:
        looked: set[str] = set()
        flying = iter(range(len(ticks)))
        lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=lambda: [lines.put(x) for x in child.stdout], daemon=True).start()

        def step():
            for k in (next(flying, None) for _ in range(2)):
                if k is not None:
                    for telemetry in served.values():
                        telemetry.tick(ticks[k].SerializeToString())
            for _ in range(lines.qsize()):
                told = valid("groundstation monitor", json.loads(lines.get()))
                if told["kind"] == "look" and not told["error"]:
                    looked.add(told["vehicle"])

        wait_for(lambda: looked == {"one", "two"}, step)
        child.send_signal(signal.SIGINT)
        assert child.wait(PATIENCE) == 0
        assert (tmp_path / "both.rrd").stat().st_size > 10_000
    finally:
        child.kill()
        for telemetry in served.values():
            telemetry.close()
