"""Odometry to setpoint, seen from the autopilot: the flying companion beside bare MAVSDK programs, in one run.

    python benchmarks/companion_latency.py [--rates 100,250,500] [--loads 0,2] [--seconds 5] [--rounds 3]
                                           [--programs plugins,companion] [--raw samples.json] [--json]

The simulated autopilot runs in a process of its own and notes when it sends an odometry message and
when the setpoint comes back. These programs answer it: MAVSDK's telemetry and offboard plugins as its
documentation shows them (`plugins`), `mavlink_direct` in both directions (`direct`), both with a constant answer, and
`companion run` in flight, with its record and one listener on Zenoh: by the plain cascade (`companion`), and corrected
by the models of `correction_models.py` (`effects`, `network`, `both`). All ask for the same messages at the same rates,
and for all of them the autopilot is armed, in Offboard and flies its physics by what it is sent: the constant answer
is that of a hover. Programs take turns, `--rounds` times, because others on the machine disturb them; latencies of all
rounds are pooled. With `--loads` of more than 0 so many busy programs run beside them. A setpoint counts as lost when
none came within 50 ms, or when a later odometry message was answered first: the companion's setpoints tell by their
time which one they answer, those of the bare programs are taken in their order. `cpu` is the processor time of the
program while it is measured, as a share of one core. `--raw` keeps every latency.
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
ECHOES = ("plugins", "direct")
MODELS = ("effects", "network", "both")
PROGRAMS = (*ECHOES, "companion", *MODELS)
HIGH = 200.0  # m: an open-loop hover may drift for a while


def autopilot(mavlink: int, port: int, flying: bool, seconds: float) -> None:
    """The simulated autopilot with a stopwatch; prints `measuring`, then its findings as JSON, and ends."""
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
    if not flying:  # nobody will arm it and climb
        pilot.simulator.start_in_hover((0.0, 0.0, HIGH))
        pilot.arm(force=True)
    pending: deque[tuple[float, int]] = deque()
    latencies: list[float] = []
    sent = 0
    begin = [0.0]
    send, handle = server._send, server.commands._handlers["SET_ATTITUDE_TARGET"]

    def measuring(now: float) -> bool:
        if not (pilot.armed and pilot.mode is Mode.OFFBOARD):
            begin[0] = 0.0
            return False
        begin[0] = begin[0] or now
        return WARM_UP < now - begin[0] < WARM_UP + seconds

    def timed_send(peer: Any, message: Any) -> None:
        nonlocal sent
        if message.get_msgId() == mav.MAVLINK_MSG_ID_ODOMETRY and peer.permanent:
            now = time.perf_counter()
            if measuring(now):
                if not sent:
                    print("measuring", flush=True)
                pending.append((now, message.time_usec // 1000 & 0xFFFFFFFF))
                sent += 1
        send(peer, message)

    def timed_handle(message: Any, peer: Any) -> Any:
        now = time.perf_counter()
        while pending and now - pending[0][0] > LOST_AFTER:
            pending.popleft()
        while flying and pending and pending[0][1] < message.time_boot_ms:
            pending.popleft()
        if pending and (not flying or pending[0][1] == message.time_boot_ms):
            latencies.append(now - pending.popleft()[0])
        answer = handle(message, peer)
        if not flying and pilot.mode is not Mode.OFFBOARD:
            pilot.set_mode(Mode.OFFBOARD)
        return answer

    server._send = timed_send  # type: ignore[method-assign]
    server.commands._handlers["SET_ATTITUDE_TARGET"] = timed_handle
    print("ready", flush=True)

    def running() -> bool:
        return not (begin[0] and time.perf_counter() - begin[0] > WARM_UP + seconds + 2 * LOST_AFTER)

    server.run(running)
    height = float(pilot.simulator.estimate().position[2])
    print(json.dumps({"sent": sent, "latencies": latencies, "height": height}), flush=True)
    server.close()


def echo(mavlink: int, rate: float, kind: str, hover: float) -> None:
    """A bare MAVSDK program that answers each odometry message with the constant setpoint of a hover."""
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
        telemetry.subscribe_odometry(
            lambda odometry, _: offboard.set_attitude_rate(AttitudeRate(0, 0, 0, hover))
        )
    else:
        direct = MavlinkDirect(system)
        fields = '{"time_boot_ms":0,"target_system":1,"target_component":1,"type_mask":128,"q":[1,0,0,0],'
        fields += f'"body_roll_rate":0,"body_pitch_rate":0,"body_yaw_rate":0,"thrust":{hover},"thrust_body":[0,0,0]}}'
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


def processor_time(process: subprocess.Popen[str]) -> float:
    """s of the processor that a process has had."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def flown(kind: str, mavlink: int, rate: float, seconds: float, folder: Path, models: Path) -> list[Any]:
    """`companion run`, ready, and the ground that asks for a hover and listens."""
    store = folder / "models"
    if kind in MODELS:
        # As a model lies there that has proved itself in an earlier flight.
        from trueflight.models.contract import model_hash

        onnx = (models / f"{kind}.onnx").read_bytes()
        store.mkdir()
        (store / f"{model_hash(onnx)}.onnx").write_bytes(onnx)
        (store / "history.json").write_text(json.dumps([model_hash(onnx)]))
    zenoh_port = free_port(socket.SOCK_STREAM)
    subject = spawn(
        *("-c", "from trueflight.companion.cli import main; main()", "run", "--vehicle", VEHICLE),
        *("--connect", f"udpin://127.0.0.1:{mavlink}", "--rate", rate, "--records", folder / "records"),
        *("--models", store, "-l", f"tcp/127.0.0.1:{zenoh_port}"),
    )
    line(subject, "ready")
    controller = "corrected" if kind in MODELS else "lqr"
    return [subject, spawn(__file__, "--listen", zenoh_port, seconds + 30.0, controller)]


def measure(kind: str, rate: float, seconds: float, models: Path, load: int) -> dict[str, Any]:
    """One program against the autopilot at one rate, once it is ready beside `load` busy ones."""
    mavlink, flying = free_port(), kind not in ECHOES
    pilot = spawn(__file__, "--autopilot", mavlink, free_port(), int(flying), seconds)
    line(pilot, "ready")
    with tempfile.TemporaryDirectory() as folder:
        if flying:
            others = flown(kind, mavlink, rate, seconds, Path(folder), models)
        else:
            from trueflight.models.vehicle import load_vehicle

            others = [spawn(__file__, "--echo", mavlink, rate, kind, load_vehicle(VEHICLE).hover_thrust)]
        others += busy(load)
        try:
            line(pilot, "measuring")
            begin, spent = time.monotonic(), processor_time(others[0])
            result: dict[str, Any] = json.loads(line(pilot, "{"))
            result["cpu"] = (processor_time(others[0]) - spent) / (time.monotonic() - begin)
            status = Path(f"/proc/{others[0].pid}/status").read_text()
            result["resident_mb"] = int(status.split("VmRSS:")[1].split()[0]) / 1024
            assert result["height"] > 0.3, "the vehicle did not fly"
        finally:
            for process in (*others, pilot):
                process.kill()
                process.wait()
    return result


def summary(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """Latencies of all rounds of one program, pooled."""
    latencies = sorted(x for one in rounds for x in one["latencies"])
    count = len(latencies)
    return {
        "sent": sum(one["sent"] for one in rounds),
        "lost": sum(one["sent"] - len(one["latencies"]) for one in rounds),
        "median_ms": 1e3 * statistics.median(latencies),
        "p99_ms": 1e3 * latencies[int(0.99 * count)],
        "p999_ms": 1e3 * latencies[int(0.999 * count)],
        "max_ms": 1e3 * latencies[-1],
        "cpu": statistics.median(one["cpu"] for one in rounds),
        "resident_mb": max(one["resident_mb"] for one in rounds),
    }


def listen(port: int, seconds: float, controller: str) -> None:
    """The ground: asks for a long hover and listens to every tick."""
    import zenoh

    from trueflight.models import contract

    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber(contract.key("quad5", "tick"), lambda sample: None)
        request = {"trajectory": "hover", "parameters": {"duration": 3600.0}, "controller": controller}
        for reply in session.get(contract.key("quad5", "mission"), payload=json.dumps(request)):
            answer = json.loads(reply.ok.payload.to_string())
            if not answer["accepted"]:
                print(answer["reason"], file=sys.stderr)
        time.sleep(seconds)
        subscriber.undeclare()


def busy(count: int) -> list[subprocess.Popen[str]]:
    """So many programs that never rest."""
    return [spawn("-c", "while True: pass") for _ in range(count)]


def compared(rate: float, load: int, programs: list[str], a: argparse.Namespace) -> list[dict[str, Any]]:
    """One row a program at one rate and load, as ratios to the first."""
    rounds = [
        {kind: measure(kind, rate, a.seconds, a.models, load) for kind in programs} for _ in range(a.rounds)
    ]
    rows: list[dict[str, Any]] = []
    for kind in programs:
        own = [one[kind] for one in rounds]
        row = {"rate": rate, "load": load, "program": kind, **summary(own)}
        bare = rows[0] if rows else row
        row |= {f"{name}_ratio": row[f"{name}_ms"] / bare[f"{name}_ms"] for name in ("median", "p99", "p999")}
        if a.raw:
            row["latencies"] = [one["latencies"] for one in own]
        rows.append(row)
    return rows


def told(row: dict[str, Any]) -> str:
    """A row in words."""
    return (
        f"{row['rate']:4.0f} Hz  load {row['load']}  {row['program']:9s}  "
        f"sent {row['sent']:6d}  lost {row['lost']:3d}  "
        f"median {row['median_ms']:.3f} ms ({row['median_ratio']:.2f}x)  p99 {row['p99_ms']:6.3f} ms "
        f"({row['p99_ratio']:.2f}x)  p99.9 {row['p999_ms']:6.2f} ms ({row['p999_ratio']:.2f}x)  "
        f"max {row['max_ms']:6.2f} ms  cpu {100 * row['cpu']:3.0f} %  resident {row['resident_mb']:.0f} MB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rates", default="100,250,500")
    parser.add_argument("--loads", default="0")
    parser.add_argument("--programs", default="plugins,direct,companion", help=", ".join(PROGRAMS))
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--models", type=Path, default=Path("build/correction_models"))
    parser.add_argument("--raw", type=Path)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--autopilot", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--echo", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--listen", nargs=3, help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.autopilot:
        mavlink, port, flying, seconds = a.autopilot
        autopilot(int(mavlink), int(port), flying == "1", float(seconds))
    elif a.echo:
        echo(int(a.echo[0]), float(a.echo[1]), a.echo[2], float(a.echo[3]))
    elif a.listen:
        listen(int(a.listen[0]), float(a.listen[1]), a.listen[2])
    else:
        run(a)


def run(a: argparse.Namespace) -> None:
    programs = a.programs.split(",")
    unknown = set(programs) - set(PROGRAMS)
    if unknown:
        raise SystemExit(f"unknown programs {', '.join(sorted(unknown))}; known: {', '.join(PROGRAMS)}")
    if set(programs) & set(MODELS) and not (a.models / "both.onnx").exists():
        a.models.mkdir(parents=True, exist_ok=True)
        script = Path(__file__).with_name("correction_models.py")
        subprocess.run([sys.executable, script, a.models], check=True)
    rows = []
    for load in map(int, a.loads.split(",")):
        for rate in map(float, a.rates.split(",")):
            rows += compared(rate, load, programs, a)
            if not a.json:
                print(*map(told, rows[-len(programs) :]), sep="\n", flush=True)
    if a.raw:
        a.raw.write_text(json.dumps(rows))
    if a.json:
        for row in rows:
            row.pop("latencies", None)
        print(json.dumps({"load": os.getloadavg(), "rows": rows}))


if __name__ == "__main__":
    main()
