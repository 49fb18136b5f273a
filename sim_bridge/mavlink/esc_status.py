"""ESC_STATUS (message 291), which PX4 sends and MAVSDK reads but pymavlink's common dialect leaves out.

Source: the message's definition in MAVLink's common.xml; the field order on the wire and the CRC seed follow
from it.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mav

ESC_STATUS = 291


class EscStatus(mav.MAVLink_message):
    """Rotor speeds (rpm), voltages (V) and currents (A) of four ESCs, the first having the given index."""

    id = ESC_STATUS
    msgname = "ESC_STATUS"
    fieldnames: ClassVar = ["index", "time_usec", "rpm", "voltage", "current"]
    ordered_fieldnames: ClassVar = ["time_usec", "rpm", "voltage", "current", "index"]
    fieldtypes: ClassVar = ["uint8_t", "uint64_t", "int32_t", "float", "float"]
    fielddisplays_by_name: ClassVar[dict[str, str]] = {}
    fieldenums_by_name: ClassVar[dict[str, str]] = {}
    fieldunits_by_name: ClassVar = {"time_usec": "us", "rpm": "rpm", "voltage": "V", "current": "A"}
    native_format = bytearray(b"<QiffB")
    orders: ClassVar = [4, 0, 1, 2, 3]
    lengths: ClassVar = [1, 4, 4, 4, 1]
    array_lengths: ClassVar = [0, 4, 4, 4, 0]
    crc_extra = 10
    unpacker = struct.Struct("<Q4i4f4fB")
    instance_field = "index"
    instance_offset = 56

    def __init__(
        self,
        index: int,
        time_usec: int,
        rpm: Sequence[int],
        voltage: Sequence[float],
        current: Sequence[float],
    ) -> None:
        mav.MAVLink_message.__init__(self, self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field = self.instance_field
        self._instance_offset = self.instance_offset
        self.index = index
        self.time_usec = time_usec
        self.rpm = rpm
        self.voltage = voltage
        self.current = current

    def pack(self, link: Any, force_mavlink1: bool = False) -> bytes:
        """The message's bytes for a link."""
        payload = self.unpacker.pack(self.time_usec, *self.rpm, *self.voltage, *self.current, self.index)
        packed: bytes = self._pack(link, self.crc_extra, payload, force_mavlink1=force_mavlink1)
        return packed
