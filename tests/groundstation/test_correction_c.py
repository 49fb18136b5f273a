"""The correction as C: the same numbers as ONNX Runtime's, natively and on the autopilot's processor."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import programs
import pytest
from c_compilers import (
    FLIGHT,
    NAMES,
    SAMPLES,
    a_network,
    evaluate,
    has_cortex_m7,
    has_native,
    header_of,
    on_cortex_m7,
    with_effects,
)

from trueflight.groundstation.export.correction_c import deployed, write
from trueflight.models import contract
from trueflight.models.effect import Stage
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.export import export_onnx
from trueflight.models.features import feature_names
from trueflight.models.model import Model, Term, rigid_body_model, write_model
from trueflight.models.network import Network, acting_share

needs_gcc = pytest.mark.skipif(not has_native(), reason="no gcc")
needs_arm = pytest.mark.skipif(not has_cortex_m7(), reason="no gcc-arm-none-eabi or qemu-system-arm")


def rows(model: Model, count: int = 500, seed: int = 1) -> np.ndarray:
    """Features of any attitude and motion, and a few rows at rest and at the ends."""
    g = np.random.default_rng(seed)
    phi, theta, psi = g.uniform(-1.2, 1.2, count), g.uniform(-1.2, 1.2, count), g.uniform(-3.1, 3.1, count)
    columns = {
        "z": g.uniform(0.05, 5.0, count),
        "cos_phi": np.cos(phi),
        "sin_phi": np.sin(phi),
        "cos_theta": np.cos(theta),
        "sin_theta": np.sin(theta),
        **{name: g.normal(0.0, 5.0, count) * (np.arange(count) % 10 > 0) for name in ("vx", "vy", "vz")},
        "u_batt": g.uniform(13.0, 17.0, count),
        "T": g.uniform(0.0, 2.5, count) * FLIGHT.vehicle.weight,
        "cos_psi": np.cos(psi),
        "sin_psi": np.sin(psi),
    }
    columns["T"][:5] = 0.0
    return np.stack([columns[name] for name in feature_names(model)], axis=1).astype(np.float32)


def fading(network: Network) -> Network:
    """With a range that the rows above are partly in and often outside of, some far."""
    width = len(network.features)
    return replace(network, low=np.zeros(width), high=np.ones(width), margin=np.linspace(20.0, 60.0, width))


MODELS = {
    "effects": lambda: with_effects(None),
    "network": lambda: with_effects({}, a_network((16, 8))),
    "one layer": lambda: with_effects({}, a_network(())),
    "both": lambda: with_effects(None, a_network((8,))),
    "fading": lambda: with_effects({}, fading(a_network((16, 8)))),
    "fading line": lambda: with_effects({}, fading(a_network(()))),
    "both, fading": lambda: with_effects(None, fading(a_network((8,), names=NAMES[2:]))),
    "nothing": lambda: with_effects({}),
}


@needs_gcc
@pytest.mark.parametrize("label", MODELS)
def test_c_computes_what_onnx_runtime_computes(label: str, tmp_path: Path) -> None:
    model = MODELS[label]()
    if label == "nothing":
        header = write(model, deployed(export_onnx(with_effects({}, a_network(())), FLIGHT))).text
        return_of_nothing = "delta[0] = delta[1] = delta[2] = 0.0F"
        assert return_of_nothing in header
        return
    onnx = export_onnx(model, FLIGHT)
    given = rows(model)
    (wanted,) = onnxruntime.InferenceSession(onnx).run(None, {contract.INPUT_NAME: given})
    got = evaluate(write(model, deployed(onnx)).text, given, tmp_path)["delta"]
    scale = np.maximum(1.0, np.abs(wanted).max(axis=1, keepdims=True))
    assert np.abs((got - wanted) / scale).max() < 2e-4
    assert np.abs(wanted).max() > 1.0


def test_rows_are_inside_between_and_outside() -> None:
    network = fading(a_network((16, 8)))
    share = acting_share(network, rows(with_effects({}, network)))
    assert np.count_nonzero(share == 0.0) > 20 and np.count_nonzero((share > 0.0) & (share < 1.0)) > 20


@needs_gcc
def test_each_effect_alone_is_the_same_in_c(tmp_path: Path) -> None:
    compared = 0
    for effect in catalogue().values():
        if not effect.exports or effect.stage is Stage.SENSOR or not effect.parameters or effect.acts_through:
            continue
        values = {p.name: 0.5 * (p.neutral_for(FLIGHT.vehicle) + p.typical) for p in effect.parameters}
        model = with_effects({effect.name: values})
        onnx = export_onnx(model, FLIGHT)
        given = rows(model, 100)
        (wanted,) = onnxruntime.InferenceSession(onnx).run(None, {contract.INPUT_NAME: given})
        folder = tmp_path / effect.name
        folder.mkdir()
        got = evaluate(write(model, deployed(onnx)).text, given, folder)["delta"]
        np.testing.assert_allclose(got, wanted, rtol=2e-4, atol=2e-4, err_msg=effect.name)
        compared += 1
    assert compared >= 8


@needs_gcc
def test_beyond_exact_rotation_there_is_the_drag_alone(tmp_path: Path) -> None:
    """By plain vector algebra: 0.3 and 0.4 1/s along x and y of the body, in a hover's thrust."""
    drag = np.diag([0.3, 0.4, 0.0])
    model = with_effects({"rotor_drag": {"x": 0.3, "y": 0.4}})
    given = rows(model, 60)
    names = list(feature_names(model))
    given[:, names.index("T")] = FLIGHT.vehicle.weight
    wanted = []
    for row in given:
        f = dict(zip(names, row.astype(float), strict=True))
        cp, sp, ct, st = f["cos_phi"], f["sin_phi"], f["cos_theta"], f["sin_theta"]
        body_to_heading = np.array([[ct, st * sp, st * cp], [0, cp, -sp], [-st, ct * sp, ct * cp]])
        air = body_to_heading.T @ np.array([f["vx"], f["vy"], f["vz"]])
        wanted.append(body_to_heading @ (-drag @ air))
    got = evaluate(header_of(model), given, tmp_path)["beyond"]
    np.testing.assert_allclose(got, wanted, atol=2e-4)


@needs_gcc
def test_range_of_training_is_in_the_file_and_nan_is_outside(tmp_path: Path) -> None:
    model = with_effects({"thrust_gain": {"gain": 0.9}})
    file = deployed(export_onnx(model, FLIGHT))
    low, high = (np.array([f[k] for f in file.features], dtype=np.float32) for k in ("low", "high"))
    inside = 0.5 * (low + high)
    tried = np.tile(inside, (4, 1))
    tried[1, 3] = low[3] - 0.01
    tried[2, 9] = high[9] + 0.1
    tried[3, 0] = np.nan
    assert evaluate(write(model, file).text, tried, tmp_path)["outside"].tolist() == [-1, 3, 9, 0]


@needs_gcc
def test_self_test_fails_where_a_number_is_wrong(tmp_path: Path) -> None:
    header = header_of(with_effects({"thrust_gain": {"gain": 0.9}}))
    wrong = header.replace(
        "const float f_T = features[CORRECTION_T]", "const float f_T = 1.01F*features[CORRECTION_T]"
    )
    assert wrong != header
    with pytest.raises(AssertionError, match="gcc: 3"):
        evaluate(wrong, rows(with_effects({"thrust_gain": {"gain": 0.9}}), 1), tmp_path)


@needs_arm
def test_cortex_m7_passes_the_self_test_and_pays_less_for_less(tmp_path: Path) -> None:
    costs = {}
    for widths in ((4,), (16, 8)):
        folder = tmp_path / str(len(widths))
        folder.mkdir()
        costs[widths] = on_cortex_m7(
            header_of(with_effects({"rotor_drag": {"x": 0.3, "y": 0.3}}, a_network(widths))), folder
        )
    small, large = costs[(4,)], costs[(16, 8)]
    assert small.flash < large.flash and small.instructions < large.instructions
    assert 4 * a_network((16, 8)).parameters < large.flash
    assert small.ram == large.ram == 0 and large.stack < 1024  # tables are in flash, and there is no heap


def test_every_effect_is_told_whether_the_file_holds_it() -> None:
    model = with_effects(None, a_network((4,)))
    written = write(model, deployed(export_onnx(model, FLIGHT)))
    held = {line.effect: line.held for line in written.lines}
    assert set(held) == {*model.names(), "network"}
    assert held["rotor_drag"] == held["network"] == "whole"
    assert held["accelerometer_bias"] == held["motor_lag"] == "not"
    assert all(f"{name}: " in written.text for name in held)


def test_command_writes_the_header_and_says_what_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "v0001.json"
    write_model(with_effects({"rotor_drag": {"x": 0.3, "y": 0.3}}), path)
    flight = SAMPLES / "rotorpy" / "rotor_drag" / "identify.parquet"
    given = ("model", "export", str(path), "--to", "c", "--flight", str(flight))
    done = programs.run("groundstation", *given, "-o", str(tmp_path / "correction.h"), "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    schema = (
        Path(__file__).parents[2] / "groundstation" / "output" / "schemas" / "groundstation-model-export.json"
    )
    assert told["to"] == "c" and schema.exists()
    assert {row["effect"] for row in told["effects"]} == {"rigid_body", "rotor_drag"}
    assert told["hash"] in (tmp_path / "correction.h").read_text()
    bad = programs.run("groundstation", *given, "-o", str(tmp_path / "correction.onnx"), cwd=tmp_path)
    assert bad.returncode == 2 and ".h" in bad.stderr


def test_effect_of_the_users_own_that_takes_no_symbols_is_refused_by_name(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "models" / "effects" / "battery_sag.py").read_text()
    own = text.replace('name="battery_sag"', 'name="odd"').replace(
        "xp.exp(exponent * ratio)", "xp.expm1(exponent)"
    )
    (tmp_path / "odd.py").write_text(own)
    model = rigid_body_model(FLIGHT.vehicle, str(tmp_path))
    model = model.with_terms((*model.terms, Term("odd", {"exponent": 1.2})))
    file = deployed(export_onnx(with_effects({"battery_sag": {"exponent": 1.2}}), FLIGHT))
    with pytest.raises(InputError, match=r"odd: xp\.expm1 .*export to onnx instead"):
        write(model, file)


def test_library_writes_c_where_the_name_ends_so(tmp_path: Path) -> None:
    import trueflight as tf

    model = tf.add(FLIGHT, "rotor_drag")
    assert "correction_self_test" in tf.export(FLIGHT, tmp_path / "a.h", model=model).read_text()
