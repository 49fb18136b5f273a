"""A program that floods one key of a companion, or its MAVLink port, and prints what came back.

    python flood.py zenoh PORT LEAF COUNT SEED
    python flood.py mavlink PORT KIND COUNT SEED

Nothing that it sends is allowed: garbage, requests of a wrong form, missions that leave the fence, ticks and events
that are no one's, MAVLink of others. What is accepted nevertheless is counted.
"""

from __future__ import annotations

import json
import random
import socket
import sys
import threading
import time
from collections.abc import Callable

import zenoh
from pymavlink.dialects.v20 import common as mav

from trueflight.models import contract

PUBLISHED = ("pose", "tick", "event")
ASKED = ("status", "mission", "model", "record")
DATAGRAMS = ("garbage", "foreign")
WAITING = 256
"""Queries that are on their way at once."""
_RATE = 5000.0
"""Datagrams a second: more than that is lost in the kernel, and with it what the vehicle says."""

_WRONG: dict[str, list[bytes]] = {
    "mission": [
        b'{"trajectory": "lemniscate", "parameters": {"width": 90.0}}',
        b'{"trajectory": "hover", "parameters": {"height": 99.0}}',
        b'{"trajectory": "nowhere"}',
        b'{"trajectory": 7, "parameters": []}',
        b'{"trajectory": "hover", "parameters": {"duration": NaN}}',
        b'{"trajectory": "hover", "controller": "mine"}',
        b'{"trajectory": "hover", "controller": "corrected"}',
        b'{"trajectory": "hover", "repeat": 1e9}',
        b'{"trajectory": "hover", "altitude": 3}',
        b'{"setpoints": "t,x,y,z\\n0,0,0,1\\n1e6,0,0,1\\n"}',
        b'{"setpoints": "t,x,y,z\\n0,0,0,1\\n1e-9,0,0,1\\n"}',
        b'{"command": "arm"}',
        b"[" * 5000,
        b'{"repeat": ' + b"9" * 5000 + b"}",
        b"[1, 2]",
        b"\xff\xfe",
    ],
    "model": [
        b'{"command": "format"}',
        b'{"command": ["rollback"]}',
        b'{"command": null}',
        b"\x08\x0a\x12\x00",
        b"{",
        b"\x00" * 4096,
    ],
    "record": [
        b'{"name": "../../etc/passwd"}',
        b'{"name": "/etc/passwd"}',
        b'{"name": "nothing.mcap"}',
        b'{"name": ["a"]}',
        b'{"name": "", "offset": -1}',
        b'{"name": "x.mcap", "offset": 1e99, "length": "all"}',
        b"[]",
    ],
    "pose": [
        b'{"position": [0, 0, 1e999], "quaternion": [1, 0, 0, 0]}',
        b'{"position": [0, 0, ' + b"9" * 400 + b'], "quaternion": [1, 0, 0, 0]}',
        b'{"position": [50, 50, 50], "quaternion": [1, 0, 0, 0]}',
        b'{"position": "here", "quaternion": {}}',
        b'{"position": [0, 0, 0], "quaternion": [0, 0, 0, 0]}',
        b"[" * 3000,
        b"null",
    ],
}


def payload(leaf: str, draw: random.Random) -> bytes:
    """Something that no companion may obey."""
    if leaf in _WRONG and draw.random() < 0.7:
        wrong = bytearray(draw.choice(_WRONG[leaf]))
        if draw.random() < 0.3 and wrong[:1] == b"[":
            wrong[draw.randrange(len(wrong))] = draw.randrange(256)
        return bytes(wrong)
    return b"\x08" + draw.randbytes(draw.randrange(400))  # no JSON begins so; every network does


def zenoh_flood(port: int, leaf: str, count: int, seed: int) -> dict[str, float]:
    """`count` messages on one key; how many were accepted, refused, not answered, and the seconds it took."""
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    draw, key, begin = random.Random(seed), contract.key("quad5", leaf), time.monotonic()
    with zenoh.open(config) as session:
        if leaf in PUBLISHED:
            for _ in range(count):
                session.put(key, payload(leaf, draw))
            return {"sent": count, "accepted": 0, "refused": 0, "seconds": time.monotonic() - begin}
        accepted, refused = _ask(session, key, lambda: payload(leaf, draw), count)
    return {"sent": count, "accepted": accepted, "refused": refused, "seconds": time.monotonic() - begin}


def _ask(session: zenoh.Session, key: str, make: Callable[[], bytes], count: int) -> tuple[int, int]:
    free = threading.Semaphore(WAITING)
    answers = {True: 0, False: 0}

    def answered(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            said = reply.ok.payload.to_bytes()
            answers[b'"accepted": true' in said or said[:1] != b"{"] += 1

    for _ in range(count):
        free.acquire()
        # Zenoh lets go of the handler once no more answers can come.
        session.get(
            key, handler=zenoh.handlers.Callback(answered, drop=free.release), payload=make(), timeout=20.0
        )
    for _ in range(WAITING):
        free.acquire()
    return answers[True], answers[False]


def mavlink_flood(port: int, kind: str, count: int, seed: int) -> dict[str, float]:
    """`count` datagrams to the companion's MAVLink port; the seconds it took."""
    draw = random.Random(seed)
    sent = [_foreign(draw) if kind == "foreign" else _garbage(draw) for _ in range(2000)]
    begin = time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for number in range(count):
            out.sendto(sent[number % len(sent)], ("127.0.0.1", port))
            ahead = number / _RATE - (time.monotonic() - begin)
            if ahead > 0.002:
                time.sleep(ahead)
    return {"sent": count, "accepted": 0, "refused": 0, "seconds": time.monotonic() - begin}


def _garbage(draw: random.Random) -> bytes:
    """Random bytes, or a message of the vehicle's that was changed on the way."""
    if draw.random() < 0.5:
        return draw.randbytes(draw.randrange(1, 280))
    data = bytearray(_foreign(draw, system=1, component=1))
    for _ in range(draw.randint(1, 5)):
        data[draw.randrange(len(data) - 2, len(data))] ^= draw.randrange(1, 256)  # its checksum is wrong
    return bytes(data[: draw.randrange(8, len(data) + 1)])


def _foreign(draw: random.Random, system: int = 0, component: int = 0) -> bytes:
    """A valid message of another system or component that would end or mislead the flight, were it the autopilot's."""
    if not system:
        system, component = draw.choice([(1, 197), (1, 180), (2, 1), (255, 190), (7, 7)])
    link = mav.MAVLink(None, srcSystem=system, srcComponent=component)
    unknown, where = [float("nan")] * 21, [draw.uniform(-9.0, 9.0) for _ in range(3)]
    stamp = int(time.time() * 1e6)
    message = draw.choice(
        [
            link.odometry_encode(stamp, 1, 1, *where, [1, 0, 0, 0], *([0.0] * 6), unknown, unknown, 9, 3, 0),
            link.heartbeat_encode(2, 12, 81, 4 << 16 | 6 << 24, 5),
            link.battery_status_encode(1, 0, 1, 2000, [5100] + [65535] * 9, 50, 0, 0, 3),
            link.highres_imu_encode(stamp, *([30.0] * 9), 1.0, 1.0, 1.0, 1.0, 0xFFF),
            link.extended_sys_state_encode(0, 1),
            link.timesync_encode(draw.randrange(1 << 60), draw.randrange(1 << 60)),
            link.command_ack_encode(176, 4),
        ]
    )
    return bytes(message.pack(link))


if __name__ == "__main__":
    what, port, which, count, seed = sys.argv[1:]
    flood = zenoh_flood if what == "zenoh" else mavlink_flood
    sys.stdout.write(json.dumps(flood(int(port), which, int(count), int(seed))) + "\n")
