"""Every effect added to a model, refitted in stages of falling noise; what falls behind drops out.

The first stages run at noise of the misfit's own size: from the base fit (one Gauss–Newton step
along the effect's tangent, projected off what the fit absorbs), and, where no effect stands out
from there, from the slow flow corrected for the effect, because a gross effect drags the declared
fit far away. Where the tangent alone promises most of the misfit, the fit goes there directly too:
beside a gross effect that is known exactly, coarse noise would lose what the base fit knows.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify.dataset import Dataset
from identify.effect import Effect, Known
from identify.executor import Executor, Progress
from identify.fit import Fit, fit_orbits, no_better
from identify.start import (
    CoarseStart,
    candidates,
    coarse,
    dense_placements,
    distinct,
    every_start,
    physical_starts,
    polish,
    signed_starts,
)
from identify.structure import Structure
from identify.trace.restated import canonical, renamed
from identify.trace.scores import ScoreTest, scan, score_tests, stepped
from identify.trace.sizes import ROUGH, beside, known_sizes, shares_of
from identify.trace.tried import Tried, few_of_each, first_of_each, misfit, tried

FloatArray = npt.NDArray[np.float64]

REACH = 10.0  # times the best χ²: what lies beyond is refitted only if nothing nearer explains
SURELY = 4  # so many are refitted in any case
PROMISED = 0.4  # share of χ² that a small effect would take away: refitted straight from the base
OF_MODES = 48  # starts of one more mode, which may be anywhere and of either sign
RIVAL_FORMS = 2  # of an effect that are led in from afar where another explains the data
OWN = 12  # starting values of an effect that are all led in from afar
SHAPES = 4  # so many are started from of an effect whose shape is unknown …
STEPPED = 2  # … and from so many with a step of all unknowns
NO_RIVAL = 30.0  # times what noise leaves: what promises no less is none of what explains the data
FINE = 0.015  # share of noise below which all harmonics are looked at


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
    hopeless: float = np.inf  # times what noise leaves, where nothing else matters
    promise: float = 0.0  # what a small effect would take off χ² by the base fit's tangents …
    small: tuple[FloatArray, ...] = ()  # … and unknowns with it, to start from
    placements: tuple[tuple[float, ...], ...] = ()

    @property
    def seen(self) -> Dataset:
        """What the first stages look at: all harmonics where the misfit is small."""
        return self.rough if self.shares[0] > FINE else self.data

    @property
    def richer(self) -> Structure | None:
        """The structure that says the same as the declared one with the effect, if any."""
        return None if self.structure.effects else self.effect.restated(self.structure)

    @property
    def proposals(self) -> list[tuple[float, ...]]:
        """The effect's own starting values."""
        return [tuple(row) for row in self.effect.starts(self.known)]


def _first_stage(task: _Task) -> list[CoarseStart]:
    """The best starts of one effect near the base fit at the first share of noise, best first."""
    larger = task.structure.with_effects(task.effect)
    inner = [task.effect.to_internal(row) for row in task.proposals]
    thetas = [
        np.r_[beside(task.structure, task.base.theta, task.data, task.effect, values), row]
        for values, row in zip(task.proposals, inner, strict=True)
    ]
    first = task.shares[0]
    if task.effect.neutral() is None:
        starts = coarse(larger, task.seen, thetas, 2 * first)[:3]
        starts += coarse(larger, task.seen, task.small, 2 * first)[:1]
    else:
        starts = coarse(larger, task.seen, [*thetas, *task.small], 2 * first)[:3]
    if task.richer is not None:
        begun = every_start(task.richer, task.rough)[:6]
        rows = renamed(task.effect, larger, task.richer, [s.theta for s in begun])
        starts += polish(larger, task.rough, coarse(larger, task.rough, rows), (ROUGH,), 8)[:2]
    return polish(larger, task.seen, starts, (first,), 8)[:3]


def slow_flow_starts(
    structure: Structure,
    data: Dataset,
    rows: Sequence[Sequence[float]],
    placements: Sequence[tuple[float, ...]],
) -> list[CoarseStart]:
    """The slow flow's starts, with flame residues of either sign in the modes that do not sing."""
    begin = physical_starts if structure.mode_count == 1 else signed_starts
    return begin(structure, data, rows, placements)


def _from_afar(task: _Task) -> list[CoarseStart]:
    """The same from the slow flow corrected for the effect, wherever the base fit is."""
    larger = task.structure.with_effects(task.effect)
    inherited = [task.base.values[q.name] for e in task.structure.effects for q in e.parameters]
    rows = [[*inherited, *row] for row in task.proposals]
    every = slow_flow_starts(larger, task.rough, rows, task.placements)
    # the best, and the best of each of the effect's own: coarse noise tells those apart badly
    inner = len(task.base.theta)
    of_each = list(first_of_each(every, lambda s: s.theta[inner:].tobytes()).values())
    starts = every[:4]
    starts += [s for s in of_each[:OWN] if not any(s is other for other in starts)]
    if task.richer is not None:  # of another mode: anywhere, and of either sign
        dense = dense_placements(task.richer.mode_count - 1)
        signed = signed_starts(task.richer, task.rough, placements=dense)[:OF_MODES]
        found = polish(task.richer, task.rough, signed, (ROUGH,), 6)[:2]
        same = renamed(task.effect, larger, task.richer, [s.theta for s in found])
        starts += coarse(larger, task.rough, same)
    led = distinct(larger, polish(larger, task.rough, starts, (ROUGH,), 8))[:3]
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
    steps = (task.shares[2], 0.0)
    fit = fit_orbits(larger, task.data, thetas, continuation=steps, hopeless=task.hopeless)
    return canonical(fit, task.data)


def _promise(task: _Task) -> _Task:
    """With what a small effect would take off χ² by the base fit's tangents, and unknowns with it:
    never worse than without, where it has a neutral point."""
    neutral, shapes = task.effect.neutral(), task.effect.shapes(task.known)
    promise, rows, sized = 0.0, list[FloatArray](), list[FloatArray]()
    if neutral is not None:
        rows = sized = [task.effect.to_internal(neutral)]
        promise = 0.0 if task.score is None else task.score.drop
    elif shapes and task.base.converged:
        found = scan(task.structure, task.data, task.base, task.effect, shapes)[:SHAPES]
        rows, sized = [row for _, row, _ in found[:STEPPED]], [large for *_, large in found]
        promise = max((drop for drop, *_ in found), default=0.0)
    small = [np.r_[task.base.theta, row] for row in sized]
    if neutral is None or promise > PROMISED * task.base.chi2:
        small += stepped(task.structure, task.data, task.base, task.effect, rows)
    return replace(task, promise=promise, small=tuple(small))


def _promising(tasks: Sequence[_Task], keep: int) -> list[_Task]:
    """The effects that promise most of the misfit, no more than two forms of one."""
    ranked = sorted((t for t in tasks if t.base.converged and t.small), key=lambda t: -t.promise)
    most = [t for t in ranked if t.promise > PROMISED * t.base.chi2]
    return few_of_each(most, lambda t: t.effect.name, 2)[:keep]


def _straight(task: _Task) -> Fit:
    """From the base fit at the data's own noise."""
    larger = task.structure.with_effects(task.effect)
    thetas = np.stack(task.small)
    fit = fit_orbits(larger, task.data, thetas, continuation=(0.0,), hopeless=task.hopeless)
    return canonical(fit, task.data)


def _balanced(task: _Task) -> Fit | None:
    """From the polynomial balance of the richer structure, exact where nothing else is lacking."""
    assert task.richer is not None
    larger = task.structure.with_effects(task.effect)
    found = candidates(task.richer, task.data)
    starts = coarse(larger, task.data, renamed(task.effect, larger, task.richer, found))
    if not starts:
        return None
    return canonical(fit_orbits(larger, task.data, starts[0].theta), task.data)


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
    progress: Progress,
    scores: Mapping[str, ScoreTest] | None = None,
    rivals: bool = False,
) -> list[Tried]:
    """Each effect added to `structure`; the best `keep` are refitted in full, best first.

    Started near the `base` fit; with `far` from the slow flow too, where none comes of that.
    `scores` are the effects' tests at the base fit, where they are known already. Sought as
    `rivals` of what explains the data, those that come nowhere near the noise are given up early.
    """
    if scores is None:
        scores = score_tests(structure, data, base, effects, executor)
    known = known_sizes(data, base)
    rough = data.coarse()
    shares = shares_of(base, data)
    hopeless = min(NO_RIVAL if rivals else np.inf, no_better(base, data))
    tasks = [
        _Task(structure, data, rough, base, e, known, shares, scores.get(e.key), hopeless)
        for e in effects
    ]
    tasks = list(executor.map(_promise, tasks))
    staged: list[tuple[_Task, list[CoarseStart]]] = []
    for task, starts in zip(tasks, executor.map(_first_stage, tasks), strict=True):
        staged.append((task, starts))
        progress(len(staged) / len(tasks) * 0.3, f"trying {task.effect.key}")
    out = _finite(executor.map(_straight, _promising(tasks, keep)), data)
    exact = executor.map(_balanced, [t for t in tasks if t.richer is not None])
    balanced = _finite((fit for fit in exact if fit is not None), data)
    out += [t for t in balanced if t.adequate]  # the others are local minima
    near = not far or _one_stands_out([s[0].cost for _, s in staged if s], shares[0])
    if near:
        out += _refits(staged, out, data, executor, keep, progress)
    if far and not (near and any(t.adequate for t in out)):  # it may have been too flexible
        placements = likely_placements(replace(structure, effects=()), rough)
        tasks = [replace(t, placements=placements) for t in tasks]
        led = list(range(len(tasks)))
        if any(t.explains for t in out):  # the others are its rivals, for which two forms speak
            led.sort(key=lambda i: min((s.cost for s in staged[i][1]), default=np.inf))
            led = few_of_each(led, lambda i: tasks[i].effect.name, RIVAL_FORMS)
        for done, (i, starts) in enumerate(
            zip(led, executor.map(_from_afar, [tasks[i] for i in led]), strict=True), start=1
        ):
            both = sorted([*staged[i][1], *starts], key=lambda s: s.cost)[:3]
            staged[i] = (tasks[i], both)
            progress(0.3 + done / len(led) * 0.2, f"trying {tasks[i].effect.key} from afar")
        out += _refits(staged, out, data, executor, keep, progress, each=True)
    return sorted(out, key=misfit)


def _finite(fits: Iterable[Fit], data: Dataset) -> list[Tried]:
    return [tried(f.structure.effects, f, data) for f in fits if np.isfinite(f.chi2)]


def _refits(
    staged: Sequence[tuple[_Task, list[CoarseStart]]],
    straight: Sequence[Tried],
    data: Dataset,
    executor: Executor,
    keep: int,
    progress: Progress,
    each: bool = False,
) -> list[Tried]:
    """The staged starts led on, the best `keep` to the data's own noise, beside what came
    `straight` from the base fit."""
    better = _heats(staged, 5 * keep // 2)
    refined: list[tuple[_Task, list[CoarseStart]]] = []
    for (task, _), starts in zip(better, executor.map(_middle_stage, better), strict=True):
        refined.append((task, starts))
        progress(0.5 + len(refined) / len(better) * 0.2, f"refining {task.effect.key}")

    def refit(
        chosen: Sequence[tuple[_Task, list[CoarseStart]]], first: float, last: float
    ) -> list[Tried]:
        fits = []
        for i, fit in enumerate(executor.map(_second_stage, chosen), start=1):
            fits.append(fit)
            key = chosen[i - 1][0].effect.key
            progress(first + i / len(chosen) * (last - first), f"refitting with {key}")
        return _finite(fits, data)

    # two forms of an effect at the most, so that other effects get their turn: first those within
    # reach of the best …
    there = {t.effects[-1].key for t in straight if t.adequate}
    chosen = [item for item in _best(refined, keep, forms=2) if item[0].effect.key not in there]
    costs = [starts[0].cost for _, starts in chosen]  # ascending
    near = max(SURELY, sum(cost <= REACH * costs[0] for cost in costs))
    out = refit(chosen[:near], 0.7, 0.85)
    if not any(t.explains for t in (*straight, *out)):
        out += refit(chosen[near:], 0.85, 0.95)
    # … and then all forms of the best two: at coarse noise they could not be told apart
    if not any(t.explains for t in (*straight, *out)):
        poor = [t for t in sorted((*straight, *out), key=misfit) if not t.adequate]
        names = list(dict.fromkeys(t.effects[-1].name for t in poor))[:2]
        done = {task.effect.key for task, _ in chosen} | there
        reached = {t.effect.key: s for t, s in refined if s}
        rest = [
            (t, reached.get(t.effect.key, s[:2]))
            for t, s in staged
            if s and t.effect.name in names and t.effect.key not in done
        ]
        out += refit(rest, 0.95, 1.0)
    # … and the nearest form of `each` other effect: coarse noise ranks effects as badly as forms
    if each and not any(t.explains for t in (*straight, *out)):
        seen = {t.effects[-1].name for t in (*straight, *out)}
        nearest = _best(refined, len(refined), forms=1)
        out += refit([item for item in nearest if item[0].effect.name not in seen], 0.95, 1.0)
    return out


def _best(
    staged: Sequence[tuple[_Task, list[CoarseStart]]], keep: int, forms: int
) -> list[tuple[_Task, list[CoarseStart]]]:
    """The `keep` most promising, no more than `forms` of one effect."""
    ranked = sorted((s for s in staged if s[1]), key=lambda s: s[1][0].cost)
    return few_of_each(ranked, lambda s: s[0].effect.name, forms)[:keep]


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


def likely_placements(structure: Structure, data: Dataset) -> tuple[tuple[float, ...], ...]:
    """Positions of the other mode (over the free frequency) of the best two coarse starts. Where
    there is none, or there are several, which trade off each other at coarse noise: none, for all
    that the slow flow starts from."""
    if structure.mode_count != 2:
        return ()
    out: list[tuple[float, ...]] = []
    for start in physical_starts(structure, data)[:20]:
        other_hz = structure.parameters.plain(start.theta)["mode2.frequency_hz"]
        ratio = (round(other_hz / data.free_hz, 6),)
        if ratio not in out:
            out.append(ratio)
    return tuple(out[:2])
