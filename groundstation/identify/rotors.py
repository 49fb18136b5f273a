"""What rotor speeds tell: which effects lie between command and rotor, and which between rotor and acceleration.

Lag, delay, thrust curve and the battery act, on a real vehicle, on the speed of the rotors; air, mass and damage act
beyond it. Where a flight has rotor speeds, the first kind is looked for from command to rotor speed, with less noise
and without the air, and what is found there starts the search in the acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trueflight.groundstation.identify.fitting import HAC_LAG, UNMODELLED, MeasuredFlights
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.models.effect import Motion
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.prediction import Chain, apply_effects, motion_of_flight

NEAR_HOVER = (0.8, 1.2)
"""Thrust over hover thrust at which the believed curve is trusted to calibrate the rotors."""


@dataclass(frozen=True)
class MeasuredRotors(MeasuredFlights):
    """Flights whose measured side is the specific thrust that the squares of the rotor speeds are proportional to."""

    def acting(self, flight: int, chain: Chain) -> np.ndarray:
        """Specific thrust (N, 1), m/s², that the chain makes of the command of flight number `flight`."""
        return np.asarray(apply_effects(self._levels[flight], chain, self.kept[flight].take).thrust)[:, None]

    def seen(self, flight: int, chain: Chain) -> np.ndarray:
        """The used samples (K, 1) of what the chain makes of flight number `flight`, behind its filter."""
        return self.behind_filter(self.measurements[flight], self.acting(flight, chain))

    @cached_property
    def _levels(self) -> tuple[Motion, ...]:
        return tuple(motion.with_(rotor_thrust=None, torque=None) for motion in self.motions)

    def behind_filter(self, m: Measurement, acting: np.ndarray) -> np.ndarray:
        """The used samples (K, 1) of the thrust, behind the flight's filter."""
        return m.smooth(acting)[m.used]

    def measured(self) -> np.ndarray:
        """Specific thrust (K, 1), m/s², of the rotor speeds, scaled to the command's."""
        return self._measured

    @cached_property
    def _measured(self) -> np.ndarray:
        parts = []
        for m, motion in zip(self.measurements, self.motions, strict=True):
            # the flight's, not the motion's: a vehicle file need not say where the rotors are
            total = np.sum(np.square(m.flight.column("rotor_speed")), axis=1)
            scale = float(np.mean(motion.command[m.rows][m.used]) / np.mean(total[m.rows][m.used]))
            parts.append(m.smooth((scale * total)[:, None])[m.used])
        return np.concatenate(parts)

    def unit(self) -> float:
        """Squared error worth one independent sample, (m/s²)²."""
        m = self.measurements[0]
        return UNMODELLED**2 * max(1.0, HAC_LAG / float(np.median(np.diff(m.t))))


def has_rotor_speeds(flight: Flight) -> bool:
    """Whether the flight has a speed of every rotor throughout, as sensors report it."""
    speeds = flight.rotor_speed
    if speeds is None or speeds.shape[1] != max(len(flight.vehicle.rotor_positions), 4):
        return False
    return bool(np.all(np.isfinite(speeds)) and float(np.median(speeds)) > 0.0)


def thrust_from_rotors(flight: Flight) -> Flight:
    """The flight with the command that its rotors' speeds stand for, as acted on at once.

    What is left to find lies beyond the rotors: air and mass. The thrust of a rotor speed is calibrated near hover, at
    the nominal voltage where the flight has voltages. Raises `InputError` where rotor speeds are missing.
    """
    if not has_rotor_speeds(flight):
        raise InputError(
            f"{flight.origin or flight.name}: --thrust rotors needs rotor_speed_1..4 (rad/s) in every row; "
            "record them, or use --thrust command"
        )
    vehicle = flight.vehicle
    squares = np.sum(flight.rotor_speed**2, axis=1)  # type: ignore[operator]
    believed = apply_effects(motion_of_flight(replace(flight, quaternion=None)), ()).thrust * vehicle.mass
    flying = np.ones(len(flight), dtype=bool) if flight.flying is None else flight.flying
    ratio = believed / vehicle.weight
    near = flying & (ratio > NEAR_HOVER[0]) & (ratio < NEAR_HOVER[1]) & (squares > 0.0)
    if near.sum() * flight.dt < 1.0:
        raise InputError(
            f"{flight.origin or flight.name}: less than a second near the hover thrust to calibrate the rotors with; "
            "use --thrust command"
        )
    constant = np.log(believed[near] / squares[near])
    log_k = float(np.median(constant))
    if flight.battery_voltage is not None:
        volts = np.log(flight.battery_voltage[near] / vehicle.nominal_voltage)
        if float(np.std(volts)) > 0.01:
            log_k = float(np.polyfit(volts, constant, 1)[1])
    thrust = np.exp(log_k) * squares / vehicle.weight
    command = vehicle.hover_thrust * (thrust if vehicle.thrust_model == "linear" else np.sqrt(thrust))
    return replace(
        flight,
        thrust_command=command,
        # of the rate loop, which lies before the rotors, nothing is believed then
        vehicle=replace(vehicle, command_delay=0.0, motor_time_constant=0.0, rate_time_constant=0.0),
        notes=(*flight.notes, "thrust is that of the rotor speeds"),
    )
