"""Named parameters: physical values outside, well-scaled unknowns inside.

A positive quantity (a frequency, a damping, a time) is fitted by its logarithm, so that no step
of the optimiser can make it negative; a signed one (a residue, a coefficient) as it is; an even
one (an inverse level, zero where nothing saturates) too, but the equations are even in it, and its
value is its size. Standard errors are carried through by the derivative of that map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from identify import dual

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

UNKNOWN = 1e50  # of any unit: a standard error of numbers that the data do not depend on
EDGE = 1e-6  # of a bound: what is no farther from it has been stopped there


@dataclass(frozen=True)
class Parameter:
    """One unknown: its name, unit, the range that is physically plausible, and its map.

    `lower` and `upper` bound what counts as plausible; the fit may leave the range, and the
    verdict then says so. `scale` is a typical size where the value itself may be zero.
    """

    name: str
    unit: str
    lower: float = -np.inf
    upper: float = np.inf
    kind: Literal["positive", "signed", "even"] = "signed"
    scale: float = 1.0

    def to_internal(self, value: float) -> float:
        return float(np.log(max(value, 1e-300))) if self.kind == "positive" else value / self.scale

    def plausible(self, value: float) -> bool:
        """Whether it lies in the range; a positive one, kept there by the fit, not at its edge."""
        edge = EDGE if self.kind == "positive" else 0.0
        return self.lower * (1 + edge) <= value <= self.upper * (1 - edge)


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error."""

    value: float
    stderr: float
    unit: str

    @property
    def determined(self) -> bool:
        """Whether the data depend on it at all."""
        return bool(self.stderr < UNKNOWN)

    def to_json(self) -> dict[str, Any]:
        return {
            "value": self.value,
            "stderr": float(self.stderr) if self.determined else None,
            "unit": self.unit,
        }

    def interval(self, sigmas: float = 1.96) -> tuple[float, float]:
        return self.value - sigmas * self.stderr, self.value + sigmas * self.stderr


@dataclass(frozen=True)
class ParameterSet:
    """Ordered parameters, and the conversions of whole vectors."""

    parameters: tuple[Parameter, ...]
    index: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        index = {p.name: i for i, p in enumerate(self.parameters)}
        if len(index) != len(self.parameters):
            names = [p.name for p in self.parameters]
            raise ValueError(f"parameter names {names} are not unique")
        object.__setattr__(self, "index", index)

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    def to_internal(self, values: Sequence[float] | FloatArray) -> FloatArray:
        pairs = zip(self.parameters, values, strict=True)
        return np.array([p.to_internal(float(v)) for p, v in pairs])

    def unknowns(self, values: Mapping[str, float]) -> FloatArray:
        """The vector of unknowns (p,) of physical values by name, of which there may be others."""
        return self.to_internal([values[name] for name in self.names])

    def to_physical(self, internal: FloatArray) -> FloatArray:
        """Physical values of a vector of unknowns, or of several, (…, p)."""
        signed = internal * self._mirrored(internal)
        return np.where(self._positive, np.exp(internal * self._positive), signed)

    def slopes(self, internal: FloatArray) -> FloatArray:
        """d(physical)/d(internal), (…, p)."""
        return np.where(self._positive, self.to_physical(internal), self._mirrored(internal))

    @cached_property
    def _positive(self) -> npt.NDArray[np.bool_]:
        return np.array([p.kind == "positive" for p in self.parameters], dtype=bool)

    @cached_property
    def _scales(self) -> FloatArray:
        return np.array([p.scale for p in self.parameters])

    @cached_property
    def _even(self) -> npt.NDArray[np.bool_]:
        return np.array([p.kind == "even" for p in self.parameters], dtype=bool)

    def _mirrored(self, internal: FloatArray) -> FloatArray:
        """The scales, negative where an even unknown is."""
        if not self._even.any():
            return self._scales
        return np.where(self._even & (internal < 0), -self._scales, self._scales)

    def seeded(
        self, internal: FloatArray, rows: int, extra: int = 0, only: IntArray | None = None
    ) -> dict[str, Any]:
        """Physical values as Duals, by name, for several vectors at once.

        `internal` is (vectors, p); each vector serves `rows` consecutive rows, so that values
        have shape (vectors·rows, 1). `extra` more seed columns stay free at the end. With `only`,
        of these parameters alone, a seed each in their order.
        """
        chosen = np.arange(len(self)) if only is None else only
        columns = self.columns(internal, rows)
        slopes = np.repeat(self.slopes(internal)[:, chosen], rows, axis=0)
        d = slopes[:, :, None] * np.eye(chosen.size, chosen.size + extra)
        return {
            self.names[j]: dual.Dual(columns[:, j : j + 1], d[:, i : i + 1])
            for i, j in enumerate(chosen.tolist())
        }

    def plain(self, internal: FloatArray, rows: int = 0) -> dict[str, Any]:
        """Physical values by name: floats of one vector (p,), or (vectors·rows, 1) of several."""
        if internal.ndim == 1:
            return dict(zip(self.names, self.to_physical(internal).tolist(), strict=True))
        return self.by_name(self.columns(internal, rows))

    def columns(self, internal: FloatArray, rows: int) -> FloatArray:
        """Physical values of several vectors, each for so many rows: (vectors·rows, p)."""
        return np.repeat(self.to_physical(internal), rows, axis=0)

    def by_name(self, columns: FloatArray) -> dict[str, Any]:
        """The columns (rows, 1) of physical values (rows, p), by name."""
        return {name: columns[:, j : j + 1] for j, name in enumerate(self.names)}

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Box for the unknowns: a positive quantity stays within its plausible range (where that
        is finite and not zero), a signed one is free."""
        low = np.full(len(self), -np.inf)
        high = np.full(len(self), np.inf)
        for i, p in enumerate(self.parameters):
            if p.kind == "positive":
                low[i] = np.log(p.lower) if p.lower > 0 else -60.0
                high[i] = np.log(p.upper) if np.isfinite(p.upper) else 60.0
        return low, high

    def estimates(self, internal: FloatArray, covariance: FloatArray) -> dict[str, Estimate]:
        """Values with standard errors from the internal covariance, shape (p, p)."""
        stderr = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * np.abs(self.slopes(internal))
        values = self.to_physical(internal)
        rows = zip(self.parameters, values, stderr, strict=True)
        return {p.name: Estimate(float(v), float(e), p.unit) for p, v, e in rows}
