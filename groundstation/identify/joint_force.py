"""The specific force of several flights of one vehicle in one fit: what is the vehicle's is shared, the rest each
flight's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trueflight.groundstation.identify.fitting import Fit, MeasuredFlights, fit
from trueflight.groundstation.identify.force import ADEQUATE, ForceProblem, mean_square_before
from trueflight.groundstation.identify.ownership import BY_FILE, Ownership
from trueflight.groundstation.identify.search import Choice, sizes, whole
from trueflight.groundstation.identify.spans import EVERYWHERE, Piecewise, Span
from trueflight.models.effect import FLIGHT, VEHICLE, Effect, Parameter
from trueflight.models.effects import CLOCK
from trueflight.models.model import Term


@dataclass(frozen=True)
class JointForce(ForceProblem):
    """The `Problem` of a search over several flights.

    `whose` tells whose each number is. With `apart`, an effect of the vehicle is a candidate a second time, with
    numbers of each flight: what differs between flights is then not taken for something else that does.
    """

    whose: Ownership = BY_FILE
    apart: bool = False

    @cached_property
    def each(self) -> tuple[Span, ...]:
        """The flights, as spans."""
        return tuple(Span(flight=k) for k in range(len(self.flights.measurements)))

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """The effects that the flights have the measurements for."""
        shared = tuple(
            whole(e)
            for n, e in self.effects.items()
            if n not in self.included and self._measurable(e) and self.only(e)
        )
        return (*shared, *(self.of_each(c) for c in shared if self.apart and self._has_shared_size(c)))

    def of_each(self, choice: Choice) -> Choice:
        """The candidate with numbers of each flight."""
        return replace(choice, spans=self.each)

    def _has_shared_size(self, choice: Choice) -> bool:
        effect = self.effects[choice.effect]
        return any(self.whose.of(effect, p.name) == VEHICLE for p in sizes(effect, choice))

    def held_on(self, choice: Choice, parameter: Parameter) -> tuple[Span, ...]:
        """The flights one by one for what is their own, and all of them at once for what is the vehicle's."""
        own = self.whose.of(self.effects[choice.effect], parameter.name) == FLIGHT
        return choice.spans or (self.each if own else (EVERYWHERE,))

    def _spans(self, choices: Sequence[Choice]) -> dict[tuple[str, str], tuple[Span, ...]]:
        found = {}
        for choice in choices:
            effect = self.effects[choice.effect]
            for p in effect.parameters:
                own = self.held_on(choice if not p.structural else whole(effect), p)
                if own != (EVERYWHERE,):
                    found[choice.effect, p.name] = own
        if not any(self.effects[c.effect].shifts_clock for c in choices):
            (clock,) = CLOCK.parameters
            found[CLOCK.name, clock.name] = self.each
        return found

    def scale_of_thrust(self, here: Fit) -> tuple[tuple[str, ...], np.ndarray] | None:
        """The effects that scale the thrust as a whole, and what they change in the prediction (K A,)."""
        scales = tuple(n for n, e in self.effects.items() if e.scales_rotors)
        if not scales:
            return None
        return scales, self.contribution(here, whole(self.effects[scales[0]])).sum(axis=1)

    @cached_property
    def mean_square_before(self) -> float:
        """Mean squared error of the base model as it stands, each flight on a clock of its own, (m/s²)²."""
        errors = [mean_square_before(self.alone(k), self.base) for k in range(len(self.each))]
        return float(np.average(errors, weights=np.bincount(self.flights.flight_of_rows)))

    def alone(self, flight: int) -> MeasuredFlights:
        """One of the flights."""
        return replace(self.flights, measurements=(self.flights.measurements[flight],))

    def rows(self, flight: int) -> np.ndarray:
        """Which of the used samples (K,) are of that flight."""
        return np.asarray(self.flights.flight_of_rows == flight)

    def adequate(self, here: Fit) -> bool:
        """Whether no axis of any flight has much more left than its noise."""
        for k, m in enumerate(self.flights.measurements):
            left = here.residual[self.rows(k)]
            noise = m.noise[list(m.axes)]
            if left.shape[1] == len(noise) and np.any(np.sqrt(np.mean(left**2, axis=0)) >= ADEQUATE * noise):
                return False
        return True

    def held_out_error(self, fitted: Fit) -> float | None:
        """Squared error on the held-out flight, (m/s²)²: its own numbers are fitted to it, the vehicle's are not."""
        if self.held_out is None:
            return None
        return float(np.sum(self.on_held_out(fitted).residual ** 2))

    def on_held_out(self, fitted: Fit) -> Fit:
        """The vehicle's numbers of `fitted`, with the held-out flight's own."""
        assert self.held_out is not None
        terms = tuple(plain(t) for t in fitted.terms if t.effect != CLOCK.name or CLOCK.name in self.included)
        free = {t.effect: self._own(self.effects[t.effect]) for t in terms if t.effect not in self.included}
        pinned = {
            (t.effect, p.name, EVERYWHERE): float(t.values[p.name])
            for t in terms
            if free.get(t.effect)
            for p in self.effects[t.effect].parameters
            if p.name not in free[t.effect]
        }
        return fit(self.held_out, terms, refit=[n for n, own in free.items() if own], pinned=pinned)

    def _own(self, effect: Effect) -> tuple[str, ...]:
        """What is each flight's own by the effect's file, not what differed between these flights."""
        return tuple(p.name for p in effect.parameters if p.belongs_to == FLIGHT)


def plain(term: Term) -> Term:
    """The term with plain numbers: those of the last flight where flights have their own."""
    values = {k: v.parts[-1][1] if isinstance(v, Piecewise) else v for k, v in term.values.items()}
    return replace(term, values=values)
