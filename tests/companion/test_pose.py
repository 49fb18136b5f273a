"""Mocap poses reach the autopilot in its own frames and with their own time, and only good ones do."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mav
from rig import PATIENT, Bridge, Companion, Wiretap, wait_for

from trueflight.companion.odometry import vision_estimate
from trueflight.companion.pose import PoseFeed, PoseGate, PoseSettings
from trueflight.models import contract
from trueflight.models.pose import Pose, pose_from_json, pose_to_json

pytestmark = pytest.mark.realtime

LEVEL = (1.0, 0.0, 0.0, 0.0)
coordinates = st.floats(-50.0, 50.0)
angles = st.floats(-math.pi, math.pi)


def elementary(axis: int, angle: float) -> np.ndarray:
    """Rotation about one axis by an angle."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[i, i], out[i, j], out[j, i], out[j, j] = c, -s, s, c
    return out


class TestFrames:
    """World ENU and body FLU to NED and FRD, against plain matrices."""

    NED_OF_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    FRD_OF_FLU = np.diag([1.0, -1.0, -1.0])

    @given(coordinates, coordinates, coordinates, angles, st.floats(-1.5, 1.5), angles)
    def test_any_pose(self, x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> None:
        estimate = vision_estimate(Pose((x, y, z), quaternion(yaw, pitch, roll)), 7, 3)
        np.testing.assert_allclose(estimate.position, self.NED_OF_ENU @ [x, y, z], atol=1e-12)
        flu_to_enu = elementary(2, yaw) @ elementary(1, pitch) @ elementary(0, roll)
        frd_to_ned = self.NED_OF_ENU @ flu_to_enu @ self.FRD_OF_FLU.T
        told_roll, told_pitch, told_yaw = estimate.angles
        sent = elementary(2, told_yaw) @ elementary(1, told_pitch) @ elementary(0, told_roll)
        np.testing.assert_allclose(sent, frd_to_ned, atol=1e-9)
        assert (estimate.taken_us, estimate.reset_counter) == (7, 3)

    def test_nose_to_the_east_is_ninety_degrees_from_north(self) -> None:
        assert vision_estimate(Pose((0, 0, 0), LEVEL), 0, 0).angles[2] == pytest.approx(0.5 * math.pi)

    def test_what_is_unknown_is_told_as_unknown(self) -> None:
        (only,) = vision_estimate(Pose((0, 0, 0), LEVEL), 0, 0).covariance
        assert math.isnan(only)
        known = vision_estimate(Pose((0, 0, 0), LEVEL, 0, 0.1, 0.2), 0, 0).covariance
        # The diagonal of the upper right triangle.
        assert [known[i] for i in (0, 6, 11, 15, 18, 20)] == pytest.approx([0.01] * 3 + [0.04] * 3)
        assert sum(known) == pytest.approx(0.15)


def quaternion(yaw: float, pitch: float, roll: float) -> tuple[float, float, float, float]:
    """Unit quaternion of Z-Y-X angles, by multiplying the elementary ones."""

    def product(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float, float]:
        return (
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        )

    def about(axis: int, angle: float) -> tuple[float, ...]:
        out = [math.cos(0.5 * angle), 0.0, 0.0, 0.0]
        out[1 + axis] = math.sin(0.5 * angle)
        return tuple(out)

    return product(product(about(2, yaw), about(1, pitch)), about(0, roll))


class TestPayload:
    """What travels over Zenoh."""

    @given(coordinates, angles, st.integers(0, 2**62), st.floats(1e-4, 1.0))
    def test_there_and_back(self, x: float, yaw: float, time_ns: int, std: float) -> None:
        pose = Pose((x, -x, 1.0), quaternion(yaw, 0.1, 0.2), time_ns, std, 2 * std)
        back = pose_from_json(pose_to_json(pose))
        assert back.position == pose.position
        assert back.quaternion == pytest.approx(pose.quaternion, abs=1e-12)
        assert (back.time_ns, back.position_std, back.attitude_std) == (time_ns, std, 2 * std)

    @pytest.mark.parametrize(
        ("payload", "reason"),
        [
            (b"", "no JSON object"),
            (b"[1, 2]", "no JSON object"),
            (b"\xff\xfe", "no JSON object"),
            (b'{"position": [1, 2, 3]}', "no JSON object"),
            (b'{"position": [1, 2], "quaternion": [1, 0, 0, 0]}', "no list of 3"),
            (b'{"position": [1, 2, NaN], "quaternion": [1, 0, 0, 0]}', "not finite"),
            (b'{"position": [1, 2, Infinity], "quaternion": [1, 0, 0, 0]}', "not finite"),
            (b'{"position": [1, 2, "3"], "quaternion": [1, 0, 0, 0]}', "no number"),
            (b'{"position": [1, 2, 3], "quaternion": [0, 0, 0, 0]}', "length 0, not 1"),
            (b'{"position": [1, 2, 3], "quaternion": [10, 0, 0, 0]}', "length 10, not 1"),
            (b'{"position": [1, 2, 3], "quaternion": [1, 0, 0, 0], "time_ns": 1.5}', "time_ns"),
            (b'{"position": [1, 2, 3], "quaternion": [1, 0, 0, 0], "position_std": "x"}', "position_std"),
        ],
    )
    def test_what_is_no_pose_is_told(self, payload: bytes, reason: str) -> None:
        with pytest.raises(ValueError, match=reason):
            pose_from_json(payload)


class TestGate:
    """What may pass."""

    def at(self, x: float, yaw: float = 0.0) -> Pose:
        return Pose((x, 0.0, 1.0), quaternion(yaw, 0.0, 0.0))

    def test_a_flight_within_the_limits_passes_whole(self) -> None:
        gate, settings = PoseGate(PoseSettings()), PoseSettings()
        for i in range(500):
            t = 0.01 * i
            across = 0.4 * settings.acceleration * math.sin(t)  # up to 8 m/s and 8 m/s²
            pose = self.at(across, 0.9 * settings.spin * t)
            assert gate.judge(pose, 100.0 + t, 100.0 + t + 0.02) == ""
        assert gate.reset_counter == 0

    def test_old_early_and_repeated_poses_do_not(self) -> None:
        gate = PoseGate(PoseSettings())
        assert gate.judge(self.at(0.0), 10.0, 10.2).startswith("stale: 0.20 s")
        assert gate.judge(self.at(0.0), 13600.0, 10.0).startswith("from the future")
        assert gate.judge(self.at(0.0), 10.0, 10.01) == ""
        assert gate.judge(self.at(0.0), 10.0, 10.01).startswith("out of order")
        assert gate.judge(self.at(0.0), 9.99, 10.01).startswith("out of order")

    @pytest.mark.parametrize("there", [(0.5, 0.0), (0.0, 1.0), (0.5, 3.0)])
    def test_a_swapped_marker_does_not_for_as_long_as_it_lasts(self, there: tuple[float, float]) -> None:
        gate = PoseGate(PoseSettings())
        for i in range(100):
            t = 0.01 * i
            swapped = 20 <= i < 70
            reason = gate.judge(self.at(*there) if swapped else self.at(0.0), t, t)
            assert reason.startswith("jump") is swapped, (i, reason)
        assert gate.reset_counter == 0

    def test_the_same_other_place_for_long_enough_is_believed_with_a_reset(self) -> None:
        settings = PoseSettings()
        gate = PoseGate(settings)
        gate.judge(self.at(0.0), 0.0, 0.0)
        passed = [gate.judge(self.at(3.0), 0.01 * i, 0.01 * i) == "" for i in range(1, 200)]
        first = 0.01 * (1 + passed.index(True))
        assert first == pytest.approx(settings.settle, abs=0.03)
        assert all(passed[passed.index(True) :])
        assert gate.reset_counter == 1

    def test_poses_that_jump_about_are_never_believed(self) -> None:
        gate = PoseGate(PoseSettings())
        gate.judge(self.at(0.0), 0.0, 0.0)
        for i in range(1, 500):
            assert gate.judge(self.at(5.0 + 2.0 * (i % 2)), 0.01 * i, 0.01 * i).startswith("jump")


class TestFeed:
    """From payload to `send`, with what is told."""

    @pytest.fixture
    def feed(self) -> Iterator[tuple[PoseFeed, list[tuple[Pose, int, int]], list[tuple[str, str]]]]:
        sent: list[tuple[Pose, int, int]] = []
        told: list[tuple[str, str]] = []
        feed = PoseFeed(
            PoseSettings(enabled=True, lost=0.2, latency=0.005),
            lambda pose, taken, resets: sent.append((pose, taken, resets)),
            lambda level, kind, text: told.append((kind, text)),
        )
        yield feed, sent, told
        feed.close()

    def test_good_poses_pass_and_trouble_is_told_once(self, feed) -> None:  # type: ignore[no-untyped-def]
        feed, sent, told = feed
        assert "at all" in feed.why_not
        for payload in (b"garbage", b"more garbage", pose_to_json(Pose((0, 0, 1), LEVEL))):
            feed.take(payload)
        wait_for(lambda: feed.status()["refused"] == {"malformed": 2, "no time": 1}, "three refusals")
        assert [kind for kind, _ in told] == ["pose_refused", "pose_refused"], "each trouble once"
        stamp = time.time_ns()
        feed.take(pose_to_json(Pose((0, 0, 1), LEVEL, stamp)))
        wait_for(lambda: sent, "the pose")
        assert sent[0][1] == stamp // 1000 - 5000
        assert feed.why_not == ""
        wait_for(lambda: ("pose_lost", "no good pose for 0.2 s") in told, "the loss")
        assert "refused" in feed.why_not
        feed.take(pose_to_json(Pose((0, 0, 1), LEVEL, time.time_ns())))
        wait_for(lambda: told[-1][0] == "pose_back", "the return")


def decoded(datagrams: list[bytes]) -> list[mav.MAVLink_vision_position_estimate_message]:
    return [mav.MAVLink(None).decode(bytearray(datagram)) for datagram in datagrams]


def test_from_zenoh_to_the_wire_and_a_lost_feed_lands(tmp_path: Path) -> None:
    config = tmp_path / "companion.toml"
    config.write_text(PATIENT + "[pose]\nenabled = true\nstale = 1.0\nlost = 1.0\n")
    tap = Wiretap()
    bridge = Bridge(tap.port)
    companion = Companion(tmp_path, tap.companion_port, "--config", str(config))
    try:
        answer = companion.ask("mission", {"trajectory": "hover"})
        assert not answer["accepted"]
        assert "no good mocap or vision pose" in answer["reason"]
        publisher = companion.session.declare_publisher(contract.key("quad5", "pose"))
        turned = quaternion(0.5 * math.pi, 0.0, 0.0)
        stamps: list[int] = []

        def put(position: tuple[float, float, float]) -> None:
            stamps.append(time.time_ns())
            publisher.put(pose_to_json(Pose(position, turned, stamps[-1])))
            time.sleep(0.01)

        wait_for(lambda: put((1.0, 2.0, 0.5)) or len(tap.poses) > 20, "poses on the wire")
        before = len(tap.poses)
        publisher.put(json.dumps({"position": [1.0, 2.0, None], "quaternion": [1, 0, 0, 0]}))
        put((9.0, 2.0, 0.5))
        wait_for(
            lambda: companion.ask("status")["pose"]["refused"] == {"malformed": 1, "jump": 1}, "refusals"
        )
        assert len(tap.poses) <= before + 1
        sent = decoded(tap.poses)
        first = sent[0]
        assert (first.x, first.y, first.z) == (2.0, 1.0, -0.5)
        assert (first.roll, first.pitch, first.yaw) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
        assert all(one.x == 2.0 for one in sent)
        # Each carries the time at which it was taken, to the microsecond, on the clock that TIMESYNC tells.
        assert {one.usec for one in sent} <= {stamp // 1000 for stamp in stamps}
        status = companion.ask("status")["pose"]
        assert status["passed"] >= len(sent)
        assert 0.0 <= status["handling_ms"]["median"] <= status["latency_ms"]["median"]
        # In flight the feed stops.
        wait_for(lambda: put((1.0, 2.0, 0.5)) or companion.ask("status")["ready"], "ready")
        mission = companion.ask("mission", {"trajectory": "hover", "parameters": {"duration": 600.0}})
        assert mission["accepted"], mission
        wait_for(lambda: put((1.0, 2.0, 0.5)) or companion.ticks[-1].phase == "mission", "the mission")
        done = companion.done(mission["mission"])
        assert done["state"] == "aborted"
        assert "no good mocap or vision pose" in done["reason"]
        assert companion.told("pose_lost")
    finally:
        companion.end()
        bridge.end()
        tap.close()
