"""Position, velocity and attitude loops of the simulated autopilot, cascaded as PX4's.  World ENU, body
FLU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.truth.sensors import Estimate

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
UNSET = math.nan
FREE: Vector = (UNSET, UNSET, UNSET)


@dataclass(frozen=True)
class RateSetpoint:
    """Normalised collective thrust and body rates (rad/s, FLU)."""

    thrust: float
    rates: Vector


@dataclass(frozen=True)
class AttitudeSetpoint:
    """Normalised collective thrust, attitude (body to world) and a rate of yaw to feed forward (rad/s, world
    z).
    """

    thrust: float
    quaternion: Quaternion
    yaw_rate: float = 0.0


@dataclass(frozen=True)
class MotionSetpoint:
    """Position (m), velocity (m/s), acceleration (m/s²) in the world and yaw (rad); NaN leaves a number
    free.
    """

    position: Vector = FREE
    velocity: Vector = FREE
    acceleration: Vector = FREE
    yaw: float = UNSET
    yaw_rate: float = UNSET

    def climbs_from(self, z: float) -> bool:
        """Whether it leads up from a height (m): only then does a vehicle leave the ground."""
        return self.position[2] > z + 0.1 or self.velocity[2] > 0.05 or self.acceleration[2] > 0.5


Setpoint = RateSetpoint | AttitudeSetpoint | MotionSetpoint


def yaw_of(q: Quaternion) -> float:
    """Yaw in rad of a body-to-world quaternion."""
    w, x, y, z = q
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def tilt_of(q: Quaternion) -> float:
    """Angle in rad between body z and world z."""
    _, x, y, _ = q
    return math.acos(min(max(1 - 2 * (x * x + y * y), -1.0), 1.0))


def attitude_of_thrust(force: Vector, yaw: float) -> Quaternion:
    """The attitude whose body z points along `force` (world) with body x in the vertical plane of `yaw`
    (rad).
    """
    length = math.sqrt(sum(f * f for f in force))
    zx, zy, zz = (f / length for f in force)
    # x = left cross z lies in the vertical plane of the heading, so that yaw is the Z-Y-X angle; y = z cross x.
    left_x, left_y = -math.sin(yaw), math.cos(yaw)
    xx, xy, xz = left_y * zz, -left_x * zz, left_x * zy - left_y * zx
    norm = math.sqrt(xx * xx + xy * xy + xz * xz)
    xx, xy, xz = xx / norm, xy / norm, xz / norm
    yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    w = math.sqrt(max(0.0, 1 + xx + yy + zz)) / 2
    if w > 1e-3:
        return w, (yz - zy) / (4 * w), (zx - xz) / (4 * w), (xy - yx) / (4 * w)
    # Half a turn away from the identity: about z for a vehicle that flies upright.
    return 0.0, 0.0, 0.0, 1.0


class PositionControl:
    """Position P, velocity PI, attitude P; integrals survive between calls, `reset()` forgets them."""

    def __init__(self, vehicle: Vehicle, parameters: Parameters) -> None:
        self._vehicle = vehicle
        self._parameters = parameters
        self._integral = [0.0, 0.0, 0.0]

    def reset(self) -> None:
        """Forget the integrals, as on the ground."""
        self._integral = [0.0, 0.0, 0.0]

    def attitude(self, setpoint: MotionSetpoint, now: Estimate, dt: float) -> AttitudeSetpoint:
        """The attitude and thrust that follow a motion setpoint."""
        get = self._parameters
        yaw_now = yaw_of(now.quaternion)
        wanted = [0.0, 0.0, 0.0]
        speed = [0.0, 0.0, 0.0]
        for i in range(3):
            gain = get["MPC_Z_P"] if i == 2 else get["MPC_XY_P"]
            feed, target = setpoint.velocity[i], setpoint.position[i]
            speed[i] = 0.0 if math.isnan(feed) else feed
            if not math.isnan(target):
                speed[i] += gain * (target - now.position[i])
        level = math.hypot(speed[0], speed[1])
        if level > get["MPC_XY_VEL_MAX"]:
            speed[0], speed[1] = (s * get["MPC_XY_VEL_MAX"] / level for s in speed[:2])
        speed[2] = min(max(speed[2], -get["MPC_Z_VEL_MAX_DN"]), get["MPC_Z_VEL_MAX_UP"])
        for i in range(3):
            axis = "Z" if i == 2 else "XY"
            feed = setpoint.acceleration[i]
            steered = not (math.isnan(setpoint.velocity[i]) and math.isnan(setpoint.position[i]))
            if steered:
                error = speed[i] - now.velocity[i]
                limit = 0.6 * GRAVITY if i == 2 else 4.0
                slope = get[f"MPC_{axis}_VEL_I_ACC"]
                self._integral[i] = min(max(self._integral[i] + slope * error * dt, -limit), limit)
                wanted[i] = get[f"MPC_{axis}_VEL_P_ACC"] * error + self._integral[i]
            if not math.isnan(feed):
                wanted[i] += feed
        up = max(wanted[2] + GRAVITY, 0.1 * GRAVITY)
        side = math.hypot(wanted[0], wanted[1])
        steepest = up * math.tan(math.radians(get["MPC_TILTMAX_AIR"]))
        if side > steepest:
            wanted[0], wanted[1] = wanted[0] * steepest / side, wanted[1] * steepest / side
        force = (wanted[0], wanted[1], up)
        yaw = yaw_now if math.isnan(setpoint.yaw) else setpoint.yaw
        yaw_rate = 0.0 if math.isnan(setpoint.yaw_rate) else setpoint.yaw_rate
        # The hover thrust is a parameter that the user may set; the vehicle's curve around it is the believed
        # one.
        command = self._vehicle.command(self._vehicle.mass * math.sqrt(sum(f * f for f in force)))
        command *= get["MPC_THR_HOVER"] / self._vehicle.hover_thrust
        thrust = min(max(command, get["MPC_THR_MIN"]), get["MPC_THR_MAX"])
        return AttitudeSetpoint(thrust, attitude_of_thrust(force, yaw), yaw_rate)

    def rates(self, setpoint: AttitudeSetpoint, q: Quaternion) -> Vector:
        """Body rates (rad/s, FLU) that turn attitude `q` to the setpoint's."""
        get = self._parameters
        w, x, y, z = q
        dw, dx, dy, dz = setpoint.quaternion
        # Error in the body: conj(q) times the wanted attitude.
        ew = w * dw + x * dx + y * dy + z * dz
        ex = w * dx - x * dw - y * dz + z * dy
        ey = w * dy + x * dz - y * dw - z * dx
        ez = w * dz - x * dy + y * dx - z * dw
        twice = 2.0 if ew >= 0 else -2.0
        limits = [math.radians(get[f"MC_{axis}RATE_MAX"]) for axis in ("ROLL", "PITCH", "YAW")]
        turn = setpoint.yaw_rate
        feed = (2 * (x * z - w * y) * turn, 2 * (y * z + w * x) * turn, (1 - 2 * (x * x + y * y)) * turn)
        gains = (get["MC_ROLL_P"], get["MC_PITCH_P"], get["MC_YAW_P"])
        p, q_rate, r = (
            min(max(gain * twice * e + f, -limit), limit)
            for gain, e, f, limit in zip(gains, (ex, ey, ez), feed, limits, strict=True)
        )
        return p, q_rate, r
