"""Searches over what the balance must be told: the flame's pole, the feedback's gain.

Section 4.7.1: the balance is solved for each assumed value; where the identification error is
least, the assumption is taken for true (Figs. 4.11 and 4.12). The thesis finds the error blind to
the gain (Fig. 4.13), though its Tables 4.5 and 4.6 differ threefold. With Yf of all harmonics and
the forward path's zeros specified, the open-loop error has a sharp minimum at the true gain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.thesis.balance import BalanceFit, Feedback, closed_loop, open_loop
from identify.thesis.runs import EntrainedRuns

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Search:
    """Assumed values, (n,), and the solution for each."""

    values: FloatArray
    fits: tuple[BalanceFit, ...]

    @property
    def errors(self) -> FloatArray:
        return np.array([f.error for f in self.fits])

    @property
    def best(self) -> int:
        """Index of the least error."""
        return int(np.argmin(self.errors))

    def mode(self, index: int) -> FloatArray:
        """(n, 2): frequency in Hz and damping of pair `index`; NaN where roots are no pair."""
        blank = (float("nan"), float("nan"))
        return np.array([f.modes[index] if len(f.modes) > index else blank for f in self.fits])


def search_flame_pole(
    runs: EntrainedRuns, poles_hz: Sequence[float] | FloatArray, retained: int | None = None
) -> Search:
    """Closed-loop identification for each assumed flame pole (Figs. 4.11, 4.12)."""
    values = np.asarray(poles_hz, dtype=float)
    return Search(values, tuple(closed_loop(runs, float(p), retained) for p in values))


def search_gain(
    runs: EntrainedRuns,
    gains: Sequence[float] | FloatArray,
    flame_pole_hz: float,
    feedback: Feedback,
    retained: int | None = None,
) -> Search:
    """Open-loop identification for each specified gain N₁ (Fig. 4.13)."""
    values = np.asarray(gains, dtype=float)
    fits = (open_loop(runs, flame_pole_hz, float(g), feedback, retained) for g in values)
    return Search(values, tuple(fits))
