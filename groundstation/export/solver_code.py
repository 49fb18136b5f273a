"""CasADi and SymPy: the equations of motion as a Python file that needs one of them and nothing else.

The file has the names and values of everything and one function, `derivative`, written with the solver's own `sqrt`,
`Max` and so on, so that it can be read, cut down and differentiated. Frames and units as in `equations`.
"""

from __future__ import annotations

import json
from typing import Any

import sympy
from sympy.printing.str import StrPrinter

from trueflight.groundstation.export.equations import Equations, equations
from trueflight.groundstation.export.target import Known, Written, airframe_of, header
from trueflight.groundstation.export.words import hash_comment
from trueflight.models.model import Model

_SINGLE = ("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "atan2")
_MORE = ("sinh", "cosh", "tanh", "sign", "floor")
_IMPORTS = {
    "casadi": "from casadi import SX, Function, vertcat, vertsplit\n"
    f"from casadi import {', '.join(_SINGLE)}, {', '.join(_MORE)}, fabs as Abs, fmax, fmin, if_else\n",
    "sympy": "from sympy import Matrix, Piecewise, symbols\n"
    f"from sympy import {', '.join(_SINGLE)}, {', '.join(_MORE)}, Abs, Max as fmax, Min as fmin\n\n\n"
    "def if_else(condition, one, other):\n    return Piecewise((one, condition), (other, True))\n",
}
_ENDS = {
    "casadi": '''
def model():
    """`f(x, u, p)` to the derivative of x, as a CasADi function; p in the order of PARAMETERS."""
    x, u, p = SX.sym("x", len(STATE)), SX.sym("u", len(INPUTS)), SX.sym("p", max(len(PARAMETERS), 1))
    xdot = vertcat(*derivative(vertsplit(x), vertsplit(u), vertsplit(p)[: len(PARAMETERS)]))
    return Function(NAME, [x, u, p], [xdot], ["x", "u", "p"], ["xdot"])
''',
    "sympy": '''
def model():
    """State, inputs and parameters as symbols, and the derivative of the state as a matrix of them."""
    x, u = symbols(STATE, real=True), symbols(INPUTS, real=True)
    p = symbols(tuple(PARAMETERS), real=True)
    return x, u, p, Matrix(derivative(x, u, p))
''',
}


class _Printer(StrPrinter):
    """Expressions as Python, with two arguments to each minimum and maximum, as solvers want it."""

    def _print_Max(self, expr: Any) -> str:
        return self._two("fmax", expr.args)

    def _print_Min(self, expr: Any) -> str:
        return self._two("fmin", expr.args)

    def _two(self, name: str, arguments: Any) -> str:
        first, *rest = map(self._print, arguments)
        for other in rest:
            first = f"{name}({first}, {other})"
        return first

    def _print_Piecewise(self, expr: Any) -> str:
        *early, (last, _) = expr.args
        out = self._print(last)
        for value, condition in reversed(early):
            out = f"if_else({self._print(condition)}, {self._print(value)}, {out})"
        return out

    def _print_Rational(self, expr: Any) -> str:
        return f"({expr.p}/{expr.q})"

    def _print_Float(self, expr: Any) -> str:
        return repr(float(expr))


def write(model: Model, known: Known, solver: str) -> Written:
    """The equations of a model as Python for a `solver`. Raises `InputError` where an effect cannot be traced."""
    made = equations(model)
    airframe = airframe_of(model)
    notes = []
    if airframe.delay or airframe.rate_delay:
        notes.append(
            f"delays are not in it: {1e3 * airframe.delay:.3g} ms of the thrust command, "
            f"{1e3 * airframe.rate_delay:.3g} ms of the rates; shift the inputs by them"
        )
    said = header(model, made.lines, tuple(notes))
    return Written(_module(model, made, said, solver), made.lines, tuple(notes))


def _module(model: Model, made: Equations, said: tuple[str, ...], solver: str) -> str:
    printer = _Printer()
    shared, results = sympy.cse(list(made.derivative), symbols=sympy.numbered_symbols("c"), order="none")
    steps = "".join(f"    {name} = {printer.doprint(value)}\n" for name, value in shared)
    values = "".join(f"        {printer.doprint(value)},\n" for value in results)
    parameters = "".join(
        f"    {json.dumps(str(name))}: {value!r},\n" for name, value in made.parameters.items()
    )
    return f'''{hash_comment(said)}{_IMPORTS[solver]}
NAME = {json.dumps("".join(c if c.isascii() and c.isalnum() else "_" for c in "model_" + model.vehicle.name))}
# m and m/s in the world (ENU), quaternion body (FLU) to world, rotor speed over hover speed, body rates in rad/s
STATE = {_names(made.state)}
# collective, 0 to 1, and body rates asked for, rad/s
INPUTS = {_names(made.inputs)}
PARAMETERS = {{
{parameters}}}


def derivative(state, inputs, parameters):
    """Derivative of the state; each argument a sequence in the order of its names."""
    {", ".join(map(str, made.state))} = state
    {", ".join(map(str, made.inputs))} = inputs
    {"".join(f"{name}, " for name in made.parameters) or "()"} = parameters
{steps}    return (
{values}    )

{_ENDS[solver]}'''


def _names(symbols: tuple[sympy.Symbol, ...]) -> str:
    return "(" + "".join(f"{json.dumps(str(one))}, " for one in symbols).rstrip() + ")"
