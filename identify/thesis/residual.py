"""Residual dynamics in the three places of Fig. 5.5, and the error over two of their parameters.

Where the two-mode structure is too poor, the thesis filters signals with an arbitrary system and
looks for the parameters with the least identification error (Section 5.4):

    actuation   u_a passes the filter before the input dynamics
    feedback    Yf passes it before the nonlinearity
    forward     what drives the forward path passes it, flame and input alike

A small error says that the filter helps the balance, not that it is physical: Table 5.4's second
mode is at 94 Hz with a damping of 0.9.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from identify.thesis.balance import BalanceFit, flame_signal, solve
from identify.thesis.runs import EntrainedRuns

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
Place = Literal["actuation", "feedback", "forward"]


@dataclass(frozen=True)
class ResidualDynamics:
    """A filter of complex zeros and poles, (frequency in Hz, damping) each, and real poles in Hz.

    Unit gain at zero frequency; a negative damping is a root in the right half plane.
    """

    place: Place
    zeros: tuple[tuple[float, float], ...] = ()
    poles: tuple[tuple[float, float], ...] = ()
    lowpass_hz: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.place not in get_args(Place):
            raise ValueError(f"place={self.place!r} is not one of {get_args(Place)}")

    def response(self, s: ComplexArray) -> ComplexArray:
        """The filter at s, same shape."""
        out = np.ones_like(s)
        for frequency, damping in self.zeros:
            out = out * _pair(s, frequency, damping)
        for frequency, damping in self.poles:
            out = out / _pair(s, frequency, damping)
        for pole in self.lowpass_hz:
            out = out / (1 + s / (2 * np.pi * pole))
        return np.asarray(out)


def _pair(s: ComplexArray, frequency_hz: float, damping: float) -> ComplexArray:
    x = s / (2 * np.pi * frequency_hz)
    return np.asarray(x**2 + 2 * damping * x + 1)


def with_residuals(
    runs: EntrainedRuns,
    flame_pole_hz: float,
    residuals: Sequence[ResidualDynamics],
    retained: int | None = None,
    modes: int = 2,
) -> BalanceFit:
    """Closed-loop identification with residual dynamics at their places."""
    filters = {place: np.ones_like(runs.s) for place in get_args(Place)}
    for r in residuals:
        filters[r.place] = filters[r.place] * r.response(runs.s)
    signal = flame_signal(runs, flame_pole_hz, 1.0, retained, filters["feedback"])
    return solve(
        runs,
        flame_pole_hz,
        signal,
        forward=filters["forward"],
        actuation=filters["actuation"],
        modes=modes,
    )


@dataclass(frozen=True)
class Surface:
    """Identification error (n, m) over two parameters, (n,) and (m,) values."""

    first: FloatArray
    second: FloatArray
    errors: FloatArray

    @property
    def best(self) -> tuple[float, float]:
        """The two values of least error."""
        i, j = np.unravel_index(int(np.argmin(self.errors)), self.errors.shape)
        return float(self.first[i]), float(self.second[j])


def error_surface(
    runs: EntrainedRuns,
    flame_pole_hz: float,
    residuals: Callable[[float, float], Sequence[ResidualDynamics]],
    first: Sequence[float] | FloatArray,
    second: Sequence[float] | FloatArray,
    retained: int | None = None,
) -> Surface:
    """The error over a grid of two parameters (Fig. 5.6).

    `residuals` builds the dynamics from the two, wherever they stand: two parameters of one
    filter, or one each of filters at two places.
    """
    a, b = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    errors = [
        [with_residuals(runs, flame_pole_hz, residuals(p, q), retained).error for q in b.tolist()]
        for p in a.tolist()
    ]
    return Surface(a, b, np.array(errors))
