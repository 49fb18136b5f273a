"""Names of the PX4 events that concern a quadrotor, 1.14 to 1.18 beta, each with what it means and what helps.

Source: the arming checks of PX4's commander module, and what navigator, sensors and estimator tell in flight.
"""

from __future__ import annotations

CHECKS: dict[str, tuple[str, str]] = {
    "check_modes_offboard_signal": (  # up to 1.17
        "no setpoints are arriving for Offboard",
        "the companion streams them before it arms; seen in flight, the companion or the link had stopped",
    ),
    "check_modes_offboard_signal_lost": (  # 1.18
        "no setpoints are arriving for Offboard",
        "the companion streams them before it arms; seen in flight, the companion or the link had stopped",
    ),
    "check_modes_offboard_no_local_position": (
        "no position estimate",
        "wait for GPS, or turn mocap on ([pose])",
    ),
    "check_modes_offboard_no_local_velocity": (
        "no velocity estimate",
        "wait for GPS, or turn mocap on ([pose])",
    ),
    "check_modes_offboard_no_attitude": (
        "no attitude estimate",
        "keep the vehicle still; calibrate gyroscope and level",
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
    "check_estimator_gps_pdop_too_high": (
        "the satellites stand badly (PDOP)",
        "wait under open sky (EKF2_REQ_PDOP)",
    ),
    "check_estimator_gps_hor_pos_err_too_high": (
        "GPS knows its horizontal position badly",
        "wait under open sky (EKF2_REQ_EPH)",
    ),
    "check_estimator_gps_vert_pos_err_too_high": (
        "GPS knows its height badly",
        "wait under open sky (EKF2_REQ_EPV)",
    ),
    "check_estimator_gps_speed_acc_too_low": (
        "GPS knows its speed badly",
        "wait under open sky (EKF2_REQ_SACC)",
    ),
    "check_estimator_gps_hor_pos_drift_too_high": (
        "the GPS position drifts though the vehicle stands",
        "wait; away from walls (EKF2_REQ_HDRIFT)",
    ),
    "check_estimator_gps_vert_pos_drift_too_high": (
        "the GPS height drifts though the vehicle stands",
        "wait; away from walls (EKF2_REQ_VDRIFT)",
    ),
    "check_estimator_gps_hor_speed_drift_too_high": (
        "GPS tells a horizontal speed though the vehicle stands",
        "keep it still; wait (EKF2_REQ_HDRIFT)",
    ),
    "check_estimator_gps_vert_speed_drift_too_high": (
        "GPS tells a vertical speed though the vehicle stands",
        "keep it still; wait (EKF2_REQ_VDRIFT)",
    ),
    "check_estimator_gps_spoofed": ("the GPS signal is spoofed", "do not fly here by GPS"),
    "check_estimator_gps_jammed": (
        "the GPS signal is jammed",
        "look for a transmitter or a noisy cable near the receiver; do not fly here by GPS",
    ),
    "check_estimator_gps_jamming_critical": (
        "the GPS signal is jammed",
        "look for a transmitter or a noisy cable near the receiver",
    ),
    "check_estimator_gnss_warning_spoofing": ("the GPS signal is spoofed", "land; do not fly here by GPS"),
    "check_estimator_gnss_warning_jamming": ("the GPS signal is jammed", "land; do not fly here by GPS"),
    "check_estimator_gnss_fault": ("the heading of GPS is not reliable", "land; check both antennas"),
    "check_estimator_gnss_fusion_stopped": (
        "the estimator no longer uses GPS",
        "land before it loses its position",
    ),
    "check_estimator_gnss_fusion_started": ("the estimator uses GPS now", ""),
    "check_estimator_heading_no_source": (
        "nothing tells the heading",
        "calibrate the compass, or take yaw from GPS or mocap",
    ),
    "check_gnss_receiver_offline": (
        "a GPS receiver is silent",
        "check its wiring, or lower SYS_HAS_NUM_GNSS",
    ),
    "check_gnss_receiver_no_fix": ("a GPS receiver lost its fix", "wait under open sky"),
    "check_gps_position_divergence": (
        "two GPS receivers disagree",
        "check both antennas; wait under open sky",
    ),
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
    "check_power_oc_hipower": (
        "too much current from the 5 V supply for strong loads",
        "take the load off it; check wiring",
    ),
    "check_power_oc_periph": (
        "too much current from the 5 V supply of the ports",
        "unplug what hangs on the ports; check wiring",
    ),
    "check_power_oc_report": ("too much current from a 5 V supply", "land, then check what hangs on it"),
    "check_avionics_power_redundancy": (
        "fewer power modules than wanted",
        "connect them, or lower COM_POWER_COUNT",
    ),
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
    "check_escs_fault": (
        "a motor controller reports a fault",
        "check motor and controller (COM_ARM_CHK_ESCS)",
    ),
    "check_escs_not_all_armed": ("not every motor controller is armed", "check their wiring and supply"),
    "check_esc_over_temperature": ("a motor controller is hot", "land; let it cool (ESC_TEMP_WARN_TH)"),
    "check_failure_detector_motor": (
        "a motor failed",
        "land; check motor, controller and propeller (FD_ACT_EN)",
    ),
    "check_failure_detector_ext": (
        "an external system triggered the failure detector",
        "find out why (FD_EXT_ATS_EN)",
    ),
    "check_motor_undercurrent": (
        "a motor draws too little current",
        "check its propeller and wiring (FD_ACT_EN)",
    ),
    "check_motor_overcurrent": (
        "a motor draws too much current",
        "check whether it turns freely (FD_ACT_EN)",
    ),
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
    # up to PX4 1.14
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
    "check_distance_sensor_invalid": (
        "the distance sensor gives nothing of use",
        "check it, or lower SYS_HAS_NUM_DIST",
    ),
    "check_optical_flow_sensor_invalid": (
        "the flow sensor gives nothing of use",
        "check it, or set SYS_HAS_NUM_OF 0",
    ),
    "check_missing_cpuload": (
        "the autopilot does not tell its load",
        "reboot; COM_CPU_MAX 0 skips this check",
    ),
    "check_task_watchdog_present": (
        "the SD card holds dumps of a starved task",
        "read them, then delete them",
    ),
    "check_companion_computer_temperature_high": (
        "this computer is hot, says the autopilot",
        "cool it (COM_CC_TEMP_WARN)",
    ),
    "check_mission_failure": ("the autopilot's mission cannot be flown", "not needed for Offboard"),
    "check_rally_point_missing": ("no rally point", "not needed for Offboard"),
    "check_navigator_failure_hagl": (
        "the autopilot's own target is above the height that its sensors allow",
        "lower it, or land",
    ),
    "navigator_fail_max_hagl": (
        "the autopilot's own target is above the height that its sensors allow",
        "lower it, or land",
    ),
    "navigator_terrain_collision_risk": (
        "the ground is near: the autopilot stopped its descent",
        "land by hand",
    ),
    "navigator_reposition_outside_geofence": (
        "a target outside the autopilot's geofence was refused",
        "bring it inside",
    ),
    "check_external_modes_unavailable": (
        "a mode of another program is not there",
        "start that program, or choose another mode",
    ),
    "check_external_modes_unresponsive": (
        "a mode of another program does not answer",
        "restart that program, or choose another mode",
    ),
    "commander_mode_fallback_internal": (
        "a mode of another program does not answer; the autopilot's own takes its place",
        "",
    ),
    "commander_modeswitch_not_avail": (
        "the autopilot cannot switch to that mode now",
        "read why in its arming checks",
    ),
    "check_open_drone_id_missing": ("the remote ID is missing", "connect it, or set COM_ARM_ODID 0"),
    "check_open_drone_id_unhealthy": ("the remote ID is not well", "check it, or set COM_ARM_ODID 0"),
    "commander_remote_id_lost": ("the remote ID was lost", ""),
    "check_traffic_avoidance_missing": ("the traffic receiver is missing", "connect it (COM_ARM_TRAFF)"),
    "commander_traffic_avoidance_lost": ("the traffic receiver was lost", ""),
    "check_parachute_unhealthy": ("the parachute is not well", "check it, or set COM_PARACHUTE 0"),
    "check_man_control_landing_gear_up": ("the landing gear switch is up", "flip it down"),
    "check_rc_min_too_small": ("the radio is calibrated badly", "calibrate it in QGroundControl"),
    "check_rc_max_too_high": ("the radio is calibrated badly", "calibrate it in QGroundControl"),
    "check_rc_trim_too_small": ("the radio is calibrated badly", "calibrate it in QGroundControl"),
    "check_rc_trim_too_high": ("the radio is calibrated badly", "calibrate it in QGroundControl"),
    "check_above_wind_limits_warning": ("the wind is above the limit", "land (COM_WIND_WARN)"),
    "check_wind_too_high": ("the wind is above the limit", "land (COM_WIND_MAX)"),
    "vehicle_imu_accel_clipping": (
        "the accelerometer is at its limit: vibration",
        "land; balance propellers, damp the autopilot",
    ),
    "vehicle_imu_gyro_clipping": (
        "the gyroscope is at its limit: vibration",
        "land; balance propellers, damp the autopilot",
    ),
    "sensor_failover": (
        "an accelerometer or gyroscope failed and another took over",
        "land at once, then look for the fault",
    ),
    "sensor_failover_baro": (
        "a barometer failed and another took over",
        "land at once, then look for the fault",
    ),
    "sensor_failover_mag": (
        "a compass failed and another took over",
        "land at once, then look for the fault",
    ),
    "commander_arm_denied_throttle_unsafe": (
        "the throttle stick is not where it is safe",
        "pull it down, or centre it for the height modes",
    ),
    "commander_arm_denied_resolve_failures": ("not armed: failed checks stand against it", "read them above"),
    "commander_rc_loss_hold_no_failsafe": ("radio control was lost: Hold", ""),
    "commander_max_flight_time_warning_minutes": (
        "the longest flight time is almost over",
        "land (COM_FLT_TIME_MAX)",
    ),
    "commander_max_flight_time_warning_seconds": (
        "the longest flight time is almost over",
        "land (COM_FLT_TIME_MAX)",
    ),
    "commander_failsafe_enter_low_flight_time_warn": ("little flight time left: return advised", ""),
    "commander_low_bat_shutdown": ("battery all but empty: the autopilot switches itself off", ""),
}
"""PX4's name of an event to what it means and what to do."""

NO_SETPOINTS = frozenset({"check_modes_offboard_signal", "check_modes_offboard_signal_lost"})
"""What PX4 says as long as nobody streams, and at the end of every flight."""

TOLD_ANYWAY = frozenset(
    {
        "failsafe_rc_override",
        "commander_rc_override",
        "commander_rc_lost",
        "commander_rc_loss_hold_no_failsafe",
        "commander_kill_sw_engaged",
        "commander_failsafe_enter_low_flight_time_warn",
        "commander_max_flight_time_warning_minutes",
        "commander_max_flight_time_warning_seconds",
        "check_estimator_gnss_fusion_stopped",
        "check_above_wind_limits_warning",
        "check_wind_too_high",
        "check_esc_over_temperature",
    }
)
"""What matters in flight though PX4 gives it a mild level."""
