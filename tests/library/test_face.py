"""`import trueflight as tf`: light until asked, typed, and the same answers as the commands."""

import inspect
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import trueflight as tf
from trueflight.groundstation import library
from trueflight.groundstation.commands.app import app

ROOT = Path(__file__).parents[2]
DRAG = ROOT / "samples" / "rotorpy" / "rotor_drag"
HEAVY = {"torch", "scipy", "numpy", "control", "rerun", "pyarrow", "matplotlib", "pandas", "statsmodels"}


def python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return done.stdout.strip()


def printed(*words: object) -> str:
    """What a command prints, in this process."""
    from typer.testing import CliRunner

    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def flight() -> tf.Flight:
    """The first 30 s of a simulated flight with rotor drag that its owner does not know of."""
    return tf.read(DRAG / "identify.parquet").part(slice(0, 3000))


@pytest.fixture(scope="module")
def diagnosis(flight: tf.Flight, tmp_path_factory: pytest.TempPathFactory) -> tf.Diagnosis:
    held_out = tf.read(DRAG / "validate.parquet").part(slice(0, 2000))
    return tf.diagnose(flight, validate=held_out, store=tmp_path_factory.mktemp("store"))


def test_importing_it_loads_nothing_heavy() -> None:
    assert python(f"import sys, trueflight; print(sorted({HEAVY!r} & set(sys.modules)))") == "[]"
    assert (
        python("import sys, trueflight; print([m for m in sys.modules if m.startswith('trueflight.')])")
        == "[]"
    )


def test_asking_for_a_function_loads_no_learning_library() -> None:
    heavy = {"torch", "matplotlib", "rerun"}
    code = f"import sys, trueflight as tf; tf.read, tf.train; print(sorted({heavy!r} & set(sys.modules)))"
    assert python(code) == "[]"


@pytest.mark.parametrize("module", ["companion.cli", "companion.flight", "sim_bridge.cli"])
def test_the_vehicle_never_loads_the_face(module: str) -> None:
    assert (
        python(f"import sys, trueflight.{module}; print('trueflight.groundstation' in sys.modules)")
        == "False"
    )


def test_its_names_are_those_of_the_library_and_dir_lists_them() -> None:
    assert tf.__all__ == library.__all__ == sorted(library.__all__)
    assert set(tf.__all__) <= set(dir(tf))
    assert all(getattr(tf, name) is getattr(library, name) for name in tf.__all__)
    with pytest.raises(AttributeError, match="no attribute 'diagnos'"):
        tf.diagnos  # noqa: B018


def test_arguments_have_one_order() -> None:
    """What several functions take has one name and one place among the arguments."""
    order = ["flight", "flights", "effect", "output", "vehicle", "model", "models", "validate", "design", "bandwidth",
             "attitude_bandwidth", "rate", "store", "effects"]  # fmt: skip
    for name in library.__all__:
        if inspect.isfunction(function := getattr(library, name)):
            taken = [p for p in inspect.signature(function).parameters if p in order]
            assert taken == sorted(taken, key=order.index), name


def test_reading_gives_columns_and_a_table(flight: tf.Flight) -> None:
    assert repr(flight).startswith("<Flight identify: ")
    assert "30.0 s at 100 Hz, 3000 samples; position, velocity, quaternion" in repr(flight)
    table = flight.to_pandas()
    assert table.index.name == "t" and len(table) == 3000
    np.testing.assert_allclose(table["velocity_x"], flight.column("velocity")[:, 0], atol=1e-8)
    assert "specific_force" in str(flight.summary()) and "<pre" in flight._repr_html_()


def test_a_flight_written_and_read_again_is_the_same(flight: tf.Flight, tmp_path: Path) -> None:
    again = tf.read(flight.write(tmp_path / "again.parquet"))
    np.testing.assert_allclose(again.column("velocity"), flight.column("velocity"), atol=1e-8)


def test_without_pandas_it_says_what_to_install(flight: tf.Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(tf.InputError, match=r"pip install 'trueflight\[notebook\]'"):
        flight.to_pandas()


def test_a_diagnosis_answers(diagnosis: tf.Diagnosis) -> None:
    assert diagnosis.missing == ("rotor_drag",)
    low, high = diagnosis.interval("rotor_drag")["x"]
    assert low < 0.2 < high, "the drag that was hidden"
    assert diagnosis.conf_int()["rotor_drag.x"] == (low, high)
    assert low < diagnosis.params["rotor_drag.x"] < high
    assert diagnosis.pvalues["rotor_drag"] < 0.01
    assert diagnosis.effect("ground_effect").verdict in ("not_supported", "not_excited")
    assert "ground_effect" in {*diagnosis.not_supported, *diagnosis.not_excited}
    with pytest.raises(tf.InputError, match="moon_gravity: no effect that was judged"):
        diagnosis.interval("moon_gravity")
    assert repr(diagnosis).startswith("<Diagnosis of identify: missing rotor_drag; residual ")
    assert "MISSING" in str(diagnosis.summary()) and "MISSING" in diagnosis._repr_html_()
    frame = diagnosis.to_pandas()
    assert frame.loc[("rotor_drag", "x"), "low"] == low
    assert diagnosis.model.params.keys() == {"rotor_drag.x", "rotor_drag.y"}


def test_its_answers_are_those_of_the_command(flight: tf.Flight, tmp_path: Path) -> None:
    """The same flight through `groundstation diagnose --json`, and through the library."""
    path = flight.part(slice(0, 2000)).write(tmp_path / "short.parquet")
    told = json.loads(printed("diagnose", path, "--store", tmp_path, "--json"))
    found = tf.diagnose(tf.read(path), store=tmp_path)
    answered = json.loads(json.dumps(found.to_dict()))
    made = {"schema", "recording", "provenance"}  # of the command, and of the time
    assert {k: v for k, v in answered.items() if k not in made} == {
        k: v for k, v in told.items() if k not in made
    }
    assert found.to_dict()["residual_rms"]["before"] == pytest.approx(
        tf.compare(found.flight, store=tmp_path).rms, rel=0.02
    )


@pytest.mark.parametrize("chart", ["waterfall", "prediction", "over_time", "maps", "path", "place"])
def test_a_diagnosis_is_drawn(diagnosis: tf.Diagnosis, chart: str, tmp_path: Path) -> None:
    drawn = diagnosis.plot(chart)
    drawn.savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5000
    assert drawn._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    from matplotlib.colors import to_hex

    colours = {to_hex(line.get_color()) for ax in drawn.axes for line in ax.get_lines()}
    assert not any(colour.startswith("#000") for colour in colours), "the stand-ins of the page's stylesheet"


def test_an_unknown_chart_is_told(diagnosis: tf.Diagnosis) -> None:
    with pytest.raises(tf.InputError, match=r"no chart 'pie'; there are: waterfall, "):
        diagnosis.plot("pie")


def test_comparisons_and_where(flight: tf.Flight, tmp_path: Path) -> None:
    c = tf.compare(flight, model="linear", store=tmp_path)
    assert c.rms > tf.compare(flight, store=tmp_path).rms > c.noise_floor
    assert len(c.to_pandas()) == len(flight)
    for chart in ("prediction", "over_time", "path"):
        c.plot(chart)
    assert "…" not in printed("compare", DRAG / "identify.parquet"), "all numbers on 80 columns"
    where = tf.where(flight, store=tmp_path)
    assert {m.variable for m in where.maps} >= {"height", "tilt"}
    assert "Where it fails" in str(where.summary())
    for chart in ("maps", "place"):
        where.plot(chart)
    both = tf.side_by_side([flight], models=["linear", None], store=tmp_path)
    assert both.change[1] < 0.0
    for chart in ("maps", "over_time"):
        both.plot(chart)


def test_models_are_added_saved_and_chosen(flight: tf.Flight, tmp_path: Path) -> None:
    model = tf.add(flight, "rotor_drag", store=tmp_path)
    assert model.version == 0 and "not saved" in str(model.summary())
    assert model.conf_int()["rotor_drag.x"][0] < model.params["rotor_drag.x"]
    saved = model.save(tmp_path)
    assert saved.version == 1 and isinstance(saved, tf.Model)
    newest = tf.compare(flight, store=tmp_path)
    assert newest.label == saved.label
    assert newest.rms == pytest.approx(tf.compare(flight, model=model).rms, rel=1e-9)
    with pytest.raises(tf.InputError, match=r"rotor_drag is in v1 \+ rotor_drag already"):
        tf.add(flight, "rotor_drag", store=tmp_path)


def test_errors_are_those_of_the_commands(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    missing = tmp_path / "nothing.csv"
    with pytest.raises(tf.InputError) as told:
        tf.read(missing)
    done = CliRunner().invoke(app, ["compare", str(missing)])
    assert str(done.exception) == str(told.value)
    assert "\n" not in str(told.value)
    with pytest.raises(tf.InputError, match="carries no design"):
        tf.track(tf.read(DRAG / "validate.parquet"))


def test_a_flight_is_simulated_tracked_and_revealed(tmp_path: Path) -> None:
    flown = tf.simulate(
        tmp_path / "a.mcap", trajectory="lemniscate", parameters={"speed": 2.0}, hidden="random", seed=3
    )
    (hidden,) = tf.reveal(flown)
    assert hidden in tf.effects()
    t = tf.track(flown)
    assert t.rms > 0.0 and repr(t).startswith("<Tracking of a: MSE x ")
    assert "mean squared error" in str(t.summary()) and t.plot() is not None
    tube = tf.bound(flown)
    assert tube.inside.min() > 0.9 and "tube around the design" in str(tube.summary())
    with pytest.raises(tf.InputError, match=r"sim-bridge fly failed: .*did you mean 'rotor_drag'"):
        tf.simulate(tmp_path / "b.mcap", hidden="rotor_drg")


def test_many_flights_are_simulated_and_read_one_by_one(tmp_path: Path) -> None:
    hover: dict[str, object] = {
        "trajectory": "hover",
        "set": ["duration=3"],
        "hidden": ["rotor_drag:0.3", "wind:2"],
    }
    flights = tf.simulate_many(tmp_path, [{**hover, "name": f"no-{i}", "seed": i} for i in range(3)], jobs=1)
    first, *others = list(flights)
    assert [Path(one.origin).stem for one in (first, *others)] == ["no-0", "no-1", "no-2"]
    assert first.position is not None and len(others[1]) == len(first) > 100
    with pytest.raises(tf.InputError, match=r"sim-bridge fly-many failed: .*column 'sed' is no option"):
        tf.simulate_many(tmp_path, [{"sed": 1}])


def test_gains_are_designed() -> None:
    from trueflight.models.shipped import QUAD5

    gains = tf.design(QUAD5, bandwidth=0.4)
    assert gains.integral is not None and gains.K_eta[0][1] != 0.0


def test_the_page_is_written(diagnosis: tf.Diagnosis, tmp_path: Path) -> None:
    page = diagnosis.report(tmp_path / "report.html")
    assert "rotor_drag" in page.read_text(encoding="utf-8")


SCRIPT = """
import trueflight as tf

flight: tf.Flight = tf.read("log.ulg", vehicle="vehicle.toml")
found: tf.Diagnosis = tf.diagnose(flight, validate=tf.read("other.ulg"))
names: tuple[str, ...] = found.missing
low, high = found.interval("rotor_drag")["x"]
width: float = high - low
model: tf.Model = tf.add(flight, names[0])
saved: int = model.save("store").version
rms: float = tf.compare(flight, model=model).rms
found.plot("maps").savefig("maps.png")
rows: int = len(flight.to_pandas())
error: float = tf.track(flight, design=tf.design(flight.vehicle)).mse[0]
tf.export(flight, "correction.onnx", model=tf.train([flight]).model)
tf.simulate("a.mcap", hidden=["rotor_drag:0.3"])
"""


@pytest.mark.long  # mypy reads all of the package anew
def test_a_users_script_type_checks_strictly_and_a_wrong_one_does_not(tmp_path: Path) -> None:
    (tmp_path / "right.py").write_text(SCRIPT)
    (tmp_path / "wrong.py").write_text(SCRIPT + "\nrms = found.missing\ntf.compare('log.ulg')\n")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--follow-imports=silent",
        "--cache-dir",
        str(ROOT / ".mypy_cache" / "strict"),
    ]
    done = subprocess.run(
        [*command, "right.py", "wrong.py"], capture_output=True, text=True, cwd=tmp_path, env=_environment()
    )
    # what mypy says of stubs that are not installed is not of the script
    told = [
        line
        for line in done.stdout.splitlines()
        if line.startswith(("right.py", "wrong.py")) and ": error:" in line
    ]
    assert [line.split(":")[0] for line in told] == ["wrong.py", "wrong.py"], done.stdout
    assert "[assignment]" in told[0] and "[arg-type]" in told[1]


def _environment() -> dict[str, str]:
    import os

    return {**os.environ, "MYPYPATH": str(ROOT)}
