"""What a Crazyflie's card and Betaflight's blackbox hold: the same flight as the tables made of them by others."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from px4_layouts import flown, middle_of

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.crazyflie_log import read_usd_log
from trueflight.groundstation.reading.several import flight_files
from trueflight.models.errors import InputError
from trueflight.models.frames import euler_from_quaternion
from trueflight.models.vehicle import GRAVITY

SAMPLES = Path(__file__).parents[2] / "samples" / "crazyflie"
VEHICLE = SAMPLES / "crazyswarm2_log08.vehicle.toml"
QUAD5 = Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml"


def usd(events: dict[str, tuple[np.ndarray, dict[str, tuple[str, np.ndarray]]]], version: int = 2) -> bytes:
    """A log as the firmware writes it: for each event its times (s) and variables (letter of `struct`, values)."""
    out = bytearray(b"\xbc" + struct.pack("<HH", version, len(events)))
    rows = []
    for number, (event, (t, variables)) in enumerate(events.items()):
        out += struct.pack("<H", number) + event.encode() + b"\0" + struct.pack("<H", len(variables))
        for name, (letter, _) in variables.items():
            out += f"{name}({letter})".encode() + b"\0"
        layout = "<" + "".join(letter for letter, _ in variables.values())
        for i, when in enumerate(t):
            values = [
                v[i].item() if letter in "fe" else round(v[i].item()) for letter, v in variables.values()
            ]
            head = (
                struct.pack("<HQ", number, round(1e6 * when))
                if version == 2
                else struct.pack("<HI", number, round(1e3 * when))
            )
            rows.append((when, head + struct.pack(layout, *values)))
    for _, row in sorted(rows, key=lambda pair: pair[0]):
        out += row
    return bytes(out + struct.pack("<I", zlib.crc32(out)))


def quat32(q: np.ndarray) -> np.ndarray:
    """Quaternions (M, 4) w, x, y, z in the firmware's 32 bits."""
    xyzw = q[:, [1, 2, 3, 0]]
    packed = []
    for one in xyzw:
        largest = int(np.argmax(np.abs(one)))
        word, negative = largest, one[largest] < 0
        for i in range(4):
            if i != largest:
                word = (
                    word << 10 | ((one[i] < 0) != negative) << 9 | int(511 * abs(one[i]) / np.sqrt(0.5) + 0.5)
                )
        packed.append(word)
    return np.array(packed)


def of_card(one, *, compressed: bool = False, version: int = 2) -> bytes:
    roll, pitch, yaw = np.degrees(euler_from_quaternion(one.quaternion)).T
    fast = {f"acc.{a}": ("f", one.specific_force[:, i] / GRAVITY) for i, a in enumerate("xyz")}
    fast |= {f"gyro.{a}": ("f", np.degrees(one.angular_velocity[:, i])) for i, a in enumerate("xyz")}
    fast["controller.cmd_thrust"] = ("f", 65535 * one.thrust)
    if compressed:
        fast |= {f"stateEstimateZ.{a}": ("h", 1000 * one.position[:, i]) for i, a in enumerate("xyz")}
        fast |= {f"stateEstimateZ.v{a}": ("h", 1000 * one.velocity[:, i]) for i, a in enumerate("xyz")}
        fast["stateEstimateZ.quat"] = ("I", quat32(one.quaternion))
    else:
        fast |= {f"stateEstimate.{a}": ("f", one.position[:, i]) for i, a in enumerate("xyz")}
        fast |= {f"stateEstimate.v{a}": ("f", one.velocity[:, i]) for i, a in enumerate("xyz")}
        fast |= {
            "stateEstimate.roll": ("f", roll),
            "stateEstimate.pitch": ("f", -pitch),
            "stateEstimate.yaw": ("f", yaw),
        }
    slow = slice(None, None, 10)
    return usd(
        {"fixedFrequency": (one.t, fast), "battery": (one.t[slow], {"pm.vbat": ("f", one.voltage[slow])})},
        version,
    )


def test_the_log_of_a_card_is_the_table_that_its_owners_made_of_it():
    card = read_flight(SAMPLES / "card" / "log08", VEHICLE)
    table = read_flight(SAMPLES / "crazyswarm2_log08.csv", VEHICLE)
    for name in ("position", "velocity"):
        for mine, theirs in zip(getattr(card, name).T, getattr(table, name).T, strict=True):
            np.testing.assert_allclose(np.interp(table.t, card.t, mine)[9:-9], theirs[9:-9], atol=0.02)
    commanded = np.interp(table.t, card.t, card.thrust_command)
    assert np.corrcoef(commanded[9:-9], table.thrust_command[9:-9])[0, 1] > 0.999
    assert card.has("position_reference")


@pytest.mark.parametrize("compressed, version", [(False, 1), (False, 2), (True, 2)])
def test_variables_of_either_kind_are_the_flight(tmp_path, compressed, version):
    one = flown()
    path = tmp_path / "log00"
    path.write_bytes(of_card(one, compressed=compressed, version=version))
    flight = read_flight(path, QUAD5)
    rows, there = middle_of(flight, one)
    np.testing.assert_allclose(flight.position[rows], one.position[there], atol=2e-3)
    np.testing.assert_allclose(flight.velocity[rows], one.velocity[there], atol=2e-3)
    turned = np.abs(np.sum(flight.quaternion[rows] * one.quaternion[there], axis=1))
    assert turned.min() > 1 - 1e-5
    np.testing.assert_allclose(flight.specific_force[rows], one.specific_force[there], atol=1e-3)
    np.testing.assert_allclose(flight.thrust_command[rows], one.thrust[there], atol=1e-4)
    np.testing.assert_allclose(flight.battery_voltage[rows], one.voltage[there], atol=0.05)
    assert flight_files(tmp_path) == [path]


@pytest.mark.parametrize("keep, words", [(0.6, None), (0.0004, "Crazyflie|no kind of flight file")])
def test_a_card_that_lost_power_is_read_as_far_as_it_goes(tmp_path, keep, words):
    raw = of_card(flown())
    path = tmp_path / "log01"
    path.write_bytes(raw[: int(keep * len(raw))])
    if words is None:
        assert any("checksum" in note for note in read_flight(path, QUAD5).notes)
        return
    with pytest.raises(InputError, match=words) as error:
        read_flight(path, QUAD5)
    assert "\n" not in str(error.value)


def test_foreign_files_that_begin_alike_are_told(tmp_path):
    path = tmp_path / "log02"
    path.write_bytes(b"\xbc\x02\x00\xff\xff" + bytes(200))
    with pytest.raises(InputError, match="log02"):
        read_usd_log(path)


@pytest.mark.parametrize("raw", [False, True])
def test_blackbox_decode_makes_a_flight_of_accelerometer_and_motors(tmp_path, raw):
    one = flown()
    unit, scale = ("", 2048 / GRAVITY) if raw else (" (m/s2)", 1.0)
    names = ["loopIteration", "time (us)", *(f"gyroADC[{i}] (deg/s)" for i in range(3)),
             *(f"accSmooth[{i}]{unit}" for i in range(3)),
             *(f"motor[{i}]" for i in range(4)), "vbatLatest (V)", "flightModeFlags (flags)"]  # fmt: skip
    lines = [", ".join(names)]
    for i, t in enumerate(one.t):
        numbers = [i, round(1e6 * t), *np.degrees(one.angular_velocity[i]), *(one.specific_force[i] * scale),
                   *[round(48 + 1999 * one.thrust[i])] * 4, one.voltage[i]]  # fmt: skip
        lines.append(", ".join(f"{n:.10g}" for n in numbers) + ", ANGLE_MODE")
    path = tmp_path / "LOG00001.01.csv"
    path.write_text("\n".join(lines) + "\n")
    flight = read_flight(path, QUAD5)
    rows, there = middle_of(flight, one)
    np.testing.assert_allclose(flight.thrust_command[rows], one.thrust[there], atol=1e-3)
    np.testing.assert_allclose(flight.specific_force[rows], one.specific_force[there], rtol=0.05, atol=0.05)
    np.testing.assert_allclose(flight.angular_velocity[rows], one.angular_velocity[there], atol=1e-3)
    assert not flight.has("position")


def test_a_blackbox_as_it_comes_from_the_converter(tmp_path):
    """Flags in words beside a 0, motors at 0 until it is armed, DShot below all pulses, and no accelerometer."""
    one = flown()
    names = ["loopIteration", "time (us)", *(f"gyroADC[{i}] (deg/s)" for i in range(3)),
             *(f"accSmooth[{i}] (g)" for i in range(3)), *(f"motor[{i}]" for i in range(4)),
             "flightModeFlags (flags)", " stateFlags (flags)"]  # fmt: skip

    def lines(force):
        yield ", ".join(names)
        for i, t in enumerate(one.t):
            motor = 0 if one.thrust[i] == 0 else round(48 + 1999 * one.thrust[i])
            numbers = [i, round(1e6 * t), *np.degrees(one.angular_velocity[i]), *force[i], *[motor] * 4]
            flags = "GPS_FIX|GPS_FIX_HOME" if i % 3 == 0 else "0"
            yield (
                ", ".join(f"{n:.10g}" if np.isfinite(n) else "-nan" for n in numbers)
                + f", ANGLE_MODE, {flags}"
            )

    path = tmp_path / "LOG00002.01.csv"
    path.write_text("\n".join(lines(one.specific_force / GRAVITY)) + "\n")
    flight = read_flight(path, QUAD5)
    rows, there = middle_of(flight, one)
    np.testing.assert_allclose(flight.thrust_command[rows], one.thrust[there], atol=1e-3)
    path.write_text("\n".join(lines(np.full_like(one.specific_force, np.nan))) + "\n")
    with pytest.raises(InputError, match="neither an accelerometer"):
        read_flight(path, QUAD5)


def test_a_blackbox_that_was_not_converted_is_told_how(tmp_path):
    path = tmp_path / "LOG00001.BFL"
    path.write_bytes(b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n")
    with pytest.raises(InputError, match="blackbox_decode") as error:
        read_flight(path, QUAD5)
    assert "\n" not in str(error.value)


def test_a_number_of_a_damaged_card_that_is_none_is_no_warning(tmp_path, recwarn):
    """A signalling NaN, which numpy warns of where it widens it."""
    t = 0.01 * np.arange(50)
    data = usd({"fixedFrequency": (t, {"acc.z": ("f", np.where(t == t[7], 3.0, 1.0))})})
    path = tmp_path / "log00"
    path.write_bytes(data.replace(struct.pack("<f", 3.0), struct.pack("<I", 0x7FA00000)))
    assert np.isnan(read_usd_log(path).columns["acc.z"][7])
    assert not recwarn.list
