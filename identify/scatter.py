"""Maximum likelihood with random differences from run to run.

A run draws its own x_r ~ N(0, diag σ²) along the directions that an
`identify.effects.scatter.Scatter` names. Let ρ_r(θ, x) be its whitened residuals; for given σ, θ
and the likeliest x̂_r are found together (`identify.own`). With the tangents T_r and J_r taken
there, and e_r = ρ_r(θ, x̂_r) − T_r x̂_r,

    e_r + J_r δθ ~ N(0, V_r),    V_r = I + T_r diag(σ²) T_rᵀ,
    −2 ln L(θ, σ) = Σ_r e_rᵀ V_r⁻¹ e_r + ln det V_r + const.

σ comes from the restricted likelihood (δθ profiled out, + ln det Σ Jᵀ V⁻¹ J): θ has many numbers,
and what they absorb of the runs' deviations must not pass for their smallness. The two alternate.
ln det V is what the freedom costs: a spread never explains for nothing what a law explains. A
spread must also look random (`identify.randomness`): what follows the runs' conditions or time, or
sits in a single run, has another cause. What the experiment itself drifts by at random may wander:
its likelihood is the greater of both (`identify.wander`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify import assess
from identify.chances import beta_tail, rank_correlation
from identify.dataset import Batch, Dataset
from identify.effects.scatter import Scatter
from identify.fit import Fit, profiled, resolved
from identify.own import Led, Own, lead, settle
from identify.parameters import Estimate
from identify.randomness import law_in
from identify.start import distant_starts
from identify.structure import Structure
from identify.wander import LARGEST, SMALLEST, likelier

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

ROUNDS = 8
LEAST_RUNS = 6  # forced runs below which a spread says nothing
SQUARED = " squared"
TREND_P = 0.003  # a rank correlation less probable than this is a law, not chance
NOTHING = "no run deviates"  # an objection
ONE_RUN = 0.9  # share of all deviation that a single run may hold, whatever their number
UPPER = 2.0  # standard errors of ln σ that held-out runs may lie beyond the estimate
HOPELESS = 5.0  # χ² a residual beyond which further rounds, or less noise, mend nothing …
FAR = 30.0  # … and at first, when σ is no more than a guess
WIDER = 3.0  # times the σ that leads in by which every run may deviate, as yet at that price
LEADING = 10.0  # typical sizes of each direction that the lead-in allows
ASTRAY = 300.0  # χ²/dof beyond which the base fit is no place to start from alone
#: How they are led in: harmonics, share of noise, Newton steps, and how many are kept.
STAGES = (
    ("coarse", 0.1, 2, 24),
    ("coarse", 0.02, 2, 16),
    ("all", 0.003, 3, 8),
    ("all", 0.0005, 3, 4),
)


@dataclass(frozen=True)
class Spread:
    """The fit of a scatter: θ's fit under the widened covariances, σ, and what it costs."""

    fit: Fit
    data: Dataset
    sizes: dict[str, Estimate]
    penalty: float
    objection: str
    luck: float = 1.0  # chance of what is objected to, were the deviations random; 0: not so asked
    unrivalled: bool = False  # no law comes near (`identify.trace.claims.unrivalled`)
    wandering: float = 0.0  # by how much −2 ln L is less for deviations that wander in time


@dataclass(frozen=True)
class _Rows:
    """A batch's e (runs, n) and its tangents T (runs, n, q) and J (runs, n, p), whitened."""

    batch: Batch
    residual: FloatArray
    tangent: FloatArray
    jacobian: FloatArray


def fit_scatter(
    structure: Structure,
    data: Dataset,
    base: Fit,
    scatter: Scatter,
    most: float = np.inf,
    far: bool = False,
) -> Spread | None:
    """Fit `structure` with a scatter on top, from the fit `base` without it, and from the slow flow
    where that one is no place to start from, or is said to be `far`.

    None where there are too few runs, or no likelihood that is finite, or where χ² and penalty stay
    beyond `most`.
    """
    forced = sum(b.runs for b in data.fit if not b.free)
    if forced < LEAST_RUNS or not np.isfinite(base.chi2):
        return None
    own = Own(scatter.directions, _reached(data.fit, scatter))
    starts = [np.concatenate([base.theta, np.zeros(len(own.parameters))])[None]]
    if far or base.chi2_per_dof > ASTRAY:
        starts.append(_afar(structure, data, own, base))
    found = []
    for begin in starts:
        try:
            spread = _alternate(structure, data, own, begin, scatter, most)
        except np.linalg.LinAlgError:  # V is singular to rounding: σ beyond all measure
            spread = None
        if spread is not None:
            found.append(spread)
    return min(found, key=lambda spread: spread.fit.chi2 + spread.penalty, default=None)


def _reached(batches: Sequence[Batch], scatter: Scatter) -> IntArray:
    """Identities of the runs that may deviate: without a drive there is none to scatter."""
    reached = [b.at.identity for b in batches if not (b.free and scatter.location == "actuator")]
    return np.concatenate([np.empty(0, dtype=np.int64), *reached])


def _guess(own: Own) -> FloatArray:
    """σ that leads in: wide, but not so wide that any θ would do."""
    return np.array([LEADING * d.scale for d in own.directions])


def _afar(structure: Structure, data: Dataset, own: Own, base: Fit) -> FloatArray:
    """Starts from the slow flow wherever the base fit is, led through falling noise; none where
    that leads nowhere."""
    rough = data.coarse()
    inherited = [base.values[q.name] for e in structure.effects for q in e.parameters]
    begun = distant_starts(structure, rough, inherited)
    none = np.zeros(len(own.parameters))
    thetas = np.stack([np.r_[s.theta, none] for s in begun] + [np.r_[base.theta, none]])
    for seen, share, steps, kept in STAGES:
        batches = rough.fit if seen == "coarse" else data.fit
        led = lead(
            structure, own, batches, thetas, _guess(own), share=share, steps=steps, iterations=20
        )
        if not led or led[0].cost > sum(2 * b.compared * b.runs for b in batches):
            return thetas[:0]  # more is left than even noise so raised explains
        thetas = np.stack([np.r_[x.theta, x.own] for x in led[:kept]])
    return thetas


def _alternate(
    structure: Structure,
    data: Dataset,
    own: Own,
    starts: FloatArray,
    scatter: Scatter,
    most: float,
) -> Spread | None:
    sizes, settled = _guess(own), False
    if not len(starts):
        return None
    begun = starts[0]
    for i in range(ROUNDS):
        enough = (FAR if i == 0 else HOPELESS) * data.residuals
        found = lead(structure, own, data.fit, starts, sizes, hopeless=10 * enough)
        if not found or found[0].cost > enough:
            return None
        led = found[0]
        if led.cost > most + (WIDER**2 * len(own.parameters) if i == 0 else 0.0):
            return None
        rows = [_rows(structure, led.theta, own.placed(b, led.own), scatter) for b in data.fit]
        if not _finite(rows):
            return None
        # a guess that is far too wide leads astray: from the beginning too, once σ is known better
        starts = np.stack([np.r_[led.theta, led.own], begun])
        before, sizes = sizes, _sizes(rows, sizes)
        settled = bool(np.allclose(sizes, before, rtol=0.01, atol=1e-6))
        if settled:
            break
    errors = _relative_errors(rows, sizes)
    # a spread known from a dozen runs is itself uncertain: held-out runs get its upper end
    upper = sizes * np.exp(UPPER * np.minimum(errors, 1.0))
    wide = replace(
        data,
        fit=tuple(_widen(r, sizes) for r in rows),
        validation=tuple(
            _widen(_held_out(structure, led.theta, b, scatter, upper), upper)
            for b in data.validation
        ),
    )
    named = {
        q.name: Estimate(float(s), float(s * e), q.unit)
        for q, s, e in zip(scatter.parameters, sizes, errors, strict=True)
    }
    fit, penalty = _fit(structure, led, rows, sizes), _penalty(rows, sizes)
    wandering = _wandering(rows, fit.chi2 + penalty) if scatter.wanders else 0.0
    said, luck = _objection(rows, sizes, scatter)
    return Spread(fit, wide, named, penalty, said, luck, wandering=wandering)


def _wandering(rows: Sequence[_Rows], deviance: float) -> float:
    """By how much −2 ln L is less than `deviance` where the one direction's deviations wander."""
    none = np.zeros(1)
    tangent = _tangents(rows, none, np.arange(1))[..., 0]
    started_s = np.concatenate([r.batch.started_s for r in rows])
    return likelier(*_whitened(rows, none), tangent, started_s, deviance)


def _fit(structure: Structure, led: Led, rows: Sequence[_Rows], sizes: FloatArray) -> Fit:
    """θ's fit under the widened covariances."""
    residual, jacobian = _whitened(rows, sizes)
    return Fit(
        structure,
        led.theta,
        float(residual @ residual),
        residual.size - led.theta.size,
        resolved(structure, led.theta, jacobian),
        residual,
        jacobian,
        led.converged,
        led.reason,
        led.iterations,
    )


def _held_out(
    structure: Structure, theta: FloatArray, batch: Batch, scatter: Scatter, sizes: FloatArray
) -> _Rows:
    """The rows of runs that θ was not fitted to, at their own likeliest deviations."""
    own = Own(scatter.directions, _reached([batch], scatter), absorbed=False)
    led = settle(structure, own, theta, batch, sizes)
    return _rows(structure, theta, batch if led is None else own.placed(batch, led.own), scatter)


def _rows(structure: Structure, theta: FloatArray, batch: Batch, scatter: Scatter) -> _Rows:
    """e and the tangents, at the deviations that the batch's runs are known to have."""
    larger = structure.with_effects(*scatter.directions)
    scale = np.array([d.scale for d in scatter.directions])
    p = theta.size
    found = assess.predict(larger, np.r_[theta, np.zeros(scale.size)], batch)
    n = found.residual.size // batch.runs
    J = found.jacobian.reshape(batch.runs, n, -1)
    T = J[..., p:] / scale
    e = found.residual.reshape(-1, n)
    if batch.at.deviations:
        x = np.stack([d.size for d in batch.at.deviations], axis=1)
        e = e - np.einsum("rnq,rq->rn", T, x)
    return _Rows(batch, e, T, J[..., :p])


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
    """The batch whose residuals are e, with covariances widened by the spread."""
    b, K = rows.batch, rows.batch.compared
    L = np.linalg.cholesky(_spread(rows, sizes))
    W = np.linalg.solve(L, b.whitener)
    inverse = np.linalg.inv(W)
    covariance = inverse @ inverse.transpose(0, 2, 1)
    added = np.diagonal(covariance - b.covariance, axis1=1, axis2=2)
    added = added.reshape(b.runs, 2, K).copy()
    measured, at = b.measured, b.at
    if at.deviations:  # e = W (measured − predicted) − T x: the last goes into what was measured
        x = np.stack([d.size for d in at.deviations], axis=1)
        taken = np.linalg.solve(b.whitener, np.einsum("rnq,rq->rn", rows.tangent, x)[..., None])
        re, im = taken[:, :K, 0], taken[:, K:, 0].copy()
        if b.free:  # turned so that the fundamental is real, which leaves a place for the frequency
            measured = measured * np.exp(-1j * np.angle(measured[:, :1]) * np.arange(1, K + 1))
            at = replace(at, omega=at.omega - 2 * np.pi * im[:, 0])
            im[:, 0] = 0.0
        measured = measured - (re + 1j * im)
    if b.free:
        added[:, 1, 0] = 0.0
    noise = b.noise + np.maximum(added.sum(axis=1), 0.0)
    return replace(b, at=at, measured=measured, whitener=W, covariance=covariance, noise=noise)


def _deviance(rows: Sequence[_Rows], sizes: FloatArray) -> float:
    """−2 ln of the restricted likelihood, up to a constant."""
    chi2, logdet = profiled(*_whitened(rows, sizes))
    return _penalty(rows, sizes) + chi2 + logdet


def _whitened(rows: Sequence[_Rows], sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals e (n,) and Jacobian (n, p) of all runs, whitened by noise and spread."""
    inner = []
    for r in rows:
        both = np.concatenate([r.residual[..., None], r.jacobian], axis=2)
        solved = np.linalg.solve(np.linalg.cholesky(_spread(r, sizes)), both)
        inner.append(solved.reshape(-1, both.shape[2]))
    whole = np.concatenate(inner)
    return whole[:, 0], whole[:, 1:]


def _weighted(rows: _Rows, sizes: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(_spread(rows, sizes), rows.residual[..., None])[..., 0])


def _penalty(rows: Sequence[_Rows], sizes: FloatArray) -> float:
    return float(sum(np.linalg.slogdet(_spread(r, sizes))[1].sum() for r in rows))


def _sizes(rows: Sequence[_Rows], start: FloatArray) -> FloatArray:
    from scipy import optimize  # a third of a second that only a spread costs

    def deviance(logs: FloatArray) -> float:
        return _deviance(rows, np.exp(np.clip(logs, np.log(SMALLEST), np.log(LARGEST))))

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
    return np.asarray(np.exp(np.clip(best.x, np.log(SMALLEST), np.log(LARGEST))))


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


def _objection(rows: Sequence[_Rows], sizes: FloatArray, scatter: Scatter) -> tuple[str, float]:
    """Why the deviations are not random, in words, and how probable that is if they are; empty
    where nothing speaks against it."""
    forced = [r for r in rows if not r.batch.free]
    x = np.concatenate([_likeliest(r, sizes) for r in forced])
    there = np.flatnonzero((sizes > 10 * SMALLEST) & (np.ptp(x, axis=0) > 0))
    names = [scatter.parameters[j].name for j in there]
    known, ranked, laws = _conditions(forced, scatter)
    doubts: list[tuple[float, str]] = []
    for name, own in zip(names, x[:, there].T, strict=True):
        share = float(np.max(own**2) / np.sum(own**2))
        p_value = own.size * beta_tail(share, 0.5, (own.size - 1) / 2)
        if share > ONE_RUN and p_value < TREND_P:
            doubts.append((p_value, f"{name}: a single run deviates (p {p_value:.1g})"))
        for word in ranked:
            # what the parameters could have absorbed and did not, seen in the deviations themselves
            if np.ptp(known[word]) > 0:
                p_value = rank_correlation(own, known[word])[1]
                if p_value < TREND_P:
                    doubts.append((p_value, f"{name} follows the {word} (p {p_value:.1g})"))
    if not there.size:
        return NOTHING, 0.0
    residual, jacobian = _whitened(rows, sizes)
    forced_runs = np.concatenate([np.full(r.batch.runs, not r.batch.free) for r in rows])
    deviations = _tangents(rows, sizes, there)[:, forced_runs] * sizes[there]
    if scatter.wanders:  # what wanders follows by chance what goes with the time
        trends = np.stack([known["time"], known["time" + SQUARED]], axis=1)
        slow = np.einsum("nmq,mk->nqk", deviations, trends).reshape(residual.size, -1)
        jacobian = np.c_[jacobian, slow]
    law = law_in(residual, jacobian, deviations, known, laws)
    if law is not None:
        which = " and ".join(names[j] for j in law.directions)
        verb = "follows" if len(law.directions) == 1 else "follow"
        told = " and ".join(dict.fromkeys(c.removesuffix(SQUARED) for c in law.covariates))
        said = f"{which} {verb} the {told} (p {law.p_value:.1g})"
        doubts.append((law.p_value, said))
    p_value, said = min(doubts, default=(1.0, ""))
    return said, p_value


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
    if not scatter.wanders:  # what wanders in the course of it may follow the time
        ranked.append("time")
        laws += [("time",), ("time", "time" + SQUARED)]
    return known, ranked, laws


def _tangents(rows: Sequence[_Rows], sizes: FloatArray, there: IntArray) -> FloatArray:
    """The runs' tangents (n, runs, directions) `there`, n counting all runs' residuals, whitened
    by noise and spread."""
    own: list[FloatArray] = []
    for r in rows:
        L = np.linalg.cholesky(_spread(r, sizes))
        own += list(np.linalg.solve(L, r.tangent[..., there]))
    ends = np.cumsum([len(t) for t in own])
    out = np.zeros((int(ends[-1]), len(own), there.size))
    for run, (end, t) in enumerate(zip(ends, own, strict=True)):
        out[end - len(t) : end, run] = t
    return out
