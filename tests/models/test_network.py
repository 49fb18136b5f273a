"""A network as data: it survives the disk, predicts alike in every library, and is deployed as it predicts."""

import base64
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.companion.law.model_check import check_model
from trueflight.companion.law.straight_line import StraightLine
from trueflight.models import contract
from trueflight.models.errors import InputError
from trueflight.models.export import Correction, export_onnx, sequential
from trueflight.models.features import feature_matrix, features_of_flight
from trueflight.models.flight import Flight
from trueflight.models.frames import rotation_matrix
from trueflight.models.model import Term, linear_model, read_model, rigid_body_model, write_model
from trueflight.models.network import (
    Network,
    acting_share,
    error_acceleration_of,
    features_of_motion,
    folded_layers,
    network_from_table,
    network_table,
)
from trueflight.models.prediction import acceleration, apply_effects, error_acceleration, motion_of_flight
from trueflight.models.vehicle import load_vehicle

VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")
NAMES = tuple(contract.FEATURES)


def a_network(seed: int = 0, widths: tuple[int, ...] = (16, 8), names: tuple[str, ...] = NAMES) -> Network:
    g = np.random.default_rng(seed)
    sizes = [len(names), *widths, 3]
    layers = tuple(
        (g.normal(0, 0.6, (b, a)).astype(np.float32), g.normal(0, 0.3, b).astype(np.float32))
        for a, b in pairwise(sizes)
    )
    low = g.uniform(-1, 0, len(names)).astype(np.float32)
    return Network(
        features=names, centre=g.normal(0, 1, len(names)).astype(np.float32),
        scale=g.uniform(0.05, 2, len(names)).astype(np.float32), layers=layers,
        output_scale=np.array([0.5, 0.6, 0.8], np.float32), low=low, high=low + 2, data_hash="abc", seed=seed,
        recipe="default", fit={"train_rms": 0.1},
    )  # fmt: skip


def a_fading_network(seed: int, widths: tuple[int, ...], names: tuple[str, ...] = NAMES) -> Network:
    """One that was trained on part of what `a_flight` does; further out it fades."""
    features = feature_matrix(features_of_flight(a_flight()), names)
    low, high = np.quantile(features, (0.1, 0.9), axis=0).astype(np.float32)
    return replace(a_network(seed, widths, names), low=low, high=high, margin=2.0 * (high - low) + 0.05)


def a_flight(n: int = 400, seed: int = 0) -> Flight:
    """A flight that tilts, turns and moves, with everything a network needs."""
    g = np.random.default_rng(seed)
    t = 0.01 * np.arange(n)
    wave = [
        np.sin(2 * np.pi * f * t + p)
        for f, p in zip(g.uniform(0.2, 1.5, 12), g.uniform(0, 6, 12), strict=True)
    ]
    phi, theta, psi = 0.3 * wave[0], 0.3 * wave[1], 2.0 * wave[2]
    half = [(np.cos(a / 2), np.sin(a / 2)) for a in (phi, theta, psi)]
    (cr, sr), (cp, sp), (cy, sy) = half
    quaternion = np.stack(
        [cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
         cr * cp * sy - sr * sp * cy], -1,
    )  # fmt: skip
    return Flight(
        name="made", vehicle=VEHICLE, t=t,
        position=np.stack([wave[3], wave[4], 1.2 + 0.5 * wave[5]], -1),
        velocity=np.stack([2 * wave[6], 2 * wave[7], wave[8]], -1),
        quaternion=quaternion, thrust_command=0.38 + 0.1 * wave[9], battery_voltage=16 + 0.4 * wave[10],
        specific_force=np.zeros((n, 3)), data_hash="flight",
    )  # fmt: skip


def test_numpy_torch_and_onnx_predict_alike() -> None:
    flight, network = a_flight(), a_network()
    model = rigid_body_model(VEHICLE).with_network(network)
    features = feature_matrix(features_of_flight(flight), NAMES)
    by_numpy = error_acceleration_of(network, features)
    by_torch = error_acceleration_of(network, torch.from_numpy(features)).numpy()
    folded = sequential(folded_layers(network, NAMES))(torch.from_numpy(features)).detach().numpy()
    np.testing.assert_allclose(by_torch, by_numpy, atol=1e-5)
    np.testing.assert_allclose(folded, by_numpy, atol=1e-4)
    with torch.no_grad():
        whole = Correction(model, NAMES)(torch.from_numpy(features)).numpy()
    session = onnxruntime.InferenceSession(export_onnx(model, flight))
    (delta,) = session.run([contract.OUTPUT_NAME], {contract.INPUT_NAME: features})
    np.testing.assert_allclose(delta, whole, atol=1e-4)
    rigid = Correction(rigid_body_model(VEHICLE), NAMES)(torch.from_numpy(features)).numpy()
    np.testing.assert_allclose(delta - rigid, by_numpy, atol=1e-4)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 1000), st.lists(st.integers(1, 20), max_size=3), st.sampled_from([NAMES, NAMES[2:]]))
def test_whoever_computes_a_network_that_fades_lets_the_same_of_it_act(
    seed: int, widths: list[int], names: tuple[str, ...]
) -> None:
    """numpy, torch, ONNX Runtime and the companion's straight line; C is in `test_correction_c.py`."""
    network = a_fading_network(seed, tuple(widths), names)
    model = linear_model(VEHICLE).with_network(network)
    inside = feature_matrix(features_of_flight(a_flight()), NAMES)
    given = np.concatenate([inside, inside * np.float32(1.5) - np.float32(0.3), inside + np.float32(100.0)])
    of_network = given[:, [NAMES.index(name) for name in names]]
    share = acting_share(network, of_network)
    assert np.all(share[-len(inside) :] == 0.0) and np.count_nonzero((share > 0.0) & (share < 1.0)) > 0
    plain = error_acceleration_of(replace(network, margin=None), of_network)
    wanted = plain * share[:, None]
    np.testing.assert_allclose(error_acceleration_of(network, of_network), wanted, atol=1e-6)
    by_torch = error_acceleration_of(network, torch.from_numpy(of_network)).numpy()
    np.testing.assert_allclose(by_torch, wanted, rtol=1e-3, atol=1e-3)
    onnx_file = export_onnx(model, a_flight())
    (by_runtime,) = onnxruntime.InferenceSession(onnx_file).run(None, {contract.INPUT_NAME: given})
    np.testing.assert_allclose(by_runtime, wanted, rtol=1e-3, atol=1e-3)
    straight = StraightLine(onnx_file, len(NAMES))(given.tolist())
    np.testing.assert_allclose(straight, by_runtime, rtol=1e-4, atol=1e-4)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(0, len(NAMES) - 1), st.booleans())
def test_a_network_acts_wholly_in_its_range_and_less_with_each_step_out_of_it(
    seed: int, feature: int, up: bool
) -> None:
    network = a_fading_network(seed, (8,))
    inside = np.random.default_rng(seed).uniform(network.low, network.high)
    assert acting_share(network, inside[None]) == 1.0
    ways = np.linspace(0.0, 2.0, 101)
    path = np.tile(inside, (len(ways), 1))
    end, sign = (network.high, 1.0) if up else (network.low, -1.0)
    path[:, feature] = end[feature] + sign * ways * network.margin[feature]
    share = acting_share(network, path)
    np.testing.assert_allclose(
        share, np.clip(1.0 - ways, 0.0, None), atol=1e-5
    )  # continuous, and 0 far outside
    out = error_acceleration_of(network, path)
    assert np.all(out[ways > 1.0 + 1e-6] == 0.0)


def test_effects_are_kept_where_a_network_has_faded_and_the_file_is_believed_there() -> None:
    """The range of the file is that of its flights; of a file of before it is the network's, effects or not."""
    network, flight = a_fading_network(0, (8,)), a_flight()
    model = rigid_body_model(VEHICLE)
    features = feature_matrix(features_of_flight(flight), NAMES)
    new, old = (
        check_model(export_onnx(model.with_network(n), flight), VEHICLE).model
        for n in (network, replace(network, margin=None))
    )
    assert [f.low for f in old.info.features] == pytest.approx(network.low.tolist())
    assert [f.low for f in new.info.features] == pytest.approx(features.min(axis=0).tolist())
    assert [f.high for f in new.info.features] == pytest.approx(features.max(axis=0).tolist())
    assert new.straight and old.straight
    away = features[0] + np.float32(0.0)
    away[NAMES.index("u_batt")] = network.low[8] - 1.5 * network.margin[8]
    effects = check_model(export_onnx(model, flight), VEHICLE).model
    np.testing.assert_allclose(new(away.tolist()), effects(away.tolist()), atol=1e-5)
    assert max(np.abs(np.subtract(old(away.tolist()), effects(away.tolist())))) > 0.01


def test_golden_vectors_of_a_network_that_fades_are_inside_between_and_outside() -> None:
    import onnx

    network = a_fading_network(0, (8,))
    file = export_onnx(linear_model(VEHICLE).with_network(network), a_flight())
    meta = {one.key: one.value for one in onnx.load_from_string(file).metadata_props}
    golden = np.array(json.loads(meta[contract.KEY_GOLDEN_FEATURES]))
    half, far = acting_share(network, golden)[-2:]
    assert (half, far) == (pytest.approx(0.5, abs=1e-5), 0.0)


def test_what_a_flight_is_predicted_with_is_what_the_companion_gets() -> None:
    """The chain that comparisons use and the exported formula agree, at every attitude and heading."""
    flight = a_flight()
    still = VEHICLE.__class__(**{**VEHICLE.__dict__, "command_delay": 0.0, "motor_time_constant": 0.0})
    flight = flight.__class__(**{**flight.__dict__, "vehicle": still})
    drag = Term("rotor_drag", {"x": 0.3, "y": 0.4})
    model = rigid_body_model(still).with_network(a_network(3))
    model = model.with_terms((*model.terms, drag))
    motion = motion_of_flight(flight)
    features = features_of_motion(motion, NAMES)
    np.testing.assert_allclose(features, feature_matrix(features_of_flight(flight), NAMES), atol=1e-5)
    before_sensor = error_acceleration(motion, model.chain())
    with torch.no_grad():
        exported = Correction(model, NAMES)(torch.from_numpy(features.astype(np.float32))).numpy()
    np.testing.assert_allclose(exported, before_sensor, atol=2e-4)


def test_wind_changes_what_drag_feels_and_not_what_the_network_sees() -> None:
    flight, network = a_flight(), a_network(1)
    drag, wind = Term("rotor_drag", {"x": 0.3, "y": 0.3}), Term("wind", {"x": 4.0, "y": -1.0})
    base = rigid_body_model(VEHICLE)
    base = base.with_terms((*base.terms, drag, wind))
    motion = motion_of_flight(flight)
    with_, without = (
        acceleration(apply_effects(motion, m.chain())) for m in (base.with_network(network), base)
    )
    delivered = apply_effects(motion, [])
    expected = error_acceleration_of(network, features_of_motion(delivered, network.features))
    np.testing.assert_allclose(with_ - without, expected, atol=1e-9)


def test_thrust_that_the_network_sees_is_the_one_that_acts() -> None:
    flight = a_flight()
    step = np.where(flight.t < 2.0, 0.3, 0.5)
    flight = flight.__class__(**{**flight.__dict__, "thrust_command": step})
    seen = features_of_motion(apply_effects(motion_of_flight(flight), []), ("T",))[:, 0]
    commanded = VEHICLE.thrust(step)
    after = np.flatnonzero(flight.t >= 2.0)[0]
    assert seen[after] < commanded[after] - 2.0  # neither delay nor lag are over yet
    assert seen[-1] == pytest.approx(commanded[-1], rel=1e-6)
    assert np.all(np.diff(seen) >= -1e-9)


def test_companion_accepts_effects_and_network_in_one_file_with_the_network_s_range() -> None:
    network = a_network()
    model = rigid_body_model(VEHICLE).with_network(network)
    data = export_onnx(model, a_flight())
    verdict = check_model(data, VEHICLE)
    assert verdict.accepted, verdict.reason
    assert [f.low for f in verdict.model.info.features] == pytest.approx(network.low.tolist())
    assert [f.high for f in verdict.model.info.features] == pytest.approx(network.high.tolist())
    assert [link["effect"] for link in verdict.model.info.chain] == ["rigid_body", "network"]
    assert verdict.model.info.data_hash == "abc"


def test_feature_the_network_does_not_use_has_no_influence() -> None:
    network = a_network(names=tuple(n for n in NAMES if n != "u_batt"))
    data = export_onnx(linear_model(VEHICLE).with_network(network), a_flight())
    session = onnxruntime.InferenceSession(data)
    x = feature_matrix(features_of_flight(a_flight()), NAMES)
    y = x.copy()
    y[:, NAMES.index("u_batt")] -= 3.0
    (a,), (b,) = (session.run(None, {contract.INPUT_NAME: v}) for v in (x, y))
    np.testing.assert_array_equal(a, b)
    assert check_model(data, VEHICLE).accepted


def test_network_alone_is_a_handful_of_operations() -> None:
    import onnx

    graph = onnx.load_from_string(
        export_onnx(linear_model(VEHICLE).with_network(a_network()), a_flight())
    ).graph
    assert [n.op_type for n in graph.node] == ["Gemm", "Relu", "Gemm", "Relu", "Gemm"]
    fading = linear_model(VEHICLE).with_network(a_fading_network(0, (16, 8)))
    graph = onnx.load_from_string(export_onnx(fading, a_flight())).graph
    assert sorted(n.op_type for n in graph.node) == 4 * ["Gemm"] + ["Mul"] + 3 * ["Relu"]


def test_version_with_a_network_survives_the_disk(tmp_path) -> None:
    model = rigid_body_model(VEHICLE).with_network(a_network())
    write_model(model, tmp_path / "v0001-network.json")
    again = read_model(tmp_path / "v0001-network.json")
    assert again == model
    assert again.network.hash == model.network.hash
    x = feature_matrix(features_of_flight(a_flight()), NAMES)
    np.testing.assert_array_equal(
        error_acceleration_of(again.network, x), error_acceleration_of(model.network, x)
    )
    assert again.label == "+ network 16-8"


def test_version_without_a_network_reads_as_before(tmp_path) -> None:
    write_model(rigid_body_model(VEHICLE), tmp_path / "m.json")
    assert "network" not in json.loads((tmp_path / "m.json").read_text())
    assert read_model(tmp_path / "m.json").network is None


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.lists(st.integers(1, 40), min_size=1, max_size=4))
def test_any_network_is_read_as_it_was_written(seed: int, widths: list[int]) -> None:
    network = a_network(seed, tuple(widths))
    assert "margin" not in network_table(network)  # as files of before are
    fading = replace(network, margin=np.full(len(NAMES), 0.5, np.float32))
    assert network_from_table(json.loads(json.dumps(network_table(fading))), "x") == fading != network
    assert network_from_table(json.loads(json.dumps(network_table(network))), "x") == network
    assert network.parameters == sum(w.size + b.size for w, b in network.layers)


def _nan(table):
    table["centre"] = base64.b64encode(np.full(10, np.nan, "<f4").tobytes()).decode()


DAMAGE = {
    "features": lambda t: t.update(features=["z", "speed"]),
    "sizes": lambda t: t.update(sizes=[10, 16, 4]),
    "inputs": lambda t: t.update(sizes=[9, 16, 8, 3]),
    "layers": lambda t: t["layers"].pop(),
    "weights": lambda t: t["layers"][1].update(weights="AAAA"),
    "base64": lambda t: t["layers"][0].update(biases="not base64!"),
    "finite": _nan,
    "range": lambda t: t.update(low=t["high"], high=t["low"]),
    "margin": lambda t: t.update(margin=base64.b64encode(np.zeros(10, "<f4").tobytes()).decode()),
    "short margin": lambda t: t.update(margin="AAAA"),
    "kind": lambda t: t.update(seed="one"),
    "not a table": lambda t: t.clear(),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_damaged_network_is_told_in_one_line(damage, tmp_path) -> None:
    path = tmp_path / "m.json"
    write_model(rigid_body_model(VEHICLE).with_network(a_network()), path)
    table = json.loads(path.read_text())
    damage(table["network"])
    bad = tmp_path / "bad.json"
    bad.write_text(json.dumps(table))
    with pytest.raises(InputError, match=r"bad\.json: network") as told:
        read_model(bad)
    assert "\n" not in str(told.value)


def test_flight_without_attitude_is_refused_with_what_to_do() -> None:
    flight = a_flight()
    blind = flight.__class__(**{**flight.__dict__, "quaternion": None})
    model = linear_model(VEHICLE).with_network(a_network())
    with pytest.raises(InputError, match="quaternion"):
        apply_effects(motion_of_flight(blind), model.chain())


def test_heading_frame_of_the_features_turns_with_yaw() -> None:
    """Turned by any yaw, a flight shows the network the same features."""
    flight = a_flight()
    angle = 1.1
    turn = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    w, x, y, z = flight.quaternion.T
    c, s = turn[0], turn[3]
    turned_q = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)
    r = rotation_matrix(turn[None])[0]
    turned = flight.__class__(
        **{**flight.__dict__, "quaternion": turned_q, "velocity": flight.velocity @ r.T}
    )
    a, b = (features_of_motion(motion_of_flight(f), NAMES) for f in (flight, turned))
    np.testing.assert_allclose(a, b, atol=1e-9)


def test_a_model_of_many_flights_is_accepted() -> None:
    """The hashes of four flights are longer than what a name or hash of a file may be."""
    model = replace(rigid_body_model(VEHICLE), data_hash="+".join(f"{number:064x}" for number in range(4)))
    assert check_model(export_onnx(model, a_flight()), VEHICLE).accepted
