"""Live: the vehicle in space with its path and reference, commands, correction, guard, latency, battery."""

from __future__ import annotations

import contextlib
import queue
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.processes import told_to_end
from trueflight.groundstation.views import scene
from trueflight.groundstation.views.colour import AXES, LINEAR, MEASURED, NEWEST, REFERENCE, WARNING, Colour
from trueflight.groundstation.views.recording import TIME, recording, text
from trueflight.models.errors import InputError
from trueflight.models.record_pb2 import Event, Tick, Vector3
from trueflight.models.vehicle import Vehicle

PERIOD = 0.1  # s between two updates of the picture
TRAIL = 30.0  # s of path that stay in sight
ASK = 1.0  # s between two questions for the names of models, while connected
WINDOW = 20.0  # s of the curves
HISTORY = 200  # ticks of the past that are asked for
SILENCE = 2.0  # s without a tick that the pilot is told of
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


def monitor(link: Link, save: Path | None = None, seconds: float | None = None) -> int:
    """Show a companion's ticks and events until told to end (Ctrl-C, SIGTERM, a closed terminal), or for `seconds`;
    returns how many ticks were seen.

    Opens the Rerun viewer, or writes the recording `save`. Raises `InputError` where there is no viewer to
    open.
    """
    if save is not None:
        with recording(save, "monitor", f"{link.vehicle}, live") as stream:
            return Monitor(stream, link.vehicle).run(link, seconds)
    stream = rr.RecordingStream("trueflight monitor")
    try:
        stream.spawn()
    except (RuntimeError, OSError) as error:
        raise InputError(
            f"the Rerun viewer does not open ({error}); is there a display? Use --save FILE"
        ) from None
    return Monitor(stream, link.vehicle).run(link, seconds)


class Monitor:
    """Turns ticks and events into a recording, a batch at a time."""

    def __init__(self, stream: rr.RecordingStream, vehicle: str) -> None:
        self.stream, self.vehicle = stream, vehicle
        self.seen = 0
        self._ticks: queue.SimpleQueue[Tick] = queue.SimpleQueue()
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._trail: deque[tuple[float, tuple[float, float, float]]] = deque()
        self._last: Tick | None = None
        self._heard = time.monotonic()
        self._told = ""
        self._models: dict[str, Any] = {}
        stream.send_blueprint(blueprint())
        stream.log("space", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for path, name, colour in CURVES:
            width = 1.0 if "shadow" in path else 2.0
            stream.log(path, rr.SeriesLines(colors=[colour], names=name, widths=[width]), static=True)
        drawn = Vehicle(name=vehicle, mass=1.0, hover_thrust=0.5, rotor_radius=0.07)
        scene.log_vehicle(stream, "space/vehicle", drawn, 5.0)

    def run(self, link: Link, seconds: float | None = None) -> int:
        """Follow `link` until told to end or for `seconds`; returns how many ticks were seen."""
        if link.warning:
            self.stream.log("events", rr.TextLog(link.warning, level="ERROR"), static=False)
        link.follow(self._ticks.put, self._events.put, history=HISTORY)
        end = time.monotonic() + seconds if seconds is not None else np.inf
        asked = -np.inf
        with told_to_end() as told:
            while time.monotonic() < end and not told.wait(PERIOD):
                if time.monotonic() - asked > ASK and time.monotonic() - self._heard < SILENCE:
                    asked = time.monotonic()
                    with contextlib.suppress(InputError):  # the link may drop; ticks say the rest
                        self._models = link.ask("status", timeout=ASK)
                        self._models["insecure"] = link.warning
                self.update()
        self.update()
        return self.seen

    def update(self) -> None:
        """Log what has arrived since the last time."""
        ticks = [self._ticks.get() for _ in range(self._ticks.qsize())]
        if ticks:
            self._heard = time.monotonic()
            self.add_ticks(ticks)
        events = [self._events.get() for _ in range(self._events.qsize())]
        for event in events:
            self.add_event(event)
        self._tell()

    def add_ticks(self, ticks: list[Tick]) -> None:
        """Log ticks, in the order in which they were flown."""
        last = self._last.vehicle_time_us if self._last is not None else -1
        ticks = [t for t in sorted(ticks, key=lambda t: t.vehicle_time_us) if t.vehicle_time_us > last]
        if not ticks:
            return
        self.seen += len(ticks)
        clock = np.array([t.vehicle_time_us * 1e-6 for t in ticks])
        times = [rr.TimeColumn(TIME, duration=clock)]
        for path, values in _columns(ticks).items():
            self.stream.send_columns(path, indexes=times, columns=rr.Scalars.columns(scalars=values))
        position = np.array([_xyz(t.position) for t in ticks])
        turn = np.array([(t.quaternion.x, t.quaternion.y, t.quaternion.z, t.quaternion.w) for t in ticks])
        self.stream.send_columns(
            "space/vehicle",
            indexes=times,
            columns=rr.Transform3D.columns(translation=position, quaternion=turn),
        )
        self._last = ticks[-1]
        self.stream.set_time(TIME, duration=float(clock[-1]))
        self._trail.extend(zip(clock.tolist(), map(tuple, position), strict=True))
        while self._trail and self._trail[0][0] < clock[-1] - TRAIL:
            self._trail.popleft()
        trail = np.array([place for _, place in self._trail])
        self.stream.log(
            "space/path", rr.LineStrips3D([trail[:: max(1, len(trail) // 600)]], colors=[NEWEST], radii=0.012)
        )
        reference = _xyz(self._last.position_reference)
        if self._last.phase not in ("", "idle", "silent") and np.all(np.isfinite(reference)):
            self.stream.log("space/reference", rr.Points3D([reference], colors=[REFERENCE], radii=0.06))

    def add_event(self, event: Event) -> None:
        """Log an event."""
        if self._last is not None:
            self.stream.set_time(TIME, duration=max(event.vehicle_time_us * 1e-6, 0.0))
        self.stream.log("events", rr.TextLog(f"{event.kind}: {event.text}", level=LEVELS.get(event.level)))

    def _tell(self) -> None:
        """What the pilot reads first, only when it has changed."""
        silent = time.monotonic() - self._heard
        said = state(self.vehicle, self._last, silent if silent > SILENCE else 0.0, self._models)
        if said != self._told:
            self._told = said
            text(self.stream, "state", said)


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


def blueprint() -> rrb.Blueprint:
    """What the pilot sees: the vehicle in space and the state large, the rest of it in curves."""
    now = rrb.VisibleTimeRange(
        TIME,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )

    def curves(origin: str, name: str) -> rrb.TimeSeriesView:
        legend = rrb.PlotLegend(visible=False)
        return rrb.TimeSeriesView(origin=origin, name=name, time_ranges=now, plot_legend=legend)

    space = rrb.Spatial3DView(
        origin="space",
        name="vehicle, path (blue), reference (green)",
        eye_controls=rrb.EyeControls3D(
            position=(-5.0, -5.0, 4.5), look_target=(0.0, 0.0, 1.2), eye_up=(0.0, 0.0, 1.0)
        ),
        line_grid=scene.ground(),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Horizontal(
                    rrb.TextDocumentView(origin="state", name="state"), space, column_shares=[1, 2.2]
                ),
                rrb.TextLogView(
                    origin="events",
                    name="events",
                    columns=rrb.TextLogColumns(
                        timeline_columns=[TIME], text_log_columns=["loglevel", "body"]
                    ),
                ),
                row_shares=[4, 1],
            ),
            rrb.Vertical(
                curves("position/x", "x (m): flown blue, reference green"),
                curves("position/y", "y (m)"),
                curves("position/z", "height z (m)"),
                rrb.Horizontal(
                    curves("thrust/feedback", "thrust wanted by the linear cascade (N)"),
                    curves("thrust/sent", "thrust sent (1 is full)"),
                ),
                curves("rates", "body rates sent (deg/s): roll red, pitch green, yaw blue"),
                curves("correction", "correction (m/s²): x red, y green, z blue; thin: in the shadow"),
                rrb.Horizontal(
                    curves("latency", "latency (ms): age grey, model orange"),
                    curves("battery", "battery (V)"),
                ),
            ),
            column_shares=[5, 4],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
        collapse_panels=True,
    )


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
