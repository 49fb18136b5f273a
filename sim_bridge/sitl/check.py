"""The check at the start: PX4's control allocation against the vehicle file, before it arms."""

from __future__ import annotations

from enum import Enum

from models.errors import InputError
from models.vehicle import Vehicle
from sim_bridge.sitl.allocation import Expected, differences, expected_parameters
from sim_bridge.sitl.px4_link import Px4Link
from sim_bridge.truth.battery import Battery

_PATIENCE_US = 20_000_000  # of PX4's clock, from its first stream on
_ATTEMPTS = 3
_BATTERY_EVERY_US = 500_000
_HOVER_TOLERANCE = 0.05

BATTERY_SIMULATOR, HOVER = "SIM_BAT_ENABLE", "MPC_THR_HOVER"


class State(Enum):
    """How far the check is."""

    WAITING = "waiting"
    AGREES = "agrees"
    UNKNOWN = "not checked"


class AllocationCheck:
    """Reads what PX4 has, compares, and sets it where that is asked for (`correct`). Called with PX4's clock.

    `notes` collects lines for the user. Where `battery` is given and PX4's own battery simulator is off, PX4 is told
    the true battery.
    """

    def __init__(
        self, vehicle: Vehicle, link: Px4Link, battery: Battery | None = None, correct: bool = False
    ) -> None:
        self.vehicle = vehicle
        self.state = State.WAITING
        self.notes: list[str] = []
        self.changed: list[str] = []
        self._link, self._battery, self._correct = link, battery, correct
        self._expected = expected_parameters(vehicle)
        self._tries = 0
        self._begin_us: int | None = None
        self._battery_us = 0
        link.ask([one.name for one in self._expected] + [BATTERY_SIMULATOR, HOVER])

    def step(self, now_us: int) -> None:
        """Go on with the check, and tell PX4 the battery. Raises `InputError` where PX4 flies another vehicle."""
        self._link.poll(now_us)
        if self._begin_us is None:
            self._begin_us = now_us
        if self.state is State.WAITING:
            if self._link.complete:
                self._compare()
            elif now_us - self._begin_us > _PATIENCE_US:
                self._give_up()
        elif self._feeds_battery and now_us >= self._battery_us and self._battery is not None:
            self._battery_us = now_us + _BATTERY_EVERY_US
            self._link.tell_battery(self._battery)

    @property
    def _feeds_battery(self) -> bool:
        return self.state is State.AGREES and self._link.values.get(BATTERY_SIMULATOR) == 0

    def rows(self) -> list[tuple[Expected, int | float | None]]:
        """Every parameter with what PX4 has (None: not told)."""
        return [(one, self._link.values.get(one.name)) for one in self._expected]

    def _compare(self) -> None:
        values = self._link.values
        found = differences(self.vehicle, values)
        if not found:
            self.state = State.AGREES
            self._remark()
            return
        if not self._correct or self._tries == _ATTEMPTS:
            more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
            advice = (
                "PX4 did not take the parameters that were set"
                if self._correct
                else "pass --set-params to set PX4's parameters, or see --show-params"
            )
            raise InputError(f"PX4 flies another vehicle: {found[0]}{more}; {advice}")
        self._tries += 1
        for one in self._expected:
            if abs(values[one.name] - one.value) > 1e-6:
                self._link.set(one.name, one.value)
                self.changed.append(one.name)
        if abs(values[HOVER] - self.vehicle.hover_thrust) > 1e-3:
            self._link.set(HOVER, self.vehicle.hover_thrust)
            self.changed.append(HOVER)

    def _remark(self) -> None:
        values = self._link.values
        if abs(values[HOVER] - self.vehicle.hover_thrust) > _HOVER_TOLERANCE:
            self.notes.append(
                f"{HOVER} is {values[HOVER]:.3g} in PX4, hover_thrust {self.vehicle.hover_thrust:.3g} in the vehicle "
                "file: PX4's own modes will start with the wrong thrust"
            )
        if values[BATTERY_SIMULATOR] != 0:
            self.notes.append(
                f"PX4 simulates a battery of its own; for the vehicle's: param set {BATTERY_SIMULATOR} 0, and start "
                "PX4 again"
            )

    def _give_up(self) -> None:
        self.state = State.UNKNOWN
        told = sum(value is not None for _, value in self.rows())
        reason = "PX4 sends nothing to" if not self._link.heard else f"only {told} parameters came on"
        self.notes.append(
            f"PX4's control allocation was not checked: {reason} UDP port {self._link.port}; compare it with "
            "`sim-bridge sitl --show-params`"
        )
