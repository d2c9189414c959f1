"""From residual to cause: which effect the declared model lacks, where, how large, how sure.

1. Is there anything to explain? Whitened lack of fit on the fitted and on the validation runs.
2. Every form of every candidate effect is added to the declared model and led from several starts
   to full noise weight, beginning with noise of the misfit's own size: from the declared fit (one
   Gauss–Newton step along the effect's tangent, projected off what the fit absorbs), and, where
   no effect stands out from there, from the slow flow corrected for the effect, because a gross
   effect drags the declared fit far away. What falls behind drops out between stages.
3. If no single effect explains the data to within noise, pairs are grown from the best singles,
   then triples; an effect stays only if leaving it out makes the fit significantly worse, and
   others are tried in the place of each.
4. What explains the data must also predict the validation runs, lie in its plausible range, and
   have no rival: another effect that does as well, complexity counted (χ² + p ln n within 10).

Selection is by lack of fit and held-out runs with corrected significance; information criteria
only weigh candidates that are adequate already.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from identify import assess
from identify.chances import chi2_tail, chi2_tails
from identify.dataset import Dataset
from identify.effects import CANDIDATES, CATALOGUE
from identify.effects.scatter import Scatter
from identify.executor import Executor, InProcess
from identify.fit import Fit, OrbitResidual, fit_orbits
from identify.parameters import Estimate
from identify.results import Candidate
from identify.scatter import Spread, fit_scatter
from identify.start import (
    CoarseStart,
    candidates,
    coarse,
    corrected,
    every_start,
    physical_starts,
    polish,
)
from identify.structure import Effect, Known, Structure

FloatArray = npt.NDArray[np.float64]
Progress = Callable[[float, str], None]

ALPHA = 1e-3  # false-alarm probability of each significance test
EVIDENCE = 10.0  # difference of χ² + p ln n that rules a rival out («very strong»)
UNSETTLED = 60.0  # the same for a fit that has not converged
PREFERENCE = 6.0  # what a form without a law must gain on one of the same effect with a law
AGAIN = 30.0  # χ²/dof of a refitted effect that a bad start may have caused
REACH = 10.0  # times the best χ²: what lies beyond is refitted only if nothing nearer explains
SURELY = 4  # so many are refitted in any case
REFORMED = 3  # sets of effects of which other forms are tried
DRAWS = 20_000  # of the bootstrap of the smallest p-value
DECIDED = 1e-5  # Bonferroni's bound below which none is drawn
ROUGH = 0.05  # share of a coefficient's size that counts as noise where the search begins afar
FINE = 0.015  # share of noise below which all harmonics are looked at
GROSS = 300.0  # χ²/dof beyond which the declared fit is no place to start from alone


class Cancelled(Exception):
    """The search was cancelled by its caller."""


@dataclass(frozen=True)
class Tried:
    """One set of effects, refitted."""

    effects: tuple[Effect, ...]
    fit: Fit
    validation_error: float
    fit_p: float
    validation_p: float
    spread: Spread | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.effects)

    @property
    def key(self) -> tuple[str, ...]:
        return tuple(sorted(self.names))

    @property
    def key_of_forms(self) -> tuple[str, ...]:
        return tuple(sorted(e.key for e in self.effects))

    @property
    def adequate(self) -> bool:
        return self.fit_p > ALPHA and not self.validation_p < ALPHA

    @property
    def explains(self) -> bool:
        """Adequate, and with values that can be true."""
        return self.adequate and self.plausible

    @property
    def evidence(self) -> float:
        """χ² + p ln n: only compared between adequate candidates."""
        n, p, cost = self.fit.residual.size, self.fit.theta.size, 0.0
        if self.spread is not None:
            p, cost = p + len(self.spread.sizes), self.spread.penalty
        return self.fit.chi2 + cost + p * float(np.log(n))

    @property
    def estimates(self) -> dict[str, Estimate]:
        own = {} if self.spread is None else self.spread.sizes
        return {**self.fit.estimates, **own}

    @property
    def plausible(self) -> bool:
        if self.spread is not None and self.spread.objection:
            return False
        values = {name: e.value for name, e in self.estimates.items()}
        inside = all(q.plausible(values[q.name]) for e in self.effects for q in e.parameters)
        return inside and all(
            values[f"mode{i}.damping"] < 0.7 for i in range(1, self.fit.structure.mode_count + 1)
        )


@dataclass(frozen=True)
class Search:
    """All that was tried, best first, and what it was tried against."""

    tried: tuple[Tried, ...]
    singles: tuple[Tried, ...]


def known_sizes(data: Dataset, fit: Fit) -> Known:
    """Sizes that starting values lean on."""
    v = fit.values
    n = fit.structure.mode_count
    forced = [b for b in data.fit if not b.free]
    velocity = float(np.median(np.concatenate([np.abs(b.measured[:, 0]) for b in forced])))
    drive = float(np.max(np.concatenate([np.abs(b.at.drive[:, 0]) for b in forced])))
    omega = np.concatenate([b.at.omega for b in forced]) / (2 * np.pi)
    pole = 2 * np.pi * v.get("flame.pole_hz", data.free_hz)
    return Known(
        free_hz=data.free_hz,
        modes_hz=tuple(v[f"mode{i}.frequency_hz"] for i in range(1, n + 1)),
        modes_damping=tuple(v[f"mode{i}.damping"] for i in range(1, n + 1)),
        flame_residues=tuple(v[f"mode{i}.flame_residue"] for i in range(1, n + 1)),
        speaker_residues=tuple(v[f"mode{i}.speaker_residue"] for i in range(1, n + 1)),
        flame_input_amplitude=velocity / abs(2j * np.pi * data.free_hz + pole),
        velocity_amplitude=velocity,
        drive_amplitude=drive,
        band_hz=(float(omega.min()), float(omega.max())),
        runs=sum(b.runs for b in data.fit),
    )


@dataclass(frozen=True)
class ScoreTest:
    """An effect's tangent at its neutral point, projected off the fitted parameters' tangents.

    `drop` is the decrease of χ² that a small effect along it would bring, `size` its estimated
    internal values, `share` the part of the tangent that the fit cannot absorb, `p_value` of the
    drop for as many degrees of freedom as the tangent keeps, `basis` (n, degrees of freedom) an
    orthonormal one of what it keeps: drop = |basisᵀ ρ|².
    """

    drop: float
    size: FloatArray
    share: float
    p_value: float
    basis: FloatArray


def score_test(structure: Structure, data: Dataset, fit: Fit, effect: Effect) -> ScoreTest | None:
    """Score test of one more effect at a fitted model; None where it has no neutral point."""
    neutral = effect.neutral()
    if neutral is None:
        return None
    larger = structure.with_effects(effect)
    inner = [q.to_internal(v) for q, v in zip(effect.parameters, neutral, strict=True)]
    outcome = OrbitResidual(larger, data.fit)(np.r_[fit.theta, inner][None], np.array([0]), True)
    if outcome.jacobian is None or not outcome.exists[0]:
        return None
    rho, J = outcome.residual[0], outcome.jacobian[0]
    base, tangent = J[:, : fit.theta.size], J[:, fit.theta.size :]
    Q, _ = np.linalg.qr(base / (np.sqrt(np.sum(base**2, axis=0)) + 1e-300))
    rest = tangent - Q @ (Q.T @ tangent)
    norm = float(np.linalg.norm(tangent))
    if not norm > 0:
        return None
    share = float(np.linalg.norm(rest)) / norm
    if share < 1e-5:  # wholly absorbed: what is left of the tangent is rounding
        return None
    U, S, V = np.linalg.svd(rest, full_matrices=False)
    kept = 1e-8 * S[0] < S
    basis = U[:, kept]
    along = basis.T @ rho
    step = -V[kept].T @ (along / S[kept])
    drop = float(along @ along)
    return ScoreTest(drop, step, share, chi2_tail(drop, basis.shape[1]), basis)


def score_tests(
    structure: Structure, data: Dataset, fit: Fit, effects: Sequence[Effect], executor: Executor
) -> dict[str, ScoreTest]:
    """Score tests by the effects' keys, of those that have one."""
    found = executor.map(_score, [(structure, data, fit, e) for e in effects])
    return {e.key: s for e, s in zip(effects, found, strict=True) if s is not None}


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
    more = 0
    for _ in range(DRAWS // 1000):
        squares = (rng.standard_normal((1000, together.shape[0])) @ together) ** 2
        drops = np.diff(np.cumsum(squares, axis=1)[:, ends - 1], axis=1, prepend=0.0)
        dofs = np.diff(ends, prepend=0)
        more += int(np.sum(chi2_tails(drops, dofs).min(axis=1) <= least))
    return min(bound, (more + 1) / (DRAWS + 1))


@dataclass(frozen=True)
class _Task:
    """What a worker needs to try one effect on top of a structure."""

    structure: Structure
    data: Dataset
    rough: Dataset
    base: Fit
    effect: Effect
    known: Known
    shares: tuple[float, float, float]  # of each coefficient's size that count as noise, by stage
    score: ScoreTest | None
    placements: tuple[tuple[float, ...], ...] = ()

    @property
    def seen(self) -> Dataset:
        """What the first stages look at: all harmonics where the misfit is small."""
        return self.rough if self.shares[0] > FINE else self.data

    @property
    def proposals(self) -> list[tuple[float, ...]]:
        """The effect's own starting values."""
        return [tuple(row) for row in self.effect.starts(self.known)]


def _louder(theta: FloatArray, names: Sequence[str], gain: float) -> FloatArray:
    """Unknowns of these names, the speaker `gain` times as loud."""
    spoken = [n.endswith("speaker_residue") for n in names]
    return np.where(spoken, theta * gain, theta)


def _loudness(data: Dataset, effects: Sequence[Effect], p: Mapping[str, float]) -> float:
    """What effects of these values make of the drive at the free frequency: a factor whose sign
    is that of its real part (a resonance below it turns the sign), 1 where it says nothing."""
    at = data.fit[0].at.take(np.array([0]))
    s = np.array([[2j * np.pi * data.free_hz]])
    gain = complex(np.prod([np.ravel(e.actuator(p, at, s))[0] for e in effects]))
    signed = float(np.copysign(abs(gain), gain.real))
    return signed if np.isfinite(signed) and signed != 0 else 1.0


def _beside(
    structure: Structure,
    theta: FloatArray,
    data: Dataset,
    effect: Effect,
    values: Sequence[float],
) -> FloatArray:
    """Unknowns of `structure` as they are with one more effect of these values: as loud."""
    p = {q.name: v for q, v in zip(effect.parameters, values, strict=True)}
    return _louder(theta, structure.parameters.names, 1 / _loudness(data, [effect], p))


def _first_stage(task: _Task) -> list[CoarseStart]:
    """The best starts of one effect near the base fit at the first share of noise, best first."""
    larger = task.structure.with_effects(task.effect)
    own = task.effect.parameters
    inner = [[q.to_internal(v) for q, v in zip(own, row, strict=True)] for row in task.proposals]
    thetas = [
        np.r_[_beside(task.structure, task.base.theta, task.data, task.effect, values), row]
        for values, row in zip(task.proposals, inner, strict=True)
    ]
    neutral = task.effect.neutral()
    if neutral is not None:  # never worse than without the effect
        still = [q.to_internal(v) for q, v in zip(own, neutral, strict=True)]
        thetas.append(np.r_[task.base.theta, still])
    if task.score is not None:
        bound = 20 * np.max(np.abs(inner), axis=0) + 1e-12
        thetas.append(np.r_[task.base.theta, np.clip(task.score.size, -bound, bound)])
    first = task.shares[0]
    starts = coarse(larger, task.seen, thetas, 2 * first)[:3]
    richer = None if task.structure.effects else task.effect.restated(task.structure)
    if richer is not None:
        found = every_start(richer, task.rough)[:6]
        restated = [
            task.effect.from_restated(task.structure, richer.parameters.plain(s.theta))
            for s in found
        ]
        rows = [larger.parameters.to_internal(v) for v in restated]
        starts += polish(larger, task.rough, coarse(larger, task.rough, rows), (ROUGH,), 8)[:2]
    return polish(larger, task.seen, starts, (first,), 8)[:3]


def _from_afar(task: _Task) -> list[CoarseStart]:
    """The same from the slow flow corrected for the effect, wherever the base fit is."""
    larger = task.structure.with_effects(task.effect)
    inherited = [task.base.values[q.name] for e in task.structure.effects for q in e.parameters]
    rows = [[*inherited, *row] for row in task.proposals]
    starts = physical_starts(larger, task.rough, rows, task.placements)[:4]
    led = polish(larger, task.rough, starts, (ROUGH,), 8)[:3]
    return polish(larger, task.seen, led, (task.shares[0],), 8)[:3]


def _middle_stage(item: tuple[_Task, list[CoarseStart]]) -> list[CoarseStart]:
    """The survivors' starts at the second share of noise, best first."""
    task, starts = item
    larger = task.structure.with_effects(task.effect)
    return polish(larger, task.seen, starts, shares=(task.shares[1],), iterations=10)[:2]


def _second_stage(item: tuple[_Task, list[CoarseStart]]) -> Fit:
    task, starts = item
    larger = task.structure.with_effects(task.effect)
    thetas = np.stack([s.theta for s in starts])
    fit = fit_orbits(larger, task.data, thetas, continuation=(task.shares[2], 0.0))
    return _canonical(fit, task.data)


def _canonical(fit: Fit, data: Dataset) -> Fit:
    """The same fit with its effects' parameters named by the effects' own rules."""
    structure = fit.structure
    plain = replace(structure, effects=())
    for effect in structure.effects:
        if not fit.converged or effect.restated(plain) is None:
            continue
        named = effect.from_restated(plain, effect.to_restated(plain, fit.values))
        names = [*plain.parameters.names, *(q.name for q in effect.parameters)]
        values = {**fit.values, **dict(zip(names, named, strict=True))}
        theta = structure.parameters.to_internal([values[n] for n in structure.parameters.names])
        if np.allclose(theta, fit.theta, rtol=1e-9, atol=1e-12):
            continue
        renamed = fit_orbits(structure, data, theta, continuation=(0.0,))
        # beside an effect that speaks of the modes by number, another name is another model
        if renamed.converged and renamed.chi2 < fit.chi2 + 1.0:
            fit = renamed
    return fit


def shares_of(base: Fit, data: Dataset) -> tuple[float, float, float]:
    """Noise of the stages as shares of each coefficient's size: of the size of the misfit.

    Much coarser, and an effect that explains it does no better than one that does not.
    """
    misfit = assess.relative_error(
        [assess.predict(base.structure, base.theta, b) for b in data.fit]
    )
    first = float(np.clip(2 * misfit, 1e-4, ROUGH)) if np.isfinite(misfit) else ROUGH
    return first, first / 5, min(0.003, first / 15)


def _one_stands_out(costs: Sequence[float], share: float) -> bool:
    """Whether one effect takes away nearly all that the usual one leaves, seen at all harmonics."""
    return share <= FINE and bool(costs) and min(costs) < float(np.median(costs)) / REACH


def try_effects(
    structure: Structure,
    data: Dataset,
    base: Fit,
    effects: Sequence[Effect],
    *,
    executor: Executor,
    keep: int,
    far: bool,
    progress: Callable[[float, str], None],
    scores: Mapping[str, ScoreTest] | None = None,
) -> list[Tried]:
    """Each effect added to `structure`; the best `keep` are refitted in full, best first.

    Started near the `base` fit; with `far` from the slow flow too, where none comes of that.
    `scores` are the effects' tests at the base fit, where they are known already.
    """
    if scores is None:
        scores = score_tests(structure, data, base, effects, executor)
    known = known_sizes(data, base)
    rough = data.coarse()
    shares = shares_of(base, data)
    tasks = [
        _Task(structure, data, rough, base, e, known, shares, scores.get(e.key)) for e in effects
    ]
    staged: list[tuple[_Task, list[CoarseStart]]] = []
    for task, starts in zip(tasks, executor.map(_first_stage, tasks), strict=True):
        staged.append((task, starts))
        progress(len(staged) / len(tasks) * 0.3, f"trying {task.effect.key}")
    if far and not _one_stands_out([s[0].cost for _, s in staged if s], shares[0]):
        placements = _likely_placements(replace(structure, effects=()), rough)
        tasks = [replace(t, placements=placements) for t in tasks]
        for i, starts in enumerate(executor.map(_from_afar, tasks)):
            both = sorted([*staged[i][1], *starts], key=lambda s: s.cost)[:3]
            staged[i] = (tasks[i], both)
            progress(0.3 + (i + 1) / len(tasks) * 0.2, f"trying {tasks[i].effect.key} from afar")
    better = _heats(staged, 5 * keep // 2)
    refined: list[tuple[_Task, list[CoarseStart]]] = []
    for (task, _), starts in zip(better, executor.map(_middle_stage, better), strict=True):
        refined.append((task, starts))
        progress(0.5 + len(refined) / len(better) * 0.2, f"refining {task.effect.key}")

    def refit(
        chosen: Sequence[tuple[_Task, list[CoarseStart]]], first: float, last: float
    ) -> list[Tried]:
        out = []
        for i, fit in enumerate(executor.map(_second_stage, chosen), start=1):
            effect = chosen[i - 1][0].effect
            progress(first + i / len(chosen) * (last - first), f"refitting with {effect.key}")
            if np.isfinite(fit.chi2):
                out.append(tried((*structure.effects, effect), fit, data))
        return out

    # two forms of an effect at the most, so that other effects get their turn: first those within
    # reach of the best …
    chosen = _best(refined, keep, forms=2)
    costs = [starts[0].cost for _, starts in chosen]  # ascending
    near = max(SURELY, sum(cost <= REACH * costs[0] for cost in costs))
    out = refit(chosen[:near], 0.7, 0.85)
    if not any(t.explains for t in out):
        out += refit(chosen[near:], 0.85, 0.95)
    # … and then all forms of the best two: at coarse noise they could not be told apart
    if not any(t.explains for t in out):
        poor = [t for t in sorted(out, key=_misfit) if not t.adequate]
        names = list(dict.fromkeys(t.effects[-1].name for t in poor))[:2]
        done = {task.effect.key for task, _ in chosen}
        reached = {t.effect.key: s for t, s in refined if s}
        rest = [
            (t, reached.get(t.effect.key, s[:2]))
            for t, s in staged
            if s and t.effect.name in names and t.effect.key not in done
        ]
        out += refit(rest, 0.95, 1.0)
    return sorted(out, key=_misfit)


def started_again(singles: Sequence[Tried], data: Dataset, executor: Executor) -> list[Tried]:
    """The best of each effect started once more as if its values were known.

    A gross effect leads the fit of everything else astray, yet is often nearly right itself: with
    the data corrected for it, the declared model's own starting values serve again.
    """
    best = [t for t in best_by_name(singles) if t.fit.chi2_per_dof > AGAIN][:4]
    again = [
        tried(t.effects, fit, data)
        for t, fit in zip(best, executor.map(_again, [(t, data) for t in best]), strict=True)
        if np.isfinite(fit.chi2) and fit.chi2 < t.fit.chi2
    ]
    return sorted([*singles, *again], key=_misfit)


def _again(item: tuple[Tried, Dataset]) -> Fit:
    t, data = item
    larger, plain = t.fit.structure, replace(t.fit.structure, effects=())
    values = t.fit.values
    row = [values[q.name] for e in t.effects for q in e.parameters]
    own = t.fit.theta[len(plain.parameters) :]
    rough = data.coarse()
    clean = corrected(data, t.effects, values)
    exact = [] if clean is None else [np.r_[theta, own] for theta in candidates(plain, clean)]
    starts = coarse(larger, rough, exact)[:5] + physical_starts(larger, rough, [row])[:5]
    polished = polish(larger, rough, starts, shares=(0.05, 0.01), iterations=10)[:3]
    thetas = np.stack([*(s.theta for s in polished), t.fit.theta])
    return fit_orbits(larger, data, thetas, continuation=(0.003, 0.0), iterations=100)


def try_scatters(
    structure: Structure, data: Dataset, base: Fit, scatters: Sequence[Scatter]
) -> list[Tried]:
    """Each kind of random difference from run to run on top of `structure`."""
    out = []
    for s in scatters:
        spread = fit_scatter(structure, data, base, s)
        if spread is not None:
            t = tried((*structure.effects, s), spread.fit, spread.data)
            out.append(replace(t, spread=spread))
    return out


def _best(
    staged: Sequence[tuple[_Task, list[CoarseStart]]], keep: int, forms: int
) -> list[tuple[_Task, list[CoarseStart]]]:
    """The `keep` most promising, no more than `forms` of one effect."""
    out: list[tuple[_Task, list[CoarseStart]]] = []
    for item in sorted((s for s in staged if s[1]), key=lambda s: s[1][0].cost):
        same = sum(o[0].effect.name == item[0].effect.name for o in out)
        if same < forms:
            out.append(item)
    return out[:keep]


def _heats(
    staged: Sequence[tuple[_Task, list[CoarseStart]]], keep: int
) -> list[tuple[_Task, list[CoarseStart]]]:
    """The best form of every effect, and the most promising of the others up to `keep` in all.

    At five per cent noise nearly all do well: no effect may drop out for having few forms.
    """
    firsts = _best(staged, len(staged), forms=1)
    taken = {task.effect.key for task, _ in firsts}
    others = [s for s in _best(staged, len(staged), forms=3) if s[0].effect.key not in taken]
    return [*firsts, *others[: max(keep - len(firsts), 0)]]


def _likely_placements(structure: Structure, data: Dataset) -> tuple[tuple[float, ...], ...]:
    """Positions of the other modes (over the free frequency) of the best coarse starts."""
    if structure.mode_count == 1:
        return ((),)
    out: list[tuple[float, ...]] = []
    for start in physical_starts(structure, data)[:20]:
        values = structure.parameters.plain(start.theta)
        ratio = tuple(
            round(values[f"mode{i}.frequency_hz"] / data.free_hz, 6)
            for i in range(2, structure.mode_count + 1)
        )
        if ratio not in out:
            out.append(ratio)
    return tuple(out[:2])


def tried(effects: tuple[Effect, ...], fit: Fit, data: Dataset) -> Tried:
    """A refitted candidate with its adequacy on fitted and held-out runs."""
    held_out = [assess.predict(fit.structure, fit.theta, b) for b in data.validation]
    if held_out:
        error = assess.relative_error(held_out)
        p_out = assess.validation_p(held_out, fit.covariance)
    else:
        error, p_out = float("nan"), float("nan")
    return Tried(effects, fit, error, assess.lack_of_fit_p(fit.chi2, fit.dof), p_out)


def best_by_name(tries: Sequence[Tried]) -> list[Tried]:
    """The best form of each set of effect names, best first."""
    best: dict[tuple[str, ...], Tried] = {}
    for t in sorted(tries, key=_merit):
        best.setdefault(t.key, t)
    return sorted(best.values(), key=_misfit)


def _misfit(t: Tried) -> float:
    return t.fit.chi2


def best_form(good: Sequence[Tried]) -> Tried:
    """The best of adequate candidates, in its preferred form."""
    best = min(good, key=lambda t: t.evidence)
    return min((t for t in good if t.key == best.key), key=_merit)


def _merit(t: Tried) -> tuple[bool, float]:
    """Adequate ones first, by evidence; the others by misfit."""
    good = t.explains
    handicap = PREFERENCE if any(e.empirical for e in t.effects) else 0.0
    return not good, t.evidence + handicap if good else t.fit.chi2


def search(
    structure: Structure,
    data: Dataset,
    base: Fit,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
    catalogue: Sequence[Effect] = CANDIDATES,
    depth: int = 3,
    scores: Mapping[str, ScoreTest] | None = None,
) -> Search:
    """Forward selection of up to `depth` effects with backward elimination.

    `scores` are the candidates' tests at the base fit, where they are known already.
    """
    run = executor or InProcess()
    report = progress or (lambda share, text: None)
    scatters = [e for e in catalogue if isinstance(e, Scatter)]
    available = [e for e in catalogue if usable(e, data, structure)]
    singles = try_effects(
        structure,
        data,
        base,
        available,
        executor=run,
        keep=8,
        far=base.chi2_per_dof > GROSS,
        progress=lambda share, text: report(0.6 * share, text),
        scores=scores,
    )
    if not any(t.adequate for t in singles) and base.chi2_per_dof > GROSS:
        report(0.6, "starting the best once more from afar")
        singles = started_again(singles, data, run)
    singles = [*singles, *_other_forms(singles, data, available)]
    everything = list(singles)
    if not any(t.explains for t in everything):
        report(0.6, "trying run-to-run scatter")
        everything += try_scatters(structure, data, base, scatters)
    level = best_by_name(singles)
    extended: set[tuple[str, ...]] = {()}
    for _ in range(2, depth + 1):
        # a spread does not end the search: a pair may explain the same without chance
        if any(t.explains and t.spread is None for t in everything):
            break
        grown: list[Tried] = []
        parents = sorted(level, key=lambda t: not t.fit.converged)[:2]
        for parent in parents:
            extended.add(parent.key_of_forms)
            rest = [e for e in available if e.name not in parent.names]
            grown += try_effects(
                parent.fit.structure, data, parent.fit, rest, executor=run, keep=5, far=False,
                progress=lambda share, text: report(0.6 + 0.35 * share, text),
            )  # fmt: skip
        if not grown:
            break
        if not any(t.adequate for t in grown) and base.chi2_per_dof > GROSS:
            grown = started_again(grown, data, run)
        if not any(t.explains for t in grown):
            report(0.6, "trying other forms of the best")
            grown += _reformed(grown, data, available)
        everything += [eliminate(t, data) for t in grown]
        level = best_by_name(grown)
        if len(parents[0].effects) == 1 and not any(t.explains for t in everything):
            report(0.6, "trying run-to-run scatter beside an effect")
            for parent in parents:
                if parent.effects[0].location != "experiment":  # which would know of time
                    everything += try_scatters(parent.fit.structure, data, parent.fit, scatters)
    if not any(t.explains for t in everything):
        everything += _reformed([t for t in everything if t.spread is None], data, available)
    everything += _in_their_places(everything, data, available, run, extended, report)
    everything += _settled(everything, data, run)
    return Search(
        tuple(sorted(everything, key=lambda t: (not t.adequate, t.fit.chi2))), tuple(singles)
    )


def _in_their_places(
    tries: Sequence[Tried],
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    extended: set[tuple[str, ...]],
    report: Progress,
) -> list[Tried]:
    """Other effects in the place of each of several that explain the data together.

    The set was grown from one of them, so that only the places of the others have been contested.
    One effect in the place of them all is sought too, from what they say of the declared model.
    `extended` are the sets (of keys, sorted) that have been grown from already.
    """
    good = [t for t in tries if t.explains and t.spread is None]
    if not good:
        return []
    best = best_form(good)
    if len(best.effects) == 1:
        return []
    out: list[Tried] = []
    for kept in [*combinations(best.effects, len(best.effects) - 1), ()]:
        if kept and tuple(sorted(e.key for e in kept)) in extended:
            continue
        base = _with_fewer(best, kept, data) if kept else part_of(best, (), data)
        if not np.isfinite(base.chi2):
            continue
        names = {e.name for e in kept}
        tried_already = {e.key for e in best.effects}
        out += try_effects(
            base.structure, data, base,
            [a for a in available if a.name not in names and a.key not in tried_already],
            executor=run, keep=5, far=False, scores=None if kept else {},
            progress=lambda share, text: report(0.95 + 0.05 * share, text),
        )  # fmt: skip
    return [eliminate(t, data) for t in out]


def _settled(tries: Sequence[Tried], data: Dataset, run: Executor) -> list[Tried]:
    """What had not converged and might yet be a rival of the best, led to the end.

    Weak effects leave long flat valleys: a rival must not be ruled out for want of iterations.
    """
    good = [t for t in tries if t.explains]
    if not good:
        return []
    least = best_form(good).evidence + UNSETTLED
    near = [
        t
        for t in best_by_name([t for t in tries if t.spread is None])
        if not t.fit.converged and t.evidence < least
    ]
    fits = run.map(_to_the_end, [(t, data) for t in near])
    pairs = zip(near, fits, strict=True)
    return [tried(t.effects, fit, data) for t, fit in pairs if fit.chi2 < t.fit.chi2]


def _to_the_end(item: tuple[Tried, Dataset]) -> Fit:
    t, data = item
    last = t.effects[-1]
    others = t.fit.theta[: -len(last.parameters)]
    rows = last.starts(known_sizes(data, t.fit))
    inner = [[q.to_internal(v) for q, v in zip(last.parameters, r, strict=True)] for r in rows]
    again = [s.theta for s in coarse(t.fit.structure, data, [np.r_[others, r] for r in inner])]
    thetas = np.stack([t.fit.theta, *again[:3]])
    return fit_orbits(t.fit.structure, data, thetas, continuation=(0.003, 0.0), iterations=200)


def _reformed(grown: Sequence[Tried], data: Dataset, available: Sequence[Effect]) -> list[Tried]:
    """Other forms of the best few sets, one after the other for as long as that helps."""
    out: list[Tried] = []
    for t in best_by_name(grown)[:REFORMED]:
        current = t
        for _ in range(len(t.effects) + 1):
            found = _other_forms([current], data, available)
            out += found
            best = min(found, key=_misfit, default=current)
            if best.explains or not best.fit.chi2 < current.fit.chi2 - EVIDENCE:
                break
            current = best
    return out


def _other_forms(tries: Sequence[Tried], data: Dataset, available: Sequence[Effect]) -> list[Tried]:
    """The other forms of the effects of the best of `tries`, started from where it ended.

    A form with one parameter less may do as well, and is then what should be named; where none
    explains the data, another may be nearer to the truth than the one that was refitted first.
    """
    good = [t for t in tries if t.explains]
    best = min(good, key=lambda t: t.evidence) if good else min(tries, key=_misfit, default=None)
    if best is None:
        return []
    known = known_sizes(data, best.fit)
    done = {t.key_of_forms for t in tries if t.adequate}
    out = []
    for e in best.effects:
        kept = tuple(o for o in best.effects if o is not e)
        base = part_of(best, kept, data)
        for form in available:
            forms = tuple(sorted(o.key for o in (*kept, form)))
            if form.name != e.name or form.key == e.key or forms in done:
                continue
            larger = base.structure.with_effects(form)
            rows = form.starts(known)
            if [q.unit for q in form.parameters] == [q.unit for q in e.parameters]:
                rows = [*rows, tuple(best.fit.values[q.name] for q in e.parameters)]
            thetas = [
                np.r_[
                    _beside(base.structure, base.theta, data, form, row),
                    [q.to_internal(v) for q, v in zip(form.parameters, row, strict=True)],
                ]
                for row in rows
            ]
            found = coarse(larger, data, thetas)[:2]
            if not found:
                continue
            starts = np.stack([s.theta for s in found])
            fit = fit_orbits(larger, data, starts, continuation=(0.003, 0.0), iterations=30)
            if np.isfinite(fit.chi2):
                out.append(tried(larger.effects, fit, data))
    return out


def part_of(t: Tried, effects: tuple[Effect, ...], data: Dataset) -> Fit:
    """The values of `t` with some of its effects, not fitted again: as loud as with all."""
    structure, values = replace(t.fit.structure, effects=effects), t.fit.values
    theta = structure.parameters.to_internal([values[n] for n in structure.parameters.names])
    left = [e for e in t.effects if e not in effects]
    theta = _louder(theta, structure.parameters.names, _loudness(data, left, values))
    return replace(t.fit, structure=structure, theta=theta)


def _with_fewer(t: Tried, effects: tuple[Effect, ...], data: Dataset) -> Fit:
    """The fit with only some of the effects of `t`, started from its values."""
    smaller, values = replace(t.fit.structure, effects=effects), t.fit.values
    theta = smaller.parameters.to_internal([values[n] for n in smaller.parameters.names])
    return fit_orbits(smaller, data, theta, continuation=(0.003, 0.0))


def eliminate(candidate: Tried, data: Dataset) -> Tried:
    """Backward elimination: effects without which the fit is no worse than chance are dropped."""
    current = candidate
    while len(current.effects) > 1:
        smaller = []
        for leave in current.effects:
            rest = tuple(e for e in current.effects if e is not leave)
            fit = _with_fewer(current, rest, data)
            gain = fit.chi2 - current.fit.chi2
            freedom = current.fit.theta.size - fit.theta.size
            if np.isfinite(gain) and chi2_tail(gain, freedom) > ALPHA / len(CATALOGUE):
                smaller.append((gain, rest, fit))
        if not smaller:
            break
        _, rest, fit = min(smaller, key=lambda item: item[0])
        current = tried(rest, fit, data)
    return current


def without_effects(structure: Structure, data: Dataset, tries: Sequence[Tried]) -> Fit | None:
    """The declared model fitted from where the best of `tries` ended, their effects left out.

    None where nothing finite comes of it. Several effects that do equally well are often a sign
    that the declared fit itself had ended in the wrong minimum.
    """
    count = len(structure.parameters)
    best = sorted((t for t in tries if np.isfinite(t.fit.chi2)), key=_misfit)[:4]
    if not best:
        return None
    thetas = np.stack([t.fit.theta[:count] for t in best])
    fit = fit_orbits(structure, data, thetas, continuation=(0.003, 0.0))
    return fit if np.isfinite(fit.chi2) else None


def refitted(tries: Sequence[Tried], data: Dataset, keep: int = 6) -> list[Tried]:
    """The best of each set of effects fitted to `data`, whose covariances have changed, from where
    they ended. A spread, which has widened its own data, is left out."""
    best = [t for t in best_by_name(tries) if t.spread is None][:keep]
    out = []
    for t in best:
        fit = fit_orbits(t.fit.structure, data, t.fit.theta, continuation=(0.0,))
        if np.isfinite(fit.chi2):
            out.append(tried(t.effects, fit, data))
    return out


def usable(effect: Effect, data: Dataset, structure: Structure) -> bool:
    """Whether the effect can be added to this declared model and asked of these data."""
    if isinstance(effect, Scatter):  # no parameter describes it: `try_scatters`
        return False
    if effect.mode_count not in (None, structure.mode_count):
        return False
    pressure = any(np.any(b.at.pressure != 0) for b in data.fit)
    return not ("pressure" in effect.needs and not pressure)


def rivals(best: Tried, others: Sequence[Tried]) -> list[Tried]:
    """Adequate, plausible sets of other effects that the data do not rule out against `best`.

    What only adds an effect to one of them is none of its own.
    """
    found = [
        t
        for t in others
        if t.key != best.key
        and t.explains
        and t.evidence < best.evidence + EVIDENCE
        and not set(best.names) < set(t.names)
        and not _extends(t, best)
    ]
    return [t for t in found if not any(set(o.names) < set(t.names) for o in found)]


def other_forms(best: Tried, others: Sequence[Tried]) -> dict[str, tuple[str, ...]]:
    """By effect, its other forms that the data do not rule out against those of `best`."""
    out: dict[str, list[str]] = {name: [] for name in best.names}
    for t in others:
        if t.key != best.key or not t.explains:
            continue
        if t.evidence < best.evidence + EVIDENCE:
            for e in t.effects:
                out[e.name].append(e.form)
    own = {e.name: e.form for e in best.effects}
    return {n: tuple(f for f in dict.fromkeys(forms) if f != own[n]) for n, forms in out.items()}


def _extends(t: Tried, best: Tried) -> bool:
    """Whether `t` is `best` with an extension that the data do not ask for."""
    general = {n for e in t.effects for n in e.generalises}
    return t.fit.theta.size > best.fit.theta.size and set(best.names) <= set(t.names) | general


def candidate(
    t: Tried, smaller_chi2: float, smaller_p: int, tests: int, equal: Sequence[str]
) -> Candidate:
    """The candidate's line of the report: its gain over the declared model, corrected."""
    freedom = max(t.fit.theta.size - smaller_p, 1)
    raw = chi2_tail(smaller_chi2 - t.fit.chi2, freedom)
    own = {q.name for e in t.effects for q in e.parameters}
    return Candidate(
        effects=t.names,
        forms=tuple(e.form for e in t.effects),
        locations=tuple(e.location for e in t.effects),
        chi2=t.fit.chi2,
        chi2_per_dof=t.fit.chi2_per_dof,
        validation_error=t.validation_error,
        p_value=min(1.0, raw * tests),
        parameters={n: e for n, e in t.estimates.items() if n in own},
        equivalent_to=tuple(equal),
        plausible=t.plausible,
        adequate=t.adequate,
        note=_note(t),
    )


def _note(t: Tried) -> str:
    if not t.fit.converged:
        return t.fit.reason
    return "" if t.spread is None else t.spread.objection
