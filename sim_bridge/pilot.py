"""The simulated pilot: sends one order to a running `sim-bridge run`."""

from __future__ import annotations

import json
import socket

from trueflight.models.errors import InputError


def send_order(mode: str, port: int, timeout: float = 2.0) -> dict[str, object]:
    """Switch the mode over UDP on 127.0.0.1 and return the answer. Raises `InputError` where nobody
    answers.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pilot:
        pilot.settimeout(timeout)
        pilot.connect(("127.0.0.1", port))
        try:
            pilot.send(json.dumps({"mode": mode}).encode())
            answer: dict[str, object] = json.loads(pilot.recv(4096))
        except (TimeoutError, ConnectionError):
            raise InputError(
                f"no simulated vehicle answers on UDP port {port}; "
                "start `sim-bridge run`, or give its --pilot-port"
            ) from None
        except ValueError:
            raise InputError(
                f"what listens on UDP port {port} is no sim-bridge; give its --pilot-port"
            ) from None
    return answer
