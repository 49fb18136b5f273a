"""Rerun recordings: whole, verified, and drawn where there is a renderer."""

import os
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from trueflight.groundstation.evaluate.compare import compare, waterfall
from trueflight.groundstation.evaluate.error_over_time import rolling_rms
from trueflight.groundstation.evaluate.tracking import Tracking
from trueflight.groundstation.evaluate.where import where_it_fails
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.results import WhereItFails
from trueflight.groundstation.versions.store import add_effect
from trueflight.groundstation.views import write_before_after, write_comparison, write_tracking, write_where
from trueflight.groundstation.views.colour import of_error
from trueflight.groundstation.views.monitor import Monitor, state
from trueflight.groundstation.views.picture import draw
from trueflight.groundstation.views.recording import readable, recording
from trueflight.models.errors import InputError
from trueflight.models.model import linear_model, rigid_body_model
from trueflight.models.record_pb2 import Event, Tick

SAMPLES = Path(__file__).parents[2] / "samples"
RERUN = Path(sys.executable).parent / "rerun"


@pytest.fixture(scope="module")
def flights():
    drag = SAMPLES / "rotorpy" / "rotor_drag"
    return read_flight(drag / "identify.parquet"), read_flight(drag / "validate.parquet")


@pytest.fixture(scope="module")
def versions(flights):
    fitted, _ = flights
    base = rigid_body_model(fitted.vehicle)
    made = add_effect(base, "rotor_drag", [fitted])
    return [linear_model(fitted.vehicle), replace(base, version=1), replace(made, version=2)]


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """A home of its own, with Rerun's analytics off."""
    home = tmp_path_factory.mktemp("home")
    own = {**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": str(home), "XDG_DATA_HOME": str(home)}
    subprocess.run([RERUN, "analytics", "disable"], env=own, check=True, capture_output=True)
    return own


def a_tracking(flight):
    part = flight.part(slice(0, 1000))
    expected = part.position_reference
    miss = tuple(float(x) for x in np.mean((part.position - expected) ** 2, axis=0))
    zeta = np.zeros((1000, 3))
    return Tracking(
        part, "lemniscate lqr", part.t, part.position, expected, expected, zeta, zeta, miss, (0.0, 0.0, 0.0)
    )


def write_all(folder, flights, versions):
    fitted, held_out = flights
    comparisons = [compare(fitted, model) for model in versions]
    write_comparison(folder / "comparison.rrd", comparisons, where_it_fails(comparisons[0]))
    write_where(folder / "where.rrd", comparisons[1], where_it_fails(comparisons[1]))
    first, last = (compare(held_out, model, horizons=False) for model in (versions[0], versions[-1]))
    write_before_after(folder / "before_after.rrd", first, last, waterfall(fitted, held_out, versions))
    write_tracking(folder / "tracking.rrd", [a_tracking(fitted), a_tracking(held_out)])
    with_monitor(folder / "monitor.rrd", fitted)


def with_monitor(path, flight):
    stream = rr.RecordingStream("trueflight monitor")
    stream.save(path)
    view = Monitor(stream, flight.vehicle.name)
    view.add_ticks([a_tick(flight, k) for k in range(0, 2000, 5)])
    view.add_event(
        Event(vehicle_time_us=3_000_000, level="warning", kind="guard_trip", text="left the envelope")
    )
    view.tell()
    stream.flush()
    stream.disconnect()


def a_tick(flight, k):
    tick = Tick(
        vehicle_time_us=round(1e6 * flight.t[k]),
        phase="mission",
        flight_mode="OFFBOARD",
        armed=True,
        controller="corrected",
        guard="active",
        model="0123456789ab",
        trajectory="lemniscate",
        thrust_command=flight.thrust_command[k],
        battery_voltage=flight.battery_voltage[k],
        latency=0.0009,
    )
    for name in ("position", "velocity", "position_reference"):
        vector = getattr(tick, name)
        vector.x, vector.y, vector.z = getattr(flight, name)[k]
    q = tick.quaternion
    q.w, q.x, q.y, q.z = flight.quaternion[k]
    return tick


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, flights, versions):
    folder = tmp_path_factory.mktemp("recordings")
    write_all(folder, flights, versions)
    return folder


NAMES = ("comparison", "where", "before_after", "tracking", "monitor")


def test_every_recording_is_whole_and_small(recordings, environment):
    files = [recordings / f"{name}.rrd" for name in NAMES]
    told = subprocess.run([RERUN, "rrd", "verify", *files], env=environment, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    assert sorted(p.name for p in recordings.iterdir()) == sorted(f.name for f in files)
    for file in files:
        assert 10_000 < file.stat().st_size < 3_000_000


def pixels(path):
    """Rows of a PNG of 8 bits a channel, as (height, width, channels); filters undone."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    place, body = 8, b""
    while place < len(data):
        size, kind = struct.unpack(">I4s", data[place : place + 8])
        content = data[place + 8 : place + 8 + size]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", content[:10])
            assert depth == 8 and colour in (2, 6)
        elif kind == b"IDAT":
            body += content
        place += 12 + size
    channels = 3 if colour == 2 else 4
    raw = np.frombuffer(zlib.decompress(body), np.uint8).reshape(height, 1 + width * channels)
    out = np.zeros((height, width, channels), np.uint8)
    above = np.zeros((width, channels), np.int64)
    for row in range(height):
        line = raw[row, 1:].reshape(width, channels).astype(np.int64)
        kind = int(raw[row, 0])
        if kind == 2:
            line = line + above
        elif kind != 0:
            left, corner = np.zeros(channels, np.int64), np.zeros(channels, np.int64)
            for column in range(width):
                up = above[column]
                if kind == 1:
                    guess = left
                elif kind == 3:
                    guess = (left + up) // 2
                else:
                    p = left + up - corner
                    a, b, c = np.abs(p - left), np.abs(p - up), np.abs(p - corner)
                    guess = np.where((a <= b) & (a <= c), left, np.where(b <= c, up, corner))
                line[column] = (line[column] + guess) % 256
                left, corner = line[column], up
        above = line % 256
        out[row] = above
    return out


def test_where_it_fails_is_drawn_in_the_colours_of_the_error(recordings, tmp_path):
    """The renderer draws the path: its picture holds colours of the error's scale that no part of the frame
    has."""
    picture = tmp_path / "where.png"
    try:
        draw(recordings / "where.rrd", picture, str(RERUN), (480, 270))
    except InputError as error:
        pytest.skip(str(error))
    scale = of_error(np.linspace(0.0, 1.0, 64), 1.0).astype(int)
    seen = pixels(picture)[..., :3].reshape(-1, 3).astype(int)
    near = [bool(np.any(np.abs(seen - colour).sum(axis=1) < 40)) for colour in scale[::8]]
    assert sum(near) >= 4


def test_a_machine_that_cannot_draw_says_so_and_keeps_the_recording(recordings, tmp_path, monkeypatch):
    for name in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES", "LIBGL_DRIVERS_PATH", "__EGL_VENDOR_LIBRARY_DIRS"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    with pytest.raises(InputError, match=r"where.rrd is written, but this machine cannot draw"):
        draw(recordings / "where.rrd", tmp_path / "where.png", str(RERUN))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("low", "high", "height"),
    [(-6.7, 6.7, 230.0), (0.0, 17.0, 270.0), (0.0, 0.18, 110.0), (-12.0, 5.0, 105.0)],
)
def test_an_axis_has_three_labels(low, high, height):
    """Rerun has labels at multiples of a power of ten, where these are far enough apart."""
    bottom, top = readable(low, high, height)
    assert bottom <= low and top >= high
    step = 10.0 ** np.ceil(np.log10((top - bottom) * 25.0 / height))
    assert np.floor(top / step) - np.ceil(bottom / step) >= 2


def test_a_recording_that_cannot_be_written_is_told(flights, versions):
    comparison = compare(flights[1], versions[1], horizons=False)
    with pytest.raises(InputError, match=r"cannot write the recording.*choose another --save"):
        write_where(Path("/proc/none/where.rrd"), comparison, where_it_fails(comparison))


@pytest.mark.parametrize(
    "name", ["20261126-152733.123_log: v1 + rotor_drag", "Flüge/1, 2", "x" * 300, "plain-name_1: v1 [a]"]
)
def test_rerun_takes_the_name_of_a_recording_as_it_is(name, tmp_path, capfd):
    told = set()
    for other in (name, name + "+", name + ","):
        with recording(tmp_path / "a.rrd", "waterfall", other) as stream:
            told.add(stream.get_application_id())
    assert len(told) == 3  # or one would be shown with the blueprint of another
    assert capfd.readouterr().err == ""


def test_a_recording_that_fails_halfway_leaves_nothing(tmp_path, flights, versions):
    comparison = compare(flights[1], versions[1], horizons=False)
    broken = replace(comparison, residual=comparison.residual[:10])
    with pytest.raises(ValueError):
        write_where(tmp_path / "where.rrd", broken, WhereItFails((), (), ()))
    assert list(tmp_path.iterdir()) == []


def test_a_flight_without_position_or_attitude_has_views_too(tmp_path, environment):
    flight = read_flight(SAMPLES / "crazyflie" / "ddsysid_crazyflie_log10_500Hz.parquet")
    comparison = compare(flight, linear_model(flight.vehicle))
    where = where_it_fails(comparison)
    write_comparison(tmp_path / "comparison.rrd", [comparison], where)
    write_where(tmp_path / "where.rrd", comparison, where)
    for name in ("comparison", "where"):
        subprocess.run(
            [RERUN, "rrd", "verify", tmp_path / f"{name}.rrd"],
            env=environment,
            check=True,
            capture_output=True,
        )


def test_rolling_rms_is_that_of_its_window_and_says_nothing_where_little_counts():
    residual = np.full((500, 3), 2.0)
    used = np.ones(500, bool)
    np.testing.assert_allclose(rolling_rms(residual, used, 50), 2.0)
    used[200:300] = False
    rolled = rolling_rms(residual, used, 50)
    assert np.all(np.isnan(rolled[230:270])) and np.all(np.isfinite(rolled[:200]))


def test_colours_rise_in_lightness_with_the_error_and_missing_ones_are_grey():
    colours = of_error(np.array([*np.linspace(0.0, 1.0, 50), np.nan]), 1.0).astype(float)
    lightness = colours[:-1] @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(lightness) > -0.5) and lightness[-1] > 3 * lightness[0]
    assert len(set(colours[-1])) == 1


def test_the_pilots_page_says_what_flies_and_when_the_vehicle_falls_silent(flights):
    tick = a_tick(flights[0], 100)
    page = state("quad5", tick, 0.0)
    for word in (
        "quad5: mission",
        "**OFFBOARD**, armed",
        "**corrected**",
        "`0123456789ab`",
        "active",
        "0.9 ms",
    ):
        assert word in page
    tick.guard = "tripped: outside the training range of vx"
    assert "**tripped: outside the training range of vx**" in state("quad5", tick, 0.0)
    tick.shadow, tick.guard = "ba9876543210", "active, shadow"
    status = {
        "models": [{"hash": "0123456789ab", "name": "quad5", "version": "3"}],
        "last_good": "aaaaaaaaaaaa",
        "shadow": {"hash": "ba9876543210", "title": "ba9876543210 (quad5 4)", "remaining": 2.2},
    }
    page = state("quad5", tick, 0.0, status)
    for word in (
        "`0123456789ab` quad5 3",
        "`ba9876543210` quad5 4",
        "to go | 2 s",
        "last good | `aaaaaaaaaaaa`",
    ):
        assert word in page
    assert "SILENT for 7 s" in state("quad5", tick, 7.2)
    assert "No tick has arrived" in state("quad5", None, 0.0)
