"""Many flights at once are each the flight that it is alone: same draws, same numbers within float error, same
record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx_models import RANGES, constant_model, drag_model, linear_model, nan_model

from trueflight.companion.law.controllers import TrimLimits
from trueflight.models import contract
from trueflight.models.design import Design
from trueflight.models.errors import InputError
from trueflight.models.record import read_record
from trueflight.models.reference import trajectory, trajectory_from_csv
from trueflight.models.trajectory import Trajectory, hold, min_jerk
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.in_process import Flown, Sample, fly, record
from trueflight.sim_bridge.many.flight import Samples, fly_many
from trueflight.sim_bridge.many.records import record_many
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.battery import BatteryState
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import choose
from trueflight.sim_bridge.truth.sensors import NO_NOISE, Noise

SHORT = Trajectory(
    "short", (min_jerk((0.0, 0.0, 1.2, 0.0), (0.8, 0.4, 1.6, 0.5), 1.2), hold((0.8, 0.4, 1.6, 0.5), 0.2))
)
CLOSE = 1e-9
"""Of numbers of the order of one to a hundred; rotor speeds are of a thousand."""


def alone(samples: Sequence[Sample]) -> dict[str, np.ndarray]:
    """Columns of a flight on its own."""
    return {
        "position": np.array([s.position for s in samples]),
        **{
            name: np.array([getattr(s.estimate, name) for s in samples])
            for name in (
                *("time_us", "velocity", "quaternion", "angular_velocity", "specific_force"),
                *("battery_voltage", "rotor_speed"),
            )
        },
        "reference": np.array([(*s.reference.position, *s.reference.velocity) for s in samples]),
        "yaw": np.array([s.reference.yaw for s in samples]),
        "feedback": np.array([(s.step.feedback.thrust, *s.step.feedback.body_rate) for s in samples]),
        "correction": np.array([(*s.step.correction, *s.step.trim) for s in samples]),
        "raw": np.array([s.step.correction_raw for s in samples]),
        "command": np.array([(s.step.thrust_command, *s.step.command.body_rate) for s in samples]),
        "motors": np.array([s.motors for s in samples]),
        "mission": np.array([s.mission for s in samples]),
        "guard": np.array([s.guard for s in samples]),
    }


def among(samples: Sequence[Samples], i: int, ticks: int) -> dict[str, np.ndarray]:
    """The same columns of one of many."""
    own = samples[:ticks]
    assert all(s.under_way[i] for s in own) and not any(s.under_way[i] for s in samples[ticks:])
    return {
        "position": np.array([s.position[:, i] for s in own]),
        "time_us": np.array([s.estimates.time_us for s in own]),
        **{
            name: np.array([getattr(s.estimates, name)[..., i] for s in own])
            for name in (
                *("velocity", "quaternion", "angular_velocity", "specific_force", "battery_voltage"),
                "rotor_speed",
            )
        },
        "reference": np.array([(*s.references.position[:, i], *s.references.velocity[:, i]) for s in own]),
        "yaw": np.array([s.references.yaw[i] for s in own]),
        "feedback": np.array([(s.steps.feedback_thrust[i], *s.steps.feedback_rate[:, i]) for s in own]),
        "correction": np.array([(*s.steps.correction[:, i], *s.steps.trim[:, i]) for s in own]),
        "raw": np.array([s.steps.correction_raw[:, i] for s in own]),
        "command": np.array([(s.steps.thrust_command[i], *s.steps.body_rate[:, i]) for s in own]),
        "motors": np.array([s.motors[:, i] for s in own]),
        "mission": np.array([s.mission[i] for s in own]),
        "guard": np.array([s.guard[i] for s in own]),
    }


def each_is_as_alone(plans: Sequence[Plan], close: float = CLOSE) -> list[Flown]:
    together: list[Samples] = []
    ended: dict[int, Flown] = {}
    found = fly_many(plans, lambda s: together.append(replace(s, guard=tuple(s.guard))), ended.__setitem__)
    assert {i: replace(flown, wall=0.0) for i, flown in enumerate(found)} == ended
    for i, (plan, flown) in enumerate(zip(plans, found, strict=True)):
        samples: list[Sample] = []
        lonely = fly(plan, samples.append)
        what = f"{[one.name for one in plan.hidden]}, {plan.controller}"
        assert (flown.outcome, flown.ticks, flown.touching, flown.guard) == (
            lonely.outcome, lonely.ticks, lonely.touching, lonely.guard,
        ), what  # fmt: skip
        assert flown.rms_error == pytest.approx(lonely.rms_error, abs=close), what
        one, many = alone(samples), among(together, i, lonely.ticks)
        for name, expected in one.items():
            if expected.dtype.kind == "f":
                assert many[name] == pytest.approx(expected, rel=close, abs=close), f"{what}: {name}"
            else:
                assert np.array_equal(many[name], expected), f"{what}: {name}"
    return found


def test_every_effect_alone_and_all_of_rich(vehicle: Vehicle, design: Design) -> None:
    path = SHORT
    requests = [[name] for name in EFFECTS] + [["rich", "wind"], ["none"]]
    each_is_as_alone(
        [
            Plan(vehicle, design, path, choose(words, vehicle, seed), seed, noise=Noise())
            for seed, words in enumerate(requests, 1)
        ]
    )


def test_paths_controllers_batteries_and_what_begins_in_flight(vehicle: Vehicle, design: Design) -> None:
    paths = [
        Trajectory("low", (min_jerk((0.0, 0.0, 0.15, 0.0), (1.0, 0.5, 0.15, 0.0), 1.6),)),
        Trajectory(
            "drop",
            (min_jerk((0.0, 0.0, 3.2, 0.0), (0.2, 0.0, 1.4, 0.0), 0.8), hold((0.2, 0.0, 1.4, 0.0), 0.8)),
        ),
        Trajectory(
            "turn",
            (min_jerk((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 1.0, 1.0), 1.5), hold((0.0, 0.0, 1.0, 1.0), 0.8)),
        ),
    ]
    rows = "\n".join(f"{0.2 * i},{0.1 * i},0,1,{0.05 * i}" for i in range(20))
    paths.append(trajectory_from_csv(f"t,x,y,z,yaw\n{rows}\n", "setpoints"))
    hidden = (
        ("ceiling_effect", "ground_effect", "gyroscopic"),
        ("vortex_ring:0.4", "rotor_drag", "battery_sag"),
        ("wind:4@1", "rotor_damage:0.1@2.004", "thrust_gain:1.1@1"),
        (
            "payload:0.2",
            "inertia:1.3",
            "gusts",
            "imu_lever_arm",
            "estimator_delay:0.014",
            "rotor_drag:0.4@0.5",
        ),
    )
    plans = []
    for i, (path, words) in enumerate(zip(paths, hidden, strict=True)):
        chosen = choose(list(words), vehicle, i)
        if i == 3:  # a payload sooner than `choose` would have it
            chosen = (replace(chosen[0], parameters={**chosen[0].parameters, "time": 1.1}), *chosen[1:])
        plans.append(
            Plan(
                vehicle, design, path, chosen, 10 + i, repeat=2 if i == 3 else 1, battery=BatteryState(0.7, 1.3),
                controller="lqr_integral" if i % 2 else "lqr", settle=0.5 * (i > 1), noise=NO_NOISE if i == 1 else None,
            )
        )  # fmt: skip
    each_is_as_alone(plans)


def test_vehicles_that_differ(vehicle: Vehicle, design: Design) -> None:
    large = replace(
        vehicle, name="large", mass=1.5, inertia=(0.009, 0.01, 0.016), rotor_radius=0.09, hover_thrust=0.5,
        rotor_positions=((0.15, -0.12, 0.01), (-0.15, 0.12, 0.01), (0.15, 0.12, 0.01), (-0.15, -0.12, 0.01)),
        thrust_model="quadratic", command_delay=0.011, motor_time_constant=0.035,
    )  # fmt: skip
    own = replace(
        design, vehicle="large", mass=1.5, K_eta=(*design.K_eta[:2], tuple(2 * k for k in design.K_eta[2]))
    )
    path = SHORT
    words = [
        "ground_effect",
        "rotor_drag",
        "thrust_misalignment",
        "vortex_ring",
        "thrust_curve",
        "gyroscopic",
    ]
    each_is_as_alone(
        [
            Plan(vehicle, design, path, choose(words, vehicle, 1), 1),
            Plan(large, own, path, choose(words, large, 2), 2),
        ]
    )


def test_flights_that_end_early(vehicle: Vehicle, design: Design) -> None:
    path = trajectory("hover", height=1.0, duration=6.0)
    blown = choose(["wind:15"], vehicle, 1)
    strong = tuple(replace(one, parameters={**one.parameters, "drag": 2.0}) for one in blown)
    found = each_is_as_alone(
        [
            Plan(vehicle, design, path, strong, 1),
            Plan(vehicle, design, path, choose(["com_offset:0.09"], vehicle, 2), 2),
            Plan(
                vehicle,
                design,
                trajectory("hover", height=0.1, duration=1.5),
                choose(["thrust_gain:0.93"], vehicle, 4),
                4,
            ),
            Plan(vehicle, design, path, (), 4),
        ],
        close=1e-6,  # MuJoCo solves a contact to a tolerance of its own
    )
    assert [flown.outcome for flown in found] == ["lost", "crashed", "finished", "finished"]
    assert found[2].touching > 0


def test_records_are_those_of_flights_alone(vehicle: Vehicle, design: Design, tmp_path: Path) -> None:
    plans = [
        Plan(vehicle, design, SHORT, choose(["rich"], vehicle, 5), 5, settle=0.5),
        Plan(vehicle, design, trajectory("hover", duration=1.0), (), 6, controller="lqr_integral", rotor_speeds=False),
    ]  # fmt: skip
    names = [f"{i}.mcap" for i in range(len(plans))]
    record_many(plans, [tmp_path / name for name in names])
    for plan, name in zip(plans, names, strict=True):
        record(plan, tmp_path / "alone.mcap")
        one, many = read_record(tmp_path / "alone.mcap"), read_record(tmp_path / name)
        assert (many.metadata, many.events, many.vehicle, many.design) == (
            one.metadata, one.events, one.vehicle, one.design,
        )  # fmt: skip
        assert not many.truncated and not many.notes and set(one.ticks) == set(many.ticks)
        for column, expected in one.ticks.items():
            if expected.dtype.kind == "f":
                assert many.ticks[column] == pytest.approx(expected, rel=CLOSE, abs=CLOSE, nan_ok=True), (
                    column
                )
            else:
                assert np.array_equal(many.ticks[column], expected), column
        (tmp_path / "alone.mcap").unlink()
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    with pytest.raises(InputError, match="never overwritten"):
        record_many(plans, [tmp_path / name for name in names])


def test_rates_that_differ_are_refused(vehicle: Vehicle, design: Design) -> None:
    plan = Plan(vehicle, design, trajectory("hover"))
    with pytest.raises(InputError, match="one --rate"):
        fly_many([plan, replace(plan, rate=50.0)])


KNOWN = {
    "rate_delay": 0.013, "rate_lag": 0.05, "rate_integral": 1.3, "thrust_delay": 0.005, "thrust_lag": 0.02,
}  # fmt: skip


def test_the_corrected_cascade_with_its_guard(vehicle: Vehicle, design: Design) -> None:
    there, back = (0.0, 0.0, 0.4, 0.0), (1.5, 0.7, 0.9, 0.6)
    path = Trajectory("and back", (min_jerk(there, back, 1.5), min_jerk(back, there, 1.5)))
    named = {contract.KEY_ACTUATION: KNOWN}
    yaws = np.zeros((12, 3))
    yaws[10:, :2] = 0.3
    models = {
        "drag": drag_model(0.4, metadata=named),
        "drag, acting at once": drag_model(0.4),
        "of the world": linear_model(
            yaws, metadata={contract.KEY_ACTUATION: {**KNOWN, "rate_integral": 0.0}}
        ),
        "beyond its authority": constant_model(3.1, 0.0, 0.0, metadata=named),
        "absurd": constant_model(0.0, 16.0, 0.0, metadata=named),
        "no number": nan_model(0.2, 0.3),
    }
    words = (["rotor_drag:0.4"], ["rich"], ["wind:3", "transport_delay:0.02"])
    plans = [
        Plan(
            vehicle, design, path, choose(words[i % 3], vehicle, i), 20 + i, model=onnx, settle=1.3 * (i % 2),
            trim=TrimLimits(bandwidth=0.4 if i else 0.0), battery=BatteryState(0.8 if i != 1 else 0.12, 1.0),
        )
        for i, onnx in enumerate(models.values())
    ]  # fmt: skip
    plans.append(replace(plans[0], model=None, controller="lqr"))
    found = each_is_as_alone(plans, close=1e-7)
    told = [flown.guard for flown in found[:-1]]
    assert told[0] == told[2] == "active", told
    assert [text.startswith("tripped") for text in told[3:]] == [True, True, True], told


def test_what_the_accelerometer_bears_out_beyond_authority_and_range(
    vehicle: Vehicle, design: Design
) -> None:
    there, back = (0.0, 0.0, 3.0, 0.0), (7.0, 1.0, 3.0, 0.0)
    path = Trajectory("fast", (min_jerk(there, back, 2.5), min_jerk(back, there, 2.5)))
    named = {contract.KEY_ACTUATION: KNOWN}
    narrow = [
        {
            "name": name,
            "unit": unit,
            "low": -1.0 if name in ("vx", "vy") else low,
            "high": 1.0 if name in ("vx", "vy") else high,
        }
        for (name, unit), (low, high) in zip(contract.FEATURES.items(), RANGES.values(), strict=False)
    ]
    models = [
        drag_model(0.9, metadata=named),
        drag_model(0.9, metadata={**named, contract.KEY_FEATURES: narrow}),
        drag_model(-0.9, metadata=named),
        drag_model(-0.4, metadata={**named, contract.KEY_FEATURES: narrow}),
    ]
    plans = [
        Plan(vehicle, design, path, choose(["rotor_drag:0.9"], vehicle, i), 40 + i, model=onnx, settle=1.2)
        for i, onnx in enumerate(models)
    ]
    told = [flown.guard for flown in each_is_as_alone(plans, close=1e-7)]
    assert told[:2] == ["active", "active"], told
    assert told[2] == "tripped: beyond its authority for 1 s"
    assert told[3].endswith("outside its training range for 1 s")


def test_controllers_without_a_form_for_arrays(vehicle: Vehicle, design: Design) -> None:
    others = [
        name for name in contract.CONTROLLERS if name not in ("lqr", "lqr_integral", *contract.WITH_MODEL)
    ]
    plans = [
        Plan(
            vehicle,
            design,
            SHORT,
            choose(["rotor_drag"], vehicle, i),
            i,
            controller=name,
            settle=0.2 * (i % 2),
        )
        for i, name in enumerate(others)
    ]
    each_is_as_alone([*plans, Plan(vehicle, design, SHORT)])


def test_many_flights_of_one_model(vehicle: Vehicle, design: Design) -> None:
    onnx = drag_model(0.4, metadata={contract.KEY_ACTUATION: KNOWN})
    each_is_as_alone(
        [Plan(vehicle, design, SHORT, choose(["rotor_drag"], vehicle, i), i, model=onnx) for i in range(5)],
        close=1e-5,  # together it is computed in 32 bits
    )
