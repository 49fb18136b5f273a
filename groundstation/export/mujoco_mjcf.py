"""MuJoCo: one MJCF file without plugins, for MuJoCo 3 and later.

World ENU, body FLU with its origin in the centre of mass, SI units: MuJoCo's own. Each rotor is an actuator on a site;
its control is the thrust in N that it settles at. Drag of the rotors and the loss by climbing are actuators whose bias
goes with the site's own velocity along the body's axes, and whose control is the air's velocity along that axis. Drag
of the frame is that of a small ellipsoid in MuJoCo's fluid, which blows with `<option wind>`.

Sources: MuJoCo documentation, "Computation", actuation model (gain, bias, filterexact) and fluid forces (ellipsoid
model: `f = -rho C A |v| v` with the area A of the ellipsoid's projection); as of `mj_fwdActuation` and
`mj_ellipsoidFluidModel`.
"""

from __future__ import annotations

import math

from trueflight.groundstation.export.target import (
    AIR_DENSITY,
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
)
from trueflight.groundstation.export.words import numbers, xml_comment
from trueflight.models.airframe import Airframe
from trueflight.models.model import Model
from trueflight.models.vehicle import GRAVITY

_TIMESTEP = 0.002
_LARGEST_AXIS = 0.01
"""m, of the ellipsoid: its drag is put into the coefficient, so that the air that it carries along weighs nothing."""
_THINNEST = 1e-3
"""Of the largest face: an ellipsoid has no face of no area."""

_HOLDINGS = {
    "curve": Holding(
        'the controls are thrusts in N; <numeric name="thrust_curve"> has the collective thrust of a command'
    ),
    "lag": Holding("dynprm of the rotors: on thrust, not on speed, the same for small changes", ROUGHLY),
    "hub_drag": Holding("actuators air_x and air_y: as in a hover, whatever the rotors' speed", ROUGHLY),
    "inflow": Holding("actuator air_z: as in a hover, whatever the rotors' speed", ROUGHLY),
    "frame_drag": Holding("ellipsoid in the fluid: exact along each axis of the body", ROUGHLY),
    "moving_air": Holding(
        "<option wind>, which the frame's drag feels; air_x, air_y, air_z take it by control", ROUGHLY
    ),
    "lean": Holding("gear of the rotors"),
    "centre_of_mass": Holding("origin of the body, from which the rotors are"),
    "strength": Holding("gainprm of the rotors"),
}


def write(model: Model, known: Known) -> Written:
    """The MJCF of a model. Raises `InputError` where its vehicle has no inertia or no rotors."""
    airframe = airframe_of(model)
    rotors, notes = rotors_of(airframe, known)
    notes = tuple(note for note in notes if "in a hover" not in note)  # it has no rotor speeds
    lines = lines_of(model, _HOLDINGS, "MuJoCo")
    return Written(_mjcf(airframe, rotors, header(model, lines, notes)), lines, notes)


def _mjcf(airframe: Airframe, rotors: Rotors, said: tuple[str, ...]) -> str:
    vehicle = airframe.vehicle
    arm = max(math.hypot(x, y) for x, y, _ in rotors.positions) or vehicle.rotor_radius
    below = 0.45 * arm + max(0.0, -min(z for _, _, z in rotors.positions))
    fluid = f'density="{AIR_DENSITY}"' if any(airframe.frame_drag) else 'density="0"'
    sites = "".join(
        f'      <site name="rotor{i}" pos="{numbers(position)}" size="{0.1 * arm:.6g}"/>\n'
        f'      <geom type="cylinder" pos="{numbers(position)}" size="{vehicle.rotor_radius:.6g} {0.02 * arm:.6g}" '
        'contype="0" conaffinity="0" rgba="0.2 0.2 0.2 0.5"/>\n'
        f'      <geom type="sphere" pos="{numbers((position[0], position[1], 0.08 * arm - below))}" '
        f'size="{0.08 * arm:.6g}"/>\n'
        for i, position in enumerate(rotors.positions)
    )
    return f"""<mujoco model="{vehicle.name}">
{xml_comment(said)}
  <option timestep="{_TIMESTEP}" integrator="implicitfast" gravity="0 0 {-GRAVITY}" {fluid} viscosity="0"
          wind="{numbers((*airframe.moving_air, 0.0))}"/>
  <default><geom solref="0.02 1"/></default>
  <custom><numeric name="thrust_curve" data="{numbers(airframe.curve)}"/></custom>
  <worldbody>
    <light pos="0 0 10"/>
    <geom name="ground" type="plane" size="100 100 1"/>
    <body name="vehicle" pos="0 0 {below:.6g}">
      <freejoint name="free"/>
      <inertial pos="0 0 0" mass="{vehicle.mass:.9g}" diaginertia="{numbers(moments(vehicle))}"/>
      <geom type="box" size="{0.35 * arm:.6g} {0.35 * arm:.6g} {0.1 * arm:.6g}"/>
      <site name="centre" size="{0.05 * arm:.6g}"/>
{_drag_of_the_frame(airframe)}{sites}    </body>
  </worldbody>
  <actuator>
{_actuators(airframe, rotors)}  </actuator>
  <sensor>
    <accelerometer name="specific_force" site="centre"/>
    <gyro name="body_rate" site="centre"/>
  </sensor>
</mujoco>
"""


def _drag_of_the_frame(airframe: Airframe) -> str:
    """The ellipsoid whose faces drag as the frame does: `pi C rho` times the product of its other two semi-axes."""
    largest = max(airframe.frame_drag)
    if not largest > 0.0:
        return ""
    face = [max(drag, _THINNEST * largest) for drag in airframe.frame_drag]  # proportional to the areas
    x, y, z = face
    axes = [math.sqrt(y * z / x), math.sqrt(z * x / y), math.sqrt(x * y / z)]
    scale = _LARGEST_AXIS / max(axes)
    axes = [scale * axis for axis in axes]
    coefficient = airframe.vehicle.mass * x / (math.pi * AIR_DENSITY * axes[1] * axes[2])
    return (
        f'      <geom name="air" type="ellipsoid" size="{numbers(axes)}" contype="0" conaffinity="0" '
        f'fluidshape="ellipsoid" fluidcoef="{coefficient:.9g} 0 0 0 0"/>\n'
    )


def _actuators(airframe: Airframe, rotors: Rotors) -> str:
    vehicle, out = airframe.vehicle, []
    x, y = airframe.lean
    axis = (x, y, math.sqrt(1.0 - x * x - y * y))
    most = airframe.thrust(rotors.full_command) / len(rotors.positions)
    strength = airframe.strength or (1.0,) * len(rotors.positions)
    lag = f'dyntype="filterexact" dynprm="{airframe.lag:.9g}" ' if airframe.lag > 0.0 else ""
    for i, direction in enumerate(vehicle.rotor_directions):
        torque = [-direction * rotors.torque_length * part for part in axis]
        out.append(
            f'    <general name="rotor{i}" site="rotor{i}" gear="{numbers((*axis, *torque))}" {lag}'
            f'ctrllimited="true" ctrlrange="0 {most:.9g}" gainprm="{strength[i] if i < len(strength) else 1.0:.9g}"/>\n'
        )
    for name, gear, drag in zip(
        "xyz", ("1 0 0", "0 1 0", "0 0 1"), (*airframe.hub_drag, airframe.inflow), strict=True
    ):
        if drag:
            out.append(
                f'    <general name="air_{name}" site="centre" gear="{gear} 0 0 0" gainprm="{vehicle.mass * drag:.9g}" '
                f'biastype="affine" biasprm="0 0 {-vehicle.mass * drag:.9g}"/>\n'
            )
    return "".join(out)


TARGET = Target("mujoco", "MuJoCo", ".xml", write)
