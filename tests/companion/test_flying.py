"""The companion flies the simulated vehicle over real MAVLink, and a ground asks for it over real Zenoh."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from onnx_models import constant_model, drag_model, linear_model
from rig import PATIENT, Bridge, Companion, free_port, wait_for

from trueflight.models import contract, frames
from trueflight.models.record import FlightRecord, read_record
from trueflight.models.record_pb2 import Event

pytestmark = pytest.mark.realtime

SPEED = "2"


@pytest.fixture(scope="module")
def bridge() -> Iterator[tuple[Bridge, int]]:
    port = free_port()
    # Drag as the deployed model has it: the observer would take back what no vehicle does.
    bridge = Bridge(port, "--speed", SPEED, "--hidden", "rotor_drag:0.1")
    yield bridge, port
    bridge.end()


@pytest.fixture(scope="module")
def companion(bridge: tuple[Bridge, int], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Companion]:
    config = tmp_path_factory.mktemp("companion") / "companion.toml"
    config.write_text(PATIENT + "fence_radius = 6.0\nfence_height = 4.0\n[guard]\ndeadline = 0.02\n")
    companion = Companion(config.parent, bridge[1], "--config", str(config))
    yield companion
    companion.end()


def record_of(companion: Companion, status: dict[str, str]) -> FlightRecord:
    record = read_record(companion.records / status["record"])
    assert not record.truncated
    return record


def rows(*points: tuple[float, ...]) -> str:
    """Setpoints at rest, one each second: x, y, z, yaw."""
    lines = [f"{t},{x},{y},{z},0,0,0,0,0,0,{yaw}" for t, (x, y, z, yaw) in enumerate(points)]
    return "t,x,y,z,vx,vy,vz,ax,ay,az,yaw\n" + "\n".join(lines)


@pytest.mark.parametrize("yaw", [0.0, 0.5 * math.pi])
def test_a_move_along_each_axis_goes_the_right_way(companion: Companion, yaw: float) -> None:
    """Signs by flying: east, north and up, with the nose to the east and to the north."""
    base = (0.0, 0.0, 1.0, yaw)
    moves = {0: (0.6, 0.0, 1.0, yaw), 1: (0.0, 0.6, 1.0, yaw), 2: (0.0, 0.0, 1.6, yaw)}
    points = [base]
    for moved in moves.values():
        points += [moved, moved, base, base]
    status = companion.done(companion.fly(setpoints=rows(*points)))
    assert status["state"] == "finished", status
    ticks = record_of(companion, status).ticks
    flown = ticks["phase"] == "mission"
    position, reference = ticks["position"][flown], ticks["position_reference"][flown]
    assert np.abs(position - reference).max() < 0.3
    t = ticks["t"][flown] - ticks["t"][flown][0]
    for axis in moves:
        there = np.argmin(np.abs(t - (2.0 + 4.0 * axis)))
        moved = position[there] - position[0]
        assert moved[axis] > 0.4, f"axis {axis}"
        assert np.abs(np.delete(moved, axis)).max() < 0.15, f"axis {axis}"
    angles = frames.euler_from_quaternion(ticks["quaternion"][flown])
    assert np.abs(frames.wrap_angle(angles[:, 2] - yaw)).max() < 0.1
    # Velocity is the derivative of position, in the world, whatever the nose says: over each half second.
    velocity = ticks["velocity"][flown]
    integral = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t)[:, None], axis=0)
    np.testing.assert_allclose(integral[50:] - integral[:-50], position[51:] - position[1:-50], atol=0.05)


def test_the_record_holds_what_was_flown_and_what_was_sent(companion: Companion) -> None:
    first = len(companion.ticks)
    mission = companion.fly(trajectory="lemniscate", parameters={"laps": 1.0, "speed": 1.5}, repeat=1)
    status = companion.done(mission)
    record = record_of(companion, status)
    ticks = record.ticks
    flown = ticks["phase"] == "mission"
    assert record.metadata["trajectory"] == "lemniscate"
    assert record.metadata["parameter.speed"] == "1.5"
    assert record.vehicle is not None
    assert record.vehicle.name == "quad5"
    assert record.design is not None
    assert [event.kind for event in record.events] == [
        "takeoff",
        "mission_started",
        "mission_flown",
        "mission_ended",
    ]
    assert ticks["setpoint_sent"][flown].all()
    assert set(ticks["controller"][flown]) == {"lqr"}
    assert set(ticks["flight_mode"][flown]) == {"OFFBOARD"}
    assert ticks["armed"][flown].all()
    np.testing.assert_allclose(ticks["interval"][flown] / (1 + ticks["overtaken"][flown]), 0.01, atol=1e-9)
    # At hover the accelerometer feels the weight upwards and the believed command carries it.
    still = flown & (np.abs(ticks["velocity"]).max(axis=1) < 0.1)
    assert np.median(ticks["specific_force"][still], axis=0) == pytest.approx([0.0, 0.0, 9.81], abs=0.3)
    assert np.median(ticks["thrust_command"][still]) == pytest.approx(0.38, abs=0.03)
    assert ticks["rotor_speed"][flown].min() > 100.0
    assert 12.0 < np.median(ticks["battery_voltage"][flown]) < 17.0
    assert np.isfinite(ticks["position_reference"][flown]).all()
    # The ground saw the same ticks as the record has: telemetry may drop, and on this link has no reason to.
    seen = {tick.vehicle_time_us for tick in companion.ticks[first:]}
    recorded = set(np.round(1e6 * ticks["vehicle_time"]).astype(int).tolist())
    assert len(recorded - seen) <= 0.01 * len(recorded)


def test_a_deployed_model_flies_as_correction(companion: Companion) -> None:
    onnx = drag_model(0.1)
    answer = companion.ask("model", onnx)
    assert answer["accepted"], answer
    assert (answer["state"], answer["staged"]["hash"]) == ("staged", contract.model_hash(onnx))
    status = companion.done(
        companion.fly(trajectory="lemniscate", parameters={"laps": 1.0, "speed": 2.0}, controller="corrected")
    )
    assert status["state"] == "finished", status
    ticks = record_of(companion, status).ticks
    flown = ticks["phase"] == "mission"
    active = flown & (ticks["guard"] == "active")
    assert active.sum() > 0.7 * flown.sum()
    assert set(ticks["model"][flown]) == {contract.model_hash(onnx)}
    assert set(ticks["controller"][flown]) == {"corrected"}
    # What was applied is what the model says of the recorded velocity, in the heading frame, within its slew.
    yaw = frames.euler_from_quaternion(ticks["quaternion"][active])[:, 2]
    expected = -0.1 * frames.heading_from_world(ticks["velocity"][active], yaw)[:, :2]
    np.testing.assert_allclose(ticks["correction_raw"][active][:, :2], expected, atol=1e-3)
    applied = ticks["correction"] - ticks["trim"]
    np.testing.assert_allclose(applied[active][:, :2], expected, atol=0.02)
    # And the command differs from the feedback in that direction: against forward drag, nose down. Lead, trim and
    # observer come on top, so it is not in proportion.
    assert np.abs(expected).max() > 0.1
    difference = ticks["body_rate_command"][active] - ticks["feedback_body_rate"][active]
    assert np.corrcoef(difference[:, 1], -expected[:, 0])[0, 1] > 0.5


def test_a_correction_outside_its_training_trips_and_the_flight_goes_on(companion: Companion) -> None:
    narrow = [
        {
            "name": name,
            "unit": unit,
            "low": 0.0 if name == "z" else -100.0,
            "high": 2.0 if name == "z" else 100.0,
        }
        for name, unit in contract.FEATURES.items()
    ]
    onnx = linear_model(np.zeros((10, 3)), (0.1, 0.0, 0.0), metadata={contract.KEY_FEATURES: narrow})
    while companion.ask("status")["live"]:  # an earlier test's model would be faded in instead
        companion.ask("model", {"command": "rollback"})
    assert companion.ask("model", onnx)["accepted"]
    status = companion.done(
        companion.fly(
            setpoints=rows(*[(0.0, 0.0, 1.0, 0.0)] * 2, *[(0.0, 0.0, 3.0, 0.0)] * 6), controller="corrected"
        )
    )
    assert status["state"] == "finished", status
    ticks = record_of(companion, status).ticks
    flown = ticks["phase"] == "mission"
    assert ticks["guard"][flown][0] == "active", "it proved itself on the way to the mission"
    assert ticks["guard"][flown][-1].startswith("tripped: z outside its training range")
    np.testing.assert_allclose(ticks["correction"][flown][-1], ticks["trim"][flown][-1], atol=1e-12)
    assert np.abs(ticks["trim"][flown][-1]).max() == 0.0, "the trim goes with the model"
    wait_for(lambda: any(contract.model_hash(onnx) in t for t in companion.told("guard_trip")), "the event")
    assert companion.ask("model", {"command": "rollback"})["accepted"]


def test_what_cannot_be_flown_is_refused_with_the_reason(companion: Companion) -> None:
    wait_for(lambda: companion.ask("status")["ready"], "ready")
    for request, reason in (
        ({"trajectory": "lemniscat"}, "did you mean 'lemniscate'"),
        ({"trajectory": "circle", "parameters": {"radius": 20.0}}, "fence"),
        ({"trajectory": "hover", "parameters": {"height": 10.0}}, "fence"),
        ({"trajectory": "hover", "controller": "pid"}, "unknown"),
        ({"trajectory": "hover", "repeat": 0}, "repeat"),
        ({"trajectroy": "hover"}, "unknown key 'trajectroy'"),
        ({"setpoints": "t,x,y\n0,0,0"}, "'z' is missing"),
        ({"command": "jump"}, "unknown command"),
        ({}, "'trajectory' must be"),
    ):
        answer = companion.ask("mission", request)
        assert not answer["accepted"]
        assert reason in answer["reason"], answer
    answer = companion.ask("mission", b"no json")
    assert not answer["accepted"]
    answer = companion.ask(
        "model", constant_model(0, 0, 0, metadata={contract.KEY_VEHICLE: {"name": "other"}})
    )
    assert not answer["accepted"]
    assert "made for vehicle 'other'" in answer["reason"]
    wait_for(lambda: any("other" in text for text in companion.told("model_refused")), "the event")


def test_an_order_to_land_ends_a_flight_early_and_empties_the_queue(companion: Companion) -> None:
    mission = companion.fly(trajectory="hover", parameters={"duration": 600.0})
    companion.phase("mission")
    second = companion.ask("mission", {"trajectory": "hover"})["mission"]
    assert companion.ask("mission", {"command": "land"})["accepted"]
    assert companion.done(mission)["state"] == "aborted"
    assert companion.done(second)["state"] == "aborted"
    assert companion.ask("status")["landed"] == "on ground"


def test_records_are_listed_and_fetched_in_pieces(companion: Companion) -> None:
    companion.done(companion.fly(trajectory="hover", parameters={"duration": 1.0}))
    records = companion.ask("record")["records"]
    newest = records[-1]
    whole = (companion.records / newest["name"]).read_bytes()
    assert newest["size"] == len(whole)
    got = b""
    while len(got) < newest["size"]:
        sample = companion.query("record", {"name": newest["name"], "offset": len(got), "length": 100_000})
        assert sample.attachment is not None
        assert json.loads(sample.attachment.to_string()) == {"size": len(whole), "offset": len(got)}
        got += sample.payload.to_bytes()
    assert got == whole
    for name in ("../companion.toml", "none.mcap", ""):
        assert not companion.ask("record", {"name": name})["accepted"]


def test_the_pilot_takes_over_and_keeps_it(bridge: tuple[Bridge, int], companion: Companion) -> None:
    mission = companion.fly(trajectory="hover", parameters={"duration": 600.0})
    companion.phase("mission")
    bridge[0].pilot("POSCTL")
    companion.phase("silent")
    wait_for(lambda: any("POSCTL" in text for text in companion.told("pilot_takeover")), "the event")
    count = len(companion.ticks)
    wait_for(lambda: len(companion.ticks) > count + 200, "two more seconds of ticks")
    assert not any(tick.setpoint_sent for tick in companion.ticks[count:])
    assert {tick.phase for tick in companion.ticks[count:]} == {"silent"}
    assert not companion.ask("status")["ready"]
    bridge[0].pilot("LAND")
    status = companion.done(mission)
    assert status["state"] == "aborted"
    assert "POSCTL" in status["reason"]


def test_late_joiners_see_the_events_before_them(companion: Companion) -> None:
    import zenoh.ext

    seen: list[str] = []
    subscriber = zenoh.ext.declare_advanced_subscriber(
        companion.session,
        contract.key("quad5", "event"),
        lambda sample: seen.append(Event.FromString(sample.payload.to_bytes()).kind),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
    )
    wait_for(lambda: "takeoff" in seen, "events from before")
    subscriber.undeclare()
    tokens = companion.session.liveliness().get(contract.key("quad5", "*"))
    assert [str(reply.ok.key_expr) for reply in tokens] == [contract.key("quad5", "status")]


def test_sigterm_in_flight_lands_and_leaves_a_whole_record(
    bridge: tuple[Bridge, int], tmp_path: Path
) -> None:
    port = free_port()
    own = Bridge(port, "--speed", SPEED)
    companion = Companion(tmp_path, port)
    try:
        companion.fly(trajectory="hover", parameters={"duration": 600.0})
        companion.phase("mission")
        assert companion.end(signal.SIGTERM) == 0, companion.output
    finally:
        if companion.child.poll() is None:
            companion.end(signal.SIGKILL)
        own.end()
    (path,) = companion.records.glob("*.mcap")
    record = read_record(path)
    assert not record.truncated
    assert record.events[-1].kind == "mission_ended"
    assert "shutting down" in record.events[-1].text
    assert record.ticks["flight_mode"][-1] != "OFFBOARD"
    assert not record.ticks["armed"][-1]
