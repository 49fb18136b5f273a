"""What may be asked for: size, length and depth are bounded, and the answer says by how much."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from typing import Any

import pytest

from trueflight.companion.mission_request import SMALL, mission_request, read_json, read_request
from trueflight.models.contract import REQUEST_BYTES, too_large
from trueflight.models.errors import InputError
from trueflight.models.pose import pose_from_json
from trueflight.models.reference import LONGEST, MOST_ROWS, trajectory_from_csv

HUGE = 10**400


def table(*times: float) -> str:
    return "t,x,y,z\n" + "\n".join(f"{t!r},0,0,1" for t in times)


MISSIONS: dict[str, tuple[dict[str, Any], str]] = {
    "long ago": ({"trajectory": "hover", "parameters": {"duration": 1e9}}, "outside 0.5 to 3600 s"),
    "slow": (
        {"trajectory": "spiral", "parameters": {"laps": 100, "speed": 0.05, "radius": 50}},
        "at most 3600",
    ),
    "slower": ({"trajectory": "circle", "parameters": {"speed": 1e-9}}, "outside"),
    "often": (
        {"trajectory": "hover", "parameters": {"duration": 60.0}, "repeat": 100},
        "100 times, takes 6000 s",
    ),
    "nan": ({"trajectory": "hover", "parameters": {"height": math.nan}}, "outside"),
    "huge": ({"trajectory": "hover", "parameters": {"height": HUGE}}, "must be a number"),
    "truth": ({"trajectory": "hover", "parameters": {"height": True}}, "outside|number"),
    "list": ({"trajectory": "hover", "parameters": {"height": [1.0]}}, "must be a number"),
    "the name itself": ({"trajectory": "hover", "parameters": {"name": "x"}}, "no parameter 'name'"),
    "no name": ({"trajectory": ["hover"]}, "must be one of"),
    "repeat": ({"trajectory": "hover", "repeat": HUGE}, "from 1 to 100"),
    "repeat of a truth": ({"trajectory": "hover", "repeat": True}, "from 1 to 100"),
    "controller": ({"trajectory": "hover", "controller": ["lqr"] * 9}, "must be a name"),
    "key": ({"a" * 9000: 1}, "unknown key"),
    "setpoints": ({"setpoints": [1, 2]}, "text of a table"),
    "10^6 s": ({"setpoints": table(0.0, 1e6)}, f"at most {LONGEST:g} s"),
    "10^300 s": ({"setpoints": table(-1e308, 1e308)}, f"at most {LONGEST:g} s"),
    "close": ({"setpoints": table(0.0, 1e-320, 2.0)}, "row 3 comes .* at least 0.001 s"),
    "closer": ({"setpoints": table(0.0, 1.0, 1.0 + 1e-9)}, "row 4 comes"),
    "far": ({"setpoints": "t,x,y,z\n0,0,0,1\n1,1e300,0,1"}, "beyond"),
    "many": ({"setpoints": table(*range(MOST_ROWS + 1))}, f"at most {MOST_ROWS}"),
    "quoted": ({"setpoints": 't,x,y,z\n"' + "a" * 200_000}, "comma-separated"),
}


@pytest.mark.parametrize("name", MISSIONS)
def test_a_mission_beyond_the_limits_is_refused_with_them(name: str) -> None:
    request, reason = MISSIONS[name]
    with pytest.raises(InputError, match=reason) as told:
        mission_request(request)
    assert len(str(told.value)) < 400


@pytest.mark.parametrize(
    "payload",
    [
        b"[" * 100_000,
        b'{"a":' * 3000,
        b"1" * 6000,
        b"\xff\xfe\x00",
        b"[1]",
        b"null",
        b'{"trajectory": [' + b"0," * 4000,
    ],
)
def test_what_is_no_object_of_json_is_refused(payload: bytes) -> None:
    with pytest.raises(InputError, match="the request"):
        read_json(payload)


def test_a_long_table_is_read_by_a_child_and_flies_as_it_would_here() -> None:
    text = "t,x,y,z,yaw\n" + "\n".join(f"{0.1 * i:.1f},{math.sin(0.1 * i):.6f},0,1,0.2" for i in range(600))
    payload = json.dumps({"setpoints": text, "repeat": 2, "controller": "lqr"}).encode()
    assert len(payload) > SMALL
    asked = mission_request(read_request(payload))
    here = trajectory_from_csv(text)
    assert (asked.repeat, asked.controller) == (2, "lqr")
    assert asked.path.duration == pytest.approx(here.duration)
    assert asked.path.bounds == here.bounds
    assert (asked.path.start, asked.path.end) == (here.start, here.end)
    for t in (0.0, 3.33, 17.0, 59.9, 80.0):
        assert asked.path.at(t) == here.at(t)


@pytest.mark.parametrize(
    "payload",
    [
        b'{"trajectory": [' + b"0," * 100_000 + b"0]}",
        b"[" * 100_000,
        b'{"setpoints": "' + b"a" * 200_000 + b'"}',
        b"\x00" * 100_000,
        json.dumps({"setpoints": table(*(1e-6 * i for i in range(5000)))}).encode(),
    ],
)
def test_a_long_message_of_nonsense_is_refused_by_the_child(payload: bytes) -> None:
    with pytest.raises(InputError) as told:
        read_request(payload)
    assert len(str(told.value)) < 1100
    assert "ended with code" not in str(told.value)


def test_every_key_has_a_limit_that_its_refusal_names() -> None:
    for leaf, most in REQUEST_BYTES.items():
        assert too_large(leaf, most) == ""
        assert str(most) in too_large(leaf, most + 1)


def pose(**changes: Any) -> bytes:
    return json.dumps({"position": [0, 0, 1], "quaternion": [1, 0, 0, 0], "time_ns": 1, **changes}).encode()


POSES: dict[str, bytes] = {
    "position of 400 digits": pose(position=[HUGE, 0, 0]),
    "quaternion of 400 digits": pose(quaternion=[HUGE, 0, 0, 0]),
    "deviation of 400 digits": pose(position_std=HUGE),
    "time of 400 digits": pose(time_ns=HUGE),
    "time beyond 64 bits": pose(time_ns=1 << 63),
    "infinite deviation": pose(attitude_std=math.inf),
    "negative deviation": pose(position_std=-1),
    "beyond a single": pose(position=[1e300, 0, 0]),
    "quaternion that overflows": pose(quaternion=[1e200, 0, 0, 0]),
    "digits without end": b'{"position": [' + b"1" * 5000 + b",0,0]}",
    "deep": b'{"position": ' + b"[" * 3000,
    "deep object": b'{"a":' * 3000,
    "no object": b"[1, 2]",
    "text": pose(position="abc"),
    "nothing": b"",
    "no text": b"\xff\x00\xfe",
}


@pytest.mark.parametrize("name", POSES)
def test_no_packet_is_anything_but_a_pose_or_refused(name: str) -> None:
    with pytest.raises(ValueError, match="it") as told:
        pose_from_json(POSES[name])
    assert type(told.value) is ValueError
    assert len(str(told.value)) < 200


def test_no_packet_ends_the_feed() -> None:
    from trueflight.companion.pose import PoseFeed, PoseSettings

    passed: list[object] = []
    told: list[str] = []

    def send(pose: object, taken_us: int, counter: int) -> None:
        if not passed:
            passed.append(None)
            raise ZeroDivisionError("a wire that nobody foresaw")
        passed.append(pose)

    feed = PoseFeed(PoseSettings(enabled=True, clock="arrival"), send, lambda *words: told.append(words[2]))
    try:
        for payload in [*POSES.values(), pose()]:
            feed.take(payload)
            wait(lambda: not feed._waiting)
        feed.take(pose())
        wait(lambda: len(passed) == 2)
        refused = feed.status()["refused"]
        assert refused["malformed"] == len(POSES)
        assert refused["failed"] == 1
        assert any("ZeroDivisionError" in text for text in told)
    finally:
        feed.close()


def wait(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
