"""Flights from tables: the project's own columns, foreign ones through a mapping, gaps, ground and air."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.groundstation.reading import read_flight, segments
from trueflight.groundstation.reading.mapping import UNITS
from trueflight.groundstation.reading.writing import own_table, write_flight
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS
from trueflight.models.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd, rotate, rotate_inverse
from trueflight.models.vehicle import GRAVITY, load_vehicle

SAMPLES = Path(__file__).parents[2] / "samples"
DRAG = SAMPLES / "rotorpy" / "rotor_drag"
CRAZYFLIE = SAMPLES / "crazyflie"
BIN = Path(sys.executable).parent


@pytest.fixture(scope="module")
def flight():
    return read_flight(DRAG / "identify.parquet").part(slice(0, 1500))


def write(path: Path, columns: dict[str, np.ndarray]) -> Path:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    return path


def test_a_written_flight_reads_back_the_same(flight, tmp_path):
    for name in ("flight.csv", "flight.parquet"):
        path = tmp_path / name
        write_flight(flight, path)
        again = read_flight(path)
        assert again.vehicle == flight.vehicle
        assert again.notes == ()
        for column in COLUMNS:
            if flight.has(column):
                np.testing.assert_allclose(
                    getattr(again, column), getattr(flight, column), rtol=1e-7, atol=1e-7
                )
        np.testing.assert_array_equal(again.flying, flight.flying)
    assert not list(tmp_path.glob(".*"))


def test_an_identical_file_has_an_identical_hash_and_another_one_has_not(flight, tmp_path):
    a, b, c = tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "c.csv"
    write_flight(flight, a)
    write_flight(flight, b)
    write_flight(flight.part(slice(0, 1400)), c)
    hashes = [read_flight(path).data_hash for path in (a, b, c)]
    assert hashes[0] == hashes[1] != hashes[2]
    assert len(hashes[0]) == 64


@pytest.mark.parametrize(
    ("name", "mass", "gain", "accelerometer"),
    [
        # Masses and thrust gains as published with the logs: motors stronger than the controller was told.
        ("crazyswarm2_log08.csv", 0.0333, 1.44, False),
        ("crazyswarm2_log44.csv", 0.0375, 1.52, False),
        ("crazyswarm2_log201.csv", 0.0369, 0.0369 / 0.0406, True),
    ],
)
def test_real_crazyflie_logs_say_what_is_known_of_them(name, mass, gain, accelerometer):
    flight = read_flight(CRAZYFLIE / name)
    assert flight.vehicle.mass == mass
    assert flight.accelerometer is accelerometer
    np.testing.assert_allclose(np.linalg.norm(flight.quaternion, axis=1), 1.0, atol=1e-9)
    commanded = flight.vehicle.thrust(flight.thrust_command)[flight.flying].mean() / mass
    # Level on average and neither climbing nor sinking: the thrust carries the weight.
    up = rotate(flight.quaternion, np.array([0.0, 0.0, 1.0]))[flight.flying, 2].mean()
    assert commanded * gain * up == pytest.approx(GRAVITY, rel=0.02)


def test_a_mapping_turns_xyzw_and_newtons():
    flight = read_flight(CRAZYFLIE / "crazyswarm2_log08.csv")
    assert abs(flight.quaternion[0, 0]) > 0.99
    # 0.2270701 N at mass 0.0333 kg, as the first row of the log says.
    newtons = flight.vehicle.thrust(flight.thrust_command[:1])[0]
    assert newtons == pytest.approx(0.2270701, rel=1e-6)


def test_a_log_of_motor_commands_and_accelerometer_alone_is_a_flight():
    flight = read_flight(CRAZYFLIE / "ddsysid_crazyflie_log10_500Hz.parquet")
    assert flight.has("specific_force", "angular_velocity", "thrust_command", "motor_command")
    assert not flight.has("quaternion") and not flight.has("position")
    assert flight.specific_force[flight.flying, 2].mean() == pytest.approx(GRAVITY, rel=0.03)
    # It crashes at the end and lies on its back: neither counts as flying.
    assert flight.t[flight.flying].max() < 43.0 < flight.t[-1] - 5.0
    assert np.abs(flight.specific_force[flight.flying]).max() < 40.0


def test_what_stands_on_the_ground_between_two_hops_is_left_out():
    flight = read_flight(CRAZYFLIE / "crazypad_normal_E9_log03.csv")
    resting = (flight.t > 12.0) & (flight.t < 16.0)
    hovering = ((flight.t > 5.0) & (flight.t < 11.0)) | ((flight.t > 19.0) & (flight.t < 25.0))
    assert not np.any(flight.flying[resting])
    assert np.all(flight.flying[hovering])
    assert flight.position[flight.flying, 2].min() > 0.05
    assert any("pitch is not logged" in note for note in flight.notes)
    assert any("gap" in note for note in flight.notes)


def test_pitch_from_acceleration_puts_the_whole_thrust_on_z():
    flight = read_flight(CRAZYFLIE / "crazypad_normal_E9_log03.csv")
    world = rotate(flight.quaternion, flight.specific_force) - [0.0, 0.0, GRAVITY]
    speed = flight.velocity
    ahead = round(0.2 / flight.dt)
    gained = (speed[ahead:] - speed[:-ahead]) / (ahead * flight.dt)
    felt = np.stack([np.convolve(axis, np.ones(ahead) / ahead, "valid") for axis in world.T], -1)[
        : len(gained)
    ]
    inside = flight.flying[ahead:] & flight.flying[:-ahead]
    assert np.corrcoef(gained[inside, 2], felt[inside, 2])[0, 1] > 0.9
    assert np.abs(flight.specific_force[flight.flying, 0]).max() < 1e-9


def test_a_ned_frd_log_with_degrees_g_and_milliseconds_is_the_same_flight(flight, tmp_path):
    q = enu_flu_from_ned_frd(flight.quaternion)
    frd = {"rates": flu_from_frd(flight.angular_velocity), "acc": flu_from_frd(flight.specific_force)}
    ned = {"pos": enu_from_ned(flight.position), "vel": enu_from_ned(flight.velocity)}
    columns = {"time": 1e3 * flight.t}
    for i, axis in enumerate("xyz"):
        columns |= {f"p{axis}": 1e3 * ned["pos"][:, i], f"v{axis}": ned["vel"][:, i]}
        columns |= {f"w{axis}": np.degrees(frd["rates"][:, i]), f"a{axis}": frd["acc"][:, i] / GRAVITY}
    columns |= {f"q{axis}": q[:, i] for axis, i in zip("xyzw", (1, 2, 3, 0), strict=True)}
    columns |= {"thr": -65535 * flight.thrust_command, "mv": 1e3 * flight.battery_voltage}
    path = write(tmp_path / "log.csv", columns)
    (tmp_path / "mapping.toml").write_text(
        'frame = "ned_frd"\n'
        '[time]\ncolumn = "time"\nunit = "ms"\n'
        '[position]\ncolumns = ["px", "py", "pz"]\nunit = "mm"\n'
        '[velocity]\ncolumns = ["vx", "vy", "vz"]\n'
        '[angular_velocity]\ncolumns = ["wx", "wy", "wz"]\nunit = "deg/s"\n'
        '[specific_force]\ncolumns = ["ax", "ay", "az"]\nunit = "g"\n'
        '[quaternion]\ncolumns = ["qx", "qy", "qz", "qw"]\norder = "xyzw"\n'
        '[thrust_command]\ncolumn = "thr"\nunit = "u16"\nsign = -1\n'
        '[battery_voltage]\ncolumn = "mv"\nunit = "mV"\n'
    )
    mapped = read_flight(path, flight.vehicle)
    for name in (
        "position",
        "velocity",
        "angular_velocity",
        "specific_force",
        "thrust_command",
        "battery_voltage",
    ):
        np.testing.assert_allclose(getattr(mapped, name), getattr(flight, name), atol=2e-6)
    same = np.abs(np.sum(mapped.quaternion * flight.quaternion, axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-9)


@given(
    value=st.floats(-3.0, 3.0), unit=st.sampled_from([(k, u) for k, units in UNITS.items() for u in units])
)
def test_every_unit_is_undone_by_its_own_scale(value, unit):
    kind, name = unit
    factor, offset = UNITS[kind][name]
    written = value / factor + offset
    assert factor * (written - offset) == pytest.approx(value, abs=1e-9)


def test_roll_pitch_yaw_columns_are_an_attitude(flight, tmp_path):
    from trueflight.models.frames import euler_from_quaternion

    roll, pitch, yaw = np.degrees(euler_from_quaternion(flight.quaternion)).T
    columns = own_table(flight)
    columns = {k: v for k, v in columns.items() if not k.startswith(("quaternion", "flying"))}
    path = write(tmp_path / "log.csv", {**columns, "roll": roll, "pitch": -pitch, "yaw": yaw})
    names = {k: list(n) for k, (n, _, _) in COLUMNS.items() if flight.has(k) and k != "quaternion"}
    lines = ['[time]\ncolumn = "t"']
    lines += [
        f"[{k}]\n" + (f'column = "{n[0]}"' if len(n) == 1 else f"columns = {json.dumps(n)}")
        for k, n in names.items()
    ]
    lines += ['[attitude]\nroll = "roll"\npitch = "pitch"\nyaw = "yaw"\nunit = "deg"\nsign = [1, -1, 1]']
    mapping = tmp_path / "my.toml"
    mapping.write_text("\n".join(lines))
    mapped = read_flight(path, flight.vehicle, mapping)
    same = np.abs(np.sum(mapped.quaternion * flight.quaternion, axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-9)


def test_a_gap_splits_and_is_not_bridged(flight, tmp_path):
    keep = np.ones(len(flight), bool)
    keep[600:640] = False
    path = tmp_path / "gap.csv"
    write_flight(flight.part(keep), path)
    cut = read_flight(path)
    assert [s.stop - s.start for s in segments(cut.t)] == [600, 860]
    assert any("1 gap in the log, the longest 0.41 s at t = 5.99 s" in note for note in cut.notes)


@settings(max_examples=15, deadline=None)
@given(lost=st.sets(st.integers(10, 1400), min_size=1, max_size=60))
def test_lost_single_samples_are_interpolated_onto_an_even_clock(flight, lost, tmp_path_factory):
    keep = np.ones(len(flight), bool)
    keep[[i for i in lost if i - 1 not in lost and i + 1 not in lost]] = False
    path = tmp_path_factory.mktemp("lost") / "lost.csv"
    write_flight(flight.part(keep), path)
    again = read_flight(path)
    assert len(segments(again.t)) == 1
    np.testing.assert_allclose(np.diff(again.t), flight.dt, rtol=1e-6)
    # A single lost position is where its neighbours say, to the sensor's noise.
    at = np.round((again.t - flight.t[0]) / flight.dt).astype(int)
    assert np.abs(again.position - flight.position[at]).max() < 0.25


def test_a_log_that_was_cut_in_its_last_line_loses_only_that(flight, tmp_path):
    path = tmp_path / "cut.csv"
    write_flight(flight, path)
    text = path.read_text()
    path.write_text(text[: text.rstrip().rfind("\n") + 30])
    cut = read_flight(path)
    assert len(cut) == len(flight) - 1
    assert any("last line is cut short" in note for note in cut.notes)


def test_low_rate_columns_hold_their_last_value(flight, tmp_path):
    columns = own_table(flight)
    sparse = columns["battery_voltage"].copy()
    sparse[np.arange(len(sparse)) % 50 != 0] = np.nan
    path = write(tmp_path / "sparse.csv", {**columns, "battery_voltage": sparse})
    read = read_flight(path, flight.vehicle)
    np.testing.assert_allclose(read.battery_voltage[:50], columns["battery_voltage"][0])
    assert any("battery voltage: the last value is held" in note for note in read.notes)


def test_takeoff_and_landing_are_cut_by_height(flight, tmp_path):
    n = 1200
    t = 0.01 * np.arange(n)
    height = np.clip(np.minimum((t - 3.0) * 0.5, (11.0 - t) * 0.5), 0.0, 1.2)
    height[t > 11.0] = 0.0
    # Thrust comes on a second before it lifts, and goes off half a second after touching down.
    thrust = np.where((t > 2.0) & (t < 11.5), flight.vehicle.hover_thrust, 0.0)
    still = np.zeros(n)
    columns = {"t": t, "position_x": still, "position_y": still, "position_z": 7.0 + height}
    columns |= {f"velocity_{a}": still for a in "xy"} | {"velocity_z": np.gradient(height, t)}
    columns |= {f"specific_force_{a}": still for a in "xy"}
    columns |= {"specific_force_z": still + GRAVITY, "thrust_command": thrust}
    flown = read_flight(write(tmp_path / "hop.csv", columns), flight.vehicle)
    air = flown.t[flown.flying]
    assert air[0] == pytest.approx(3.2, abs=0.03)
    assert air[-1] == pytest.approx(10.8, abs=0.03)


def test_import_writes_our_format_and_flights_lists_it(tmp_path):
    out = tmp_path / "log08.csv"
    source = CRAZYFLIE / "crazyswarm2_log08.csv"
    told = subprocess.run(
        [BIN / "groundstation", "import", source, "-o", out, "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    answer = json.loads(told.stdout)
    assert answer["columns"][:2] == ["t", "position_x"]
    assert load_vehicle(answer["vehicle"]).mass == 0.0333
    listed = subprocess.run(
        [BIN / "groundstation", "flights", tmp_path, "--json"], capture_output=True, text=True, check=True
    )
    (row,) = json.loads(listed.stdout)
    assert row["flight"] == "log08.csv" and row["error"] == ""
    assert row["measured"] == ["position", "attitude", "gyroscope"]
    assert row["duration"] == pytest.approx(11.65, abs=0.01)


def test_the_vehicle_of_the_longest_matching_name_is_taken(flight, tmp_path):
    path = tmp_path / "log_7.csv"
    write_flight(flight, path)
    for name, mass in (("log.vehicle.toml", 1.1), ("log_7.vehicle.toml", 1.2), ("other.vehicle.toml", 1.3)):
        text = (DRAG / "vehicle.toml").read_text().replace("mass = 0.9", f"mass = {mass}")
        (tmp_path / name).write_text(text)
    assert read_flight(path).vehicle.mass == 1.2
    assert read_flight(path, replace(flight.vehicle, mass=0.5)).vehicle.mass == 0.5


def test_gravity_stays_in_the_specific_force_of_a_world_acceleration():
    flight = read_flight(CRAZYFLIE / "crazypad_cut_M3_3mm_E9_log00.csv")
    level = rotate_inverse(flight.quaternion, np.array([0.0, 0.0, GRAVITY]))
    resting = (flight.t > 13.0) & (flight.t < 15.0)
    assert np.abs(flight.specific_force[resting] - level[resting]).max() < 0.3


def jittered(t):
    return t + np.random.default_rng(1).uniform(-0.003, 0.003, len(t))


@pytest.mark.parametrize(
    ("every", "clock", "rate"),
    [
        (4, lambda t: t, 25),
        (1, jittered, 100),
        (1, lambda t: t + 1.78e9, 100),
        (4, lambda t: jittered(t) + 1.78e9, 25),
    ],
    ids=["25 Hz", "jitter", "since 1970", "all of it"],
)
def test_slow_uneven_and_epoch_clocks_make_the_same_flight(flight, every, clock, rate, tmp_path):
    t = clock(flight.t)
    columns = own_table(flight) | {"t": t}
    for name in columns.keys() - {"t", "flying"}:  # what was measured at the uneven times
        columns[name] = np.interp(t - t[0] + flight.t[0], flight.t, columns[name])
    path = tmp_path / "flight.csv"
    table = np.column_stack(list(columns.values()))[::every]
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.6f")
    again = read_flight(path, flight.vehicle)
    assert 1 / again.dt == pytest.approx(rate, rel=0.05)
    assert not {c.verdict for c in again.consistency} & {"weak", "contradicts", "undone"}
    at = again.t - again.t[0] + flight.t[0]
    for name, tolerance in (("position", 0.03), ("velocity", 0.1)):
        wanted = np.stack([np.interp(at, flight.t, c) for c in getattr(flight, name).T], -1)
        assert np.abs(getattr(again, name) - wanted).max() < tolerance, name


def test_a_table_in_which_the_logger_began_again_is_refused(flight, tmp_path):
    columns = own_table(flight.part(slice(0, 1000)))
    twice = {name: np.concatenate([column, column]) for name, column in columns.items()}
    with pytest.raises(InputError, match="split the file where the logger started again"):
        read_flight(write(tmp_path / "flight.csv", twice), flight.vehicle)
