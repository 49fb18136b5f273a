"""A second, thin MAVLink connection to the PX4 that is simulated: its parameters, and the battery's state to it."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import common as mav

from trueflight.models.errors import InputError
from trueflight.sim_bridge.mavlink import wire
from trueflight.sim_bridge.mavlink.peer import Peer
from trueflight.sim_bridge.truth.battery import Battery

PAYLOAD_PORT = 14030
"""Where PX4's simulation sends its second onboard stream (instance 0): a port that neither a companion nor a ground
station listens on.
"""

_INTEGER_TYPES = (
    mav.MAV_PARAM_TYPE_INT8,
    mav.MAV_PARAM_TYPE_INT16,
    mav.MAV_PARAM_TYPE_INT32,
    mav.MAV_PARAM_TYPE_UINT8,
    mav.MAV_PARAM_TYPE_UINT16,
    mav.MAV_PARAM_TYPE_UINT32,
)
_ASK_EVERY = 200_000  # us of the vehicle's clock
_AT_ONCE = 8  # requests in flight: the stream that answers is a slow one


class Px4Link:
    """Reads and sets parameters of the PX4 that sends to a UDP port of 127.0.0.1. Nothing here blocks.

    `values` holds what PX4 has told so far, integers as int.
    """

    def __init__(self, port: int) -> None:
        self.port = port
        self.values: dict[str, int | float] = {}
        self._types: dict[str, int] = {}
        self._wanted: list[str] = []
        self._ask_us = 0
        self._address: tuple[str, int] | None = None
        self._system = 1
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            if error.errno == errno.EADDRINUSE:
                raise InputError(
                    f"UDP port {port} on 127.0.0.1 is in use: another sim-bridge sitl or a payload may be listening; "
                    "stop it, or choose another port with --link-port (0: none)"
                ) from None
            raise InputError(f"--link-port {port}: {error.strerror}") from None
        self._socket.setblocking(False)
        self._peer = Peer(("127.0.0.1", port), 1, mav.MAV_COMP_ID_BATTERY, True, 0)

    @property
    def heard(self) -> bool:
        """Whether PX4 has sent anything here."""
        return self._address is not None

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()

    def ask(self, names: Iterable[str]) -> None:
        """Want these parameters; `poll` asks until they are there."""
        self._wanted = list(names)
        for name in self._wanted:
            self.values.pop(name, None)

    def has(self, names: Iterable[str]) -> bool:
        """Whether PX4 has told all of these."""
        return all(name in self.values for name in names)

    def poll(self, now_us: int) -> None:
        """Take what has come, and ask again for what is missing; `now_us` is the vehicle's clock."""
        while True:
            try:
                datagram, address = self._socket.recvfrom(65535)
            except (BlockingIOError, ConnectionError):
                break
            for message in self._peer.parse(datagram):
                self._take(message, address)
        if self._address is None or now_us < self._ask_us:
            return
        self._ask_us = now_us + _ASK_EVERY
        missing = [name for name in self._wanted if name not in self.values]
        for name in missing[:_AT_ONCE]:
            self._send(mav.MAVLink_param_request_read_message(self._system, 1, name.encode(), -1))

    def set(self, name: str, value: float) -> None:
        """Set a parameter that has been read before, in the type that PX4 gave; its answer replaces `values[name]`."""
        kind = self._types[name]
        self.values.pop(name, None)
        on_wire = wire.float_of_int(round(value)) if kind in _INTEGER_TYPES else float(value)
        self._send(mav.MAVLink_param_set_message(self._system, 1, name.encode(), on_wire, kind))

    def tell_battery(self, battery: Battery) -> None:
        """Tell the battery's true state, as a smart battery of the vehicle does."""
        if self._address is None:
            return
        cells = max(round(battery.cell.volts_per_cell_volt), 1)
        each = round(battery.voltage * 1e3 / cells)
        self._send(
            mav.MAVLink_battery_status_message(
                *(0, mav.MAV_BATTERY_FUNCTION_ALL, mav.MAV_BATTERY_TYPE_LIPO, 2500),
                [each if i < cells else 65535 for i in range(10)],
                round(battery.current * 100),
                round(battery.consumed / 3.6),
                -1,
                round(battery.charge * 100),
            )
        )

    def _take(self, message: Any, address: tuple[str, int]) -> None:
        if message.get_srcComponent() != mav.MAV_COMP_ID_AUTOPILOT1:
            return
        if self._address is None:
            # PX4 takes a battery's word only from its own system.
            self._address, self._system = address, message.get_srcSystem()
            self._peer = Peer(address, self._system, mav.MAV_COMP_ID_BATTERY, True, 0)
        if message.get_type() == "PARAM_VALUE":
            integer = message.param_type in _INTEGER_TYPES
            value = wire.int_of_float(message.param_value) if integer else float(message.param_value)
            self._types[message.param_id] = message.param_type
            self.values[message.param_id] = value

    def _send(self, message: Any) -> None:
        assert self._address is not None
        try:
            self._socket.sendto(self._peer.pack(message), self._address)
        except (BlockingIOError, ConnectionError):
            return
