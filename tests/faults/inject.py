"""A program that sends messages of other components and systems into a companion's port for 2 s, as a router would.

`vio`: a camera's odometry of the same system; `vehicle2`: another vehicle; `battery2`, `smartbattery`: a second battery
of 5.1 V, by the autopilot and by a component of its own.
"""

from __future__ import annotations

import socket
import sys
import time

from pymavlink.dialects.v20 import common as mav

COMPONENTS = {"battery2": 1, "smartbattery": 180, "vio": 197, "vehicle2": 1}


def inject(kind: str, port: int) -> None:
    """Send for 2 s."""
    link = mav.MAVLink(None, srcSystem=2 if kind == "vehicle2" else 1, srcComponent=COMPONENTS[kind])
    unknown = [float("nan")] * 21
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for n in range(100):
            if kind in ("battery2", "smartbattery"):
                sent = [link.battery_status_encode(1, 0, 1, 2000, [5100] + [65535] * 9, 50, 0, 0, 90)]
            else:
                place = (1.0, 0.5, -1.0) if kind == "vio" else (5.0, 5.0, -3.0)
                stamp, still = int(time.time() * 1e6), (0.0,) * 6
                sent = [
                    link.odometry_encode(
                        stamp, 1, 12, *place, [1, 0, 0, 0], *still, unknown, unknown, 0, 3, 0
                    )
                ]
                if n % 25 == 0:
                    beat = (18, 8, 0, 0, 4) if kind == "vio" else (2, 12, 81, 0x060000, 3)
                    sent.append(link.heartbeat_encode(*beat))
            for message in sent:
                out.sendto(message.pack(link), ("127.0.0.1", port))
            time.sleep(0.02)


if __name__ == "__main__":
    inject(sys.argv[1], int(sys.argv[2]))
