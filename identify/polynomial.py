"""Static characteristics that are sums of powers: the common case, and one that can be compiled.

    N(w) = Σ_d c_d w^d + b w|w|,        d = 1, 2, …

Coefficients are numbers or Duals, or either with one row a run, (runs, 1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.dual import Dual

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Polynomial:
    """N(w), called with time samples (runs, samples); `coefficients` by rising power from w¹."""

    coefficients: tuple[Any, ...]
    bent: Any = None  # the coefficient b of w|w|; None: no such term

    def plus(self, powers: Sequence[int], coefficients: Sequence[Any]) -> "Polynomial":
        """The same with more of some powers."""
        total: list[Any] = list(self.coefficients)
        total += [0.0] * (max(powers) - len(total))
        for d, c in zip(powers, coefficients, strict=True):
            total[d - 1] = total[d - 1] + c
        return Polynomial(tuple(total), self.bent)

    def bending(self, b: Any) -> "Polynomial":
        """The same with b w|w| more."""
        return Polynomial(self.coefficients, b if self.bent is None else b + self.bent)

    def table(self, rows: int) -> FloatArray:
        """Plain values (rows, degree + 1): b first, then c_1, c_2, …"""
        columns = [0.0 if self.bent is None else self.bent, *self.coefficients]
        out = np.empty((rows, len(columns)))
        for j, c in enumerate(columns):
            plain = dual.value(c)
            out[:, j] = plain[:, 0] if plain.ndim == 2 else plain
        return out

    def __call__(self, w: Any) -> Any:
        x = dual.value(w)
        value, slope = self.curve(x)
        return dual.chain(value, (slope, w), *self.terms(x))

    def terms(self, x: FloatArray) -> list[tuple[FloatArray, Dual]]:
        """N's partial derivatives at time samples by those coefficients that carry derivatives,
        with these coefficients."""
        out: list[tuple[FloatArray, Dual]] = []
        if isinstance(self.bent, Dual):
            out.append((x * np.abs(x), self.bent))
        power = x
        for c in self.coefficients:
            if isinstance(c, Dual):
                out.append((power, c))
            power = power * x
        return out

    def curve(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """N and N′ at time samples."""
        total: Any = 0.0  # Horner's scheme from the highest degree down
        slope: Any = 0.0
        for d, c in reversed(list(enumerate(map(dual.value, self.coefficients), start=1))):
            total = total * x + c
            slope = slope * x + d * c
        value = total * x
        if self.bent is not None:
            size = np.abs(x)
            value = value + dual.value(self.bent) * x * size
            slope = slope + 2.0 * dual.value(self.bent) * size
        return value, slope
