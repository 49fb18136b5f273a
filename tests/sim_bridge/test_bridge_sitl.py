"""`sim-bridge sitl` flown over loopback TCP by a scripted peer that does what a real PX4 was seen to do."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridge_process import QUAD5, free_ports
from json_schemas import valid
from processes import with_parent
from px4_peer import ARMED, Hover, ParameterServer, Px4Peer
from pymavlink.dialects.v20 import common as mav

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle, vehicle_from_table
from trueflight.sim_bridge.mavlink.stream import MessageStream
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.sitl import lockstep
from trueflight.sim_bridge.sitl.allocation import differences, expected_parameters
from trueflight.sim_bridge.sitl.lockstep import Ending, Lockstep, listen
from trueflight.sim_bridge.sitl.sensors import RawNoise, RawSensors

pytestmark = pytest.mark.realtime

IRIS = {
    **{"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4},
    **{f"PWM_MAIN_FUNC{i + 1}": 101 + i for i in range(4)},
    **{"CA_ROTOR0_PX": 0.1515, "CA_ROTOR0_PY": 0.245, "CA_ROTOR0_KM": 0.05},
    **{"CA_ROTOR1_PX": -0.1515, "CA_ROTOR1_PY": -0.1875, "CA_ROTOR1_KM": 0.05},
    **{"CA_ROTOR2_PX": 0.1515, "CA_ROTOR2_PY": -0.245, "CA_ROTOR2_KM": -0.05},
    **{"CA_ROTOR3_PX": -0.1515, "CA_ROTOR3_PY": 0.1875, "CA_ROTOR3_KM": -0.05},
    **{"SIM_BAT_ENABLE": 1, "COM_FLTT_LOW_ACT": 3, "MPC_THR_HOVER": 0.5},
}
"""What PX4 1.15 has with PX4_SIM_MODEL=none_iris."""


@dataclass
class Running:
    """A running `sim-bridge sitl --json`: its process, its ports, and the events it tells."""

    process: subprocess.Popen[str]
    port: int
    link_port: int
    events: list[dict[str, Any]]

    def event(self, kind: str) -> dict[str, Any]:
        """The next event of a kind."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.events.append(valid("sim-bridge sitl", json.loads(line)))
            if self.events[-1]["event"] == kind:
                return self.events[-1]
        raise AssertionError(f"no '{kind}': {self.process.communicate()[1]}")

    def end(self) -> tuple[int, str, list[dict[str, Any]]]:
        """Exit code, standard error and all events, once it has ended by itself."""
        out, errors = self.process.communicate(timeout=60)
        self.events += [valid("sim-bridge sitl", json.loads(line)) for line in out.splitlines()]
        return self.process.returncode, errors, self.events


@pytest.fixture
def sitl(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    running: list[Running] = []

    def start(*arguments: str, link: bool = False) -> Running:
        tcp = socket.create_server(("127.0.0.1", 0))
        port = tcp.getsockname()[1]
        tcp.close()
        link_port = free_ports(1)[0] if link else 0
        process = subprocess.Popen(
            [
                *(
                    sys.executable,
                    "-c",
                    "from trueflight.sim_bridge.cli import main; main()",
                    "sitl",
                    "--json",
                ),
                *("--vehicle", str(QUAD5 / "vehicle.toml"), "--port", str(port)),
                *("--link-port", str(link_port), *arguments),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            preexec_fn=with_parent,
        )
        running.append(Running(process, port, link_port, []))
        assert running[-1].event("ready")["port"] == port
        return running[-1]

    yield start
    for one in running:
        if one.process.poll() is None:
            one.process.send_signal(signal.SIGINT)
        _, errors = one.process.communicate(timeout=60)
        assert "Traceback" not in errors


@pytest.fixture
def connect() -> Iterator[Callable[[int], Px4Peer]]:
    peers: list[Px4Peer] = []

    def start(port: int, greet: bool = True) -> Px4Peer:
        peers.append(Px4Peer(port))
        if greet:
            peers[-1].greet()
        return peers[-1]

    yield start
    for peer in peers:
        peer.close()


def pilot(vehicle: Vehicle) -> Hover:
    """PX4's allocation of the vehicle, as a user would enter it: forward and right."""
    arms = [(x, -y) for x, y, _ in vehicle.rotor_positions]
    return Hover(arms, vehicle.rotor_directions, vehicle.hover_thrust, vehicle.mass, vehicle.inertia)


def truth(step: Any) -> np.ndarray:
    """Position in NED from PX4's origin, of the HIL_STATE_QUATERNION with a step."""
    state = step.of("HIL_STATE_QUATERNION")
    north = np.radians(state.lat * 1e-7 - 47.397742) * 6371000.0
    east = np.radians(state.lon * 1e-7 - 8.545594) * 6371000.0 * np.cos(np.radians(47.397742))
    return np.array([north, east, 488.0 - state.alt * 1e-3])


def fly_a_hover(
    peer: Px4Peer, hover: Hover, seconds: float = 8.0, target: Any = (0.0, 0.0, -2.0)
) -> list[Any]:
    """Stand for two seconds, then take off by the sensors and hold a place; the steps in the air."""
    peer.fly(2.0, hover.stand, armed=False)
    hover.target = np.array(target)
    return peer.fly(seconds, hover.control)


# What PX4 gets


def test_px4s_clock_and_the_rates_of_its_sensors(sitl, connect) -> None:
    running = sitl("--speed", "0", "--position", "both", "--vision-rate", "50")
    peer = connect(running.port)
    steps = peer.fly(2.0, None, armed=False)
    stamps = np.array([step.sensor.time_usec for step in steps])
    assert stamps[0] == 4000 and set(np.diff(stamps)) == {4000}
    fields = np.array([step.sensor.fields_updated for step in steps])
    assert np.all(fields & 0x3F == 0x3F) and {step.sensor.id for step in steps} == {0}
    seconds = len(steps) * 0.004
    rates = {
        name: np.count_nonzero(fields & bits == bits) / seconds
        for name, bits in (("mag", 0x1C0), ("baro", 0x1A00))
    }
    assert rates == pytest.approx({"mag": 62.5, "baro": 50.0}, rel=0.02)
    kinds = [message.get_type() for step in steps for message in step.others]
    counts = {kind: kinds.count(kind) / seconds for kind in ("HIL_GPS", "ODOMETRY", "HIL_STATE_QUATERNION")}
    assert counts == pytest.approx(
        {"HIL_GPS": 10.0, "ODOMETRY": 50.0, "HIL_STATE_QUATERNION": 125.0}, rel=0.05
    )
    last = next(step for step in reversed(steps) if step.of("HIL_GPS"))
    assert last.of("HIL_GPS").fix_type == 3


def test_standing_facing_east_the_sensors_say_so(sitl, connect) -> None:
    running = sitl("--speed", "0", "--position", "both", "--noise", "0")
    steps = connect(running.port).fly(0.5, None, armed=False)
    settled = [step.sensor for step in steps[50:]]
    force = np.mean([(s.xacc, s.yacc, s.zacc) for s in settled], axis=0)
    assert force == pytest.approx([0.0, 0.0, -9.81], abs=0.02)
    field = np.mean([(s.xmag, s.ymag, s.zmag) for s in settled if s.fields_updated & 0x1C0], axis=0)
    # North is to the left, which is minus y in FRD.
    assert field == pytest.approx([0.0127, -0.2175, 0.4310], abs=0.001)
    seen = next(step.of("ODOMETRY") for step in reversed(steps) if step.of("ODOMETRY"))
    assert (seen.frame_id, seen.child_frame_id, seen.estimator_type) == (1, 1, mav.MAV_ESTIMATOR_TYPE_VISION)
    assert seen.q == pytest.approx([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], abs=1e-3)
    for step in steps:
        if step.of("HIL_GPS"):
            assert step.of("HIL_GPS").alt == pytest.approx(488_000, abs=200)


# Flights


def test_a_controller_that_knows_only_the_sensors_takes_off_and_goes_north_east(
    sitl, connect, vehicle
) -> None:
    """Every sign on the way is needed: gyroscope, accelerometer, compass, GPS, motor order, direction of turn."""
    running = sitl("--speed", "0")
    hover = pilot(vehicle)
    steps = fly_a_hover(connect(running.port), hover, 12.0, (1.5, 1.0, -2.0))
    where = np.array([truth(step) for step in steps if step.of("HIL_STATE_QUATERNION")])
    # GPS wanders by a quarter of a metre, and by half of one vertically.
    assert where[-200:].mean(axis=0) == pytest.approx([1.5, 1.0, -2.0], abs=1.2)
    heading = steps[-1].of("HIL_STATE_QUATERNION") or steps[-2].of("HIL_STATE_QUATERNION")
    w, _, _, z = heading.attitude_quaternion
    assert np.degrees(2 * np.arctan2(z, w)) == pytest.approx(90.0, abs=8.0)


def test_what_is_hidden_acts(sitl, connect, vehicle) -> None:
    """With a fifth more thrust than believed the same hover needs a fifth less command (a linear thrust curve)."""
    commands = {}
    for hidden in ("none", "thrust_gain:1.2"):
        running = sitl("--speed", "0", "--hidden", hidden)
        peer, hover = connect(running.port), pilot(vehicle)
        fly_a_hover(peer, hover, 8.0)
        flown: list[float] = []
        peer.fly(2.0, lambda step, hover=hover, flown=flown: _kept(hover.control(step), flown))
        commands[hidden] = float(np.mean(flown))
    assert commands["none"] == pytest.approx(vehicle.hover_thrust, rel=0.02)
    assert commands["none"] / commands["thrust_gain:1.2"] == pytest.approx(1.2, rel=0.02)


def _kept(motors: np.ndarray, means: list[float]) -> np.ndarray:
    means.append(float(motors.mean()))
    return motors


def test_the_same_seed_flies_the_same_flight(sitl, connect, vehicle) -> None:
    """By commands of time alone: a pilot would react to a GPS message one step later where the wire splits the two.
    Before it has an answer the bridge runs on, so that the flight begins once both are in step."""

    def flown(seed: str) -> list[dict[str, Any]]:
        running = sitl("--speed", "0", "--seed", seed)
        peer = connect(running.port)
        begin = peer.fly(0.5, None, armed=False)[-1].sensor.time_usec

        def jolted(step: Any) -> np.ndarray:
            swing = 0.02 * np.sin(7.0e-6 * (step.sensor.time_usec - begin))
            return vehicle.hover_thrust * np.array([1.2 + swing, 1.2, 1.2 - swing, 1.2])

        steps = peer.fly(1.5, jolted)
        assert any(abs(step.sensor.zacc + 9.81) > 0.5 for step in steps[-50:]), "it is in the air"
        running.process.send_signal(signal.SIGINT)
        with pytest.raises(ConnectionError):
            peer.fly(60.0, jolted)
        code, errors, events = running.end()
        assert code == 0, errors
        if events[-1]["late"]:  # a busy machine went on for a step without its answer: another flight
            return flown(seed)
        return [step.sensor.to_dict() for step in steps[-3:]]

    assert flown("3") == flown("3") != flown("4")


def test_the_truth_is_written_in_the_projects_columns(sitl, connect, vehicle, tmp_path) -> None:
    running = sitl("--speed", "0", "--truth", "truth.csv")
    steps = fly_a_hover(connect(running.port), pilot(vehicle), 4.0)
    running.process.send_signal(signal.SIGINT)
    code, errors, _ = running.end()
    assert code == 0, errors
    table = np.genfromtxt(tmp_path / "truth.csv", delimiter=",", names=True)
    assert np.all(np.diff(table["t"]) == pytest.approx(0.008))
    when = steps[-1].sensor.time_usec * 1e-6
    row = table[np.searchsorted(table["t"], when) - 1]
    north, east, down = next(truth(step) for step in reversed(steps) if step.of("HIL_STATE_QUATERNION"))
    assert (row["position_x"], row["position_y"]) == pytest.approx((east, north), abs=0.05)
    assert row["position_z"] == pytest.approx(-down - 0.0495, abs=0.05)
    assert table["position_z"][0] == pytest.approx(0.0, abs=0.005)
    assert row["specific_force_z"] == pytest.approx(9.81, abs=3.0)


# Pace and patience


def test_time_follows_px4_and_the_speed_asked_for(sitl, connect) -> None:
    running = sitl("--speed", "2", "--duration", "3")
    peer = connect(running.port)
    begin = time.monotonic()
    with pytest.raises(ConnectionError):
        peer.fly(10.0, None, armed=False)
    wall = time.monotonic() - begin
    code, errors, events = running.end()
    assert code == 0, errors
    # Not faster than asked for; slower is the machine's business.
    assert wall > 0.8 * 3 / 2
    assert events[-1]["simulated"] == pytest.approx(3.0, abs=0.01)
    assert events[-1]["ending"] == "stopped" and events[-1]["answers"] > 500


def test_the_world_waits_for_px4(sitl, connect) -> None:
    """In lockstep there is one HIL_SENSOR for each answer, however late it comes."""
    running = sitl("--speed", "0")
    peer = connect(running.port)
    step = peer.next()
    peer.answer(step)
    peer.socket.settimeout(0.2)  # less than it waits for an answer
    with pytest.raises(TimeoutError):  # after those that it sent before it had heard of us
        while True:
            step = peer.next()
    for _ in range(5):
        peer.answer(step)
        peer.socket.settimeout(5.0)
        before, step = step, peer.next()
        assert step.sensor.time_usec == before.sensor.time_usec + 4000
        peer.socket.settimeout(0.1)
        with pytest.raises(TimeoutError):
            peer.next()


@pytest.fixture
def in_thread(
    vehicle, monkeypatch
) -> Iterator[Callable[..., tuple[Lockstep, threading.Thread, list[Any], list[str]]]]:
    """A `Lockstep` in a thread of the test, to shorten its patience."""
    monkeypatch.setattr(lockstep, "_PATIENCE", 0.05)
    monkeypatch.setattr(lockstep, "_SILENCE", 0.6)
    monkeypatch.setattr(lockstep, "_HANDSHAKE", 0.3)
    stop = threading.Event()
    made: list[tuple[Lockstep, threading.Thread]] = []

    def start() -> tuple[int, Lockstep, threading.Thread, list[Any], list[str]]:
        listener = listen("127.0.0.1", 0)
        told: list[str] = []
        results: list[Any] = []
        flight = Lockstep(Simulator(vehicle), RawSensors(RawNoise(), 0), listener, told.append, 0.0)

        def run() -> None:
            try:
                if flight.accept(lambda: not stop.is_set()):
                    results.append(flight.run(lambda: not stop.is_set()))
            except InputError as error:
                results.append(error)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        made.append((flight, thread))
        return listener.getsockname()[1], flight, thread, results, told

    yield start
    stop.set()
    for flight, thread in made:
        thread.join(5.0)
        flight.close()


def test_a_px4_that_hesitates_is_waited_for_and_one_that_is_silent_ends_it(in_thread, connect) -> None:
    port, flight, thread, results, _ = in_thread()
    peer = connect(port)
    peer.fly(0.5, None, armed=False)
    time.sleep(0.25)  # longer than its patience
    for _ in range(3):
        peer.answer(peer.next())
    thread.join(0.1)
    assert thread.is_alive() and flight.progress.late >= 1
    thread.join(5.0)
    assert results == [Ending.SILENT]


def test_a_px4_without_lockstep_is_refused(in_thread, connect) -> None:
    port, _, thread, results, _ = in_thread()
    peer = connect(port)
    peer.answer(peer.next(), flags=0)
    thread.join(5.0)
    assert "lockstep" in str(results[0])


def test_another_airframe_is_refused(in_thread, connect) -> None:
    port, _, thread, results, _ = in_thread()
    peer = connect(port)
    peer.answer(peer.next(), (0.1,) * 6, armed=True)
    thread.join(5.0)
    assert "output 5" in str(results[0])


def test_impossible_motor_commands_do_no_harm(in_thread, connect) -> None:
    port, flight, thread, results, _ = in_thread()
    peer = connect(port)
    for motors in ((float("nan"),) * 4, (-1.0,) * 4, (7.0,) * 4, (float("inf"),) * 4):
        for _ in range(20):
            peer.answer(peer.next(), motors, armed=True)
    assert thread.is_alive() and results == []
    assert np.all(np.isfinite(flight.simulator.world.position.tolist()))


def test_disarmed_the_motors_stand_still_whatever_is_commanded(in_thread, connect) -> None:
    port, flight, _, _, _ = in_thread()
    peer = connect(port)
    for _ in range(50):
        peer.answer(peer.next(), (0.9,) * 4, armed=False)
    assert flight.simulator.motors == [0.0] * 4 and not flight.progress.airborne


# Wrong clients


@pytest.mark.parametrize(
    "greeting",
    [b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" * 20, bytes(range(256)) * 4, b"", None],
    ids=["http", "binary", "silent", "closed"],
)
def test_who_is_no_px4_is_sent_away_and_px4_may_still_come(in_thread, connect, greeting) -> None:
    port, flight, thread, _, told = in_thread()
    stranger = socket.create_connection(("127.0.0.1", port))
    if greeting is None:
        stranger.close()
    elif greeting:
        stranger.sendall(greeting)
    peer = connect(port)
    peer.fly(0.2, None, armed=False)
    assert thread.is_alive() and flight.progress.answers > 40
    assert len(told) == 1 and "sent away" in told[0]
    if greeting is not None:
        assert stranger.recv(1000) == b""
        stranger.close()


def test_an_ardupilot_is_told_from_a_px4(in_thread, connect) -> None:
    port, _, _, _, told = in_thread()
    other = connect(port, greet=False)
    other.send(mav.MAVLink_heartbeat_message(2, mav.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 0, 3))
    with pytest.raises(ConnectionError):
        other.next()
    assert "no PX4" in told[0]


def test_garbage_in_the_stream_is_skipped_and_told_once(in_thread, connect) -> None:
    port, flight, thread, _, told = in_thread()
    peer = connect(port)
    peer.fly(0.2, None, armed=False)
    for _ in range(10):
        peer.socket.sendall(bytes(range(200)))
    peer.fly(0.5, None, armed=False)
    assert thread.is_alive() and flight.progress.answers > 150
    assert len(told) == 1 and "no MAVLink" in told[0]


def test_a_second_px4_waits_and_the_first_flies_on(in_thread, connect) -> None:
    port, flight, thread, _, told = in_thread()
    first = connect(port)
    first.fly(0.2, None, armed=False)
    second = connect(port)
    first.fly(0.5, None, armed=False)
    assert thread.is_alive() and flight.progress.refused == 1
    assert len(told) == 1 and "--port 4561" in told[0]
    second.socket.settimeout(0.1)
    with pytest.raises(TimeoutError):
        second.next()


def test_a_px4_that_vanishes_in_the_air_is_exit_code_2(sitl, connect, vehicle) -> None:
    running = sitl("--speed", "0")
    peer = connect(running.port)
    fly_a_hover(peer, pilot(vehicle), 3.0)
    peer.close()
    code, errors, _ = running.end()
    assert code == 2 and "closed the connection" in errors and "in the air" in errors
    assert errors.count("\n") == 1


def test_a_px4_that_ends_on_the_ground_ends_it_in_order(sitl, connect) -> None:
    running = sitl("--speed", "0")
    peer = connect(running.port)
    peer.fly(1.0, None, armed=False)
    peer.close()
    code, errors, events = running.end()
    assert code == 0, errors
    assert events[-1]["ending"] == "closed" and events[-1]["armed"] is False


# The check of the control allocation


def serve(peer: Px4Peer, server: ParameterServer, seconds: float) -> None:
    """PX4's two sides, in its own time, until the bridge goes or the time is over."""
    tick = 0
    begin = None
    while True:
        try:
            step = peer.next()
            peer.answer(step)
        except (ConnectionError, OSError):
            return
        begin = step.sensor.time_usec if begin is None else begin
        tick += 1
        if tick % 25 == 0:
            server.serve()
        if step.sensor.time_usec - begin > seconds * 1e6:
            return


@pytest.fixture
def parameters() -> Iterator[Callable[..., ParameterServer]]:
    servers: list[ParameterServer] = []

    def start(port: int, values: dict[str, Any], obey: bool = True) -> ParameterServer:
        servers.append(ParameterServer(port, values, obey))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


def test_the_iris_of_px4_is_not_this_vehicle(sitl, connect, parameters) -> None:
    running = sitl("--speed", "0", link=True)
    serve(connect(running.port), parameters(running.link_port, IRIS), 30.0)
    code, errors, _ = running.end()
    assert code == 2
    assert "rotor 1" in errors and "--set-params" in errors and errors.count("\n") == 1


def test_asked_to_it_sets_the_allocation_and_gives_px4_the_battery(
    sitl, connect, parameters, vehicle
) -> None:
    running = sitl("--speed", "0", "--set-params", link=True)
    server = parameters(running.link_port, {**IRIS, "SIM_BAT_ENABLE": 0})
    serve(connect(running.port), server, 6.0)
    told = running.event("checked")
    assert "CA_ROTOR0_PX" in told["changed"] and "CA_ROTOR0_KM" not in told["changed"]
    assert server.values["MPC_THR_HOVER"] == pytest.approx(vehicle.hover_thrust)
    assert differences(vehicle, server.values) == []
    cells = server.batteries[-1].voltages
    assert sum(cell for cell in cells if cell < 65535) * 1e-3 == pytest.approx(16.6, abs=0.5)


def test_flying_by_vision_sets_what_the_estimator_needs(sitl, connect, parameters) -> None:
    running = sitl("--speed", "0", "--set-params", "--position", "vision", link=True)
    server = parameters(running.link_port, {**IRIS, "EKF2_EV_CTRL": 15, "EKF2_HGT_REF": 1, "SYS_HAS_GPS": 1})
    serve(connect(running.port), server, 6.0)
    running.event("checked")
    assert (server.values["EKF2_HGT_REF"], server.values["SYS_HAS_GPS"]) == (3, 0)


def test_an_older_px4_without_the_batterys_parameters_is_checked_all_the_same(
    sitl, connect, parameters, vehicle
) -> None:
    values = {**IRIS, **agreeing(vehicle)}
    del values["COM_FLTT_LOW_ACT"], values["SIM_BAT_ENABLE"]
    running = sitl("--speed", "0", link=True)
    server = parameters(running.link_port, values)
    serve(connect(running.port), server, 8.0)
    assert running.event("checked")["changed"] == []
    assert server.batteries == []  # nobody knows whether it simulates one of its own


def test_a_px4_that_does_not_take_parameters_is_refused(sitl, connect, parameters) -> None:
    running = sitl("--speed", "0", "--set-params", link=True)
    serve(connect(running.port), parameters(running.link_port, IRIS, obey=False), 30.0)
    code, errors, _ = running.end()
    assert code == 2 and "did not take" in errors


def test_an_unreachable_px4_is_flown_unchecked_and_told(sitl, connect) -> None:
    running = sitl("--speed", "0", "--duration", "25", link=True)
    peer = connect(running.port)
    with pytest.raises(ConnectionError):
        peer.fly(30.0, None, armed=False)
    code, errors, events = running.end()
    assert code == 0, errors
    assert any("was not checked" in one["text"] and "--show-params" in one["text"] for one in events)
    assert events[-1]["allocation"] == "not checked"


def agreeing(vehicle: Vehicle) -> dict[str, float]:
    return {one.name: one.value for one in expected_parameters(vehicle)}


def test_the_vehicles_own_allocation_agrees_at_any_scale(vehicle: Vehicle) -> None:
    values = agreeing(vehicle)
    assert differences(vehicle, values) == []
    # PX4's own quad X has arms of 1 m and flies any square vehicle: its mixer is normalised.
    wide = {name: value * 12.85 if name.endswith(("_PX", "_PY")) else value for name, value in values.items()}
    assert differences(vehicle, wide) == []


def test_px4s_quad_x_is_the_order_of_the_vehicle_file(vehicle: Vehicle) -> None:
    """PX4's airframe reference, Quadrotor x: 1 front right and 2 rear left counter-clockwise, 3 and 4 the others."""
    values = agreeing(vehicle)
    forward = [values[f"CA_ROTOR{i}_PX"] for i in range(4)]
    right = [values[f"CA_ROTOR{i}_PY"] for i in range(4)]
    moment = [values[f"CA_ROTOR{i}_KM"] for i in range(4)]
    assert (np.sign(forward), np.sign(right), np.sign(moment)) == (
        pytest.approx([1, -1, 1, -1]),
        pytest.approx([1, -1, -1, 1]),
        pytest.approx([1, 1, -1, -1]),
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"CA_ROTOR0_PX": -0.0778, "CA_ROTOR1_PX": 0.0778}, "rotor 1 is front right"),
        ({f"CA_ROTOR{i}_PY": y for i, y in enumerate((-0.0778, 0.0778, 0.0778, -0.0778))}, "rotor 1"),
        ({"CA_ROTOR2_KM": 0.05}, "rotor 3 turns clockwise in the vehicle file, counter-clockwise in PX4"),
        ({"CA_ROTOR2_KM": -0.1}, "CA_ROTOR2_KM"),
        ({"PWM_MAIN_FUNC2": 103, "PWM_MAIN_FUNC3": 102}, "output 2 of PX4 has function 103"),
        ({"CA_ROTOR_COUNT": 6}, "6 rotors"),
        ({"CA_AIRFRAME": 1}, "CA_AIRFRAME is 1"),
        ({f"CA_ROTOR{i}_PX": 0.0 for i in range(4)}, "rotor 1"),
    ],
)
def test_every_way_of_being_another_vehicle_is_named(vehicle: Vehicle, change, words) -> None:
    found = differences(vehicle, agreeing(vehicle) | change)
    assert any(words in one for one in found), found


def test_a_missing_parameter_is_told(vehicle: Vehicle) -> None:
    values = agreeing(vehicle)
    del values["CA_ROTOR1_KM"]
    with pytest.raises(InputError, match="CA_ROTOR1_KM"):
        differences(vehicle, values)


def test_an_uneven_frame_is_compared_as_it_is() -> None:
    uneven = vehicle_from_table(
        {
            **{"name": "iris", "mass": 1.5, "hover_thrust": 0.6, "inertia": [0.03, 0.03, 0.05]},
            "rotor_positions": [
                [0.1515, -0.245, 0],
                [-0.1515, 0.1875, 0],
                [0.1515, 0.245, 0],
                [-0.1515, -0.1875, 0],
            ],
            "rotor_directions": [1, 1, -1, -1],
        },
        "iris.toml",
    )
    assert differences(uneven, IRIS) == []


# The stream


def test_messages_in_pieces_are_whole_again() -> None:
    link = mav.MAVLink(None, srcSystem=1, srcComponent=1)
    data = b"".join(
        mav.MAVLink_hil_actuator_controls_message(i, [0.1] * 16, ARMED, 1).pack(link) for i in range(20)
    )
    for size in (1, 7, 93, 1000):
        stream = MessageStream()
        found = [m for at in range(0, len(data), size) for m in stream.feed(data[at : at + size])]
        assert [m.time_usec for m in found] == list(range(20)) and stream.foreign == 0


def test_a_broken_message_costs_itself_and_not_the_next() -> None:
    link = mav.MAVLink(None, srcSystem=1, srcComponent=1)
    messages = [mav.MAVLink_hil_actuator_controls_message(i, [0.1] * 16, 1, 1).pack(link) for i in range(8)]
    broken = bytearray(messages[1])
    broken[20] ^= 0x55
    stream = MessageStream()
    # A stray 0xFE begins a message of 253 bytes that never comes: what it swallowed is found again.
    found = stream.feed(messages[0] + bytes(broken) + b"\x00\x01\xfe" + messages[2] + messages[3][:30])
    found += stream.feed(messages[3][30:] + b"".join(messages[4:]))
    assert [m.time_usec for m in found] == [0, 2, 3, 4, 5, 6, 7] and stream.foreign > 0


# The command line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--position", "radar"), "gps, vision, both"),
        (("--hidden", "rate_loop_lag"), "rate_loop_lag"),
        (("--speed", "-1"), "--speed"),
        (("--host", "300.1.1.1"), "cannot listen"),
    ],
)
def test_what_cannot_be_is_one_line_and_exit_code_2(arguments, words, tmp_path) -> None:
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 2 and words in done.stderr and "Traceback" not in done.stderr


def test_a_port_in_use_is_told(tmp_path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        done = command("--port", str(other.getsockname()[1]), cwd=tmp_path)
    assert done.returncode == 2 and "in use" in done.stderr and "-i 1" in done.stderr


def test_what_px4_must_have_can_be_printed(tmp_path) -> None:
    done = command("--show-params", cwd=tmp_path)
    assert done.returncode == 0
    assert "param set CA_ROTOR0_PY 0.0778" in done.stdout.splitlines()


def command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    run = "from trueflight.sim_bridge.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", run, "sitl", "--vehicle", str(QUAD5 / "vehicle.toml"), *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=cwd,
    )
