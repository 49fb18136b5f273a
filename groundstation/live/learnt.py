"""What a companion learnt in flight and flies with: told when a number leaves the deployed one and when it is back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError
from trueflight.models.record_pb2 import Tick

DEVIATIONS = 3.0
"""Standard deviations that a number that acts must be away from what was deployed, or from what was told of it last."""
HELD = 2.0
"""s for which it must stay so: what was learnt fades in within half a second, and may go on moving for a second."""
AGAIN = 5.0
"""s between two lines of one number, at least."""
_NINETY_FIVE = 1.96


@dataclass(frozen=True)
class Learnt:
    """One number of an effect that the companion learnt in flight, as it acts, in `unit` ("" where the effect is not
    known here).

    `deployed` is what the model brought, `value` what flies now with its standard `deviation`; it left `deployed` at
    `since`, and this is of `time`, both s on the flight's clock. `or_else` are the quantities that no flight can tell
    from the effect. `ended` where the deployed number flies again.
    """

    effect: str
    parameter: str
    unit: str
    deployed: float
    value: float
    deviation: float
    since: float
    time: float
    or_else: tuple[str, ...] = ()
    ended: bool = False

    @property
    def text(self) -> str:
        """It in one line."""
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        name = f"{self.effect} {self.parameter}"
        if self.ended:
            return f"learnt on board: {name} is {self.deployed:.3g}{unit} again, as deployed"
        low, high = (self.value + side * _NINETY_FIVE * self.deviation for side in (-1.0, 1.0))
        others = f": {self.effect}, or {', '.join(self.or_else)}?" if self.or_else else ""
        return (
            f"learnt on board: {name} {self.value:.3g} [{low:.3g}, {high:.3g}]{unit} since {self.since:.1f} s, "
            f"{self.deployed:.3g} as deployed{others}"
        )


class Followed:
    """The numbers that one vehicle's companion learns, followed through one flight."""

    def __init__(self) -> None:
        self._flight, self._model, self._names = -1, "", ""
        self._numbers: list[_Number] = []

    def take(self, ticks: Sequence[Tick], flight: int, zero: int) -> list[Learnt]:
        """What is to be told now, after more ticks of the flight number `flight`, in the order of flight.

        `zero` is where the flight began on the vehicle's clock, us.
        """
        news = []
        for tick in ticks:
            if not tick.learnt_names or tick.vehicle_time_us < zero:
                continue
            if (flight, tick.model, tick.learnt_names) != (self._flight, self._model, self._names):
                self._flight, self._model, self._names = flight, tick.model, tick.learnt_names
                self._numbers = [_Number(name) for name in tick.learnt_names.split(" ")]
            time, acts = 1e-6 * (tick.vehicle_time_us - zero), tick.learning == "acting"
            for number, value, deviation in zip(
                self._numbers, tick.learnt_acting, tick.learnt_deviation, strict=False
            ):
                told = number.step(time, value, deviation, acts)
                if told is not None:
                    news.append(told)
        return news


class _Number:
    """One number: what it was deployed as, since when it is away from that, and what was told of it."""

    def __init__(self, name: str) -> None:
        self._effect, _, self._parameter = name.partition(".")
        self._deployed: float | None = None
        self._away: float | None = None
        self._back: float | None = None
        self._told: Learnt | None = None

    def step(self, time: float, value: float, deviation: float, acts: bool) -> Learnt | None:
        """What is to be told of it now; nothing before a tick has told the deployed number."""
        if self._deployed is None:
            if acts:
                return None
            self._deployed = value
        if abs(value - self._deployed) <= DEVIATIONS * deviation:
            if self._told is None:
                self._away = None
                return None
            self._back = time if self._back is None else self._back
            return self._tell(time, value, deviation, ended=True) if time - self._back >= HELD else None
        self._back = None
        self._away = time if self._away is None else self._away
        if time - self._away < HELD:
            return None
        last = self._told
        if last is None or (
            time - last.time >= AGAIN
            and abs(value - last.value) > DEVIATIONS * max(deviation, last.deviation)
        ):
            return self._tell(time, value, deviation)
        return None

    def _tell(self, time: float, value: float, deviation: float, ended: bool = False) -> Learnt:
        since = self._away if self._away is not None else time
        unit, or_else = _known(self._effect, self._parameter)
        deployed = self._deployed if self._deployed is not None else value
        learnt = Learnt(
            self._effect, self._parameter, unit, deployed, value, deviation, since, time, or_else, ended
        )
        self._told = None if ended else learnt
        self._away = None if ended else since
        return learnt


def _known(effect: str, parameter: str) -> tuple[str, tuple[str, ...]]:
    """Unit, and what no flight can tell from it, of a parameter; nothing where the effect is not known here."""
    try:
        known = effect_named(effect)
    except InputError:  # somebody's own effect
        return "", ()
    units = [p.unit for p in known.parameters if p.name == parameter]
    return (units[0] if units else ""), known.aliases
