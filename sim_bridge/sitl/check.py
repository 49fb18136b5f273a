"""The check at the start: PX4's control allocation against the vehicle file, before it arms."""

from __future__ import annotations

from enum import Enum

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.sitl.allocation import Expected, differences, expected_parameters
from trueflight.sim_bridge.sitl.px4_link import Px4Link
from trueflight.sim_bridge.truth.battery import Battery

_PATIENCE_US = 20_000_000  # of PX4's clock, from its first stream on
_ATTEMPTS = 3
_OPTIONAL_US = 2_000_000  # for what not every PX4 has
_BATTERY_EVERY_US = 500_000
_HOVER_TOLERANCE = 0.05

HOVER = "MPC_THR_HOVER"
_SIMULATED, _FLIGHT_TIME = "SIM_BAT_ENABLE", "COM_FLTT_LOW_ACT"
OWN_BATTERY = {_SIMULATED: 0, _FLIGHT_TIME: 1}
"""What PX4 needs to fly on the vehicle's battery: no simulated one of its own, and no return for want of flight time
(PX4 takes a MAVLink battery's remaining time for 0 s; with 0, no action, PX4 1.15 leaves Offboard for Hold all the
same, with 1 it warns).
"""


VISION_ESTIMATOR = {"EKF2_EV_CTRL": 15, "EKF2_HGT_REF": 3}
"""What makes EKF2 believe external vision in all that it tells, and in height above the barometer."""

NO_GPS = {"SYS_HAS_GPS": 0}
"""What lets PX4 arm where no GPS is."""


class State(Enum):
    """How far the check is."""

    WAITING = "waiting"
    AGREES = "agrees"
    UNKNOWN = "not checked"


class AllocationCheck:
    """Reads what PX4 has, compares, and sets it where that is asked for (`correct`). Called with PX4's clock.

    `notes` collects lines for the user. Where `battery` is given and PX4's own battery simulator is off, PX4 is told
    the true battery. `estimator` is what EKF2 needs for the source of its position.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        link: Px4Link,
        battery: Battery | None = None,
        correct: bool = False,
        estimator: dict[str, int] | None = None,
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
        self._needed = [*(one.name for one in self._expected), HOVER]
        self._complete_us: int | None = None
        self._estimator = estimator or {}
        self._wished = {**OWN_BATTERY, **self._estimator}
        link.ask([*self._needed, *self._wished])

    def step(self, now_us: int) -> None:
        """Go on with the check, and tell PX4 the battery. Raises `InputError` where PX4 flies another vehicle."""
        self._link.poll(now_us)
        if self._begin_us is None:
            self._begin_us = now_us
        if self.state is State.WAITING:
            if self._link.has(self._needed):
                self._complete_us = now_us if self._complete_us is None else self._complete_us
                if self._link.has(self._wished) or now_us - self._complete_us > _OPTIONAL_US:
                    self._compare()
            elif now_us - self._begin_us > _PATIENCE_US:
                self._give_up()
        elif self.state is State.AGREES and self._battery is not None and now_us >= self._battery_us:
            if not self._feeds_battery:
                return
            self._battery_us = now_us + _BATTERY_EVERY_US
            self._link.tell_battery(self._battery)

    @property
    def _feeds_battery(self) -> bool:
        values = self._link.values
        own = values.get(_SIMULATED) == 0 and _SIMULATED not in self.changed  # PX4 reads it when it starts
        return own and values.get(_FLIGHT_TIME, 1) == 1

    def rows(self) -> list[tuple[Expected, int | float | None]]:
        """Every parameter with what PX4 has (None: not told)."""
        return [(one, self._link.values.get(one.name)) for one in self._expected]

    def _compare(self) -> None:
        values = self._link.values
        found = differences(self.vehicle, values)
        if not found and not (self._correct and self._tries == 0 and self._beside()):
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
                self._set(one.name, one.value)
        for name, value in self._beside().items():
            self._set(name, value)

    def _beside(self) -> dict[str, float]:
        """What else differs and is set where that is asked for: hover thrust, battery, source of the position."""
        wanted = {HOVER: self.vehicle.hover_thrust, **self._wished}
        values = self._link.values
        return {name: wish for name, wish in wanted.items() if abs(values.get(name, wish) - wish) > 1e-3}

    def _set(self, name: str, value: float) -> None:
        self._link.set(name, value)
        if name not in self.changed:
            self.changed.append(name)

    def _remark(self) -> None:
        values = self._link.values
        if abs(values[HOVER] - self.vehicle.hover_thrust) > _HOVER_TOLERANCE:
            self.notes.append(
                f"{HOVER} is {values[HOVER]:.3g} in PX4, hover_thrust {self.vehicle.hover_thrust:.3g} in the vehicle "
                "file: PX4's own modes will start with the wrong thrust"
            )
        if _SIMULATED in self.changed:
            self.notes.append(f"PX4 flies on a battery of its own until it is started again ({_SIMULATED})")
        elif not self._feeds_battery and self._battery is not None:
            commands = ", ".join(f"param set {name} {value}" for name, value in OWN_BATTERY.items())
            self.notes.append(
                f"PX4 flies on a battery of its own; for the vehicle's: {commands}; start PX4 again"
            )

        for name, value in self._estimator.items():
            if values.get(name, value) != value:
                self.notes.append(
                    f"{name} is {values[name]:g} in PX4; to fly by vision: param set {name} {value}"
                )

    def _give_up(self) -> None:
        self.state = State.UNKNOWN
        told = sum(value is not None for _, value in self.rows())
        reason = "PX4 sends nothing to" if not self._link.heard else f"only {told} parameters came on"
        self.notes.append(
            f"PX4's control allocation was not checked: {reason} UDP port {self._link.port}; compare it with "
            "`sim-bridge sitl --show-params`"
        )
