"""Is what a fit leaves white, and independent of what was asked of the rig?

The whitened residuals of a right model are noise less what p parameters absorbed: ρ = (1 − QQᵀ) n,
with Q an orthonormal basis of the Jacobian's columns and n of unit variance, Student's t rather
than normal because each coefficient's variance was itself estimated from neighbouring bins. Each
test's null distribution is simulated from just that, so that its false-alarm rate holds for few
runs and many parameters too. The statistics are normalised by Σρ²: they see the pattern of a
misfit, χ² sees its size. Each run's residuals are turned into the phase of its own response, in
which what drifts or depends on the drive points the same way in neighbouring runs.

    run_order    Σ ρ_i·ρ_i+1 over runs in the order of recording: drift
    harmonics    Σ_i Σ_k ρ_i,k·ρ_i,k+1: correlation across a run's harmonics
    amplitude    Σ_j (Σ_i ρ_ij a_i)², a: the drive's standardised amplitudes
    frequency    the same with the forcing frequencies
    outlier      the largest ρ²
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.dataset import Batch, Dataset
from identify.fit import Fit
from identify.harmonics import VARIANCE_DOF

FloatArray = npt.NDArray[np.float64]

SIMULATED = 1999  # draws of the null distribution: a p of 0.05 is known to 0.005
LEAST_RUNS = 4


@dataclass(frozen=True)
class ResidualTest:
    """`statistic` in standard deviations of its null distribution from its mean."""

    name: str
    statistic: float
    p_value: float


def residual_tests(fit: Fit, data: Dataset, seed: int = 0) -> tuple[ResidualTest, ...]:
    """The five tests; none for a fit that did not converge or has fewer than four forced runs."""
    forced = next((b for b in data.fit if not b.free), None)
    if not fit.converged or forced is None or forced.runs < LEAST_RUNS:
        return ()
    null = _null(fit, data, np.random.default_rng(seed))
    begin = 0
    for b in data.fit:
        if b is forced:
            break
        begin += 2 * b.compared * b.runs
    part = slice(begin, begin + 2 * forced.compared * forced.runs)
    both = np.concatenate([fit.residual[None], null])
    table = both[:, part].reshape(both.shape[0], forced.runs, 2 * forced.compared)
    found = []
    for name, values in _statistics(table, forced).items():
        observed, simulated = float(values[0]), values[1:]
        spread = float(np.std(simulated)) + 1e-300
        p = (1 + int(np.sum(simulated >= observed))) / (1 + simulated.size)
        found.append(ResidualTest(name, (observed - float(np.mean(simulated))) / spread, p))
    return tuple(found)


def _null(fit: Fit, data: Dataset, rng: np.random.Generator) -> FloatArray:
    """(SIMULATED, n) residuals as a right model leaves them."""
    J = fit.jacobian / (np.sqrt(np.sum(fit.jacobian**2, axis=0)) + 1e-300)
    U, sv, _ = np.linalg.svd(J, full_matrices=False)
    Q = U[:, sv > 1e-12 * sv[0]]
    noise = []
    for b in data.fit:
        shape = (SIMULATED, b.runs, 1, b.compared)
        size = np.sqrt(VARIANCE_DOF / rng.chisquare(VARIANCE_DOF, shape))  # one a coefficient
        draws = rng.standard_normal((SIMULATED, b.runs, 2, b.compared)) * size
        noise.append(draws.reshape(SIMULATED, -1))
    n = np.concatenate(noise, axis=1)
    return np.asarray(n - (n @ Q) @ Q.T)


def _statistics(rho: FloatArray, batch: Batch) -> dict[str, FloatArray]:
    """Each statistic of residuals (draws, runs, 2K), (draws,)."""
    K = batch.compared
    phase = np.angle(batch.measured[:, :1]) * np.arange(1, K + 1)
    turned = (rho[..., :K] + 1j * rho[..., K:]) * np.exp(-1j * phase)
    rho = np.concatenate([turned.real, turned.imag], axis=-1)
    total = np.sum(rho**2, axis=(1, 2)) + 1e-300
    order = np.argsort(batch.started_s, kind="stable")
    sorted_ = rho[:, order]
    out = {"run_order": np.abs(np.sum(sorted_[:, 1:] * sorted_[:, :-1], axis=(1, 2))) / total}
    if K > 1:
        parts = rho.reshape(rho.shape[0], batch.runs, 2, K)
        out["harmonics"] = np.abs(np.sum(parts[..., 1:] * parts[..., :-1], axis=(1, 2, 3))) / total
    asked = {"amplitude": np.abs(batch.at.drive[:, 0]), "frequency": batch.at.omega}
    for name, value in asked.items():
        spread = float(np.std(value))
        if spread > 1e-6 * float(np.mean(value)):
            z = (value - np.mean(value)) / spread
            out[name] = np.sum(np.einsum("dij,i->dj", rho, z) ** 2, axis=1) / total
    out["outlier"] = np.max(rho**2, axis=(1, 2))
    return out
