"""RotorPy: a Python file with `quad_params`, as those in `rotorpy/vehicles`, for `rotorpy.vehicles.multirotor`.

World ENU, body FLU, SI units: RotorPy's own. Its inputs are rotor speeds in rad/s; `motor_speeds` turns normalised
commands into them. Its `rotor_directions` is +1 for a rotor whose drag turns the vehicle counter-clockwise, so the
rotor turns clockwise: the opposite of a vehicle file's.

Source: Folk, Paulos, Kumar 2023, "RotorPy" (arXiv 2306.04485), eq. (5) to (10), as of RotorPy 3.0: thrust
`k_eta w²`, `k_h |v_h|²`; H-force `-w diag(k_d, k_d, k_z) v`; drag `-|v| diag(c_D) v`; first-order rotor speed.
"""

from __future__ import annotations

from trueflight.groundstation.export.target import (
    NO_LAG,
    ROUGHLY,
    Holding,
    Known,
    Rotors,
    Target,
    Written,
    airframe_of,
    header,
    lines_of,
    moments,
    rotors_of,
    told,
)
from trueflight.groundstation.export.words import hash_comment, numbers
from trueflight.models.airframe import Airframe
from trueflight.models.errors import InputError
from trueflight.models.model import Model

_HOLDINGS = {
    "curve": Holding("k_eta, and motor_speeds(), which turns commands into rotor speeds"),
    "lag": Holding("tau_m"),
    "hub_drag": Holding("k_d, the mean of both axes: RotorPy's rotors drag alike along x and y", ROUGHLY),
    "inflow": Holding("k_z"),
    "frame_drag": Holding("c_Dx, c_Dy, c_Dz"),
    "lift": Holding("k_h"),
    "moving_air": Holding(
        "the array 'wind' of the file: pass it to ConstantWind, RotorPy's vehicles have none"
    ),
    "centre_of_mass": Holding("rotor_pos, from the centre of mass as found"),
}


def write(model: Model, known: Known) -> Written:
    """The parameter file of a model. Raises `InputError` where its vehicle has no inertia, or not four rotors."""
    airframe = airframe_of(model)
    rotors, notes = rotors_of(airframe, known)
    if len(rotors.positions) != 4:
        raise InputError(f"{told(model.vehicle)}: {len(rotors.positions)} rotors; RotorPy flies four")
    lines = lines_of(model, _HOLDINGS, "RotorPy")
    if airframe.lag < NO_LAG:
        notes = (*notes, f"tau_m: {NO_LAG:g} s stands for none, RotorPy divides by it")
    return Written(_module(airframe, rotors, header(model, lines, notes)), lines, notes)


def _module(airframe: Airframe, rotors: Rotors, said: tuple[str, ...]) -> str:
    vehicle = airframe.vehicle
    ixx, iyy, izz = moments(vehicle)
    per_speed = vehicle.mass / (4.0 * rotors.hover_speed)  # of all rotors at hover speed, to one per rad/s
    cx, cy, cz = (vehicle.mass * drag for drag in airframe.frame_drag)
    positions = "".join(
        f'        "r{i + 1}": np.array([{numbers(p).replace(" ", ", ")}]),\n'
        for i, p in enumerate(rotors.positions)
    )
    values = [
        ("mass", vehicle.mass, "kg"),
        ("Ixx", ixx, "kg m^2"),
        ("Iyy", iyy, "kg m^2"),
        ("Izz", izz, "kg m^2"),
        ("Ixy", 0.0, "kg m^2"),
        ("Ixz", 0.0, "kg m^2"),
        ("Iyz", 0.0, "kg m^2"),
        ("rotor_radius", vehicle.rotor_radius, "m"),
        ("c_Dx", cx, "N/(m/s)^2"),
        ("c_Dy", cy, "N/(m/s)^2"),
        ("c_Dz", cz, "N/(m/s)^2"),
        ("k_eta", rotors.thrust_constant, "N/(rad/s)^2"),
        ("k_m", rotors.thrust_constant * rotors.torque_length, "N m/(rad/s)^2"),
        ("k_d", 0.5 * sum(airframe.hub_drag) * per_speed, "N/(rad/s m/s)"),
        ("k_z", airframe.inflow * per_speed, "N/(rad/s m/s)"),
        ("k_h", airframe.lift * vehicle.mass / 4.0, "N/(m/s)^2"),
        ("k_flap", 0.0, "N m/(rad/s m/s)"),
        ("tau_m", max(airframe.lag, NO_LAG), "s, of rotor speed"),
        ("rotor_speed_min", 0.0, "rad/s"),
        ("rotor_speed_max", rotors.full_speed, "rad/s"),
        ("motor_noise_std", 0.0, "rad/s"),
    ]
    table = "".join(f'    "{name}": {value:.9g},  # {unit}\n' for name, value, unit in values)
    turns = ", ".join(str(-direction) for direction in vehicle.rotor_directions)
    curve = ", ".join(f"{c:.9g}" for c in airframe.curve)
    return f'''{hash_comment(said)}import numpy as np

quad_params = {{
    "num_rotors": 4,
    "rotor_pos": {{  # m, from the centre of mass
{positions}    }},
    "rotor_directions": np.array([{turns}]),  # of the drag torque on the vehicle, +1 counter-clockwise
    "rI": np.array([0.0, 0.0, 0.0]),  # m, the accelerometer
{table}}}

# m/s, world, where the air moves to: ConstantWind(*wind)
wind = np.array([{numbers((*airframe.moving_air, 0.0)).replace(" ", ", ")}])

thrust_curve = [{curve}]  # N of all rotors, of the normalised command u, u^2, ...


def motor_speeds(commands):
    """Rotor speeds (rad/s) of normalised motor commands (0 to 1): control["cmd_motor_speeds"]."""
    u = np.clip(np.asarray(commands, dtype=float), 0.0, {rotors.full_command:.9g})
    thrust = sum(c * u ** (k + 1) for k, c in enumerate(thrust_curve)) / 4.0
    return np.sqrt(np.clip(thrust, 0.0, None) / quad_params["k_eta"])
'''


TARGET = Target("rotorpy", "RotorPy", ".py", write)
