"""Model versions: immutable, for one vehicle, exported as they predict."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import programs
import pytest

from trueflight.groundstation.evaluate.compare import waterfall
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.versions.store import add_effect, find, lineage, save
from trueflight.models import contract
from trueflight.models.effect import Stage
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.export import export_onnx, not_exported
from trueflight.models.features import feature_matrix, feature_names, features_of_flight
from trueflight.models.model import Term, read_model, rigid_body_model, write_model
from trueflight.models.prediction import error_acceleration, motion_of_features

SAMPLES = Path(__file__).parents[2] / "samples"
DRAG = SAMPLES / "rotorpy" / "rotor_drag"
BIN = Path(sys.executable).parent


@pytest.fixture(scope="module")
def flight():
    return read_flight(DRAG / "identify.parquet")


def test_added_effect_makes_a_version_and_the_error_falls(flight, tmp_path) -> None:
    model, path = save(tmp_path, add_effect(rigid_body_model(flight.vehicle), "rotor_drag", [flight]), None)
    assert path.name == "v0001-rotor_drag.json"
    assert read_model(path) == model
    steps = waterfall(flight, read_flight(DRAG / "validate.parquet"), lineage(tmp_path, model))
    assert [s.label for s in steps] == ["linear", "+ rigid_body", "v1 + rotor_drag"]
    assert steps[0].fitted > steps[1].fitted > 1.3 * steps[2].fitted
    assert steps[1].held_out > 1.3 * steps[2].held_out
    second, _ = save(tmp_path, add_effect(model, "thrust_gain", [flight]), model)
    assert (second.version, second.parent) == (2, 1)
    assert find(tmp_path, flight.vehicle.name, "v1") == model


def test_version_is_never_overwritten(flight, tmp_path) -> None:
    path = tmp_path / "v0001-x.json"
    write_model(rigid_body_model(flight.vehicle), path)
    before = path.read_bytes()
    with pytest.raises(InputError, match="never overwritten"):
        write_model(rigid_body_model(flight.vehicle), path)
    assert path.read_bytes() == before


def test_effect_that_acts_through_another_asks_for_it(flight) -> None:
    with pytest.raises(InputError, match="rotor_drag or parasitic_drag"):
        add_effect(rigid_body_model(flight.vehicle), "wind", [flight])


@pytest.mark.parametrize(
    "damage", ["{", "[]", '{"trueflight_model": 1}', '{"trueflight_model": 1, "vehicle": {}, "terms": []}']
)
def test_damaged_model_file_is_told_in_one_line(tmp_path, damage: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(damage)
    with pytest.raises(InputError, match=r"bad\.json"):
        read_model(path)


def test_onnx_file_predicts_as_the_model_and_carries_its_contract(flight) -> None:
    middle = {
        e.name: {p.name: 0.5 * (p.neutral_for(flight.vehicle) + p.typical) for p in e.parameters}
        for e in catalogue().values()
    }
    model = rigid_body_model(flight.vehicle)
    model = model.with_terms(tuple(Term(name, values) for name, values in middle.items()))
    assert set(not_exported(model)) == {
        *("accelerometer_bias", "imu_lever_arm", "com_offset", "gyroscopic")
    }  # lag and delay are looked over
    session = onnxruntime.InferenceSession(export_onnx(model, flight))
    names = feature_names(model)
    assert names[-2:] == ("cos_psi", "sin_psi")
    columns = features_of_flight(flight)
    features = feature_matrix(columns, names)
    (delta,) = session.run([contract.OUTPUT_NAME], {contract.INPUT_NAME: features})
    static = [(e, v) for e, v in model.chain() if e.exports and e.stage is not Stage.SENSOR]
    expected = error_acceleration(motion_of_features(columns, flight.vehicle), static)
    np.testing.assert_allclose(delta, expected, atol=2e-4)
    metadata = session.get_modelmeta().custom_metadata_map
    assert set(contract.REQUIRED_KEYS) <= set(metadata)
    ranges = json.loads(metadata[contract.KEY_FEATURES])
    assert [r["name"] for r in ranges] == list(names)
    assert ranges[0]["low"] == pytest.approx(features[:, 0].min())
    golden = np.array(json.loads(metadata[contract.KEY_GOLDEN_FEATURES]), dtype=np.float32)
    (again,) = session.run(None, {contract.INPUT_NAME: golden})
    np.testing.assert_allclose(
        again, json.loads(metadata[contract.KEY_GOLDEN_DELTA]), atol=contract.GOLDEN_TOLERANCE
    )


def test_rigid_body_correction_is_small_angle_error(flight) -> None:
    model = rigid_body_model(flight.vehicle)
    angle, g = 0.4, 9.81
    columns = {
        "z": 1.0, "cos_phi": 1.0, "sin_phi": 0.0, "cos_theta": np.cos(angle), "sin_theta": np.sin(angle),
        "vx": 0.0, "vy": 0.0, "vz": 0.0, "u_batt": 16.0, "T": flight.vehicle.weight,
    }  # fmt: skip
    row = {k: np.array([v]) for k, v in columns.items()}
    delta = error_acceleration(motion_of_features(row, flight.vehicle), model.chain())[0]
    np.testing.assert_allclose(
        delta, [g * (np.sin(angle) - angle), 0.0, g * (np.cos(angle) - 1.0)], atol=1e-9
    )


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return programs.run("groundstation", *arguments)


BAD = [
    (["diagnose", "nowhere.csv"], "nowhere.csv"),
    (["model", "add", "rotordrag", "--flight", DRAG / "identify.parquet"], "rotor_drag"),
    (["model", "show", "v9", "--vehicle-name", "hb"], "v9"),
    (["model", "list", "--store", "nowhere"], "nowhere"),
    (["compare", DRAG / "identify.parquet", "--model", "missing.json"], "missing.json"),
    (["effects", "rotordrag"], "rotor_drag"),
    (["effects", "--effects", "nowhere"], "nowhere"),
]


@pytest.mark.parametrize(("arguments", "said"), BAD, ids=[" ".join(map(str, a[:3]))[:40] for a, _ in BAD])
def test_bad_input_is_one_line_and_exit_code_2(arguments, said: str) -> None:
    done = run(*arguments)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_model_of_another_vehicle_is_refused(flight, tmp_path) -> None:
    _, path = save(tmp_path, add_effect(rigid_body_model(flight.vehicle), "rotor_drag", [flight]), None)
    done = run("compare", SAMPLES / "rotorpy" / "nothing_hidden" / "identify.parquet", "--model", path)
    assert done.returncode == 2
    assert "was made for vehicle" in done.stderr


def test_mass_of_500_is_refused_with_the_file_and_the_field(tmp_path) -> None:
    text = (DRAG / "vehicle.toml").read_text().replace("mass = 0.9", "mass = 500")
    (tmp_path / "vehicle.toml").write_text(text)
    done = run("diagnose", DRAG / "identify.parquet", "--vehicle", tmp_path / "vehicle.toml")
    assert done.returncode == 2
    assert "vehicle.toml" in done.stderr
    assert "mass = 500" in done.stderr
