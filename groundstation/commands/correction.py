"""`groundstation model export` of what flies as a correction: the companion's ONNX file, or the same as C."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.commands.elsewhere import print_lines, row_of
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.whole_file import write_whole

ONNX, C = "onnx", "c"
CORRECTIONS = (ONNX, C)
"""Targets that are a correction, made with flights: the companion's own file, and a header for an autopilot."""


def export_correction(
    console: Console,
    which: str,
    to: str,
    flight: Sequence[Path],
    output: Path,
    vehicle: Path | None,
    mapping: list[str] | None,
    store: Path,
    as_json: bool,
    adaptive: bool = False,
) -> None:
    """Write a version as an ONNX file or as a C header, and tell what it holds. Raises `InputError` without a flight,
    for an unknown version, and where the file cannot be written."""
    from trueflight.groundstation.export.correction_c import ENDING, deployed, write
    from trueflight.groundstation.identify.actuation import actuation_of
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.versions.choice import check_vehicle
    from trueflight.groundstation.versions.store import find
    from trueflight.models.adaptive import adaptive as learnables
    from trueflight.models.contract import model_hash
    from trueflight.models.export import export_onnx, not_exported

    if not flight:
        raise InputError(f"{to}: pass --flight, which gives training range and golden vectors")
    if to == C and adaptive:
        raise InputError("c: a header learns nothing in flight; leave out --adaptive, or export to onnx")
    if to == C and output.suffix != ENDING:
        raise InputError(f"{output}: a C header ends with {ENDING}; choose another name")
    flights = [read_flight(path, vehicle, mapping) for path in flight]
    model = find(store, flights[0].vehicle.name, which)
    for one in flights:
        check_vehicle(model, one)
    actuation = actuation_of(model, flights)
    data = onnx = export_onnx(model, *flights, actuation=actuation, adaptive=adaptive)
    written = write(model, deployed(onnx)) if to == C else None
    if written is not None:
        data = written.text.encode()
    write_whole(output, data, "the model", "choose another -o")
    left = not_exported(model)
    learnt = learnables(model)[1] if adaptive else ()
    if as_json:
        print_json(
            {
                "path": str(output),
                "to": to,
                "hash": model_hash(onnx),
                "bytes": len(data),
                "not_exported": list(left),
                "learnt_in_flight": [one.table() for one in learnt],
                "actuation": actuation,
                "effects": [row_of(line) for line in written.lines] if written else [],
                "notes": list(written.notes) if written else [],
            }
        )
        return
    console.print(f"{escape(str(output))}: {model.label}, {len(data) / 1000:.0f} kB, hash {model_hash(onnx)}")
    if written is not None:
        print_lines(console, written)
    _print_exported(console, actuation, () if written is not None else left)
    for number in learnt:
        unit = "" if number.unit == "1" else f" {number.unit}"
        console.print(
            f"learnt in flight: {number.effect} {number.parameter} = {number.value:.4g}{unit}, within "
            f"{number.low:.4g} to {number.high:.4g}",
            highlight=False,
        )


def _print_exported(console: Console, actuation: Mapping[str, float], left: Sequence[str]) -> None:
    rates = (
        f"rates {1e3 * actuation['rate_delay']:.0f} ms delay and {1e3 * actuation['rate_lag']:.0f} ms lag"
        if "rate_lag" in actuation
        else "nothing of the rate loop (these flights do not show it)"
    )
    console.print(
        f"looks ahead over: thrust {1e3 * actuation['thrust_delay']:.0f} ms delay and "
        f"{1e3 * actuation['thrust_lag']:.0f} ms lag, {rates}",
        highlight=False,
    )
    if left:
        console.print(
            f"not in it, for a static correction has no memory and no sensor: {', '.join(left)}",
            style="yellow",
        )
