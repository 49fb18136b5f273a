"""PX4 ULogs and the companion's own records, whole and cut: they agree with physics, or say why not."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from trueflight.groundstation.reading import read_flight, segments
from trueflight.models.errors import InputError
from trueflight.models.frames import rotate, rotate_inverse
from trueflight.models.record_pb2 import Tick
from trueflight.models.vehicle import GRAVITY, load_vehicle

ROOT = Path(__file__).parents[2]
ULOG = ROOT / "samples" / "px4" / "sih_lemniscate.ulg"
QUAD5 = ROOT / "models" / "vehicles" / "quad5" / "vehicle.toml"
BIN = Path(sys.executable).parent


@pytest.fixture(scope="module")
def ulog():
    return read_flight(ULOG)


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    path = tmp_path_factory.mktemp("record") / "flight.mcap"
    arguments = [
        "--trajectory",
        "circle",
        "--vehicle",
        QUAD5,
        "--hidden",
        "rotor_drag:0.5",
        "--seed",
        "2",
        "-o",
        path,
    ]
    subprocess.run([BIN / "sim-bridge", "fly", *arguments], check=True, capture_output=True)
    return path


def agreement(flight):
    """Correlation per world axis of velocity gained over 0.2 s with what accelerometer and attitude say."""
    ahead = round(0.2 / flight.dt)
    gained = (flight.velocity[ahead:] - flight.velocity[:-ahead]) / (ahead * flight.dt)
    world = rotate(flight.quaternion, flight.specific_force) - [0.0, 0.0, GRAVITY]
    felt = np.stack([np.convolve(axis, np.ones(ahead) / ahead, "valid") for axis in world.T], -1)[
        : len(gained)
    ]
    air = flight.flying[ahead:] & flight.flying[:-ahead]
    return [np.corrcoef(gained[air, k], felt[air, k])[0, 1] for k in range(3)]


def drag(flight):
    """Linear drag per mass along body x and y, 1/s."""
    speed = rotate_inverse(flight.quaternion, flight.velocity)[flight.flying]
    force = flight.specific_force[flight.flying]
    return [-np.sum(speed[:, k] * force[:, k]) / np.sum(speed[:, k] ** 2) for k in (0, 1)]


def test_a_ulog_is_enu_and_flu_on_an_even_clock(ulog):
    assert ulog.dt == pytest.approx(0.01, rel=1e-9)
    assert len(segments(ulog.t)) == 1
    assert ulog.specific_force[ulog.flying, 2].mean() == pytest.approx(GRAVITY, rel=0.08)
    assert min(agreement(ulog)) > 0.97
    np.testing.assert_allclose(np.linalg.norm(ulog.quaternion, axis=1), 1.0, atol=1e-12)
    assert 0.4 < ulog.thrust_command[ulog.flying].mean() < 0.8
    assert ulog.battery_voltage.mean() > 10.0


def test_a_ulog_flies_between_takeoff_and_its_end(ulog):
    air = ulog.t[ulog.flying]
    assert ulog.position[ulog.flying, 2].min() > 0.05
    assert 5.0 < air[0] < 7.0 and air[-1] == ulog.t[-1]
    assert any("ends while armed" in note for note in ulog.notes)
    assert any("50 Hz" in note for note in ulog.notes)
    assert any("heights are above the ground at takeoff" in note for note in ulog.notes)


def test_a_ulog_shows_the_simulators_own_mass_and_drag(ulog):
    """SIH flew 1.2 kg with 0.15 N/(m/s) of drag (its parameters in the log); the vehicle file says 1.0 kg."""
    assert np.mean(drag(ulog)) == pytest.approx(0.15 / 1.2, rel=0.2)
    believed = ulog.vehicle.thrust(ulog.thrust_command)[ulog.flying] / ulog.vehicle.mass
    felt = ulog.specific_force[ulog.flying, 2]
    assert np.sum(felt * believed) / np.sum(believed**2) == pytest.approx(1.0 / 1.2, rel=0.02)


def test_body_rates_of_a_ulog_turn_the_attitude(ulog):
    from trueflight.groundstation.reading.plausible import body_rate

    rows = np.flatnonzero(ulog.flying)[:-5]
    turned = body_rate(ulog.quaternion[rows], ulog.quaternion[rows + 4], 0.04)
    felt = ulog.angular_velocity[rows + 2]
    for axis in range(3):
        if np.std(felt[:, axis]) > 0.1:
            assert np.corrcoef(turned[:, axis], felt[:, axis])[0, 1] > 0.9
    followed = [np.corrcoef(ulog.body_rate_command[rows, k], felt[:, k])[0, 1] for k in (0, 1)]
    assert min(followed) > 0.7


def test_a_record_is_read_with_its_own_vehicle_and_only_what_was_commanded_flies(record):
    flight = read_flight(record)
    assert flight.vehicle == load_vehicle(QUAD5)
    assert flight.accelerometer and flight.has(
        "position_reference", "velocity_reference", "body_rate_command"
    )
    assert np.all(flight.extra["commanded"][flight.flying] > 0.5)
    assert flight.position[flight.flying, 2].min() > 0.05
    assert min(agreement(flight)) > 0.9
    assert np.mean(drag(flight)) == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize("share", [0.95, 0.7, 0.5])
def test_a_record_cut_by_a_power_failure_keeps_what_was_written(record, share, tmp_path):
    whole = read_flight(record)
    content = record.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(content[: int(share * len(content))])
    cut = read_flight(path)
    assert any("not whole" in note for note in cut.notes)
    assert 0.6 * share * len(whole) < len(cut) < len(whole)
    same = slice(0, len(cut) - 1)
    np.testing.assert_allclose(cut.position[same], whole.position[same], atol=1e-9)


def test_a_record_in_which_nothing_flew_is_told(record, tmp_path):
    content = record.read_bytes()
    path = tmp_path / "start.mcap"
    path.write_bytes(content[:40_000])
    with pytest.raises(InputError, match=r"start\.mcap.*(in the air|never flew)"):
        read_flight(path)


def with_foreign_ticks(record, path, every):
    """The record with a tick of another component after each `every`, stamped by a clock that counts since 1970."""
    with record.open("rb") as stream, path.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out)
        writer.start()
        schemas, channels = {}, {}
        for number, (schema, channel, message) in enumerate(reader.iter_messages(log_time_order=False)):
            if channel.id not in channels:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            told = (
                channels[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
            writer.add_message(*told)
            if channel.topic == "/tick" and number % every == 0:
                tick = Tick.FromString(message.data)
                tick.vehicle_time_us += 1_795_708_709_000_000
                tick.position.x += 5.0
                writer.add_message(told[0], told[1], tick.SerializeToString(), told[3], told[4])
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time,
                attachment.log_time,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )
        writer.finish()
    return path


def test_ticks_that_count_another_clock_are_read_around(record, tmp_path):
    whole = read_flight(record)
    flight = read_flight(with_foreign_ticks(record, tmp_path / "mixed.mcap", 7))
    assert any("count another clock" in note for note in flight.notes)
    assert len(flight) == len(whole)
    np.testing.assert_allclose(flight.position, whole.position, atol=1e-9)
    with pytest.raises(InputError, match="several clocks"):
        read_flight(with_foreign_ticks(record, tmp_path / "half.mcap", 1))
