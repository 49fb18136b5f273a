"""What `model export` wrote, flown: in the simulator itself where it is installed, and by its own formulas.

Each plant reads the file that was written and nothing else. What is exported for one simulator is flown by the same
control law, inner loop, delay and sensors as any flight of ours, so that only the vehicle differs.
"""

from __future__ import annotations

import math
import runpy
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np
import pytest

from trueflight.groundstation.export.gazebo_sdf import motor_signal, square_motors
from trueflight.groundstation.export.target import Known, airframe_of
from trueflight.groundstation.export.targets import TARGETS
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.versions.store import add_effect
from trueflight.models.design import load_design
from trueflight.models.effects import effect_named
from trueflight.models.flight import Flight
from trueflight.models.frames import rotation_matrix
from trueflight.models.model import Model, rigid_body_model
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import GRAVITY, Vehicle, load_vehicle
from trueflight.sim_bridge import in_process
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.hidden import Hidden
from trueflight.sim_bridge.truth.sensors import Noise
from trueflight.sim_bridge.world import PHYSICS_STEP

FOLDER = Path(__file__).parents[2] / "models" / "vehicles" / "quad5"
UP = np.array([0.0, 0.0, 1.0])

GAIN, DRAG = Hidden("thrust_gain", {"gain": 1.08}), Hidden("rotor_drag", {"x": 0.40, "y": 0.45})
FRAME = Hidden("parasitic_drag", {"x": 0.05, "y": 0.06, "z": 0.08})
HIDDEN: dict[str, tuple[Hidden, ...]] = {
    "thrust, drag, lag": (GAIN, DRAG, Hidden("motor_lag", {"time_constant": 0.04})),
    "thrust, curve": (GAIN, Hidden("thrust_curve", {"speed_blend": 0.5})),
    "both drags": (DRAG, FRAME),
    "both drags, wind": (
        DRAG,
        FRAME,
        Hidden("wind", {"east": 3.0, "north": -1.5, "speed": 3.35, "drag": 0.4}),
    ),
}
"""What is hidden before it is found, exported and flown elsewhere."""


class Plant(Protocol):
    """A vehicle of another simulator: from motion and motor commands to the motion one physics step later.

    `position` (7,) is x y z and quaternion w x y z, `velocity` (6,) linear in the world and body rates.
    """

    def move(
        self, position: np.ndarray, velocity: np.ndarray, commands: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]: ...


class Elsewhere(Simulator):
    """Our simulator with another one's vehicle in it."""

    plant: Plant

    def _turn(self, velocity: list[float], motors: list[float]) -> None:
        position = np.array(self._position.tolist())
        self.airframe.act(position.tolist(), velocity, motors, self._wrench)  # tells the sensors how it moves
        moved = self.plant.move(position, np.array(velocity), np.array(motors))
        self.world.data.qpos[:], self.world.data.qvel[:] = moved
        self.time_us += round(PHYSICS_STEP * 1e6)
        self._estimate = None


class Mujoco:
    """The MJCF in MuJoCo."""

    def __init__(self, text: str) -> None:
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        assert self.model.opt.timestep == PHYSICS_STEP
        self.curve = self.model.numeric("thrust_curve").data
        self.wind = self.model.opt.wind.copy()
        self.started = False

    def move(
        self, position: np.ndarray, velocity: np.ndarray, commands: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        data = self.data
        data.qpos[:], data.qvel[:] = position, velocity
        each = sum(c * commands ** (k + 1) for k, c in enumerate(self.curve)) / len(commands)
        data.ctrl[: len(each)] = each
        if not self.started:
            data.act[:] = each[: len(data.act)]
            self.started = True
        air = rotation_matrix(position[3:]).T @ self.wind
        for i in range(len(each), self.model.nu):
            data.ctrl[i] = air["xyz".index(self.model.actuator(i).name[-1])]
        mujoco.mj_step(self.model, data)
        return data.qpos.copy(), data.qvel.copy()


class Rigid:
    """A rigid body under `force` (N) and `torque` (N m) in the body, as a simulator's formulas have them, of what
    drives its rotors: `drive` follows `target(commands)` with `lag` s."""

    mass: float
    inertia: np.ndarray
    lag: float

    def target(self, commands: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def wrench(self, drive: np.ndarray, air: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError

    wind = np.zeros(3)
    drive: np.ndarray | None = None

    def move(
        self, position: np.ndarray, velocity: np.ndarray, commands: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        rotation, rates = rotation_matrix(position[3:]), velocity[3:]
        target = self.target(commands)
        before = target if self.drive is None else self.drive
        self.drive = target + (before - target) * math.exp(-PHYSICS_STEP / self.lag)
        air = rotation.T @ (velocity[:3] - self.wind)
        force, torque = self.wrench(0.5 * (before + self.drive), air, rates)
        linear = velocity[:3] + PHYSICS_STEP * (rotation @ force / self.mass - GRAVITY * UP)
        turned = rates + PHYSICS_STEP * (torque - np.cross(rates, self.inertia * rates)) / self.inertia
        quaternion = np.zeros(4)
        mujoco.mju_copy(quaternion, position[3:])
        mujoco.mju_quatIntegrate(quaternion, turned, PHYSICS_STEP)
        place = position[:3] + PHYSICS_STEP * linear
        return np.concatenate([place, quaternion]), np.concatenate([linear, turned])


class RotorPyFormulas(Rigid):
    """`Multirotor.compute_body_wrench` of RotorPy, from the parameter file."""

    def __init__(self, path: Path) -> None:
        self.module = runpy.run_path(str(path))
        p = self.p = self.module["quad_params"]
        self.mass, self.lag, self.wind = p["mass"], p["tau_m"], self.module["wind"]
        self.inertia = np.array([p["Ixx"], p["Iyy"], p["Izz"]])
        self.hubs = np.array(list(p["rotor_pos"].values()))

    def target(self, commands: np.ndarray) -> np.ndarray:
        speeds: np.ndarray = self.module["motor_speeds"](commands)
        return speeds

    def wrench(self, drive: np.ndarray, air: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p = self.p
        local = air + np.cross(rates, self.hubs)
        hubs = -drive[:, None] * np.array([p["k_d"], p["k_d"], p["k_z"]]) * local
        hubs[:, 2] += p["k_eta"] * drive**2 + p["k_h"] * (local[:, 0] ** 2 + local[:, 1] ** 2)
        frame = -np.linalg.norm(air) * np.array([p["c_Dx"], p["c_Dy"], p["c_Dz"]]) * air
        yaw = float(np.sum(p["rotor_directions"] * p["k_m"] * drive**2))
        return hubs.sum(axis=0) + frame, np.cross(self.hubs, hubs).sum(axis=0) + yaw * UP


class CrazyflowFormulas(Rigid):
    """`dynamics` of crazyflow's and drone-models' first_principles, from the section of the parameter file."""

    def __init__(self, path: Path) -> None:
        (p,) = tomllib.loads(path.read_text()).values()
        self.p, self.mass, self.lag = p, p["mass"], 1.0 / p["rotor_dyn_coef"][0]
        self.inertia = np.diag(p["J"])
        self.mixing, self.drag = np.array(p["mixing_matrix"]), np.array(p["drag_matrix"])

    def target(self, commands: np.ndarray) -> np.ndarray:
        thrust = sum(c * commands ** (k + 1) for k, c in enumerate(self.p["thrust_curve"])) / 4.0
        return np.sqrt(thrust / self.p["rpm2thrust"][2])

    def wrench(self, drive: np.ndarray, air: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p = self.p
        thrust, torque = p["rpm2thrust"][2] * drive**2, p["rpm2torque"][2] * drive**2
        roll, pitch, _ = self.mixing @ thrust * p["L"]
        return thrust.sum() * UP + self.drag @ air, np.array([roll, pitch, (self.mixing @ torque)[2]])


class GazeboFormulas(Rigid):
    """`MulticopterMotorModel` and `Hydrodynamics` of gz-sim, from the SDF; PX4 in front of it with THR_MDL_FAC and
    SIM_GZ_EC_MAX as its notes say."""

    def __init__(self, text: str, factor: float) -> None:
        model = ET.fromstring(text).find("model")
        assert model is not None
        self.model, self.factor = model, factor
        self.motors = [
            p for p in model.iter("plugin") if p.get("filename", "").startswith("gz-sim-multicopter")
        ]
        water = [p for p in model.iter("plugin") if p.get("filename", "").startswith("gz-sim-hydro")]
        self.lag = number(self.motors[0], "timeConstantUp")
        self.fastest = number(self.motors[0], "maxRotVelocity")
        names = ("motorConstant", "rotorDragCoefficient", "momentConstant")
        self.constants, self.drags, self.moments = (
            np.array([number(motor, name) for motor in self.motors]) for name in names
        )
        self.turns = np.array([1 if m.findtext("turningDirection") == "ccw" else -1 for m in self.motors])
        base, *rotors = model.findall("link")
        self.hubs = np.array([triple(link, "pose") for link in rotors])
        light = number(rotors[0], "inertial/mass")
        self.mass = number(base, "inertial/mass") + 4 * light
        own = np.array([number(rotors[0], f"inertial/inertia/{i}") for i in ("ixx", "iyy", "izz")])
        self.inertia = np.array([number(base, f"inertial/inertia/{i}") for i in ("ixx", "iyy", "izz")])
        for x, y, z in self.hubs:
            self.inertia += own + light * np.array([y * y + z * z, z * z + x * x, x * x + y * y])
        self.linear, self.quadratic = np.zeros(3), np.zeros((3, 3))
        for plugin in water:
            self.wind = triple(plugin, "default_current")
            self.linear = np.array([number(plugin, name, 0.0) for name in ("xU", "yV", "zW")])
            self.quadratic = np.array(
                [[number(plugin, f"{n}abs{k}", 0.0) for k in "UVW"] for n in ("xU", "yV", "zW")]
            )

    def target(self, commands: np.ndarray) -> np.ndarray:
        return motor_signal(commands, self.factor) * self.fastest

    def wrench(self, drive: np.ndarray, air: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        thrust = self.constants * drive**2
        local = air + np.cross(rates, self.hubs)
        hubs = -(drive * self.drags)[:, None] * (local * (1.0 - UP))
        hubs[:, 2] += thrust
        frame = (self.linear + self.quadratic @ np.abs(air)) * air
        yaw = -float(np.sum(self.turns * thrust * self.moments))
        return hubs.sum(axis=0) + frame, np.cross(self.hubs, hubs).sum(axis=0) + yaw * UP


class SihFormulas(Rigid):
    """`Sih::generate_force_and_torques` of PX4 for a quadcopter, from the parameter file; x forward, y left, z up."""

    def __init__(self, text: str) -> None:
        p = self.p = parameters(text)
        self.mass, self.lag = p["SIH_MASS"], p["SIH_T_TAU"]
        self.inertia = np.array([p["SIH_IXX"], p["SIH_IYY"], p["SIH_IZZ"]])
        assert p["THR_MDL_FAC"] == 0.0

    def target(self, commands: np.ndarray) -> np.ndarray:
        return commands

    def wrench(self, drive: np.ndarray, air: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p, (a, b, c, d) = self.p, drive
        roll = p["SIH_L_ROLL"] * p["SIH_T_MAX"] * (-a + b + c - d)
        pitch = p["SIH_L_PITCH"] * p["SIH_T_MAX"] * (a - b + c - d)
        yaw = p["SIH_Q_MAX"] * (a + b - c - d)
        force = p["SIH_T_MAX"] * drive.sum() * UP - p["SIH_KDV"] * air
        return force, np.array([roll, -pitch, -yaw])  # FRD to FLU


class RotorPy:
    """The parameter file in RotorPy's own `Multirotor`."""

    def __init__(self, path: Path) -> None:
        multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")
        self.module = runpy.run_path(str(path))
        self.vehicle = multirotor.Multirotor(self.module["quad_params"])
        self.speeds: np.ndarray | None = None

    def move(
        self, position: np.ndarray, velocity: np.ndarray, commands: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        speeds = self.module["motor_speeds"](commands)
        w, x, y, z = position[3:]
        state = {
            "x": position[:3],
            "v": velocity[:3],
            "q": np.array([x, y, z, w]),
            "w": velocity[3:],
            "wind": self.module["wind"],
            "rotor_speeds": speeds if self.speeds is None else self.speeds,
        }
        after = self.vehicle.step(state, {"cmd_motor_speeds": speeds}, PHYSICS_STEP)
        self.speeds = after["rotor_speeds"]
        x, y, z, w = after["q"]
        return np.array([*after["x"], w, x, y, z]), np.array([*after["v"], *after["w"]])


class DroneModels:
    """The section of the parameter file in drone-models' own first principles, integrated by the midpoint rule."""

    def __init__(self, path: Path) -> None:
        self.dynamics = pytest.importorskip("drone_models.first_principles").dynamics
        (table,) = tomllib.loads(path.read_text()).values()
        names = ("mass", "L", "prop_inertia", "gravity_vec", "J", "rpm2thrust", "rpm2torque", "mixing_matrix")
        arrays = {name: np.array(table[name]) for name in (*names, "drag_matrix", "rotor_dyn_coef")}
        self.numbers = {**arrays, "J_inv": np.linalg.inv(arrays["J"])}
        self.formulas = CrazyflowFormulas(path)
        self.speeds: np.ndarray | None = None

    def move(
        self, position: np.ndarray, velocity: np.ndarray, commands: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        target = self.formulas.target(commands)
        speeds = target if self.speeds is None else self.speeds
        w, x, y, z = position[3:]
        quaternion = np.array([x, y, z, w])
        _, _, linear, turning, spin = self.dynamics(
            position[:3], quaternion, velocity[:3], velocity[3:], target, speeds, **self.numbers
        )
        middle = velocity + 0.5 * PHYSICS_STEP * np.concatenate([linear, turning])
        _, _, linear, turning, spin = self.dynamics(
            position[:3], quaternion, middle[:3], middle[3:], target, speeds + 0.5 * PHYSICS_STEP * spin,
            **self.numbers,
        )  # fmt: skip
        self.speeds = speeds + PHYSICS_STEP * spin
        after = velocity + PHYSICS_STEP * np.concatenate([linear, turning])
        turned = position[3:].copy()
        mujoco.mju_quatIntegrate(turned, 0.5 * (velocity[3:] + after[3:]), PHYSICS_STEP)
        place = position[:3] + 0.5 * PHYSICS_STEP * (velocity[:3] + after[:3])
        return np.concatenate([place, turned]), after


def number(element: ET.Element, name: str, default: float | None = None) -> float:
    """A number of an XML file; the default, or none at all, where it is not there."""
    text = element.findtext(name)
    if text is None and default is not None:
        return default
    assert text is not None, name
    return float(text)


def triple(element: ET.Element, name: str) -> np.ndarray:
    """The first three numbers of an element."""
    return np.array([float(word) for word in (element.findtext(name) or "").split()[:3]])


def parameters(text: str) -> dict[str, float]:
    """A `.params` file as QGroundControl reads it: five words between tabs, `#` before remarks."""
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert all(len(row) == 5 and row[:2] == ["1", "1"] and len(row[2]) <= 16 for row in rows)
    assert all(row[4] == ("9" if "." in row[3] or "e" in row[3] or row[4] == "9" else "6") for row in rows)
    return {row[2]: float(row[3]) for row in rows}


def vehicle() -> Vehicle:
    """The shipped quadrotor."""
    return load_vehicle(FOLDER / "vehicle.toml")


def flown(path: Path, seed: int, hidden: tuple[Hidden, ...] = (), plant: Plant | None = None) -> Flight:
    """A survey flight with the sensors' noise: in our simulator with something hidden, or in another one's."""
    made: Callable[..., Simulator] = Simulator
    if plant is not None:
        made = type("Flown", (Elsewhere,), {"plant": plant})
    believed = vehicle()
    plan = Plan(
        believed,
        load_design(FOLDER / "design.json", believed),
        trajectory("excitation"),
        hidden,
        seed,
        noise=Noise(),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(in_process, "Simulator", made)
        assert in_process.record(plan, path).outcome == "finished"
    return read_flight(path)


def found_in(flight: Flight) -> Model:
    """Exact rotation with every effect that a diagnosis finds missing; what acts through another comes after it."""
    model = rigid_body_model(flight.vehicle)
    names = missing(flight, model)
    for name in sorted(names, key=lambda name: bool(effect_named(name).acts_through)):
        model = add_effect(model, name, [flight])
    return model


def missing(flight: Flight, model: Model) -> list[str]:
    """The effects that a diagnosis calls missing from a model."""
    return [effect.name for effect in diagnose(flight, model).effects if effect.verdict == "missing"]


def held(model: Model, to: str) -> Model:
    """What of a model a target says that it holds, whole or roughly."""
    lines = {line.effect: line.held for line in TARGETS[to].write(model, Known()).lines}
    return model.with_terms(tuple(term for term in model.terms if lines[term.effect] != "not"))


def formulas(model: Model, to: str, folder: Path) -> Rigid:
    """The formulas of a simulator with the file that is written for it."""
    path = folder / f"vehicle{TARGETS[to].ending}"
    path.write_text(TARGETS[to].write(model, Known()).text)
    if to == "gazebo":
        airframe = airframe_of(model)
        plant = GazeboFormulas(path.read_text(), square_motors(airframe)[0])
        plant.wind = np.array([*airframe.moving_air, 0.0])  # of the world, as the notes say
        return plant
    if to == "px4-sih":
        return SihFormulas(path.read_text())
    return RotorPyFormulas(path) if to == "rotorpy" else CrazyflowFormulas(path)


def itself(model: Model, to: str, folder: Path) -> Plant:
    """A simulator itself with the file that is written for it; the test is skipped where it is not installed."""
    path = folder / f"vehicle{TARGETS[to].ending}"
    path.write_text(TARGETS[to].write(model, Known()).text)
    if to == "mujoco":
        return Mujoco(path.read_text())
    return RotorPy(path) if to == "rotorpy" else DroneModels(path)
