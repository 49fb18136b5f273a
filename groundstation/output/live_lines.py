"""What a monitor says line by line: to a person, only when something changes; to a program, all of it as JSON."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.live.learnt import Learnt
from trueflight.groundstation.live.said import PERSISTS, Alert, Said
from trueflight.groundstation.output.as_json import UNIT, effect_found_table, plain
from trueflight.groundstation.output.tables import SAID, VERDICT_STYLE
from trueflight.groundstation.output.terminal import print_event
from trueflight.models.printed import print_json_line
from trueflight.models.record_pb2 import Event, Tick

LEFT_OUT = (
    "not asked while it flies: what drifts by and by, gusts and other structure of what is left, a held-out flight "
    "(groundstation diagnose asks all); new effects, and other sets that explain as much, by every fifth look"
)


def not_excited(said: Said, most: int = 3) -> list[str]:
    """What this flight has not shown yet, and what to fly for it: the manoeuvres that most effects wait for first."""
    by_manoeuvre: dict[str, list[str]] = {}
    for e in said.effects:
        if e.verdict == "not_excited":
            by_manoeuvre.setdefault(e.advice.removeprefix("to see it, "), []).append(e.name)
    most_first = sorted(by_manoeuvre.items(), key=lambda pair: -len(pair[1]))
    return [f"{', '.join(names)}: {manoeuvre}" for manoeuvre, names in most_first[:most]]


class Lines:
    """For a person: a line when the flight begins, what is found changes, or something changed in flight."""

    def __init__(self, console: Console, events: bool = True) -> None:
        self._console, self._events = console, events
        self._found: dict[str, tuple[tuple[str, str], ...]] = {}
        self._next: dict[str, tuple[tuple[tuple[str, str], ...], int]] = {}
        self._silent: dict[str, bool] = {}
        self._flight: dict[str, int] = {}
        self._error: dict[str, str] = {}

    def ticks(self, name: str, ticks: Sequence[Tick]) -> None:
        """Nothing: ticks are for the picture."""

    def past(self, name: str, ticks: Sequence[Tick]) -> None:
        """That a hole is filled."""
        seconds = 1e-6 * (ticks[-1].vehicle_time_us - ticks[0].vehicle_time_us)
        self._print(
            name, f"{seconds:.1f} s that were missing are filled from the companion's record", "green"
        )

    def event(self, name: str, event: Event) -> None:
        """What the companion told."""
        if self._events:
            print_event(self._console, event)

    def state(self, name: str, silent: float, status: dict[str, Any]) -> None:
        """That the link is lost, and that it is back."""
        if bool(silent) != self._silent.get(name, False):
            self._silent[name] = bool(silent)
            self._print(name, "silent" if silent else "heard again", "yellow" if silent else "green")

    def learnt(self, name: str, flight: int, news: Sequence[Learnt]) -> None:
        """What the companion learnt and flies with."""
        for one in news:
            self._print(name, f"{one.time:.0f} s: {one.text}", "green" if one.ended else "bold yellow")

    def said(self, name: str, said: Said, alerts: Sequence[Alert], news: Sequence[Alert], age: float) -> None:
        """What has changed since the last look."""
        if self._flight.get(name) != said.flight:
            self._flight[name] = said.flight
            self._found.pop(name, None)
        if said.error != self._error.get(name, ""):
            self._error[name] = said.error
            if said.error:
                self._print(name, f"cannot be judged now: {said.error}", "yellow")
        for alert in news:
            self._print(
                name, f"{said.stop:.0f} s: {alert.text}", "yellow" if alert.taken_back else "bold red"
            )
        if not said.error:
            self._tell_found(name, said)

    def _tell_found(self, name: str, said: Said) -> None:
        """What is found, once several looks agree on it."""
        found = tuple((e.name, e.verdict) for e in _ranked(said) if e.verdict in ("missing", "possible"))
        last, count = self._next.get(name, (found, 0))
        count = count + 1 if last == found else 1
        self._next[name] = (found, count)
        if count < PERSISTS or self._found.get(name) == found:
            return
        self._found[name] = found
        told = [
            f"[{VERDICT_STYLE[e.verdict]}]{e.name} {SAID[e.verdict]}[/] {escape(numbers(e))}".strip()
            for e in _ranked(said)
            if e.verdict in ("missing", "possible")
        ]
        self._console.print(
            f"{name}, {said.stop:.0f} s: {'; '.join(told) or 'nothing is missing'} "
            f"(residual {said.rms_before:.2g} → {said.rms_after:.2g} m/s²)",
            highlight=False,
            soft_wrap=True,
        )
        for line in not_excited(said, most=1):
            told_of = f"  not excited yet: {escape(line)}"
            self._console.print(told_of, style="cyan", highlight=False, soft_wrap=True)

    def _print(self, name: str, text: str, style: str) -> None:
        self._console.print(f"{name}: {escape(text)}", style=style, highlight=False, soft_wrap=True)


def numbers(effect: Any) -> str:
    """The parameters of a verdict with their intervals, in one line."""
    return ", ".join(
        f"{p.name} {p.value:.3g} [{p.low:.3g}, {p.high:.3g}]{'' if p.unit == '1' else f' {p.unit}'}"
        for p in effect.parameters
    )


def _ranked(said: Said) -> list[Any]:
    return sorted((e for e in said.effects if e.rank), key=lambda e: e.rank or 0)


class JsonLines:
    """For a program: one JSON document a line, of the kinds `look`, `alert`, `learnt`, `link`, `filled` and `event`."""

    def __init__(self, out: Callable[[dict[str, Any]], None] = print_json_line) -> None:
        self._out = out
        self._silent: dict[str, bool] = {}

    def ticks(self, name: str, ticks: Sequence[Tick]) -> None:
        """Nothing: they are in the record."""

    def past(self, name: str, ticks: Sequence[Tick]) -> None:
        """That a hole is filled."""
        first, last = ticks[0].vehicle_time_us, ticks[-1].vehicle_time_us
        self._out(
            {
                "kind": "filled",
                "vehicle": name,
                "ticks": len(ticks),
                "vehicle_time": [1e-6 * first, 1e-6 * last],
            }
        )

    def event(self, name: str, event: Event) -> None:
        """What the companion told."""
        told = {"level": event.level, "event": event.kind, "text": event.text}
        self._out(
            {"kind": "event", "vehicle": name, "vehicle_time": [1e-6 * event.vehicle_time_us] * 2, **told}
        )

    def state(self, name: str, silent: float, status: dict[str, Any]) -> None:
        """That the link is lost, and that it is back."""
        if bool(silent) != self._silent.get(name, False):
            self._silent[name] = bool(silent)
            self._out({"kind": "link", "vehicle": name, "silent": bool(silent)})

    def learnt(self, name: str, flight: int, news: Sequence[Learnt]) -> None:
        """What the companion learnt and flies with."""
        for one in news:
            told = {**asdict(one), "text": one.text}
            self._out(plain({"kind": "learnt", "vehicle": name, "flight": flight, **told}))

    def said(self, name: str, said: Said, alerts: Sequence[Alert], news: Sequence[Alert], age: float) -> None:
        """The look, and what it lets be told now."""
        rms = {
            "before": said.rms_before,
            "after": said.rms_after,
            "noise_floor": said.noise_floor,
            "unit": UNIT,
        }
        self._out(
            plain(
                {
                    "kind": "look",
                    "vehicle": name,
                    "flight": said.flight,
                    "window": [said.start, said.stop],
                    "age": age,
                    "cost": said.cost,
                    "thorough": said.thorough,
                    "error": said.error,
                    "residual_rms": None if said.error else rms,
                    "effects": [effect_found_table(e) for e in said.effects],
                    "alerts": [alert_table(a) for a in alerts if a.told is not None],
                }
            )
        )
        for alert in news:
            self._out(plain({"kind": "alert", "vehicle": name, "flight": said.flight, **alert_table(alert)}))


def alert_table(alert: Alert) -> dict[str, Any]:
    """The JSON of an alert."""
    table = asdict(alert)
    return {**{k: v for k, v in table.items() if k not in ("seen", "missed")}, "text": alert.text}
