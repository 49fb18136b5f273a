"""What looks at a flight say while it goes on: the ranking as a page, intervals as they narrow, and what changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.live.said import Alert, Said
from trueflight.groundstation.output.live_lines import LEFT_OUT, not_excited, numbers
from trueflight.groundstation.output.tables import SAID, percent
from trueflight.groundstation.views.colour import FLOOR, LINEAR, NEWEST
from trueflight.groundstation.views.recording import TIME, text

CURVES = (("before", LINEAR), ("after", NEWEST), ("noise", FLOOR))


class Panes:
    """The diagnosis of one vehicle under `root`."""

    def __init__(self, stream: rr.RecordingStream, vehicle: str, root: str) -> None:
        self._stream, self._vehicle, self._root = stream, vehicle, root
        self._named: set[str] = set()
        self._shown: tuple[Said, tuple[Alert, ...], float] | None = None
        self._age = 0.0
        for name, colour in CURVES:
            path = f"{root}diagnosis/residual/{name}"
            stream.log(path, rr.SeriesLines(colors=[colour], names=name, widths=[1.5]), static=True)
        text(
            stream,
            f"{root}diagnosis/page",
            f"## {vehicle}\n\nNot looked at yet: it has to fly for 10 s first.",
        )

    def said(
        self, said: Said, alerts: Sequence[Alert], news: Sequence[Alert], age: float, now: float
    ) -> None:
        """Show a look; `now` is the time of the newest tick on the timeline, `age` that since the window's end, s."""
        self._shown, self._age = (said, tuple(alerts), now - age), -np.inf
        self.grow_old(now)
        self._stream.set_time(TIME, duration=max(now - age, 0.0))
        if not said.error:
            values = (said.rms_before, said.rms_after, said.noise_floor)
            for (name, _), value in zip(CURVES, values, strict=True):
                self._stream.log(f"{self._root}diagnosis/residual/{name}", rr.Scalars(value))
            for path, width in said.widths:
                where = f"{self._root}diagnosis/narrowing/{path}"
                if path not in self._named:
                    self._named.add(path)
                    named = rr.SeriesLines(names=path.replace("/", " "), widths=[1.5])
                    self._stream.log(where, named, static=True)
                self._stream.log(where, rr.Scalars(width))
        for alert in news:
            level = rr.TextLogLevel.INFO if alert.taken_back else rr.TextLogLevel.WARN
            self._stream.log("events", rr.TextLog(f"{self._vehicle}: {alert.text}", level=level))

    def grow_old(self, now: float) -> None:
        """Say how old the newest look is when the newest tick is of `now`, once a second."""
        if self._shown is None or now - self._shown[2] < self._age + 1.0:
            return
        said, alerts, end = self._shown
        self._age = now - end
        text(self._stream, f"{self._root}diagnosis/page", page(self._vehicle, said, alerts, self._age))


def page(vehicle: str, said: Said, alerts: Sequence[Alert], age: float) -> str:
    """What a look says, as a page: what changed, the ranking, what has not been excited yet, what was not asked."""
    if said.error:
        return f"## {vehicle}\n\nCannot be judged now: {said.error}"
    told = [a for a in alerts if a.told is not None and not a.taken_back][-3:]
    ranked = sorted((e for e in said.effects if e.rank), key=lambda e: e.rank or 0)
    missing = [e.name for e in ranked if e.verdict == "missing"]
    head = f"missing: {', '.join(missing)}" if missing else "nothing is missing for sure"
    lines = [f"## {vehicle}: {head}", ""]
    lines += [f"**{a.text}**\n" for a in told]
    if ranked:
        lines += ["| effect | verdict | share | value [95 %] |", "|---|---|---|---|"]
        for e in ranked:
            unsure = e.verdict == "possible" and e.indistinguishable_from
            others = f" or {', '.join(e.indistinguishable_from)}" if unsure else ""
            share = percent(e.variance_share) if e.seen_in == "acceleration" else "rotation"
            lines.append(f"| {e.name}{others} | {SAID[e.verdict]} | {share} | {numbers(e)} |")
    kind = "Thorough" if said.thorough else "Brief"
    lines += [
        "",
        f"Residual {said.rms_before:.3g} → {said.rms_after:.3g} m/s², noise {said.noise_floor:.2g}. {kind} look at "
        f"{said.start:.0f} to {said.stop:.0f} s of the flight, {age:.1f} s ago.",
        "",
        *(f"Not excited yet: {line}\n" for line in not_excited(said)),
        f"*{LEFT_OUT[0].upper()}{LEFT_OUT[1:]}.*",
    ]
    return "\n".join(lines)


def panes(root: str, name: str) -> rrb.Container:
    """Where a diagnosis is seen: its page beside the residual and the intervals as they narrow."""
    return rrb.Horizontal(
        rrb.TextDocumentView(origin=f"{root}diagnosis/page", name=name),
        rrb.Vertical(
            rrb.TimeSeriesView(
                origin=f"{root}diagnosis/residual",
                name="residual (m/s²)",
                plot_legend=rrb.PlotLegend(visible=False),
            ),
            rrb.TimeSeriesView(
                origin=f"{root}diagnosis/narrowing",
                name="95 % intervals narrow",
            ),
        ),
        column_shares=[3, 2],
    )
