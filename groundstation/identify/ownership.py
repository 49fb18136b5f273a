"""Whose a number is where several flights are fitted together: the vehicle's, one for all, or each flight's own.

An effect's file says it (`Parameter.belongs_to`); who flies may know better and say otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from trueflight.models.effect import FLIGHT, VEHICLE, Effect
from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError

Number = tuple[str, str]
"""Effect and parameter."""


@dataclass(frozen=True)
class Ownership:
    """Whose each number is: `own` are each flight's own against what their files say, `shared` the vehicle's."""

    own: frozenset[Number] = frozenset()
    shared: frozenset[Number] = frozenset()

    def of(self, effect: Effect, parameter: str) -> str:
        """`VEHICLE` or `FLIGHT`."""
        number = effect.name, parameter
        if number in self.own:
            return FLIGHT
        if number in self.shared:
            return VEHICLE
        return next(p.belongs_to for p in effect.parameters if p.name == parameter)

    def vehicles(self, effect: Effect) -> tuple[str, ...]:
        """Names of the parameters of `effect` that are the vehicle's."""
        return tuple(p.name for p in effect.parameters if self.of(effect, p.name) == VEHICLE)

    def flights(self, effect: Effect) -> tuple[str, ...]:
        """Names of those that are each flight's own."""
        return tuple(p.name for p in effect.parameters if self.of(effect, p.name) == FLIGHT)

    def with_own(self, numbers: Iterable[Number]) -> Ownership:
        """The same, with these numbers each flight's own."""
        own = frozenset(numbers)
        return replace(self, own=self.own | own, shared=self.shared - own)


BY_FILE = Ownership()
"""As the effects' files say."""


def ownership(
    per_flight: Iterable[str] = (), shared: Iterable[str] = (), effects_directory: str | None = None
) -> Ownership:
    """What the effects' files say, but for what `per_flight` and `shared` name: "thrust_gain", or "rotor_drag.x" for
    one number of an effect.

    Raises `InputError` for a name that is none, and one that is in both.
    """
    own, common = (
        frozenset(n for name in names for n in _numbers(name, option, effects_directory))
        for names, option in ((per_flight, "--per-flight"), (shared, "--shared"))
    )
    if both := sorted(own & common):
        raise InputError(f"{'.'.join(both[0])} is named by --per-flight and by --shared; leave out one")
    return Ownership(own, common)


def needs_several(per_flight: Sequence[str], shared: Sequence[str]) -> None:
    """Raise `InputError` where numbers are given owners though there is one flight only."""
    if per_flight or shared:
        option = "--per-flight" if per_flight else "--shared"
        raise InputError(f"{option} goes with several flights of one vehicle; give more than one")


def _numbers(name: str, option: str, effects_directory: str | None) -> list[Number]:
    effect_name, _, parameter = name.partition(".")
    try:
        effect = effect_named(effect_name, effects_directory)
    except InputError as error:
        raise InputError(f"{option} {name}: {error}") from None
    names = [p.name for p in effect.parameters]
    if not names or (parameter and parameter not in names):
        told = ", ".join(f"{effect_name}.{n}" for n in names) or "none"
        raise InputError(f"{option} {name}: {effect_name} has no such parameter; it has: {told}")
    return [(effect_name, n) for n in ([parameter] if parameter else names)]
