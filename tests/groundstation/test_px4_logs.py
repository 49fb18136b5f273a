"""A flight is the same flight whichever release of PX4 logged it, and whichever topic told its thrust."""

import numpy as np
import px4_layouts
import pytest
from px4_layouts import BOOT, RELEASES, flown, log_of, middle_of, motors, still_later
from ulog_writer import Written

from trueflight.groundstation.reading import read_flight, segments
from trueflight.groundstation.reading.px4_log import load_ulog
from trueflight.groundstation.reading.writing import write_flight
from trueflight.groundstation.versions.vehicle_draft import draft_of
from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle

VEHICLE = Vehicle("quad5", mass=0.75, hover_thrust=0.38)
THRUST_TOPICS = (
    "vehicle_thrust_setpoint",
    "actuator_controls_0",
    "vehicle_rates_setpoint",
    "actuator_motors",
)


def read(log, tmp_path, vehicle=VEHICLE):
    return read_flight(log.save(tmp_path / "log.ulg"), vehicle)


def thrust_agrees(flight, tolerance):
    rows, same = middle_of(flight, flown())
    error = flight.thrust_command[rows] - flown().thrust[same]
    return np.sqrt(np.mean(error**2)) < tolerance * np.std(flown().thrust[same]) + 1e-6


@pytest.mark.parametrize("release", RELEASES)
def test_the_layout_of_every_release_is_read_to_the_same_flight(release, tmp_path):
    flight = read(log_of(release), tmp_path)
    rows, same = middle_of(flight, flown())
    assert len(rows) > 1000
    for name, tolerance in (
        ("position", 0.002),
        ("velocity", 0.01),
        ("specific_force", 0.15),
        ("angular_velocity", 0.05),
    ):
        error = getattr(flight, name)[rows] - getattr(flown(), name)[same]
        assert np.sqrt(np.mean(error**2)) < tolerance, name
    aligned = np.abs(np.sum(flight.quaternion[rows] * flown().quaternion[same], axis=1))
    assert aligned.min() > 1 - 1e-4
    assert thrust_agrees(flight, 0.25)
    np.testing.assert_allclose(flight.battery_voltage[rows], flown().voltage[same], atol=0.1)
    assert np.abs(flight.position_reference[rows] - flown().position[same]).max() < 0.15
    assert flight.flying[rows].all()
    assert any(f"PX4 {release}" in note for note in flight.notes)


def test_takeoff_landing_and_ground_are_left_out(tmp_path):
    flight = read(log_of("1.15"), tmp_path)
    assert flight.position[flight.flying, 2].min() > 0.09
    assert np.all(flight.t[flight.flying] > px4_layouts.GROUND)
    assert flight.t[-1] - flight.t[flight.flying][-1] > px4_layouts.GROUND


@pytest.mark.parametrize("gone", range(len(THRUST_TOPICS)))
def test_thrust_comes_from_what_is_there_and_the_flight_says_from_what(gone, tmp_path):
    log = log_of("1.13", leave_out=THRUST_TOPICS[:gone])
    flight = read(log, tmp_path)
    said = next(note for note in flight.notes if note.startswith("thrust is"))
    # Setpoints at 50 Hz tell more than controls at 20 Hz or motors at 10 Hz.
    expected = (
        "vehicle_thrust_setpoint",
        "vehicle_rates_setpoint",
        "vehicle_rates_setpoint",
        "actuator_motors",
    )
    assert expected[gone] in said
    assert thrust_agrees(flight, 0.25 if gone < 3 else 0.8)


def outputs(log, low, high, factor=0.0, channels=(0, 1, 2, 3), instance=0, rate=50.0):
    """Outputs of a driver: the motors' signals, through THR_MDL_FAC, in its range."""
    one = flown()
    rows = one.rows(rate)
    wanted = motors(one, rows)
    if factor:
        b = (1 - factor) / (2 * factor)
        signal = -b + np.sqrt(b**2 + wanted / factor)
    else:
        signal = wanted
    values = np.zeros((len(rows), 16))
    values[:, list(channels)] = np.where(one.armed[rows][:, None], low + signal * (high - low), 900.0)
    log.parameters["THR_MDL_FAC"] = factor
    log.add(
        "actuator_outputs", one.t[rows], instance, noutputs=("I", np.full(len(rows), 8)), output=("f", values)
    )
    return log


BARE = (*THRUST_TOPICS, "vehicle_attitude_setpoint")
PERMUTED = {f"PWM_MAIN_FUNC{channel + 1}": 101 + motor for motor, channel in enumerate((2, 0, 3, 1))}


@pytest.mark.parametrize(
    ("release", "parameters", "ends", "factor", "channels"),
    [
        ("1.11", {"PWM_MIN": 1075, "PWM_MAX": 1950}, (1075, 1950), 0.0, (0, 1, 2, 3)),
        ("1.12", {"PWM_MAIN_MIN": 1100, "PWM_MAIN_MAX": 1900, "PWM_MAIN_MIN2": -1}, (1100, 1900), 0.3, (0, 1, 2, 3)),
        (
            "1.15",
            {**PERMUTED, **{f"PWM_MAIN_{e}{c}": v for c in range(1, 5) for e, v in (("MIN", 1120), ("MAX", 1940))}},
            (1120, 1940),
            0.5,
            (2, 0, 3, 1),
        ),
        ("1.16", {**PERMUTED, "PWM_MAIN_TIM0": -4, "DSHOT_MIN": 0.055, "PWM_MAIN_MIN1": 1000, "PWM_MAIN_MAX1": 2000},
         (110, 1999), 0.0, (2, 0, 3, 1)),
        (
            "1.16",
            {f"UAVCAN_EC_{w}{c}": v for c in range(1, 5) for w, v in (("FUNC", 100 + c), ("MIN", 1), ("MAX", 8191))},
            (1, 8191),
            0.0,
            (0, 1, 2, 3),
        ),
    ],
    ids=["pwm of 1.11", "pwm of 1.12, bent", "pwm by function, bent", "dshot", "can"],
)  # fmt: skip
def test_outputs_are_turned_back_into_thrust(release, parameters, ends, factor, channels, tmp_path):
    log = log_of(release, leave_out=BARE)
    log.parameters |= parameters
    # A second driver whose outputs stand still is not the motors'.
    one = flown()
    log.add("actuator_outputs", one.t[::20], noutputs=("I", np.full(len(one.t[::20]), 8)),
            output=("f", np.full((len(one.t[::20]), 16), 1500.0)))  # fmt: skip
    flight = read(outputs(log, *ends, factor, channels, instance=1), tmp_path)
    assert any("actuator_outputs" in note and f"{ends[0]} to {ends[1]}" in note for note in flight.notes)
    assert thrust_agrees(flight, 0.3)
    rows, same = middle_of(flight, one)
    np.testing.assert_allclose(flight.motor_command[rows].mean(axis=1), one.thrust[same], atol=0.02)
    sent = one.rows(50)
    for motor, commands in enumerate(motors(one, sent).T):
        expected = np.interp(one.t[same], one.t[sent], commands)
        np.testing.assert_allclose(flight.motor_command[rows, motor], expected, atol=0.01)


def test_rotor_speeds_alone_tell_thrust_but_for_its_scale(tmp_path):
    one = flown()
    log = log_of("1.16", leave_out=BARE)
    rpm = (one.rotor_speed * 30 / np.pi).round().astype(int)
    rpm[500:505, 1] = 0  # reports that got lost
    order = (2, 0, 3, 1)
    escs = {}
    for slot, motor in enumerate(order):
        escs[f"esc[{slot}].esc_rpm"] = ("i", rpm[:, motor])
        escs[f"esc[{slot}].actuator_function"] = ("B", np.full(len(one.t), 101 + motor))
    log.add("esc_status", one.t, **escs)
    flight = read(log, tmp_path)
    assert any("scaled so that its median is hover_thrust" in note for note in flight.notes)
    rows, same = middle_of(flight, one)
    np.testing.assert_allclose(flight.rotor_speed[rows], one.rotor_speed[same], rtol=0.01)
    squared = np.mean(one.rotor_speed**2, axis=1)[same]
    assert np.corrcoef(flight.thrust_command[rows], squared)[0, 1] > 0.99


def test_the_battery_that_flies_is_read(tmp_path):
    log = log_of("1.15", leave_out=("battery_status",))
    one = flown()
    dead = np.full(len(one.t[::20]), 3.0)
    log.add(
        "battery_status", one.t[::20], 0, connected=("?", np.zeros(len(dead), bool)), voltage_v=("f", dead)
    )
    px4_layouts._battery(log, px4_layouts.replace(one, voltage=one.voltage - 4.0), (1, 15), 1, current=0.1)
    px4_layouts._battery(log, one, (1, 15), 2, current=20.0)
    flight = read(log, tmp_path)
    rows, same = middle_of(flight, one)
    np.testing.assert_allclose(flight.battery_voltage[rows], one.voltage[same], atol=0.1)


def test_a_command_older_than_the_batterys_scaling_is_scaled(tmp_path):
    log = log_of("1.12", leave_out=("battery_status", "actuator_controls_0"))
    log.parameters["MC_BAT_SCALE_EN"] = 1
    one = flown()
    rows = one.rows(5)
    log.add("battery_status", one.t[rows], connected=("?", np.ones(len(rows), bool)),
            voltage_v=("f", one.voltage[rows]), scale=("f", np.full(len(rows), 1.2)))  # fmt: skip
    flight = read(log, tmp_path)
    at, same = middle_of(flight, one)
    assert np.mean(flight.thrust_command[at] / one.thrust[same]) == pytest.approx(1.2, abs=0.01)
    assert any("MC_BAT_SCALE_EN" in note for note in flight.notes)


@pytest.mark.parametrize("release", ["1.12", "1.16"])
@pytest.mark.parametrize("body", [False, True])
def test_odometry_stands_in_for_the_local_position(release, body, tmp_path):
    log = log_of(release, leave_out=("vehicle_local_position", "vehicle_odometry"))
    px4_layouts._odometry(log, flown(), tuple(int(p) for p in release.split(".")), body)
    flight = read(log, tmp_path)
    rows, same = middle_of(flight, flown())
    assert any("vehicle_odometry" in note for note in flight.notes)
    assert np.sqrt(np.mean((flight.velocity[rows] - flown().velocity[same]) ** 2)) < 0.02


def test_of_several_estimators_the_one_in_use_is_read(tmp_path):
    log = log_of("1.16")
    for name, estimate in (
        ("vehicle_attitude", "estimator_attitude"),
        ("vehicle_local_position", "estimator_local_position"),
    ):
        index = next(i for i, topic in enumerate(log.topics) if topic[0] == name)
        _, _, t, fields = log.topics.pop(index)
        wrong = {key: (code, np.zeros_like(values)) for key, (code, values) in fields.items()}
        wrong["timestamp_sample"] = fields["timestamp_sample"]
        log.add(estimate, t, 0, **wrong)
        log.add(estimate, t, 1, **fields)
    log.add(
        "estimator_selector_status",
        flown().t[::100],
        primary_instance=("B", np.ones(len(flown().t[::100]), int)),
    )
    flight = read(log, tmp_path)
    rows, same = middle_of(flight, flown())
    assert np.sqrt(np.mean((flight.position[rows] - flown().position[same]) ** 2)) < 0.01
    assert any("estimator_local_position 1" in note for note in flight.notes)


def test_what_the_logger_dropped_is_a_gap_and_not_made_up(tmp_path):
    log = log_of("1.15")
    hole = (BOOT + 10.0, BOOT + 11.0)
    for number, (name, instance, t, fields) in enumerate(log.topics):
        keep = (t < hole[0]) | (t > hole[1])
        log.topics[number] = (
            name,
            instance,
            t[keep],
            {k: (c, np.asarray(v)[keep]) for k, (c, v) in fields.items()},
        )
    log.dropouts.append((hole[0], 1000))
    flight = read(log, tmp_path)
    assert len(segments(flight.t)) == 2
    assert not np.any((flight.t > hole[0] - BOOT + 0.05) & (flight.t < hole[1] - BOOT - 0.05))
    assert any("dropped data once, 1.0 s" in note for note in flight.notes)


def test_two_flights_in_one_log_each_have_their_ground(tmp_path):
    one, two = flown(), still_later(flown(), 40.0, 7.0)
    first, second = log_of("1.15", one), log_of("1.15", two)
    both = Written(first.parameters, first.info)
    for (name, instance, t, fields), (_, _, later, others) in zip(first.topics, second.topics, strict=True):
        joined = {
            key: (code, np.concatenate([values, others[key][1]])) for key, (code, values) in fields.items()
        }
        both.topics.append((name, instance, np.concatenate([t, later]), joined))
    flight = read(both, tmp_path)
    assert any("2 flights in the log" in note for note in flight.notes)
    middle = one.t[one.middle] - BOOT
    for start in (0.0, 40.0):
        rows = (flight.t > middle[0] + start) & (flight.t < middle[-1] + start)
        assert flight.flying[rows].all()
        assert np.median(flight.position[rows, 2]) == pytest.approx(
            np.median(one.position[one.middle, 2]), abs=0.02
        )
        np.testing.assert_allclose(flight.position_reference[rows, 2], flight.position[rows, 2], atol=0.1)
    between = (flight.t > one.t[-1] - BOOT) & (flight.t < 40.0)
    assert not flight.flying[between].any()


def test_an_estimate_that_jumps_or_is_not_vouched_for_is_left_out(tmp_path):
    log = log_of("1.14")
    index = next(i for i, topic in enumerate(log.topics) if topic[0] == "vehicle_local_position")
    name, instance, t, fields = log.topics[index]
    jump, lost = t > BOOT + 9.0, (t > BOOT + 12.0) & (t < BOOT + 13.0)
    fields = dict(fields)
    fields["x"] = ("f", np.asarray(fields["x"][1]) + 3.0 * jump)
    fields["xy_reset_counter"] = ("B", jump.astype(int))
    fields["delta_xy"] = ("f", np.stack([3.0 * jump, 0.0 * jump], -1))
    fields["v_xy_valid"] = ("?", ~lost)
    log.topics[index] = (name, instance, t, fields)
    flight = read(log, tmp_path)
    at = flight.t[flight.flying]
    assert not np.any((at > 8.99) & (at < 9.01)) and not np.any((at > 12.03) & (at < 12.99))
    assert any("the estimator reset its position by 3 m at t = 9.0" in note for note in flight.notes)
    assert any("without a valid estimate" in note for note in flight.notes)


@pytest.mark.parametrize(("degrees", "told"), [(60.0, True), (-5.0, False)])
def test_a_heading_reset_is_told_by_its_counter_and_undone_where_it_is_large(degrees, told, tmp_path):
    log = log_of("1.15")
    index = next(i for i, topic in enumerate(log.topics) if topic[0] == "vehicle_attitude")
    name, instance, t, fields = log.topics[index]
    after, half = t > BOOT + 14.0, np.radians(degrees) / 2
    turn = np.where(after[:, None], [np.cos(half), 0.0, 0.0, np.sin(half)], [1.0, 0.0, 0.0, 0.0])
    q = np.asarray(fields["q"][1])
    turned = np.stack([
        turn[:, 0] * q[:, 0] - turn[:, 3] * q[:, 3], turn[:, 0] * q[:, 1] - turn[:, 3] * q[:, 2],
        turn[:, 0] * q[:, 2] + turn[:, 3] * q[:, 1], turn[:, 0] * q[:, 3] + turn[:, 3] * q[:, 0],
    ], -1)  # fmt: skip
    fields = {
        **fields,
        "q": ("f", turned),
        "delta_q_reset": ("f", turn),
        "quat_reset_counter": ("B", after.astype(int)),
    }
    log.topics[index] = (name, instance, t, fields)
    flight = read(log, tmp_path)
    said = f"reset its heading by {abs(degrees):.0f} degrees at t = 14.0"
    assert any(said in note and "quat_reset_counter" in note for note in flight.notes)
    assert any("was turned by" in note for note in flight.notes) == told
    assert not np.any(flight.flying[(flight.t > 13.975) & (flight.t < 14.005)])
    same = np.round(100 * flight.t[flight.flying]).astype(int)
    aligned = np.abs(np.sum(flight.quaternion[flight.flying] * flown().quaternion[same], axis=1))
    assert np.degrees(2 * np.arccos(np.clip(aligned.min(), 0, 1))) < (2.0 if told else 6.0)


def test_a_flight_without_a_horizontal_estimate_keeps_thrust_and_accelerometer(tmp_path):
    log = log_of("1.14", leave_out=("vehicle_local_position", "vehicle_odometry", "trajectory_setpoint"))
    px4_layouts._position(log, flown(), (1, 14))
    name, instance, t, fields = log.topics[-1]
    log.topics[-1] = (name, instance, t, {**fields, "v_xy_valid": ("?", np.zeros(len(t), bool))})
    flight = read(log, tmp_path)
    assert flight.velocity is None and flight.position is None and flight.specific_force is not None
    assert any("no horizontal velocity" in note for note in flight.notes)


def test_parameters_changed_in_the_air_are_told(tmp_path):
    log = log_of("1.15")
    log.changes += [
        (BOOT + 10.0, "THR_MDL_FAC", 0.4),
        (BOOT + 10.5, "MPC_XY_P", 1.2),
        (BOOT + 0.5, "PWM_MAIN_MAX1", 1900),
    ]
    flight = read(log, tmp_path)
    told = next(note for note in flight.notes if "changed in the air" in note)
    assert "THR_MDL_FAC 0 to 0.4 at 10.0 s" in told and "MPC_XY_P" not in told and "PWM" not in told


def set_status(log, **values):
    index = next(i for i, topic in enumerate(log.topics) if topic[0] == "vehicle_status")
    name, instance, t, fields = log.topics[index]
    changed = {key: (fields[key][0], np.full(len(t), value)) for key, value in values.items()}
    log.topics[index] = (name, instance, t, {**fields, **changed})
    return log


@pytest.mark.parametrize(
    ("status", "said"),
    [
        ({"vehicle_type": 2, "system_type": 1}, "fixed-wing aircraft"),
        ({"is_vtol": True, "system_type": 22}, "VTOL aircraft"),
        ({"vehicle_type": 3, "system_type": 10}, "rover"),
        ({"arming_state": 1}, "never armed"),
    ],
)
def test_what_is_no_flight_of_a_multirotor_is_told_in_one_line(status, said, tmp_path):
    with pytest.raises(InputError, match=said) as error:
        read(set_status(log_of("1.15"), **status), tmp_path)
    assert "\n" not in str(error.value)


def test_armed_on_the_ground_is_no_flight(tmp_path):
    log = log_of("1.15", leave_out=("vehicle_land_detected",))
    log.add("vehicle_land_detected", flown().t[::100], landed=("?", np.ones(len(flown().t[::100]), bool)))
    with pytest.raises(InputError, match="never off the ground"):
        read(log, tmp_path)


def test_six_motors_of_which_none_was_logged_give_a_collective(tmp_path):
    log = set_status(log_of("1.16"), system_type=13)
    log.parameters["CA_ROTOR_COUNT"] = 6
    flight = read(log, tmp_path)
    assert flight.motor_command is None and thrust_agrees(flight, 0.25)
    assert any(note.startswith("6 motors") for note in flight.notes)


@pytest.mark.parametrize("count", [6, 8])
def test_six_and_eight_motors_are_read_with_their_places_and_written(count, tmp_path):
    log, one = set_status(log_of("1.16", leave_out=("actuator_motors",)), system_type=13), flown()
    log.parameters["CA_ROTOR_COUNT"] = count
    angles = 2 * np.pi * (0.5 + np.arange(count)) / count
    for i, angle in enumerate(angles):
        place = {"PX": 0.3 * np.cos(angle), "PY": 0.3 * np.sin(angle), "PZ": 0.0, "KM": 0.05 * (-1) ** i}
        log.parameters |= {f"CA_ROTOR{i}_{axis}": float(value) for axis, value in place.items()}
    rows = one.rows(50)
    share = 1.0 + 0.1 * np.sin(0.1 * np.arange(len(rows)))[:, None] * np.cos(angles)
    control = np.full((len(rows), 12), np.nan)
    control[:, :count] = one.thrust[rows][:, None] * share
    log.add("actuator_motors", one.t[rows], control=("f", control))
    rpm = np.sqrt(np.clip(control[:, :count], 0.01, 1.0)) * 900.0 * 30 / np.pi
    log.add(
        "esc_status", one.t[rows], **{f"esc[{i}].esc_rpm": ("i", rpm[:, i].astype(int)) for i in range(count)}
    )
    path = log.save(tmp_path / "log.ulg")
    drafted = draft_of(path, tmp_path / "vehicle.toml", 2.0)
    np.testing.assert_allclose(
        drafted.vehicle.rotor_positions,
        0.3 * np.stack([np.cos(angles), -np.sin(angles), 0 * angles], -1),
        atol=1e-3,
    )
    assert drafted.vehicle.rotor_directions == (1, -1) * (count // 2)
    flight = read_flight(path, drafted.vehicle)
    assert flight.motor_command.shape[1] == flight.rotor_speed.shape[1] == count
    middle, same = middle_of(flight, one)
    np.testing.assert_allclose(flight.motor_command[middle].mean(axis=1), one.thrust[same], atol=0.02)
    assert not any("rotor_positions: correct" in note for note in flight.notes)
    write_flight(flight, tmp_path / "flight.csv")
    again = read_flight(tmp_path / "flight.csv")
    np.testing.assert_allclose(again.rotor_speed, flight.rotor_speed, atol=0.1)
    assert (
        again.motor_command.shape[1] == count
        and again.vehicle.rotor_positions == drafted.vehicle.rotor_positions
    )


@pytest.mark.parametrize("share", [0.02, 0.15, 0.4, 0.6, 0.999])
def test_a_log_cut_anywhere_is_read_or_told(share, tmp_path):
    whole = log_of("1.15").save(tmp_path / "whole.ulg").read_bytes()
    path = tmp_path / "cut.ulg"
    path.write_bytes(whole[: int(share * len(whole))])
    if share >= 0.4:
        flight = read_flight(path, VEHICLE)
        assert share > 0.9 or any("cut short" in note for note in flight.notes)
    else:
        with pytest.raises(InputError):
            read_flight(path, VEHICLE)


@pytest.mark.parametrize("seed", range(12))
def test_a_damaged_log_is_read_or_told_never_more(seed, tmp_path):
    content = bytearray(log_of("1.15").save(tmp_path / "whole.ulg").read_bytes())
    random = np.random.default_rng(seed)
    for _ in range(1 + 3 * seed):
        at = int(random.integers(0, len(content)))
        content[at : at + int(random.integers(1, 40))] = random.bytes(int(random.integers(1, 40)))
    path = tmp_path / "damaged.ulg"
    path.write_bytes(content)
    try:
        flight = read_flight(path, VEHICLE)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert flight.duration < 60.0 and np.all(np.diff(flight.t) > 0)


def test_a_cut_log_whose_definitions_are_damaged_comes_to_an_end(tmp_path):
    content = log_of("1.15").save(tmp_path / "whole.ulg").read_bytes()
    path = tmp_path / "damaged.ulg"
    # The length of the second definition says more than the file has.
    second = 16 + 43
    path.write_bytes(content[:second] + b"\xff\xff\x00" + content[second + 3 : 20_000])
    with pytest.raises(InputError):
        read_flight(path, VEHICLE)


def test_one_wrong_time_costs_one_sample(tmp_path):
    log = log_of("1.15")
    whole = load_ulog(log.save(tmp_path / "whole.ulg")).topic("vehicle_attitude")
    index = next(i for i, topic in enumerate(log.topics) if topic[0] == "vehicle_attitude")
    name, instance, t, fields = log.topics[index]
    for wrong in (BOOT + 500.0, 0.001):
        times = t.copy()
        times[400] = wrong
        stamped = dict(fields)
        stamped["timestamp_sample"] = ("Q", (1e6 * times).round().astype(int))
        damaged = log_of("1.15")
        damaged.topics = [(n, i, tt, ff) for n, i, tt, ff in log.topics if n != "vehicle_attitude"]
        damaged.topics.append((name, instance, times, stamped))
        # Written in the order of its own damaged clock, but for this one sample.
        read_back = load_ulog(damaged.save(tmp_path / "wrong.ulg")).topic("vehicle_attitude")
        assert len(read_back.t) >= len(whole.t) - 1
