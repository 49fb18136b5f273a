"""Gazebo: the `model.sdf` of a vehicle that PX4 flies, as PX4-gazebo-models has x500, in SDF 1.9.

World ENU, body FLU, SI units: Gazebo's own. A rotor is a light link that turns about a joint, driven by
`MulticopterMotorModel`; its speed is told in rad/s divided by `rotorVelocitySlowdownSim`. What else drags goes through
`Hydrodynamics`, whose derivatives are below 0 where they brake, and whose current is the wind.

Sources: gz-sim 9, `MulticopterMotorModel::UpdateForcesAndMoments` (motorConstant w², -w rotorDragCoefficient v in the
rotor's plane, momentConstant times thrust), `Hydrodynamics::PreUpdate` (`(xU + xUabsU |u| + xUabsV |v| + ...) u`, and
so on for y and z); PX4 1.17, `GZMixingInterfaceESC` and `module.yaml` of SIM_GZ (speeds up to 1000 rad/s).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

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
    hover_command,
    lines_of,
    moments,
    rotors_of,
    told,
)
from trueflight.groundstation.export.words import numbers, xml_comment
from trueflight.models.airframe import Airframe
from trueflight.models.errors import InputError
from trueflight.models.model import Model

_FASTEST = 1000.0
"""rad/s, the largest speed that PX4 sends to Gazebo."""
_SLOWER = 10
"""By so much Gazebo's rotors turn slower than those they stand for, or they would turn too far in a step."""
_BESIDE = 0.01
"""Of the weight: a thrust curve that PX4 and Gazebo together give as well as this is held whole."""
_ACROSS = math.sqrt(2.0) - 1.0
"""Share of the other axes' speeds in that of one: |u| + share |v| is |v| along an axis and halfway between two."""
_ROTOR_SHARE = 0.005
"""Of the vehicle's mass, each rotor's link: light, and whole with the base's."""

_HOLDINGS = {
    "curve": Holding("motorConstant, with SIM_GZ_EC_MIN* 0, SIM_GZ_EC_MAX* and THR_MDL_FAC as the notes say"),
    "lag": Holding("timeConstantUp and timeConstantDown"),
    "hub_drag": Holding("rotorDragCoefficient; what the axes do not share in Hydrodynamics", ROUGHLY),
    "inflow": Holding("Hydrodynamics zW: as in a hover, whatever the rotors' speed", ROUGHLY),
    "frame_drag": Holding(
        "Hydrodynamics: exact along each axis of the body and halfway between two", ROUGHLY
    ),
    "moving_air": Holding(
        "Hydrodynamics default_current; for the rotors it stands in the world, see the notes", ROUGHLY
    ),
    "lean": Holding("pose of the rotors' links"),
    "centre_of_mass": Holding("pose of the rotors' links, from the centre of mass as found"),
    "strength": Holding("motorConstant of each rotor"),
    "spin_inertia": Holding(f"inertia of the rotors' links, times {_SLOWER} for they turn so much slower"),
}


def write(model: Model, known: Known) -> Written:
    """The SDF of a model. Raises `InputError` where its vehicle has no rotors, no inertia, or too little of it."""
    airframe, vehicle = airframe_of(model), model.vehicle
    factor, full, off = square_motors(airframe)
    assumed = known.hover_speed is None
    if assumed:  # the scale is free: the one that PX4's largest number stands for full command
        known = Known(_FASTEST * math.sqrt(vehicle.weight / full), known.torque_length)
    rotors, notes = rotors_of(airframe, known)
    rotors = replace(rotors, full_speed=rotors.hover_speed * math.sqrt(full / vehicle.weight))
    if assumed:
        notes = (*notes, f"rotors: {_FASTEST:g} rad/s at full command is PX4's largest number, not measured")
    curve = _HOLDINGS["curve"]
    if off > _BESIDE:
        curve = Holding(f"{curve.how}; off by up to {100 * off:.0f} % of the weight near the hover", ROUGHLY)
    notes = (*notes, *_notes(airframe, rotors, factor))
    lines = lines_of(model, {**_HOLDINGS, "curve": curve}, "Gazebo")
    return Written(_sdf(airframe, rotors, header(model, lines, notes)), lines, notes)


def square_motors(airframe: Airframe) -> tuple[float, float, float]:
    """THR_MDL_FAC and full thrust (N) for rotors whose speed goes with the motor signal, so that a command gives the
    airframe's thrust; and by how much of the weight the two differ at most, between half and one and a half times the
    hover's command."""
    hover = hover_command(airframe)
    command = np.linspace(0.5 * hover, min(1.5 * hover, airframe.top()), 51)
    thrust = np.array([airframe.thrust(u) for u in command])
    best = (1.0, float(thrust[-1]), math.inf)
    for factor in np.linspace(0.0, 1.0, 201):
        square = motor_signal(command, float(factor)) ** 2
        full = float(np.sum(thrust * square) / np.sum(square**2))
        worst = float(np.max(np.abs(full * square - thrust))) / airframe.vehicle.weight
        if worst < best[2]:
            best = (float(factor), full, worst)
    return best


def motor_signal(command: np.ndarray, factor: float) -> np.ndarray:
    """The signal x that PX4 makes of a command: `factor x² + (1 - factor) x = command`."""
    if factor == 0.0:
        return command
    rest = 1.0 - factor
    return np.asarray((np.sqrt(rest * rest + 4.0 * factor * command) - rest) / (2.0 * factor))


def _notes(airframe: Airframe, rotors: Rotors, factor: float) -> tuple[str, ...]:
    notes = [
        f"PX4: SIM_GZ_EC_MIN* 0, SIM_GZ_EC_MAX* {rotors.full_speed:.0f}, THR_MDL_FAC {factor:.3g}",
        f"the rotors weigh {100 * _ROTOR_SHARE:g} % of the vehicle each, which the base is lighter by",
    ]
    if rotors.full_speed > _FASTEST + 0.5:
        notes.append(
            f"PX4 sends at most {_FASTEST:g} rad/s to Gazebo: below full command's {rotors.full_speed:.0f}"
        )
    if any(airframe.moving_air):
        wind = numbers((*airframe.moving_air, 0.0))
        notes.append(
            f"put <wind><linear_velocity>{wind}</linear_velocity></wind> and the plugin gz-sim-wind-effects-system "
            "into the world: the rotors' drag takes the wind from there"
        )
    if not airframe.spin_inertia:
        notes.append("inertia of the rotors' links is a flat disc's, not measured")
    return tuple(notes)


def _sdf(airframe: Airframe, rotors: Rotors, said: tuple[str, ...]) -> str:
    vehicle, count = airframe.vehicle, len(rotors.positions)
    light = _ROTOR_SHARE * vehicle.mass
    spin = _SLOWER * airframe.spin_inertia or 0.5 * light * vehicle.rotor_radius**2
    base = _base_inertia(airframe, rotors, light, spin)
    arm = max(math.hypot(x, y) for x, y, _ in rotors.positions) or vehicle.rotor_radius
    below = 0.45 * arm + max(0.0, -min(z for _, _, z in rotors.positions))
    links = "".join(_rotor(airframe, rotors, i, light, spin) for i in range(count))
    motors = "".join(_motor(airframe, rotors, i) for i in range(count))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<sdf version="1.9">
{xml_comment(said)}
  <model name="{vehicle.name}">
    <pose>0 0 {below:.6g} 0 0 0</pose>
    <link name="base_link">
      <inertial>
        <mass>{vehicle.mass - count * light:.9g}</mass>
        <inertia>{_tensor(base)}</inertia>
      </inertial>
      <collision name="base_link_collision">
        <geometry><box><size>{numbers((1.4 * arm, 1.4 * arm, 2.0 * below))}</size></box></geometry>
      </collision>
      <visual name="base_link_visual">
        <geometry><box><size>{numbers((0.7 * arm, 0.7 * arm, 0.2 * arm))}</size></box></geometry>
      </visual>
{_SENSORS}    </link>
{links}{motors}{_drag(airframe)}  </model>
</sdf>
"""


_SENSORS = "".join(
    f'      <sensor name="{name}_sensor" type="{name}">\n'
    f"        <always_on>1</always_on>\n        <update_rate>{rate}</update_rate>\n      </sensor>\n"
    for name, rate in (("imu", 250), ("air_pressure", 50), ("magnetometer", 100), ("navsat", 30))
)


def _base_inertia(airframe: Airframe, rotors: Rotors, light: float, spin: float) -> list[float]:
    """Moments of the base: the vehicle's without its rotors' links, which are discs at their places."""
    out = list(moments(airframe.vehicle))
    for x, y, z in rotors.positions:
        for axis, own, square in ((0, 0.5, y * y + z * z), (1, 0.5, z * z + x * x), (2, 1.0, x * x + y * y)):
            out[axis] -= own * spin + light * square
    if not min(out) > 0.0:
        raise InputError(
            f"{told(airframe.vehicle)}: inertia {list(airframe.vehicle.inertia)} is less than that of rotors at their "
            "places; check inertia and rotor_positions"
        )
    return out


def _tensor(diagonal: list[float]) -> str:
    ixx, iyy, izz = diagonal
    return f"<ixx>{ixx:.9g}</ixx><ixy>0</ixy><ixz>0</ixz><iyy>{iyy:.9g}</iyy><iyz>0</iyz><izz>{izz:.9g}</izz>"


def _rotor(airframe: Airframe, rotors: Rotors, i: int, light: float, spin: float) -> str:
    x, y = airframe.lean
    roll = -math.asin(y)
    turned = numbers((*rotors.positions[i], roll, math.asin(x / math.cos(roll)), 0.0))
    return f"""    <link name="rotor_{i}">
      <pose>{turned}</pose>
      <inertial>
        <mass>{light:.9g}</mass>
        <inertia>{_tensor([0.5 * spin, 0.5 * spin, spin])}</inertia>
      </inertial>
      <visual name="rotor_{i}_visual">
        <geometry><cylinder><radius>{airframe.vehicle.rotor_radius:.6g}</radius><length>0.005</length></cylinder></geometry>
      </visual>
    </link>
    <joint name="rotor_{i}_joint" type="revolute">
      <parent>base_link</parent>
      <child>rotor_{i}</child>
      <axis>
        <xyz>0 0 1</xyz>
        <limit><lower>-1e+16</lower><upper>1e+16</upper></limit>
      </axis>
    </joint>
"""


def _motor(airframe: Airframe, rotors: Rotors, i: int) -> str:
    vehicle = airframe.vehicle
    strength = airframe.strength[i] if i < len(airframe.strength) else 1.0
    lag = max(airframe.lag, NO_LAG)
    shared = min(airframe.hub_drag) * vehicle.mass / (len(rotors.positions) * rotors.hover_speed)
    return f"""    <plugin filename="gz-sim-multicopter-motor-model-system"
            name="gz::sim::systems::MulticopterMotorModel">
      <jointName>rotor_{i}_joint</jointName>
      <linkName>rotor_{i}</linkName>
      <turningDirection>{"ccw" if vehicle.rotor_directions[i] > 0 else "cw"}</turningDirection>
      <timeConstantUp>{lag:.9g}</timeConstantUp>
      <timeConstantDown>{lag:.9g}</timeConstantDown>
      <maxRotVelocity>{rotors.full_speed:.9g}</maxRotVelocity>
      <motorConstant>{strength * rotors.thrust_constant:.9g}</motorConstant>
      <momentConstant>{rotors.torque_length:.9g}</momentConstant>
      <commandSubTopic>command/motor_speed</commandSubTopic>
      <motorNumber>{i}</motorNumber>
      <rotorDragCoefficient>{shared:.9g}</rotorDragCoefficient>
      <rollingMomentCoefficient>0</rollingMomentCoefficient>
      <rotorVelocitySlowdownSim>{_SLOWER}</rotorVelocitySlowdownSim>
      <motorType>velocity</motorType>
    </plugin>
"""


def _drag(airframe: Airframe) -> str:
    """What the motor model has no number for: drag of the frame, loss by climbing, and the axis that drags more."""
    mass, shared = airframe.vehicle.mass, min(airframe.hub_drag)
    linear = [*(drag - shared for drag in airframe.hub_drag), airframe.inflow]
    if not any(linear) and not any(airframe.frame_drag):
        return ""
    names = ("xU", "yV", "zW")
    terms = [(name, -mass * drag) for name, drag in zip(names, linear, strict=True)]
    terms += [
        (f"{name}abs{other[1]}", -mass * drag * (1.0 if other == name else _ACROSS))
        for name, drag in zip(names, airframe.frame_drag, strict=True)
        for other in names
    ]
    rows = "".join(f"      <{name}>{value:.9g}</{name}>\n" for name, value in terms if value)
    return f"""    <plugin filename="gz-sim-hydrodynamics-system" name="gz::sim::systems::Hydrodynamics">
      <link_name>base_link</link_name>
      <disable_added_mass>true</disable_added_mass>
      <disable_coriolis>true</disable_coriolis>
      <default_current>{numbers((*airframe.moving_air, 0.0))}</default_current>
{rows}    </plugin>
"""


TARGET = Target("gazebo", "Gazebo", ".sdf", write)
