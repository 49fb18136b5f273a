"""From columns, whatever they were read from, to a checked `Flight` on an even clock."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading import plausible, rows
from trueflight.groundstation.reading.actuation import actuation_checks
from trueflight.groundstation.reading.airborne import flying_mask
from trueflight.groundstation.reading.consistency import reconcile, refusal
from trueflight.groundstation.reading.mapping import (
    Mapping,
    corrected,
    corrected_time,
    left_out,
    span_of,
    units_of,
)
from trueflight.groundstation.reading.uniform import MOST_LOST, even_clock, slopes, trend
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.vehicle import Vehicle

WIDE = 0.1
"""s on either side over which a velocity is taken from the position: it keeps 94 % of motion at 1.2 Hz."""


def assemble(
    path: Path,
    vehicle: Vehicle,
    t: np.ndarray,
    columns: dict[str, np.ndarray],
    place: Callable[[int], str],
    *,
    extra: dict[str, np.ndarray] | None = None,
    flying: np.ndarray | None = None,
    commanded: np.ndarray | None = None,
    notes: tuple[str, ...] = (),
    most_lost: float = MOST_LOST,
    mapping: Mapping | None = None,
    accelerometer: bool = True,
    named_by: Mapping | None = None,
    rates: dict[str, float] | None = None,
    on_disk: bool = True,
) -> Flight:
    """Check columns (N, ...) by attribute of `Flight` on the clock `t` (N,), put them on an even clock and
    find what was flown.

    `place(row)` names a row in messages; `extra` are columns that are kept and not analysed; `flying` (N,) is True
    where the log says that the vehicle is in the air (without it, that is found out), `commanded` (N,) where these
    commands flew it; `notes` are told to the user; `most_lost` is the share of samples that gaps may take; `mapping`
    corrects the columns; `accelerometer` is False where the specific force is an estimator's; `named_by`
    is the mapping that they were read by already; `rates` are the true ones (Hz) of columns that were interpolated
    onto the clock; `on_disk` is False where `path` is a name alone. Raises `InputError` for anything that cannot be
    analysed.
    """
    origin = str(path)
    columns = {name: column for name, column in columns.items() if name not in left_out(mapping)}
    _check_groups(origin, columns)
    columns, dead = rows.without_dead_battery(columns)
    names = list(columns)
    every = {
        **rows.without_empty_attitude(columns),
        **{f"extra {k}": v for k, v in (extra or {}).items()},
    }
    if flying is not None:
        every["flying"] = np.asarray(flying, dtype=bool)
    if commanded is not None:
        every["commanded"] = np.asarray(commanded, dtype=bool)
    if mapping is not None:
        t = corrected_time(mapping, t, vehicle)
    t, every, mended = _whole_rows(t, every, names, place)
    t, every, cut = _cut(t, every, span_of(named_by or mapping), origin)
    mended += cut
    if mapping is not None:
        every |= corrected(mapping, t, {name: every[name] for name in names if name in every}, vehicle)
        mended.append(f"corrected by {mapping.source}")
    units = units_of(named_by or mapping)
    plausible.check_units(t, {name: every[name] for name in names}, vehicle, origin, units)
    every, wrong_voltage = plausible.without_wrong_voltage(every, vehicle)
    t, every, resampled = even_clock(t, rows.continuous(every), origin, most_lost)
    said = [*notes, *dead, *mended, *wrong_voltage, *resampled]
    given = {name: every[name] for name in names if name in every}
    if "thrust_command" not in given:
        given["thrust_command"] = given["motor_command"].mean(axis=1)
        said.append("no collective command in the log: thrust_command is the mean of the motor commands")
    in_air = every["flying"] if flying is not None else flying_mask(t, given, vehicle)
    if commanded is not None:
        in_air = in_air & every["commanded"]
    said += _left_out(t, in_air, said, origin)
    plausible.check_sensors(t, given, in_air, origin)
    implausible = plausible.implausible_force(given, in_air)
    if "position" in given and "velocity" not in given:
        # what is felt is not taken from it, where there is an accelerometer: noise matters more than quick motion
        felt = accelerometer and "specific_force" in given
        given["velocity"] = trend(t, given["position"], WIDE) if felt else slopes(t, given["position"])
        said.append("no velocity in the log: differentiated from the position")
    agreed = reconcile(t, given, in_air)
    checks = (
        *agreed.checks,
        *actuation_checks(_of(t, agreed.keep), agreed.columns, _of(in_air, agreed.keep), vehicle),
    )
    named = any(c.mapping and c.verdict == "contradicts" for c in checks)
    if wrong := implausible if implausible and not named else refusal(checks):
        raise InputError(f"{origin}: {wrong}")
    extras = {n.removeprefix("extra "): column for n, column in every.items() if n.startswith("extra ")}
    return Flight(
        name=path.stem,
        vehicle=vehicle,
        t=_of(t, agreed.keep),
        **agreed.columns,  # type: ignore[arg-type]
        flying=_of(in_air, agreed.keep),
        accelerometer=accelerometer and "specific_force" in given,
        sensor_rate={**(rates or {}), **agreed.rates}.get(
            "specific_force" if "specific_force" in given else "velocity"
        ),
        origin=origin,
        data_hash=_hash_of(path) if on_disk else "",
        notes=(*said, *agreed.notes, *(c.text for c in checks[len(agreed.checks) :] if c.verdict == "weak")),
        extra={name: _of(column, agreed.keep) for name, column in extras.items()},
        consistency=checks,
    )


def _of(column: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """The rows of a column to `keep` (N,); not copied where that is all of them: an hour's flight is large."""
    return column if np.all(keep) else column[keep]


def _hash_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _whole_rows(
    t: np.ndarray, every: dict[str, np.ndarray], names: list[str], place: Callable[[int], str]
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Clock and columns in order of time, each time once, and whole in the columns `names`; what was done to them."""
    t, every, order, sorted_ = rows.in_order(t, every)

    def sorted_place(row: int) -> str:
        return place(int(order[min(row, len(order) - 1)]) if len(order) else 0)

    plausible.check_clock(t, sorted_place)
    t, every, repeated = rows.without_duplicates(t, every)
    wanted = {name: every[name] for name in names}
    _, whole, missing = rows.complete(t, {**wanted, "row": np.arange(len(t))}, sorted_place)
    kept = whole.pop("row")
    if len(kept) == len(t):
        return t, every | whole, [*sorted_, *repeated, *missing]
    others = {name: column[kept] for name, column in every.items() if name not in wanted}
    return t[kept], {**whole, **others}, [*sorted_, *repeated, *missing]


def _cut(
    t: np.ndarray, every: dict[str, np.ndarray], span: tuple[float, float], origin: str
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """What is within the `span` of time; what was cut off."""
    keep = (t >= span[0]) & (t <= span[1])
    if np.all(keep):
        return t, every, []
    if np.sum(keep) < plausible.LEAST:
        raise InputError(
            f"{origin}: nothing is left from {max(span[0], t[0]):g} until {span[1]:g} s by [time] of the mapping; the "
            f"log has t = {t[0]:.1f} to {t[-1]:.1f} s"
        )
    said = f"cut to t = {t[keep][0]:.1f} to {t[keep][-1]:.1f} s of {t[0]:.1f} to {t[-1]:.1f} s by the mapping"
    return t[keep], {name: column[keep] for name, column in every.items()}, [said]


def _left_out(t: np.ndarray, in_air: np.ndarray, said: list[str], origin: str) -> list[str]:
    """What to say of the samples that are not in the air; raises `InputError` where too few are."""
    seconds = float(in_air.sum()) * float(np.median(np.diff(t)))
    if seconds < plausible.SHORTEST:
        cut = " (the log may be cut short)" if any("cut" in note for note in said) else ""
        raise InputError(
            f"{origin}: only {seconds:.1f} s of {t[-1] - t[0]:.1f} s are in the air{cut}; at least "
            f"{plausible.SHORTEST:g} s are needed: fly longer, or check hover_thrust of the vehicle file"
        )
    if np.all(in_air):
        return []
    first, last = t[in_air][0], t[in_air][-1]
    return [
        f"{seconds:.1f} s of {t[-1] - t[0]:.1f} s are in the air, between t = {first:.1f} and "
        f"{last:.1f} s; the rest (ground, takeoff, landing, fragments) is left out"
    ]


def _check_groups(origin: str, columns: dict[str, np.ndarray]) -> None:
    """What no analysis can do without: a command, and something that was measured in answer to it."""
    if "thrust_command" not in columns and "motor_command" not in columns:
        raise InputError(
            f"{origin}: no thrust_command (nor motor_command_1..4): without the command nothing can be "
            "predicted; add "
            "the column, or name yours in a mapping (--mapping)"
        )
    moves = "quaternion" in columns and ("velocity" in columns or "position" in columns)
    if "specific_force" not in columns and not moves:
        raise InputError(
            f"{origin}: neither an accelerometer (specific_force_x, y, z) nor attitude with velocity or "
            "position "
            "(quaternion_*, velocity_*); add one of them, or name yours in a mapping (--mapping)"
        )
