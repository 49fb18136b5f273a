"""A simulated flight as PX4 would log it: the topics and fields of each release, from 1.11 to today.

Layouts: the message definitions of PX4 at those releases, as far as a flight needs them.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from simulated import simulated
from ulog_writer import Written

from trueflight.models.flight import Flight
from trueflight.models.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd

BOOT = 20.0  # s on PX4's clock when the log starts
GROUND, CLIMB = 3.0, 3.0  # s before and after the flight
RELEASES = {"1.11": 0x010B00FF, "1.12": 0x010C00FF, "1.13": 0x010D00FF, "1.14": 0x010E00FF, "1.15": 0x010F00FF,
            "1.16": 0x011000FF, "1.17": 0x011100FF}  # fmt: skip
HOVER = 0.38


@dataclass(frozen=True)
class Flown:
    """What a vehicle did on PX4's clock `t` (M,): it stands, climbs, flies (`middle`), comes down, stands. ENU, FLU."""

    t: np.ndarray
    middle: slice
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray
    specific_force: np.ndarray
    thrust: np.ndarray
    body_rate_command: np.ndarray
    voltage: np.ndarray
    rotor_speed: np.ndarray
    armed: np.ndarray
    landed: np.ndarray

    def rows(self, rate: float) -> np.ndarray:
        """Rows of a topic that is logged at a rate (Hz)."""
        return np.arange(0, len(self.t), round(100 / rate))


@cache
def flown(seed: int = 3, kind: str = "circle") -> Flown:
    """A circle (or another trajectory) with rotor drag, between a takeoff and a landing."""
    flight = simulated(seed, "rotor_drag:0.4", kind=kind)
    ground, climb = round(100 * GROUND), round(100 * CLIMB)
    s = np.linspace(0.0, 1.0, climb, endpoint=False)
    rise, speed = 10 * s**3 - 15 * s**4 + 6 * s**5, (30 * s**2 - 60 * s**3 + 30 * s**4) / CLIMB
    push = (60 * s - 180 * s**2 + 120 * s**3) / CLIMB**2

    def ends(before: np.ndarray, column: np.ndarray, after: np.ndarray) -> np.ndarray:
        return np.concatenate([before, column, after])

    def still(value: np.ndarray, count: int) -> np.ndarray:
        return np.repeat(np.atleast_1d(value)[None], count, axis=0)

    def vertical(at: np.ndarray, heights: np.ndarray) -> np.ndarray:
        out = still(at, len(heights))
        out[:, 2] = heights
        return out

    first, last = flight.position[0], flight.position[-1]
    up = np.array([0.0, 0.0, 1.0])
    position = ends(
        np.concatenate([vertical(first, np.zeros(ground)), vertical(first, rise * first[2])]),
        flight.position,
        np.concatenate([vertical(last, (1 - rise) * last[2]), vertical(last, np.zeros(ground))]),
    )
    zero = np.zeros((ground, 3))
    velocity = ends(
        np.concatenate([zero, speed[:, None] * first[2] * up]), flight.velocity,
        np.concatenate([-speed[:, None] * last[2] * up, zero]),
    )  # fmt: skip
    felt = still(9.81 * up, ground)
    force = ends(
        np.concatenate([felt, (9.81 + push * first[2])[:, None] * up]), flight.specific_force,
        np.concatenate([(9.81 - push * last[2])[:, None] * up, felt]),
    )  # fmt: skip
    idle = np.zeros(ground)
    thrust = ends(
        np.concatenate([idle, HOVER * (1 + push * first[2] / 9.81)]), flight.thrust_command,
        np.concatenate([HOVER * (1 - push * last[2] / 9.81), idle]),
    )  # fmt: skip
    rest = ground + climb

    def around(column: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        return ends(still(before, rest), column, still(after, rest))

    q = flight.quaternion
    spin = flight.rotor_speed
    count = len(position)
    t = BOOT + 0.01 * np.arange(count)
    armed = (t > t[0] + 1.0) & (t < t[-1] - 1.0)
    landed = (t < t[0] + GROUND) | (t > t[-1] - GROUND)
    return Flown(
        t, slice(rest, rest + len(flight)), position, velocity, around(q, q[0], q[-1]),
        around(flight.angular_velocity, np.zeros(3), np.zeros(3)), force, thrust,
        around(flight.body_rate_command, np.zeros(3), np.zeros(3)),
        around(flight.battery_voltage[:, None], flight.battery_voltage[:1], flight.battery_voltage[-1:])[:, 0],
        around(spin, spin[0], spin[-1]), armed, landed,
    )  # fmt: skip


def still_later(one: Flown, seconds: float, ground: float) -> Flown:
    """The same flight, begun later and on higher ground (m)."""
    return replace(one, t=one.t + seconds, position=one.position + [0.0, 0.0, ground])


def log_of(release: str, one: Flown | None = None, *, leave_out: tuple[str, ...] = ()) -> Written:
    """The log that PX4 of a release writes of a flight, at rates of its default profile or faster."""
    one = one or flown()
    number = tuple(int(part) for part in release.split("."))
    log = Written(
        {"MPC_THR_HOVER": 0.4, "SYS_AUTOSTART": 4001, "MAV_TYPE": 2, "THR_MDL_FAC": 0.0, "MC_BAT_SCALE_EN": 0,
         "MC_ROLLRATE_P": 0.15, "MC_ROLLRATE_MAX": 220.0,
         ("BAT1_N_CELLS" if number >= (1, 12) else "BAT_N_CELLS"): 4},
        {"ver_hw": "PX4_FMU_V5", "ver_sw_release": RELEASES[release]},
    )  # fmt: skip
    if number >= (1, 14):
        log.parameters |= {"CA_ROTOR_COUNT": 4}
        for i, (x, y, km) in enumerate(
            ((0.09, 0.1, 0.05), (-0.08, -0.1, 0.05), (0.09, -0.1, -0.05), (-0.08, 0.1, -0.05))
        ):
            log.parameters |= {
                f"CA_ROTOR{i}_PX": x,
                f"CA_ROTOR{i}_PY": y,
                f"CA_ROTOR{i}_PZ": 0.01,
                f"CA_ROTOR{i}_KM": km,
            }
    add = {
        "vehicle_status": _status, "vehicle_land_detected": _land, "vehicle_attitude": _attitude,
        "vehicle_local_position": _position, "vehicle_odometry": _odometry, "sensor_combined": _sensors,
        "vehicle_angular_velocity": _rates, "vehicle_rates_setpoint": _rates_setpoint,
        "actuator_controls_0": _controls, "vehicle_thrust_setpoint": _thrust_setpoint,
        "actuator_motors": _motors, "trajectory_setpoint": _trajectory, "battery_status": _battery,
    }  # fmt: skip
    for name, write in add.items():
        if name not in leave_out:
            write(log, one, number)
    return log


def ned(vectors: np.ndarray) -> np.ndarray:
    return enu_from_ned(vectors)


def frd(vectors: np.ndarray) -> np.ndarray:
    return flu_from_frd(vectors)


def _sampled(
    one: Flown, rows: np.ndarray, number: tuple[int, ...], since: tuple[int, int]
) -> dict[str, tuple]:
    """From its release on a topic has the time of measurement, 2 ms before its publication here."""
    return {"timestamp_sample": ("Q", (1e6 * one.t[rows]).round().astype(int))} if number >= since else {}


def _published(one: Flown, rows: np.ndarray, number: tuple[int, ...], since: tuple[int, int]) -> np.ndarray:
    return one.t[rows] + (0.002 if number >= since else 0.0)


def _status(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    rows = one.rows(2)
    count = len(rows)
    log.add(
        "vehicle_status", one.t[rows], nav_state=("B", np.full(count, 14)),
        arming_state=("B", np.where(one.armed[rows], 2, 1)), system_type=("B", np.full(count, 2)),
        vehicle_type=("B", np.ones(count, int)), is_vtol=("?", np.zeros(count, bool)),
    )  # fmt: skip


def _land(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    rows = np.flatnonzero(np.diff(one.landed, prepend=not one.landed[0]))
    log.add(
        "vehicle_land_detected", one.t[rows], landed=("?", one.landed[rows]),
        maybe_landed=("?", one.landed[rows]), ground_contact=("?", one.landed[rows]),
    )  # fmt: skip


def _attitude(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    rows, since = one.rows(50), (1, 12)
    log.add(
        "vehicle_attitude", _published(one, rows, number, since), **_sampled(one, rows, number, since),
        q=("f", enu_flu_from_ned_frd(one.quaternion[rows])),
    )  # fmt: skip


def _position(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    rows, since = one.rows(50), (1, 12)
    position, velocity = ned(one.position[rows]), ned(one.velocity[rows])
    true = ("?", np.ones(len(rows), bool))
    fields = dict(
        zip(("x", "y", "z", "vx", "vy", "vz"), (("f", c) for c in [*position.T, *velocity.T]), strict=True)
    )
    counters = {n: ("B", np.zeros(len(rows), int)) for n in ("xy_reset_counter", "z_reset_counter", "vxy_reset_counter",
                                                             "vz_reset_counter")}  # fmt: skip
    log.add(
        "vehicle_local_position", _published(one, rows, number, since), **_sampled(one, rows, number, since),
        xy_valid=true, z_valid=true, v_xy_valid=true, v_z_valid=true, **fields, **counters,
    )  # fmt: skip


def _odometry(log: Written, one: Flown, number: tuple[int, ...], body: bool = False) -> None:
    from trueflight.models.frames import rotate_inverse

    rows = one.rows(50)
    position = ned(one.position[rows])
    velocity = (
        frd(rotate_inverse(one.quaternion[rows], one.velocity[rows])) if body else ned(one.velocity[rows])
    )
    q = ("f", enu_flu_from_ned_frd(one.quaternion[rows]))
    frame = ("B", np.full(len(rows), 3 if body else int(number >= (1, 14))))
    if number >= (1, 14):
        log.add("vehicle_odometry", one.t[rows], pose_frame=("B", np.ones(len(rows), int)), position=("f", position),
                q=q, velocity_frame=frame, velocity=("f", velocity))  # fmt: skip
    else:
        named = dict(
            zip(
                ("x", "y", "z", "vx", "vy", "vz"), (("f", c) for c in [*position.T, *velocity.T]), strict=True
            )
        )
        log.add("vehicle_odometry", one.t[rows], local_frame=("B", np.zeros(len(rows), int)), q=q, velocity_frame=frame,
                **named)  # fmt: skip


def _sensors(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    rows = one.rows(100)
    log.add("sensor_combined", one.t[rows], gyro_rad=("f", frd(one.angular_velocity[rows])),
            accelerometer_m_s2=("f", frd(one.specific_force[rows])))  # fmt: skip


def _rates(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    rows, since = one.rows(100), (1, 11)
    log.add("vehicle_angular_velocity", _published(one, rows, number, since), **_sampled(one, rows, number, since),
            xyz=("f", frd(one.angular_velocity[rows])))  # fmt: skip


def _rates_setpoint(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    rows = one.rows(50)
    wanted = frd(one.body_rate_command[rows])
    pull = np.zeros((len(rows), 3))
    pull[:, 2] = -one.thrust[rows]
    log.add("vehicle_rates_setpoint", one.t[rows], roll=("f", wanted[:, 0]), pitch=("f", wanted[:, 1]),
            yaw=("f", wanted[:, 2]), thrust_body=("f", pull))  # fmt: skip


def _controls(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    if number > (1, 13):
        return
    rows = one.rows(10 if number == (1, 11) else 20)
    control = np.zeros((len(rows), 8))
    control[:, 3] = one.thrust[rows]
    log.add("actuator_controls_0", one.t[rows], control=("f", control))


def _thrust_setpoint(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    if number < (1, 13):
        return
    rows, since = one.rows(50), (1, 13)
    xyz = np.zeros((len(rows), 3))
    xyz[:, 2] = -one.thrust[rows]
    log.add("vehicle_thrust_setpoint", _published(one, rows, number, since), **_sampled(one, rows, number, since),
            xyz=("f", xyz))  # fmt: skip


def motors(one: Flown, rows: np.ndarray) -> np.ndarray:
    """Four motor commands whose mean is the collective."""
    part = 0.05 * np.sin(np.arange(len(rows)) * 0.1)[:, None] * np.array([1.0, 1.0, -1.0, -1.0])
    return np.clip(one.thrust[rows][:, None] * (1.0 + part), 0.0, 1.0)


def _motors(log: Written, one: Flown, number: tuple[int, ...], rate: float = 10) -> None:
    if number < (1, 13):
        return
    rows = one.rows(rate)
    control = np.full((len(rows), 8 if number == (1, 13) else 12), np.nan)
    control[:, :4] = motors(one, rows)
    log.add("actuator_motors", one.t[rows], control=("f", control))


def _trajectory(log: Written, one: Flown, number: tuple[int, ...]) -> None:
    rows = one.rows(5)
    wanted = ned(one.position[rows])
    if number >= (1, 14):
        log.add("trajectory_setpoint", one.t[rows], position=("f", wanted))
    else:
        log.add(
            "trajectory_setpoint",
            one.t[rows],
            x=("f", wanted[:, 0]),
            y=("f", wanted[:, 1]),
            z=("f", wanted[:, 2]),
        )


def _battery(
    log: Written, one: Flown, number: tuple[int, ...], instance: int = 0, current: float = 10.0
) -> None:
    rows = one.rows(5)
    count = len(rows)
    log.add("battery_status", one.t[rows], instance, connected=("?", np.ones(count, bool)),
            voltage_v=("f", one.voltage[rows]), current_a=("f", np.full(count, current)),
            scale=("f", np.ones(count)))  # fmt: skip


def middle_of(flight: Flight, one: Flown) -> tuple[np.ndarray, slice]:
    """Rows of a flight that was read, and of what was flown, at the same times."""
    start = one.t[one.middle][0] - one.t[0]
    rows = np.flatnonzero((flight.t > start + 0.1) & (flight.t < start + 0.01 * len(one.t[one.middle]) - 0.1))
    first = round(100 * flight.t[rows[0]])
    return rows, slice(first, first + len(rows))
