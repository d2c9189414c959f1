"""Score tests: along which effects' tangents the declared fit's residual lies.

A tangent is projected off those of the fitted parameters, so that what the fit can absorb is not
counted as evidence. An effect whose shape is unknown where its size is zero (the frequency of a
mode that takes no part) is tested at one shape after the other: to start from, never as evidence.
To start from is a step of all unknowns together too: where the fit absorbs nearly all of an effect,
the effect beside what had stood for it leaves far more than there was.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify.chances import chi2_points, chi2_tail
from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects.scatter import Scatter
from identify.executor import Executor
from identify.fit import Fit
from identify.residual import OrbitResidual
from identify.structure import Structure
from identify.trace.tried import first_of_each

FloatArray = npt.NDArray[np.float64]

DRAWS = 20_000  # of the bootstrap of the smallest p-value
DECIDED = 1e-5  # Bonferroni's bound below which none is drawn
ABOVE_NOISE = 5.0  # times the recorded pressure's noise that a tangent formed of it must stand
NOISES = 4  # draws of that noise
STEPS = np.array([1.0, 0.3, 0.1, 0.03, 0.01])  # shares of a Gauss–Newton step that are tried …
NEAR = 10.0  # … and times the χ² there was that the best of them may leave


@dataclass(frozen=True)
class ScoreTest:
    """An effect's tangent at its neutral point, projected off the fitted parameters' tangents.

    `drop` is the decrease of χ² that a small effect along it would bring, `share` the part of the
    tangent that the fit cannot absorb, `p_value` of the drop for as many degrees of freedom as the
    tangent keeps, `basis` (n, degrees of freedom) an orthonormal one of what it keeps:
    drop = |basisᵀ ρ|².
    """

    drop: float
    share: float
    p_value: float
    basis: FloatArray


def score_test(structure: Structure, data: Dataset, fit: Fit, effect: Effect) -> ScoreTest | None:
    """Score test of one more effect at a fitted model; None where it has no neutral point."""
    neutral = effect.neutral()
    if neutral is None:
        return None
    larger = structure.with_effects(effect)
    inner = effect.to_internal(neutral)
    outcome = OrbitResidual(larger, data.fit)(np.r_[fit.theta, inner][None], np.array([0]), True)
    if outcome.jacobian is None or not outcome.exists[0]:
        return None
    rho, J = outcome.residual[0], outcome.jacobian[0]
    tangent = J[:, fit.theta.size :]
    Q = _span(J[:, : fit.theta.size])
    if "pressure" in effect.needs:
        rest = tangent - Q @ (Q.T @ tangent)
        noise = _of_noise(larger, data, np.r_[fit.theta, inner], tangent, Q)
        if np.linalg.norm(rest) < ABOVE_NOISE * noise:
            return None
    return _along(rho, tangent, Q)


def _along(rho: FloatArray, tangent: FloatArray, Q: FloatArray) -> ScoreTest | None:
    """The residual along a tangent, beyond what `Q` spans; None where that is all of it."""
    rest = tangent - Q @ (Q.T @ tangent)
    norm = float(np.linalg.norm(tangent))
    if not norm > 0:
        return None
    share = float(np.linalg.norm(rest)) / norm
    if share < 1e-5:  # wholly absorbed: what is left of the tangent is rounding
        return None
    U, S, _ = np.linalg.svd(rest, full_matrices=False)
    basis = U[:, 1e-8 * S[0] < S]
    along = basis.T @ rho
    drop = float(along @ along)
    return ScoreTest(drop, share, chi2_tail(drop, basis.shape[1]), basis)


def chance_test(
    structure: Structure, data: Dataset, fit: Fit, scatter: Scatter
) -> ScoreTest | None:
    """The same for random differences from run to run: along what lets every run deviate freely in
    the directions of `scatter`, of which the fit absorbs a few."""
    larger, count = structure.with_effects(*scatter.directions), fit.theta.size
    none = np.zeros(len(scatter.directions))
    outcome = OrbitResidual(larger, data.fit)(np.r_[fit.theta, none][None], np.array([0]), True)
    if outcome.jacobian is None or not outcome.exists[0]:
        return None
    rho, J = outcome.residual[0], outcome.jacobian[0]
    run = np.concatenate([np.repeat(b.at.identity, 2 * b.compared) for b in data.fit])
    each = run[:, None] == np.unique(run)
    own = (J[:, count:, None] * each[:, None, :]).reshape(rho.size, -1)
    size = np.linalg.norm(own, axis=0)
    return _along(rho, own[:, size > 0] / size[size > 0], _span(J[:, :count]))


def _of_noise(
    larger: Structure, data: Dataset, theta: FloatArray, tangent: FloatArray, Q: FloatArray
) -> float:
    """How much of a tangent that is formed from the recorded pressure, beyond what `Q` spans, is
    the pressure's noise. Where noise is sound, the velocity has the same: its residual lies along
    such a tangent without any effect."""
    rng = np.random.default_rng(0)
    powers = []
    for _ in range(NOISES):
        batches = []
        for b in data.fit:
            if b.pressure_noise is None:
                return 0.0
            size = np.sqrt(b.pressure_noise / 2)
            noise = size * (rng.standard_normal(size.shape) + 1j * rng.standard_normal(size.shape))
            batches.append(replace(b, at=replace(b.at, pressure=b.at.pressure + noise)))
        outcome = OrbitResidual(larger, tuple(batches))(theta[None], np.array([0]), True)
        if outcome.jacobian is None or not outcome.exists[0]:
            return 0.0
        moved = outcome.jacobian[0][:, -tangent.shape[1] :] - tangent
        powers.append(float(np.sum((moved - Q @ (Q.T @ moved)) ** 2)))
    return float(np.sqrt(np.mean(powers)))


def scan(
    structure: Structure, data: Dataset, fit: Fit, effect: Effect, shapes: Sequence[Sequence[float]]
) -> list[tuple[float, FloatArray, FloatArray]]:
    """What a small effect of each shape (`Effect.shapes`) takes off χ², and its internal values
    without and with a size; the best first, of neighbours within 8 % only the better."""
    larger = structure.with_effects(effect)
    rows = np.stack([effect.to_internal(shape) for shape in shapes])
    sized = np.array([value == 0 for value in shapes[0]])
    thetas = np.concatenate([np.tile(fit.theta, (len(rows), 1)), rows], axis=1)
    outcome = OrbitResidual(larger, data.fit)(thetas, np.arange(len(rows)), True)
    if outcome.jacobian is None or not outcome.exists.all():
        return []
    count = fit.theta.size
    Q = _span(outcome.jacobian[0][:, :count])
    rho = outcome.residual[0] - Q @ (Q.T @ outcome.residual[0])
    found = []
    for row, J in zip(rows, outcome.jacobian, strict=True):
        tangent = J[:, count:][:, sized]
        rest = tangent - Q @ (Q.T @ tangent)
        size = np.linalg.lstsq(rest, -rho, rcond=None)[0]
        large = row.copy()
        large[sized] = size
        found.append((float(rho @ rho - np.sum((rho + rest @ size) ** 2)), row, large))
    out: list[tuple[float, FloatArray, FloatArray]] = []
    for drop, row, large in sorted(found, key=lambda item: -item[0]):
        if all(np.abs(row[~sized] - other[~sized]).max() > 0.08 for _, other, _ in out):
            out.append((drop, row, large))
    return out


def stepped(
    structure: Structure,
    data: Dataset,
    fit: Fit,
    effect: Effect,
    rows: Sequence[FloatArray],
) -> list[FloatArray]:
    """Unknowns to start from with a small effect, of each of `rows`, its internal values where it
    has no size: a Gauss–Newton step of all unknowns, as much of it as leaves least of χ²."""
    if not rows:
        return []
    larger = structure.with_effects(effect)
    thetas = np.stack([np.r_[fit.theta, row] for row in rows])
    residual = OrbitResidual(larger, data.fit)
    outcome = residual(thetas, np.arange(len(thetas)), True)
    if outcome.jacobian is None:
        return []
    out = []
    for theta, exists, rho, J in zip(
        thetas, outcome.exists, outcome.residual, outcome.jacobian, strict=True
    ):
        if not exists:
            continue
        norms = np.sqrt(np.sum(J**2, axis=0))
        seen = norms > 1e-10 * norms.max()  # the shape of what has no size is not
        step = np.zeros_like(theta)
        step[seen] = np.linalg.lstsq(J[:, seen] / norms[seen], -rho, rcond=1e-10)[0] / norms[seen]
        tries = theta + STEPS[:, None] * step
        reached = residual(tries, np.arange(len(tries)), False)
        left = np.where(reached.exists, np.sum(reached.residual**2, axis=1), np.inf)
        if left.min() < NEAR * float(rho @ rho):
            out.append(tries[np.argmin(left)])
    return out


def _span(base: FloatArray) -> FloatArray:
    """An orthonormal basis of what the fitted parameters' tangents span."""
    return np.linalg.qr(base / (np.sqrt(np.sum(base**2, axis=0)) + 1e-300))[0]


def score_tests(
    structure: Structure, data: Dataset, fit: Fit, effects: Sequence[Effect], executor: Executor
) -> dict[str, ScoreTest]:
    """Score tests by the effects' keys, of those that have one."""
    found = executor.map(_score, [(structure, data, fit, e) for e in effects])
    return {e.key: s for e, s in zip(effects, found, strict=True) if s is not None}


def most_promising(
    scores: Mapping[str, ScoreTest], effects: Sequence[Effect], count: int
) -> list[Effect]:
    """The effects whose small sizes would take most off χ², each in its best form."""
    ranked = sorted((e for e in effects if e.key in scores), key=lambda e: -scores[e.key].drop)
    return list(first_of_each(ranked, lambda e: e.name).values())[:count]


def _score(item: tuple[Structure, Dataset, Fit, Effect]) -> ScoreTest | None:
    return score_test(*item)


def family_p(scores: Sequence[ScoreTest], seed: int = 0) -> float:
    """How probable it is that noise alone makes the most extreme of all score tests as extreme.

    Bootstrap of the smallest p-value: the tests share tangents, so their number overstates how
    many there are (Bonferroni). Residuals of a model that is right are white and of unit variance,
    ρ ~ N(0, I), and each drop is |basisᵀ ρ|². Where Bonferroni decides by itself, it is kept.
    """
    if not scores:
        return 1.0
    least = min(s.p_value for s in scores)
    bound = min(1.0, len(scores) * least)
    if not DECIDED < bound < 1.0:
        return bound
    rng = np.random.default_rng(seed)
    together = np.concatenate([s.basis for s in scores], axis=1)
    ends = np.cumsum([s.basis.shape[1] for s in scores])
    as_extreme = chi2_points(least, np.diff(ends, prepend=0))
    more = 0
    for _ in range(DRAWS // 1000):
        squares = (rng.standard_normal((1000, together.shape[0])) @ together) ** 2
        drops = np.diff(np.cumsum(squares, axis=1)[:, ends - 1], axis=1, prepend=0.0)
        more += int(np.sum((drops >= as_extreme).any(axis=1)))
    return min(bound, (more + 1) / (DRAWS + 1))
