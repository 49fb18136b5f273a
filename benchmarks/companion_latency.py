"""Odometry to setpoint, seen from the autopilot: the flying companion beside bare MAVSDK programs, in one run.

    python benchmarks/companion_latency.py [--rates 100,250,500] [--seconds 5] [--rounds 3] [--json]

The simulated autopilot runs in a process of its own and notes when it sends an odometry message and
when the setpoint comes back. Three programs answer it: MAVSDK's telemetry and offboard plugins as its
documentation shows them (`plugins`), `mavlink_direct` in both directions with a constant answer
(`direct`), and `companion run` in flight, with its record and one listener on Zenoh. All three ask for
the same messages at the same rates, so that the link and the autopilot have the same to do. They take
turns, `--rounds` times, because other programs on the machine disturb them; latencies of all rounds are
pooled. A setpoint counts as lost when none came within 50 ms, or when a later odometry message was answered first: the
companion's setpoints tell by their time which one they answer, those of the bare programs are taken in their order.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from pathlib import Path
from typing import Any

VEHICLE = Path(__file__).parents[1] / "models" / "vehicles" / "quad5" / "vehicle.toml"
LOST_AFTER = 0.05  # s
WARM_UP = 2.0  # s
PROGRAMS = ("plugins", "direct", "companion")


def autopilot(mavlink: int, port: int, flying: bool, seconds: float) -> None:
    """The simulated autopilot with a stopwatch; prints its findings as JSON and ends."""
    from pymavlink.dialects.v20 import common as mav

    from trueflight.models.vehicle import load_vehicle
    from trueflight.sim_bridge.autopilot import Autopilot
    from trueflight.sim_bridge.mavlink.server import Link, Server
    from trueflight.sim_bridge.modes import Mode
    from trueflight.sim_bridge.parameters import Parameters
    from trueflight.sim_bridge.simulator import Simulator
    from trueflight.sim_bridge.truth.hidden import choose

    vehicle = load_vehicle(VEHICLE)
    pilot = Autopilot(Simulator(vehicle, choose(["none"], vehicle, 0), 0), Parameters(vehicle))
    server = Server(pilot, Link(("127.0.0.1", port), ("127.0.0.1", mavlink), 0))
    pending: deque[tuple[float, int]] = deque()
    latencies: list[float] = []
    sent = 0
    begin = [0.0]
    send, handle = server._send, server.commands._handlers["SET_ATTITUDE_TARGET"]

    def measuring(now: float) -> bool:
        ready = (pilot.armed and pilot.mode is Mode.OFFBOARD) if flying else bool(answered)
        if not ready:
            begin[0] = 0.0
            return False
        begin[0] = begin[0] or now
        return WARM_UP < now - begin[0] < WARM_UP + seconds

    answered: list[float] = []

    def timed_send(peer: Any, message: Any) -> None:
        nonlocal sent
        if message.get_msgId() == mav.MAVLINK_MSG_ID_ODOMETRY and peer.permanent:
            now = time.perf_counter()
            if measuring(now):
                pending.append((now, message.time_usec // 1000 & 0xFFFFFFFF))
                sent += 1
        send(peer, message)

    def timed_handle(message: Any, peer: Any) -> Any:
        now = time.perf_counter()
        answered.append(now)
        while pending and now - pending[0][0] > LOST_AFTER:
            pending.popleft()
        while flying and pending and pending[0][1] < message.time_boot_ms:
            pending.popleft()
        if pending and (not flying or pending[0][1] == message.time_boot_ms):
            latencies.append(now - pending.popleft()[0])
        return handle(message, peer)

    server._send = timed_send  # type: ignore[method-assign]
    server.commands._handlers["SET_ATTITUDE_TARGET"] = timed_handle
    print("ready", flush=True)

    def running() -> bool:
        return not (begin[0] and time.perf_counter() - begin[0] > WARM_UP + seconds + 2 * LOST_AFTER)

    server.run(running)
    print(json.dumps({"sent": sent, "latencies": latencies}), flush=True)
    server.close()


def echo(mavlink: int, rate: float, kind: str) -> None:
    """A bare MAVSDK program that answers each odometry message with a constant setpoint."""
    import mavsdk
    from mavsdk.mavsdk import Configuration, Mavsdk
    from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkMessage
    from mavsdk.plugins.offboard import Offboard
    from mavsdk.plugins.offboard.offboard import AttitudeRate
    from mavsdk.plugins.telemetry import Telemetry

    mavsdk.log_subscribe(lambda level, text, file, line: True)
    wire = Mavsdk(Configuration.create_with_component_type(mavsdk.ComponentType.COMPANION_COMPUTER))
    wire.add_any_connection(f"udpin://127.0.0.1:{mavlink}")
    system = wire.first_autopilot(20.0)
    assert system is not None
    telemetry = Telemetry(system)
    if kind == "plugins":
        offboard = Offboard(system)
        telemetry.subscribe_odometry(lambda odometry, _: offboard.set_attitude_rate(AttitudeRate(0, 0, 0, 0)))
    else:
        direct = MavlinkDirect(system)
        fields = '{"time_boot_ms":0,"target_system":1,"target_component":1,"type_mask":128,"q":[1,0,0,0],'
        fields += '"body_roll_rate":0,"body_pitch_rate":0,"body_yaw_rate":0,"thrust":0,"thrust_body":[0,0,0]}'
        message = MavlinkMessage(
            "SET_ATTITUDE_TARGET", target_system_id=1, target_component_id=1, fields_json=fields
        )
        direct.subscribe_message("ODOMETRY", lambda odometry, _: direct.send_message(message))
    # As the companion asks for them, by name so that this program stays independent of it.
    wishes = {331: rate, 105: max(rate, 250.0) if rate < 250.0 else rate, 147: 10.0, 291: min(rate, 100.0)}
    wishes |= {245: 5.0, 0: 10.0}
    commands = MavlinkDirect(system)
    for number, wish in wishes.items():
        fields = {f"param{i}": 0.0 for i in range(1, 8)} | {"param1": float(number), "param2": 1e6 / wish}
        target = {"target_system": 1, "target_component": 1, "command": 511, "confirmation": 0}
        commands.send_command(MavlinkMessage("COMMAND_LONG", fields_json=json.dumps(fields | target)))
    signal.pause()


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def spawn(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, *map(str, arguments)], stdout=subprocess.PIPE, text=True)


def line(process: subprocess.Popen[str], begin: str) -> str:
    assert process.stdout is not None
    for text in process.stdout:
        if text.startswith(begin):
            return text
    raise RuntimeError("ended without an answer")


def measure(kind: str, rate: float, seconds: float) -> dict[str, Any]:
    """One program against the autopilot at one rate."""
    mavlink, flying = free_port(), kind == "companion"
    pilot = spawn(__file__, "--autopilot", mavlink, free_port(), int(flying), seconds)
    line(pilot, "ready")
    result: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        if flying:
            zenoh_port = free_port(socket.SOCK_STREAM)
            subject = spawn(
                *("-c", "from trueflight.companion.cli import main; main()", "run", "--vehicle", VEHICLE),
                *(
                    "--connect",
                    f"udpin://127.0.0.1:{mavlink}",
                    "--rate",
                    rate,
                    "--records",
                    f"{folder}/records",
                ),
                *("--models", f"{folder}/models", "-l", f"tcp/127.0.0.1:{zenoh_port}"),
            )
            line(subject, "ready")
            listener = spawn(__file__, "--listen", zenoh_port, seconds + 30.0)
        else:
            subject, listener = spawn(__file__, "--echo", mavlink, rate, kind), None
        try:
            result.update(json.loads(line(pilot, "{")))
            status = Path(f"/proc/{subject.pid}/status").read_text()
            result["resident_mb"] = int(status.split("VmRSS:")[1].split()[0]) / 1024
        finally:
            for process in (subject, listener, pilot):
                if process is not None:
                    process.kill()
                    process.wait()
    return result


def summary(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """Latencies of all rounds of one program, pooled."""
    latencies = sorted(x for one in rounds for x in one["latencies"])
    return {
        "sent": sum(one["sent"] for one in rounds),
        "lost": sum(one["sent"] - len(one["latencies"]) for one in rounds),
        "median_ms": 1e3 * statistics.median(latencies),
        "p99_ms": 1e3 * latencies[int(0.99 * len(latencies))],
        "max_ms": 1e3 * latencies[-1],
        "resident_mb": max(one["resident_mb"] for one in rounds),
    }


def listen(port: int, seconds: float) -> None:
    """The ground: asks for a long hover and listens to every tick."""
    import zenoh

    from trueflight.models import contract

    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber(contract.key("quad5", "tick"), lambda sample: None)
        request = {"trajectory": "hover", "parameters": {"duration": 3600.0}}
        for reply in session.get(contract.key("quad5", "mission"), payload=json.dumps(request)):
            answer = json.loads(reply.ok.payload.to_string())
            if not answer["accepted"]:
                print(answer["reason"], file=sys.stderr)
        time.sleep(seconds)
        subscriber.undeclare()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rates", default="100,250,500")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--autopilot", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--echo", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--listen", nargs=2, help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.autopilot:
        mavlink, port, flying, seconds = a.autopilot
        autopilot(int(mavlink), int(port), flying == "1", float(seconds))
    elif a.echo:
        echo(int(a.echo[0]), float(a.echo[1]), a.echo[2])
    elif a.listen:
        listen(int(a.listen[0]), float(a.listen[1]))
    else:
        rows = []
        for rate in map(float, a.rates.split(",")):
            rounds = [[measure(kind, rate, a.seconds) for kind in PROGRAMS] for _ in range(a.rounds)]
            bare = summary([one[0] for one in rounds])
            for i, kind in enumerate(PROGRAMS):
                row = {"rate": rate, "program": kind, **summary([one[i] for one in rounds])}
                row["median_ratio"] = row["median_ms"] / bare["median_ms"]
                row["p99_ratio"] = row["p99_ms"] / bare["p99_ms"]
                rows.append(row)
                if not a.json:
                    print(
                        f"{rate:5.0f} Hz  {kind:9s}  sent {row['sent']:6d}  lost {row['lost']:3d}  "
                        f"median {row['median_ms']:.3f} ms ({row['median_ratio']:.2f}x)  "
                        f"p99 {row['p99_ms']:.3f} ms ({row['p99_ratio']:.2f}x)  "
                        f"max {row['max_ms']:6.2f} ms  resident {row['resident_mb']:.0f} MB",
                        flush=True,
                    )
        if a.json:
            print(json.dumps({"load": os.getloadavg(), "rows": rows}))


if __name__ == "__main__":
    main()
