"""A file whose numbers can be learnt in flight: what it says, what is checked of it, and what flies with it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

from trueflight.companion.law.inference import Model, Runtime, open_session
from trueflight.companion.law.model_check import check_model
from trueflight.groundstation.reading import read_flight
from trueflight.models import contract
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.export import export_onnx
from trueflight.models.flight import Flight
from trueflight.models.model import Model as Version
from trueflight.models.model import Term
from trueflight.models.record import read_record
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import choose

VEHICLE = load_vehicle("models/vehicles/quad5/vehicle.toml")
DESIGN = load_design(Path("models/vehicles/quad5/design.json"), VEHICLE)
DRAG = Version(
    VEHICLE, (Term("rigid_body", {}), Term("rotor_drag", {"x": 0.3, "y": 0.36})), name="drag", version=1
)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    path = tmp_path_factory.mktemp("flown") / "excitation.mcap"
    record(Plan(VEHICLE, DESIGN, trajectory("excitation"), choose(["rotor_drag:0.3"], VEHICLE, 3), 3), path)
    return read_flight(path)


@pytest.fixture(scope="module")
def file(flight: Flight) -> bytes:
    return export_onnx(DRAG, flight, adaptive=True)


def _with(file: bytes, change: Callable[[dict[str, str], onnx.ModelProto], None]) -> bytes:
    graph = onnx.load_from_string(file)
    meta = {one.key: one.value for one in graph.metadata_props}
    change(meta, graph)
    del graph.metadata_props[:]
    onnx.helper.set_model_props(graph, meta)
    return graph.SerializeToString()


def test_gain_and_wind_can_be_learnt_of_a_model_that_has_neither(file: bytes) -> None:
    verdict = check_model(file, VEHICLE, 1.0)
    assert verdict.accepted and verdict.model is not None, verdict.reason
    assert verdict.model.straight
    assert [one.name for one in verdict.model.info.learnables] == [
        "thrust_gain.gain",
        "wind.x",
        "wind.y",
        "rotor_drag.x",
        "rotor_drag.y",
    ]
    assert verdict.model.info.deployed == [1.0, 0.0, 0.0, 0.3, 0.36]


def test_straight_line_and_runtime_feel_the_same(file: bytes) -> None:
    verdict = check_model(file, VEHICLE, 1.0)
    assert verdict.model is not None
    info = verdict.model.info
    runtime = Model(Runtime(open_session(file), len(info.features), len(info.learnables)), info)
    row = [0.5 * (one.low + one.high) + 0.1 for one in info.features]
    numbers = [0.9, 3.0, -2.0, 0.2, 0.5]
    for ours, theirs in zip(verdict.model.sensed(row, numbers), runtime.sensed(row, numbers), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(
        verdict.model.rows([row] * 4, numbers), runtime.rows([row] * 4, numbers), atol=1e-4
    )
    assert verdict.model(row) != verdict.model.rows([row], numbers)[0]


def _lies(meta: dict[str, str], graph: onnx.ModelProto) -> None:
    golden = np.array(json.loads(meta[contract.KEY_GOLDEN_SENSITIVITY])) * 1.5
    meta[contract.KEY_GOLDEN_SENSITIVITY] = json.dumps(golden.tolist())


def _other_answer(meta: dict[str, str], graph: onnx.ModelProto) -> None:
    """A graph that answers with what it claims to be the derivative of something else."""
    for node in graph.graph.node:
        if node.output[0] == contract.SENSITIVITY_NAME:
            node.input[0], node.input[2] = node.input[2], node.input[0]
    golden = np.array(json.loads(meta[contract.KEY_GOLDEN_SENSITIVITY]))
    golden[:, [0, 2]] = golden[:, [2, 0]]
    meta[contract.KEY_GOLDEN_SENSITIVITY] = json.dumps(golden.tolist())


def _set(key: str, value: object) -> Callable[[dict[str, str], onnx.ModelProto], None]:
    def change(meta: dict[str, str], graph: onnx.ModelProto) -> None:
        meta[key] = json.dumps(value)

    return change


def _first(**fields: object) -> Callable[[dict[str, str], onnx.ModelProto], None]:
    def change(meta: dict[str, str], graph: onnx.ModelProto) -> None:
        table = json.loads(meta[contract.KEY_ADAPTIVE])
        table[0] |= fields
        meta[contract.KEY_ADAPTIVE] = json.dumps(table)

    return change


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (_lies, "sensitivity differs from that of a golden vector"),
        (_other_answer, "is not the derivative of its answer"),
        (lambda meta, graph: meta.pop(contract.KEY_ADAPTIVE), "its ports are"),
        (lambda meta, graph: meta.pop(contract.KEY_NOISE), "lack 'noise'"),
        (_set(contract.KEY_ADAPTIVE, []), "must name 1 to 8 different parameters"),
        (_set(contract.KEY_ADAPTIVE, [1]), "its metadata 'adaptive'"),
        (_set(contract.KEY_NOISE, [0.1, 0.1, 0.0]), "three numbers above 0"),
        (_first(value=9.0), "9 is not between"),
        (_first(spread=True), "is no number"),
        (_first(effect="a\nb"), "must be words"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(
    file: bytes, change: Callable[[dict[str, str], onnx.ModelProto], None], why: str
) -> None:
    verdict = check_model(_with(file, change), VEHICLE, 1.0)
    assert not verdict.accepted and why in verdict.reason


def test_a_payload_picked_up_is_learnt_acts_and_stands_in_every_tick(file: bytes, tmp_path: Path) -> None:
    path = tmp_path / "learnt.mcap"
    hidden = choose(["rotor_drag:0.3", "thrust_gain:0.909@8"], VEHICLE, 3)
    plan = Plan(
        VEHICLE,
        DESIGN,
        trajectory("lemniscate"),
        hidden,
        3,
        model=file,
        controller=contract.CORRECTED_ADAPTIVE,
        settle=2.0,
    )
    assert record(plan, path).outcome == "finished"
    ticks = read_record(path).ticks
    assert set(ticks["learnt_names"]) == {"thrust_gain.gain wind.x wind.y rotor_drag.x rotor_drag.y"}
    t = ticks["t"]
    before, after = (t > 6.0) & (t < 8.0), t > 13.0
    gain, deviation = ticks["learnt"][:, 0], ticks["learnt_deviation"][:, 0]
    assert np.all(np.abs(gain[before] - 1.0) < 0.02) and np.all(np.abs(gain[after] - 0.909) < 0.02)
    assert np.all(ticks["learnt_acting"][before, 0] == 1.0) and set(ticks["learning"][before]) == {"shadow"}
    np.testing.assert_allclose(ticks["learnt_acting"][after, 0], gain[after])
    assert np.all(deviation[after] < 0.02) and set(ticks["learning"][after]) == {"acting"}


def test_a_model_of_which_nothing_can_be_learnt_does_not_fly_adaptive(flight: Flight, tmp_path: Path) -> None:
    plain = export_onnx(DRAG, flight)
    plan = Plan(VEHICLE, DESIGN, trajectory("hover"), model=plain, controller=contract.CORRECTED_ADAPTIVE)
    with pytest.raises(InputError, match="export it with --adaptive"):
        record(plan, tmp_path / "never.mcap")
