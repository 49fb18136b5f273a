"""Every target of `model export`, by name."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from trueflight.groundstation.export import (
    crazyflow_params,
    gazebo_sdf,
    mujoco_mjcf,
    px4_params,
    rotorpy_params,
)
from trueflight.groundstation.export.target import Known, Target, Written
from trueflight.models.errors import InputError
from trueflight.models.model import Model
from trueflight.models.whole_file import write_whole


def _for_a_solver(model: Model, known: Known, solver: str) -> Written:
    from trueflight.groundstation.export.solver_code import write  # SymPy, which the others need not wait for

    return write(model, known, solver)


TARGETS: dict[str, Target] = {
    target.name: target
    for target in (
        mujoco_mjcf.TARGET,
        rotorpy_params.TARGET,
        crazyflow_params.TARGET,
        gazebo_sdf.TARGET,
        px4_params.TARGET,
        px4_params.SIH_TARGET,
        Target("casadi", "CasADi", ".py", partial(_for_a_solver, solver="casadi")),
        Target("sympy", "SymPy", ".py", partial(_for_a_solver, solver="sympy")),
    )
}


def target_named(name: str) -> Target:
    """A target by name; raises `InputError` with the names for any other."""
    if name not in TARGETS:
        raise InputError(f"--to {name}: no such target; there are onnx, c, {', '.join(TARGETS)}")
    return TARGETS[name]


def export(model: Model, to: str, output: Path, known: Known) -> Written:
    """Write the file of the target named `to`, whole or not at all, and return what it says of each effect.

    Raises `InputError` for an unknown target, an output that does not end as its files do, numbers without sense, a
    vehicle that lacks what the target needs, and where the file cannot be written.
    """
    target = target_named(to)
    for what, value, most in (
        ("hover speed, rad/s,", known.hover_speed, 1e5),
        ("torque length, m,", known.torque_length, 1.0),
    ):
        if value is not None and not 0.0 < value <= most:
            raise InputError(f"{what} of {value:g}: must be above 0 and at most {most:g}")
    if output.suffix and output.suffix != target.ending:
        raise InputError(f"{output}: {target.title} wants {target.ending}; choose another name")
    written = target.write(model, known)
    write_whole(output, written.text, "the export", "choose another -o")
    return written
