"""Maximum likelihood on the solved orbit.

Each run's Fourier coefficients are predicted by solving the harmonic balance, and the parameters
minimise the noise-weighted difference to the measured ones:

    χ²(θ) = Σ_runs |W (Y − Ŷ(θ))|²

by Levenberg–Marquardt (`identify.descent`) with the exact Jacobian of `identify.balance`. For
Gaussian noise this is the maximum-likelihood estimate; (JᵀJ)⁻¹ is its covariance and, at the truth,
the Cramér–Rao bound.

Each coefficient's noise is first raised by a share of its own size (`identify.residual.soften`):
far from the optimum, where the balance is stiff, that lets all runs pull evenly; lowered step by
step to zero, it leads the fit in (continuation).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.dataset import Dataset
from identify.descent import AT_REST, Descent, levenberg_marquardt
from identify.parameters import Estimate
from identify.residual import OrbitResidual, Straightened, soften
from identify.structure import MODAL, Structure

FloatArray = npt.NDArray[np.float64]

LEAD_IN_STEPS = 3  # Newton steps towards each orbit while leading in
SHORTLY = 10  # iterations for what may be given up as hopeless: only fits near to the noise matter
FADES = 0.1  # of another's flame residue: less of it in mode 1 may be none
SAME = 1.0  # of χ²: what two ends of descents differ by that are the same, modes renumbered or not
UNSEEN = 1e-13  # singular value, relative to the largest, of what the data say nothing of


@dataclass(frozen=True)
class Fit:
    """The outcome of a fit: an answer only where `converged`; `reason` says why not.

    `theta` are the internal unknowns; `covariance` (p, p) theirs; `residual` the whitened
    residuals in the order of the batches; `jacobian` theirs.
    """

    structure: Structure
    theta: FloatArray
    chi2: float
    dof: int
    covariance: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    converged: bool
    reason: str
    iterations: int

    @property
    def ended(self) -> bool:
        """Whether its descent came to an end: converged, or where rounding, a corner or an edge
        lets no step down."""
        return self.converged or self.reason == AT_REST

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / max(self.dof, 1)

    @property
    def estimates(self) -> dict[str, Estimate]:
        return self.structure.parameters.estimates(self.theta, self.covariance)

    @property
    def values(self) -> dict[str, float]:
        return self.structure.parameters.plain(self.theta)


def no_better(fit: Fit, data: Dataset) -> float:
    """The misfit of a fit, in times what noise leaves: what adds to its model, or takes its place,
    and promises no less than that has gone where nothing is."""
    return fit.chi2 / data.residuals if fit.converged else np.inf


def covariance_of(jacobian: FloatArray) -> FloatArray:
    """(JᵀJ)⁻¹; undetermined directions get a very large variance."""
    norm, sv, Vt = _scaled(jacobian)
    return np.asarray(((Vt.T * (1.0 / sv**2)) @ Vt) / np.outer(norm, norm))


def resolved(structure: Structure, theta: FloatArray, jacobian: FloatArray) -> FloatArray:
    """The covariance of θ's unknowns, with what the tangents do not say (`Effect.resolution`)."""
    out, slopes = covariance_of(jacobian), structure.parameters.slopes(theta)
    for i, stderr in resolutions(structure, theta).items():
        out[i], out[:, i] = 0.0, 0.0
        out[i, i] = (stderr / slopes[i]) ** 2
    return out


def resolutions(structure: Structure, theta: FloatArray) -> dict[int, float]:
    """Standard deviations of the values that lie between two runs, wherever: by unknown."""
    values, index = structure.parameters.plain(theta), structure.parameters.index
    known = [e.resolution(values) for e in structure.effects]
    return {index[name]: stderr for each in known for name, stderr in each.items()}


def log_determinant_of(jacobian: FloatArray) -> float:
    """ln det JᵀJ: minus that of `covariance_of`, which need not be formed for it."""
    norm, sv, _ = _scaled(jacobian)
    return float(2 * (np.log(norm).sum() + np.log(sv).sum()))


def profiled(residual: FloatArray, jacobian: FloatArray) -> tuple[float, float]:
    """χ² that is left of residuals (n,) where the parameters of a linear model, `jacobian` (n, p),
    are at their best, and ln det JᵀJ of those that the data tell of."""
    norm = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-150)
    left, sv, _ = np.linalg.svd(jacobian / norm, full_matrices=False)
    told = sv > UNSEEN * sv[0]
    absorbed = left[:, told].T @ residual
    chi2 = float(residual @ residual - absorbed @ absorbed)
    return chi2, float(2 * (np.log(sv[told]).sum() + np.log(norm).sum()))


def _scaled(jacobian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lengths of the columns, and singular values and directions of all of one length, none of the
    values below what can be told from zero."""
    norm = np.sqrt(np.sum(jacobian**2, axis=0))
    norm = np.where(norm > 1e-100, norm, 1e-100)
    _, sv, Vt = np.linalg.svd(jacobian / norm, full_matrices=False)
    return norm, np.maximum(sv, UNSEEN * max(float(sv[0]), 1e-300)), Vt


def fit_orbits(
    structure: Structure,
    data: Dataset,
    thetas: FloatArray,
    *,
    continuation: Sequence[float] = (0.03, 0.003, 0.0),
    iterations: int = 60,
    hopeless: float = np.inf,
) -> Fit:
    """Maximum-likelihood fit from one start (p,) or several (starts, p); the best one is returned.

    Each is led in by decreasing `continuation` shares, the last of which must be 0. It ends early
    where its tangents promise no less than `hopeless` times what noise leaves. Where it turns out
    that another mode sings than the first, that one is called the first, if all is the same so.
    """
    fit = _from_each(structure, data, thetas, continuation, iterations, hopeless)
    other = _another_sings(fit)
    if other is None:
        return fit
    enough = min(hopeless, (fit.chi2 + SAME) / data.residuals)
    again = _from_each(structure, data, other, (0.0,), iterations, enough)
    same = again.chi2 < fit.chi2 + SAME and again.converged >= fit.converged
    return again if same else fit


def _another_sings(fit: Fit) -> FloatArray | None:
    """Unknowns with the modes renumbered, where the flame's part in mode 1 is within its error of
    nothing, or fades on a way that has no end, and that in another is not. `Straightened` leads
    along the valley of mode 1: down that of another, a descent creeps for thousands of steps. None
    where mode 1 sings, or none does.
    """
    names = fit.structure.parameters.names
    if fit.structure.mode_count == 1 or not np.isfinite(fit.chi2):
        return None
    modes = range(1, fit.structure.mode_count + 1)
    at = [names.index(f"mode{i}.flame_residue") for i in modes]
    parts = np.abs(fit.theta[at])
    known = parts > np.sqrt(np.diag(fit.covariance)[at])
    fades = not known[0] or (not fit.converged and parts[0] < FADES * parts.max())
    if not fades or not known[1:].any():
        return None
    sings = int(np.argmax(np.where(known[1:], parts[1:], 0.0))) + 2
    theta = fit.theta.copy()
    for kind in MODAL:
        own, other = names.index(f"mode1.{kind}"), names.index(f"mode{sings}.{kind}")
        theta[own], theta[other] = fit.theta[other], fit.theta[own]
    return theta


def repeated(fit: Fit, data: Dataset, counted: Dataset) -> tuple[Dataset, Fit]:
    """`counted`, which is `data` with other covariances, and `fit` repeated on them; `data` and
    `fit` themselves where they are the same, or where nothing comes of it."""
    if counted is data:
        return data, fit
    again = fit_orbits(fit.structure, counted, fit.theta, continuation=(0.0,))
    return (counted, again) if np.isfinite(again.chi2) else (data, fit)


def _from_each(
    structure: Structure,
    data: Dataset,
    thetas: FloatArray,
    continuation: Sequence[float],
    iterations: int,
    hopeless: float,
) -> Fit:
    current = np.atleast_2d(thetas)
    batches = [b.balanced(structure) for b in data.fit]
    reason = "the harmonic balance has no solution at the start"
    best: Descent | None = None
    for share in continuation:
        last = share == 0
        residual = OrbitResidual(structure, soften(batches, share), None if last else LEAD_IN_STEPS)
        straight = Straightened(residual, structure)
        descents = levenberg_marquardt(
            straight,
            straight.inside(current),
            iterations=iterations if last else 20,
            tolerance=1e-6 if last else 1e-2,
            hopeless=hopeless * data.residuals,
            hope=SHORTLY,
            bounds=straight.bounds(structure),
        )
        if last:
            usable = [d for d in descents if d is not None]
            least = min((d.cost for d in usable), default=np.inf)
            # one that has not converged yet, but is far below, shows that the others are astray
            near = [d for d in usable if d.cost <= least + SAME]
            best = min(near, key=lambda d: (not d.converged, d.cost), default=None)
        else:
            pairs = zip(current, descents, strict=True)
            current = np.stack([c if d is None else straight.outside(d.theta) for c, d in pairs])
    if best is None:
        return failed(structure, data, current[0], reason)
    dof = best.residual.size - best.theta.size
    theta = straight.outside(best.theta)
    # the covariance is formed where the unknowns are well scaled, and carried over
    jacobian = straight.to_outside(best.jacobian[None], best.theta[None])[0]
    return Fit(
        structure,
        theta,
        best.cost,
        dof,
        resolved(structure, theta, jacobian),
        best.residual,
        jacobian,
        best.converged,
        best.reason,
        best.iterations,
    )


def failed(structure: Structure, data: Dataset, theta: FloatArray, reason: str) -> Fit:
    """The outcome of a fit that produced nothing to rely on."""
    n, p = data.residuals, theta.size
    nothing = np.full((p, p), np.inf)
    return Fit(
        structure, theta, np.inf, n - p, nothing, np.full(n, np.inf), np.zeros((n, p)), False,
        reason, 0,
    )  # fmt: skip
