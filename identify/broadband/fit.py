"""Simulation-error fit: Gauss–Newton with Levenberg's damping on whitened residuals.

The residual r = y − ŷ(θ) over the estimation samples is whitened in frequency: its transform over
the square root of the noise's spectral density, Tukey-windowed at the two ends. The density is the
smoothed periodogram of the residual that the previous, simpler model left (2 % of the sample rate
would hide lines; the width here is 0.35 %), which is iteratively reweighted least squares, i.e.
maximum likelihood for coloured noise. Without a density the criterion is the plain mean square.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d
from scipy.signal.windows import tukey

from identify.broadband.model import Excitation, Structure, physical

FloatArray = npt.NDArray[np.float64]

_TAPER = 0.02
_SMOOTHING = 0.0035


@dataclass(frozen=True)
class Whitener:
    """Maps time series on the estimation samples to whitened real vectors."""

    where: slice
    density: FloatArray | None  # power of one real component, (bins,)

    @classmethod
    def plain(cls, where: slice) -> "Whitener":
        return cls(where, None)

    @classmethod
    def of(cls, residual: FloatArray, where: slice) -> "Whitener":
        """Density from the smoothed periodogram of `residual` (samples,)."""
        r = residual[where]
        power = np.abs(np.fft.rfft(r * tukey(r.size, _TAPER))) ** 2
        width = max(9, int(_SMOOTHING * r.size))
        return cls(where, np.asarray(uniform_filter1d(power, width, mode="nearest") / 2))

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Shape (samples, …) to (components, …)."""
        x = columns[self.where]
        if self.density is None:
            return x
        window = tukey(x.shape[0], _TAPER)
        shape = (-1,) + (1,) * (x.ndim - 1)
        spectrum = np.fft.rfft(x * window.reshape(shape), axis=0)
        spectrum /= np.sqrt(self.density).reshape(shape)
        return np.concatenate([spectrum.real, spectrum.imag])


@dataclass(frozen=True)
class Fit:
    """A fitted structure. `chi2` is the whitened sum of squares, `components` their number."""

    structure: Structure
    theta: FloatArray
    prediction: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    chi2: float
    components: int
    covariance: FloatArray
    iterations: int
    converged: bool

    def with_sandwich(self, noise: Whitener) -> "Fit":
        """The plain fit's covariance under coloured noise of `noise`'s density (Huber, White).

        With the transform of the Jacobian J and the noise's density S, both over frequency:
        (JᵀJ)⁻¹ (Jᴴ S J) (JᵀJ)⁻¹, each Parseval-scaled; components of S are halves of its power.
        """
        if noise.density is None:
            return self
        j = self.jacobian[noise.where]
        scale = np.linalg.norm(j, axis=0)
        scale[scale == 0] = 1.0
        window = tukey(j.shape[0], _TAPER)
        spectrum = np.fft.rfft(j / scale * window[:, None], axis=0)
        loss = float(np.mean(window**2))
        middle = np.real(np.conj(spectrum).T @ (spectrum * (2 * noise.density)[:, None]))
        middle *= 2 / (j.shape[0] ** 2 * loss**2)
        bread = np.linalg.pinv((j / scale).T @ (j / scale), rcond=1e-13)
        covariance = bread @ middle @ bread / np.outer(scale, scale)
        return replace(self, covariance=covariance)

    def parameters(self, record: Excitation) -> dict[str, dict[str, float | str]]:
        """Readable parameters; standard errors by the delta method."""
        base = physical(self.structure, self.theta, record.scale)
        step = 1e-4 * np.maximum(np.sqrt(np.diag(self.covariance)), 1e-12)
        slopes = []
        for i, h in enumerate(step):
            shifted = self.theta.copy()
            shifted[i] += h
            moved = physical(self.structure, shifted, record.scale)
            slopes.append([(moved[name][0] - base[name][0]) / h for name in base])
        variance = np.einsum("ip,ij,jp->p", slopes, self.covariance, slopes)
        errors = np.sqrt(np.maximum(variance, 0))
        return {
            name: {"value": value, "stderr": float(error), "unit": unit}
            for (name, (value, unit)), error in zip(base.items(), errors, strict=True)
        }


def fit(
    record: Excitation,
    structure: Structure,
    start: Mapping[str, float],
    whiten: Whitener,
    *,
    iterations: int = 25,
    tolerance: float = 1e-6,
) -> Fit:
    """Minimise the whitened simulation error from `start` (every name of the structure).

    Non-convergence is a result (`converged`), not an exception; a start whose motion runs away is
    one too, of infinite `chi2`.
    """
    theta = np.array([start[name] for name in structure.names], dtype=np.float64)
    prediction, jacobian = record.predict(structure, theta)
    if not np.isfinite(prediction).all():
        return _runaway(record, structure, theta, whiten)
    weighted = whiten(record.y - prediction)
    chi2, damping, converged, done = float(weighted @ weighted), 1e-6, False, 0
    for done in range(1, iterations + 1):  # noqa: B007
        j = whiten(jacobian)
        scale = np.linalg.norm(j, axis=0)
        scale[scale == 0] = 1.0
        normal = (j / scale).T @ (j / scale)
        gradient = (j / scale).T @ weighted
        accepted = False
        while damping < 1e6:
            step = np.linalg.solve(normal + damping * np.eye(theta.size), gradient) / scale
            trial, slopes = record.predict(structure, theta + step)
            moved = whiten(record.y - trial) if np.isfinite(trial).all() else None
            if moved is not None and moved @ moved < chi2:
                accepted = True
                break
            damping = max(10 * damping, 1e-4)
        if not accepted or moved is None:
            converged = True  # no descent at any damping: a minimum to rounding
            break
        gain = 1 - float(moved @ moved) / chi2
        theta, jacobian, prediction, weighted = theta + step, slopes, trial, moved
        chi2, damping = float(moved @ moved), damping / 10
        if gain < tolerance:
            converged = True
            break
    j = whiten(jacobian)
    scale = np.linalg.norm(j, axis=0)
    scale[scale == 0] = 1.0
    unit = np.linalg.pinv((j / scale).T @ (j / scale), rcond=1e-13)
    variance = chi2 / max(weighted.size - theta.size, 1)
    return Fit(
        structure=structure,
        theta=theta,
        prediction=prediction,
        residual=record.y - prediction,
        jacobian=jacobian,
        chi2=chi2,
        components=int(weighted.size),
        covariance=unit / np.outer(scale, scale) * variance,
        iterations=done,
        converged=converged,
    )


def _runaway(record: Excitation, structure: Structure, theta: FloatArray, whiten: Whitener) -> Fit:
    """The outcome of a start from which the motion grows without bounds: nothing is fitted."""
    n, nothing = theta.size, np.zeros(record.samples)
    return Fit(
        structure, theta, nothing, record.y, np.zeros((record.samples, n)), np.inf,
        int(whiten(nothing).size), np.full((n, n), np.inf), 0, False,
    )  # fmt: skip
