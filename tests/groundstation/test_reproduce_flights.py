"""What the paper's experiment asks the simulator to fly, as one table."""

from pathlib import Path

from simulated import VEHICLE

from trueflight.groundstation.study.batch import table_text
from trueflight.groundstation.study.reproduce import (
    ANATOMY,
    ARMS,
    BOTH,
    MODELS,
    SCENARIOS,
    Prepared,
    flight_rows,
)
from trueflight.sim_bridge.many.variations import Row, rows_of


def test_every_flight_of_the_experiment_is_a_row(tmp_path: Path) -> None:
    files = {name: tmp_path / f"{name}.onnx" for name in (*MODELS, f"{BOTH} at once")}
    tasks = [(scenario, arm) for scenario in SCENARIOS for arm in (*ARMS, *ANATOMY[:2])]
    (tmp_path / "flights.csv").write_text(
        table_text(flight_rows(Prepared(3, files, ()), ["--hidden", "rich"], tasks))
    )
    rows = rows_of(tmp_path / "flights.csv", Row(vehicle=str(VEHICLE), seed=3, settle=4.0))
    assert len({row.name for row in rows}) == len(rows) == 42
    named = {row.name: row for row in rows}
    assert (named["old-lqr"].battery_age, named["half-lqr"].charge) == (1.5, 0.5)
    assert named["wind-network"].hidden == ("rich", "wind:3")
    assert named["wind-network"].model == str(files["network"])
    assert named["unseen-at-once-no-trim"].model == str(files[f"{BOTH} at once"])
    assert (named["unseen-at-once-no-trim"].trim, named["unseen-effects"].trim) == (0.0, Row().trim)
    assert named["unseen-lqr"].set == ("speed=3", "seed=103")
    assert all((row.seed, row.settle) == (3, 4.0) for row in rows)
