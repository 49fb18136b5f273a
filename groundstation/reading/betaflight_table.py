"""Betaflight's blackbox as `blackbox_decode` (betaflight/blackbox-tools) writes it as CSV: what its columns are.

Betaflight's axes are ours, FLU. It logs neither position nor velocity, so what is compared is the accelerometer with
the motors' mean; the motors are in its own order: rear right, front right, rear left, front left.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from trueflight.groundstation.reading.mapping import Mapping
from trueflight.groundstation.reading.table import Table

BLACKBOX = (".bbl", ".bfl", ".bbs")
"""How the vehicle's own files end."""
CONVERT = (
    "a Betaflight blackbox: convert it by `blackbox_decode --unit-rotation deg/s --unit-acceleration g FILE` "
    "(betaflight/blackbox-tools) and read the .csv; the only library for Python (orangebox) is under the GPL"
)
SCALES = 2.0 ** np.arange(8, 14)
"""Counts of a g of accelerometers that are logged raw (`acc_1G`)."""
LEAST_PULSE, MOST_PULSE = 900.0, 2001.0
"""us; a motor's command that is larger is DShot's, and so is a smaller one that is not 0."""
TIMES = {"time (us)": "us", "time (ms)": "ms", "time (s)": "s"}
GRAVITIES = {"g": "g", "m/s2": "m/s^2", "m/s^2": "m/s^2"}


def blackbox_mapping(table: Table) -> tuple[Table, Mapping] | None:
    """The table with its accelerometer in g or m/s², and what its columns are; None for a table of another kind."""
    time = next((name for name in TIMES if name in table.columns), None)
    if time is None or "loopIteration" not in table.columns or "motor[0]" not in table.columns:
        return None
    quantities: dict[str, dict[str, object]] = {"time": {"column": time, "unit": TIMES[time]}}
    motors = _indexed(table, "motor", 12)
    pulses = np.concatenate([table.columns[name] for name in motors])
    given = pulses[pulses > 0.0]  # disarmed it is 0 in either unit
    kind = "dshot" if given.size and (np.max(given) > MOST_PULSE or np.min(given) < LEAST_PULSE) else "pwm"
    quantities["motor_command"] = {"columns": motors, "unit": kind}
    for quantity, name in (("angular_velocity", "gyroADC"), ("body_rate_command", "setpoint")):
        if len(found := _indexed(table, name, 3)) == 3:
            unit = "rad/s" if "rad/s" in found[0] else "deg/s"
            quantities[quantity] = {"columns": found, "unit": unit}
    force = _indexed(table, "accSmooth", 3)
    if len(force) == 3 and any(np.any(np.isfinite(table.columns[name])) for name in force):
        told = re.search(r"\(([^)]*)\)", force[0])
        unit = GRAVITIES.get(told[1] if told else "", "")
        if not unit:
            table, unit = _in_g(table, force), "g"
        quantities["specific_force"] = {"columns": force, "unit": unit}
    if "vbatLatest (V)" in table.columns:
        quantities["battery_voltage"] = {"column": "vbatLatest (V)"}
    return table, Mapping("Betaflight's columns", "", quantities)


def _indexed(table: Table, name: str, most: int) -> list[str]:
    """Columns `name[0]`, `name[1]`, ..., with their unit in brackets or without."""
    found: list[str] = []
    for i in range(most):
        column = next((c for c in table.columns if re.fullmatch(rf"{name}\[{i}\]( \(.*\))?", c)), None)
        if column is None:
            break
        found.append(column)
    return found


def _in_g(table: Table, force: list[str]) -> Table:
    """The table with a raw accelerometer in g: by the scale, a power of two, that brings the median of its length
    nearest to one g."""
    raw = np.stack([table.columns[name] for name in force], -1)
    length = float(np.nanmedian(np.linalg.norm(raw, axis=1)))
    scale = float(SCALES[np.argmin(np.abs(np.log(np.maximum(length, 1e-9) / SCALES)))])
    scaled = {**table.columns, **{name: table.columns[name] / scale for name in force}}
    note = f"the accelerometer is logged raw: {scale:.0f} counts (acc_1G of the log's header) make its length one g"
    return replace(table, columns=scaled, notes=(*table.notes, note))
