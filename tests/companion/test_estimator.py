"""ESTIMATOR_STATUS of every PX4 release: who has a position to fly by, and what a refusal tells."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mav
from rig import VEHICLE, Bridge, Companion, free_port, wait_for
from test_companion_cli import companion

from trueflight.companion.estimator import EstimatorStatus, estimator_status

pytestmark = pytest.mark.realtime

MOST = 2.0


class Status(NamedTuple):
    """One message of a vehicle at rest, and whether it has a position to fly by."""

    release: str
    what: str
    flags: int
    accuracy: float | None
    flies: bool


# All recorded, from builds of these releases in PX4's own simulator SIH (1.15.2: in an earlier session).
STATUSES = (
    Status("1.14.4", "GPS", 831, 0.3111, True),
    Status("1.14.4", "GPS lost, at once", 831, 0.4412, True),
    Status("1.14.4", "GPS lost, after 9 s", 165, 14.1432, False),
    Status("1.14.4", "GPS lost, after 20 s", 165, 0.3035, False),
    Status("1.14.4", "started without GPS", 165, 0.3921, False),
    Status("1.15.2", "GPS", 895, 0.29, True),
    Status("1.15.2", "started without GPS", 229, 101.3, False),
    Status("1.15.4", "GPS", 895, 0.3007, True),
    Status("1.15.4", "GPS lost, after 6 s", 229, 3.351, False),
    Status("1.15.4", "started without GPS", 228, 61.0419, False),
    Status("1.16.2", "GPS", 1023, 0.287, True),
    Status("1.16.2", "GPS lost, after 4 s", 997, 1.4464, False),
    Status("1.16.2", "GPS lost, after 6 s", 229, 14.1439, False),
    Status("1.16.2", "GPS lost, after 20 s", 229, 0.0137, False),
    Status("1.16.2", "started without GPS", 1253, 0.0129, False),
    Status("1.17.0", "GPS", 1023, 0.2851, True),
    Status("1.17.0", "GPS lost, at once", 1023, 0.3952, True),
    Status("1.17.0", "GPS lost, after 4 s", 997, 1.3884, False),
    Status("1.17.0", "GPS lost, after 6 s", 229, 14.1534, False),
    Status("1.17.0", "GPS lost, after 14 s", 229, 0.0159, False),
    Status("1.17.0", "started without GPS", 1253, 0.0131, False),
    Status("1.18.0-beta1", "GPS", 1023, 0.2872, True),
    Status("1.18.0-beta1", "GPS lost, after 4 s", 997, 1.4277, False),
    Status("1.18.0-beta1", "GPS lost, after 6 s", 229, 14.2019, False),
    Status("1.18.0-beta1", "GPS lost, after 20 s", 229, 0.0122, False),
    Status("1.18.0-beta1", "started without GPS", 1253, 0.0132, False),
)


@pytest.mark.parametrize("status", STATUSES, ids=lambda status: f"{status.release}, {status.what}")
def test_every_release_is_read_alike(status: Status) -> None:
    read = estimator_status({"flags": status.flags, "pos_horiz_accuracy": status.accuracy})
    assert (read.refusal(MOST) == "") is status.flies, (status, read.words)
    assert (read.position_accuracy <= MOST) is status.flies
    if not status.flies:
        assert math.isinf(read.position_accuracy), "no accuracy stands for a position that is not there"


def test_a_refusal_tells_what_was_received_and_what_was_wanted() -> None:
    without = estimator_status({"flags": 1253, "pos_horiz_accuracy": 0.013}).refusal(MOST)
    assert "has no position" in without
    assert "received: attitude, vertical velocity, height, height above ground, constant position" in without
    assert "GPS glitch; 0.01 m" in without
    assert "wanted: relative or absolute position, known to 2 m" in without
    poor = estimator_status({"flags": 895, "pos_horiz_accuracy": 7.31}).refusal(MOST)
    assert "knows the position to 7.3 m only" in poor
    assert "absolute position" in poor
    untold = estimator_status({"flags": 895, "pos_horiz_accuracy": None}).refusal(MOST)
    assert "does not tell how well" in untold
    assert "no accuracy" in untold
    assert EstimatorStatus(0, math.inf).words == "no flag; no accuracy"
    assert "unknown flags 0x1000" in EstimatorStatus(0x1001, 1.0).words


def test_the_status_for_the_ground_is_json() -> None:
    for accuracy in (math.inf, math.nan, None, -1.0, 0.25):
        described = estimator_status({"flags": 895, "pos_horiz_accuracy": accuracy}).describe()
        json.dumps(described, allow_nan=False)
        assert described["accuracy"] == (0.25 if accuracy == 0.25 else None)


@pytest.mark.parametrize("fields", [{}, {"flags": 1}, {"flags": None, "pos_horiz_accuracy": 1.0}])
def test_what_is_no_status_is_no_answer(fields: dict[str, Any]) -> None:
    with pytest.raises((KeyError, TypeError, ValueError)):
        estimator_status(fields)


def set_gps(bridge: Bridge, used: bool) -> None:
    """EKF2_GPS_CTRL of the stand-in, set by a ground station."""
    station = mavutil.mavlink_connection(f"udpout:127.0.0.1:{bridge.port}", source_system=255)
    try:
        # PX4 takes an INT32 as its four bytes in the place of a float.
        (value,) = struct.unpack("<f", struct.pack("<i", 7 if used else 0))
        station.mav.param_set_send(1, 1, b"EKF2_GPS_CTRL", value, mav.MAV_PARAM_TYPE_INT32)
    finally:
        station.close()


def test_no_flight_without_a_position_and_every_refusal_tells_what_was_received(tmp_path: Path) -> None:
    """At rest the accuracy looks good and the flag of a constant position is set, with GPS and without."""
    port = free_port()
    bridge = Bridge(port, "--param", "EKF2_GPS_CTRL=0", "--param", "COM_OBL_RC_ACT=4")
    try:
        report = companion(
            "preflight", "--connect", f"udpin://127.0.0.1:{port}", "--vehicle", VEHICLE, "--json"
        )
        rows = {row["name"]: row for row in json.loads(report.stdout)["arming"]}
        assert report.returncode == 2
        assert (rows["position"]["state"], rows["position"]["value"]) == ("fail", "none")
        assert "constant position" in rows["position"]["why"]
        assert "0.02 m" in rows["position"]["why"]
        assert "known to 2 m" in rows["position"]["wanted"]
        assert rows["arming"]["value"] == "PX4 would arm"
        assert "without a position, the companion does not" in rows["arming"]["why"]

        flying = Companion(tmp_path, port)
        try:
            refused = flying.ask("mission", {"trajectory": "hover"})
            assert not refused["accepted"]
            status = flying.ask("status")
            for text in (refused["reason"], status["not_ready"]):
                assert "has no position" in text
                assert "received: attitude" in text
                assert "known to 2 m" in text
            assert (status["position"]["valid"], status["position"]["accuracy"]) == (False, None)

            set_gps(bridge, True)
            wait_for(lambda: flying.ask("status")["ready"], "a position")
            assert "constant position" in flying.ask("status")["position"]["received"]
            identity = flying.fly(trajectory="hover", parameters={"duration": 60})
            flying.phase("mission")
            set_gps(bridge, False)
            reason = flying.done(identity)["reason"]
            assert "has no position" in reason
            assert "100.00 m" in reason
        finally:
            flying.end()
    finally:
        bridge.end()
