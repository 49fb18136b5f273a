"""PX4's events become reasons in plain words; the numbers and bytes here came from a running PX4 1.15.2."""

from __future__ import annotations

import struct

import pytest

from trueflight.companion.px4_checks import CHECKS
from trueflight.companion.px4_events import (
    ArmingChecks,
    Px4Event,
    describe,
    event_number,
    problem_of,
    unhealthy,
)

# What PX4 1.15.2 sent after MAV_CMD_RUN_PREARM_CHECKS, some seconds after its start: number, levels, arguments.
STARTING = (
    (27825120, 136, (0, 0, 0, 16, 0, 128, 0, 0, 0, 128, 43, 1, 128, 128, 43, 1, 128)),
    (27227279, 34, (126, 208, 126, 0, 20)),
    (30612409, 51, (124, 0, 126, 0, 20)),
    (26788467, 51, (56, 0, 0, 0, 20)),
    (17154777, 102, (8, 0, 0, 0, 20)),
    (19865031, 51, (0, 64, 0, 0, 20)),
    (17231145, 68, (255, 255, 255, 255, 7)),
    (23579003, 102, (255, 255, 255, 255, 12)),
    (18691879, 136, (0, 2, 8, 2, 40)),
)


def event(number: int, levels: int, arguments: tuple[int, ...]) -> Px4Event:
    return Px4Event(number, levels & 0xF, bytes(arguments).ljust(40, b"\0"))


def test_a_report_of_a_real_autopilot_is_read() -> None:
    checks = ArmingChecks()
    for one in STARTING[:-1]:
        checks.take(event(*one))
        assert checks.report is None, "not before it is whole"
    checks.take(event(*STARTING[-1]))
    report = checks.report
    assert report is not None
    assert not report.can_arm
    # A missing position stands against other modes alone: Offboard with body rates does not need one.
    assert [problem.name for problem in report.problems] == [
        "check_modes_attitude",
        "check_modes_offboard_signal",
        "check_modes_manual_control",
        "check_rc_dl_no_dllink",
    ]
    assert [problem.text for problem in report.reasons(streaming=False)] == ["no attitude estimate"]
    assert len(report.reasons(streaming=True)) == 2


def test_a_new_report_takes_the_place_of_the_old_one() -> None:
    checks = ArmingChecks()
    for one in (*STARTING, STARTING[0], STARTING[-1]):
        checks.take(event(*one))
    assert checks.count == 2
    assert checks.report is not None
    assert checks.report.problems == ()


def test_an_event_outside_a_report_is_no_arming_problem() -> None:
    checks = ArmingChecks()
    checks.take(event(*STARTING[1]))
    checks.take(event(*STARTING[-1]))
    assert checks.report is None


def test_an_unknown_check_is_told_with_its_number() -> None:
    problem = problem_of(event(0x01ABCDEF, 51, ()))
    assert "0x01abcdef" in problem.line
    assert "QGroundControl" in problem.line


@pytest.mark.parametrize(
    ("name", "level", "arguments", "text"),
    [
        ("commander_failsafe_enter", 2, (0, 0, 6, 0, 7, 4), "failsafe: battery critical, Land"),
        ("commander_failsafe_enter_generic", 2, (0, 0, 6, 0, 5), "failsafe: a failed check, Hold"),
        (
            "commander_failsafe_enter_hold",
            2,
            (0, 0, 6, 0, 6, 5, 0, 1),
            "failsafe: radio control lost, Return",
        ),
        ("commander_failsafe_enter_warn", 4, (0, 0, 6, 0, 2), "failsafe: ground station lost, warning"),
        ("commander_failsafe_enter", 2, (0, 0, 6, 0, 200, 200), "failsafe: a failed check, warning"),
        ("commander_failsafe_enter", 2, (), "failsafe: a failed check, warning"),
        ("check_gf_violation_max_alt", 3, (), "above the autopilot's geofence"),
        ("failsafe_rc_override", 6, (), "the pilot took over with the sticks"),
        ("check_modes_offboard_signal", 3, (), ""),  # the end of every flight
        ("check_modes_offboard_signal_lost", 3, (), ""),  # the same in 1.18
        ("check_estimator_gnss_fusion_stopped", 6, (), "the estimator no longer uses GPS"),
        ("check_estimator_gnss_warning_spoofing", 1, (), "the GPS signal is spoofed"),
        ("check_failure_detector_motor", 2, (1,), "a motor failed"),
        ("commander_failsafe_enter_low_flight_time_warn", 4, (), "little flight time left: return advised"),
        ("check_power_oc_periph", 3, (), "too much current from the 5 V supply of the ports"),
        ("check_rc_dl_no_dllink", 6, (), ""),
        ("something_new", 0, (), ""),
    ],
)
def test_what_is_told_in_flight(name: str, level: int, arguments: tuple[int, ...], text: str) -> None:
    assert describe(Px4Event(event_number(name), level, bytes(arguments))) == text


# From the tables (all_events.json) that the builds of 1.17.0 and of 1.18.0 beta 1 make of their sources.
NUMBERS = {
    "check_estimator_gps_hor_pos_drift_too_high": 22494412,
    "check_estimator_gnss_warning_spoofing": 25957751,
    "check_estimator_gps_jamming_critical": 29557505,
    "check_failure_detector_motor": 17443695,
    "check_power_oc_periph": 22476331,
    "check_navigator_failure_hagl": 17588137,
    "commander_failsafe_enter_low_flight_time_warn": 19085767,
    "check_escs_fault": 23725705,
    "check_modes_offboard_signal_lost": 28241790,
    "check_gnss_receiver_no_fix": 17904473,
}


def test_the_events_of_today_s_releases_have_their_numbers_and_words() -> None:
    for name, number in NUMBERS.items():
        problem = problem_of(Px4Event(number, 3, b""))
        assert problem.name == name
        assert "not known here" not in problem.text


def test_missing_setpoints_stand_against_nobody_before_a_flight_in_any_release() -> None:
    for name in ("check_modes_offboard_signal", "check_modes_offboard_signal_lost"):
        checks = ArmingChecks()
        checks.take(event(*STARTING[0]))
        checks.take(Px4Event(event_number(name), 3, struct.pack("<I", 1 << 14)))
        checks.take(event(*STARTING[-1]))
        assert checks.report is not None
        assert checks.report.reasons(streaming=False) == ()
        assert len(checks.report.reasons(streaming=True)) == 1


def test_no_two_names_have_the_same_number_and_each_has_words() -> None:
    assert len({event_number(name) for name in CHECKS}) == len(CHECKS)
    assert all(text for text, _ in CHECKS.values())


def test_sensors_that_are_on_and_not_well() -> None:
    assert unhealthy(0x1 | 0x2 | 0x20, 0x1 | 0x10000000) == ("accelerometer", "GPS")
    assert unhealthy(0, 0) == ()
