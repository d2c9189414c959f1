"""Growth rate, saturation and noise intensity from the fluctuations of the oscillation's envelope.

A mode driven by broadband noise and saturating has, after averaging over the period, the envelope

    dA = (ν A − κ A³ + D/A) dt + √(2D) dW                       (Stuart–Landau with noise)

(Noiray and Schuermans 2013; ν linear growth rate 1/s, κ saturation 1/(unit²·s), D the noise's
diffusion in each quadrature, unit²/s). The textbook way estimates drift and diffusion from
increments over a vanishing lag τ; a band-passed envelope forbids small lags, and at finite ones
the Kramers–Moyal moments are biased. The adjoint Fokker–Planck operator

    L† = (ν a − κ a³ + D/a) ∂_a + D ∂²_a,      E[g(A_τ) | A_0 = a] = (e^{L†τ} g)(a)

gives every finite-lag expectation exactly (Boujo and Noiray 2017: moments g = (A − a)ⁿ). Here g is
the indicator of each cell of a grid, so that e^{L†τ} is the whole transition matrix, and the
parameters maximise the likelihood Σ N_ij log (e^{L†τ})_ij of the observed transitions i → j at
lag τ: the finite-time correction, with the weights that the statistics themselves dictate.

Of the band-pass (Gaussian, memory σ_t = 1/(2π·bandwidth)) two traces remain. Filtered samples at
lag τ correlate like unfiltered ones at τ − E|Δ|, Δ the difference of two filter delays: Gaussian
with std √2 σ_t, so that the effective lag is τ − 2σ_t/√π. And the fluctuations lose power: of an
exponential correlation with rate λ, the share exp(λ²σ_t²)·erfc(λσ_t) remains, by which D is
divided. Both are first-order in λσ_t (`filter_ratio`).

L† is discretised in detailed balance with the stationary density a·exp((νa²/2 − κa⁴/4)/D), which
makes it similar to a symmetric tridiagonal matrix: one eigendecomposition a likelihood.

Standard errors are the inverse observed information; the transitions of all start times within
one lag are averaged, so that they count as one chain.

Assumes: one mode in the band, white noise over the band, stationarity. Not suitable when the
record holds less than about fifty correlation times, or for a limit cycle so quiet that only its
neighbourhood is visited: then ν rests on the cubic law alone, and `stderr` does not know.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh_tridiagonal
from scipy.optimize import minimize
from scipy.special import erfcx

from identify.characterise.envelope import Estimate

FloatArray = npt.NDArray[np.float64]

_CELLS = 48
# κ ≥ 0 is tested on its boundary: half χ² with one degree of freedom, 2.5 % beyond 3.84.
SATURATION_LR = 3.84
_FLOOR = 1e-12  # smallest transition probability: keeps the likelihood finite off the support


@dataclass(frozen=True)
class StochasticMode:
    """Result of the identification; `lag_s` is the effective τ.

    `saturation_lr` is twice the log-likelihood gained by κ > 0 over a linear, damped mode. The
    growth rate is the saturating fit's in any case: choosing the linear one where κ is not
    significant would be more precise and, near onset, wrong by several of its standard errors.
    """

    growth_rate_per_s: Estimate
    saturation: Estimate
    noise_intensity: Estimate
    saturation_lr: float
    lag_s: float
    filter_ratio: float  # λσ_t: relaxation rate times the band-pass's memory
    converged: bool
    message: str
    grid: FloatArray
    measured_drift: FloatArray
    measured_diffusion: FloatArray
    model_drift: FloatArray
    model_diffusion: FloatArray
    visits: FloatArray


def identify_envelope(
    envelope: FloatArray, step_s: float, bandwidth_hz: float, *, lags: float = 3.0
) -> StochasticMode:
    """Maximum-likelihood (ν, κ, D) of `envelope`, shape (samples,), sampled every `step_s`.

    `bandwidth_hz` is that of `demodulate`; transitions are taken over `lags` filter memories.

    Raises
    ------
    ValueError : the lag leaves fewer than 30 transitions, or the envelope is constant.
    """
    memory = 1 / (2 * np.pi * bandwidth_hz)
    lag = max(1, round(lags * memory / step_s))
    if envelope.size < 31 * lag:
        raise ValueError(
            f"lag={lag * step_s:.4g} s leaves {envelope.size // lag} transitions of the at least 30"
            " that identification needs: record longer"
        )
    scale = float(np.sqrt(np.mean(envelope**2)))
    a = envelope / scale
    if not a.std() > 1e-9:
        raise ValueError("envelope is constant: nothing fluctuates, so nothing can be identified")
    edges = _edges(a)
    grid = 0.5 * (edges[1:] + edges[:-1])
    index = np.clip(np.searchsorted(edges, a) - 1, 0, grid.size - 1)
    counts = np.zeros((grid.size, grid.size))
    np.add.at(counts, (index[:-lag], index[lag:]), 1.0 / lag)
    tau = lag * step_s - 2 * memory / np.sqrt(np.pi)
    fit, linear = _fit(counts, grid, tau), _fit(counts, grid, tau, saturating=False)
    gain = float(2 * (linear.fun - fit.fun))
    nu, kappa, log_d = fit.x
    stderr = _standard_errors(counts, grid, tau, fit.x)
    diffusion = float(np.exp(log_d))
    transition = _transition(grid, nu, kappa, diffusion, tau)
    moments = [_moments(matrix, grid, tau, scale) for matrix in (counts, transition)]
    rate = _relaxation_rate(counts, grid, tau)
    kept = float(erfcx(rate * memory))
    good = bool(np.isfinite(stderr).all())
    return StochasticMode(
        growth_rate_per_s=Estimate(float(nu), float(stderr[0])),
        saturation=Estimate(float(kappa) / scale**2, float(stderr[1]) / scale**2),
        noise_intensity=Estimate(
            diffusion * scale**2 / kept, float(stderr[2]) * diffusion * scale**2 / kept
        ),
        saturation_lr=gain,
        lag_s=tau,
        filter_ratio=rate * memory,
        converged=good,
        message="converged" if good else "the likelihood has no proper maximum on these data",
        grid=grid * scale,
        measured_drift=moments[0][0],
        measured_diffusion=moments[0][1],
        model_drift=moments[1][0],
        model_diffusion=moments[1][1],
        visits=counts.sum(axis=1),
    )


def _edges(a: FloatArray) -> FloatArray:
    """Cells from near the smallest to beyond the largest envelope, a fifth of the range wider."""
    margin = 0.2 * (a.max() - a.min())
    return np.linspace(max(0.0, a.min() - margin), a.max() + margin, _CELLS + 1)


def _transition(grid: FloatArray, nu: float, kappa: float, d: float, tau: float) -> FloatArray:
    """e^{L†τ} on the grid, rows i → columns j; rates √(p_j/p_i)·D/h² obey detailed balance."""
    h = grid[1] - grid[0]
    log_p = np.log(grid) + (0.5 * nu * grid**2 - 0.25 * kappa * grid**4) / d
    half = np.clip(0.5 * np.diff(log_p), -40, 40)
    up, down = d / h**2 * np.exp(half), d / h**2 * np.exp(-half)
    diagonal = -np.concatenate([up, [0.0]]) - np.concatenate([[0.0], down])
    values, vectors = eigh_tridiagonal(diagonal, np.sqrt(up * down))
    root = np.exp(0.5 * (log_p - log_p.max()))
    root = np.maximum(root, 1e-150)
    kernel = (vectors * np.exp(np.minimum(values, 0.0) * tau)) @ vectors.T
    return np.asarray(np.maximum(kernel * (root[None, :] / root[:, None]), _FLOOR))


def _negative_log_likelihood(
    theta: FloatArray, counts: FloatArray, grid: FloatArray, tau: float
) -> float:
    probability = _transition(grid, theta[0], theta[1], float(np.exp(theta[2])), tau)
    used = counts > 0
    return float(-(counts[used] * np.log(np.minimum(probability[used], 1.0))).sum())


def _relaxation_rate(counts: FloatArray, grid: FloatArray, tau: float) -> float:
    """−ln(correlation)/τ of the observed transitions, 1/s."""
    x = grid - (counts.sum(axis=1) @ grid) / counts.sum()
    correlation = (x @ counts @ x) / (counts.sum(axis=1) @ x**2)
    return float(-np.log(np.clip(correlation, 1e-2, 0.99)) / tau)


@dataclass(frozen=True)
class _Optimum:
    x: FloatArray
    fun: float


def _fit(counts: FloatArray, grid: FloatArray, tau: float, *, saturating: bool = True) -> _Optimum:
    """Best of a few starts around the stationary moments; κ = exp(·) > 0, or 0 if not saturating.

    The relaxation rate λ sets the time scale; for a limit cycle ν = λ/2 and κ = ν (unit mean
    square), for a damped mode ν = −λ/2 and D = −ν/2·⟨A²⟩.
    """
    rate = _relaxation_rate(counts, grid, tau)
    occupied = counts.sum(axis=1) / counts.sum()
    variance = occupied @ (grid - occupied @ grid) ** 2
    diffusion = max(rate * variance, 1e-9)
    best = _Optimum(np.zeros(3), np.inf)
    starts = (
        [(0.5 * rate, 0.5 * rate), (-0.3 * rate, 0.1 * rate)]
        if saturating
        else [(-0.5 * rate, 0.0)]
    )
    for nu, kappa in starts:

        def objective(p: FloatArray) -> float:
            k = float(np.exp(p[2])) * rate if saturating else 0.0
            g = p[0] * rate if saturating else -float(np.exp(p[0])) * rate
            return _negative_log_likelihood(
                np.array([g, k, p[1] + np.log(diffusion)]), counts, grid, tau
            )

        first = nu / rate if saturating else np.log(-nu / rate)
        start = [first, 0.0] + ([np.log(kappa / rate)] if saturating else [])
        found = minimize(
            objective,
            start,
            method="BFGS",
            options={"gtol": 1e-2, "maxiter": 60},
        )
        p = found.x
        theta = np.array(
            [
                p[0] * rate if saturating else -np.exp(p[0]) * rate,
                np.exp(p[2]) * rate if saturating else 0.0,
                p[1] + np.log(diffusion),
            ]
        )
        if found.fun < best.fun:
            best = _Optimum(theta, float(found.fun))
    return best


def _standard_errors(
    counts: FloatArray, grid: FloatArray, tau: float, theta: FloatArray
) -> FloatArray:
    """Square roots of the inverse observed information (central differences), shape (3,)."""
    step = np.array([1e-2 * max(abs(theta[0]), abs(theta[1]), 0.1 / tau)] * 2 + [1e-2])
    hessian = np.zeros((3, 3))

    def value(offset: FloatArray) -> float:
        return _negative_log_likelihood(theta + offset, counts, grid, tau)

    units = np.diag(step)
    for i in range(3):
        for j in range(i + 1):
            hessian[i, j] = hessian[j, i] = (
                value(units[i] + units[j])
                - value(units[i] - units[j])
                - value(units[j] - units[i])
                + value(-units[i] - units[j])
            ) / (4 * step[i] * step[j])
    try:
        variance = np.diag(np.linalg.inv(hessian))
    except np.linalg.LinAlgError:
        return np.full(3, np.inf)
    return np.asarray(np.where(variance > 0, np.sqrt(np.abs(variance)), np.inf))


def _moments(
    matrix: FloatArray, grid: FloatArray, tau: float, scale: float
) -> tuple[FloatArray, FloatArray]:
    """Finite-lag drift ⟨A_τ − a⟩/τ and diffusion ⟨(A_τ − a)²⟩/2τ by row, in the signal's unit."""
    total = np.maximum(matrix.sum(axis=1), 1e-300)
    change = grid[None, :] - grid[:, None]
    drift = (matrix * change).sum(axis=1) / total / tau * scale
    diffusion = (matrix * change**2).sum(axis=1) / total / (2 * tau) * scale**2
    seen = matrix.sum(axis=1) > 0
    return np.where(seen, drift, np.nan), np.where(seen, diffusion, np.nan)
