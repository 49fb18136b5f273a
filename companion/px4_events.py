"""PX4's events: why it refuses to arm and why a failsafe acts, in a pilot's words.

PX4 tells its reasons in EVENT messages on every link; the older STATUSTEXT goes to ground stations alone. An
event carries no text: its number is a hash of its name, and the names of the arming checks that concern a
quadrotor, with what each means and what helps, stand here. Source: PX4's events interface (1.13 and later; 24
bits of FNV-1a, component in the upper 8) and the checks of its commander module.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

ERROR, WARNING = 3, 4
"""Log levels as in syslog: lower is worse."""
_OFFBOARD_GROUP = 1 << 14
_AUTOPILOT_COMPONENT = 1 << 24


@dataclass(frozen=True)
class Px4Event:
    """One EVENT message: number, level (syslog's, as told to people), arguments as they came."""

    number: int
    level: int
    arguments: bytes


@dataclass(frozen=True)
class Problem:
    """An arming check that failed: PX4's `name` for it, what it means, what to do, and its level.

    `name` is the number in hexadecimal where this program does not know the check.
    """

    name: str
    text: str
    advice: str
    level: int

    @property
    def line(self) -> str:
        """Both in one line."""
        return f"{self.text}; {self.advice}" if self.advice else self.text


@dataclass(frozen=True)
class ArmingReport:
    """What PX4's arming checks say; `can_arm` is for Offboard, `problems` those that concern it."""

    can_arm: bool
    problems: tuple[Problem, ...]

    def reasons(self, streaming: bool) -> tuple[Problem, ...]:
        """The problems that stand against a flight; without setpoints `streaming`, not that they are missing."""
        return tuple(
            problem
            for problem in self.problems
            if problem.level <= ERROR and (streaming or problem.name != NO_SETPOINTS)
        )


def event_number(name: str) -> int:
    """The number that PX4 gives an event of the autopilot component."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = (value ^ byte) * 0x1000193 & 0xFFFFFFFF
    return value & 0xFFFFFF | _AUTOPILOT_COMPONENT


NO_SETPOINTS = "check_modes_offboard_signal"

CHECKS: dict[str, tuple[str, str]] = {
    NO_SETPOINTS: (
        "no setpoints are arriving for Offboard",
        "the companion streams them before it arms; seen in flight, the companion or the link had stopped",
    ),
    "check_modes_local_pos": (
        "no position estimate",
        "wait for GPS outdoors; indoors turn mocap or vision on ([pose], EKF2_EV_CTRL)",
    ),
    "check_modes_global_pos": (
        "no global position",
        "wait for GPS, or choose a failsafe action that needs none (COM_OBL_RC_ACT 4, Land)",
    ),
    "check_modes_local_alt": ("no height estimate", "check barometer and EKF2_HGT_REF"),
    "check_modes_attitude": ("no attitude estimate", "keep the vehicle still; calibrate gyroscope and level"),
    "check_modes_angular_velocity": (
        "no body rates",
        "the gyroscope gives nothing; reboot, then look for a fault",
    ),
    "check_modes_manual_control": (
        "no radio control",
        "switch the transmitter on; a flight without one needs COM_RCL_EXCEPT with bit 2 (4)",
    ),
    "check_modes_home_position": ("no home position", "wait for GPS, or set it in QGroundControl"),
    "check_modes_cannot_takeoff": (
        "the present mode cannot take off",
        "the companion chooses Offboard itself; try again",
    ),
    "check_modes_mission": ("no mission on board", "not needed for Offboard"),
    "check_estimator_missing_data": ("the estimator is still starting", "wait some seconds"),
    "check_estimator_hor_pos_not_stable": (
        "horizontal position is unsteady",
        "wait, or improve GPS or mocap",
    ),
    "check_estimator_hor_vel_not_stable": (
        "horizontal velocity is unsteady",
        "keep the vehicle still and wait",
    ),
    "check_estimator_vert_vel_not_stable": (
        "vertical velocity is unsteady",
        "keep the vehicle still and wait",
    ),
    "check_estimator_hgt_not_stable": ("height is unsteady", "wait; check barometer and EKF2_HGT_REF"),
    "check_estimator_heading_not_stable": (
        "heading is unsteady",
        "away from metal; calibrate the compass, or take yaw from mocap (EKF2_EV_CTRL bit 3)",
    ),
    "check_estimator_low_position_accuracy": ("the position estimate is poor", "improve GPS or mocap"),
    "check_estimator_position_failure_imminent": ("the position is about to be lost", "land"),
    "check_estimator_mag_interference": ("strong magnetic interference", "move away from steel and cables"),
    "check_estimator_mag_fault": ("the estimator gave the compass up", "calibrate it, or turn it off"),
    "check_estimator_high_accel_bias": (
        "the accelerometer is off",
        "calibrate it; let the vehicle warm up, still and level",
    ),
    "check_estimator_high_gyro_bias": ("the gyroscope is off", "calibrate it with the vehicle still"),
    "check_estimator_gps_fix_too_low": ("GPS has no good fix", "wait outdoors; indoors set SYS_HAS_GPS 0"),
    "check_estimator_gps_num_sats_too_low": ("too few satellites", "wait under open sky"),
    "check_estimator_gps_not_fusing": (
        "the estimator does not use GPS yet",
        "wait; indoors set SYS_HAS_GPS 0 and EKF2_GPS_CTRL 0",
    ),
    "check_estimator_gps_generic": ("GPS is poor", "wait under open sky"),
    "check_accel_missing": ("an accelerometer is missing", "reboot; then look for a fault"),
    "check_accel_no_data": ("an accelerometer gives nothing", "reboot; then look for a fault"),
    "check_accel_not_calibrated": ("the accelerometer is not calibrated", "calibrate it in QGroundControl"),
    "check_gyro_missing": ("a gyroscope is missing", "reboot; then look for a fault"),
    "check_gyro_no_data": ("a gyroscope gives nothing", "reboot; then look for a fault"),
    "check_gyro_not_calibrated": ("the gyroscope is not calibrated", "calibrate it in QGroundControl"),
    "check_imu_accel_inconsistent": ("two accelerometers disagree", "calibrate them in QGroundControl"),
    "check_imu_gyro_inconsistent": ("two gyroscopes disagree", "keep still, reboot, calibrate"),
    "check_mag_missing": ("the compass is missing", "connect it, or set SYS_HAS_MAG 0"),
    "check_mag_no_data": ("the compass gives nothing", "reboot, or set SYS_HAS_MAG 0"),
    "check_mag_not_calibrated": ("the compass is not calibrated", "calibrate it in QGroundControl"),
    "check_mag_fault": ("the compass is faulty", "move away from metal; calibrate it"),
    "check_mag_consistency": ("two compasses disagree", "move away from metal; calibrate them"),
    "check_mag_sys_has_mag_missing": (
        "fewer compasses than SYS_HAS_MAG says",
        "connect it, or lower SYS_HAS_MAG",
    ),
    "check_baro_missing": ("the barometer is missing", "reboot, or set SYS_HAS_BARO 0 with another height"),
    "check_baro_no_data": ("the barometer gives nothing", "reboot; then look for a fault"),
    "check_distance_sensor_missing": (
        "the distance sensor is missing",
        "connect it, or lower SYS_HAS_NUM_DIST",
    ),
    "check_optical_sensor_missing": ("the flow sensor is missing", "connect it, or set SYS_HAS_NUM_OF 0"),
    "check_battery_missing": ("a battery is missing", "connect it, and its power module"),
    "check_battery_disconnected": ("a battery is disconnected", "connect it"),
    "check_battery_unhealthy": ("the battery is not well", "take another one"),
    "check_battery_low": ("the battery is low", "charge it (PX4 compares with BAT_LOW_THR)"),
    "check_battery_critical": ("the battery is critically low", "charge it (BAT_CRIT_THR)"),
    "check_battery_emergency": ("the battery is all but empty", "charge it (BAT_EMERGEN_THR)"),
    "check_battery_fault": ("the battery reports a fault", "take another one"),
    "check_battery_rem_flight_time_low": ("too little flight time is left", "charge the battery"),
    "check_avionics_power_low": ("the avionics' supply is too low", "check power module and wiring"),
    "check_avionics_power_high": ("the avionics' supply is too high", "check power module and wiring"),
    "check_avionics_power_missing": (
        "no power module",
        "connect it; on the bench, on USB alone, CBRK_SUPPLY_CHK 894281 skips this check",
    ),
    "check_missing_system_power": ("the supply is not measured", "check the power module"),
    "check_system_usb_connected": ("USB is connected", "take the cable off before flying"),
    "check_system_safety_button": ("the safety switch is on", "press it until it stops blinking"),
    "check_system_flight_term_active": ("flight is terminated", "find out why, then reboot the autopilot"),
    "check_system_arm_auth_failed": (
        "arming was not authorised",
        "ask whoever has the authority (COM_ARM_AUTH)",
    ),
    "check_system_no_home_pos": ("no home position", "wait for GPS, or lower COM_ARM_WO_GPS"),
    "check_system_no_global_pos": ("no global position", "wait for GPS, or set COM_ARM_WO_GPS 1"),
    "check_armable_configuration": ("arming is switched off", "set COM_ARMABLE 1"),
    "check_man_control_kill_engaged": ("the kill switch is on", "flip it back on the transmitter"),
    "check_man_control_rtl_engaged": ("the return switch is on", "flip it back on the transmitter"),
    "check_rc_dl_no_dllink": ("no ground station", "connect QGroundControl, or set NAV_DLL_ACT 0"),
    "check_cpuload_too_high": ("the autopilot's processor is overloaded", "ask for lower message rates"),
    "check_ram_usage_too_high": ("the autopilot's memory is full", "stop what is not needed"),
    "check_missing_fmu_sdcard": ("no SD card", "put one in, or set COM_ARM_SDCARD 0"),
    "check_hardfault_present": ("the SD card holds crash dumps", "read them, then delete them"),
    "check_escs_offline": ("a motor controller is silent", "check its wiring"),
    "check_escs_telem_missing": ("the motor controllers tell nothing", "check their telemetry"),
    "check_failure_detector_arm_esc": ("a motor controller reports a fault", "check motor and controller"),
    "check_failure_detector_roll": ("tilted too far in roll", "put the vehicle level (FD_FAIL_R)"),
    "check_failure_detector_pitch": ("tilted too far in pitch", "put the vehicle level (FD_FAIL_P)"),
    "check_failure_detector_alt": ("the height failed", "find out why before another flight"),
    "check_failure_detector_imbalanced_prop": ("a propeller is unbalanced", "change it"),
    "check_gf_violation_custom_gf": (
        "outside the autopilot's geofence",
        "bring it inside, or change the fence",
    ),
    "check_gf_violation_max_alt": ("above the autopilot's geofence", "GF_MAX_VER_DIST"),
    "check_gf_violation_max_hor_dist": ("beyond the autopilot's geofence", "GF_MAX_HOR_DIST"),
    "check_gf_violation": ("outside the autopilot's geofence", "bring it inside, or change the fence"),
    "check_gf_no_home": ("the geofence needs a home position", "wait for GPS, or set GF_ACTION 3 (Hold)"),
    "check_parachute_missing": ("the parachute is missing", "connect it, or set COM_PARACHUTE 0"),
    "check_flight_time_limit": ("the longest flight time is over", "land (COM_FLT_TIME_MAX)"),
    "check_high_wind_warning": ("strong wind", "land"),
    "commander_arm_denied_calibrating": ("a calibration is under way", "wait for its end"),
    "commander_arm_denied_throttle_high": ("the throttle stick is not down", "pull it down"),
    "commander_arm_denied_throttle_center": ("the throttle stick is not centred", "centre it"),
    "commander_disarm_denied_not_landed": ("not disarmed: the vehicle is not on the ground", ""),
    "commander_kill_sw_engaged": ("the kill switch was switched on", ""),
    "commander_kill_sw_disengaged": ("the kill switch was switched off", ""),
    "commander_rc_override": ("the pilot took over with the sticks", ""),
    "failsafe_rc_override": ("the pilot took over with the sticks", ""),
    "commander_rc_lost": ("radio control was lost", ""),
    "commander_gcs_lost": ("the ground station was lost", ""),
    "commander_failsafe_enter_low_bat": ("battery low: return advised", ""),
    "commander_failsafe_enter_crit_bat_warn": ("battery critical: land now", ""),
    "commander_failsafe_enter_crit_low_bat_warn": ("battery all but empty: land at once", ""),
}
"""PX4's name of an event to what it means and what to do."""

_NAMES = {event_number(name): name for name in CHECKS}
_ARMING_SUMMARY = event_number("commander_arming_check_summary")
_HEALTH_SUMMARY = event_number("commander_health_summary")
_ACTIONS = (
    "none",
    "warning",
    "Position",
    "Altitude",
    "Stabilized",
    "Hold",
    "Return",
    "Land",
    "Descend",
    "disarm",
    "terminate",
)
_CAUSES = (
    "a failed check",
    "radio control lost",
    "ground station lost",
    "battery low",
    "battery critical",
    "battery all but empty",
    "flight time running out",
)
# PX4's failsafe events, and where in the arguments action and cause stand.
_FAILSAFES: dict[int, tuple[int | None, int | None]] = {
    event_number("commander_failsafe_enter"): (4, 5),
    event_number("commander_failsafe_enter_generic"): (4, None),
    event_number("commander_failsafe_enter_autopilot_disengaged"): (4, None),
    event_number("commander_failsafe_enter_hold"): (4, 7),
    event_number("commander_failsafe_enter_generic_hold"): (4, None),
    event_number("commander_failsafe_enter_warn"): (None, 4),
    event_number("commander_failsafe_enter_generic_warn"): (None, None),
}


def describe(event: Px4Event) -> str:
    """One line for an event that matters in flight; '' for any other."""
    if event.number in _FAILSAFES:
        action_at, cause_at = _FAILSAFES[event.number]
        action = _name_of(_ACTIONS, event.arguments, action_at)
        cause = _name_of(_CAUSES, event.arguments, cause_at)
        return f"failsafe: {cause or _CAUSES[0]}, {action or _ACTIONS[1]}"
    name = _NAMES.get(event.number)
    if name is None or name == NO_SETPOINTS or (event.level > ERROR and name not in _TOLD_ANYWAY):
        return ""
    return CHECKS[name][0]


_TOLD_ANYWAY = (
    "failsafe_rc_override",
    "commander_rc_override",
    "commander_rc_lost",
    "commander_kill_sw_engaged",
)


def _name_of(names: Sequence[str], arguments: bytes, at: int | None) -> str:
    if at is None or at >= len(arguments) or arguments[at] >= len(names):
        return ""
    return names[arguments[at]]


class ArmingChecks:
    """Collects the report that PX4 sends when its checks change or are asked for: a summary, one event for each
    problem, a second summary.

    `report` is the last whole one; `count` tells how many there have been.
    """

    def __init__(self) -> None:
        self.report: ArmingReport | None = None
        self.count = 0
        self._can_arm: bool | None = None
        self._problems: list[Problem] = []

    def take(self, event: Px4Event) -> None:
        """Take the next event."""
        if event.number == _ARMING_SUMMARY:
            # chunk uint8, error uint32, warning uint32, can_arm uint32, can_run uint32
            (groups,) = struct.unpack_from("<I", event.arguments.ljust(17, b"\0"), 9)
            self._can_arm, self._problems = bool(groups & _OFFBOARD_GROUP), []
        elif event.number == _HEALTH_SUMMARY:
            if self._can_arm is not None:
                self.report = ArmingReport(self._can_arm, tuple(self._problems))
                self.count += 1
            self._can_arm = None
        elif self._can_arm is not None:
            (groups,) = struct.unpack_from("<I", event.arguments.ljust(4, b"\0"))
            if groups & _OFFBOARD_GROUP:
                self._problems.append(problem_of(event))


def problem_of(event: Px4Event) -> Problem:
    """The failed check of an event, in plain words."""
    name = _NAMES.get(event.number, f"0x{event.number:08x}")
    text, advice = CHECKS.get(
        name, (f"an arming check failed that is not known here (PX4 event {name})", "see QGroundControl")
    )
    return Problem(name, text, advice, event.level)


_SENSORS = {
    0x1: "gyroscope",
    0x2: "accelerometer",
    0x4: "compass",
    0x8: "barometer",
    0x20: "GPS",
    0x40: "optical flow",
    0x80: "vision position",
    0x100: "distance sensor",
    0x200: "external position",
    0x400: "body rate control",
    0x800: "attitude control",
    0x1000: "yaw control",
    0x2000: "height control",
    0x4000: "position control",
    0x8000: "motor outputs",
    0x10000: "radio control",
    0x100000: "geofence",
    0x200000: "attitude estimate",
    0x1000000: "logging",
    0x2000000: "battery",
    0x10000000: "arming checks",
}
"""Bits of SYS_STATUS (MAV_SYS_STATUS_SENSOR)."""


def unhealthy(enabled: int, health: int) -> tuple[str, ...]:
    """What SYS_STATUS says is switched on and not well."""
    return tuple(name for bit, name in _SENSORS.items() if enabled & bit and not health & bit)
