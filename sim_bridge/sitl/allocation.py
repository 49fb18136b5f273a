"""Whether PX4 allocates control to the rotors that the vehicle file describes, in the same order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle

FIRST_MOTOR = 101
"""PX4's output function of motor 1 (PWM_MAIN_FUNCn); motor i is CA_ROTOR(i - 1)."""

_PLACE_TOLERANCE = 0.1  # of the arm: a rotor further off turns a roll command noticeably into pitch
_MOMENT_TOLERANCE = 0.3  # of the mean: yaw alone depends on it, and its loop is slow


@dataclass(frozen=True)
class Expected:
    """One parameter that PX4 must have: its name, the vehicle's value, and what it is."""

    name: str
    value: int | float
    what: str


def expected_parameters(vehicle: Vehicle) -> list[Expected]:
    """PX4's control allocation for a vehicle: airframe, outputs, rotors (m, forward and right; sign of the moment)."""
    wanted = [
        Expected("CA_AIRFRAME", 0, "multirotor"),
        Expected("CA_ROTOR_COUNT", len(vehicle.rotor_positions), "rotors"),
    ]
    for i, ((x, y, _), turn) in enumerate(
        zip(vehicle.rotor_positions, vehicle.rotor_directions, strict=True)
    ):
        wanted += [
            Expected(f"PWM_MAIN_FUNC{i + 1}", FIRST_MOTOR + i, f"output {i + 1} drives motor {i + 1}"),
            Expected(f"CA_ROTOR{i}_PX", x, f"rotor {i + 1}, m forward"),
            Expected(f"CA_ROTOR{i}_PY", -y, f"rotor {i + 1}, m to the right"),
            Expected(f"CA_ROTOR{i}_KM", math.copysign(0.05, turn), f"rotor {i + 1}, {_turn(turn)}"),
        ]
    return wanted


def differences(vehicle: Vehicle, values: Mapping[str, int | float]) -> list[str]:
    """What differs between PX4's control allocation (`values` by name) and the vehicle's; empty if nothing does.

    PX4 normalises the mixer: arms may be longer or shorter by one common factor, and moments too. Raises `InputError`
    where a value is missing.
    """
    missing = [one.name for one in expected_parameters(vehicle) if one.name not in values]
    if missing:
        raise InputError(f"PX4 did not tell its {missing[0]}; is it PX4 1.13 or newer?")
    found = []
    if round(values["CA_AIRFRAME"]) != 0:
        found.append(f"CA_AIRFRAME is {values['CA_AIRFRAME']:g}, a multirotor's is 0")
    count = round(values["CA_ROTOR_COUNT"])
    if count != len(vehicle.rotor_positions):
        found.append(f"PX4 has {count} rotors, the vehicle file {len(vehicle.rotor_positions)}")
        return found
    for i in range(count):
        function = round(values[f"PWM_MAIN_FUNC{i + 1}"])
        if function != FIRST_MOTOR + i:
            found.append(f"output {i + 1} of PX4 has function {function}, motor {i + 1} is {FIRST_MOTOR + i}")
    here = [(x, -y) for x, y, _ in vehicle.rotor_positions]
    there = [(values[f"CA_ROTOR{i}_PX"], values[f"CA_ROTOR{i}_PY"]) for i in range(count)]
    size = sum(x * x + y * y for x, y in here)
    scale = sum(a * x + b * y for (a, b), (x, y) in zip(there, here, strict=True)) / size
    arm = math.sqrt(size / count)
    for i, ((a, b), (x, y)) in enumerate(zip(there, here, strict=True)):
        # By sign where no common factor fits at all: the order of the motors is another one.
        apart = math.inf if scale <= 0 else math.hypot(a - scale * x, b - scale * y) / (scale * arm)
        if apart > _PLACE_TOLERANCE:
            found.append(
                f"rotor {i + 1} is {_place(x, y)} in the vehicle file, {_place(a, b)} in PX4 (CA_ROTOR{i}_PX, _PY)"
            )
    moments = [values[f"CA_ROTOR{i}_KM"] for i in range(count)]
    mean = sum(abs(moment) for moment in moments) / count
    for i, (moment, turn) in enumerate(zip(moments, vehicle.rotor_directions, strict=True)):
        if moment * turn <= 0:
            found.append(
                f"rotor {i + 1} turns {_turn(turn)} in the vehicle file, {_turn(moment)} in PX4 (CA_ROTOR{i}_KM)"
            )
        elif abs(abs(moment) - mean) > _MOMENT_TOLERANCE * mean:
            found.append(f"rotor {i + 1} has CA_ROTOR{i}_KM {moment:g} in PX4, the mean of all is {mean:.3g}")
    return found


def _place(forward: float, right: float) -> str:
    front = "front" if forward > 0 else "rear"
    return f"{front} {'right' if right > 0 else 'left'} ({forward:.3g}, {right:.3g} m)"


def _turn(direction: float) -> str:
    return "counter-clockwise" if direction > 0 else "clockwise"
