"""What stands against a mission that starts now: autopilot, battery, record, position, odometry, rates."""

from __future__ import annotations

import time

from trueflight.companion.flight import FlightStateMachine
from trueflight.companion.message_rates import Rates, link_too_slow, odometry_too_low
from trueflight.companion.outcome import IDLE
from trueflight.companion.pose import PoseFeed
from trueflight.companion.records import Records
from trueflight.companion.stopping import Safety
from trueflight.companion.vehicle_link import VehicleLink
from trueflight.models.vehicle import Vehicle

_SILENT = 3.0  # s without a heartbeat
_LEAST_MODE_RATE = 0.4  # Hz: PX4 1.14 gives 1 whatever is asked for (HEARTBEAT alone), later ones 3
_MODE_MEASURED = 1.5  # s of measuring below which so rare a message may well be missing


class Readiness:
    """Judges by what the link tells; asks for nothing and never blocks. Any thread.

    `rates` are what was measured last, `pose` is the feed of mocap poses where there is one; whoever measures and opens
    them sets them. `rate` is how many setpoints a second are wanted.
    """

    def __init__(
        self,
        link: VehicleLink,
        flight: FlightStateMachine,
        records: Records,
        safety: Safety,
        vehicle: Vehicle,
        rate: float,
    ) -> None:
        self.rates: Rates | None = None
        self.pose: PoseFeed | None = None
        self._link, self._flight, self._records = link, flight, records
        self._safety, self._vehicle, self._rate = safety, vehicle, rate

    def why_not(self) -> str:
        """'' where a mission could start now, otherwise the reason."""
        if self._flight.phase != IDLE:
            return f"a flight is under way ({self._flight.phase})"
        latest = self._link.latest
        if time.monotonic() - latest.heartbeat > _SILENT:
            return "the autopilot is silent"
        if latest.armed:
            return "the vehicle is armed by somebody else"
        low = self._safety.takeoff_voltage * self._vehicle.nominal_voltage
        if 0.0 < latest.battery_voltage < low:
            told = latest.batteries
            which = f" ({told.words}; choose one with --battery)" if len(told.connected) > 1 else ""
            return f"the battery has {latest.battery_voltage:.1f} V, a flight needs {low:.1f} V{which}"
        return (
            latest.batteries.why_not
            or self._records.why_not()
            or self.blind
            or self._flight.agrees.standing
            or self._link.ambiguous
            or self.rates_too_low(self.rates)
        )

    @property
    def blind(self) -> str:
        """'' where poses come, if they are to come, and the estimator has a position that is good enough."""
        return (self.pose.why_not if self.pose is not None else "") or self.lost_position

    @property
    def lost_position(self) -> str:
        """'' where the estimator has a position that is good enough, or says nothing of it."""
        estimator = self._link.latest.estimator
        return "" if estimator is None else estimator.refusal(self._safety.position_accuracy)

    def rates_too_low(self, rates: Rates | None) -> str:
        """'' where odometry and accelerometer arrive often enough, otherwise what is missing."""
        if rates is None:
            return "rates have not been measured yet"
        too_low = odometry_too_low(rates, self._rate)
        if too_low:
            return too_low
        if rates.longest_gap > self._safety.odometry_gap:
            return f"odometry had a gap of {rates.longest_gap:.2f} s; the link or this machine is too busy"
        if rates.imu < 0.5 * min(self._rate, 100.0):
            return link_too_slow(f"HIGHRES_IMU at {rates.imu:.0f} Hz")
        if rates.duration > _MODE_MEASURED and rates.mode < _LEAST_MODE_RATE:
            what = f"the flight mode (HEARTBEAT, CURRENT_MODE) at {rates.mode:.1f} Hz, so that a pilot is heard late,"
            return link_too_slow(what)
        return ""
