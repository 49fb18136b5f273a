"""Every reason to end a flight, or to send nothing in it, by what one tick has seen.

Nothing here acts: `companion.phases` does what a `Stop` says. What stands against a flight before it begins is in
`companion.readiness`, what is seen without odometry in `companion.sortie`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from trueflight.companion.latest import Latest
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import LANDING, Outcome, Vector
from trueflight.companion.resets import Reset
from trueflight.models.reference import Trajectory

LAND, RETURN, SILENCE, TELL = "land", "return", "silence", "tell"
"""What a `Stop` asks for: land here, land at home, send nothing any more; `TELL` alone ends nothing."""
_TUMBLED = 1.4
"""rad of tilt, twice what the cascade may ask for: a vehicle there for longer than `_TUMBLING` s has crashed, or
nothing that a linear design sends can bring it back."""
_TUMBLING = 0.5
_LEAST_COSINE = math.cos(_TUMBLED)
_MODE_UNKNOWN_US = 2_500_000
"""us of the vehicle's clock without a word of mode and arming after which nothing is sent until they are told again.

PX4 sends HEARTBEAT once a second whatever is asked for, and CURRENT_MODE (from 1.15 on) twice a second and at once when
the mode changes: two heartbeats may be lost."""


@dataclass(frozen=True)
class Safety:
    """Where a flight may go and when it must end.

    The fence is a cylinder around home: `fence_radius`, `fence_height` in m. `takeoff_voltage` and
    `land_voltage` are shares of the nominal voltage; the latter ends a flight when it lasts
    `battery_patience` s. `odometry_gap` s of the vehicle's clock without odometry end a flight, as do a position that
    moves `jump` m otherwise than its velocity between two messages, a distance of `lost` m from the reference and an
    estimator that knows its horizontal position to no better than `position_accuracy` m. Where the estimator tells of a
    reset, up to `reset` m and `reset_turn` rad of heading are taken for a better view of the same place, and the flight
    goes on from there. A flight lands when for `late_patience` s setpoints answer to odometry older than `late` s; no
    setpoint leaves that answers to odometry older than `stale` s: the flight falls silent then.
    `climb_speed` and `transfer_speed` in m/s.
    """

    fence_radius: float = 10.0
    fence_height: float = 8.0
    takeoff_voltage: float = 0.90
    land_voltage: float = 0.80
    battery_patience: float = 2.0
    odometry_gap: float = 0.25
    jump: float = 0.3
    reset: float = 1.0
    reset_turn: float = 0.35
    late: float = 0.1
    late_patience: float = 0.3
    stale: float = 0.5
    lost: float = 4.0
    position_accuracy: float = 2.0
    climb_speed: float = 0.8
    transfer_speed: float = 1.5

    def check_trajectory(self, trajectory: Trajectory) -> str:
        """'' where the whole reference lies inside the fence and above ground, otherwise the reason."""
        (x0, y0, z0), (x1, y1, z1) = trajectory.bounds
        radius = max(math.hypot(x, y) for x in (x0, x1) for y in (y0, y1))
        if z0 < 0.05:
            return f"it goes down to {z0:.2f} m above ground; keep it above 0.05 m"
        if z1 > self.fence_height:
            return f"it climbs to {z1:.1f} m, the fence ends at {self.fence_height:g} m"
        if radius > self.fence_radius:
            return f"it may go {radius:.1f} m from home, the fence ends at {self.fence_radius:g} m"
        return ""


class Stop(NamedTuple):
    """A reason to end a flight: what to do (`LAND`, `RETURN`, `SILENCE`, `TELL`), the event's kind, why in words."""

    act: str
    kind: str
    text: str


def motors_cut(latest: Latest) -> Stop | None:
    """The kill switch, or a failsafe that cut the motors; the vehicle may call itself armed still."""
    if latest.killed or latest.flight_mode == "TERMINATION":
        return Stop(SILENCE, "kill_switch", f"the motors were cut{_because(latest)}: silent")
    return None


def taken_over(latest: Latest) -> Stop | None:
    """Any mode but Offboard: the pilot wins, and so do a ground station and the autopilot's failsafes."""
    if latest.flight_mode == "OFFBOARD":
        return None
    mode, why = latest.flight_mode, _because(latest)
    if latest.failsafe:
        return Stop(SILENCE, "failsafe", f"{mode} was chosen by the autopilot's failsafe{why}: silent")
    return Stop(SILENCE, "pilot_takeover", f"{mode} was chosen by the pilot or a ground station{why}: silent")


class ReasonsToStop:
    """Looks at every tick of a flight; belongs to the control thread. Times in s of the vehicle's clock.

    `reset` is the last one of the estimate that was carried over, for the next `look`.
    """

    def __init__(self, safety: Safety, nominal_voltage: float) -> None:
        self._safety, self._nominal_voltage = safety, nominal_voltage
        self.begin()

    def begin(self) -> None:
        """A new flight: nothing has lasted for any time yet."""
        self.reset: Reset | None = None
        self._tumbled_since = self._late_since = self._low_since = math.inf
        self._heard_again = 0  # us: when odometry came again after a gap

    def hear(self, odometry: Odometry, interval: float) -> None:
        """Before a tick decides: odometry came, `interval` s after the one before, with those that were overtaken."""
        if interval / (1 + odometry.overtaken) > self._safety.odometry_gap:
            self._heard_again = odometry.vehicle_time_us

    def mode_unknown(self, odometry: Odometry, latest: Latest) -> bool:
        """Whether somebody else may fly by now: mode and arming were not told lately, or not since a gap."""
        told = latest.mode_time_us
        since = max(odometry.vehicle_time_us - _MODE_UNKNOWN_US, self._heard_again)
        return told is not None and told < since

    def stale(self, age: float) -> Stop | None:
        """What is known of the vehicle is too old to send anything by, and with it who flies it."""
        most = self._safety.stale
        if age <= most:
            return None
        return Stop(
            SILENCE,
            "stale",
            f"the odometry to answer to is {age:.2f} s old, {most:g} s are allowed: silent",
        )

    def look(
        self,
        odometry: Odometry,
        out: Outcome,
        latest: Latest,
        reference: Sequence[float],
        disagrees: str,
        land_asked: bool,
    ) -> tuple[Stop, ...]:
        """What speaks against flying on after a tick whose setpoint has left; only the last one ends the flight.

        `reference` is where the vehicle should be (m, home frame), `disagrees` how odometry and sensors do, '' where
        they agree. Once the autopilot has been asked to land (`land_asked`) only a tumbling vehicle matters.
        """
        if latest.flight_mode != "OFFBOARD":
            return ()
        now = 1e-6 * odometry.vehicle_time_us
        tumbled = self._tumbled(odometry, now)
        if tumbled is not None:
            return (tumbled,)
        reset, self.reset = self.reset, None
        if land_asked:
            return ()
        gap = self._gap(odometry, out.interval)
        if gap is not None and gap.act != TELL:
            return (gap,)
        told = () if gap is None else (gap,)
        if reset is not None:
            jump = self._judged(reset)
            told = (*told, jump)
            if jump.act != TELL:
                return told
        stop = (
            (Stop(LAND, "odometry_disagrees", disagrees) if disagrees else None)
            or self._late(max(odometry.age, out.age), out.age, now)
            or self._astray(out.position, reference)
            or self._battery_low(latest.battery_voltage, out.phase, now)
        )
        return told if stop is None else (*told, stop)

    def _tumbled(self, odometry: Odometry, now: float) -> Stop | None:
        _, x, y, _ = odometry.quaternion
        tumbled = 1.0 - 2.0 * (x * x + y * y) < _LEAST_COSINE  # body z against the vertical
        self._tumbled_since = min(self._tumbled_since, now) if tumbled else math.inf
        if now - self._tumbled_since > _TUMBLING:
            text = f"tilted by more than {math.degrees(_TUMBLED):.0f} degrees: silent"
            return Stop(SILENCE, "tumbled", text)
        return None

    def _gap(self, odometry: Odometry, interval: float) -> Stop | None:
        most = self._safety.odometry_gap
        gap = interval / (1 + odometry.overtaken)  # those overtaken have arrived
        if gap > most or interval < 0.0:
            what = f"missing for {gap:.2f} s" if interval > 0.0 else "going back in time"
            return Stop(LAND, "odometry_gap", f"odometry was {what}")
        if interval > most:
            text = (
                f"this machine stood still for {interval:.2f} s; {odometry.overtaken} messages were overtaken"
            )
            return Stop(TELL, "stalled", text)
        return None

    def _judged(self, reset: Reset) -> Stop:
        """A reset of the estimate: told always; home and reference have been carried over already."""
        safety = self._safety
        if not reset.told:
            kind = "position_jump" if reset.distance > safety.jump else "heading_jump"
            return Stop(LAND, kind, f"{reset.text}, and the estimator told of no reset")
        text = f"the estimator was reset: {reset.text}"
        if reset.distance > safety.reset or abs(reset.turned) > safety.reset_turn:
            return Stop(LAND, "estimator_reset", text)
        carried = "; home and reference are carried over" if reset.moves else ""
        return Stop(TELL, "estimator_reset", text + carried)

    def _late(self, oldest: float, age: float, now: float) -> Stop | None:
        safety = self._safety
        self._late_since = min(self._late_since, now) if oldest > safety.late else math.inf
        if now - self._late_since > safety.late_patience:
            text = f"setpoints answer to odometry that is {age:.2f} s old; {safety.late:g} s are allowed"
            return Stop(LAND, "late", text)
        return None

    def _astray(self, position: Vector, reference: Sequence[float]) -> Stop | None:
        safety = self._safety
        x, y, z = position
        if math.hypot(x, y) > safety.fence_radius or z > safety.fence_height:
            return Stop(LAND, "geofence", "outside the geofence")
        if math.dist(position, reference) > safety.lost:
            return Stop(LAND, "lost", f"more than {safety.lost:g} m from the reference")
        return None

    def _battery_low(self, voltage: float, phase: str, now: float) -> Stop | None:
        safety = self._safety
        low = 0.0 < voltage < safety.land_voltage * self._nominal_voltage
        self._low_since = min(self._low_since, now) if low else math.inf
        if now - self._low_since > safety.battery_patience and phase != LANDING:
            return Stop(RETURN, "battery_low", f"battery at {voltage:.1f} V")
        return None


def _because(latest: Latest) -> str:
    """What the autopilot told just now, in brackets."""
    return f" ({latest.why})" if latest.why else ""
