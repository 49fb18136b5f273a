"""A log without a velocity: it is taken from the position, whose noise is no motion."""

from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet, table

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.uniform import slopes, trend

DRAG = Path(__file__).parents[2] / "samples" / "rotorpy" / "rotor_drag"


def test_a_trend_keeps_the_motion_and_leaves_the_noise() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    position = np.stack([np.sin(2 * np.pi * 0.4 * t), 0.3 * t**2, 0.0 * t], axis=1)
    moving = np.stack([2 * np.pi * 0.4 * np.cos(2 * np.pi * 0.4 * t), 0.6 * t, 0.0 * t], axis=1)
    np.testing.assert_allclose(trend(t, position, 0.1)[10:-10], moving[10:-10], atol=0.025)
    noise = np.random.default_rng(0).normal(0.0, 0.01, position.shape)
    assert slopes(t, noise).std() > 0.6
    # the variance of a line's slope through 21 points
    assert trend(t, noise, 0.1).std() == pytest.approx(
        0.01 / 0.01 / np.sqrt(2 * sum(k**2 for k in range(11))), rel=0.1
    )


def test_a_noisy_position_beside_a_vibrating_accelerometer_is_no_contradiction(tmp_path: Path) -> None:
    columns = parquet.read_table(DRAG / "identify.parquet").to_pydict()
    columns = {n: np.array(c) for n, c in columns.items() if not n.startswith("velocity")}
    rng = np.random.default_rng(3)
    t = columns["t"]
    for axis in "xyz":
        columns[f"position_{axis}"] = columns[f"position_{axis}"] + rng.normal(0.0, 0.01, len(t))
        name = f"specific_force_{axis}"
        columns[name] = columns[name] + 1.5 * np.sin(2 * np.pi * 14.0 * t + rng.uniform(0.0, 6.0))
    path = tmp_path / "identify.parquet"
    parquet.write_table(table(columns), path)
    flight = read_flight(path, DRAG / "vehicle.toml")
    truth = read_flight(DRAG / "identify.parquet")
    assert "no velocity in the log: differentiated from the position" in flight.notes
    error = np.interp(truth.t, flight.t, flight.velocity[:, 0]) - truth.velocity[:, 0]
    assert np.std(error[50:-50]) < 0.15
