"""Forward-mode automatic differentiation for arrays.

A `Dual` carries values of any shape and, on one more last axis, their derivatives with respect to
`p` seeds (the parameters of a fit). Every arithmetic operation applies the chain rule, so that a
transfer function written once yields its derivatives to rounding: no finite differences, no
formula written twice. Plain NumPy arrays and numbers act as constants.

Only what transfer functions and characteristics need is here: + − × ÷, powers, exp, log, sqrt,
tanh, abs of real values, real and imaginary parts, indexing and stacking.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Number = complex | float | int
Operand = Any  # Dual | Array | Number: NumPy's own operators decide which


class Dual:
    """Values `v` and derivatives `d`, with ``d.shape == v.shape + (p,)`` up to broadcasting."""

    __slots__ = ("d", "v")
    __array_priority__ = 1000  # NumPy arrays on the left defer to the reflected operators here
    __array_ufunc__ = None

    def __init__(self, v: Array | Number, d: Array) -> None:
        self.v = v if type(v) is np.ndarray else np.asarray(v)
        self.d = d

    @property
    def shape(self) -> tuple[int, ...]:
        return self.v.shape

    def __add__(self, other: Operand) -> Dual:
        if isinstance(other, Dual):
            v = self.v + other.v
            return Dual(v, _fit(self.d, v) + _fit(other.d, v))
        v = self.v + np.asarray(other)
        return Dual(v, _fit(self.d, v))

    __radd__ = __add__

    def __neg__(self) -> Dual:
        return Dual(-self.v, -self.d)

    def __sub__(self, other: Operand) -> Dual:
        if isinstance(other, Dual):
            v = self.v - other.v
            return Dual(v, _fit(self.d, v) - _fit(other.d, v))
        v = self.v - np.asarray(other)
        return Dual(v, _fit(self.d, v))

    def __rsub__(self, other: Operand) -> Dual:
        return Dual(-self.v, -self.d).__add__(other)

    def __mul__(self, other: Operand) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.v * other.v, self.d * other.v[..., None] + other.d * self.v[..., None])
        c = np.asarray(other)
        return Dual(self.v * c, self.d * c[..., None])

    __rmul__ = __mul__

    def reciprocal(self) -> Dual:
        inverse = 1.0 / self.v
        return Dual(inverse, self.d * (-inverse * inverse)[..., None])

    def __truediv__(self, other: Operand) -> Dual:
        if isinstance(other, Dual):
            return self * other.reciprocal()
        return Dual.__mul__(self, 1.0 / np.asarray(other))

    def __rtruediv__(self, other: Operand) -> Dual:
        return Dual.__mul__(self.reciprocal(), other)

    def __pow__(self, exponent: int) -> Dual:
        if exponent == 0:
            return Dual(np.ones_like(self.v), np.zeros_like(self.d))
        return Dual(self.v**exponent, self.d * (exponent * self.v ** (exponent - 1))[..., None])

    def __getitem__(self, key: Any) -> Dual:
        keys = key if isinstance(key, tuple) else (key,)
        if Ellipsis in keys:
            return Dual(self.v[keys], self.d[(*keys, slice(None))])
        return Dual(self.v[keys], self.d[keys])

    @property
    def real(self) -> Dual:
        return Dual(self.v.real, self.d.real)

    @property
    def imag(self) -> Dual:
        return Dual(self.v.imag, self.d.imag)


def _fit(d: Array, v: Array) -> Array:
    """`d` broadcast to the shape that belongs to values `v`."""
    if d.ndim == v.ndim + 1:
        return d
    return d.reshape((1,) * (v.ndim + 1 - d.ndim) + d.shape)


def value(x: Operand) -> Array:
    """The plain values of a Dual, array or number."""
    return x.v if isinstance(x, Dual) else np.asarray(x)


def column(x: Operand, rows: int) -> Array:
    """The plain values of a number or a column (rows, 1), as an array (rows,) of its own: always of
    one kind, because compiled code would be compiled again for another."""
    return np.array(np.broadcast_to(value(x), (rows, 1))[:, 0], dtype=float)


def derivative(x: Operand, shape: tuple[int, ...], seeds: int) -> Array:
    """Derivatives of shape ``shape + (seeds,)``; zeros for constants."""
    if isinstance(x, Dual):
        return np.broadcast_to(x.d, (*shape, seeds))
    return np.zeros((*shape, seeds))


def _apply(x: Operand, v: Array, slope: Array) -> Any:
    return Dual(v, x.d * slope[..., None])


def chain(v: Array, *terms: tuple[Array, Operand]) -> Any:
    """Value `v` of a function whose partial derivative by each operand is given.

    ``terms`` are pairs (∂v/∂x, x); operands that are plain numbers contribute nothing. One pass
    over the seeds instead of one an arithmetic operation.
    """
    total: Any = None
    for partial, x in terms:
        if isinstance(x, Dual):
            part = partial[..., None] * x.d
            if total is not None and total.shape == part.shape and total.dtype == part.dtype:
                total += part  # a product of its own: nobody else holds it
            else:
                total = part if total is None else total + part
    return v if total is None else Dual(v, total)


def conj(x: Operand) -> Any:
    """Complex conjugate; seeds are real."""
    return Dual(x.v.conj(), x.d.conj()) if isinstance(x, Dual) else np.conj(x)


def powers(x: Operand, count: int) -> Any:
    """x, x², …, x^count of a column (rows, 1), as (rows, count)."""
    k = np.arange(1, count + 1)
    v = value(x) ** k
    if not isinstance(x, Dual):
        return v
    return Dual(v, (k * x.v ** (k - 1))[..., None] * x.d)


def exp(x: Operand) -> Any:
    v = np.exp(value(x))
    return _apply(x, v, v) if isinstance(x, Dual) else v


def log(x: Operand) -> Any:
    v = np.log(value(x))
    return _apply(x, v, 1.0 / x.v) if isinstance(x, Dual) else v


def sqrt(x: Operand) -> Any:
    v = np.sqrt(value(x))
    return _apply(x, v, 0.5 / v) if isinstance(x, Dual) else v


def tanh(x: Operand) -> Any:
    v = np.tanh(value(x))
    return _apply(x, v, 1.0 - v * v) if isinstance(x, Dual) else v


def arctan(x: Operand) -> Any:
    v = np.arctan(value(x))
    return _apply(x, v, 1.0 / (1.0 + x.v * x.v)) if isinstance(x, Dual) else v


def sin(x: Operand) -> Any:
    return _apply(x, np.sin(x.v), np.cos(x.v)) if isinstance(x, Dual) else np.sin(x)


def cos(x: Operand) -> Any:
    return _apply(x, np.cos(x.v), -np.sin(x.v)) if isinstance(x, Dual) else np.cos(x)


def absolute(x: Operand) -> Any:
    """|x| of real values; its slope at 0 is taken as 0."""
    return _apply(x, np.abs(x.v), np.sign(x.v)) if isinstance(x, Dual) else np.abs(x)
