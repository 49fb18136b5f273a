"""A user's effect, one file from the template, gets all that the catalogue's own effects get."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import programs
import pytest
from simulated import simulated

from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.writing import write_flight
from trueflight.groundstation.versions.effect_file import write_template
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.export import export_onnx
from trueflight.models.features import feature_matrix, feature_names, features_of_flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.model import Term, rigid_body_model

BIN = Path(sys.executable).parent
ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "samples" / "rotorpy" / "nothing_hidden" / "identify.parquet"
PULL = 0.3


@pytest.fixture(scope="module")
def flight_with_tether(tmp_path_factory) -> Path:
    """A flight of another simulator to which plain vector algebra adds the weight of a tether."""
    flight = read_flight(SAMPLE)
    weight = np.outer(-PULL * flight.position[:, 2], [0.0, 0.0, 1.0])
    pulled = replace(flight, specific_force=flight.specific_force + rotate_inverse(flight.quaternion, weight))
    path = tmp_path_factory.mktemp("tether") / "flight.csv"
    write_flight(pulled, path)
    return path


def run(*arguments: object) -> str:
    done = programs.run("groundstation", *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_template_is_ranked_fitted_added_and_exported(flight_with_tether: Path, tmp_path) -> None:
    effects, store = tmp_path / "mine", tmp_path / "store"
    run("effect", "new", "tether", "--output", effects)
    vehicle = flight_with_tether.with_suffix(".vehicle.toml")
    common = ("--vehicle", vehicle, "--effects", effects, "--store", store, "--json")

    diagnosis = json.loads(run("diagnose", flight_with_tether, "--model", "linear", *common))
    (found,) = [e for e in diagnosis["effects"] if e["verdict"] in ("missing", "possible")]
    assert (found["name"], found["verdict"], found["rank"]) == ("tether", "missing", 1)
    pull = found["parameters"]["pull"]
    assert pull["low"] <= PULL <= pull["high"]
    assert pull["unit"] == "1/s^2"

    recording = tmp_path / "tether.rrd"
    added = json.loads(
        run("model", "add", "tether", "--flight", flight_with_tether, "--rrd", recording, *common)
    )
    assert added["waterfall"][-1]["fitted"] < 0.8 * added["waterfall"][-2]["fitted"]
    assert recording.stat().st_size > 1000

    graph = tmp_path / "tether.onnx"
    exported = run(
        *("model", "export", "v1", "--flight", flight_with_tether, "--vehicle", vehicle, "--store", store),
        *("-o", graph, "--json"),
    )
    assert json.loads(exported)["not_exported"] == []
    session = onnxruntime.InferenceSession(graph.read_bytes())
    hover = np.array([[2.0, 1, 0, 1, 0, 0, 0, 0, 16.0, 0.0]], dtype=np.float32)
    higher = hover.copy()
    higher[0, 0] = 3.0
    delta = [session.run(None, {"features": f})[0][0] for f in (hover, higher)]
    np.testing.assert_allclose(delta[1] - delta[0], [0, 0, -pull["value"]], atol=1e-3)


def test_an_import_by_its_old_name_is_told_with_the_new_one(tmp_path, monkeypatch) -> None:
    (tmp_path / "old.py").write_text("from models.effect import Effect\n")
    monkeypatch.setattr(sys, "path", [p for p in sys.path if Path(p).resolve() != ROOT.resolve()])
    for name in [n for n in sys.modules if n.split(".")[0] == "models"]:  # another test's
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(InputError, match=r"old\.py: no module 'models.*; import it from trueflight\.models"):
        catalogue(str(tmp_path))


def test_a_library_that_is_not_there_is_told_as_it_is(tmp_path) -> None:
    (tmp_path / "alone.py").write_text("import models_of_nobody\n")
    with pytest.raises(
        InputError, match="cannot be loaded: ModuleNotFoundError: No module named 'models_of_nobody'"
    ):
        catalogue(str(tmp_path))


@pytest.fixture(scope="module")
def breeze(tmp_path_factory) -> Path:
    """A folder with a user's effect that acts as wind does, in a file of another name."""
    folder = tmp_path_factory.mktemp("mine")
    text = (ROOT / "models" / "effects" / "wind.py").read_text()
    (folder / "breeze.py").write_text(text.replace('name="wind"', 'name="breeze"'))
    return folder


def test_wind_of_ones_own_is_found_as_wind_is(breeze: Path) -> None:
    flight = simulated(5, "wind:4")
    result = diagnose(flight, rigid_body_model(flight.vehicle, str(breeze)))
    told = {e.name: e for e in result.effects}
    assert told["rotor_drag"].verdict == "missing"
    assert {told["wind"].verdict, told["breeze"].verdict} == {"possible"}
    assert {told["wind"].rank, told["breeze"].rank} > {None}
    assert "breeze" in told["wind"].indistinguishable_from and "wind" in told["breeze"].indistinguishable_from
    values = [[p.value for p in told[name].parameters] for name in ("wind", "breeze")]
    np.testing.assert_allclose(*values, rtol=1e-3)


def test_wind_of_ones_own_turns_with_yaw_in_the_exported_correction(breeze: Path) -> None:
    flight = simulated(5, "wind:4")
    deltas = []
    for name in ("wind", "breeze"):
        model = rigid_body_model(flight.vehicle, str(breeze))
        drag = Term("rotor_drag", {"x": 0.2, "y": 0.2})
        model = model.with_terms((*model.terms, drag, Term(name, {"x": 3.0, "y": -2.0})))
        session = onnxruntime.InferenceSession(export_onnx(model, flight))
        features = feature_matrix(features_of_flight(flight), feature_names(model))
        deltas.append(session.run(None, {"features": features})[0])
    np.testing.assert_allclose(deltas[1], deltas[0], atol=1e-6)
    without = rigid_body_model(flight.vehicle, str(breeze))
    assert feature_names(without) == feature_names(model)[:-2], "yaw goes in for the breeze alone"


def test_template_is_listed_with_its_formula(tmp_path) -> None:
    write_template("tether", tmp_path)
    (told,) = json.loads(run("effects", "tether", "--effects", tmp_path, "--json"))
    assert "a = -pull h z" in told["formula"]
    assert told["parameters"]["pull"]["unit"] == "1/s^2"


@pytest.mark.parametrize("name", ["Tether", "my tether", "../x", "rotor_drag", ""])
def test_a_name_that_cannot_be_is_refused(tmp_path, name: str) -> None:
    with pytest.raises(InputError, match=r"choose another name|use lower-case"):
        write_template(name, tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_effect_of_ones_own_is_never_overwritten(tmp_path) -> None:
    path = write_template("tether", tmp_path)
    path.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        write_template("tether", tmp_path)
    assert path.read_text() == "mine"
