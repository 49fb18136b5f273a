"""Arrays of SymPy expressions that formulas take for arrays: what an effect does, written down.

An effect asks `array_api_compat.array_namespace` for its functions, and gets those of this module for a `Symbolic`.
Raises `NoSymbol` for a function that has no form here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import sympy


class NoSymbol(AttributeError):
    """A formula asked for something that has no form in symbols."""


class Symbolic:
    """An array of expressions of any shape. Operators act element by element, with numbers and with each other."""

    __array_ufunc__ = None  # numpy's numbers leave the operators to this class

    def __init__(self, values: Any) -> None:
        self.values: np.ndarray = np.asarray(_bare(values), dtype=object)

    def __array_namespace__(self, api_version: str | None = None) -> Namespace:
        """The functions that go with it."""
        return NAMESPACE

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each axis."""
        return self.values.shape

    @property
    def dtype(self) -> Any:
        """A double's: formulas may ask, and make numbers of it."""
        return np.dtype(float)

    @property
    def T(self) -> Symbolic:
        """With its axes turned round."""
        return Symbolic(self.values.T)

    def __iter__(self) -> Iterator[Symbolic]:
        return (Symbolic(one) for one in self.values)

    def __getitem__(self, key: Any) -> Symbolic:
        return Symbolic(self.values[key])

    def __neg__(self) -> Symbolic:
        return Symbolic(-self.values)

    def __add__(self, other: Any) -> Symbolic:
        return Symbolic(self.values + _bare(other))

    def __sub__(self, other: Any) -> Symbolic:
        return Symbolic(self.values - _bare(other))

    def __rsub__(self, other: Any) -> Symbolic:
        return Symbolic(_bare(other) - self.values)

    def __mul__(self, other: Any) -> Symbolic:
        return Symbolic(self.values * _bare(other))

    def __truediv__(self, other: Any) -> Symbolic:
        return Symbolic(self.values / _bare(other))

    def __rtruediv__(self, other: Any) -> Symbolic:
        return Symbolic(_bare(other) / self.values)

    def __pow__(self, other: Any) -> Symbolic:
        power = _rational(_bare(other))
        return Symbolic(self.values**power)

    __radd__, __rmul__ = __add__, __mul__

    def __lt__(self, other: Any) -> Symbolic:
        return _each(sympy.Lt, self, other)

    def __le__(self, other: Any) -> Symbolic:
        return _each(sympy.Le, self, other)

    def __gt__(self, other: Any) -> Symbolic:
        return _each(sympy.Gt, self, other)

    def __ge__(self, other: Any) -> Symbolic:
        return _each(sympy.Ge, self, other)


def _bare(value: Any) -> Any:
    return value.values if isinstance(value, Symbolic) else value


def _rational(power: Any) -> Any:
    """Half as a fraction, so that a root stays a root."""
    return sympy.nsimplify(power) if isinstance(power, float) else power


def _each(function: Callable[..., Any], *arguments: Any) -> Symbolic:
    """A function of expressions, element by element."""
    arrays = np.broadcast_arrays(*(np.asarray(_bare(one), dtype=object) for one in arguments))
    out = np.empty(arrays[0].shape, dtype=object)
    for index in np.ndindex(out.shape):
        out[index] = function(*(array[index] for array in arrays))
    return Symbolic(out)


def _clip(x: Any, low: Any = None, high: Any = None, /, *, min: Any = None, max: Any = None) -> Symbolic:
    low, high = min if low is None else low, max if high is None else high
    out = Symbolic(x)
    if low is not None:
        out = _each(sympy.Max, out, low)
    return out if high is None else _each(sympy.Min, out, high)


def _where(condition: Any, one: Any, other: Any) -> Symbolic:
    return _each(lambda c, a, b: sympy.Piecewise((a, c), (b, True)), condition, one, other)


def _stack(arrays: Sequence[Any], axis: int = 0) -> Symbolic:
    shape = np.broadcast_shapes(*(np.shape(_bare(one)) for one in arrays))
    whole = [np.broadcast_to(np.asarray(_bare(one), dtype=object), shape) for one in arrays]
    return Symbolic(np.stack(whole, axis=axis))


def _sum(x: Any, axis: int | None = None) -> Symbolic:
    return Symbolic(np.sum(_bare(x), axis=axis))


def _constant(value: float) -> Callable[..., Symbolic]:
    return lambda x, **_: Symbolic(np.full(np.shape(_bare(x)), value, dtype=object))


class Namespace:
    """The functions of `Symbolic`, by their names in the Array API standard."""

    __name__ = __name__  # which libraries ask for
    pi = float(np.pi)
    float64 = float32 = np.dtype(float)
    clip, where, stack = staticmethod(_clip), staticmethod(_where), staticmethod(_stack)
    sum = staticmethod(_sum)
    zeros_like, ones_like = staticmethod(_constant(0.0)), staticmethod(_constant(1.0))

    def __getattr__(self, name: str) -> Callable[..., Symbolic]:
        known = _FUNCTIONS.get(name)
        if known is None:
            raise NoSymbol(f"xp.{name}")
        return lambda *arguments: _each(known, *arguments)

    @staticmethod
    def asarray(x: Any, **_: Any) -> Symbolic:
        """An array of a number, or of an array."""
        return Symbolic(x)


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{
        name: getattr(sympy, name)
        for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh")
    },
    **{name: getattr(sympy, name) for name in ("asin", "acos", "atan", "atan2", "sign", "floor")},
    "abs": sympy.Abs,
    "square": lambda x: x**2,
    "pow": lambda x, power: x ** _rational(power),
    "minimum": sympy.Min,
    "maximum": sympy.Max,
    "multiply": lambda a, b: a * b,
    "add": lambda a, b: a + b,
}
NAMESPACE = Namespace()
