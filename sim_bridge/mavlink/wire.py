"""Frames and units at the rim: world ENU and body FLU inside, NED, FRD, degrees and milli-units on the
wire.
"""

from __future__ import annotations

import math
import struct

_HALF_ROOT = math.sqrt(0.5)
EARTH_RADIUS = 6371000.0
"""m; PX4's map projection uses a sphere of this radius."""

ORIGIN = (47.397742, 8.545594, 488.0)
"""Latitude and longitude in degrees and altitude in m of the local origin: PX4's usual simulation home in
Zurich.
"""

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def ned(v: Vector) -> Vector:
    """ENU in NED, and back."""
    return v[1], v[0], -v[2]


def frd(v: Vector) -> Vector:
    """FLU in FRD, and back."""
    return v[0], -v[1], -v[2]


def attitude(q: Quaternion) -> Quaternion:
    """The quaternion body FLU to world ENU as body FRD to world NED, and back; w is not negative."""
    w, x, y, z = q
    r = _HALF_ROOT
    a, b, c, d = r * (w + z), r * (x + y), r * (x - y), r * (w - z)
    return (-a, -b, -c, -d) if a < 0 else (a, b, c, d)


def heading(yaw: float) -> float:
    """Yaw about z up from east as yaw about z down from north, rad in (-pi, pi], and back."""
    turned = math.pi / 2 - yaw
    return math.atan2(math.sin(turned), math.cos(turned))


def euler(q: Quaternion) -> Vector:
    """Roll, pitch, yaw (rad) of a wire quaternion (FRD to NED)."""
    w, x, y, z = q
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(min(max(2 * (w * y - x * z), -1.0), 1.0)),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def geodetic(position: Vector) -> tuple[float, float, float]:
    """Latitude and longitude in degrees and altitude in m of a position (m, ENU from the origin)."""
    latitude, longitude, altitude = ORIGIN
    east, north, up = position
    return (
        latitude + math.degrees(north / EARTH_RADIUS),
        longitude + math.degrees(east / (EARTH_RADIUS * math.cos(math.radians(latitude)))),
        altitude + up,
    )


def local(latitude: float, longitude: float, altitude: float) -> Vector:
    """Position (m, ENU from the origin) of a latitude and longitude in degrees and an altitude in m."""
    lat0, lon0, alt0 = ORIGIN
    east = math.radians(longitude - lon0) * EARTH_RADIUS * math.cos(math.radians(lat0))
    return east, math.radians(latitude - lat0) * EARTH_RADIUS, altitude - alt0


def float_of_int(value: int) -> float:
    """The float whose 32 bits are an INT32, as PX4 sends integer parameters."""
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def int_of_float(value: float) -> int:
    """The INT32 with the 32 bits of a float."""
    return int(struct.unpack("<i", struct.pack("<f", value))[0])
