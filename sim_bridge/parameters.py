"""The parameters that the simulated autopilot has, typed as PX4's are."""

from __future__ import annotations

from dataclasses import dataclass

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle


@dataclass(frozen=True)
class Parameter:
    """A parameter's default, whose Python type is its type on the wire (int: INT32, float: REAL32), and its
    limits.
    """

    default: int | float
    low: float
    high: float


_TABLE: dict[str, Parameter] = {
    "BAT_CRIT_THR": Parameter(0.07, 0.05, 0.5),
    "CBRK_SUPPLY_CHK": Parameter(0, 0, 894281),
    "COM_ARM_WO_GPS": Parameter(1, 0, 2),
    "COM_DISARM_LAND": Parameter(2.0, -1.0, 20.0),  # s
    "COM_DISARM_PRFLT": Parameter(10.0, -1.0, 60.0),  # s
    "COM_FLTMODE1": Parameter(-1, -1, 15),
    "COM_LOW_BAT_ACT": Parameter(0, 0, 3),
    "COM_OBL_RC_ACT": Parameter(0, -1, 7),
    "COM_OF_LOSS_T": Parameter(1.0, 0.0, 60.0),  # s
    "COM_RCL_EXCEPT": Parameter(0, 0, 31),
    "COM_RC_IN_MODE": Parameter(1, 0, 4),
    "COM_RC_OVERRIDE": Parameter(1, 0, 3),
    "EKF2_GPS_CTRL": Parameter(7, 0, 15),  # 0: no position at all, as the stand-in has no other source
    "EKF2_PREDICT_US": Parameter(2000, 1000, 20000),
    "GF_ACTION": Parameter(2, 0, 5),
    "GF_MAX_HOR_DIST": Parameter(0.0, 0.0, 10000.0),  # m
    "GF_MAX_VER_DIST": Parameter(0.0, 0.0, 10000.0),  # m
    "MAV_COMP_ID": Parameter(1, 1, 250),
    "MAV_SYS_ID": Parameter(1, 1, 250),
    "MAV_TYPE": Parameter(2, 0, 22),
    "MC_PITCHRATE_MAX": Parameter(220.0, 0.0, 1800.0),  # deg/s
    "MC_PITCH_P": Parameter(6.5, 0.0, 12.0),
    "MC_ROLLRATE_MAX": Parameter(220.0, 0.0, 1800.0),
    "MC_ROLL_P": Parameter(6.5, 0.0, 12.0),
    "MC_YAWRATE_MAX": Parameter(200.0, 0.0, 1800.0),
    "MC_YAW_P": Parameter(2.8, 0.0, 5.0),
    "MIS_TAKEOFF_ALT": Parameter(2.5, 0.0, 80.0),  # m
    "MPC_LAND_SPEED": Parameter(0.7, 0.1, 3.0),  # m/s
    "MPC_THR_HOVER": Parameter(0.5, 0.01, 0.98),
    "MPC_THR_MAX": Parameter(1.0, 0.0, 1.0),
    "MPC_THR_MIN": Parameter(0.12, 0.01, 0.5),
    "MPC_TILTMAX_AIR": Parameter(45.0, 20.0, 89.0),  # deg
    "MPC_TKO_SPEED": Parameter(1.5, 0.5, 5.0),
    "MPC_XY_P": Parameter(0.95, 0.0, 2.0),
    "MPC_XY_VEL_I_ACC": Parameter(0.4, 0.0, 60.0),
    "MPC_XY_VEL_MAX": Parameter(12.0, 0.0, 20.0),
    "MPC_XY_VEL_P_ACC": Parameter(1.8, 1.2, 5.0),
    "MPC_Z_P": Parameter(1.0, 0.1, 1.5),
    "MPC_Z_VEL_I_ACC": Parameter(2.0, 0.2, 3.0),
    "MPC_Z_VEL_MAX_DN": Parameter(1.5, 0.5, 4.0),
    "MPC_Z_VEL_MAX_UP": Parameter(3.0, 0.5, 8.0),
    "MPC_Z_VEL_P_ACC": Parameter(4.0, 2.0, 15.0),
    "NAV_RCL_ACT": Parameter(2, 0, 6),
    "RTL_RETURN_ALT": Parameter(5.0, 0.0, 100.0),
    "SYS_AUTOSTART": Parameter(4001, 0, 9999999),
    "SYS_HAS_GPS": Parameter(1, 0, 1),
    "THR_MDL_FAC": Parameter(0.0, 0.0, 1.0),
}


class Parameters:
    """The values, by name and in the order of the list (alphabetical, as PX4 sends them)."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._values: dict[str, int | float] = {name: entry.default for name, entry in sorted(_TABLE.items())}
        self._values["MPC_THR_HOVER"] = vehicle.hover_thrust
        self.names = list(self._values)

    def __getitem__(self, name: str) -> int | float:
        return self._values[name]

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __len__(self) -> int:
        return len(self._values)

    def index(self, name: str) -> int:
        """Place in the list."""
        return self.names.index(name)

    def is_integer(self, name: str) -> bool:
        """Whether the parameter is an INT32 (else REAL32)."""
        return isinstance(_TABLE[name].default, int)

    def set(self, name: str, value: int | float) -> bool:
        """Set a value of the parameter's own type; False, and no change, for another type or out of range."""
        entry = _TABLE[name]
        if isinstance(value, int) is not self.is_integer(name) or not entry.low <= value <= entry.high:
            return False
        self._values[name] = value
        return True

    def set_text(self, assignment: str) -> None:
        """Set from `NAME=VALUE` of a command line or configuration; raises `InputError`."""
        name, equals, text = assignment.partition("=")
        name = name.strip()
        if not equals or name not in self._values:
            raise InputError(f"--param {assignment}: write NAME=VALUE with one of {', '.join(self.names)}")
        try:
            value = int(text) if self.is_integer(name) else float(text)
        except ValueError:
            kind = "a whole number" if self.is_integer(name) else "a number"
            raise InputError(f"--param {assignment}: {name} is {kind}, '{text}' is not") from None
        if not self.set(name, value):
            entry = _TABLE[name]
            raise InputError(f"--param {assignment}: {name} must be {entry.low:g} to {entry.high:g}")
