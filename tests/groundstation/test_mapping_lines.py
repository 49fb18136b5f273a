"""A refusal that names a mapping line names one that works: pasted, it reads the flight as it was before the fault."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trueflight.groundstation.commands.app import app
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.faults import ENU_FROM_NED, about_z
from trueflight.groundstation.reading.writing import write_flight
from trueflight.models.errors import InputError, run_command_line
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse

SAMPLES = Path(__file__).parents[2] / "samples"
VECTORS = ("position", "velocity", "quaternion", "angular_velocity", "specific_force")
FRD = [1.0, -1.0, -1.0]


@pytest.fixture(scope="module")
def good() -> Flight:
    whole = read_flight(
        SAMPLES / "rotorpy" / "rotor_drag" / "identify.parquet"
    )  # an accelerometer feels drag only
    return whole.part(slice(0, 4000))


def pasted(line: str) -> list[str]:
    """The options that a refusal tells."""
    return re.findall(r"--mapping '([^']+)'", line)


def refused(path: Path) -> str:
    with pytest.raises(InputError) as refusal:
        read_flight(path)
    return str(refusal.value)


def exchanged(*names: str, order: list[int], signs: list[float]) -> Callable[[Flight], dict[str, np.ndarray]]:
    return lambda f: {n: getattr(f, n)[:, order] * signs for n in names}


def all_in_ned(f: Flight) -> dict[str, np.ndarray]:
    assert f.position is not None and f.velocity is not None and f.quaternion is not None
    assert f.angular_velocity is not None and f.specific_force is not None
    w, x, y, z = f.quaternion.T
    half = np.sqrt(0.5)
    return {
        "position": f.position @ ENU_FROM_NED.T,
        "velocity": f.velocity @ ENU_FROM_NED.T,
        "quaternion": half * np.stack([w + z, x + y, x - y, w - z], -1),
        "angular_velocity": f.angular_velocity * FRD,
        "specific_force": f.specific_force * FRD,
    }


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(lambda f: {"quaternion": f.quaternion[:, [1, 2, 3, 0]]}, id="xyzw"),
        pytest.param(lambda f: {"quaternion": f.quaternion * [1.0, -1.0, -1.0, -1.0]}, id="world to body"),
        pytest.param(
            lambda f: {"quaternion": (f.quaternion * [1.0, -1.0, -1.0, -1.0])[:, [1, 2, 3, 0]]}, id="both"
        ),
        pytest.param(lambda f: {"quaternion": f.quaternion * [1.0, 1.0, -1.0, -1.0]}, id="FRD body"),
        pytest.param(lambda f: {"velocity": rotate_inverse(f.quaternion, f.velocity)}, id="body velocity"),
        pytest.param(
            lambda f: {"velocity": rotate_inverse(f.quaternion, f.velocity) * FRD}, id="FRD body velocity"
        ),
        pytest.param(
            lambda f: {n: getattr(f, n) @ about_z(0.8).T for n in ("position", "velocity")}, id="turned"
        ),
        pytest.param(
            exchanged("angular_velocity", "specific_force", order=[1, 0, 2], signs=[1, -1, 1]), id="IMU"
        ),
        pytest.param(exchanged("velocity", order=[0, 2, 1], signs=[1, 1, -1]), id="velocity"),
        pytest.param(exchanged("specific_force", order=[2, 1, 0], signs=[1, 1, 1]), id="accelerometer"),
        pytest.param(all_in_ned, id="NED"),
        pytest.param(lambda f: {"angular_velocity": np.degrees(f.angular_velocity)}, id="deg/s"),
        pytest.param(lambda f: {"velocity": 3.6 * f.velocity}, id="km/h"),
        pytest.param(lambda f: {"specific_force": f.specific_force / 9.80665}, id="g"),
        pytest.param(lambda f: {"battery_voltage": 1e3 * f.battery_voltage}, id="mV"),
        pytest.param(lambda f: {"thrust_command": -f.thrust_command}, id="thrust down"),
    ],
)
def test_the_line_of_a_refusal_mends_the_flight(
    good: Flight, tmp_path: Path, wrong: Callable[[Flight], dict[str, np.ndarray]]
) -> None:
    path = tmp_path / "flight.parquet"
    columns = wrong(good)
    write_flight(replace(good, **columns), path)  # type: ignore[arg-type]
    lines = pasted(refused(path))
    assert lines
    mended = read_flight(path, mapping=lines)
    for name in columns:
        right, got = getattr(good, name), getattr(mended, name)
        if name == "quaternion":
            got = got * np.sign(np.sum(got * right, axis=1, keepdims=True))
        tolerance = 0.05 if name in ("position", "velocity") else 1e-3  # an angle is told to the degree
        assert np.max(np.abs(got - right)) < tolerance * max(np.max(np.abs(right)), 1.0), name


def test_a_clock_in_milliseconds_is_read_by_its_line(good: Flight, tmp_path: Path) -> None:
    path = tmp_path / "flight.parquet"
    write_flight(replace(good, t=1e3 * good.t), path)
    assert read_flight(path, mapping=pasted(refused(path))).dt == pytest.approx(good.dt)


def test_a_line_corrects_a_log_and_is_told() -> None:
    log = SAMPLES / "px4" / "sih_lemniscate.ulg"
    as_it_is, turned = read_flight(log), read_flight(log, mapping="velocity.sign = 1")
    assert np.array_equal(as_it_is.velocity, turned.velocity)
    assert "corrected by --mapping 'velocity.sign = 1'" in turned.notes
    with pytest.raises(InputError, match="velocity"):
        read_flight(log, mapping="velocity.turned = 90")


def test_lines_hold_over_the_mapping_beside_a_table() -> None:
    log = SAMPLES / "crazyflie" / "crazyswarm2_log201.csv"
    plain = read_flight(log)
    louder = read_flight(log, mapping=["thrust_command.sign = 1", 'thrust_command.unit = "1"'])
    assert not np.allclose(plain.thrust_command, louder.thrust_command)
    assert np.array_equal(plain.position, louder.position)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("velocity.turned = north", "velocity.turned = north"),
        ("velocty.turned = 20", "did you mean 'velocity'"),
        ("velocity.turn = 20", "did you mean 'turned'"),
        ("rotor_speed.sign = 1", "there is no rotor_speed to correct"),
        ('velocity.columns = ["a", "b", "c"]', "needs [time]"),
    ],
)
def test_a_line_that_cannot_be_is_one_line_and_exit_code_2(
    line: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(SAMPLES / "px4" / "sih_lemniscate.ulg")
    with pytest.raises(SystemExit) as stopped:
        run_command_line(lambda: app(["import", "--check", log, "--mapping", line], standalone_mode=False))
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and words in " ".join(said.split()) and "Traceback" not in said, said
