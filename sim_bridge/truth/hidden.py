"""Physical effects that the simulator can hide, one small class each, by the project's standard names.

The formulas are the simulator's own: per rotor, in forces and rotor speeds. Add an effect by writing a class
with `@register`; it may change the powertrain's numbers, act on the rotors, act on the body, or bias the
sensors.
"""

from __future__ import annotations

import difflib
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import sqrt
from typing import ClassVar

from trueflight.models.errors import InputError
from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.truth.airframe import AIR_DENSITY, Act, Airframe, Motion, Powertrain
from trueflight.sim_bridge.truth.sensors import Sensors
from trueflight.sim_bridge.world import PHYSICS_STEP, World

Event = tuple[float, Callable[[World], None]]


_MASS, _RADIUS = 0.75, 0.0635
"""kg and m: the 5-inch quadrotor that the ranges of sizes were chosen for."""


def _times_larger(vehicle: Vehicle) -> float:
    """How many times larger a vehicle is, by its rotors."""
    return vehicle.rotor_radius / _RADIUS


@dataclass(frozen=True)
class Hidden:
    """One hidden effect with every number that it acts by."""

    name: str
    parameters: dict[str, float]

    def answer(self) -> dict[str, object]:
        """As `sim-bridge reveal` tells it: name and parameters with their units."""
        units = EFFECTS[self.name].units
        return {
            "name": self.name,
            "parameters": {
                key: {"value": value, "unit": units[key]} for key, value in self.parameters.items()
            },
        }


class TruthEffect:
    """A hidden effect: `size` is its main number, between `low` and `high` when drawn.

    `units` names every parameter of the effect with its unit, the first being the size.
    """

    name: str
    what: str
    low: float
    high: float
    units: ClassVar[dict[str, str]]
    least: float = 0.0
    most: float = math.inf
    drawn: bool = True
    """Whether `random` may draw it."""
    any_draws: bool | None = None
    """Whether `any` may draw it; None: as `random` does."""

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """All parameters, drawn, or around a given size."""
        drawn = generator.uniform(self.low, self.high)
        return {next(iter(self.units)): drawn if size is None else size}

    def neutral(self, vehicle: Vehicle) -> float:
        """The size at which nothing is hidden."""
        return 0.0

    def scale(self, vehicle: Vehicle) -> float:
        """How many times larger than on the 5-inch quadrotor that `low` and `high` were chosen for."""
        return 1.0

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """The powertrain with this effect."""
        return train

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Let the effect act on rotors, body or sensors; `others` are the names of all that is hidden with
        it.
        """

    def event(self, vehicle: Vehicle, numbers: dict[str, float]) -> Event | None:
        """What happens to the rigid body in flight, with its time after take-off in s; None for nothing."""
        return None


EFFECTS: dict[str, TruthEffect] = {}


def register(effect: type[TruthEffect]) -> type[TruthEffect]:
    """Make an effect known by its name."""
    EFFECTS[effect.name] = effect()
    return effect


@register
class ThrustGain(TruthEffect):
    """Other propellers than believed: every rotor's thrust constant is off by one factor."""

    name, what = "thrust_gain", "thrust of every rotor is off by a factor"
    low, high, least, most = 0.93, 1.18, 0.5, 2.0
    units: ClassVar = {"gain": "1"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """Up by 7 to 18 %, or down by 4 to 7 %: a cascade without integral sinks too far with less thrust."""
        up, down = generator.uniform(0.07, 0.18), -generator.uniform(0.04, 0.07)
        off = generator.choice((up, down))
        return {"gain": 1.0 + off if size is None else size}

    def neutral(self, vehicle: Vehicle) -> float:
        """A factor of one."""
        return 1.0

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """Thrust constants times the gain."""
        a, b, c, d = train.thrust_constants
        gain = numbers["gain"]
        return replace(train, thrust_constants=(gain * a, gain * b, gain * c, gain * d))


@register
class ThrustCurve(TruthEffect):
    """The speed controller turns commands into rotor speed by another curve, with the same hover."""

    name, what = "thrust_curve", "the map from command to rotor speed is another curve, right at hover only"
    low, high, least, most = 0.35, 0.9, -0.5, 1.5
    units: ClassVar = {"speed_blend": "1"}

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """Rotor speed becomes a blend of the square-root and the proportional map."""
        return replace(train, speed_blend=numbers["speed_blend"])


@register
class BatterySag(TruthEffect):
    """Rotor speed is not regulated: thrust follows a power of the voltage."""

    name, what = "battery_sag", "thrust follows a power of the battery's voltage over the nominal one"
    low, high, least, most = 0.9, 2.0, -4.0, 4.0
    units: ClassVar = {"exponent": "1"}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """All thrusts times (V / V_nominal) to the exponent."""
        nominal, exponent = airframe.vehicle.nominal_voltage, numbers["exponent"]

        def act(m: Motion) -> None:
            factor = (m.voltage / nominal) ** exponent
            thrusts = m.thrusts
            for i in (0, 1, 2, 3):
                thrusts[i] *= factor

        airframe.on_rotors.append(act)


@register
class MotorLag(TruthEffect):
    """Rotors take longer to change speed than measured on the bench."""

    name, what = "motor_lag", "the rotors' speed lags its command with another time constant"
    low, high, least, most = 0.045, 0.058, 0.0, 1.0
    units: ClassVar = {"time_constant": "s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """At least 25 ms above the believed one, else it would not be hidden but absent."""
        least = max(self.low, vehicle.motor_time_constant + 0.025)
        drawn = generator.uniform(least, max(self.high, least + 0.013))
        return {"time_constant": drawn if size is None else size}

    def neutral(self, vehicle: Vehicle) -> float:
        """The believed time constant."""
        return vehicle.motor_time_constant

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """The true time constant of rotor speed."""
        return replace(train, time_constant=numbers["time_constant"])


@register
class TransportDelay(TruthEffect):
    """Setpoints reach the motors later than believed."""

    name, what = "transport_delay", "setpoints reach the motors later than believed, by this much more"
    low, high, least, most = 0.018, 0.036, 0.0, 0.5
    units: ClassVar = {"extra_delay": "s"}

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """The believed delay plus the hidden one."""
        return replace(train, delay=train.delay + numbers["extra_delay"])


@register
class RotorDrag(TruthEffect):
    """H-force of each rotor, proportional to its speed and to the air's velocity at its hub, in the rotor
    plane.

    Source: Martin and Salaün, "The true role of accelerometer feedback in quadrotor control", ICRA 2010;
    Faessler et al., "Differential flatness of quadrotor dynamics subject to rotor drag", RA-L 2018.
    """

    name, what = (
        "rotor_drag",
        "each rotor drags in its plane, in proportion to its speed and the air's velocity there",
    )
    low, high, most = 0.15, 0.45, 5.0
    units: ClassVar = {"x": "1/s", "y": "1/s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """Acceleration per speed at hover along body x, and up to 25 % more along y."""
        x = generator.uniform(self.low, self.high)
        ratio = generator.uniform(1.0, 1.25)
        x = x if size is None else size
        return {"x": x, "y": ratio * x}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Force -c omega_i V_i at every hub, V_i with the velocity that the body's rates give the hub."""
        airframe.on_body.append(rotor_drag(airframe, numbers["x"], numbers["y"]))


def rotor_drag(airframe: Airframe, x_per_s: float, y_per_s: float) -> Act:
    """The H-force of four rotors, given as acceleration per speed (1/s) when all turn at hover speed."""
    per_rotor = airframe.vehicle.mass / (4 * airframe.powertrain.hover_speed)
    cx, cy = x_per_s * per_rotor, y_per_s * per_rotor
    hubs = tuple(airframe.vehicle.rotor_positions)

    def act(m: Motion) -> None:
        u, v, p, q, r = m.u, m.v, m.p, m.q, m.r
        fx = fy = tx = ty = tz = 0.0
        for speed, (x, y, z) in zip(m.speeds, hubs, strict=True):
            hx = -cx * speed * (u + q * z - r * y)
            hy = -cy * speed * (v + r * x - p * z)
            fx += hx
            fy += hy
            tx -= z * hy
            ty += z * hx
            tz += x * hy - y * hx
        body = m.wrench
        body[0] += fx
        body[1] += fy
        body[3] += tx
        body[4] += ty
        body[5] += tz

    return act


@register
class ParasiticDrag(TruthEffect):
    """Dynamic pressure on the frame, with an area of its own along each body axis.

    Source: Hoerner, "Fluid-Dynamic Drag", 1965: drag 0.5 rho C_D A |V| V.
    """

    name, what = "parasitic_drag", "the frame drags with the square of the air's velocity"
    low, high, most = 0.05, 0.14, 5.0
    units: ClassVar = {"x": "1/m", "y": "1/m", "z": "1/m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """Acceleration per speed squared along body x; y and z have larger areas."""
        x = generator.uniform(self.low, self.high)
        y_ratio, z_ratio = generator.uniform(1.0, 1.3), generator.uniform(1.2, 1.8)
        x = x if size is None else size
        return {"x": x, "y": y_ratio * x, "z": z_ratio * x}

    def scale(self, vehicle: Vehicle) -> float:
        """Area over mass, of a body of the same density."""
        return 1.0 / _times_larger(vehicle)

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Force -0.5 rho (C_D A)_axis |V| V_axis at the centre of mass."""
        areas = [2.0 * airframe.vehicle.mass * numbers[axis] / AIR_DENSITY for axis in "xyz"]
        ax, ay, az = (0.5 * AIR_DENSITY * area for area in areas)

        def act(m: Motion) -> None:
            u, v, w = m.u, m.v, m.w
            speed = (u * u + v * v + w * w) ** 0.5
            body = m.wrench
            body[0] -= ax * speed * u
            body[1] -= ay * speed * v
            body[2] -= az * speed * w

        airframe.on_body.append(act)


@register
class GroundEffect(TruthEffect):
    """Each rotor feels the images of all four below the ground, at the heights that the attitude gives their
    hubs.

    Method of images: Cheeseman and Bennett, ARC R&M 3021, 1955, for the rotor's own image; Sanchez-Cuenca et
    al., "Characterization of the aerodynamic ground effect and its influence in multirotor control", 2017,
    for those of its neighbours. The effective radius is larger than the propeller's, as measured on small
    quadrotors.
    """

    name, what = "ground_effect", "each rotor's thrust rises near the ground, by the images of all four"
    low, high, most = 1.2, 2.0, 6.0
    units: ClassVar = {"radius_factor": "1"}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Thrust of rotor i over 1 - sum_j (R²/2) h / (d_ij² + 4 h²)^(3/2), h the mean height of hubs i and
        j.
        """
        hubs = tuple(airframe.vehicle.rotor_positions)
        radius = numbers["radius_factor"] * airframe.vehicle.rotor_radius
        half_square = 0.5 * radius * radius
        # Below a quarter of the radius the images leave their range of validity; the feet are longer than
        # that.
        least, ceiling = 0.25 * radius, 20.0 * radius
        # Rotor i feels the image of j as j feels that of i: six pairs and four images of their own.
        pairs = tuple(
            (i, j, (hubs[i][0] - hubs[j][0]) ** 2 + (hubs[i][1] - hubs[j][1]) ** 2)
            for i in range(4)
            for j in range(i)
        )

        def act(m: Motion) -> None:
            z, r20, r21, r22 = m.z, m.r20, m.r21, m.r22
            if z > ceiling:
                return
            heights = [0.0, 0.0, 0.0, 0.0]
            images = [0.0, 0.0, 0.0, 0.0]
            for i, (x, y, up) in enumerate(hubs):
                h = z + r20 * x + r21 * y + r22 * up
                heights[i] = h = h if h > least else least
                images[i] = 0.125 / (h * h)
            for i, j, apart in pairs:
                h = 0.5 * (heights[i] + heights[j])
                square = apart + 4.0 * h * h
                image = h / (square * sqrt(square))
                images[i] += image
                images[j] += image
            thrusts = m.thrusts
            for i in (0, 1, 2, 3):
                loss = half_square * images[i]
                thrusts[i] /= 1.0 - (loss if loss < 0.5 else 0.5)

        airframe.on_rotors.append(act)


@register
class Wind(TruthEffect):
    """Steady wind. It acts through drag: where no drag is hidden with it, the rotors drag as known for such
    frames.
    """

    name, what = "wind", "a steady horizontal wind, acting through rotor drag"
    low, high, most = 3.0, 5.5, 15.0
    units: ClassVar = {"speed": "m/s", "east": "m/s", "north": "m/s", "drag": "1/s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A speed (m/s) from any direction."""
        speed, direction = generator.uniform(self.low, self.high), generator.uniform(-math.pi, math.pi)
        speed = speed if size is None else size
        east, north = speed * math.cos(direction), speed * math.sin(direction)
        return {"speed": speed, "east": east, "north": north, "drag": generator.uniform(0.18, 0.28)}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Move the air; bring rotor drag along if nothing else drags."""
        airframe.wind = (numbers["east"], numbers["north"], 0.0)
        if not others & {"rotor_drag", "parasitic_drag"}:
            airframe.on_body.append(rotor_drag(airframe, numbers["drag"], numbers["drag"]))


@register
class AccelerometerBias(TruthEffect):
    """The accelerometer reads a constant in body axes."""

    name, what = "accelerometer_bias", "the accelerometer reads a constant off, in body axes"
    low, high, most = 0.2, 0.5, 0.3 * GRAVITY
    units: ClassVar = {"size": "m/s^2", "x": "m/s^2", "y": "m/s^2", "z": "m/s^2"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A size (m/s²) in any direction."""
        drawn = generator.uniform(self.low, self.high)
        size = drawn if size is None else size
        axis = [generator.gauss(0.0, 1.0) for _ in range(3)]
        length = math.sqrt(sum(x * x for x in axis))
        x, y, z = (size * component / length for component in axis)
        return {"size": size, "x": x, "y": y, "z": z}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Added to every reading."""
        sensors.accelerometer_bias = (numbers["x"], numbers["y"], numbers["z"])


@register
class EstimatorDelay(TruthEffect):
    """Sensors, filters, estimator and link take time: a companion is told of a moment this much later.

    The messages carry the time of the moment that they tell of. The autopilot's own loops are not late: they
    use the gyroscope itself. Not a force, so that `random` does not draw it.
    """

    name, what = "estimator_delay", "a companion is told of every moment this much later, to whole 2 ms"
    low, high, most, drawn = 0.006, 0.014, 0.2, False
    units: ClassVar = {"delay": "s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A whole number of physics steps."""
        drawn = round(generator.uniform(self.low, self.high) / PHYSICS_STEP) * PHYSICS_STEP
        return {"delay": drawn if size is None else size}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """The age of what is reported."""
        sensors.delay = numbers["delay"]


@register
class Payload(TruthEffect):
    """A load picked up in flight: more mass and inertia from a time after take-off until the motors stop.

    A cube as wide as a rotor's radius, its centre in the centre of mass, so that no torque comes with it. An
    event rather than an effect of the whole flight, so that neither `random` nor `rich` hides it.
    """

    name, what = "payload", "a share of the vehicle's mass is picked up at a time after take-off"
    low, high, most, drawn = 0.08, 0.15, 1.0, False
    units: ClassVar = {"mass_fraction": "1", "time": "s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A share of the mass, after 12 s: the transfer to a trajectory's start is over, most of it is ahead."""
        drawn = generator.uniform(self.low, self.high)
        return {"mass_fraction": drawn if size is None else size, "time": 12.0}

    def event(self, vehicle: Vehicle, numbers: dict[str, float]) -> Event:
        """The load is fixed to the rigid body."""
        mass = numbers["mass_fraction"] * vehicle.mass
        inertia = mass * vehicle.rotor_radius**2 / 6.0
        return numbers["time"], lambda world: world.load(mass, inertia)


@register
class TranslationalLift(TruthEffect):
    """Blade elements of a rotor in edgewise flow meet faster air on one side than they miss on the other.

    Averaged over a turn the square of a blade element's airspeed grows by half the square of the edgewise airspeed:
    thrust rises by the square of the airspeed at the hub, whatever the rotor's speed (Leishman, "Principles of
    Helicopter Aerodynamics", ch. 3).
    """

    name, what = (
        "translational_lift",
        "each rotor's thrust rises with the square of the airspeed in its plane",
    )
    low, high, most, drawn, any_draws = 0.03, 0.08, 0.5, False, True
    units: ClassVar = {"lift": "1/m"}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """A quarter of the gain at every hub, with the velocity that the body's rates give the hub."""
        gain = 0.25 * airframe.vehicle.mass * numbers["lift"]
        hubs = tuple(airframe.vehicle.rotor_positions)

        def act(m: Motion) -> None:
            u, v, p, q, r = m.u, m.v, m.p, m.q, m.r
            thrusts = m.thrusts
            for i, (x, y, z) in enumerate(hubs):
                hx, hy = u + q * z - r * y, v + r * x - p * z
                thrusts[i] += gain * (hx * hx + hy * hy)

        airframe.on_rotors.append(act)


@register
class CeilingEffect(TruthEffect):
    """A ceiling above the flight draws each rotor up.

    Law and constants of Sanchez-Cuevas, Heredia and Ollero, "Multirotor UAS for bridge inspection by contact using
    the ceiling effect", ICUAS 2017: thrust over 1 - (R / (d + 0.0378 m))² / 6.924, with the effective radius R.
    """

    name, what = "ceiling_effect", "each rotor's thrust rises near a ceiling above the flight"
    low, high, most, drawn, any_draws = 2.0, 3.0, 6.0, False, False
    units: ClassVar = {"radius_factor": "1", "height": "m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """An effective radius, below a ceiling just above the survey flight's highest hover."""
        drawn = generator.uniform(self.low, self.high)
        height = generator.uniform(2.78, 2.85)
        return {"radius_factor": drawn if size is None else size, "height": height}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Each hub by its own distance."""
        hubs = tuple(airframe.vehicle.rotor_positions)
        square = (numbers["radius_factor"] * airframe.vehicle.rotor_radius) ** 2 / 6.924
        height = numbers["height"]

        def act(m: Motion) -> None:
            z, r20, r21, r22 = m.z, m.r20, m.r21, m.r22
            thrusts = m.thrusts
            for i, (x, y, up) in enumerate(hubs):
                distance = height - (z + r20 * x + r21 * y + r22 * up)
                near = square / (max(distance, 0.0) + 0.0378) ** 2
                thrusts[i] /= 1.0 - (near if near < 0.5 else 0.5)

        airframe.on_rotors.append(act)


@register
class VortexRing(TruthEffect):
    """A rotor that sinks into its own wake loses thrust.

    A raised cosine over the descent speed of each hub, from 0.3 to 1.5 of the hover's induced velocity, as the loss of
    small propellers measured by Shetty and Selig, AIAA 2011-1254; gone at edgewise speeds above the induced velocity.
    """

    name, what = "vortex_ring", "each rotor loses thrust where it sinks nearly as fast as its own wake"
    low, high, most, drawn, any_draws = 0.15, 0.35, 0.8, False, False
    units: ClassVar = {"loss": "1"}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Thrust of rotor i times one minus the loss."""
        vehicle = airframe.vehicle
        disc = math.pi * vehicle.rotor_radius**2
        induced = math.sqrt(0.25 * vehicle.weight / (2.0 * AIR_DENSITY * disc))
        hubs, loss = tuple(vehicle.rotor_positions), numbers["loss"]

        def act(m: Motion) -> None:
            u, v, w, p, q = m.u, m.v, m.w, m.p, m.q
            edgewise = sqrt(u * u + v * v) / induced
            if edgewise >= 1.0:
                return
            thrusts = m.thrusts
            for i, (x, y, _) in enumerate(hubs):
                sinking = -(w + p * y - q * x) / induced
                if 0.3 < sinking < 1.5:
                    ring = 0.5 - 0.5 * math.cos(2.0 * math.pi * (sinking - 0.3) / 1.2)
                    thrusts[i] *= 1.0 - loss * ring * (1.0 - edgewise)

        airframe.on_rotors.append(act)


@register
class ThrustMisalignment(TruthEffect):
    """Rotors are mounted with a common tilt against the autopilot."""

    name, what = "thrust_misalignment", "every rotor's axis leans by the same angle against the body"
    low, high, most, drawn, any_draws = 0.02, 0.05, 0.3, False, True
    units: ClassVar = {"angle": "rad", "x": "rad", "y": "rad"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """An angle in any direction."""
        angle, direction = generator.uniform(self.low, self.high), generator.uniform(-math.pi, math.pi)
        angle = angle if size is None else size
        return {"angle": angle, "x": angle * math.cos(direction), "y": angle * math.sin(direction)}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """The force of each rotor along its leaning axis, and its torque at the hub."""
        sx, sy = math.sin(numbers["x"]), math.sin(numbers["y"])
        short = 1.0 - sqrt(1.0 - sx * sx - sy * sy)
        hubs = tuple(airframe.vehicle.rotor_positions)

        def act(m: Motion) -> None:
            body = m.wrench
            for thrust, (x, y, z) in zip(m.thrusts, hubs, strict=True):
                fx, fy, fz = sx * thrust, sy * thrust, -short * thrust
                body[0] += fx
                body[1] += fy
                body[2] += fz
                body[3] += y * fz - z * fy
                body[4] += z * fx - x * fz
                body[5] += x * fy - y * fx

        airframe.on_body.append(act)


@register
class ImuLeverArm(TruthEffect):
    """The accelerometer sits away from the centre of mass and reads the acceleration of where it sits."""

    name, what = "imu_lever_arm", "the accelerometer sits away from the centre of mass"
    low, high, most, drawn, any_draws = 0.03, 0.07, 0.5, False, True
    units: ClassVar = {"length": "m", "x": "m", "y": "m", "z": "m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A distance in any direction."""
        drawn = generator.uniform(self.low, self.high)
        size = drawn if size is None else size
        axis = [generator.gauss(0.0, 1.0) for _ in range(3)]
        length = math.sqrt(sum(a * a for a in axis))
        x, y, z = (size * a / length for a in axis)
        return {"length": size, "x": x, "y": y, "z": z}

    def scale(self, vehicle: Vehicle) -> float:
        """A distance on the frame."""
        return _times_larger(vehicle)

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Where the accelerometer is; the simulator differentiates that point's velocity."""
        sensors.lever_arm = (numbers["x"], numbers["y"], numbers["z"])


@register
class CentreOfMassOffset(TruthEffect):
    """The battery slipped: the centre of mass is not where the rotors' positions are measured from."""

    name, what = (
        "com_offset",
        "the centre of mass is off the rotors' centre, so that thrust turns the vehicle",
    )
    low, high, most, drawn, any_draws = 0.004, 0.010, 0.2, False, True
    units: ClassVar = {"distance": "m", "x": "m", "y": "m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A distance in any direction of the rotors' plane."""
        drawn, direction = generator.uniform(self.low, self.high), generator.uniform(-math.pi, math.pi)
        size = drawn if size is None else size
        return {"distance": size, "x": size * math.cos(direction), "y": size * math.sin(direction)}

    def scale(self, vehicle: Vehicle) -> float:
        """A distance on the frame."""
        return _times_larger(vehicle)

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Every rotor's arm is shorter by the offset."""
        cx, cy = numbers["x"], numbers["y"]

        def act(m: Motion) -> None:
            body = m.wrench
            for thrust in m.thrusts:
                body[3] += -cy * thrust
                body[4] -= -cx * thrust

        airframe.on_body.append(act)


@register
class RotorDamage(TruthEffect):
    """A chipped propeller: one rotor gives less thrust, and drags less, at the same speed."""

    name, what = "rotor_damage", "one rotor gives less thrust than the others at the same speed"
    low, high, most, drawn, any_draws = 0.08, 0.16, 0.7, False, True
    units: ClassVar = {"loss": "1", "rotor": "1"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A share of the thrust of any one rotor, 1 to 4."""
        drawn, rotor = generator.uniform(self.low, self.high), generator.randint(1, 4)
        return {"loss": drawn if size is None else size, "rotor": float(rotor)}

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """Its thrust constant is smaller."""
        constants = list(train.thrust_constants)
        constants[round(numbers["rotor"]) - 1] *= 1.0 - numbers["loss"]
        a, b, c, d = constants
        return replace(train, thrust_constants=(a, b, c, d))


@register
class RateLoopLag(TruthEffect):
    """The autopilot filters the commanded body rates."""

    name, what = "rate_loop_lag", "body rates follow their command through a further lag"
    low, high, most, drawn, any_draws = 0.06, 0.09, 1.0, False, True
    units: ClassVar = {"time_constant": "s"}

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """The filter's time constant."""
        return replace(train, rate_filter=numbers["time_constant"])


@register
class Gyroscopic(TruthEffect):
    """Rotors have angular momentum: turning their axes and changing their speed takes torque from the body.

    The momentum of all rotors along the body's z axis, J sum s_i W_i, changes with the body's rates and with the
    rotors' speeds; the body gets the opposite (Newton-Euler; Bouabdallah 2007, thesis EPFL 3727).
    """

    name, what = (
        "gyroscopic",
        "the rotors' angular momentum couples roll and pitch, and their spin-up turns the body",
    )
    low, high, most, drawn, any_draws = 1.5e-5, 4e-5, 1.0, False, False
    units: ClassVar = {"inertia": "kg m^2"}

    def scale(self, vehicle: Vehicle) -> float:
        """A moment of inertia, of rotors that weigh the same share of the vehicle."""
        return vehicle.mass / _MASS * _times_larger(vehicle) ** 2

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Minus the change of momentum as seen from the body."""
        inertia, directions = numbers["inertia"], tuple(airframe.vehicle.rotor_directions)
        rate = 1.0 / airframe.dt
        before: list[float] = []

        def act(m: Motion) -> None:
            momentum = inertia * sum(s * w for s, w in zip(directions, m.speeds, strict=True))
            spin_up = (momentum - before[0]) * rate if before else 0.0
            before[:] = [momentum]
            body = m.wrench
            body[3] -= m.q * momentum
            body[4] += m.p * momentum
            body[5] -= spin_up

        airframe.on_body.append(act)


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
        size = generator.uniform(low, high)
        if name == "estimator_delay":
            size = round(size / PHYSICS_STEP) * PHYSICS_STEP
        hidden.append(Hidden(name, EFFECTS[name].draw(vehicle, size, generator)))
    return tuple(hidden)


def pool(request: str) -> list[str]:
    """Names of the effects that `random` or `any` draws from."""
    if request == "random":
        return [name for name, effect in EFFECTS.items() if effect.drawn]
    return [n for n, e in EFFECTS.items() if (e.drawn if e.any_draws is None else e.any_draws)]


def choose(
    requests: list[str], vehicle: Vehicle, seed: int, count: int = 1, strength: float = 1.0
) -> tuple[Hidden, ...]:
    """What to hide, from `NAME`, `NAME:SIZE`, `none`, `random` or `rich` requests; the same seed hides the same.

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
        name, colon, text = request.partition(":")
        if name not in EFFECTS:
            known = [*EFFECTS, "rich", "random", "any", "none"]
            close = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known)}"
            raise InputError(f"--hidden {request}: unknown effect '{name}'; {hint}")
        effect, size = EFFECTS[name], None
        if colon:
            try:
                size = float(text)
            except ValueError:
                raise InputError(
                    f"--hidden {request}: '{text}' is not a number; write NAME or NAME:SIZE"
                ) from None
            if not effect.least <= size <= effect.most:
                unit = next(iter(effect.units.values()))
                raise InputError(
                    f"--hidden {request}: size must be {effect.least:g} to {effect.most:g} {unit}"
                )
        chosen[name] = _make(name, size, vehicle, seed, strength)
    return tuple(chosen.values())


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


def install(
    vehicle: Vehicle, hidden: tuple[Hidden, ...], believed: Powertrain, sensors: Sensors, dt: float
) -> tuple[Powertrain, Airframe]:
    """The true powertrain and airframe: what the owner believes, changed by what is hidden."""
    train = believed
    for one in hidden:
        train = EFFECTS[one.name].powertrain(train, vehicle, one.parameters)
    airframe = Airframe(vehicle, train, dt)
    names = frozenset(one.name for one in hidden)
    for one in hidden:
        EFFECTS[one.name].attach(airframe, sensors, one.parameters, names)
    return train, airframe


def after_takeoff(hidden: tuple[Hidden, ...], vehicle: Vehicle) -> list[Event]:
    """What happens to the rigid body in flight, in the order of its times after take-off (s)."""
    events = (EFFECTS[one.name].event(vehicle, one.parameters) for one in hidden)
    return sorted((event for event in events if event is not None), key=lambda event: event[0])
