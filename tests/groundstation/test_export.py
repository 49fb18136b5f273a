"""A model for other simulators, autopilots and solvers: its numbers by plain algebra, and flown there."""

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import elsewhere
import mujoco
import numpy as np
import pytest
import sympy
from programs import run

from trueflight.groundstation.export.equations import equations
from trueflight.groundstation.export.gazebo_sdf import square_motors
from trueflight.groundstation.export.px4_params import thrust_model_factor
from trueflight.groundstation.export.target import Known, Written, airframe_of
from trueflight.groundstation.export.targets import TARGETS, export
from trueflight.groundstation.versions.store import refit
from trueflight.models.effect import Motion, Stage
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.frames import rotation_matrix
from trueflight.models.model import Model, Term, write_model
from trueflight.models.prediction import acceleration, apply_effects
from trueflight.models.vehicle import GRAVITY

VEHICLE = elsewhere.vehicle()
DRAG = {"rotor_drag": {"x": 0.4, "y": 0.4}}
FRAME = {"parasitic_drag": {"x": 0.05, "y": 0.06, "z": 0.08}}
THRUST = {"thrust_gain": {"gain": 1.1}, "thrust_curve": {"curvature": 0.25}, "motor_lag": {"tau": 0.04}}
CLIMB = {"axial_inflow": {"slope": 0.2}}
LIFT = {"translational_lift": {"lift": 0.02}}
WIND = {"wind": {"x": 2.0, "y": -1.0}}


def model_with(*effects: Mapping[str, Mapping[str, float]]) -> Model:
    """A model of the shipped vehicle with these effects."""
    terms = [Term(name, values) for some in effects for name, values in some.items()]
    return Model(VEHICLE, (Term("rigid_body", {}), *terms), version=1)


def written(model: Model, to: str, known: Known | None = None) -> Written:
    return TARGETS[to].write(model, known or Known())


def believed(model: Model, command: float, state: np.ndarray) -> np.ndarray:
    """The model's acceleration (world) at a command and a motion, by the formulas that fit and predict."""
    rotation = rotation_matrix(state[6:10])[None]
    thrust = np.array([float(VEHICLE.thrust(np.array(command))) / VEHICLE.mass])
    zero = np.zeros((1, 3))
    motion = Motion(
        vehicle=VEHICLE,
        dt=0.01,
        command=thrust,
        thrust=thrust,
        force=zero,
        reading=zero,
        rotation=rotation,
        euler=(np.zeros(1), np.zeros(1)),
        air_velocity=state[None, 3:6],
        cos_yaw=np.ones(1),
        sin_yaw=np.zeros(1),
        height=state[2:3],
        voltage=np.full(1, 15.0),
    )
    return np.asarray(acceleration(apply_effects(motion, model.effect_chain())))[0]


def states(count: int) -> list[np.ndarray]:
    """Position, velocity (world) and quaternion of motions of any kind."""
    generator = np.random.default_rng(4)
    made = []
    for _ in range(count):
        quaternion = np.array([1.0, *generator.normal(0.0, 0.3, 3)])
        made.append(
            np.concatenate(
                [
                    generator.uniform(0.3, 2.0, 3),
                    generator.normal(0.0, 3.0, 3),
                    quaternion / np.linalg.norm(quaternion),
                ]
            )
        )
    return made


def felt(plant: elsewhere.Rigid, command: float, state: np.ndarray) -> np.ndarray:
    """A plant's acceleration (world) with its rotors settled at a command."""
    rotation = rotation_matrix(state[6:10])
    force, _ = plant.wrench(
        plant.target(np.full(4, command)), rotation.T @ (state[3:6] - plant.wind), np.zeros(3)
    )
    return rotation @ force / plant.mass - np.array([0.0, 0.0, GRAVITY])


@pytest.mark.parametrize(
    ("to", "model"),
    [
        ("rotorpy", model_with(DRAG, FRAME, THRUST, CLIMB, LIFT, WIND)),
        ("crazyflow", model_with(THRUST)),
        ("gazebo", model_with(DRAG, {"thrust_gain": {"gain": 1.1}}, WIND)),
        ("px4-sih", model_with({"thrust_gain": {"gain": 1.1}})),
    ],
    ids=["rotorpy", "crazyflow", "gazebo", "px4-sih"],
)
def test_what_is_held_whole_gives_the_same_acceleration_by_the_simulators_own_formulas(
    to: str, model: Model, tmp_path: Path
) -> None:
    plant = elsewhere.formulas(model, to, tmp_path)
    for state in states(20):
        for command in (0.2, 0.38, 0.6):
            assert felt(plant, command, state) == pytest.approx(believed(model, command, state), abs=1e-6)


def test_drag_that_is_held_roughly_is_that_of_the_hover_and_of_each_axis(tmp_path: Path) -> None:
    hover = VEHICLE.hover_thrust
    for to in ("crazyflow", "gazebo"):
        model = model_with({"rotor_drag": {"x": 0.3, "y": 0.5}}, FRAME if to == "gazebo" else {})
        plant = elsewhere.formulas(model, to, tmp_path)
        for axis in range(3):
            state = np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
            state[3 + axis] = -2.5
            assert felt(plant, hover, state) == pytest.approx(believed(model, hover, state), abs=1e-6)


def test_mujoco_drags_on_each_axis_and_blows_as_the_model_does() -> None:
    model = model_with({"rotor_drag": {"x": 0.3, "y": 0.5}}, FRAME, CLIMB, {"thrust_gain": {"gain": 1.1}})
    loaded = mujoco.MjModel.from_xml_string(written(model, "mujoco").text)
    hover = VEHICLE.hover_thrust / 1.1  # where thrust is the weight, and the rotors turn as in a hover
    for wind in (0.0, 1.5):
        for axis in range(3):
            data = mujoco.MjData(loaded)
            loaded.opt.wind[:] = 0.0
            loaded.opt.wind[axis] = wind
            state = np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
            state[3 + axis] = -2.5
            data.qpos[:] = (*state[:3], *state[6:])
            data.qvel[:3] = state[3:6]
            data.act[:] = airframe_of(model).thrust(hover) / 4
            data.ctrl[4 + axis] = wind
            mujoco.mj_forward(loaded, data)
            state[3 + axis] -= wind
            assert data.qacc[:3] == pytest.approx(believed(model, hover, state), abs=1e-4)
            assert data.qacc[3:] == pytest.approx(np.zeros(3), abs=1e-6)


def test_rotors_turn_the_vehicle_the_same_way_everywhere(tmp_path: Path) -> None:
    """One rotor pushed harder, on a vehicle whose centre of mass is off: roll, pitch and yaw by r x F."""
    model = model_with({"com_offset": {"x": 0.01, "y": -0.006}})
    plants = {to: elsewhere.formulas(model, to, tmp_path) for to in ("rotorpy", "crazyflow", "gazebo")}
    loaded = mujoco.MjModel.from_xml_string(written(model, "mujoco").text)
    px4 = elsewhere.parameters(written(model, "px4", Known(torque_length=0.07 * 0.127)).text)
    for rotor in range(4):
        commands = np.full(4, 0.38)
        commands[rotor] += 0.05
        thrusts = VEHICLE.thrust(commands) / 4
        arms = np.array(VEHICLE.rotor_positions) - [0.01, -0.006, 0.0]
        torque = np.cross(arms, thrusts[:, None] * [0.0, 0.0, 1.0]).sum(axis=0)
        torque[2] -= np.dot(VEHICLE.rotor_directions, thrusts) * 0.07 * 0.127
        for to, plant in plants.items():
            _, turned = plant.wrench(plant.target(commands), np.zeros(3), np.zeros(3))
            assert turned == pytest.approx(torque, abs=1e-6), to
        data = mujoco.MjData(loaded)
        data.qpos[2] = 2.0
        data.act[:] = thrusts
        mujoco.mj_forward(loaded, data)
        assert data.qacc[3:] * VEHICLE.inertia == pytest.approx(torque, abs=1e-6)
        allocated = np.zeros(3)
        for i, thrust in enumerate(thrusts):
            place, axis = (np.array([px4[f"CA_ROTOR{i}_{kind}{a}"] for a in "XYZ"]) for kind in "PA")
            allocated += thrust * (np.cross(place, axis) - px4[f"CA_ROTOR{i}_KM"] * axis)
        assert allocated * [1, -1, -1] == pytest.approx(torque, abs=1e-6)  # PX4's body is FRD


def test_px4_hovers_bends_and_drags_by_its_own_formulas() -> None:
    gain, curve = {"thrust_gain": {"gain": 1.1}}, {"thrust_curve": {"curvature": 0.25}}
    model = model_with(gain, curve, {"rotor_drag": {"x": 0.3, "y": 0.4}}, FRAME)
    p = elsewhere.parameters(written(model, "px4").text)
    airframe = airframe_of(model)
    factor = p["THR_MDL_FAC"]
    for share in (0.2, 0.5, 0.9):  # a share of full thrust, as PX4 turns it into a motor signal
        rest = 1.0 - factor
        signal = (np.sqrt(rest**2 + 4.0 * factor * share) - rest) / (2.0 * factor)
        assert airframe.thrust(signal) / airframe.thrust(1.0) == pytest.approx(share, abs=1e-6)
    assert p["MPC_THR_HOVER"] * airframe.thrust(1.0) == pytest.approx(VEHICLE.weight, rel=1e-6)
    assert p["EKF2_MCOEF"] == pytest.approx(0.35)
    state = np.array([0.0, 0.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    frame_alone = believed(model_with(FRAME), VEHICLE.hover_thrust, state)[0]
    assert -0.5 * 1.225 / p["EKF2_BCOEF_X"] * 3.0 * 3.0 == pytest.approx(frame_alone, rel=1e-6)


def test_a_thrust_curve_that_px4_cannot_bend_says_by_how_much_it_differs() -> None:
    straight, square = (airframe_of(model_with()).with_(curve=curve) for curve in ((20.0,), (0.0, 20.0)))
    assert thrust_model_factor(square) == pytest.approx((1.0, 0.0), abs=1e-9)
    assert thrust_model_factor(straight) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert square_motors(straight) == pytest.approx((1.0, 20.0, 0.0), abs=1e-9)
    assert square_motors(square) == pytest.approx((0.0, 20.0, 0.0), abs=1e-9)
    falling = written(model_with({"thrust_curve": {"curvature": -0.5}}), "px4")
    assert falling.lines[-1].held == "roughly" and "%" in falling.lines[-1].how
    assert any("falls beyond a command" in note for note in falling.notes)
    assert elsewhere.parameters(falling.text)["MPC_THR_HOVER"] == pytest.approx(
        VEHICLE.hover_thrust, rel=1e-6
    )


def test_sih_is_told_nothing_that_its_own_vehicle_does_not_do() -> None:
    model = model_with(FRAME, {"com_offset": {"x": 0.01, "y": 0.0}}, DRAG)
    made = written(model, "px4-sih")
    p = elsewhere.parameters(made.text)
    assert [line.held for line in made.lines] == ["whole", "not", "not", "roughly"]
    assert p["EKF2_BCOEF_X"] == 0.0 and p["CA_ROTOR0_PX"] == -p["CA_ROTOR1_PX"]
    assert p["SIH_KDV"] / p["SIH_MASS"] == pytest.approx(p["EKF2_MCOEF"]) == 0.4


def test_the_written_equations_are_the_model_for_every_effect_that_acts_on_the_motion() -> None:
    everything = [
        {e.name: e.typical(hovering())} for e in catalogue().values() if e.parameters and not e.rotational
    ]
    model = model_with(*everything)
    made = equations(model)
    call = sympy.lambdify([made.state, made.inputs, list(made.parameters)], made.derivative, "numpy")
    numbers = [15.0 if str(name) == "voltage" else value for name, value in made.parameters.items()]
    moves = {name for name, e in catalogue().items() if e.stage not in (Stage.COMMAND, Stage.SENSOR)}
    settled = model.with_terms(tuple(term for term in model.terms if term.effect in moves))
    settled = replace(settled, vehicle=replace(VEHICLE, motor_time_constant=0.0, command_delay=0.0))
    for state in states(10):
        at = np.concatenate([state, [np.sqrt(0.45 / VEHICLE.hover_thrust)], [0.1, -0.2, 0.3]])
        out = call(at, [0.45, 0.0, 0.0, 0.0], numbers)
        assert out[3:6] == pytest.approx(believed(settled, 0.45, state), abs=1e-9)
        assert out[10] == pytest.approx(0.0, abs=1e-9)  # the rotors have settled
    assert {line.effect for line in made.lines} == set(model.names())


def hovering() -> Motion:
    """A hover at 1 m, of which effects tell their typical sizes."""
    one = np.ones(2)
    return Motion(VEHICLE, 0.01, GRAVITY * one, GRAVITY * one, np.zeros((2, 3)), np.zeros((2, 3)), height=one)


@pytest.mark.parametrize("solver", ["sympy", "casadi"])
def test_a_solver_computes_what_the_model_does(solver: str, tmp_path: Path) -> None:
    pytest.importorskip(solver)
    model = model_with(DRAG, FRAME, {"ground_effect": {"rho": 1.2}}, {"battery_sag": {"exponent": 1.5}}, WIND)
    path = tmp_path / "model.py"
    export(model, solver, path, Known())
    names: dict[str, object] = {}
    exec(compile(path.read_text(), str(path), "exec"), names)
    values = [15.0 if name == "voltage" else value for name, value in names["PARAMETERS"].items()]  # type: ignore[attr-defined]
    for state in states(5):
        x = np.concatenate([state, [1.0], [0.1, -0.2, 0.3]])
        u = [VEHICLE.hover_thrust, 0.0, 0.0, 0.0]
        if solver == "casadi":
            out = np.array(names["model"]()(x, u, values)).ravel()  # type: ignore[operator]
        else:
            sx, su, sp, derivative = names["model"]()  # type: ignore[operator]
            out = np.array(sympy.lambdify([sx, su, sp], derivative)(x, u, values), dtype=float).ravel()
        assert out[3:6] == pytest.approx(believed(model, VEHICLE.hover_thrust, state), abs=1e-9)
        turning = rotation_matrix(state[6:] + 1e-6 * out[6:10]) - rotation_matrix(state[6:])
        spin = rotation_matrix(state[6:]).T @ turning / 1e-6
        assert [spin[2, 1], spin[0, 2], spin[1, 0]] == pytest.approx([0.1, -0.2, 0.3], abs=1e-4)


def test_every_effect_is_told_of_once_in_every_file(tmp_path: Path) -> None:
    effects = catalogue()
    model = model_with(*({e.name: e.typical(hovering())} for e in effects.values() if e.parameters))
    model = replace(model, vehicle=replace(VEHICLE, name="a--b"))
    for to, target in TARGETS.items():
        made = written(model, to)
        assert [line.effect for line in made.lines] == list(model.names()), to
        assert all(line.how and "\n" not in line.how for line in made.lines)
        for name in model.names():
            assert name in made.text, (to, name)
        if target.ending in (".xml", ".sdf"):
            ET.fromstring(made.text)
        assert "nan" not in made.text and "inf," not in made.text
    names = [
        e.get("name")
        for e in ET.fromstring(written(model, "gazebo").text).iter()
        if e.tag in ("link", "joint")
    ]
    assert len(names) == len(set(names)) == 9


def test_the_table_of_the_documentation_is_what_the_files_hold() -> None:
    text = (Path(__file__).parents[2] / "docs" / "export.md").read_text()
    rows = [line.strip()[1:-1].split("|") for line in text.splitlines() if line.startswith("| `")]
    targets = ("mujoco", "rotorpy", "crazyflow", "gazebo", "px4", "px4-sih", "sympy")
    marks = {"whole": "●", "roughly": "○", "not": ""}
    told = {name.strip(" `"): cells for first, *cells in rows for name in first.split(",")}
    assert set(told) == set(catalogue())
    for name, effect in catalogue().items():
        carrier = {one: {"x": 0.3, "y": 0.3} for one in effect.acts_through[:1]}
        model = model_with(carrier, {name: effect.typical(hovering())} if effect.parameters else {})
        for to, cell in zip(targets, told[name], strict=True):
            line = next(line for line in written(model, to).lines if line.effect == name)
            assert cell.strip()[:1] == marks[line.held], (name, to)


def test_what_cannot_be_exported_is_one_line_and_no_file(tmp_path: Path) -> None:
    store, out = tmp_path / "store", tmp_path / "out"
    write_model(model_with(DRAG), store / "quad5" / "v0001-rotor_drag.json")
    bare = replace(VEHICLE, inertia=(0.0, 0.0, 0.0))
    write_model(replace(model_with(), vehicle=bare), store / "bare" / "v0001-rigid_body.json")
    weak = model_with({"thrust_gain": {"gain": 0.3}})
    write_model(
        replace(weak, vehicle=replace(VEHICLE, name="weak")), store / "weak" / "v0001-thrust_gain.json"
    )
    asked = {
        "no such target": ("v1", "--to", "unity", "-o", out / "a.xml"),
        "wants .xml": ("v1", "--to", "mujoco", "-o", out / "a.sdf", "--vehicle-name", "quad5"),
        "--vehicle-name": ("v1", "--to", "mujoco", "-o", out / "a.xml"),
        "--flight": ("v1", "-o", out / "a.onnx"),
        "no model version": ("v7", "--to", "mujoco", "-o", out / "a.xml", "--vehicle-name", "quad5"),
        "rigid body": ("v1", "--to", "gazebo", "-o", out / "a.sdf", "--vehicle-name", "bare"),
        "N at most": ("v1", "--to", "px4", "-o", out / "a.params", "--vehicle-name", "weak"),
        "--vehicle FILE": ("linear", "--to", "px4", "-o", out / "a.params"),
        "above 0": (
            *("v1", "--to", "px4", "-o", out / "a.params", "--vehicle-name", "quad5"), "--hover-speed", "-3",
        ),
    }  # fmt: skip
    for said, words in asked.items():
        ended = run("groundstation", "model", "export", *words, "--store", store)
        assert ended.returncode == 2 and said in ended.stderr, (said, ended.stderr)
        assert len(ended.stderr.strip().splitlines()) == 1 and "Traceback" not in ended.stderr
        assert not out.exists()
    words = (
        "v1",
        "--to",
        "mujoco",
        "-o",
        out / "a.xml",
        "--vehicle-name",
        "quad5",
        "--store",
        store,
        "--json",
    )
    told = json.loads(run("groundstation", "model", "export", *words).stdout)
    assert told["not_exported"] == [] and [e["held"] for e in told["effects"]] == ["whole", "roughly"]
    assert (out / "a.xml").read_text().startswith("<mujoco")


def test_a_formula_that_takes_no_symbols_is_one_line(tmp_path: Path) -> None:
    effect = (
        "import numpy as np\nfrom array_api_compat import array_namespace\n"
        "from trueflight.models.effect import Effect, Parameter, Stage\n\n\n"
        "def formula(motion, *, size):\n    {line}\n    return motion.with_(thrust=motion.thrust * size)\n\n\n"
        'EFFECT = Effect(name="odd", title="odd", stage=Stage.THRUST, formula=formula, '
        'parameters=(Parameter("size", "1", "size", 1.0, 1.1, 0.5, 2.0),), needs=("thrust_command",), '
        'manoeuvre="any", citation="none", unconfounded="a test\'s")\n'
    )
    for name, line, said in (
        ("a", "array_namespace(motion.thrust).erf(motion.thrust)", "odd: xp.erf has no symbolic form"),
        ("b", "np.interp(motion.thrust, [0.0, 1.0], [0.0, 1.0])", "odd: its formula takes no symbols"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "odd.py").write_text(effect.replace("{line}", line))
        model = replace(model_with(), effects_directory=str(folder))
        model = model.with_terms((*model.terms, Term("odd", {"size": 1.1})))
        with pytest.raises(InputError, match=said):
            written(model, "casadi")
        assert [line.held for line in written(model, "mujoco").lines] == ["whole", "not"]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Model:
    """Hidden in our simulator, flown, and found: the model that goes elsewhere."""
    hidden = elsewhere.HIDDEN["thrust, drag, lag"]
    flight = elsewhere.flown(tmp_path_factory.mktemp("ours") / "flight.mcap", 1, hidden)
    model = elsewhere.found_in(flight)
    assert set(model.names()) == {"rigid_body", *(one.name for one in hidden)}
    return model


def test_nothing_is_missing_where_the_exported_mjcf_flies(found: Model, tmp_path: Path) -> None:
    """And what is fitted there is what was exported: nothing is missing because it is there."""
    flight = elsewhere.flown(
        tmp_path / "there.mcap", 2, plant=elsewhere.Mujoco(written(found, "mujoco").text)
    )
    assert elsewhere.missing(flight, found) == []
    after = refit(found, [flight])
    for before, there in zip(found.terms, after.terms, strict=True):
        assert there.values == pytest.approx(before.values, rel=0.08), before.effect


@pytest.mark.long
@pytest.mark.parametrize("to", ["rotorpy", "crazyflow", "gazebo", "px4-sih"])
def test_nothing_is_missing_where_the_exported_numbers_fly(found: Model, to: str, tmp_path: Path) -> None:
    flight = elsewhere.flown(tmp_path / "there.mcap", 2, plant=elsewhere.formulas(found, to, tmp_path))
    # SIH drags along z as well: what no model of ours had goes in with the number of the other axes.
    assert elsewhere.missing(flight, found) == (["axial_inflow"] if to == "px4-sih" else [])


@pytest.mark.long
@pytest.mark.parametrize("to", ["rotorpy", "crazyflow"])
def test_nothing_is_missing_where_the_exported_file_flies_in_the_simulator_itself(
    found: Model, to: str, tmp_path: Path
) -> None:
    plant = elsewhere.itself(found, to, tmp_path)
    assert elsewhere.missing(elsewhere.flown(tmp_path / "there.mcap", 2, plant=plant), found) == []
