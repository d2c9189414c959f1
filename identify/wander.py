"""Deviations that wander in the course of a campaign, against ones drawn anew for each run.

What wanders has independent increments (Brownian motion): runs near each other in time deviate
alike. With the rows of `identify.scatter` for one direction, Z = diag(T_1 … T_R) and
C_rs = (min(t_r, t_s) − t_1)/(t_R − t_1),

    e + J δθ ~ N(0, V),    V = I + σ² Z C Zᵀ,

where C = I for what is drawn anew. The same number σ, and a likelihood that tells the two apart: a
law that follows what only wanders is up against the likelier. Where the runs were when the campaign
began is the declared model's (`identify.own`), so that t_1 may be its origin.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.fit import profiled

FloatArray = npt.NDArray[np.float64]

SMALLEST, LARGEST = 1e-8, 1.0  # σ of a ratio's logarithm that is looked at
STEPS = 60  # of ln σ in between, and as many about the best of these


def likelier(
    residual: FloatArray,
    jacobian: FloatArray,
    tangent: FloatArray,
    started_s: FloatArray,
    deviance: float,
) -> float:
    """By how much −2 ln L of deviations that wander is less than the `deviance` of ones drawn
    anew, χ² and ln det V; zero where it is not, or where all runs began at once.

    Parameters
    ----------
    residual : (n,), e whitened by the noise, of all runs; jacobian : (n, p), by θ.
    tangent : (n, R), each run's own deviation in a column; started_s : (R,), when each began.
    """
    since = started_s - started_s.min()
    if not np.ptp(since) > 0:
        return 0.0
    later = np.unique(since[since > 0])
    steps = np.diff(np.r_[0.0, later]) / later[-1]
    walked = (since[:, None] >= later) * np.sqrt(steps)  # C = walked walkedᵀ
    return max(0.0, deviance - _Loaded.of(residual, jacobian, tangent @ walked).least())


@dataclass(frozen=True)
class _Loaded:
    """e and J (n, 1 + p), and the principal axes of the loads W of V = I + σ² W Wᵀ."""

    both: FloatArray
    axes: FloatArray
    squared: FloatArray

    @classmethod
    def of(cls, residual: FloatArray, jacobian: FloatArray, loads: FloatArray) -> "_Loaded":
        axes, sizes, _ = np.linalg.svd(loads, full_matrices=False)
        return cls(np.c_[residual, jacobian], axes, sizes**2)

    def least(self) -> float:
        """χ² + ln det V where σ² is the likeliest by its restricted likelihood."""
        low, high = np.log([SMALLEST, LARGEST])
        found = []
        for _ in range(2):
            tried = np.linspace(low, high, STEPS)
            found = [self._deviances(np.exp(2 * v)) for v in tried]
            i = int(np.argmin([restricted for restricted, _ in found]))
            low, high = tried[max(i - 1, 0)], tried[min(i + 1, STEPS - 1)]
        return min(found)[1]

    def _deviances(self, variance: float) -> tuple[float, float]:
        """−2 ln of the restricted likelihood, and of the likelihood, at σ²."""
        grown = 1.0 + variance * self.squared
        shrunk = (1.0 - 1.0 / np.sqrt(grown))[:, None] * (self.axes.T @ self.both)
        whole = self.both - self.axes @ shrunk
        chi2, known = profiled(whole[:, 0], whole[:, 1:])
        deviance = chi2 + float(np.log(grown).sum())
        return deviance + known, deviance
