"""Training: what no effect explains is learnt, on flights that were held out as whole stretches."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import programs
import pytest

from trueflight.groundstation.evaluate.compare import compare, waterfall
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.learn.ablation import ablate, inference_time
from trueflight.groundstation.learn.training import (
    MATERIAL_MEMORY,
    OWN,
    PAPER,
    memory_share,
    recipe_named,
    train,
)
from trueflight.groundstation.learn.training_data import GAP, blocks, samples_of_flights, split
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.several import read_flights
from trueflight.groundstation.versions.store import add_effect, find, lineage, save
from trueflight.models.errors import InputError
from trueflight.models.export import export_onnx
from trueflight.models.model import linear_model, read_model, rigid_body_model
from trueflight.models.network import acting_share

BIN = Path(sys.executable).parent
VEHICLE = Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml"
QUICK = replace(OWN, epochs=12, batch=256)


def fly(folder: Path, name: str, *options: str) -> Path:
    path = folder / f"{name}.mcap"
    hidden = ["--hidden", "rotor_drag:0.4", "--hidden", "battery_sag:1.8", "--hidden", "thrust_gain:1.08"]
    told = programs.run("sim-bridge", "fly", "--vehicle", VEHICLE, "--seed", 5, "-o", path, *hidden, *options)
    assert told.returncode == 0, told.stderr
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three flights to learn from, one that nobody learns from."""
    folder = tmp_path_factory.mktemp("flights")
    (folder / "learn").mkdir()
    fly(folder / "learn", "a", "--trajectory", "excitation")
    fly(folder / "learn", "b", "--trajectory", "excitation", "--set", "speed=3", "--set", "size=1.8")
    fly(folder / "learn", "c", "--trajectory", "circle", "--set", "speed=2.5")
    fly(folder, "unseen", "--trajectory", "lemniscate", "--set", "speed=2")
    return folder


@pytest.fixture(scope="module")
def flights(folder):
    return read_flights([folder / "learn"])


@pytest.fixture(scope="module")
def unseen(folder):
    return read_flight(folder / "unseen.mcap")


@pytest.fixture(scope="module")
def base(flights):
    return rigid_body_model(flights[0].vehicle)


@pytest.fixture(scope="module")
def samples(flights, base):
    return samples_of_flights(flights, base)


@pytest.fixture(scope="module")
def trained(samples):
    return train(samples, QUICK, (32, 32), seed=1)


def test_hidden_effects_are_learnt_and_an_unseen_flight_is_predicted(trained, base, unseen) -> None:
    learnt = base.with_network(trained.network)
    before, after = (compare(unseen, m) for m in (base, learnt))
    assert before.rms > 4 * before.noise_floor
    assert after.rms < 2 * after.noise_floor
    for was, now in zip(before.axes, after.axes, strict=True):
        assert now.rms < was.rms
    # open loop, too: a second ahead from commands and attitude alone
    far = [float(np.linalg.norm(c.horizons[-1].position)) for c in (before, after)]
    assert far[1] < 0.3 * far[0]


def test_held_out_error_is_told_in_physical_units_beside_the_floor(trained, samples) -> None:
    fit = trained.network.fit
    assert fit["noise_floor"] < fit["validation_rms"] < 0.4 * fit["before_rms"]
    axes = [fit[f"validation_rms_{a}"] for a in "xyz"]
    assert fit["validation_rms"] == pytest.approx(np.sqrt(np.mean(np.square(axes))))
    assert trained.history[-1].validation_rms < trained.history[0].validation_rms


def test_network_beside_the_true_effect_has_less_to_learn(flights, samples) -> None:
    richer = add_effect(rigid_body_model(flights[0].vehicle), "rotor_drag", flights)
    rest = samples_of_flights(flights, richer)
    across = [np.sqrt(np.mean(s.target[:, :2] ** 2)) for s in (samples, rest)]
    assert across[1] < 0.4 * across[0]


@pytest.mark.parametrize("seed", range(5))
def test_split_shares_no_block_and_keeps_its_distance(samples, seed: int) -> None:
    learn, held = split(samples, seed)
    assert not np.any(learn & held)
    assert not set(samples.block[learn]) & set(samples.block[held])
    assert 0.2 < held.mean() < 0.45
    for number in range(len(samples.flights)):
        mine = samples.flight == number
        a, b = np.sort(samples.t[mine & learn]), samples.t[mine & held]
        if len(a) and len(b):
            place = np.clip(np.searchsorted(a, b), 1, len(a) - 1)
            nearest = np.minimum(np.abs(a[place] - b), np.abs(a[place - 1] - b))
            assert nearest.min() >= GAP


def test_with_many_flights_whole_flights_are_held_out(samples) -> None:
    many = replace(
        samples, flights=tuple("abcdefghijkl"), flight=np.arange(len(samples)) * 12 // len(samples),
    )  # fmt: skip
    learn, held = split(replace(many, block=blocks(many)), 0)
    assert np.all(learn | held)
    assert not set(many.flight[learn]) & set(many.flight[held])


def test_same_seed_same_weights_other_seed_others(samples, trained) -> None:
    again = train(samples, QUICK, (32, 32), seed=1)
    assert again.network.hash != train(samples, QUICK, (32, 32), seed=2).network.hash
    for (w, b), (v, c) in zip(again.network.layers, trained.network.layers, strict=True):
        np.testing.assert_array_equal(w, v)
        np.testing.assert_array_equal(b, c)


@pytest.mark.parametrize("recipe", [QUICK, replace(PAPER, epochs=4, batch=1024)], ids=["default", "paper"])
def test_interrupted_training_goes_on_to_the_very_same_weights(samples, recipe, tmp_path) -> None:
    checkpoint = tmp_path / "training.checkpoint"
    whole = train(samples, recipe, (16,), seed=3)

    def interrupt(number, epoch):
        if number == 3:
            raise KeyboardInterrupt

    first = train(samples, recipe, (16,), 3, checkpoint, progress=interrupt)
    assert first.interrupted
    assert len(first.history) == 3
    assert [p.name for p in tmp_path.iterdir()] == ["training.checkpoint"]
    second = train(samples, recipe, (16,), 3, checkpoint, resume=True)
    assert [e.validation for e in second.history] == [e.validation for e in whole.history]
    for (w, b), (v, c) in zip(second.network.layers, whole.network.layers, strict=True):
        np.testing.assert_array_equal(w, v)
        np.testing.assert_array_equal(b, c)


def test_checkpoint_of_another_training_is_refused(samples, tmp_path) -> None:
    checkpoint = tmp_path / "training.checkpoint"

    def interrupt(number, epoch):
        raise KeyboardInterrupt

    train(samples, QUICK, (8,), 0, checkpoint, progress=interrupt)
    with pytest.raises(InputError, match="another training"):
        train(samples, QUICK, (8,), 1, checkpoint, resume=True)
    checkpoint.write_bytes(b"half a file")
    with pytest.raises(InputError, match="damaged checkpoint"):
        train(samples, QUICK, (8,), 0, checkpoint, resume=True)
    with pytest.raises(InputError, match="no checkpoint"):
        train(samples, QUICK, (8,), 0, tmp_path / "none", resume=True)


def test_training_that_no_longer_improves_ends_early(samples) -> None:
    done = train(samples, replace(QUICK, rate=1e-9, epochs=50, patience=4), (8,), 0)
    assert len(done.history) < 50


def test_feature_that_never_varies_is_not_used(flights, base, unseen) -> None:
    constant = [replace(f, battery_voltage=None) for f in flights]
    samples = samples_of_flights(constant, base)
    network = train(samples, replace(QUICK, epochs=1), (8,), 0).network
    assert "u_batt" in samples.names
    assert "u_batt" not in network.features


def test_lag_that_the_base_lacks_is_told_apart_from_what_a_network_can_learn(
    flights, trained, samples
) -> None:
    quick = replace(flights[0].vehicle, motor_time_constant=0.0, command_delay=0.0)
    # and commands logged two samples before they were given
    early = [np.append(f.thrust_command[2:], f.thrust_command[-2:]) for f in flights]
    late = [replace(f, vehicle=quick, thrust_command=u) for f, u in zip(flights, early, strict=True)]
    misled = samples_of_flights(late, rigid_body_model(quick))
    shares = memory_share(samples, trained), memory_share(misled, train(misled, QUICK, (32, 32), seed=1))
    assert shares[0] < 0.1 * MATERIAL_MEMORY
    assert shares[1] > MATERIAL_MEMORY


def test_flight_that_is_too_short_is_left_out_and_told_of(flights, base, samples) -> None:
    short = replace(flights[2].part(slice(0, 300)), name="short")
    both = samples_of_flights([flights[0], short], base)
    assert len(both.left_out) == 1
    assert len(both) == int((samples.flight == 0).sum())
    with pytest.raises(InputError, match="too short"):
        samples_of_flights([short], base)


def test_samples_on_the_ground_are_not_learnt_from(flights, base) -> None:
    height = flights[0].position.copy()
    height[1000:1010, 2] = 0.0
    touching = replace(flights[0], position=height)
    whole, rest = (samples_of_flights([f], base) for f in (flights[0], touching))
    touched = flights[0].t[1005] - flights[0].t[0]
    near = [np.abs(s.t - touched) < 0.5 for s in (whole, rest)]
    assert near[0].any()
    assert not near[1].any()


def test_training_range_is_that_of_the_flights_trained_on(trained, samples) -> None:
    learn = samples.only(trained.train).with_features(trained.network.features).features
    # All but the last thousandth at each end: a handful of samples teaches nothing.
    outside = np.mean((learn < trained.network.low) | (learn > trained.network.high), axis=0)
    assert np.all(outside > 0.0)
    assert np.all(outside <= 0.0025)


def test_a_network_acts_wholly_on_what_it_was_trained_on_and_not_at_all_far_from_it(trained, samples) -> None:
    network = trained.network
    features = samples.only(trained.train).with_features(network.features).features
    share = acting_share(network, features)
    assert np.mean(share == 1.0) > 0.97 and share.mean() > 0.995
    for name, distance in (("z", 5.0), ("vx", 15.0), ("u_batt", -6.0)):
        away = features.copy()
        away[:, network.features.index(name)] += distance
        assert acting_share(network, away).max() == 0.0


def test_a_new_effect_drops_the_network_that_was_trained_without_it(trained, base, flights, tmp_path) -> None:
    first, path = save(tmp_path, base.with_network(trained.network), None)
    assert path.name == "v0001-network.json"
    assert read_model(path) == first
    second, _ = save(tmp_path, add_effect(first, "rotor_drag", flights[:1]), first)
    assert second.network is None
    assert find(tmp_path, base.vehicle.name, "v1").network is not None
    line = lineage(tmp_path, second)
    assert [m.label for m in line] == ["linear", "+ rigid_body", "v1 + network 32-32", "v2 + rotor_drag"]
    steps = waterfall(flights[0], None, line)
    assert steps[2].fitted < 0.4 * steps[1].fitted


def test_diagnosis_beside_a_network_finds_nothing_more_to_explain(trained, base, flights) -> None:
    part = flights[0].part(slice(500, 2500))
    alone = diagnose(part, base)
    beside = diagnose(part, base.with_network(trained.network))
    assert "rotor_drag" in alone.named("missing")
    assert beside.rms_before < 0.4 * alone.rms_before
    assert "rotor_drag" not in beside.named("missing")


def test_ablation_marks_the_smallest_network_that_is_good_enough(samples, base, flights) -> None:
    tried = [(4,), (32, 32), (48, 48)]
    result = ablate(samples, base, flights[0], QUICK, 0, tried, features=True)
    assert [r.widths for r in result.networks] == tried
    best, smallest = (next(r for r in result.networks if getattr(r, k)) for k in ("best", "smallest"))
    assert smallest.parameters <= best.parameters
    assert smallest.validation_rms <= 1.05 * best.validation_rms
    assert result.networks[0].onnx_bytes < result.networks[-1].onnx_bytes
    # drag is what was hidden: the features that carry it matter most
    assert {f.feature for f in result.features[:4]} & {"vx", "vy"} == {"vx", "vy"}
    without = [f.without_rms for f in result.features[-3:]]
    assert len(without) == 3 and None not in without


def test_inference_of_a_network_takes_microseconds_not_milliseconds(trained, flights) -> None:
    data = export_onnx(linear_model(flights[0].vehicle).with_network(trained.network), flights[0])
    assert inference_time(data) < 1e-3


# --- the command lines ------------------------------------------------------------------------------------------


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return programs.run("groundstation", *arguments)


def test_train_makes_a_version_that_every_other_command_uses(folder, tmp_path) -> None:
    store = tmp_path / "models"
    done = run(
        "train", folder / "learn", "--epochs", 6, "--layers", "16,16", "--store", store, "--json", "--save",
        tmp_path / "training.rrd",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["version"] == 1
    assert told["network"]["layers"] == [16, 16]
    assert told["network"]["fit"]["validation_rms"] < 0.5 * told["network"]["fit"]["before_rms"]
    assert sorted(p.name for p in (store / "quad5").iterdir()) == ["v0001-network.json"]
    verified = subprocess.run(
        [BIN / "rerun", "rrd", "verify", tmp_path / "training.rrd"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert verified.returncode == 0, verified.stderr
    compared = json.loads(run("compare", folder / "unseen.mcap", "--store", store, "--json").stdout)
    assert [v["model"] for v in compared["versions"]][-1] == "v1 + network 16-16"
    assert compared["rms"] < 0.5 * compared["versions"][1]["rms"]
    listed = run("model", "list", "--store", store)
    assert "network" in listed.stdout
    shown = json.loads(run("model", "show", "v1", "--store", store, "--json").stdout)
    assert shown["network"]["hash"] == told["network"]["hash"]


BAD = [
    (["train", "nowhere.mcap"], "nowhere.mcap"),
    (["train", "."], "no flights"),
    (["train", "FLIGHT", "--layers", "64,x"], "--layers 64,x"),
    (["train", "FLIGHT", "--layers", "0"], "--layers 0"),
    (["train", "FLIGHT", "--recipe", "secret"], "secret"),
    (["train", "FLIGHT", "--resume", "--store", "EMPTY"], "no checkpoint"),
    (["ablate", "FLIGHT", "--widths", "8,-1"], "--widths"),
]


@pytest.mark.parametrize(("arguments", "said"), BAD, ids=[" ".join(a) for a, _ in BAD])
def test_bad_input_is_one_line_and_exit_code_2(arguments, said: str, folder, tmp_path) -> None:
    known = {"FLIGHT": folder / "unseen.mcap", "EMPTY": tmp_path / "store", ".": tmp_path}
    done = run(*(known.get(a, a) for a in arguments))
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert said in done.stderr


def test_unknown_recipe_names_the_known_ones() -> None:
    with pytest.raises(InputError, match="default, paper"):
        recipe_named("adam")
