"""The rich truth: all effects at once, late samples, a payload picked up, and batteries that are half-full or old."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trueflight.models.design import Design
from trueflight.models.errors import InputError
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.autopilot import Autopilot
from trueflight.sim_bridge.in_process import Sample, fly, record
from trueflight.sim_bridge.mavlink.telemetry import STREAMS
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.seal import reveal, seal
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.airframe import believed_powertrain
from trueflight.sim_bridge.truth.battery import Battery, BatteryState, in_state
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import RICH, Hidden, choose
from trueflight.sim_bridge.truth.sensors import NO_NOISE, Sensors
from trueflight.sim_bridge.world import PHYSICS_STEP

ODOMETRY, ATTITUDE, HIGHRES_IMU = 331, 30, 105


def late(delay: float) -> Hidden:
    return Hidden("estimator_delay", {"delay": delay})


def payload(share: float, time: float) -> Hidden:
    return Hidden("payload", {"mass_fraction": share, "time": time})


# Rich


def test_rich_is_a_list_of_ordinary_effects_drawn_within_their_ranges(
    vehicle: Vehicle, tmp_path: Path
) -> None:
    for seed in range(30):
        hidden = choose(["rich"], vehicle, seed)
        assert [one.name for one in hidden] == list(RICH)
        for one in hidden:
            low, high = RICH[one.name]
            assert low - 1e-9 <= next(iter(one.parameters.values())) <= high + 1e-9
    assert choose(["rich"], vehicle, 3) == choose(["rich"], vehicle, 3) != choose(["rich"], vehicle, 4)
    seal(hidden, vehicle.name, 29, tmp_path / "a.sealed")
    assert reveal(tmp_path / "a.sealed")["effects"] == json.loads(
        json.dumps([one.answer() for one in hidden])
    )


def test_what_follows_rich_replaces_its_part_and_the_rest_stays(vehicle: Vehicle) -> None:
    plain = {one.name: one for one in choose(["rich"], vehicle, 2)}
    changed = {one.name: one for one in choose(["rich", "thrust_gain:1.15", "wind:4"], vehicle, 2)}
    assert changed["thrust_gain"].parameters == {"gain": 1.15}
    assert changed["wind"].parameters["speed"] == 4.0
    assert all(changed[name] == one for name, one in plain.items() if name != "thrust_gain")


def test_neither_random_nor_rich_loads_a_payload(vehicle: Vehicle) -> None:
    assert "payload" not in RICH
    drawn = {one.name for seed in range(100) for one in choose(["random"], vehicle, seed, 5)}
    assert not drawn & {"payload", "estimator_delay"}
    with pytest.raises(InputError, match="--hidden-count"):
        choose(["random"], vehicle, 0, len(EFFECTS))


def test_a_rich_truth_spoils_the_plain_cascade_on_every_axis(vehicle: Vehicle, design: Design) -> None:
    """Against the same flight with nothing hidden: centimetres along x and y, tens of them when half-empty in z."""
    plan = Plan(vehicle, design, trajectory("lemniscate"), seed=1, battery=BatteryState(0.5))
    rich = replace(plan, hidden=choose(["rich"], vehicle, 1))
    paths = []
    for one in (plan, rich):
        samples: list[Sample] = []
        assert fly(one, samples.append).outcome == "finished"
        paths.append(np.array([sample.position for sample in samples]))
    apart = np.sqrt(((paths[1] - paths[0]) ** 2).mean(0))
    assert np.all(apart[:2] > 0.03) and np.all(apart[:2] < 0.15)
    assert 0.1 < apart[2] < 0.4


# What is late


def moving(vehicle: Vehicle, *hidden: Hidden) -> Simulator:
    """A vehicle in the air, without noise."""
    simulator = Simulator(vehicle, hidden, noise=NO_NOISE)
    simulator.start_in_hover((0.0, 0.0, 5.0))
    return simulator


@pytest.mark.parametrize("delay", [0.002, 0.01, 0.034])
def test_a_late_sample_is_the_one_of_its_own_time(vehicle: Vehicle, delay: float) -> None:
    steps = round(delay / PHYSICS_STEP)
    on_time, delayed = moving(vehicle), moving(vehicle, late(delay))
    offset = delayed.time_us
    assert offset == pytest.approx(1e6 * delay)
    told = [on_time.estimate()]
    for i in range(200):
        if i >= steps:
            moment = told[i - steps]
            assert delayed.reported() == moment._replace(time_us=moment.time_us + offset)  # all of it
        assert delayed.reported().time_us == delayed.time_us - offset
        command, p = vehicle.hover_thrust * (1 + 0.2 * math.sin(0.1 * i)), math.sin(0.05 * i)
        for simulator in (on_time, delayed):
            simulator.step(command, p, -p, 0.3)
        told.append(on_time.estimate())


def test_without_a_delay_the_companion_hears_the_vehicles_own_sample(vehicle: Vehicle) -> None:
    simulator = moving(vehicle)
    simulator.step(0.4, 0.1, 0.0, 0.0)
    assert simulator.reported() is simulator.estimate()


def test_the_autopilot_itself_is_not_late(vehicle: Vehicle) -> None:
    simulator = moving(vehicle, late(0.02))
    for _ in range(50):
        simulator.step(0.5, 0.0, 0.0, 0.0)
    assert simulator.estimate().time_us - simulator.reported().time_us == 20_000
    assert simulator.estimate().position[2] > simulator.reported().position[2]


def test_late_samples_keep_the_statistics_of_the_noise(vehicle: Vehicle) -> None:
    """Asking for the autopilot's own sample and for the companion's in turn must not feed the wander."""
    sensors = Sensors(replace(NO_NOISE, position_wander=1.0, wander_time=1.0), 3)
    still = (
        [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
        [0.0] * 6,
        (0.0,) * 3,
        (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0),
        16.0,
    )
    out = []
    for i in range(20_000):
        sensors.sample(10_000 * i + 10_000, *still, [0.0] * 4)
        out.append(sensors.sample(10_000 * i, *still, [0.0] * 4).position)
    assert np.std(out) == pytest.approx(1.0, rel=0.2)


def test_odometry_attitude_and_imu_on_mavlink_are_late_together(vehicle: Vehicle) -> None:
    simulator = Simulator(vehicle, (late(0.01),), noise=NO_NOISE)
    autopilot = Autopilot(simulator, Parameters(vehicle))
    simulator.start_in_hover((0.0, 0.0, 5.0))
    heights = []
    for _ in range(100):
        simulator.step(0.5, 0.0, 0.0, 0.0)
        heights.append(simulator.estimate().position[2])
    odometry, imu, attitude = (STREAMS[i][0](autopilot) for i in (ODOMETRY, HIGHRES_IMU, ATTITUDE))
    assert odometry.time_usec == imu.time_usec == simulator.time_us - 10_000
    assert attitude.time_boot_ms == odometry.time_usec // 1000
    assert -odometry.z == pytest.approx(heights[-6])
    assert -imu.zacc == pytest.approx(simulator.reported().specific_force[2])


def test_in_flight_the_reference_is_that_of_the_samples_time(vehicle: Vehicle, design: Design) -> None:
    path = trajectory("circle", laps=1.0)
    samples: list[Sample] = []
    fly(Plan(vehicle, design, path, (late(0.01),), seed=2), samples.append)
    for sample in samples[::37]:
        now = path.at(1e-6 * sample.estimate.time_us)
        assert sample.reference.position == pytest.approx(now.position)
    times = np.array([sample.estimate.time_us for sample in samples])
    assert times[0] == 0 and np.all(np.diff(times) == 10_000)


def test_a_late_sample_makes_the_loop_later(vehicle: Vehicle, design: Design) -> None:
    """Seen from the samples, the rotors answer a command later by just the delay: by cross-correlation."""

    def answer(*hidden: Hidden) -> float:
        samples: list[Sample] = []
        plan = Plan(vehicle, design, trajectory("excitation", low=0.6), hidden, rate=500.0, noise=NO_NOISE)
        fly(plan, samples.append)
        command = np.diff([sample.step.thrust_command for sample in samples])
        force = np.diff([sample.estimate.specific_force[2] for sample in samples])
        shifts = np.arange(60)
        shared = [float(np.dot(command[: -60 or None], force[k : len(force) - 60 + k])) for k in shifts]
        return float(np.argmax(shared)) * PHYSICS_STEP

    assert answer(late(0.03)) - answer() == pytest.approx(0.03, abs=0.0041)


# Payload


def test_a_payload_takes_thrust_in_proportion_from_its_time_on(vehicle: Vehicle, design: Design) -> None:
    """What holds the hover after it, over what did before, is the ratio of the masses."""
    share = 0.2
    samples: list[Sample] = []
    plan = Plan(
        vehicle,
        design,
        trajectory("hover", height=3.0, duration=16.0),
        (payload(share, 6.0),),
        noise=NO_NOISE,
    )
    assert fly(plan, samples.append).outcome == "finished"
    command = np.array([sample.step.thrust_command for sample in samples])
    assert command[590] == pytest.approx(vehicle.hover_thrust, rel=1e-3)
    assert command[-1] / command[590] == pytest.approx(1.0 + share, rel=0.01)
    # A cascade without integral gives it by sinking: m g share over its stiffness along z.
    stiffness = design.K_eta[2][2]
    sunk = 3.0 - samples[-1].position[2]
    assert sunk == pytest.approx(share * vehicle.weight / stiffness, rel=0.02)
    before = next(i for i, sample in enumerate(samples) if sample.estimate.specific_force[2] < 0.95 * GRAVITY)
    assert before == pytest.approx(600, abs=2)


def test_a_payload_makes_the_vehicle_turn_slower(vehicle: Vehicle) -> None:
    simulator = Simulator(vehicle, (payload(1.0, 0.1),), noise=NO_NOISE)
    moments = simulator.world.model.body_inertia[1].copy()
    simulator.start_in_hover((0.0, 0.0, 5.0))
    for _ in range(100):
        simulator.step(vehicle.hover_thrust, 0.0, 0.0, 0.0)
    model = simulator.world.model
    assert model.body_mass[1] == pytest.approx(2.0 * vehicle.mass)
    cube = vehicle.mass * vehicle.rotor_radius**2 / 6.0
    assert model.body_inertia[1] == pytest.approx(moments + cube)


def test_the_time_of_a_payload_begins_at_take_off_and_it_is_gone_after_landing(vehicle: Vehicle) -> None:
    simulator = Simulator(vehicle, (payload(0.3, 0.5),), noise=NO_NOISE)
    mass = simulator.world.model.body_mass
    for flight in range(2):
        for _ in range(500):
            simulator.rest()
        for _ in range(400):  # idling on the ground is not flying
            simulator.step(0.1, 0.0, 0.0, 0.0)
        assert mass[1] == pytest.approx(vehicle.mass), flight
        while mass[1] == pytest.approx(vehicle.mass):
            simulator.step(0.6, 0.0, 0.0, 0.0)
            assert simulator.world.position[2] < 5.0
        assert mass[1] == pytest.approx(1.3 * vehicle.mass)
        while not simulator.world.touching:
            simulator.step(0.35, 0.0, 0.0, 0.0)


def test_what_begins_in_flight_acts_from_then_on_and_is_over_after_landing(vehicle: Vehicle) -> None:
    hidden = choose(["rotor_damage:0.5@0.5", "wind:4@1", "rotor_drag:0.3"], vehicle, 0)
    simulator = Simulator(vehicle, hidden, noise=NO_NOISE)
    airframe, whole = simulator.airframe, simulator.airframe.powertrain
    for flight in range(2):
        simulator.start_in_hover((0.0, 0.0, 5.0))
        weak = windy = 0
        for _ in range(600):
            simulator.step(vehicle.hover_thrust, 0.0, 0.0, 0.0)
            weak += airframe.powertrain != whole
            windy += airframe.wind != (0.0, 0.0, 0.0)
        assert (weak, windy) == (600 - 249, 600 - 499), flight
        assert sorted(airframe.powertrain.thrust_constants)[0] == pytest.approx(
            0.5 * whole.thrust_constants[0]
        )
        assert len(airframe.on_body) == 1, "a wind beside drag brings none of its own"
        simulator.rest()
        assert (airframe.powertrain, airframe.wind) == (whole, (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("request_", "told"),
    [
        ("motor_lag@3", "acts from the start only"),
        ("wind:4@soon", "'soon' is not a number"),
        ("wind@-1", "write a time of 0 or later"),
        ("wind@nan", "write a time of 0 or later"),
        ("wind:99@3", "size must be"),
    ],
)
def test_what_cannot_begin_so_is_told(vehicle: Vehicle, request_: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        choose([request_], vehicle, 0)


def test_a_sealed_answer_tells_when_an_effect_begins(vehicle: Vehicle, tmp_path: Path) -> None:
    seal(choose(["rotor_damage@41.5", "wind"], vehicle, 2), vehicle.name, 2, tmp_path / "a.sealed")
    damage, wind = reveal(tmp_path / "a.sealed")["effects"]
    assert damage["begins"] == {"value": 41.5, "unit": "s"}
    assert "begins" not in wind


# Battery


def test_a_battery_begins_with_its_charge_and_ages_in_resistance_and_capacity(vehicle: Vehicle) -> None:
    new = believed_powertrain(vehicle).battery
    full, half = (Battery(in_state(new, BatteryState(charge))) for charge in (1.0, 0.5))
    cells = new.volts_per_cell_volt
    assert full.open_circuit_voltage() == pytest.approx(4.20 * cells)
    assert half.open_circuit_voltage() == pytest.approx(3.84 * cells)
    old = in_state(new, BatteryState(0.5, 2.0))
    assert old.resistance == pytest.approx(2.0 * new.resistance)
    assert old.polarisation_resistance == pytest.approx(2.0 * new.polarisation_resistance)
    assert old.capacity == pytest.approx(0.8 * new.capacity)
    # The drop under a small load is in proportion to the resistance.
    drops = [half.open_circuit_voltage() - Battery(cell).load(5.0) for cell in (half.cell, old)]
    assert drops[1] / drops[0] == pytest.approx(2.0, rel=0.02)


def test_a_flight_sees_the_charge_and_the_age_of_its_battery(vehicle: Vehicle, design: Design) -> None:
    def voltages(charge: float, age: float) -> np.ndarray:
        samples: list[Sample] = []
        plan = Plan(vehicle, design, trajectory("hover", duration=20.0), battery=BatteryState(charge, age))
        fly(plan, samples.append)
        return np.array([sample.estimate.battery_voltage for sample in samples])

    full, half, old = voltages(0.97, 1.0), voltages(0.5, 1.0), voltages(0.97, 2.0)
    assert full.mean() > old.mean() > half.mean()
    # 4 % of the nominal voltage under a hover when new, twice that when old; after 20 s nearly all of it is there.
    assert full[-100:].mean() - old[-100:].mean() == pytest.approx(0.04 * vehicle.nominal_voltage, rel=0.2)


# Records


def test_the_same_plan_writes_the_same_bytes(vehicle: Vehicle, design: Design, tmp_path: Path) -> None:
    plan = Plan(vehicle, design, trajectory("steps", count=2.0), choose(["rich"], vehicle, 5), 5)
    for name in ("one.mcap", "two.mcap"):
        record(plan, tmp_path / name)
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()
