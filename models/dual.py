"""Arrays that carry their derivatives: what an effect's formula does, and how much more it would do with other numbers.

Forward differentiation (Griewank and Walther, "Evaluating Derivatives", 2008, chapter 3): every number is a value
together with its slopes along so many parameters. A formula asks `array_api_compat.array_namespace` for its functions
and gets those of this module for a `Dual`. A slope that is nothing is None and costs nothing: a graph that torch traces
through it holds what matters alone, for any number of samples, which `torch.func.jvp` does not give.
Raises `NoSlope` for a function that has no derivative here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from array_api_compat import array_namespace

Slopes = tuple[Any, ...]
"""Derivatives along each parameter, arrays of the value's shape or one number; None where there is none."""


class NoSlope(AttributeError):
    """A formula asked for something that has no derivative here."""


class Dual:
    """An array of any library with its `slopes`. Operators act element by element, with plain arrays, too."""

    __array_ufunc__ = None  # numpy's arrays leave the operators to this class

    def __init__(self, value: Any, slopes: Slopes) -> None:
        self.value, self.slopes = value, slopes

    def __array_namespace__(self, api_version: str | None = None) -> Functions:
        """The functions that go with it."""
        return Functions(array_namespace(self.value))

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each axis."""
        return tuple(self.value.shape)

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def dtype(self) -> Any:
        """That of the values."""
        return self.value.dtype

    def _each(self, of: Callable[[Any], Any]) -> Dual:
        """Something that is linear, done to value and slopes alike."""
        return Dual(of(self.value), tuple(None if s is None else of(s) for s in self.slopes))

    def scaled(self, value: Any, slope: Any) -> Dual:
        """A function of it by the chain rule: its value, and its derivative at the value."""
        return Dual(value, tuple(None if s is None else slope * s for s in self.slopes))

    def __getitem__(self, key: Any) -> Dual:
        return self._each(lambda x: x if isinstance(x, float) else x[key])

    def __iter__(self) -> Iterator[Dual]:
        return (self[i] for i in range(self.shape[0]))

    def __neg__(self) -> Dual:
        return self._each(lambda x: -x)

    def __add__(self, other: Any) -> Dual:
        if not isinstance(other, Dual):
            return Dual(self.value + other, self.slopes)
        pairs = zip(self.slopes, other.slopes, strict=True)
        return Dual(self.value + other.value, tuple(_sum(a, b) for a, b in pairs))

    def __sub__(self, other: Any) -> Dual:
        if not isinstance(other, Dual):
            return Dual(self.value - other, self.slopes)
        pairs = zip(self.slopes, other.slopes, strict=True)
        return Dual(self.value - other.value, tuple(_difference(a, b) for a, b in pairs))

    def __rsub__(self, other: Any) -> Dual:
        return Dual(other - self.value, tuple(None if s is None else -s for s in self.slopes))

    def __mul__(self, other: Any) -> Dual:
        if not isinstance(other, Dual):
            return self._each(lambda x: x * other)
        slopes = (
            _sum(None if a is None else a * other.value, None if b is None else b * self.value)
            for a, b in zip(self.slopes, other.slopes, strict=True)
        )
        return Dual(self.value * other.value, tuple(slopes))

    def __truediv__(self, other: Any) -> Dual:
        if not isinstance(other, Dual):
            return self._each(lambda x: x / other)
        inverse = 1.0 / other.value
        return self * other.scaled(inverse, -(inverse * inverse))

    def __rtruediv__(self, other: Any) -> Dual:
        inverse = 1.0 / self.value
        return self.scaled(inverse, -(inverse * inverse)) * other

    def __pow__(self, power: Any) -> Dual:
        if isinstance(power, Dual):
            raise NoSlope("an exponent that is itself learnt")
        return self.scaled(self.value**power, power * self.value ** (power - 1))

    def __lt__(self, other: Any) -> Any:
        return self.value < _plain(other)

    def __le__(self, other: Any) -> Any:
        return self.value <= _plain(other)

    def __gt__(self, other: Any) -> Any:
        return self.value > _plain(other)

    def __ge__(self, other: Any) -> Any:
        return self.value >= _plain(other)

    __radd__, __rmul__ = __add__, __mul__


def parameters(columns: Sequence[Any]) -> list[Dual]:
    """Numbers of their own, each with a slope of 1 along itself: plain arrays of one shape in, duals out."""
    count = len(columns)
    return [Dual(one, tuple(1.0 if i == k else None for i in range(count))) for k, one in enumerate(columns)]


def fixed(column: Any, count: int) -> Any:
    """An array that none of `count` parameters changes; formulas that begin from it know how to take duals."""
    return Dual(column, (None,) * count)


def _sum(a: Any, b: Any) -> Any:
    return b if a is None else a if b is None else a + b


def _difference(a: Any, b: Any) -> Any:
    return a if b is None else -b if a is None else a - b


def _plain(x: Any) -> Any:
    return x.value if isinstance(x, Dual) else x


class Functions:
    """The functions of `Dual`, by their names in the Array API standard; `xp` is the namespace of the values."""

    __name__ = __name__  # which libraries ask for
    pi = math.pi

    def __init__(self, xp: Any) -> None:
        self._xp = xp

    def __getattr__(self, name: str) -> Callable[..., Any]:
        known = _SLOPES.get(name)
        if known is None:
            raise NoSlope(f"xp.{name}")
        xp = self._xp

        def function(x: Any) -> Any:
            if not isinstance(x, Dual):
                return getattr(xp, name)(x)
            value = getattr(xp, name)(x.value)
            return x.scaled(value, known(xp, x.value, value))

        return function

    def asarray(self, x: Any, **options: Any) -> Any:
        """As it is, or an array of the values' library."""
        return x if isinstance(x, Dual) else self._xp.asarray(x, **options)

    def zeros_like(self, x: Any, **options: Any) -> Any:
        """Plain zeros."""
        return self._xp.zeros_like(_plain(x), **options)

    def ones_like(self, x: Any, **options: Any) -> Any:
        """Plain ones."""
        return self._xp.ones_like(_plain(x), **options)

    def stack(self, arrays: Sequence[Any], axis: int = 0) -> Any:
        """Arrays beside each other along a new axis."""
        duals = [one for one in arrays if isinstance(one, Dual)]
        if not duals:
            return self._xp.stack(arrays, axis=axis)
        values = [_plain(one) for one in arrays]
        slopes: list[Any] = []
        for k in range(len(duals[0].slopes)):
            parts = [one.slopes[k] if isinstance(one, Dual) else None for one in arrays]
            if all(part is None for part in parts):
                slopes.append(None)
                continue
            filled = [
                0.0 * value + (part or 0.0) if part is None or isinstance(part, float) else part
                for part, value in zip(parts, values, strict=True)
            ]
            slopes.append(self._xp.stack(filled, axis=axis))
        return Dual(self._xp.stack(values, axis=axis), tuple(slopes))

    def sum(self, x: Any, axis: int | None = None) -> Any:
        """Sum along an axis."""
        sums = self._xp.sum
        return x._each(lambda one: sums(one, axis=axis)) if isinstance(x, Dual) else sums(x, axis=axis)

    def where(self, condition: Any, one: Any, other: Any) -> Any:
        """One where the condition holds, the other elsewhere."""
        xp = self._xp
        a, b = _plain(one), _plain(other)
        value = xp.where(condition, a, b)
        duals = [x for x in (one, other) if isinstance(x, Dual)]
        if not duals:
            return value
        nothing = (None,) * len(duals[0].slopes)
        slopes = []
        sides = (
            (one.slopes if isinstance(one, Dual) else nothing),
            (other.slopes if isinstance(other, Dual) else nothing),
        )
        for p, q in zip(*sides, strict=True):
            none = p is None and q is None
            zero = 0.0 * value
            slopes.append(
                None if none else xp.where(condition, zero if p is None else p, zero if q is None else q)
            )
        return Dual(value, tuple(slopes))

    def clip(self, x: Any, low: Any = None, high: Any = None, /, *, min: Any = None, max: Any = None) -> Any:
        """Kept between plain numbers; beyond them it has no slope."""
        low, high = min if low is None else low, max if high is None else high
        value = self._xp.clip(_plain(x), low, high)
        if not isinstance(x, Dual):
            return value
        if isinstance(low, Dual) or isinstance(high, Dual):
            raise NoSlope("xp.clip between learnt bounds")
        if all(s is None for s in x.slopes):
            return Dual(value, x.slopes)
        inside = None
        for bound, kept in (
            (low, x.value > low if low is not None else None),
            (high, x.value < high if high is not None else None),
        ):
            if bound is not None:
                inside = kept if inside is None else inside & kept
        if inside is None:
            return Dual(value, x.slopes)
        xp = self._xp
        slopes = (None if s is None else xp.where(inside, s, 0.0 * s) for s in x.slopes)
        return Dual(value, tuple(slopes))

    def minimum(self, a: Any, b: Any) -> Any:
        """The smaller."""
        return self.where(_plain(a) < _plain(b), a, b)

    def maximum(self, a: Any, b: Any) -> Any:
        """The greater."""
        return self.where(_plain(a) > _plain(b), a, b)


_SLOPES: dict[str, Callable[[Any, Any, Any], Any]] = {
    "sqrt": lambda xp, x, root: 0.5 / root,
    "exp": lambda xp, x, power: power,
    "log": lambda xp, x, value: 1.0 / x,
    "sin": lambda xp, x, value: xp.cos(x),
    "cos": lambda xp, x, value: -xp.sin(x),
    "asin": lambda xp, x, value: 1.0 / xp.sqrt(1.0 - x * x),
    "tanh": lambda xp, x, value: 1.0 - value * value,
    "abs": lambda xp, x, value: xp.sign(x),
    "square": lambda xp, x, value: 2.0 * x,
}
"""Derivative of each function: of the namespace, the argument and the value."""
