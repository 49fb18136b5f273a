"""What the library's questions return: the result objects of the ground station, and the answers they give.

Every result has `summary()`, what the command of the same name prints; `to_dict()`, what that command prints with
`--json`; and, where the report has a chart of it, `plot(chart)`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trueflight.groundstation import results
from trueflight.groundstation.evaluate import bound, side_by_side, tracking
from trueflight.groundstation.library.models import Model
from trueflight.groundstation.library.shown import Summary, answering, data_frame, picture, summary_of
from trueflight.models.design import Design
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from trueflight.groundstation.evaluate.analysis import Analysis


@dataclass(frozen=True, repr=False)
class WhereItFails(results.WhereItFails):
    """Where the residual of a comparison sits: `maps` over height, speed, tilt, thrust, voltage and time, the `regions`
    that hold more than their share of the squared error, the `worst` moments (s, m/s²), and the `place` over the
    ground.
    """

    comparison: results.Comparison | None = None

    def summary(self) -> Summary:
        """The regions that hold the error, and the worst moments, as `groundstation where` prints them."""
        from trueflight.groundstation.output.tables import print_where

        return summary_of(lambda console: print_where(console, self))

    def to_dict(self) -> dict[str, Any]:
        """What `groundstation where --json` prints of it: errors in m/s², shares from 0 to 1."""
        from trueflight.groundstation.output.as_json import where_table

        return where_table(self)

    def plot(self, chart: str = "maps") -> Figure:
        """A chart of the report: "maps" (residual RMS in m/s² over each variable) or "place" (over the ground, m).

        Raises `InputError` for another `chart`, and for "place" where the flight has no position.
        """
        from trueflight.groundstation.report import charts

        table, c = self.to_dict(), self.comparison
        assert c is not None
        names = c.label, c.label
        return picture(
            {
                "maps": lambda colours: charts.maps(table, table, names, colours),
                "place": lambda colours: charts.place(c, table, colours),
            },
            chart,
        )

    def __repr__(self) -> str:
        told = self.regions[0].text if self.regions else "evenly"
        return f"<WhereItFails: {told}; {len(self.maps)} maps, {len(self.worst)} worst moments>"

    def _repr_html_(self) -> str:
        return self.summary().html


@dataclass(frozen=True, repr=False)
class Comparison(results.Comparison):
    """One model against one flight of N samples, heading frame: `measured`, `predicted` and `residual` (N, 3) are
    accelerations in m/s² after the same low-pass of `bandwidth` Hz; `used` (N,) marks the samples that count.

    `rms` and `noise_floor` are over all axes, m/s²; `label` names the model, `axes` has the errors one by one,
    `horizons` the open-loop errors (m, m/s).
    """

    def summary(self) -> Summary:
        """Residual and share explained per axis, and open-loop error, as `groundstation compare` prints them."""
        from trueflight.groundstation.output.tables import print_comparisons

        return summary_of(lambda console: print_comparisons(console, [self]))

    def to_dict(self) -> dict[str, Any]:
        """What `groundstation compare --json` prints of one model, in m/s² and m, without the time series."""
        from trueflight.groundstation.output.as_json import comparison_table

        return comparison_table(self)

    def to_pandas(self) -> pd.DataFrame:
        """Measured, predicted and residual acceleration (m/s², heading frame) and `used` as a pandas table of N rows,
        indexed by `t` (s).

        Raises `InputError` where pandas is not installed.
        """
        columns: dict[str, Any] = {"t": self.flight.t}
        for name in ("measured", "predicted", "residual"):
            columns |= {f"{name}_{axis}": getattr(self, name)[:, k] for k, axis in enumerate("xyz")}
        return data_frame({**columns, "used": self.used}, index="t")

    @cached_property
    def where(self) -> WhereItFails:
        """Where in the flight this residual sits."""
        from trueflight.groundstation.evaluate.where import where_it_fails

        return answering(WhereItFails, where_it_fails(self), comparison=self)

    def plot(self, chart: str = "prediction") -> Figure:
        """A chart of the report: "prediction" (measured and predicted acceleration in m/s² around the worst moment),
        "over_time" (residual RMS in m/s² along the flight) or "path" (the path in m, coloured by the residual).

        Raises `InputError` for another `chart`, and for "path" where the flight has no position.
        """
        from trueflight.groundstation.report import charts

        worst = self.where.worst
        return picture(
            {
                "prediction": lambda colours: charts.prediction(self, self, worst, colours),
                "over_time": lambda colours: charts.over_time(self, self, worst, colours),
                "path": lambda colours: charts.path(self, worst, colours),
            },
            chart,
        )

    def __repr__(self) -> str:
        return (
            f"<Comparison of {self.flight.name} with {self.label}: residual {self.rms:.3f} m/s², "
            f"noise floor {self.noise_floor:.3f} m/s²>"
        )

    def _repr_html_(self) -> str:
        return self.summary().html


@dataclass(frozen=True, repr=False)
class SideBySide(side_by_side.SideBySide):
    """Several flights with one model, or several models on one flight: `comparisons` named by `names`, `where` each
    fails, over the same bins, and the `change` of the RMS against the first (a share: 0.1 is 10 % more).
    """

    def summary(self) -> Summary:
        """One row a flight or model, as `groundstation compare` prints several."""
        from trueflight.groundstation.output.tables import print_side_by_side

        return summary_of(lambda console: print_side_by_side(console, self))

    def to_dict(self) -> dict[str, Any]:
        """What `groundstation compare --json` prints of several, errors in m/s²."""
        from trueflight.groundstation.output.as_json import side_by_side_table

        return side_by_side_table(self)

    def plot(self, chart: str = "maps") -> Figure:
        """A chart of the report: "maps" (residual RMS in m/s² over the same bins) or "over_time" (along the flights).

        Raises `InputError` for another `chart`.
        """
        from trueflight.groundstation.report import charts

        return picture(
            {
                "maps": lambda colours: charts.beside_maps(self.to_dict(), colours),
                "over_time": lambda colours: charts.beside_over_time(self, colours),
            },
            chart,
        )

    def __repr__(self) -> str:
        pairs = zip(self.names, self.comparisons, strict=True)
        return f"<SideBySide: {'; '.join(f'{name} {c.rms:.3f} m/s²' for name, c in pairs)}>"

    def _repr_html_(self) -> str:
        return self.summary().html


@dataclass(frozen=True, repr=False)
class Diagnosis(results.Diagnosis):
    """Which effects `base` lacks on a flight: `effects` with verdict, parameters and 95 % intervals, ranked.

    `model` is `base` with every effect found. `rms_before`, `rms_after` and `noise_floor` are over all axes in m/s²,
    after a low-pass of `bandwidth` Hz; `validation_before` and `validation_after` the same on the flight held out
    (`held_out`). `line` holds the models that led to `base`, `asked_bandwidth` is the bandwidth that was asked for,
    Hz (None: chosen from the flight).
    """

    held_out: Flight | None = None
    line: tuple[results.Model, ...] = ()
    asked_bandwidth: float | None = None
    _gathered: dict[str, Analysis] = field(default_factory=dict)

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the effects to add, the most important first."""
        return self.named("missing")

    @property
    def possible(self) -> tuple[str, ...]:
        """Names of the effects that these data cannot tell from others."""
        return self.named("possible")

    @property
    def not_supported(self) -> tuple[str, ...]:
        """Names of the effects that this flight would have shown, and did not."""
        return self.named("not_supported")

    @property
    def not_excited(self) -> tuple[str, ...]:
        """Names of the effects that this flight could not have shown."""
        return self.named("not_excited")

    @property
    def params(self) -> dict[str, float]:
        """Values of what is missing or possible, by `effect.parameter`, in the units that `effects()` tells; those of
        one of several flights by `effect.parameter@flight`."""
        return {_key(e, p): p.value for e in self._found() for p in e.parameters}

    @property
    def pvalues(self) -> dict[str, float]:
        """The p-value of every effect that was judged: how probable an improvement as large would be without the
        effect. It allows for correlated residuals."""
        return {e.name: e.p_value for e in self.effects}

    def conf_int(self) -> dict[str, tuple[float, float]]:
        """95 % intervals (low, high) of what is missing or possible, named as in `params`."""
        return {_key(e, p): (p.low, p.high) for e in self._found() for p in e.parameters}

    def effect(self, name: str) -> results.EffectVerdict:
        """What the flight says of the effect `name`. Raises `InputError` where it was not judged."""
        found = next((e for e in self.effects if e.name == name), None)
        if found is None:
            raise InputError(
                f"{name}: no effect that was judged; there are: {', '.join(sorted(e.name for e in self.effects))}"
            )
        return found

    def interval(self, effect: str) -> dict[str, tuple[float, float]]:
        """95 % interval (low, high) of each parameter of an `effect`, found or not, in the parameter's unit; of several
        flights, those of one flight by `parameter@flight`.

        Raises `InputError` where it was not judged.
        """
        return {_own(p): (p.low, p.high) for p in self.effect(effect).parameters}

    def to_pandas(self) -> pd.DataFrame:
        """One row for each parameter of each effect: verdict, share of the error (0 to 1), p-value, value, low, high,
        unit and flight (where it is one's own), indexed by effect and parameter.

        Raises `InputError` where pandas is not installed.
        """
        names = (
            "effect",
            "parameter",
            "verdict",
            "share",
            "p_value",
            "value",
            "low",
            "high",
            "unit",
            "flight",
        )
        rows = [
            (e.name, p.name, e.verdict, e.variance_share, e.p_value, p.value, p.low, p.high, p.unit, p.flight)
            for e in self.effects
            for p in e.parameters
        ]
        return data_frame({name: [row[k] for row in rows] for k, name in enumerate(names)}, index=names[:2])

    def to_dict(self) -> dict[str, Any]:
        """The diagnosis and its `analysis`, as `groundstation diagnose --json` prints them, in the units named there.
        The design is that of the flight's record, where it carries one."""
        from trueflight.groundstation.output.as_json import analysis_table
        from trueflight.groundstation.versions.choice import choose_design

        return analysis_table(self.analysis(choose_design(self.flight)))

    def summary(self, everything: bool = False) -> Summary:
        """Verdicts and residuals as `groundstation diagnose` prints them; with `everything` the parameters of effects
        that were not found, too."""
        from trueflight.groundstation.output.ranking import print_diagnosis

        return summary_of(lambda console: print_diagnosis(console, self, everything))

    def analysis(self, design: Design | None = None) -> Analysis:
        """All that the report shows beside the verdicts: a comparison for each effect found, where they fail, the
        waterfall and, where the flight has references and a `design`, the tracking. Made once."""
        from trueflight.groundstation.evaluate.analysis import gather

        key = "" if design is None else str(design)
        if key not in self._gathered:
            self._gathered[key] = gather(
                self, self.line or (self.base,), self.held_out, self.asked_bandwidth, design
            )
        return self._gathered[key]

    def plot(self, chart: str = "waterfall") -> Figure:
        """A chart of the report: "waterfall" (residual RMS in m/s² as effects are added), "prediction", "over_time",
        "maps" (the model before and after, in m/s²), "path" or "place" (over the ground, m).

        Raises `InputError` for another `chart`, and for those over the ground where the flight has no position.
        """
        from trueflight.groundstation.output.as_json import waterfall_table, where_table
        from trueflight.groundstation.report import charts

        a = self.analysis()
        before, worst = where_table(a.where), a.where.worst
        names = a.before.label, a.after.label
        return picture(
            {
                "waterfall": lambda colours: charts.waterfall(waterfall_table(a.waterfall), colours),
                "prediction": lambda colours: charts.prediction(a.before, a.after, worst, colours),
                "over_time": lambda colours: charts.over_time(a.before, a.after, worst, colours),
                "maps": lambda colours: charts.maps(before, where_table(a.where_left), names, colours),
                "path": lambda colours: charts.path(a.before, worst, colours),
                "place": lambda colours: charts.place(a.before, before, colours),
            },
            chart,
        )

    def report(self, output: str | Path, design: Design | None = None) -> Path:
        """Write the diagnosis to `output` as one HTML page that opens offline, with its tracking where there is a
        `design` (None: that of the flight's record).

        Returns the path. Raises `InputError` where it cannot be written.
        """
        from trueflight.groundstation.output.as_json import analysis_table
        from trueflight.groundstation.report import render, write_report
        from trueflight.groundstation.versions.choice import choose_design

        whole = self.analysis(choose_design(self.flight) if design is None else design)
        write_report(Path(output), render(whole, analysis_table(whole)))
        return Path(output)

    def _found(self) -> list[results.EffectVerdict]:
        return [e for e in self.effects if e.verdict in ("missing", "possible")]

    def __repr__(self) -> str:
        told = "; ".join(
            f"{verdict} {', '.join(names)}"
            for verdict, names in (("missing", self.missing), ("possible", self.possible))
            if names
        )
        of = f"{len(self.flights)} flights" if self.flights else self.flight.name
        return (
            f"<Diagnosis of {of}: {told or 'nothing missing'}; "
            f"residual {self.rms_before:.3f} -> {self.rms_after:.3f} m/s², noise floor {self.noise_floor:.3f} m/s²>"
        )

    def _repr_html_(self) -> str:
        return self.summary().html


def _own(p: results.ParameterEstimate) -> str:
    return f"{p.name}@{p.flight}" if p.flight else p.name


def _key(e: results.EffectVerdict, p: results.ParameterEstimate) -> str:
    return f"{e.name}.{_own(p)}"


@dataclass(frozen=True, repr=False)
class Tracking(tracking.Tracking):
    """A flight, named by `label`, beside the linear behaviour expected of it, over the M samples of its missions:
    `position`, `expected` and `reference` (M, 3) in m, world ENU; `zeta` and `expected_zeta` (M, 3) in rad; `mse` (3,)
    in m² and `mse_zeta` (3,) in rad², per axis.
    """

    def summary(self) -> Summary:
        """Mean squared error per axis, as `groundstation track` prints it."""
        from trueflight.groundstation.output.flown import print_tracking

        return summary_of(lambda console: print_tracking(console, [self]))

    def to_pandas(self) -> pd.DataFrame:
        """Position, expected position and reference (m, world ENU) as a pandas table of M rows, indexed by `t` (s).

        Raises `InputError` where pandas is not installed.
        """
        columns: dict[str, Any] = {"t": self.t}
        for name in ("position", "expected", "reference"):
            columns |= {f"{name}_{axis}": getattr(self, name)[:, k] for k, axis in enumerate("xyz")}
        return data_frame(columns, index="t")

    def plot(self, chart: str = "tracking") -> Figure:
        """The chart of the report: "tracking", the distance to the expected behaviour per axis, cm.

        Raises `InputError` for another `chart`.
        """
        from trueflight.groundstation.report import charts

        return picture({"tracking": lambda colours: charts.tracking(self, colours)}, chart)

    def __repr__(self) -> str:
        x, y, z = self.mse
        return f"<Tracking of {self.label}: MSE x {x:.3g}, y {y:.3g}, z {z:.3g} m², RMS {self.rms:.3g} m>"

    def _repr_html_(self) -> str:
        return self.summary().html


@dataclass(frozen=True, repr=False)
class Tube(bound.Tube):
    """A flight, named by `label`, in its predicted tube over the M samples `t` (M,) s, axes x, y, z of the world:
    `ball` (3, 2) is the half width that it settles to (m, m/s), `extent` (M, 3, 2) that along the flight, `inside` (3,)
    the share of time inside, `leavings` where it was left.
    """

    def summary(self) -> Summary:
        """Disturbance, half widths and whether the flight stayed inside, as `groundstation bound` prints them."""
        from trueflight.groundstation.output.flown import print_tube

        return summary_of(lambda console: print_tube(console, self))

    def __repr__(self) -> str:
        sizes: Mapping[str, float] = dict(zip("xyz", self.ball[:, 0].tolist(), strict=True))
        told = ", ".join(f"{axis} ± {size:.2f} m" for axis, size in sizes.items())
        return f"<Tube of {self.label}: {told}; {100 * self.inside.min():.1f} % inside>"

    def _repr_html_(self) -> str:
        return self.summary().html


__all__ = ["Comparison", "Diagnosis", "Model", "SideBySide", "Tracking", "Tube", "WhereItFails"]
