"""The ground's end of Zenoh, on real sessions over loopback: requests, refusals, records, ticks, a whole
flight."""

import contextlib
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from json_schemas import valid
from processes import with_parent

from trueflight.companion.telemetry import PIECE, Telemetry, make_event, read_json
from trueflight.companion.zenoh_session import ZenohSettings, open_session
from trueflight.groundstation.commands import fly
from trueflight.groundstation.commands.app import app
from trueflight.groundstation.operate.link import Link, companions
from trueflight.groundstation.operate.settings import Settings, load_settings
from trueflight.groundstation.output.terminal import print_warning
from trueflight.models.errors import InputError, run_command_line
from trueflight.models.record_pb2 import Tick

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).parents[2]
QUAD5 = ROOT / "models" / "vehicles" / "quad5" / "vehicle.toml"
BIN = Path(sys.executable).parent


def free_port(kind=socket.SOCK_STREAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def endpoint():
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def served(endpoint, tmp_path):
    """The companion's telemetry with a vehicle that refuses what it does not know; no autopilot behind it."""
    asked: list[tuple[str, bytes]] = []

    def mission(payload, parameters):
        asked.append(("mission", payload))
        if read_json(payload).get("trajectory") == "hover":
            return {"accepted": True, "reason": "next", "mission": "m1", "duration": 10.0}
        return {"accepted": False, "reason": "the battery has 14.1 V, a flight needs 14.4 V"}

    def model(payload, parameters):
        asked.append(("model", payload))
        return {"accepted": False, "reason": "made for vehicle 'x500', this is 'quad5'"}

    records = tmp_path / "on_board"
    records.mkdir()
    telemetry = Telemetry(
        open_session(ZenohSettings(listen=(endpoint,))),
        "quad5",
        {
            "status": lambda payload, parameters: {"accepted": True, "phase": "idle"},
            "mission": mission,
            "model": model,
        },
        records,
    )
    telemetry.asked = asked
    yield telemetry, records
    telemetry.close()


def link_to(endpoint, **changes):
    return Link(Settings(connect=(endpoint,), timeout=5.0, **changes))


def test_the_only_vehicle_is_found_and_answers(served, endpoint):
    with link_to(endpoint) as link:
        assert link.vehicle == "quad5"
        assert link.alive()
        assert link.status() == {"accepted": True, "phase": "idle"}
        assert link.request("mission", {"trajectory": "hover"})["mission"] == "m1"
    assert companions(Settings(connect=(endpoint,), timeout=2.0)) == ["quad5"]


def test_a_refusal_is_told_with_its_reason(served, endpoint):
    with link_to(endpoint) as link, pytest.raises(InputError, match=r"refused: the battery has 14\.1 V"):
        link.request("mission", {"trajectory": "circle"})


def test_another_vehicles_name_is_told_with_those_that_are_there(served, endpoint):
    with pytest.raises(InputError, match=r"no companion 'x500' answers.*there are: quad5"):
        Link(Settings(connect=(endpoint,), name="x500", timeout=1.0))


def test_no_companion_is_told_with_the_endpoint_and_what_to_do(endpoint):
    with pytest.raises(InputError, match=rf"nobody answers on {endpoint}.*start the companion.*-e"):
        Link(Settings(connect=(endpoint,), timeout=1.0))


@pytest.mark.parametrize("size", [1, PIECE - 1, PIECE, 3 * PIECE + 12345])
def test_a_record_arrives_whole_whatever_its_size(served, endpoint, size, tmp_path):
    _, records = served
    content = os.urandom(size)
    (records / "flight.mcap").write_bytes(content)
    seen = []
    with link_to(endpoint) as link:
        assert [r["name"] for r in link.records()] == ["flight.mcap"]
        got = link.fetch_record(
            "flight.mcap", tmp_path / "got", lambda done, total: seen.append((done, total))
        )
    assert got.read_bytes() == content
    assert seen[-1] == (size, size)
    assert [p.name for p in (tmp_path / "got").iterdir()] == ["flight.mcap"]


def test_a_record_that_is_not_there_leaves_nothing_behind(served, endpoint, tmp_path):
    with link_to(endpoint) as link:
        with pytest.raises(InputError, match=r"no record 'nothing\.mcap'"):
            link.fetch_record("nothing.mcap", tmp_path / "got")
        with pytest.raises(InputError, match="not a file name"):
            link.fetch_record("../secret", tmp_path / "got")
    assert list((tmp_path / "got").iterdir()) == []


def test_ticks_and_events_arrive_in_order_with_their_history(served, endpoint):
    telemetry, _ = served
    for i in range(30):
        telemetry.tick(Tick(vehicle_time_us=i).SerializeToString())
    ticks, events = queue.SimpleQueue(), queue.SimpleQueue()
    with link_to(endpoint) as link:
        link.follow(ticks.put, events.put, history=20)
        end = time.monotonic() + 60
        while ticks.qsize() < 10 and time.monotonic() < end:
            time.sleep(0.02)
        for i in range(30, 60):
            telemetry.tick(Tick(vehicle_time_us=i).SerializeToString())
        telemetry.event(make_event("warning", "guard_trip", "left the envelope"))
        assert events.get(timeout=60).kind == "guard_trip"
        got = []
        while not got or got[-1] < 59:
            got.append(ticks.get(timeout=60).vehicle_time_us)
    assert got == sorted(got)
    assert set(range(30, 60)) <= set(got) and got[0] >= 10


def run(arguments, capsys):
    code = 0
    try:
        run_command_line(lambda: app([str(a) for a in arguments], standalone_mode=False))
    except SystemExit as stopped:
        code = stopped.code
    told = capsys.readouterr()
    return code, told.out, told.err


BAD_COMMANDS = {
    "unknown trajectory": (["fly", "circel"], ["no trajectory 'circel'", "did you mean 'circle'"]),
    "unknown parameter": (["fly", "circle", "--set", "sped=2"], ["no parameter 'sped'"]),
    "no value": (["fly", "circle", "--set", "speed"], ["write NAME=VALUE"]),
    "unknown controller": (["fly", "circle", "--controller", "pid"], ["use one of lqr"]),
    "no setpoints": (["fly", "nothing.csv"], ["cannot read the setpoints", "check the path"]),
    "no model": (["deploy", "nothing.onnx"], ["nothing.onnx", "model export"]),
    "model is no ONNX": (
        ["deploy", __file__.replace("test_link.py", "empty.onnx")],
        ["cannot read the model"],
    ),
    "bad zenoh setting": (["status", "--cfg", "nonsense"], ["write KEY:VALUE"]),
    "no configuration": (["status", "--config", "nothing.toml"], ["cannot read the configuration"]),
}


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_a_wrong_command_is_told_before_anything_is_asked(case, endpoint, capsys):
    arguments, words = BAD_COMMANDS[case]
    code, out, err = run([*arguments, "-e", endpoint, "--timeout", "1"], capsys)
    assert code == 2 and out == "" and err.count("\n") == 1
    for word in words:
        assert word in err


def test_deploy_tells_why_a_model_was_refused(served, endpoint, tmp_path, capsys):
    telemetry, _ = served
    path = tmp_path / "model.onnx"
    path.write_bytes(b"\x08\x0a some network")
    code, _, err = run(["deploy", path, "-e", endpoint], capsys)
    assert code == 2 and "made for vehicle 'x500', this is 'quad5'" in err and err.count("\n") == 1
    assert telemetry.asked[-1] == ("model", path.read_bytes())


CONFIGS = {
    "typo": ("conect = []", ["unknown key 'conect'", "did you mean 'connect'"]),
    "type": ("timeout = 'long'", ["'timeout' must be"]),
    "list": ("connect = 'tcp/127.0.0.1:7447'", ["'connect' must be a list"]),
}


@pytest.mark.parametrize("case", CONFIGS)
def test_a_bad_configuration_is_told(case, tmp_path):
    text, words = CONFIGS[case]
    path = tmp_path / "groundstation.toml"
    path.write_text(text)
    with pytest.raises(InputError) as told:
        load_settings(path)
    for word in ["groundstation.toml", *words]:
        assert word in str(told.value)


def test_the_example_configuration_holds_the_defaults():
    example = load_settings(ROOT / "groundstation" / "groundstation.toml")
    assert example.flights.endswith("groundstation/flights")
    assert {**vars(example), "flights": "flights"} == vars(Settings())


@pytest.fixture
def processes(endpoint, tmp_path):
    """A bridge and a companion, as a user starts them."""
    mavlink, own = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    commands = [
        ["sim-bridge", "run", "--vehicle", QUAD5, "--hidden", "none", "--pilot-port", "0", "--port", own]
        + ["--mavlink", f"udpout:127.0.0.1:{mavlink}"],
        ["companion", "run", "--vehicle", QUAD5, "--connect", f"udpin://127.0.0.1:{mavlink}", "-l", endpoint]
        + ["--records", tmp_path / "on_board", "--models", tmp_path / "models"],
    ]
    running = []
    try:
        for command in commands:
            arguments = [str(BIN / command[0]), *map(str, command[1:])]
            child = subprocess.Popen(
                arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, preexec_fn=with_parent
            )
            running.append(child)
            line = child.stdout.readline()
            assert line.startswith("ready:"), line + child.stdout.read()
            threading.Thread(target=child.stdout.read, daemon=True).start()
        yield
    finally:
        for child in reversed(running):
            child.send_signal(signal.SIGTERM)
            child.wait(90)


def test_a_flight_is_asked_for_watched_fetched_and_tracked(processes, endpoint, tmp_path):
    """Bridge, companion and ground station as separate processes, from the request to the tracking error."""
    recording = tmp_path / "live.rrd"
    program = str(BIN / "groundstation")
    environment = {**os.environ, "RERUN_ANALYTICS": "0"}

    def ground(*arguments):
        told = subprocess.run(
            [program, *map(str, arguments)], capture_output=True, text=True, env=environment, timeout=120
        )
        assert told.returncode == 0, told.stderr
        return told.stdout

    assert valid("groundstation status", json.loads(ground("status", "-e", endpoint, "--json")))["ready"]
    # as a shell starts it in the background: Ctrl-C ignored
    watch = subprocess.Popen(
        ["sh", "-c", f"{program} monitor -e {endpoint} --save {recording} --json & echo $!; wait"],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=with_parent,
    )
    watching = int(watch.stdout.readline())
    flown = json.loads(
        ground(
            "fly", "hover", "--set", "duration=10", "-e", endpoint, "--wait", "-o", tmp_path / "got", "--json"
        )
    )
    assert flown["state"] == "finished"
    os.kill(watching, signal.SIGINT)
    told, _ = watch.communicate(timeout=60)
    looks = [valid("groundstation monitor", json.loads(line)) for line in told.splitlines()]
    judged = [one for one in looks if one["kind"] == "look" and not one["error"]]
    assert judged and not [one for one in looks if one["kind"] == "alert"]
    assert {e["verdict"] for e in judged[-1]["effects"]} <= {
        "included",
        "minor",
        "not_supported",
        "not_excited",
    }
    assert [f.name for f in tmp_path.iterdir() if "live" in f.name] == ["live.rrd"]
    checked = subprocess.run([str(BIN / "rerun"), "rrd", "verify", recording], capture_output=True, text=True)
    assert checked.returncode == 0 and recording.stat().st_size > 10_000, checked.stderr
    valid("groundstation fly", flown)
    (tracked,) = json.loads(ground("track", flown["record"], "--json"))
    assert tracked["rms"] < 0.15
    (row,) = json.loads(ground("flights", tmp_path / "got", "--json"))
    assert (row["trajectory"], row["controller"], row["error"]) == ("hover", "lqr", "")
    assert "hover lqr: finished" in ground("status", "-e", endpoint)


def test_what_is_open_to_anybody_is_told_in_red(endpoint, tmp_path, capsys):
    from trueflight.groundstation.views.monitor import state

    status = {
        "accepted": True,
        "access": {"keys": "", "exposed": ["listens on tcp/0.0.0.0:7447"], "loose": ""},
        "phase": "idle",
    }
    telemetry = Telemetry(
        open_session(ZenohSettings(listen=(endpoint,))), "quad5", {"status": lambda p, q: status}, tmp_path
    )
    try:
        with link_to(endpoint) as link:
            assert "insecure" in link.warning and "tcp/0.0.0.0:7447" in link.warning
            page = state("quad5", Tick(phase="idle"), 0.0, {"insecure": link.warning})
            assert "**INSECURE**" in page and "tcp/0.0.0.0:7447" in page
            print_warning(link.warning)
            assert "anybody on the network can fly it" in capsys.readouterr().err
    finally:
        telemetry.close()


def test_a_companion_that_was_started_again_is_followed_and_obeys(endpoint, tmp_path):
    def serve():
        asked = []
        telemetry = Telemetry(
            open_session(ZenohSettings(listen=(endpoint,))),
            "quad5",
            {
                "status": lambda payload, parameters: {"accepted": True, "phase": "idle"},
                "mission": lambda payload, parameters: asked.append(payload) or {"accepted": True},
            },
            tmp_path,
        )
        return telemetry, asked

    first, _ = serve()
    with link_to(endpoint) as link:
        before = link.instance
        first.close()
        second, asked = serve()
        try:
            end = time.monotonic() + 60
            while link.instance == before and time.monotonic() < end:
                with contextlib.suppress(InputError):  # until Zenoh has connected again
                    link.status()
            assert link.instance != before
            assert link.request("mission", {"trajectory": "hover"})["accepted"] and len(asked) == 1
        finally:
            second.close()


def test_ctrl_c_while_a_flight_is_followed_says_that_it_goes_on(capsys):
    class Interrupted:
        def end_of(self, mission, tell):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fly._accompany(Interrupted(), "m3", queue.SimpleQueue(), True)
    assert "m3 flies on, and its record stays on board; groundstation status" in capsys.readouterr().err
