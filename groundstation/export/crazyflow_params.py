"""crazyflow and drone-models: the section of a drone in `first_principles/params.toml`.

World ENU, body FLU, SI units but for rotor speeds in revolutions a minute: theirs. `drag_matrix` in N/(m/s) acts on the
velocity in the body's axes; `mixing_matrix` has the arms over `L` and the sense of each rotor's drag torque. Their
inputs are rotor speeds; the comment at `thrust_curve` tells those of a command.

Sources: `dynamics` of crazyflow 0.4 (`crazyflow/dynamics/first_principles`) and drone-models 0.1
(`drone_models/first_principles`; there the numbers stand in `data/params.toml`, with `gravity_vec`).
"""

from __future__ import annotations

import json
import math
import re

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
from trueflight.models.vehicle import GRAVITY

_RADIANS = 2.0 * math.pi / 60.0
"""rad/s of one revolution a minute."""

_HOLDINGS = {
    "curve": Holding("rpm2thrust, and thrust_curve, which tells the thrust of a command"),
    "lag": Holding("rotor_dyn_coef"),
    "hub_drag": Holding("drag_matrix: as in a hover, whatever the rotors' speed", ROUGHLY),
    "inflow": Holding("drag_matrix: as in a hover, whatever the rotors' speed", ROUGHLY),
    "centre_of_mass": Holding("mixing_matrix, from the centre of mass as found"),
    "spin_inertia": Holding("prop_inertia"),
}


def write(model: Model, known: Known) -> Written:
    """The section of a model. Raises `InputError` where its vehicle has no inertia, or not four rotors."""
    airframe = airframe_of(model)
    rotors, notes = rotors_of(airframe, known)
    if len(rotors.positions) != 4:
        raise InputError(f"{told(model.vehicle)}: {len(rotors.positions)} rotors; crazyflow flies four")
    lines = lines_of(model, _HOLDINGS, "crazyflow")
    if airframe.lag < NO_LAG:
        notes = (*notes, f"rotor_dyn_coef: {NO_LAG:g} s stands for no lag")
    return Written(_section(airframe, rotors, header(model, lines, notes)), lines, notes)


def _section(airframe: Airframe, rotors: Rotors, said: tuple[str, ...]) -> str:
    vehicle = airframe.vehicle
    ixx, iyy, izz = moments(vehicle)
    length = max(max(abs(x), abs(y)) for x, y, _ in rotors.positions) or 1.0
    thrust = rotors.thrust_constant * _RADIANS**2
    rate = 1.0 / max(airframe.lag, NO_LAG)
    dx, dy, dz = (-vehicle.mass * drag for drag in (*airframe.hub_drag, airframe.inflow))
    full = airframe.thrust(rotors.full_command) / 4.0
    bare = re.fullmatch(r"[A-Za-z0-9_-]+", vehicle.name)
    rows = [
        [y / length for _, y, _ in rotors.positions],
        [-x / length for x, _, _ in rotors.positions],
        [float(-direction) for direction in vehicle.rotor_directions],
    ]
    return f"""{hash_comment(said)}
[{vehicle.name if bare else json.dumps(vehicle.name)}]
gravity_vec = [0.0, 0.0, {-GRAVITY}]  # m/s^2
mass = {vehicle.mass:.9g}  # kg
J = {_matrix([[ixx, 0.0, 0.0], [0.0, iyy, 0.0], [0.0, 0.0, izz]])}  # kg m^2
L = {length:.9g}  # m
mixing_matrix = {_matrix(rows)}  # arms over L, sense of the drag torque
rpm2thrust = [0.0, 0.0, {thrust:.9g}]  # N of one rotor, by powers of rpm
rpm2torque = [0.0, 0.0, {thrust * rotors.torque_length:.9g}]  # N m
thrust2torque = {rotors.torque_length:.9g}  # m
rotor_dyn_coef = [{rate:.9g}, 0.0, {rate:.9g}, 0.0]  # 1/s, up and down
prop_inertia = {airframe.spin_inertia:.9g}  # kg m^2
drag_matrix = {_matrix([[dx, 0.0, 0.0], [0.0, dy, 0.0], [0.0, 0.0, dz]])}  # N/(m/s)
thrust_min = 0.0  # N of one rotor
thrust_max = {full:.9g}  # N of one rotor
prop_radius = {vehicle.rotor_radius:.9g}  # m
# rpm of a motor command u: sqrt((c1 u + c2 u^2 + ...) / 4 / rpm2thrust[2])
thrust_curve = [{numbers(airframe.curve).replace(" ", ", ")}]  # N of all rotors
"""


def _matrix(rows: list[list[float]]) -> str:
    return "[" + ", ".join("[" + ", ".join(f"{float(f'{x:.9g}')!r}" for x in row) + "]" for row in rows) + "]"


TARGET = Target("crazyflow", "crazyflow", ".toml", write)
