"""What is hidden in a flight: which effects, of which sizes, drawn by a seed or as asked."""

from __future__ import annotations

import difflib
import math
import random
from dataclasses import dataclass, replace

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.effects import EFFECTS


@dataclass(frozen=True)
class Hidden:
    """One hidden effect with every number that it acts by; it `begins` so many s after take-off."""

    name: str
    parameters: dict[str, float]
    begins: float = 0.0

    def answer(self) -> dict[str, object]:
        """As `sim-bridge reveal` tells it: name and parameters with their units, and `begins` where that is in
        flight.
        """
        units = EFFECTS[self.name].units
        told: dict[str, object] = {
            "name": self.name,
            "parameters": {
                key: {"value": value, "unit": units[key]} for key, value in self.parameters.items()
            },
        }
        return told | {"begins": {"value": self.begins, "unit": "s"}} if self.begins else told


RICH: dict[str, tuple[float, float]] = {
    "rotor_drag": (0.40, 0.60),
    "parasitic_drag": (0.01, 0.03),
    "ground_effect": (1.2, 2.0),
    "battery_sag": (1.2, 1.8),
    "motor_lag": (0.028, 0.040),
    "thrust_curve": (0.15, 0.40),
    "thrust_gain": (0.97, 1.08),
    "estimator_delay": (0.008, 0.012),
}
"""Range of each effect's main number in `rich`; the sources stand in `rich`."""


def rich(vehicle: Vehicle, seed: int) -> tuple[Hidden, ...]:
    """Everything at once that a real 5-inch quadrotor does and its linear design does not know.

    Magnitudes of the order known of such vehicles, drawn by the seed:

    * rotor drag around 0.5 1/s: Faessler, Franchi, Scaramuzza, RA-L 2018, identify about that in flight (0.54, 0.39).
    * parasitic drag: drag areas of 0.012 to 0.037 m² at 0.75 kg, a bluff body of that frontal area (Hoerner 1965).
    * ground effect: effective radii of 1.2 to 2 propellers (Sanchez-Cuenca et al. 2017).
    * battery: thrust goes with the square of the voltage of an unloaded motor and with less of a loaded one.
    * rotor lag: 28 to 40 ms on the vehicle, against the 20 ms of the bench.
    * thrust curve: of PX4's model thrust = (1 - f) u + f u² (THR_MDL_FAC) with f of 0.3 to 0.6, near hover.
    * thrust gain: what a hover command read off a log, a scale and another set of propellers leave open.
    * estimator delay: 8 to 12 ms from motion to message, motion capture and filters included.

    Neither wind nor a payload is in it; hide them beside it.
    """
    hidden = []
    for name, (low, high) in RICH.items():
        generator = random.Random(f"trueflight rich {seed} {name}")
        size = EFFECTS[name].possible(generator.uniform(low, high))
        hidden.append(Hidden(name, EFFECTS[name].draw(vehicle, size, generator)))
    return tuple(hidden)


def pool(request: str) -> list[str]:
    """Names of the effects that `random` or `any` draws from."""
    if request == "random":
        return [name for name, effect in EFFECTS.items() if effect.drawn]
    return [name for name, effect in EFFECTS.items() if effect.drawn or effect.any_draws]


def choose(
    requests: list[str], vehicle: Vehicle, seed: int, count: int = 1, strength: float = 1.0
) -> tuple[Hidden, ...]:
    """What to hide, from `NAME`, `NAME:SIZE`, `none`, `random` or `rich` requests; the same seed hides the same.
    `@SECONDS` at the end of a name or size lets the effect begin so long after take-off.

    Sizes that are drawn are `strength` times as far from "nothing hidden" as usual; `rich` and given sizes stay.

    `random` draws `count` different effects of the first catalogue, `any` of all that act for a whole flight (so
    that a seed of `random` hides for ever what it hid), `rich` is that of `rich()`; what follows it may override a
    part of it. Raises `InputError` for an unknown name or a size out of range.
    """
    chosen: dict[str, Hidden] = {}
    for request in requests:
        if request == "none":
            if len(requests) > 1:
                raise InputError("--hidden none cannot be combined with another --hidden; drop one of them")
            return ()
        if request in ("random", "any"):
            drawable = pool(request)
            if not 1 <= count <= len(drawable):
                raise InputError(f"--hidden-count {count} must be 1 to {len(drawable)}")
            generator = random.Random(
                f"trueflight {seed}" if request == "random" else f"trueflight any {seed}"
            )
            for name in generator.sample(drawable, count):
                chosen[name] = _make(name, None, vehicle, seed, strength)
            continue
        if request == "rich":
            chosen |= {one.name: one for one in rich(vehicle, seed)}
            continue
        asked, at, moment = request.partition("@")
        name, colon, text = asked.partition(":")
        if name not in EFFECTS:
            known = [*EFFECTS, "rich", "random", "any", "none"]
            close = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known)}"
            raise InputError(f"--hidden {request}: unknown effect '{name}'; {hint}")
        size = _size(request, EFFECTS[name], text) if colon else None
        begins = _moment(request, EFFECTS[name], moment) if at else 0.0
        chosen[name] = replace(_make(name, size, vehicle, seed, strength), begins=begins)
    return tuple(chosen.values())


def _size(request: str, effect: TruthEffect, text: str) -> float:
    size = _number(request, text)
    if not effect.least <= size <= effect.most:
        unit = next(iter(effect.units.values()))
        raise InputError(f"--hidden {request}: size must be {effect.least:g} to {effect.most:g} {unit}")
    return size


def _moment(request: str, effect: TruthEffect, text: str) -> float:
    moment = _number(request, text)
    if not effect.may_begin:
        able = ", ".join(name for name, one in EFFECTS.items() if one.may_begin)
        raise InputError(
            f"--hidden {request}: {effect.name} acts from the start only; these can begin in flight: {able}"
        )
    if not 0.0 <= moment < math.inf:
        raise InputError(
            f"--hidden {request}: begins {moment:g} s after take-off; write a time of 0 or later"
        )
    return moment


def _number(request: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"--hidden {request}: '{text}' is not a number; write NAME, NAME:SIZE or NAME:SIZE@SECONDS"
        ) from None


def _make(name: str, size: float | None, vehicle: Vehicle, seed: int, strength: float) -> Hidden:
    effect = EFFECTS[name]

    def draw(size: float | None) -> dict[str, float]:
        # A generator of its own for each effect, so that hiding one more does not change the others.
        return effect.draw(vehicle, size, random.Random(f"trueflight {seed} {name}"))

    numbers, factor = draw(size), strength * effect.scale(vehicle)
    if size is None and factor != 1.0:
        nothing = effect.neutral(vehicle)
        numbers = draw(nothing + factor * (numbers[next(iter(effect.units))] - nothing))
    return Hidden(name, numbers)
