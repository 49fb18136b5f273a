"""Columns that contradict each other: every exchange of axes, order, direction, turn, delay and unit that logs are
known for, put into a good flight, is named, refused, told or undone; and good flights pass."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.actuation import LIFT
from trueflight.groundstation.reading.consistency import Reconciled, reconcile, refusal
from trueflight.groundstation.reading.faults import (
    ENU_FROM_NED,
    FLU_FROM_FRD,
    SIGNED,
    about_z,
    turned_about_z,
)
from trueflight.groundstation.reading.held import MEASURED
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse

SAMPLES = Path(__file__).parents[2] / "samples"
Columns = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def flight() -> Flight:
    """60 s of it."""
    whole = read_flight(SAMPLES / "rotorpy" / "nothing_hidden" / "identify.parquet")
    return whole.part(slice(0, 6000))


def columns_of(flight: Flight, *left_out: str) -> Columns:
    return {n: getattr(flight, n) for n in MEASURED if getattr(flight, n) is not None and n not in left_out}


def looked_at(flight: Flight, columns: Columns) -> Reconciled:
    assert flight.flying is not None
    return reconcile(flight.t, columns, flight.flying)


def by(axes: np.ndarray, *names: str) -> Callable[[Columns], Columns]:
    """The columns as a log would hold them whose axes are these of ours."""
    return lambda c: {**c, **{n: c[n] @ axes.T for n in names}}


def shifted(t: np.ndarray, column: np.ndarray, late: float) -> np.ndarray:
    out = np.stack([np.interp(t - late, t, one) for one in column.T], -1)
    return out / np.linalg.norm(out, axis=1, keepdims=True) if out.shape[1] == 4 else out


@pytest.mark.parametrize(
    "path",
    [p for kind in ("*.csv", "*.parquet", "*.ulg") for p in sorted(SAMPLES.rglob(kind))],
    ids=lambda p: "/".join(p.parts[-2:]),
)
def test_good_flights_are_not_refused(path: Path) -> None:
    # a hover in which the estimator's vertical acceleration has nothing of the thrust, by the log itself
    hover = path.stem == "crazypad_normal_E9_log03"
    checks = [
        c for c in read_flight(path).consistency if not (hover and c.pair == LIFT and c.verdict == "weak")
    ]
    assert all(c.verdict in ("agrees", "undone", "cannot tell") for c in checks), checks


@pytest.mark.parametrize(
    "columns", ["position velocity", "angular_velocity specific_force", "velocity", "specific_force"]
)
@pytest.mark.parametrize("imu", [True, False], ids=["with IMU", "without"])
@pytest.mark.parametrize(
    "every", [pytest.param(1, marks=pytest.mark.long, id="all"), pytest.param(7, id="some")]
)
def test_of_48_ways_to_exchange_axes_none_passes(flight: Flight, columns: str, imu: bool, every: int) -> None:
    names = columns.split()
    left_out = () if imu else ("angular_velocity", "specific_force")
    if set(names) & set(left_out):
        pytest.skip("nothing to exchange")
    good = columns_of(flight, *left_out)
    assert not refusal(looked_at(flight, good).checks)
    for axes in SIGNED[1::every]:
        told = refusal(looked_at(flight, by(axes, *names)(good)).checks)
        assert told or _unseen(names, axes, imu), f"{names} as {axes.tolist()}"


def _unseen(names: list[str], axes: np.ndarray, imu: bool) -> bool:
    """Without an accelerometer nothing tells the sign of the height; with no drag an accelerometer feels nothing
    sideways, so that nothing tells its signs there."""
    if names == ["specific_force"]:
        return bool(axes[2, 2] == 1.0)
    mirrored = np.array_equal(np.abs(axes), np.eye(3))
    return not imu and mirrored and axes[0, 0] == axes[1, 1] == 1.0


@pytest.mark.parametrize("imu", [True, False], ids=["with IMU", "without"])
@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        ("x, y, z, w", lambda q: q[:, [1, 2, 3, 0]]),
        ("world to body", lambda q: q * [1.0, -1.0, -1.0, -1.0]),
        ("x, y, z, w and world to body", lambda q: (q * [1.0, -1.0, -1.0, -1.0])[:, [1, 2, 3, 0]]),
    ],
)
def test_order_and_direction_of_the_quaternion_are_named(
    flight: Flight, words: str, wrong: Callable[[np.ndarray], np.ndarray], imu: bool
) -> None:
    good = columns_of(flight, *(() if imu else ("angular_velocity", "specific_force")))
    told = refusal(looked_at(flight, {**good, "quaternion": wrong(good["quaternion"])}).checks)
    assert words in told and "--mapping 'quaternion." in told, told


@pytest.mark.parametrize("degrees", [10, 20, 45, 90, 135, 180, -30])
@pytest.mark.parametrize("imu", [True, False], ids=["with IMU", "without"])
def test_a_turned_world_is_named_with_its_angle(flight: Flight, degrees: float, imu: bool) -> None:
    good = columns_of(flight, *(() if imu else ("angular_velocity", "specific_force")))
    seen = looked_at(flight, by(about_z(np.radians(degrees)), "position", "velocity")(good))
    (check,) = [c for c in seen.checks if c.verdict in ("weak", "contradicts")]
    assert np.degrees(abs(check.angle)) == pytest.approx(abs(degrees), abs=1.0)
    assert degrees == 180 or np.sign(check.angle) == np.sign(degrees)
    assert check.verdict == ("weak" if abs(degrees) < 15 else "contradicts")


@pytest.mark.parametrize("degrees", [20, 90, -45])
def test_a_turned_imu_is_named(flight: Flight, degrees: float) -> None:
    good = columns_of(flight)
    told = refusal(
        looked_at(flight, by(about_z(np.radians(degrees)), "angular_velocity", "specific_force")(good)).checks
    )
    assert "body's z axis" in told and f"{degrees} degrees" in told, told


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        ("deg/s", lambda c: {**c, "angular_velocity": np.degrees(c["angular_velocity"])}),
        ("in mm", lambda c: {**c, "position": 1e3 * c["position"]}),
        ("in cm/s", lambda c: {**c, "velocity": 1e2 * c["velocity"]}),
        ("km/h", lambda c: {**c, "velocity": 3.6 * c["velocity"]}),
        ("in g", lambda c: {**c, "specific_force": c["specific_force"] / 9.81}),
        (
            "velocity is in body axes",
            lambda c: {**c, "velocity": rotate_inverse(c["quaternion"], c["velocity"])},
        ),
        ("NED", by(ENU_FROM_NED, "position", "velocity")),
        ("FRD", by(FLU_FROM_FRD, "angular_velocity", "specific_force")),
    ],
)
def test_units_and_frames_are_named(flight: Flight, words: str, wrong: Callable[[Columns], Columns]) -> None:
    told = refusal(looked_at(flight, wrong(columns_of(flight))).checks)
    assert words in told, told


@pytest.mark.parametrize("late", [0.02, 0.05, 0.1, 0.2, -0.06])
@pytest.mark.parametrize("names", ["position velocity", "quaternion", "position velocity quaternion"])
def test_what_is_late_is_shifted_back(flight: Flight, late: float, names: str) -> None:
    good = columns_of(flight)
    delayed = {**good, **{n: shifted(flight.t, good[n], late) for n in names.split()}}
    seen = looked_at(flight, delayed)
    assert not refusal(seen.checks)
    undone = [c for c in seen.checks if c.verdict == "undone"]
    assert undone and all(c.late == pytest.approx(late, abs=0.005) for c in undone)
    inner = slice(100, -100)
    for name in names.split():
        right = good[name][seen.keep]
        noise = np.std(np.diff(right, axis=0))
        assert np.sqrt(np.mean((seen.columns[name] - right)[inner] ** 2)) < 2.0 * noise


@pytest.mark.parametrize("count", [2, 5, 10, 20])
@pytest.mark.parametrize("name", MEASURED)
def test_repeated_values_are_found_with_their_true_rate(flight: Flight, count: int, name: str) -> None:
    good = columns_of(flight)
    rows = np.arange(len(flight)) // count * count
    seen = looked_at(flight, {**good, name: good[name][rows]})
    assert seen.rates[name] == pytest.approx(1.0 / (flight.dt * count), rel=0.01)
    assert not refusal(seen.checks)


@pytest.mark.parametrize("size", [1.0, 8.0, 30.0])
@pytest.mark.parametrize("seconds", [0.05, 0.4])
def test_a_glitch_of_the_velocity_is_cut_out(flight: Flight, size: float, seconds: float) -> None:
    good = columns_of(flight)
    wrong = (flight.t > 40.0) & (flight.t <= 40.0 + seconds)
    seen = looked_at(flight, {**good, "velocity": good["velocity"] + wrong[:, None] * [size, 0.0, 0.0]})
    assert not np.any(seen.keep[wrong]) and np.mean(seen.keep) > 0.97
    assert any("glitch of the velocity" in note for note in seen.notes)


@pytest.mark.parametrize("degrees", [15, 60, -120])
def test_a_heading_that_jumps_is_told_and_undone(flight: Flight, degrees: float) -> None:
    good = columns_of(flight)
    after = flight.t > 50.0
    turned = np.where(
        after[:, None], turned_about_z(good["quaternion"], np.radians(degrees)), good["quaternion"]
    )
    seen = looked_at(flight, {**good, "quaternion": turned})
    assert not refusal(seen.checks)
    assert any("heading" in n and f"{abs(degrees)} degrees" in n and "50.0" in n for n in seen.notes), (
        seen.notes
    )
    same = np.abs(np.sum(seen.columns["quaternion"] * good["quaternion"][seen.keep], axis=1))
    assert np.all(same > np.cos(np.radians(3.0) / 2))


def test_columns_of_two_vehicles_are_refused(flight: Flight) -> None:
    good, other = (
        columns_of(flight),
        columns_of(read_flight(SAMPLES / "rotorpy" / "rotor_drag" / "validate.parquet")),
    )
    count = len(other["velocity"])
    mixed = {n: (other if n in ("angular_velocity", "specific_force") else good)[n][:count] for n in good}
    assert flight.flying is not None
    assert "two vehicles" in refusal(reconcile(flight.t[:count], mixed, flight.flying[:count]).checks)


def test_a_position_that_wanders_by_gps_is_told_and_not_refused(flight: Flight) -> None:
    """PX4 by GPS in a slow flight: corrections move the position by more than the vehicle moves."""
    good = columns_of(flight)
    wander = np.cumsum(np.random.default_rng(2).standard_normal((len(flight), 3)), axis=0) * 0.2
    seen = looked_at(flight, {**good, "position": good["position"] + wander})
    assert not refusal(seen.checks)
    (check,) = [c for c in seen.checks if c.verdict == "weak"]
    assert check.pair == "position and velocity" and any(check.text in note for note in seen.notes)


def test_a_hover_says_that_it_cannot_tell(flight: Flight) -> None:
    generator = np.random.default_rng(1)
    still = {n: 0.0 * c + 1e-3 * generator.standard_normal(c.shape) for n, c in columns_of(flight).items()}
    still["quaternion"] = np.tile([1.0, 0.0, 0.0, 0.0], (len(flight), 1))
    still["specific_force"] = still["specific_force"] + [0.0, 0.0, 9.81]
    assert {c.verdict for c in looked_at(flight, still).checks} == {"cannot tell"}


@pytest.mark.parametrize("degrees", [10, -30, 90, 180])
def test_an_accelerometer_turned_alone_is_told_with_its_angle(degrees: float) -> None:
    """By the drag that it feels; its flight agrees with it otherwise, for the thrust has no x and y."""
    dragged = read_flight(SAMPLES / "rotorpy" / "rotor_drag" / "identify.parquet").part(slice(0, 6000))
    good = columns_of(dragged)
    seen = looked_at(dragged, by(about_z(np.radians(degrees)), "specific_force")(good))
    (check,) = [c for c in seen.checks if c.pair == "velocity and accelerometer"]
    assert check.verdict == ("weak" if abs(degrees) < 90 else "contradicts") and "accelerometer" in check.text
    if abs(degrees) < 90:
        assert "drag and wind rest on it" in check.text
        assert np.degrees(check.angle) == pytest.approx(degrees, abs=2.0)


def test_an_accelerometer_that_feels_nothing_sideways_says_so(flight: Flight) -> None:
    """No drag is hidden in it."""
    (check,) = [
        c for c in looked_at(flight, columns_of(flight)).checks if c.pair == "velocity and accelerometer"
    ]
    assert check.verdict == "agrees" and "too little along x and y" in check.text


@pytest.mark.parametrize("late", [0.05, 0.1, 0.2])
def test_a_trajectory_later_than_its_attitude_is_shifted_back_without_an_imu(late: float) -> None:
    """And the drag, which turns the phase as well, is not taken for a delay."""
    dragged = read_flight(SAMPLES / "rotorpy" / "rotor_drag" / "identify.parquet").part(slice(0, 6000))
    good = columns_of(dragged, "angular_velocity", "specific_force")
    assert not [c for c in looked_at(dragged, good).checks if c.verdict == "undone"]
    wrong = {n: shifted(dragged.t, good[n], late) for n in ("position", "velocity")}
    (check,) = [c for c in looked_at(dragged, {**good, **wrong}).checks if c.verdict == "undone"]
    assert check.late == pytest.approx(late, abs=0.01)


@pytest.mark.parametrize("drag", [0.0, 0.4])
@pytest.mark.parametrize("pace", [0.7, 1.5])
def test_drag_in_a_circle_is_not_taken_for_a_turn(drag: float, pace: float) -> None:
    """It stands at right angles to what the velocity gains, as a turn of the frame would have it."""
    t = np.arange(0.0, 40.0, 0.01)
    angle, generator = pace * t, np.random.default_rng(3)
    velocity = 3.0 * pace * np.stack([-np.sin(angle), np.cos(angle), 0.0 * t], -1)
    gained = -3.0 * pace**2 * np.stack([np.cos(angle), np.sin(angle), 0.0 * t], -1)
    thrust = gained + drag * velocity + [0.0, 0.0, 9.81]
    up = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    quaternion = np.stack([1.0 + up[:, 2], -up[:, 1], up[:, 0], 0.0 * t], -1)
    columns = {
        "velocity": velocity + 0.02 * generator.standard_normal(velocity.shape),
        "quaternion": quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
    }
    checks = reconcile(t, columns, np.ones(len(t), dtype=bool)).checks
    assert not refusal(checks) and all(c.verdict in ("agrees", "cannot tell") for c in checks), checks


def test_an_axis_that_hardly_moves_is_looked_at_by_itself(flight: Flight) -> None:
    """Beside what x and y move, z is next to nothing; mirrored it is told, and where it stands still that is said."""
    good = columns_of(flight, "specific_force", "quaternion", "angular_velocity")
    low = {n: c * [1.0, 1.0, 0.05] for n, c in good.items()}
    (check,) = looked_at(flight, low).checks
    assert check.verdict == "agrees" and not check.text
    (check,) = looked_at(flight, by(np.diag([1.0, 1.0, -1.0]), "position")(low)).checks
    assert check.verdict in ("weak", "contradicts") and "x, y, -z" in check.text
    (check,) = looked_at(flight, {n: c * [1.0, 1.0, 0.0] for n, c in good.items()}).checks
    assert check.verdict == "agrees" and "which way z of the position" in check.text
