"""A model from the ground flies only when everything about it fits."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from onnx_models import RANGES, constant_model, linear_model, packed

from trueflight.companion.law.actuation import Actuation
from trueflight.companion.law.model_check import MAX_BYTES, check_model, open_model, warm_up
from trueflight.companion.law.watch import GuardLimits
from trueflight.models import contract
from trueflight.models.errors import InputError
from trueflight.models.vehicle import load_vehicle

VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")
RNG = np.random.default_rng(0)


def test_a_model_that_fits_is_accepted_and_computes_what_it_should() -> None:
    weights = RNG.normal(size=(10, 3))
    verdict = check_model(linear_model(weights, (0.1, 0.2, 0.3)), VEHICLE)
    assert verdict.accepted, verdict.reason
    assert verdict.model is not None
    for features in RNG.normal(size=(20, 10)):
        expected = features.astype(np.float32) @ weights.astype(np.float32) + (0.1, 0.2, 0.3)
        np.testing.assert_allclose(verdict.model(features.tolist()), expected, atol=1e-4)
    info = verdict.model.info
    assert not info.wants_yaw
    assert info.chain[0]["effect"] == "rotor_drag"
    assert [one.name for one in info.features] == list(contract.FEATURES)


def test_a_model_with_yaw_says_so() -> None:
    verdict = check_model(linear_model(RNG.normal(size=(12, 3))), VEHICLE)
    assert verdict.model is not None
    assert verdict.model.info.wants_yaw


def feature_entries(**changes: dict[str, object]) -> list[dict[str, object]]:
    entries = [
        {"name": name, "unit": unit, "low": RANGES[name][0], "high": RANGES[name][1]}
        for name, unit in contract.FEATURES.items()
    ]
    return [{**entry, **changes.get(str(entry["name"]), {})} for entry in entries]


@pytest.mark.parametrize("key", contract.REQUIRED_KEYS)
def test_every_required_key_is_required(key: str) -> None:
    verdict = check_model(constant_model(0.1, 0.0, 0.0, drop=key), VEHICLE)
    assert not verdict.accepted
    assert f"'{key}'" in verdict.reason


@pytest.mark.parametrize(
    ("onnx", "reason"),
    [
        (b"", "not an ONNX model"),
        (b"{}" * 100, "not an ONNX model"),
        (constant_model(0, 0, 0)[:200], "not an ONNX model"),
        (bytes(MAX_BYTES + 1), "at most"),
        (constant_model(0, 0, 0, metadata={contract.KEY_CONTRACT: "2"}), "contract '2'"),
        (constant_model(0, 0, 0, metadata={contract.KEY_VEHICLE: "quad5"}), "not a JSON object"),
        (
            constant_model(0, 0, 0, metadata={contract.KEY_VEHICLE: {"name": "quad7", "mass": 0.75}}),
            "made for vehicle 'quad7', this one is 'quad5'",
        ),
        (
            constant_model(
                0, 0, 0, metadata={contract.KEY_VEHICLE: {"name": "quad5", "mass": 0.9, "hover_thrust": 0.38}}
            ),
            "made for mass 0.9",
        ),
        (
            constant_model(0, 0, 0, metadata={contract.KEY_VEHICLE: {"name": "quad5", "mass": 0.75}}),
            "made for hover_thrust None",
        ),
        (
            constant_model(0, 0, 0, metadata={contract.KEY_FEATURES: feature_entries()[:9]}),
            "its features are",
        ),
        (
            constant_model(0, 0, 0, metadata={contract.KEY_FEATURES: feature_entries()[::-1]}),
            "its features are",
        ),
        (
            constant_model(0, 0, 0, metadata={contract.KEY_FEATURES: feature_entries(z={"unit": "ft"})}),
            "with their units",
        ),
        (
            constant_model(0, 0, 0, metadata={contract.KEY_FEATURES: feature_entries(z={"low": 9.0})}),
            "training range of feature 'z'",
        ),
        (
            constant_model(0, 0, 0, metadata={contract.KEY_FEATURES: [{"name": "z"}]}),
            "name, unit, low and high",
        ),
        (constant_model(0, 0, 0, input_name="x"), "expected one called 'features'"),
        (constant_model(0, 0, 0, golden_error=0.01), "a golden vector differs by 0.01"),
        (constant_model(0, 0, 0, metadata={contract.KEY_GOLDEN_DELTA: [[0, 0, 0]]}), "at least 3 rows of 3"),
        (constant_model(0, 0, 0, metadata={contract.KEY_GOLDEN_DELTA: [["a"]]}), "at least 3 rows of 3"),
        (constant_model(0, 0, 0, metadata={contract.KEY_GOLDEN_DELTA: "[0, 0"}), "not a JSON list"),
        (
            constant_model(0, 0, 0, metadata={contract.KEY_GOLDEN_DELTA: [[0, 0, 0]] * 3}),
            "4 golden inputs and 3",
        ),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason(onnx: bytes, reason: str) -> None:
    verdict = check_model(onnx, VEHICLE)
    assert not verdict.accepted
    assert verdict.model is None
    assert reason in verdict.reason
    assert "\n" not in verdict.reason


def test_a_model_with_the_wrong_width_is_refused() -> None:
    onnx = linear_model(np.zeros((12, 3)), metadata={contract.KEY_FEATURES: feature_entries()})
    assert "expected tensor(float) [N, 10]" in check_model(onnx, VEHICLE).reason


def test_a_model_that_overflows_inside_its_range_is_refused() -> None:
    weights = np.zeros((10, 3))
    weights[8, 0] = 1e38  # times a battery voltage: infinity in single precision
    golden = [[0.0] * 10] * 3
    onnx = linear_model(
        weights, metadata={contract.KEY_GOLDEN_FEATURES: golden, contract.KEY_GOLDEN_DELTA: [[0.0] * 3] * 3}
    )
    assert "not finite inside its own training range" in check_model(onnx, VEHICLE).reason


def test_a_model_that_is_too_slow_is_refused() -> None:
    onnx = linear_model(np.eye(10, 3), extra_nodes=2000)
    verdict = check_model(onnx, VEHICLE, deadline=1e-5)
    assert "at most" in verdict.reason
    assert check_model(onnx, replace(VEHICLE), deadline=1.0).accepted


def one_row_at_a_time(onnx_file: bytes) -> bytes:
    """The same file, made for a batch of one."""
    model = onnx.ModelProto.FromString(onnx_file)
    for port in (*model.graph.input, *model.graph.output):
        port.type.tensor_type.shape.dim[0].dim_value = 1
    return bytes(model.SerializeToString())


def test_a_file_made_for_one_row_answers_several_as_well() -> None:
    file = linear_model(RNG.normal(size=(10, 3)))
    several, single = (check_model(one, VEHICLE).model for one in (file, one_row_at_a_time(file)))
    assert several is not None and single is not None
    rows = RNG.normal(size=(3, 10)).tolist()
    assert np.array(single.rows(rows)) == pytest.approx(np.array(several.rows(rows)), abs=1e-5)
    assert single.rows(rows)[1] == pytest.approx(single(rows[1]))


def test_the_watch_over_a_model_knows_it_by_what_its_file_says() -> None:
    actuation = {"rate_lag": 0.04, "thrust_delay": 0.01}
    file = linear_model(np.zeros((12, 3)), (1.0, 0.0, 0.0), metadata={contract.KEY_ACTUATION: actuation})
    model = check_model(file, VEHICLE).model
    assert model is not None
    limits = GuardLimits(fade=0.5)
    watch = model.watched(limits)
    assert (watch.name, watch.wants_yaw, watch.limits) == (contract.model_hash(file), True, limits)
    assert watch.actuation == Actuation(rate_lag=0.04, thrust_delay=0.01)
    middle = [0.5 * (low + high) for low, high in RANGES.values()]
    assert watch.evaluate(middle, 0.01)[1] == (1.0, 0.0, 0.0)
    assert model.watched().limits == GuardLimits()


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (MemoryError(), "its check needs too much memory"),
        (RecursionError(), "its check failed (RecursionError): the file is hostile or damaged"),
    ],
)
def test_what_no_check_foresaw_is_refused_as_well(error: Exception, reason: str, monkeypatch) -> None:
    def fails(model: object) -> None:
        raise error

    monkeypatch.setattr("trueflight.companion.law.model_check._check_range", fails)
    verdict = check_model(constant_model(0.1, 0.0, 0.0), VEHICLE)
    assert (verdict.accepted, verdict.model, verdict.reason) == (False, None, reason)


def test_warmed_up_a_check_loads_nothing_more() -> None:
    """It runs where no file can be opened any more."""
    warm_up()
    before = set(sys.modules)
    assert check_model(constant_model(0.1, 0.0, 0.0), VEHICLE).accepted
    assert set(sys.modules) == before


def test_a_file_that_was_changed_on_board_is_not_opened() -> None:
    file = constant_model(0.1, 0.0, 0.0)
    model = check_model(file, VEHICLE).model
    assert model is not None
    assert open_model(file, model.info)([0.0] * 10) == pytest.approx([0.1, 0.0, 0.0])
    with pytest.raises(InputError, match="the file on board is another one; deploy it again"):
        open_model(constant_model(0.2, 0.0, 0.0), model.info)
    damaged = file[:200]
    with pytest.raises(InputError, match="not an ONNX model"):
        open_model(damaged, replace(model.info, hash=contract.model_hash(damaged)))


def test_metadata_that_are_no_text_are_refused() -> None:
    file = constant_model(0.1, 0.0, 0.0)
    assert b"linear" in file
    assert (
        "no text (UTF-8)" in check_model(file.replace(b"linear", b"\xff\xfe\xfd\xfc\xfb\xfa"), VEHICLE).reason
    )


def test_a_graph_that_opens_and_cannot_be_evaluated_is_refused() -> None:
    nodes = [
        helper.make_node("ReduceMax", [contract.INPUT_NAME], ["most"], axes=[1], keepdims=0),
        helper.make_node("Cast", ["most"], ["row"], to=TensorProto.INT64),
        helper.make_node("Gather", ["table", "row"], [contract.OUTPUT_NAME]),
    ]
    table = {"table": np.zeros((1, 3), dtype=np.float32)}  # one row, and a voltage asks for the sixteenth
    verdict = check_model(packed(nodes, table, lambda features: np.zeros((len(features), 3))), VEHICLE)
    assert "it cannot be evaluated" in verdict.reason
    assert "\n" not in verdict.reason
