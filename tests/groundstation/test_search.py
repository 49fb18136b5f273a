"""The search for missing effects on the plainest of problems: a sum of columns and correlated noise."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from trueflight.groundstation.identify.fitting import Fit, FreeParameter, critical_value, robust_covariance
from trueflight.groundstation.identify.order import answers
from trueflight.groundstation.identify.search import Choice, Search, State, sizes, whole
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.identify.verdicts import Scale, judge
from trueflight.groundstation.reading import read_flight
from trueflight.models.effect import Effect, Parameter, Stage
from trueflight.models.model import rigid_body_model

T = np.arange(0.0, 60.0, 0.04)


@dataclass(frozen=True)
class Samples:
    t: np.ndarray = field(default_factory=lambda: T)
    used: np.ndarray = field(default_factory=lambda: np.ones(len(T), dtype=bool))


@dataclass(frozen=True)
class Columns:
    """Each effect adds a column times its one parameter; all are candidates."""

    measured: np.ndarray
    columns: dict[str, np.ndarray]
    through: dict[str, tuple[str, ...]] = field(default_factory=dict)
    included: tuple[str, ...] = ()
    settled: tuple[Choice, ...] = ()
    measurements: tuple[Samples, ...] = (Samples(),)

    @cached_property
    def effects(self) -> dict[str, Effect]:
        size = (Parameter("size", "1", "of the column", 0.0, 1.0, -9.0, 9.0),)
        return {
            n: Effect(
                n,
                n,
                Stage.FORCE,
                lambda m, size: m,
                size,
                (),
                "a flight",
                "none",
                acts_through=self.through.get(n, ()),
            )
            for n in self.columns
        }

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        return tuple(whole(e) for e in self.effects.values())

    @cached_property
    def blocks(self) -> np.ndarray:
        return (T / 5.0).astype(int)

    def unit(self) -> float:
        return 1.0

    def fit(self, choices: tuple[Choice, ...], near: Fit | None) -> Fit:
        free = tuple(
            FreeParameter(c.effect, sizes(self.effects[c.effect])[0], 0.0, -9.0, 9.0, 0.0, flat=True)
            for c in choices
        )
        matrix = np.column_stack([np.zeros((len(T), 0)), *(self.columns[c.effect] for c in choices)])
        x = np.linalg.lstsq(matrix, self.measured, rcond=None)[0] if choices else np.zeros(0)
        residual = (self.measured - matrix @ x)[:, None]
        jacobian = -matrix[:, None, :]
        covariance, _ = robust_covariance(self, jacobian, residual, np.zeros(len(free)))
        return Fit((), free, x, covariance, critical_value(60.0), jacobian, residual)

    def contribution(self, here: Fit, choice: Choice, through: str | None = None) -> np.ndarray:
        return self.columns[choice.effect][:, None]

    def linearised_gain(self, here: Fit, step: tuple[Choice, ...]) -> float:
        matrix = np.column_stack([here.jacobian[:, 0], *(self.columns[c.effect] for c in step)])
        residual = here.residual.ravel()
        return float(residual @ matrix @ np.linalg.lstsq(matrix, residual, rcond=None)[0])

    def adequate(self, here: Fit) -> bool:
        return False

    def scale_of_thrust(self, here: Fit) -> None:
        return None

    def beside(self, here: Fit, choice: Choice) -> Fit | None:
        return None

    def matters(self, with_: State, without: State, step: tuple[Choice, ...]) -> bool:
        return True

    def visible(self, energy: float) -> bool:
        return True

    def held_out_error(self, fitted: Fit) -> float | None:
        return None


def noise(seed: int, colour: float = 0.9) -> np.ndarray:
    return signal.lfilter([0.2], [1.0, -colour], np.random.default_rng(seed).normal(size=len(T)))


def verdicts(problem: Columns) -> dict[str, str]:
    search = Search(problem)
    found = search.select()
    named, absent = judge(search, found, found.fit, Scale(search.state(()).fit.sse, lambda share: ""))
    return {v.name: v.verdict for v in (*named, *absent)}


A, B = np.sin(0.7 * T), np.sign(np.sin(1.9 * T))


@pytest.mark.parametrize("seed", range(5))
def test_columns_that_are_there_are_missing_and_no_other(seed: int) -> None:
    columns = {"a": A, "b": B, "c": noise(100 + seed), "d": noise(200 + seed)}
    found = verdicts(Columns(1.0 * A - 0.7 * B + noise(seed), columns))
    assert (found["a"], found["b"]) == ("missing", "missing")
    assert "missing" not in (found["c"], found["d"])


def test_what_entered_first_gives_way_to_what_explains_more() -> None:
    # a mixture of both, with errors of its own, is the best single column
    mixture = A + B + 2.0 * noise(7, 0.0)
    problem = Columns(A + B + noise(1), {"mixture": mixture, "a": A, "b": B})
    search = Search(problem)
    first = search.state((whole(problem.effects["mixture"]),))
    assert first.fit.sse == min(search.state((c,)).fit.sse for c in problem.choices)
    assert set(search.select().names) == {"a", "b"}


def test_twins_stand_in_for_one_another() -> None:
    found = verdicts(Columns(A + noise(3), {"a": A, "twin": A + 1e-3 * B, "b": B}))
    assert found == {"a": "possible", "twin": "possible", "b": "not_supported"}


def test_what_acts_through_another_comes_with_it_or_not_at_all() -> None:
    problem = Columns(A + B + noise(4), {"drag": A, "wind": B}, {"wind": ("drag",)})
    assert set(Search(problem).select().names) == {"drag", "wind"}
    alone = Columns(B + noise(4), {"drag": A, "wind": B}, {"wind": ("drag",)})
    assert "wind" not in Search(alone).select().names


def test_a_column_that_hardly_moves_is_not_excited() -> None:
    assert verdicts(Columns(A + noise(5), {"a": A, "still": 1e-3 * B}))["still"] == "not_excited"


def test_a_long_flight_is_asked_for_its_order_by_the_samples_that_were_fitted(monkeypatch) -> None:
    # the search sees parts of a long flight, the figures are of all of it
    monkeypatch.setattr("trueflight.groundstation.identify.translation.LONG", 40.0)
    monkeypatch.setattr("trueflight.groundstation.identify.translation.PART", 10.0)
    asked = []

    def looked(problem, figures, effect):
        asked.append((sum(int(m.used.sum()) for m in problem.measurements), len(figures.residual)))
        return answers(problem, figures, effect)

    monkeypatch.setattr("trueflight.groundstation.identify.verdicts.answers", looked)
    flight = read_flight(Path("samples/rotorpy/rotor_drag/identify.parquet"))
    found = diagnose(flight.part(slice(0, 4500)), rigid_body_model(flight.vehicle, None))
    assert [e.name for e in found.effects if e.verdict == "missing"] == ["rotor_drag"]
    assert asked and all(rows == fitted for rows, fitted in asked)
