"""Live: vehicles in space with path and reference, commands, correction, guard, latency, battery, diagnosis."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.live.learnt import Learnt
from trueflight.groundstation.live.said import Alert, Said
from trueflight.groundstation.views import scene
from trueflight.groundstation.views.colour import AXES, LINEAR, MEASURED, NEWEST, REFERENCE, WARNING, Colour
from trueflight.groundstation.views.live import Panes, panes
from trueflight.groundstation.views.recording import TIME, recording, text
from trueflight.models.errors import InputError
from trueflight.models.record_pb2 import Event, Tick, Vector3
from trueflight.models.vehicle import Vehicle

TRAIL = 30.0  # s of path that stay in sight
WINDOW = 20.0  # s of the curves
LEVELS = {"info": rr.TextLogLevel.INFO, "warning": rr.TextLogLevel.WARN, "error": rr.TextLogLevel.ERROR}

CURVES: tuple[tuple[str, str, Colour], ...] = (
    # path, name, colour
    ("position/x/reference", "reference", REFERENCE),
    ("position/x/flown", "flown", NEWEST),
    ("position/y/reference", "reference", REFERENCE),
    ("position/y/flown", "flown", NEWEST),
    ("position/z/reference", "reference", REFERENCE),
    ("position/z/flown", "flown", NEWEST),
    ("thrust/feedback", "linear cascade", LINEAR),
    ("thrust/sent", "sent", NEWEST),
    ("rates/roll", "roll", AXES[0]),
    ("rates/pitch", "pitch", AXES[1]),
    ("rates/yaw", "yaw", AXES[2]),
    ("correction/x", "x", AXES[0]),
    ("correction/y", "y", AXES[1]),
    ("correction/z", "z", AXES[2]),
    ("correction/shadow/x", "in the shadow, x", AXES[0]),
    ("correction/shadow/y", "in the shadow, y", AXES[1]),
    ("correction/shadow/z", "in the shadow, z", AXES[2]),
    ("latency/setpoint", "odometry to setpoint", NEWEST),
    ("latency/age", "age of the odometry", REFERENCE),
    ("latency/inference", "model", WARNING),
    ("battery/voltage", "battery", MEASURED),
)


@contextmanager
def viewer(vehicles: Sequence[str], save: Path | None = None, diagnosed: bool = True) -> Iterator[Views]:
    """Everything that the vehicles tell in one view: the Rerun viewer, or the recording `save`; `diagnosed` where looks
    at the flight are shown, too.

    Raises `InputError` where there is no viewer to open.
    """
    if save is not None:
        with recording(save, "monitor", f"{', '.join(vehicles)}, live") as stream:
            yield Views(stream, vehicles, diagnosed)
        return
    stream = rr.RecordingStream("trueflight monitor")
    try:
        stream.spawn()
    except (RuntimeError, OSError) as error:
        raise InputError(
            f"the Rerun viewer does not open ({error}); is there a display? Use --save FILE, or --no-view"
        ) from None
    yield Views(stream, vehicles, diagnosed)


class Views:
    """One view of several vehicles, each under its own name; of a single one at the root."""

    def __init__(self, stream: rr.RecordingStream, vehicles: Sequence[str], diagnosed: bool = True) -> None:
        alone = len(vehicles) == 1
        self._began = time.monotonic()
        self._of = {
            name: (
                Monitor(stream, name, "" if alone else f"{name}/", "space" if alone else f"space/{name}"),
                Panes(stream, name, "" if alone else f"{name}/"),
            )
            for name in vehicles
        }
        stream.log("space", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.send_blueprint(blueprint(diagnosed) if alone else blueprint_of(vehicles, diagnosed))

    def ticks(self, name: str, ticks: Sequence[Tick]) -> None:
        """As in `live.watch.Shown`."""
        self._of[name][0].add_ticks(list(ticks), time.monotonic() - self._began)

    def past(self, name: str, ticks: Sequence[Tick]) -> None:
        """As in `live.watch.Shown`."""
        self._of[name][0].add_past(list(ticks))

    def event(self, name: str, event: Event) -> None:
        """As in `live.watch.Shown`."""
        self._of[name][0].add_event(event)

    def state(self, name: str, silent: float, status: dict[str, Any]) -> None:
        """As in `live.watch.Shown`."""
        monitor, panes = self._of[name]
        monitor.tell(silent, status)
        panes.grow_old(monitor.now)

    def learnt(self, name: str, flight: int, news: Sequence[Learnt]) -> None:
        """As in `live.watch.Shown`."""
        for one in news:
            self._of[name][0].add_line(one.text, rr.TextLogLevel.INFO if one.ended else rr.TextLogLevel.WARN)

    def said(self, name: str, said: Said, alerts: Sequence[Alert], news: Sequence[Alert], age: float) -> None:
        """As in `live.watch.Shown`."""
        monitor, panes = self._of[name]
        panes.said(said, alerts, news, age, monitor.now)


class Monitor:
    """One vehicle's ticks and events, a batch at a time: under `root`, and in space under `place`.

    The timeline begins with the first tick of the vehicle that came first; `now` is the time of the newest one.
    """

    def __init__(
        self, stream: rr.RecordingStream, vehicle: str, root: str = "", place: str = "space"
    ) -> None:
        self.stream, self.vehicle, self.root, self.place = stream, vehicle, root, place
        self.now = 0.0
        self._trail: deque[tuple[float, tuple[float, float, float]]] = deque()
        self._last: Tick | None = None
        self._zero: float | None = None
        self._told = ""
        for path, name, colour in CURVES:
            width = 1.0 if "shadow" in path else 2.0
            stream.log(root + path, rr.SeriesLines(colors=[colour], names=name, widths=[width]), static=True)
        drawn = Vehicle(name=vehicle, mass=1.0, hover_thrust=0.5, rotor_radius=0.07)
        scene.log_vehicle(stream, f"{place}/vehicle", drawn, 5.0)

    def add_ticks(self, ticks: list[Tick], elapsed: float = 0.0) -> None:
        """Log ticks, in the order in which they were flown; the first ones came when the view was `elapsed` s old."""
        last = self._last.vehicle_time_us if self._last is not None else -1
        if ticks and max(t.vehicle_time_us for t in ticks) < last:  # its clock began anew
            last, self._zero, elapsed = -1, None, self.now
            self._trail.clear()
        ticks = [t for t in sorted(ticks, key=lambda t: t.vehicle_time_us) if t.vehicle_time_us > last]
        if not ticks:
            return
        if self._zero is None:
            self._zero = 1e-6 * ticks[0].vehicle_time_us - elapsed
        clock, position = self._send(ticks)
        self._last, self.now = ticks[-1], float(clock[-1])
        self.stream.set_time(TIME, duration=self.now)
        self._trail.extend(zip(clock.tolist(), map(tuple, position), strict=True))
        while self._trail and self._trail[0][0] < clock[-1] - TRAIL:
            self._trail.popleft()
        trail = np.array([place for _, place in self._trail])
        line = rr.LineStrips3D([trail[:: max(1, len(trail) // 600)]], colors=[NEWEST], radii=0.012)
        self.stream.log(f"{self.place}/path", line)
        reference = _xyz(self._last.position_reference)
        if self._last.phase not in ("", "idle", "silent") and np.all(np.isfinite(reference)):
            point = rr.Points3D([reference], colors=[REFERENCE], radii=0.06)
            self.stream.log(f"{self.place}/reference", point)

    def add_past(self, ticks: list[Tick]) -> None:
        """Log ticks that had been missing."""
        if self._zero is not None and ticks:
            self._send(ticks)

    def _send(self, ticks: list[Tick]) -> tuple[np.ndarray, np.ndarray]:
        """Log the curves and the motion of ticks; their times on the timeline and their positions."""
        clock = np.array([t.vehicle_time_us * 1e-6 for t in ticks]) - (self._zero or 0.0)
        times = [rr.TimeColumn(TIME, duration=clock)]
        for path, values in _columns(ticks).items():
            self.stream.send_columns(
                self.root + path, indexes=times, columns=rr.Scalars.columns(scalars=values)
            )
        position = np.array([_xyz(t.position) for t in ticks])
        turn = np.array([(t.quaternion.x, t.quaternion.y, t.quaternion.z, t.quaternion.w) for t in ticks])
        self.stream.send_columns(
            f"{self.place}/vehicle",
            indexes=times,
            columns=rr.Transform3D.columns(translation=position, quaternion=turn),
        )
        return clock, position

    def add_event(self, event: Event) -> None:
        """Log an event."""
        if self._zero is not None:
            self.stream.set_time(TIME, duration=max(event.vehicle_time_us * 1e-6 - self._zero, 0.0))
        self.add_line(f"{event.kind}: {event.text}", LEVELS.get(event.level))

    def add_line(self, line: str, level: str | None) -> None:
        """Log a line among the events, at the time that the stream is at."""
        self.stream.log(
            "events", rr.TextLog(line if not self.root else f"{self.vehicle}: {line}", level=level)
        )

    def tell(self, silent: float = 0.0, status: dict[str, Any] | None = None) -> None:
        """What the pilot reads first, only when it has changed."""
        said = state(self.vehicle, self._last, silent, status)
        if said != self._told:
            self._told = said
            text(self.stream, f"{self.root}state", said)


def state(vehicle: str, tick: Tick | None, silent: float, models: dict[str, Any] | None = None) -> str:
    """The pilot's page: mode, phase, controller and models, guard, battery, in a few words.

    `models` is the companion's status: names, last good model, time that is left in the shadow.
    """
    if tick is None:
        return f"## {vehicle}\n\nNo tick has arrived yet."
    head = f"## {vehicle}: {tick.phase or 'idle'}"
    if silent:
        head = f"## {vehicle}: SILENT for {silent:.0f} s"
    guard = tick.guard or "off"
    known = models or {}
    names = {entry["hash"]: f"{entry['name']} {entry['version']}" for entry in known.get("models", [])}
    lines = [
        head,
        "",
        *([f"**INSECURE**: {known['insecure']}", ""] if known.get("insecure") else []),
        "| | |",
        "|---|---|",
        f"| mode | **{tick.flight_mode or 'unknown'}**, {'armed' if tick.armed else 'disarmed'} |",
        f"| flying | {tick.trajectory or 'nothing'} |",
        f"| controller | **{tick.controller or 'none'}** |",
        f"| live model | {_called(tick.model, names)} |",
    ]
    if tick.shadow:
        about = known.get("shadow") or {}
        same = about.get("hash") == tick.shadow
        lines.append(
            f"| in the shadow | {_called(tick.shadow, {tick.shadow: _bare(about) if same else ''})} |"
        )
        if same:
            lines.append(f"| shadow to go | {about['remaining']:.0f} s |")
    if known.get("last_good"):
        lines.append(f"| last good | {_called(known['last_good'], names)} |")
    lines += [
        f"| guard | {f'**{guard}**' if guard.startswith('tripped') else guard} |",
        f"| battery | {tick.battery_voltage:.1f} V |",
        f"| height | {tick.position.z:.1f} m |",
        f"| latency | {1e3 * tick.latency:.1f} ms, of odometry {1e3 * tick.age:.0f} ms old |",
    ]
    return "\n".join(lines)


def _called(model: str, names: dict[str, str]) -> str:
    return f"`{model}` {names.get(model, '')}".rstrip() if model else "none"


def _bare(about: dict[str, Any]) -> str:
    """Name and version of a title `HASH (NAME VERSION)`."""
    return str(about.get("title", "")).partition("(")[2].rstrip(")")


def blueprint(diagnosed: bool = True) -> rrb.Blueprint:
    """What the pilot sees of one vehicle: it in space and its state, what a look says of it, the rest in curves."""
    state_view = rrb.TextDocumentView(origin="state", name="state")
    left: list[rrb.Container | rrb.View] = [
        rrb.Horizontal(state_view, _space("vehicle, path (blue), reference (green)"), column_shares=[1, 2.2])
    ]
    if diagnosed:
        left.append(panes("", "diagnosis while it flies"))
    left.append(_events())
    shares = [3.4, 3.4, 1.2] if diagnosed else [4, 1]
    return _page(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=shares), rrb.Vertical(*_curves("")), column_shares=[5, 4]
        )
    )


def blueprint_of(vehicles: Sequence[str], diagnosed: bool = True) -> rrb.Blueprint:
    """What the pilot sees of several: all of them in space, and each with its state, diagnosis and curves."""
    each = []
    for name in vehicles:
        parts: list[rrb.Container | rrb.View] = [rrb.TextDocumentView(origin=f"{name}/state", name=name)]
        if diagnosed:
            parts.append(panes(f"{name}/", f"{name}, diagnosis"))
        curves = rrb.Tabs(*_curves(f"{name}/"), name=f"{name}, curves")
        shares = [3, 4, 2.5] if diagnosed else [3, 2.5]
        each.append(rrb.Vertical(*parts, curves, row_shares=shares))
    space = _space("vehicles, paths (blue), references (green)")
    left = rrb.Vertical(space, _events(), row_shares=[4, 1])
    return _page(rrb.Horizontal(left, *each, column_shares=[1.4, *([1] * len(each))]))


def _page(content: rrb.Container) -> rrb.Blueprint:
    panel = rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following")
    return rrb.Blueprint(content, panel, collapse_panels=True)


def _events() -> rrb.TextLogView:
    columns = rrb.TextLogColumns(timeline_columns=[TIME], text_log_columns=["loglevel", "body"])
    return rrb.TextLogView(origin="events", name="events, and what changed", columns=columns)


def _space(name: str) -> rrb.Spatial3DView:
    eye = rrb.EyeControls3D(position=(-5.0, -5.0, 4.5), look_target=(0.0, 0.0, 1.2), eye_up=(0.0, 0.0, 1.0))
    return rrb.Spatial3DView(origin="space", name=name, eye_controls=eye, line_grid=scene.ground())


def _curves(root: str) -> list[rrb.Container | rrb.View]:
    now = rrb.VisibleTimeRange(
        TIME,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )

    def curves(origin: str, name: str) -> rrb.TimeSeriesView:
        legend = rrb.PlotLegend(visible=False)
        return rrb.TimeSeriesView(origin=root + origin, name=name, time_ranges=now, plot_legend=legend)

    return [
        curves("position/x", "x (m): flown blue, reference green"),
        curves("position/y", "y (m)"),
        curves("position/z", "height z (m)"),
        rrb.Horizontal(
            curves("thrust/feedback", "thrust wanted by the linear cascade (N)"),
            curves("thrust/sent", "thrust sent (1 is full)"),
            name="thrust",
        ),
        curves("rates", "body rates sent (deg/s): roll red, pitch green, yaw blue"),
        curves("correction", "correction (m/s²): x red, y green, z blue; thin: in the shadow"),
        rrb.Horizontal(
            curves("latency", "latency (ms): age grey, model orange"),
            curves("battery", "battery (V)"),
            name="latency, battery",
        ),
    ]


def _columns(ticks: list[Tick]) -> dict[str, np.ndarray]:
    """Values of every curve, by path."""
    out: dict[str, np.ndarray] = {}
    flown = np.array([_xyz(t.position) for t in ticks])
    wanted = np.array(
        [_xyz(t.position_reference) if t.HasField("position_reference") else (np.nan,) * 3 for t in ticks]
    )
    correction = np.array([_xyz(t.correction) for t in ticks])
    shadow = np.array([_xyz(t.shadow_raw) if t.shadow else (np.nan,) * 3 for t in ticks])
    rates = np.degrees([_xyz(t.body_rate_command) for t in ticks])
    for axis, name in enumerate("xyz"):
        out[f"position/{name}/flown"] = flown[:, axis]
        out[f"position/{name}/reference"] = wanted[:, axis]
        out[f"correction/{name}"] = correction[:, axis]
        out[f"correction/shadow/{name}"] = shadow[:, axis]
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        out[f"rates/{name}"] = rates[:, axis]
    out["thrust/sent"] = np.array([t.thrust_command for t in ticks])
    out["thrust/feedback"] = np.array([t.feedback.thrust for t in ticks])
    out["latency/setpoint"] = 1e3 * np.array([t.latency for t in ticks])
    out["latency/age"] = 1e3 * np.array([t.age for t in ticks])
    out["latency/inference"] = 1e3 * np.array([t.inference for t in ticks])
    out["battery/voltage"] = np.array([t.battery_voltage or np.nan for t in ticks])
    return out


def _xyz(vector: Vector3) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z
