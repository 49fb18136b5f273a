"""`groundstation design`: the gains of the linear cascade."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from trueflight.groundstation.commands.options import JsonOption
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.design.integral_design import IntegralLoop
    from trueflight.groundstation.design.linear_design import Loop
    from trueflight.models.design import Design
    from trueflight.models.vehicle import Vehicle

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "design", epilog="Example: groundstation design models/vehicles/quad5/vehicle.toml -o design.json"
    )(design_command)


def design_command(
    vehicle: Annotated[Path, typer.Argument(help="vehicle.toml")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Design file; default: design.json beside it.")
    ] = None,
    bandwidth: Annotated[float | None, typer.Option(help="Position loop, Hz.")] = None,
    attitude_bandwidth: Annotated[float | None, typer.Option(help="Attitude loop, Hz.")] = None,
    rate: Annotated[float, typer.Option(help="Control rate, Hz.")] = 100.0,
    keep: Annotated[
        Path | None, typer.Option("--keep", help="Keep the gains of this design, add only its integral loop.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Gains of the linear cascade by LQR, with and without integral, and what the closed loop will do."""
    from trueflight.groundstation.design.integral_design import integral_loops, with_integral
    from trueflight.groundstation.design.linear_design import (
        ATTITUDE_BANDWIDTH,
        POSITION_BANDWIDTH,
        loops,
        make_design,
    )
    from trueflight.groundstation.output.as_json import design_table
    from trueflight.models.design import load_design, save_design
    from trueflight.models.vehicle import load_vehicle

    believed = load_vehicle(vehicle)
    if keep is not None:
        if bandwidth is not None or attitude_bandwidth is not None:
            raise InputError("--keep: the gains are those of the file; leave out --bandwidth")
        design = load_design(keep, believed)
    else:
        design = make_design(
            believed, bandwidth or POSITION_BANDWIDTH, attitude_bandwidth or ATTITUDE_BANDWIDTH, rate
        )
    design = with_integral(design, believed)
    target = output or vehicle.with_name("design.json")
    save_design(design, target)
    found, integral = loops(design, believed), integral_loops(design, believed)
    if as_json:
        print_json(design_table(design, target, found, integral))
        return
    _print_loops(believed, design, found, integral)
    _print_gains(design)
    _print_integral(integral)
    console.print(f"design: {escape(str(target))}")


def _print_loops(
    believed: Vehicle, design: Design, found: Sequence[Loop], integral: Sequence[IntegralLoop]
) -> None:
    from trueflight.groundstation.design.linear_design import actuation
    from trueflight.models.terminal import Table

    delay, lag = actuation(believed, design.rate)
    table = Table(title=f"{believed.name}: closed loop, step of the reference")
    for heading in (
        "loop",
        "poles (1/s)",
        "rise",
        "settles",
        "overshoot",
        f"margin at {1e3 * delay:.0f} + {1e3 * lag:.0f} ms",
    ):
        table.add_column(heading, justify="left" if heading in ("loop", "poles (1/s)") else "right")
    shown = [(loop.name, loop) for loop in found] + [(f"{i.loop.name} + i", i.loop) for i in integral]
    for name, loop in shown:
        table.add_row(
            name,
            _poles(loop.poles),
            f"{loop.rise_time:.2f} s",
            f"{loop.settling_time:.2f} s",
            f"{100 * loop.overshoot:.0f} %",
            f"{loop.phase_margin:.0f} deg",
        )
    console.print(table)


def _print_gains(design: Design) -> None:
    k_zeta, k_eta = design.K_zeta, design.K_eta
    console.print(f"K_zeta  roll, pitch {k_zeta[0][0]:.2f}, yaw {k_zeta[2][2]:.2f} 1/s")
    console.print(
        f"K_eta   tilt {k_eta[1][0]:.3f} rad/m, {k_eta[1][3]:.3f} rad s/m; thrust {k_eta[2][2]:.2f} N/m, "
        f"{k_eta[2][5]:.2f} N s/m",
        highlight=False,
    )


def _print_integral(integral: Sequence[IntegralLoop]) -> None:
    from trueflight.models.terminal import Table

    table = Table(title="with integral (lqr_integral), a constant disturbance and the distance to lqr, 1 m")
    for heading in ("loop", "gone after", "peak", "step, rms", "translation, rms"):
        table.add_column(heading, justify="left" if heading == "loop" else "right")
    for i in integral:
        table.add_row(
            f"{i.loop.name} + i",
            f"{i.removal:.1f} s of {i.allowed:.1f} s",
            f"{100 * i.peak:.0f} % of lqr's",
            f"{100 * i.step_distance:.1f} cm",
            f"{100 * i.translation_distance:.1f} cm",
        )
    console.print(table)


def _poles(poles: tuple[complex, ...]) -> str:
    words = [
        f"{p.real:.1f}" if abs(p.imag) < 1e-6 else f"{p.real:.1f} ± {abs(p.imag):.1f}i"
        for p in poles
        if p.imag >= -1e-6
    ]
    return ", ".join(words)
