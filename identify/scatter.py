"""Maximum likelihood with random differences from run to run.

A run draws its own x_r ~ N(0, diag σ²) along the directions that an
`identify.effects.scatter.Scatter` names. Let ρ_r(θ, x) be its whitened residuals and x̂_r the
likeliest x for now. With the tangents T_r and J_r taken there, and e_r = ρ_r(θ, x̂_r) − T_r x̂_r,

    e_r + J_r δθ ~ N(0, V_r),    V_r = I + T_r diag(σ²) T_rᵀ,
    −2 ln L(θ, σ) = Σ_r e_rᵀ V_r⁻¹ e_r + ln det V_r + const.

σ comes from the restricted likelihood (δθ profiled out, + ln det Σ Jᵀ V⁻¹ J): θ has many numbers,
and what they absorb of the runs' deviations must not pass for their smallness. θ for given σ is an
ordinary fit with widened covariances, to data from which what is not linear in x̂_r has been taken
off; the two alternate. ln det V is what the freedom costs: a spread never explains for nothing what
a law explains. A spread must also look random (`identify.randomness`): what follows the runs'
conditions or time, or sits in a single run, has another cause.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import optimize

from identify import assess
from identify.chances import rank_correlation
from identify.dataset import Batch, Dataset
from identify.effects.scatter import Scatter
from identify.fit import Fit, fit_orbits
from identify.parameters import Estimate
from identify.randomness import law_in
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]

ROUNDS = 8
STEPS = 3  # Gauss–Newton steps to a run's likeliest deviation
LEAST_RUNS = 6  # forced runs below which a spread says nothing
SQUARED = " squared"
TREND_P = 0.003  # a rank correlation less probable than this is a law, not chance
ONE_RUN = 0.9  # share of all deviation that a single run may hold
SMALLEST = 1e-8
UPPER = 2.0  # standard errors of ln σ that held-out runs may lie beyond the estimate
HOPELESS = 5.0  # χ²/dof after three rounds that further ones do not mend


@dataclass(frozen=True)
class Spread:
    """The fit of a scatter: θ's fit under the widened covariances, σ, and what it costs."""

    fit: Fit
    data: Dataset
    sizes: dict[str, Estimate]
    penalty: float
    objection: str


@dataclass(frozen=True)
class _Rows:
    """A batch's e (runs, n) and its tangents T (runs, n, q) and J (runs, n, p), whitened."""

    batch: Batch
    residual: FloatArray
    tangent: FloatArray
    jacobian: FloatArray


def fit_scatter(structure: Structure, data: Dataset, base: Fit, scatter: Scatter) -> Spread | None:
    """Fit `structure` with a scatter on top.

    None where there are too few runs, or no likelihood that is finite.
    """
    forced = sum(b.runs for b in data.fit if not b.free)
    if forced < LEAST_RUNS or not np.isfinite(base.chi2):
        return None
    try:
        return _alternate(structure, data, base, scatter)
    except np.linalg.LinAlgError:  # V is singular to rounding: σ beyond all measure
        return None


def _alternate(structure: Structure, data: Dataset, base: Fit, scatter: Scatter) -> Spread | None:
    fit, sizes = base, np.full(len(scatter.parameters), 0.01)
    rows = [_rows(structure, fit.theta, b, scatter) for b in data.fit]
    wide = data
    if not _finite(rows):
        return None
    for i in range(ROUNDS):
        found = _sizes(rows, sizes)
        settled = bool(i) and bool(np.allclose(found, sizes, rtol=0.01, atol=1e-6))
        sizes = found
        wide = replace(data, fit=tuple(_widen(r, sizes) for r in rows))
        # the declared fit may lie far off, misled by runs that it took at their word
        lead_in = (0.0,) if i else (0.01, 0.001, 0.0)
        fit = fit_orbits(structure, wide, fit.theta, continuation=lead_in, iterations=150)
        if not np.isfinite(fit.chi2) or (i >= 2 and fit.chi2_per_dof > HOPELESS):
            return None
        rows = _placed(structure, fit.theta, data.fit, scatter, sizes)
        if not _finite(rows):
            return None
        if settled:
            break
    errors = _relative_errors(rows, sizes)
    # a spread known from a dozen runs is itself uncertain: held-out runs get its upper end
    upper = sizes * np.exp(UPPER * np.minimum(errors, 1.0))
    held = _placed(structure, fit.theta, data.validation, scatter, upper)
    wide = replace(wide, validation=tuple(_widen(r, upper) for r in held))
    named = {
        q.name: Estimate(float(s), float(s * e), q.unit)
        for q, s, e in zip(scatter.parameters, sizes, errors, strict=True)
    }
    return Spread(fit, wide, named, _penalty(rows, sizes), _objection(rows, sizes, scatter))


def _placed(
    structure: Structure,
    theta: FloatArray,
    batches: Sequence[Batch],
    scatter: Scatter,
    sizes: FloatArray,
) -> list[_Rows]:
    """The rows of all batches at their runs' likeliest deviations."""
    at_zero = [_rows(structure, theta, b, scatter) for b in batches]
    return [_moved(structure, theta, r, scatter, sizes) for r in at_zero]


def _rows(
    structure: Structure,
    theta: FloatArray,
    batch: Batch,
    scatter: Scatter,
    x: FloatArray | None = None,
) -> _Rows:
    """Residuals and tangents at deviations `x` (runs, q); None: at none."""
    larger = structure.with_effects(*scatter.directions)
    scale = np.array([e.parameters[0].scale for e in scatter.directions])
    p = theta.size
    if x is None:
        found = assess.predict(larger, np.r_[theta, np.zeros(scale.size)], batch)
        rho, J = found.residual, found.jacobian
    else:
        each = [
            assess.predict(larger, np.r_[theta, own / scale], batch.take(np.array([r])))
            for r, own in enumerate(x)
        ]
        rho = np.concatenate([f.residual for f in each])
        J = np.concatenate([f.jacobian for f in each])
    n = rho.size // batch.runs
    J = J.reshape(batch.runs, n, -1)
    T = J[..., p:] / scale
    e = rho.reshape(-1, n)
    if x is not None:
        e = e - np.einsum("rnq,rq->rn", T, x)
    return _Rows(batch, e, T, J[..., :p])


def _moved(
    structure: Structure, theta: FloatArray, rows: _Rows, scatter: Scatter, sizes: FloatArray
) -> _Rows:
    """The rows at each run's likeliest deviation, found in a few steps; as they are for free runs
    (nearly linear) and where a step leads nowhere."""
    batch = rows.batch
    if batch.free:
        return rows
    best, x = rows, np.zeros((batch.runs, sizes.size))
    for _ in range(STEPS):
        x = np.clip(_likeliest(best, sizes), -0.5, 0.5)
        trial = _rows(structure, theta, batch, scatter, x)
        if not _finite([trial]):
            return rows
        best = trial
    # the remainder goes into what was measured: residual = W (measured − predicted)
    remainder = np.linalg.solve(batch.whitener, (best.residual - rows.residual)[..., None])[..., 0]
    K = batch.compared
    measured = batch.measured + remainder[:, :K] + 1j * remainder[:, K:]
    return replace(best, batch=replace(batch, measured=measured))


def _likeliest(rows: _Rows, sizes: FloatArray) -> FloatArray:
    """x̂ (runs, q) under the linear model of the rows."""
    pull = np.einsum("rnq,rn->rq", rows.tangent, _weighted(rows, sizes))
    return np.asarray(-(sizes**2) * pull)


def _finite(rows: Sequence[_Rows]) -> bool:
    return all(np.isfinite(a).all() for r in rows for a in (r.residual, r.tangent, r.jacobian))


def _spread(rows: _Rows, sizes: FloatArray) -> FloatArray:
    """V, (runs, n, n)."""
    T = rows.tangent * sizes
    return np.asarray(T @ T.transpose(0, 2, 1) + np.eye(T.shape[1]))


def _widen(rows: _Rows, sizes: FloatArray) -> Batch:
    b = rows.batch
    L = np.linalg.cholesky(_spread(rows, sizes))
    W = np.linalg.solve(L, b.whitener)
    inverse = np.linalg.inv(W)
    covariance = inverse @ inverse.transpose(0, 2, 1)
    added = np.diagonal(covariance - b.covariance, axis1=1, axis2=2)
    added = added.reshape(b.runs, 2, b.compared).copy()
    if b.free:
        added[:, 1, 0] = 0.0  # the frequency's place
    noise = b.noise + np.maximum(added.sum(axis=1), 0.0)
    return replace(b, whitener=W, covariance=covariance, noise=noise)


def _deviance(rows: Sequence[_Rows], sizes: FloatArray) -> float:
    """−2 ln of the restricted likelihood, up to a constant."""
    p = rows[0].jacobian.shape[-1]
    total = _penalty(rows, sizes)
    A, pull = np.zeros((p, p)), np.zeros(p)
    for r in rows:
        both = np.concatenate([r.residual[..., None], r.jacobian], axis=2)
        inner = np.linalg.solve(_spread(r, sizes), both)
        total += float(np.sum(r.residual * inner[..., 0]))
        A += np.einsum("rni,rnj->ij", r.jacobian, inner[..., 1:])
        pull += np.einsum("rni,rn->i", r.jacobian, inner[..., 0])
    scale = 1 / np.sqrt(np.maximum(np.diagonal(A), 1e-300))
    values, vectors = np.linalg.eigh(A * scale[:, None] * scale)
    kept = values > 1e-12 * values[-1]
    seen = (vectors.T @ (scale * pull))[kept]
    logdet = float(np.sum(np.log(values[kept])) - 2 * np.sum(np.log(scale)))
    return total - float(np.sum(seen**2 / values[kept])) + logdet


def _weighted(rows: _Rows, sizes: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(_spread(rows, sizes), rows.residual[..., None])[..., 0])


def _penalty(rows: Sequence[_Rows], sizes: FloatArray) -> float:
    return float(sum(np.linalg.slogdet(_spread(r, sizes))[1].sum() for r in rows))


def _sizes(rows: Sequence[_Rows], start: FloatArray) -> FloatArray:
    def deviance(logs: FloatArray) -> float:
        return _deviance(rows, np.exp(np.clip(logs, np.log(SMALLEST), 0.0)))

    starts = [np.log(np.maximum(start, 1e-5)), np.full(start.size, np.log(1e-3))]
    found = [
        optimize.minimize(
            deviance,
            s,
            method="Nelder-Mead",
            options={"xatol": 1e-3, "fatol": 1e-3, "maxfev": 200 * start.size},
        )
        for s in starts
    ]
    best = min(found, key=lambda f: float(f.fun))
    return np.asarray(np.exp(np.clip(best.x, np.log(SMALLEST), 0.0)))


def _relative_errors(rows: Sequence[_Rows], sizes: FloatArray) -> FloatArray:
    """Standard errors of ln σ from the deviance's curvature; infinite where there is none."""
    logs, h = np.log(sizes), 0.05
    out = np.full(sizes.size, np.inf)
    centre = _deviance(rows, sizes)
    for i in range(sizes.size):
        step = np.zeros(sizes.size)
        step[i] = h
        both = _deviance(rows, np.exp(logs + step)) + _deviance(rows, np.exp(logs - step))
        curvature = (both - 2 * centre) / h**2
        if curvature > 1e-3:
            out[i] = np.sqrt(2 / curvature)
    return out


def _objection(rows: Sequence[_Rows], sizes: FloatArray, scatter: Scatter) -> str:
    """Why the deviations are not random, in words; empty where nothing speaks against it."""
    forced = [r for r in rows if not r.batch.free]
    x = np.concatenate([_likeliest(r, sizes) for r in forced])
    there = np.flatnonzero((sizes > 10 * SMALLEST) & (np.ptp(x, axis=0) > 0))
    names = [scatter.parameters[j].name for j in there]
    known, ranked, laws = _conditions(forced, scatter)
    for name, own in zip(names, x[:, there].T, strict=True):
        if np.max(own**2) > ONE_RUN * np.sum(own**2):
            return f"{name}: a single run deviates"
        for word in ranked:
            # what the parameters could have absorbed and did not, seen in the deviations themselves
            if np.ptp(known[word]) > 0 and rank_correlation(own, known[word])[1] < TREND_P:
                return f"{name} follows the {word}: no chance"
    if not there.size:
        return ""
    law = law_in(*_whitened(rows, sizes, there), known, laws)
    if law is None:
        return ""
    which = " and ".join(names[j] for j in law.directions)
    verb = "follows" if len(law.directions) == 1 else "follow"
    told = " and ".join(dict.fromkeys(c.removesuffix(SQUARED) for c in law.covariates))
    return f"{which} {verb} the {told} (p {law.p_value:.1g}): no chance"


def _conditions(
    forced: Sequence[_Rows], scatter: Scatter
) -> tuple[dict[str, FloatArray], list[str], list[tuple[str, ...]]]:
    """What the runs' deviations could follow, by name: which in rank, and which in a law."""
    batches = [r.batch for r in forced]
    known = {
        "frequency": np.concatenate([b.at.omega for b in batches]),
        "drive": np.concatenate([np.abs(b.at.drive[:, 0]) for b in batches]),
        "response": np.concatenate([np.abs(b.measured[:, 0]) for b in batches]),
        "time": np.concatenate([b.started_s for b in batches]),
    }
    for name in ("frequency", "time"):
        known[name + SQUARED] = (known[name] - np.mean(known[name])) ** 2
    ranked = ["frequency", "drive"]
    laws: list[tuple[str, ...]] = [("frequency",), ("drive",), ("response",)]
    laws.append(("frequency", "drive", "response"))
    laws.append(("drive", "frequency", "frequency" + SQUARED))
    if scatter.location != "experiment":  # what wanders in the course of it may follow the time
        ranked.append("time")
        laws += [("time",), ("time", "time" + SQUARED)]
    return known, ranked, laws


def _whitened(
    rows: Sequence[_Rows], sizes: FloatArray, there: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (n,) and Jacobian (n, p), whitened by noise and spread, and the forced runs'
    tangents (n, runs, directions) `there`."""
    residual, jacobian, tangent = [], [], []
    for r in rows:
        L = np.linalg.cholesky(_spread(r, sizes))
        residual += list(np.linalg.solve(L, r.residual[..., None])[..., 0])
        jacobian += list(np.linalg.solve(L, r.jacobian))
        tangent += [(t, r.batch.free) for t in np.linalg.solve(L, r.tangent[..., there])]
    ends = np.cumsum([e.size for e in residual])
    forced = [i for i, (_, free) in enumerate(tangent) if not free]
    deviations = np.zeros((int(ends[-1]), len(forced), there.size))
    for column, i in enumerate(forced):
        deviations[ends[i] - residual[i].size : ends[i], column] = tangent[i][0]
    return np.concatenate(residual), np.concatenate(jacobian), deviations
