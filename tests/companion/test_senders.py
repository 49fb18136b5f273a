"""Who and what speaks on the autopilot's link: another autopilot, other components, several batteries, real MAVLink."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mav
from rig import VEHICLE, Bridge, free_port
from test_companion_cli import companion, refused

from trueflight.companion.batteries import Batteries
from trueflight.companion.others import Others

pytestmark = pytest.mark.realtime

PX4, ARDUPILOT, GENERIC = 12, 3, 0
QUADROTOR, FIXED_WING, VTOL, GIMBAL, GROUND_STATION = 2, 1, 22, 26, 6


class Speaker:
    """Somebody who sends the same messages to a port of this machine, 20 times a second, until `close`."""

    def __init__(self, port: int, system: int, component: int, *messages: Any) -> None:
        self._link = mav.MAVLink(None, srcSystem=system, srcComponent=component)
        self._port, self._messages, self._over = port, messages, threading.Event()
        self._thread = threading.Thread(target=self._speak, daemon=True)
        self._thread.start()

    def _speak(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not self._over.wait(0.05):
                for message in self._messages:
                    out.sendto(message.pack(self._link), ("127.0.0.1", self._port))

    def close(self) -> None:
        self._over.set()
        self._thread.join()


def heartbeat(kind: int, autopilot: int) -> Any:
    return mav.MAVLink_heartbeat_message(kind, autopilot, 81, 0, 3, 3)


def battery(number: int, volts: float, use: int = 0) -> Any:
    """BATTERY_STATUS of PX4's battery `number`, 4 cells; 0 V is one that is not connected."""
    cells = [round(250 * volts)] * 4 if volts else [65535] * 4
    return mav.MAVLink_battery_status_message(number - 1, use, 1, 2000, cells + [65535] * 6, 50, 0, 0, 90)


@pytest.mark.parametrize(
    ("kind", "autopilot", "says"),
    [
        (QUADROTOR, ARDUPILOT, "ArduPilot answers"),
        (QUADROTOR, GENERIC, "an autopilot of another kind (MAV_AUTOPILOT 0) answers"),
        (FIXED_WING, PX4, "PX4 of a fixed-wing (MAV_TYPE 1) answers"),
        (VTOL, PX4, "PX4 of a VTOL (MAV_TYPE 22) answers"),
    ],
)
def test_what_cannot_be_flown_is_named(kind: int, autopilot: int, says: str) -> None:
    port = free_port()
    speaker = Speaker(port, 3, 1, heartbeat(kind, autopilot))
    try:
        line = refused("check", "--connect", f"udpin://127.0.0.1:{port}", "--timeout", 5)
    finally:
        speaker.close()
    assert says in line
    assert "system 3" in line
    assert "--connect" in line


def test_a_ground_station_alone_is_no_autopilot() -> None:
    port = free_port()
    speaker = Speaker(port, 255, 190, heartbeat(GROUND_STATION, 8))
    try:
        line = refused("check", "--connect", f"udpin://127.0.0.1:{port}", "--timeout", 2)
    finally:
        speaker.close()
    assert "no autopilot answering" in line


@pytest.fixture
def bridge() -> Iterator[int]:
    port = free_port()
    running = Bridge(port)
    yield port
    running.end()


def test_who_else_speaks_is_counted_and_a_low_battery_is_not_hidden(bridge: int) -> None:
    """A gimbal, a ground station and a camera's odometry; a second flight battery that is all but empty."""
    address = ("--connect", f"udpin://127.0.0.1:{bridge}")
    unknown = [float("nan")] * 21
    elsewhere = mav.MAVLink_odometry_message(
        1, 1, 12, 50.0, 0, 0, [1, 0, 0, 0], *(0,) * 6, unknown, unknown, 0, 3, 0
    )
    speakers = [
        Speaker(bridge, 1, 154, heartbeat(GIMBAL, 8)),
        Speaker(bridge, 255, 190, heartbeat(GROUND_STATION, 8)),
        Speaker(bridge, 1, 197, elsewhere, battery(1, 3.0)),
        Speaker(bridge, 1, 1, battery(2, 12.4), battery(3, 5.1), battery(4, 0.0)),
    ]
    try:
        checked = json.loads(companion("check", *address, "--json").stdout)
        looked = json.loads(companion("preflight", *address, "--vehicle", VEHICLE, "--json").stdout)
        chosen = json.loads(
            companion("preflight", *address, "--vehicle", VEHICLE, "--battery", 1, "--json").stdout
        )
        gone = json.loads(companion("check", *address, "--battery", 4, "--json").stdout)
    finally:
        for speaker in speakers:
            speaker.close()
    assert set(checked["others"]) == {
        "system 1, component 154 (gimbal)",
        "system 1, component 197 (visual odometry)",
        "system 255, component 190 (ground station)",
    }
    assert [one["battery"] for one in checked["batteries"]] == [1, 2, 3]
    (told,) = [row for row in looked["arming"] if row["name"] == "battery"]
    assert told["state"] == "fail"
    assert told["value"] == "12.4 V"
    (several,) = [row for row in looked["arming"] if row["name"] == "batteries"]
    assert "battery 3: 5.1 V (left out: not of 16 V)" in several["value"]
    assert "--battery" in several["why"]
    (told,) = [row for row in chosen["arming"] if row["name"] == "battery"]
    assert told["state"] == "ok"
    assert gone["battery_voltage"] == 0.0


def told(*messages: Any, chosen: int = 0, nominal: float | None = 14.8, **capacities: float) -> Batteries:
    batteries = Batteries(chosen, nominal)
    for message in messages:
        batteries.take({**message.to_dict(), "id": message.id})
    batteries.capacities = {int(name[1:]): value for name, value in capacities.items()}
    return batteries


@pytest.mark.parametrize(
    ("batteries", "volts"),
    [
        (told(battery(1, 16.0)), 16.0),
        (told(battery(1, 0.0), battery(2, 13.0)), 13.0),
        (told(battery(1, 16.0), battery(2, 13.0)), 13.0),
        (told(battery(1, 13.0), battery(2, 16.0)), 13.0),
        (told(battery(1, 16.0), battery(2, 5.1)), 16.0),
        (told(battery(1, 16.0), battery(2, 12.0, 4)), 16.0),
        (told(battery(1, 16.0), battery(2, 13.0), b1=5000.0, b2=850.0), 16.0),
        (told(battery(1, 13.0), battery(2, 16.0), b1=5000.0, b2=4000.0), 13.0),
        (told(battery(1, 16.0), battery(2, 13.0), chosen=1), 16.0),
        (told(battery(1, 16.0), battery(2, 13.0), chosen=2), 13.0),
        (told(battery(1, 5.1)), 5.1),
        (told(battery(1, 24.0), battery(2, 23.0)), 23.0),
        (told(battery(1, 16.0), battery(2, 5.1), nominal=None), 5.1),
        (told(battery(1, 0.0)), 0.0),
        (told(), 0.0),
    ],
)
def test_the_flights_battery_is_the_lowest_of_those_that_can_be(batteries: Batteries, volts: float) -> None:
    assert batteries.voltage == pytest.approx(volts, abs=0.01)
    assert batteries.why_not == ""


def test_a_chosen_battery_that_is_not_connected_is_told() -> None:
    batteries = told(battery(1, 16.0), battery(2, 0.0), chosen=2)
    assert "battery 2 is not connected (battery 1: 16.0 V" in batteries.why_not
    assert "--battery" in batteries.why_not


def test_each_sender_is_told_once_and_a_crowd_does_not_grow_without_end() -> None:
    heard: list[str] = []
    others = Others()
    others.count(1, 154)
    others.tell(heard.append)
    for _ in range(3):
        for component in range(200):
            others.count(2, component)
    assert len(heard) == len(set(heard)) < 40
    assert heard[0].startswith("system 1, component 154 (gimbal)")
    assert sum(others.describe().values()) == 601
    assert "many others" in others.describe()
