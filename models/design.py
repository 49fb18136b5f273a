"""The design file: the gains of the linear cascade, as the ground computed them for one vehicle."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.models.errors import InputError
from trueflight.models.outside import is_number, json_object, numbers, read_text, shown
from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.models.whole_file import write_whole

Matrix = tuple[tuple[float, ...], ...]

_MAKE_ONE = "make one with `groundstation design`"
_LARGEST_GAIN = 1e6
"""No gain of a vehicle comes near it, and eigenvalues overflow long after it."""
_MASS_TOLERANCE = 0.01
"""Relative difference of mass up to which a design still belongs to a vehicle: the rounding of a scale."""


@dataclass(frozen=True)
class IntegralGains:
    """Gains of the position loop with an integral, the paper's third controller.

    `u = -K_eta eta - K_i integral(xi - xi_ref) dt + inv(A_zeta) x2ref_dot`, heading frame: `K_eta` (3, 6) as in
    `Design`, `K_i` (3, 3) maps the integral (m s) to `(phi, theta, T)` in rad, rad, N.
    """

    K_eta: Matrix
    K_i: Matrix


@dataclass(frozen=True)
class Design:
    """Gains of the paper's cascade, (13) and (16), with what gave them.

    `K_zeta` (3, 3) in 1/s maps the attitude error (roll, pitch, yaw; rad) to body rates. `K_eta` (3, 6) maps
    `(xi - xi_ref, v - v_ref)` in the heading frame (m, m/s) to `(phi, theta, T)` in rad, rad, N. `weights`
    holds the LQR weights Q and R of both loops, `rate` is the control rate in Hz they were chosen for, `mass`
    in kg is that of the vehicle. `integral` is the position loop of the controller `lqr_integral`, where the
    design has one; it shares the attitude loop.
    """

    vehicle: str
    mass: float
    K_zeta: Matrix
    K_eta: Matrix
    weights: dict[str, Any] = field(default_factory=dict)
    rate: float = 100.0
    created_by: str = ""
    integral: IntegralGains | None = None

    def check(self, vehicle: Vehicle, where: str = "design") -> None:
        """Raise `InputError` where the design belongs to another vehicle (by name or mass)."""
        if self.vehicle != vehicle.name:
            raise InputError(
                f"{where}: made for vehicle '{self.vehicle}', not '{vehicle.name}'; "
                "run `groundstation design` for it"
            )
        if abs(self.mass - vehicle.mass) > _MASS_TOLERANCE * vehicle.mass:
            raise InputError(
                f"{where}: made for {self.mass:g} kg, the vehicle file says {vehicle.mass:g} kg; "
                "run `groundstation design` again"
            )


def hover_input_matrix(mass: float) -> np.ndarray:
    """`A_zeta` (3, 3) of (9) for a `mass` in kg: acceleration in the heading frame of (phi, theta, T - m g)."""
    return np.array([[0.0, GRAVITY, 0.0], [-GRAVITY, 0.0, 0.0], [0.0, 0.0, 1.0 / mass]])


def save_design(design: Design, path: str | Path) -> None:
    """Write a design file (JSON), whole or not at all. Raises `InputError` where it cannot be written."""
    write_whole(path, design_to_json(design), "the design", "choose another -o")


def design_to_json(design: Design) -> str:
    """The text of a design file."""
    table = asdict(design)
    if design.integral is None:
        del table["integral"]
    return json.dumps(table, indent=1) + "\n"


def load_design(path: str | Path, vehicle: Vehicle | None = None) -> Design:
    """Read and check a design file (and that it belongs to `vehicle`, where given). Raises `InputError`."""
    design = design_from_json(read_text(Path(path), "the design file", _MAKE_ONE), str(path))
    if vehicle is not None:
        design.check(vehicle, str(path))
    return design


def design_from_json(text: str, where: str = "design") -> Design:
    """Check the text of a design file; `where` names it in error messages."""
    table = json_object(text, where, _MAKE_ONE)
    known = {f.name for f in fields(Design)}
    for key in table:
        if key not in known:
            raise InputError(f"{where}: unknown key {shown(key)}; known keys: {', '.join(sorted(known))}")
    for key in ("vehicle", "mass", "K_zeta", "K_eta"):
        if key not in table:
            raise InputError(f"{where}: '{key}' is missing; make the file again with `groundstation design`")
    if not isinstance(table["vehicle"], str) or not isinstance(table.get("created_by", ""), str):
        raise InputError(f"{where}: 'vehicle' and 'created_by' must be texts")
    if not isinstance(table.get("weights", {}), dict):
        raise InputError(f"{where}: 'weights' must be an object")
    design = Design(
        vehicle=table["vehicle"],
        mass=_positive(where, "mass", table["mass"]),
        K_zeta=_matrix(where, "K_zeta", table["K_zeta"], (3, 3)),
        K_eta=_matrix(where, "K_eta", table["K_eta"], (3, 6)),
        weights=table.get("weights", {}),
        rate=_positive(where, "rate", table.get("rate", 100.0)),
        created_by=table.get("created_by", ""),
        integral=_integral(where, table.get("integral")),
    )
    _check_stability(design, where)
    return design


def _integral(where: str, table: object) -> IntegralGains | None:
    if table is None:
        return None
    if not isinstance(table, dict) or set(table) != {"K_eta", "K_i"}:
        raise InputError(f"{where}: 'integral' must be an object with K_eta and K_i, and nothing else")
    return IntegralGains(
        _matrix(where, "integral.K_eta", table["K_eta"], (3, 6)),
        _matrix(where, "integral.K_i", table["K_i"], (3, 3)),
    )


def _positive(where: str, key: str, value: object) -> float:
    if not is_number(value) or value <= 0:  # type: ignore[operator]
        raise InputError(f"{where}: '{key}' must be a positive number, not {shown(value)}")
    return float(value)  # type: ignore[arg-type]


def _matrix(where: str, key: str, value: object, shape: tuple[int, int]) -> Matrix:
    matrix = numbers(value, shape)
    if matrix is None or np.any(np.abs(matrix) > _LARGEST_GAIN):
        raise InputError(f"{where}: '{key}' must be {shape[0]} rows of {shape[1]} finite numbers")
    return tuple(tuple(float(x) for x in row) for row in matrix)


def _check_stability(design: Design, where: str) -> None:
    """Every loop of the linear design must be stable, or the file has a wrong sign or a wrong row order."""
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    b = np.vstack([np.zeros((3, 3)), hover_input_matrix(design.mass)])
    loops = {"K_zeta": -np.array(design.K_zeta), "K_eta": a - b @ np.array(design.K_eta)}
    if design.integral is not None:
        # Nine states: the integral of the position error drives the position loop too.
        closed = np.zeros((9, 9))
        closed[:6, :6] = a - b @ np.array(design.integral.K_eta)
        closed[:6, 6:], closed[6:, :3] = -b @ np.array(design.integral.K_i), np.eye(3)
        loops["integral"] = closed
    for key, closed in loops.items():
        try:
            slowest = float(np.linalg.eigvals(closed).real.max())
        except np.linalg.LinAlgError:
            raise InputError(f"{where}: mass or {key} is beyond all sense; {_MAKE_ONE}") from None
        if slowest >= 0.0:
            raise InputError(
                f"{where}: {key} gives an unstable loop (a pole at {slowest:+.3g} 1/s); "
                "check signs and row order"
            )
