"""Do commands and vehicle agree? Thrust lifts, motors follow the thrust, rotors their motors, and motors turn it.

How much they do is what a diagnosis finds out; here only sign and order are looked at, by the correlation of what
changes within seconds: a battery that empties, a payload or a thrust curve leave it as it is.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np

from trueflight.groundstation.reading.faults import Columns
from trueflight.groundstation.reading.sliding import moving_mean
from trueflight.groundstation.reading.uniform import segments, slopes
from trueflight.models.flight import Check
from trueflight.models.frames import rotate
from trueflight.models.vehicle import GRAVITY, Vehicle

LIFT = "thrust and vertical acceleration"
MOTORS = "motor commands and thrust"
ROTORS = "rotor speeds and motor commands"
TORQUE = "motor commands and rotation"
BATTERY = "battery voltage and thrust"

AGAINST, LITTLE = -0.7, 0.3
"""Correlation below which two columns move against each other, and below which one does not follow the other."""
FOLLOWS = 0.6
"""Correlation from which on another order of the columns is believed, where theirs has less than half of it."""
FAST, SLOW = 0.1, 4.0
"""s over which columns are smoothed, and over which a mean is taken away."""
SAGS = (1.0, 10.0)
"""s over which voltage and thrust are smoothed, and over which a mean is taken away."""
INDEPENDENT, SURE = 1.0, 3.0
"""s after which a change says something new, and standard deviations (of Fisher's z) from which on one is believed."""
DIFFERENTIATED = 0.5
"""s over which an acceleration is smoothed that was differentiated from the velocity."""
LIFTS, TURNS = 0.3, 1.0
"""m/s² and rad/s² from which on changes of the acceleration are motion, not vibration."""
STEERED = 0.003
"""Of full throttle; smaller changes of a motor tell nothing: some logs hold 8 bits."""
UNMOVED, MEANT = 0.2, 0.5
"""Share of what the thrust should bring below which it surely lifts nothing, and m/s² from which on it should bring
something: a hover thrust wrong by a factor of three leaves more."""
COVERED = 0.5
"""Share of what is felt below which the thrust's changes are covered by noise, gusts and manoeuvres."""
LATEST = 0.15
"""s; motors, rate loop and filters delay what a command brings by no more."""
ENOUGH = 5.0
"""s in the air without which nothing is said."""


def actuation_checks(
    t: np.ndarray, columns: Columns, flying: np.ndarray, vehicle: Vehicle
) -> tuple[Check, ...]:
    """Checks of commands and rotors of a flight on the even clock `t` (N,); `columns` (N, ...) by attribute of
    `Flight`, `flying` (N,)."""
    if np.sum(flying) * float(np.median(np.diff(t))) < ENOUGH:
        return ()
    changes = _Changes(t, flying)
    return tuple(
        check
        for part in (_lift, _motors, _rotors, _torque, _battery)
        for check in part(changes, columns, vehicle)
    )


class _Changes:
    """Changes of columns over `FAST` to `SLOW` seconds, at the rows in the air."""

    def __init__(self, t: np.ndarray, flying: np.ndarray) -> None:
        self.t, self.flying = t, flying
        self.dt, self.parts = float(np.median(np.diff(t))), segments(t)
        self.seconds = float(np.sum(flying)) * self.dt

    def of(self, column: np.ndarray, fast: float = FAST, slow: float = SLOW) -> np.ndarray:
        """The changes of a column (N,) or (N, k) at the rows in the air."""
        return self.late(column, [0.0], fast, slow)[0]

    def away_from_the_ground(self, slow: float = SLOW) -> np.ndarray:
        """Which of the rows in the air have changes that know nothing of the ground, where thrust lifts nothing."""
        aloft = np.zeros(len(self.t), dtype=bool)
        for part in self.parts:
            width = max(1, round((slow + 2.0 * LATEST) / self.dt))
            aloft[part] = moving_mean(self.flying[part].astype(float), width) > 1.0 - 0.5 / width
        return aloft[self.flying]

    def late(
        self,
        column: np.ndarray,
        delays: Iterable[float] | None = None,
        fast: float = FAST,
        slow: float = SLOW,
    ) -> list[np.ndarray]:
        """The changes of a column read with each of the `delays` (s), those to be tried without them, at the rows in
        the air."""
        width, wide = (max(1, round(seconds / self.dt)) for seconds in (fast, slow))
        changes = np.full(column.shape, np.nan)
        for part in self.parts:
            smooth = moving_mean(column[part], width)
            changes[part] = smooth - moving_mean(column[part], max(width, wide))
        found = []
        for delay in np.arange(0.0, LATEST + 1e-9, max(0.02, self.dt)) if delays is None else delays:
            shift, out = round(delay / self.dt), np.full(column.shape, np.nan)
            for part in self.parts:
                if part.stop - part.start > 2 * shift + width:
                    out[part.start : part.stop - shift] = changes[part.start + shift : part.stop]
            found.append(out[self.flying])
        return found


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Pearson's correlation of two (M,) over the rows that both have; 0 where one does not change."""
    both = np.isfinite(one) & np.isfinite(other)
    a, b = one[both], other[both]
    if len(a) < 10 or np.std(a) < 1e-12 or np.std(b) < 1e-12:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def _strongest(correlations: list[float]) -> float:
    return max(correlations, key=abs)


def _lift(changes: _Changes, columns: Columns, vehicle: Vehicle) -> Iterator[Check]:
    """Thrust against what the accelerometer feels along body z, or against climb and tilt."""
    if "thrust_command" not in columns:
        return
    force, mirrored = (_felt_along_z(changes.t, columns, sign) for sign in (1.0, -1.0))
    if force is None or mirrored is None:
        return
    fast = FAST if "specific_force" in columns else DIFFERENTIATED
    thrust = changes.of(columns["thrust_command"], fast=fast) * GRAVITY / max(vehicle.hover_thrust, 1e-3)
    felt = changes.late(force, fast=fast)
    follows = max(_correlation(thrust, late) for late in felt)
    turned = max(_correlation(thrust, late) for late in changes.late(mirrored, fast=fast))
    what = "the accelerometer's z" if "specific_force" in columns else "the climb"
    left = 1.0 - follows if follows < 0 else 1.0 - follows**2
    sure = (
        float(np.arctanh(min(turned, 0.999))) * np.sqrt(max(changes.seconds / INDEPENDENT - 3.0, 0.0)) > SURE
    )
    covered = np.nanstd(thrust) < max(LIFTS, COVERED * np.nanstd(felt[0]))
    if sure and turned > FOLLOWS and follows < 0.5 * turned:
        names = ("specific_force",) if "specific_force" in columns else ("position", "velocity")
        mapping = "\n".join(f'{n}.axes = ["x", "y", "-z"]' for n in names if n in columns)
        text = f"{what} falls where the thrust rises: z or the thrust has the wrong sign"
        yield Check(LIFT, "contradicts", left, text, mapping)
    elif covered and follows < FOLLOWS:
        yield Check(LIFT, "cannot tell", float("nan"), "the thrust changes too little to compare them")
    elif follows < LITTLE and _lifts_nothing(changes, thrust, felt):
        text = (
            f"{what} changes by {np.nanstd(felt[0]):.2g} m/s² and knows nothing of the thrust, which should change it "
            f"by {np.nanstd(thrust):.2g}: on the ground, held, or without propellers"
        )
        yield Check(LIFT, "contradicts", left, text)
    elif follows < LITTLE:
        text = f"{what} hardly follows the thrust command (correlation {follows:.2f}): what is said of thrust is weak"
        yield Check(LIFT, "weak", left, text)
    else:
        yield Check(LIFT, "agrees", left)


def _lifts_nothing(changes: _Changes, thrust: np.ndarray, felt: list[np.ndarray]) -> bool:
    """Whether what the thrust (M,) should bring is surely not in what is felt (M,), of several delays."""
    aloft = changes.away_from_the_ground()
    seconds = float(aloft.sum()) * changes.dt
    if seconds < ENOUGH:
        return False
    meant, late = thrust[aloft], [one[aloft] for one in felt]
    if not np.nanstd(meant) > MEANT:
        return False
    follows = max(_correlation(meant, one) for one in late)
    most = follows + SURE / np.sqrt(max(seconds / INDEPENDENT - 3.0, 1.0))
    return bool(np.nanstd(late[0]) / np.nanstd(meant) * most < UNMOVED)


def _felt_along_z(t: np.ndarray, columns: Columns, sign: float) -> np.ndarray | None:
    """Specific force along body z (N,), measured, or what climb and tilt tell of it, if z of the columns points up
    (`sign` 1) or down (-1); None where neither is known."""
    if (force := columns.get("specific_force")) is not None:
        return np.asarray(sign * force[:, 2])
    v, q = columns.get("velocity"), columns.get("quaternion")
    if v is None or q is None:
        return None
    up = rotate(q, np.tile([0.0, 0.0, 1.0], (len(q), 1)))[:, 2]
    return np.asarray((sign * slopes(t, v)[:, 2] + GRAVITY) / np.maximum(up, 0.1))


def _motors(changes: _Changes, columns: Columns, _vehicle: Vehicle) -> Iterator[Check]:
    """The mean of the motors against the collective."""
    motors, thrust = columns.get("motor_command"), columns.get("thrust_command")
    if motors is None or thrust is None or np.array_equal(thrust, motors.mean(axis=1)):
        return
    mean, collective = changes.of(motors.mean(axis=1)), changes.of(thrust)
    if min(np.nanstd(mean), np.nanstd(collective)) < STEERED:
        yield Check(MOTORS, "cannot tell", float("nan"), "the thrust changes too little to compare them")
        return
    follows = _strongest([_correlation(collective, late) for late in changes.late(motors.mean(axis=1))])
    if follows < LITTLE:
        text = (
            f"the motors do not follow the thrust command (correlation {follows:.2f}): two vehicles' columns?"
        )
        yield Check(MOTORS, "contradicts" if follows < AGAINST else "weak", 1.0 - follows, text)
    else:
        yield Check(MOTORS, "agrees", 1.0 - follows**2)


def _rotors(changes: _Changes, columns: Columns, _vehicle: Vehicle) -> Iterator[Check]:
    """Each rotor against its motor, without what all have in common."""
    motors, speeds = columns.get("motor_command"), columns.get("rotor_speed")
    if motors is None or speeds is None or motors.shape != speeds.shape:
        return
    commanded = changes.of(motors - motors.mean(axis=1, keepdims=True))
    moving = np.nanstd(commanded, axis=0)
    if np.min(moving) < STEERED:
        yield Check(ROTORS, "cannot tell", float("nan"), "the motors differ too little to compare them")
        return
    apart = speeds - speeds.mean(axis=1, keepdims=True)
    at = changes.late(apart)
    count = motors.shape[1]
    table = np.array(
        [
            [max(_correlation(commanded[:, m], spun[:, r]) for spun in at) for r in range(count)]
            for m in range(count)
        ]
    )
    yield _ordered(ROTORS, table, "rotor_speed", "motor command")


def _ordered(name: str, table: np.ndarray, what: str, whose: str) -> Check:
    """Which order fits a table of correlations (k, k) of what is commanded (rows) with what follows (columns)."""
    from scipy.optimize import linear_sum_assignment

    rows, order = linear_sum_assignment(-table)
    own, best = float(np.mean(np.diag(table))), float(np.mean(table[rows, order]))
    left = 1.0 - own if own < 0 else 1.0 - own**2
    if best > FOLLOWS and own < 0.5 * best:
        listed = ", ".join(f"{what}_{k + 1}" for k in order)
        return Check(
            name, "contradicts", left, f"{whose}s 1, 2, ... are followed by {listed}: the order differs"
        )
    if own < LITTLE:
        return Check(name, "weak", left, f"{what} does not follow the {whose}s (correlation {own:.2f})")
    return Check(name, "agrees", left)


def _torque(changes: _Changes, columns: Columns, vehicle: Vehicle) -> Iterator[Check]:
    """The motors' differences about body x and y against the angular acceleration, by the rotors' places."""
    motors, rate = columns.get("motor_command"), columns.get("angular_velocity")
    places = np.array(vehicle.rotor_positions, dtype=float)
    if motors is None or rate is None or len(places) != motors.shape[1] or len(places) > 4:
        return
    arms = np.stack([places[:, 1], -places[:, 0]], axis=1)  # of a force along z: torque about x, y
    turning = slopes(changes.t, rate[:, :2])
    commanded = changes.of(motors, slow=1.0) @ arms
    still = np.min(np.nanstd(commanded, axis=0)) < STEERED * np.max(np.abs(arms))
    if still or np.min(np.nanstd(changes.of(turning, slow=1.0), axis=0)) < TURNS:
        yield Check(TORQUE, "cannot tell", float("nan"), "the vehicle turns too little to compare them")
        return
    at = changes.late(turning, slow=1.0)

    def follows(order: tuple[int, ...]) -> float:
        wanted = (
            commanded if order == tuple(range(len(places))) else changes.of(motors[:, order], slow=1.0) @ arms
        )
        return min(max(_correlation(wanted[:, k], turned[:, k]) for turned in at) for k in range(2))

    own = follows(tuple(range(len(places))))
    left = 1.0 - own if own < 0 else 1.0 - own**2
    best, order = max((follows(order), order) for order in itertools.permutations(range(len(places))))
    if best > FOLLOWS and own < 0.5 * best:
        listed = ", ".join(f"motor_command_{k + 1}" for k in order)
        text = (
            f"the vehicle turns as if its rotors 1, 2, ... were {listed}: motors and rotor_positions of the vehicle "
            "file are numbered differently"
        )
        yield Check(TORQUE, "contradicts", left, text)
    elif own < LITTLE:
        text = f"the vehicle does not turn as motors and rotor_positions say (correlation {own:.2f})"
        yield Check(TORQUE, "weak", left, text)
    else:
        yield Check(TORQUE, "agrees", left)


def _battery(changes: _Changes, columns: Columns, _vehicle: Vehicle) -> Iterator[Check]:
    """A battery's voltage falls where the thrust rises."""
    volts, thrust = columns.get("battery_voltage"), columns.get("thrust_command")
    if volts is None or thrust is None:
        return
    flown = volts[changes.flying]
    if np.ptp(flown) == 0.0:
        text = f"the battery voltage is {flown[0]:.2f} V from first to last: what a battery does cannot be judged"
        yield Check(BATTERY, "cannot tell", float("nan"), text)
        return
    fast, slow = SAGS
    rises = _correlation(changes.of(thrust, fast=fast, slow=slow), changes.of(volts, fast=fast, slow=slow))
    sure = float(np.arctanh(min(abs(rises), 0.999))) * np.sqrt(max(changes.seconds / slow - 3.0, 0.0)) > SURE
    if not sure:
        yield Check(BATTERY, "cannot tell", float("nan"), "the voltage changes too little to compare them")
    elif rises > 0.0:
        text = f"the battery voltage rises with the thrust (correlation {rises:.2f}): not its own?"
        yield Check(BATTERY, "weak", 1.0 + rises, text)
    else:
        yield Check(BATTERY, "agrees", 1.0 - rises**2)
