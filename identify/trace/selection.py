"""The search: singles, run-to-run scatter, pairs and triples, and what contests them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from identify.dataset import Dataset
from identify.effects import CANDIDATES
from identify.effects.scatter import Scatter
from identify.executor import Executor, InProcess
from identify.fit import Fit, fit_orbits
from identify.scatter import Spread, fit_scatter
from identify.structure import Effect, Structure
from identify.trace.contests import (
    at_the_same_place,
    eliminate,
    in_other_forms,
    in_their_places,
    led_on,
    reformed,
    settled,
    with_fewer,
)
from identify.trace.pairs import pairs_from_afar
from identify.trace.scores import ScoreTest, score_tests
from identify.trace.stages import started_again, try_effects
from identify.trace.tried import BEATEN, Tried, best_by_name, best_form, misfit, tried

Progress = Callable[[float, str], None]

BESIDE = 3  # effects that are tried beside a spread, of those that promise most
SHORTENED = 2  # best sets of a level from which the needless is left out even if none explains
LITTLE = 5.0  # χ²/dof of the declared fit up to which a law of some parameters may follow chance
GROSS = 300.0  # χ²/dof beyond which the declared fit is no place to start from alone


class Cancelled(Exception):
    """The search was cancelled by its caller."""


@dataclass(frozen=True)
class Search:
    """All that was tried, best first, and what it was tried against."""

    tried: tuple[Tried, ...]
    singles: tuple[Tried, ...]


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
    apart = [e for e in available if not e.refines]
    singles = try_effects(
        structure,
        data,
        base,
        apart,
        executor=run,
        keep=8,
        far=base.chi2_per_dof > GROSS,
        progress=lambda share, text: report(0.6 * share, text),
        scores=scores,
    )
    if not any(t.adequate for t in singles) and base.chi2_per_dof > GROSS:
        report(0.6, "starting the best once more from afar")
        singles = started_again(singles, data, run)
    if not any(t.explains for t in singles):
        richer = [e for e in available if e.refines and e.restated(structure) is not None]
        found = try_effects(
            structure, data, base, richer, executor=run, keep=1, far=False,
            progress=lambda share, text: report(0.6, text),
        )  # fmt: skip
        # of so many parameters that, beside another effect, they would stand for it
        singles += [t for t in found if t.explains]
    singles = [*singles, *in_other_forms(singles, data, available, run)]
    singles += at_the_same_place(singles, data, available, run)
    singles += led_on(singles, data, run)
    everything = list(singles)
    if base.chi2_per_dof < LITTLE or not any(t.explains for t in everything):
        report(0.6, "trying run-to-run scatter")
        everything += try_scatters(structure, data, base, scatters, run)
    level = best_by_name(singles)
    extended: set[tuple[str, ...]] = {()}
    done: set[tuple[str, ...]] = set()

    def from_afar() -> list[Tried]:
        if depth < 2 or any(t.explains for t in everything):
            return []
        pairs = pairs_from_afar(
            structure, data, base, apart, singles, run,
            lambda share, text: report(0.6 + 0.3 * share, text),
        )  # fmt: skip
        pairs = led_to_the_end(pairs)
        pairs += at_the_same_place(pairs, data, available, run)
        # all that may stand beside one of them has been sought beside it already
        extended.update((e.key,) for t in pairs if t.explains for e in t.effects)
        return [eliminate(t, data) if t.explains else t for t in pairs]

    def led_to_the_end(grown: list[Tried]) -> list[Tried]:
        grown = [*grown, *led_on(grown, data, run)]
        if not any(t.explains for t in grown):
            report(0.6, "trying other forms of the best")
            grown += reformed(grown, data, available, run, done)
        return grown

    afar = bool(level) and level[0].fit.chi2_per_dof > GROSS  # no single is a place to grow from
    if afar:
        everything += from_afar()
    for size in range(2, depth + 1):
        # a spread alone does not end the search: a pair may explain the same without chance
        explaining = [t for t in everything if t.explains]
        if any(t.spread is None or len(t.effects) > 1 or size > 2 for t in explaining):
            break
        grown: list[Tried] = []
        parents = sorted(level, key=lambda t: not t.fit.converged)[:2]
        for parent in parents:
            extended.add(parent.key_of_forms)
            rest = [e for e in apart if e.name not in parent.names]
            grown += try_effects(
                parent.fit.structure, data, parent.fit, rest, executor=run, keep=5, far=False,
                progress=lambda share, text: report(0.6 + 0.35 * share, text),
            )  # fmt: skip
        if not grown:
            break
        far = base.chi2_per_dof > GROSS and not explaining
        if far and not any(t.adequate for t in grown):
            grown = started_again(grown, data, run)
        grown = led_to_the_end(grown)
        level = best_by_name(grown)
        # what leaves a misfit is no better for having less in it; the best are shown without
        for t in grown:
            shorten = t.adequate or any(t is best for best in level[:SHORTENED])
            everything.append(eliminate(t, data) if shorten else t)
        if len(parents[0].effects) == 1:
            report(0.6, "trying run-to-run scatter beside an effect")
            good = [t for t in everything if t.explains]
            for parent in parents:
                if good and parent.names[0] not in best_form(good).names:
                    continue  # no rival: what explains the data does so without it
                other = [s for s in scatters if s.name not in parent.names]
                found = try_scatters(parent.fit.structure, data, parent.fit, other, run)
                everything += [*found, *_without_chance(found, data)]
            if not any(t.explains for t in everything):
                alone = [t for t in everything if t.spread is not None and len(t.effects) == 1]
                found = _beside_chance(alone, data, apart, run)
                everything += [*found, *_without_chance(found, data)]
            if base.chi2_per_dof > GROSS and not afar:
                everything += from_afar()
    if not any(t.explains for t in everything):
        certain = [t for t in everything if t.spread is None]
        everything += reformed(certain, data, available, run, done)
    everything += in_their_places(everything, data, apart, run, extended, report)
    everything += _beside_the_same_chance(everything, data, apart, run, report)
    everything += settled(everything, data, run)
    everything = against_chance(everything)
    return Search(
        tuple(sorted(everything, key=lambda t: (not t.adequate, t.fit.chi2))), tuple(singles)
    )


def against_chance(tries: Sequence[Tried], others: Sequence[Tried] = ()) -> list[Tried]:
    """A law that does better than a spread speaks against chance, even one of implausible values,
    or one of `others`: it stands for one that is not known."""
    laws = [t.evidence for t in (*tries, *others) if t.spread is None and t.adequate]
    least = min(laws, default=np.inf)
    out = []
    for t in tries:
        if t.spread is not None and t.evidence > least:
            spread = replace(t.spread, objection=t.spread.objection or BEATEN)
            out.append(replace(t, spread=spread))
        else:
            out.append(t)
    return out


def _without_chance(tries: Sequence[Tried], data: Dataset) -> list[Tried]:
    """Effects beside a spread that explains the data, fitted from there without it.

    A spread forgives the runs that had led the effect astray, and may have been needed for no more.
    """
    out = []
    for t in tries:
        if t.explains:
            fit = fit_orbits(t.fit.structure, data, t.fit.theta, continuation=(0.003, 0.0))
            if np.isfinite(fit.chi2):
                out.append(tried(t.fit.structure.effects, fit, data))
    return out


def _beside_chance(
    spreads: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """Effects beside each of `spreads`, which explain nothing alone: those that promise most by
    their tangents where the spread's own fit is. What changes at random drowns them elsewhere."""
    out: list[Tried] = []
    for t in spreads:
        chance = t.effects[0]
        assert isinstance(chance, Scatter)
        assert t.spread is not None
        base, wide = t.fit, t.spread.data
        others = [a for a in available if a.name != chance.name]
        scores = score_tests(base.structure, wide, base, others, run)
        ranked = sorted((e for e in others if e.key in scores), key=lambda e: -scores[e.key].drop)
        first: dict[str, Effect] = {}  # the best form of each
        for e in ranked:
            first.setdefault(e.name, e)
        for e in list(first.values())[:BESIDE]:
            theta = np.r_[base.theta, scores[e.key].size]
            larger = base.structure.with_effects(e)
            fit = fit_orbits(larger, wide, theta, continuation=(0.0,))
            out += try_scatters(larger, data, fit, [chance], run)
    return out


def _beside_the_same_chance(
    tries: Sequence[Tried],
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    report: Progress,
) -> list[Tried]:
    """Other effects in the place of the one that explains the data with a spread beside it.

    Only the nearest had a spread tried beside them; which those are, the scattered runs decided.
    """
    good = [t for t in tries if t.explains]
    best = best_form(good) if good else None
    if best is None or best.spread is None or len(best.effects) != 2:
        return []
    law, chance = best.effects
    assert isinstance(chance, Scatter)
    wide = best.spread.data
    base = with_fewer(best, (), wide)
    if not np.isfinite(base.chi2):
        return []
    others = [a for a in available if a.name not in (law.name, chance.name)]
    found = try_effects(
        base.structure, wide, base, others, executor=run, keep=5, far=False,
        progress=lambda share, text: report(0.95 + 0.05 * share, text),
    )  # fmt: skip
    out: list[Tried] = []
    for t in best_by_name(found):
        if t.explains:
            out += try_scatters(t.fit.structure, data, t.fit, [chance], run)
    return out


def try_scatters(
    structure: Structure, data: Dataset, base: Fit, scatters: Sequence[Scatter], run: Executor
) -> list[Tried]:
    """Each kind of random difference from run to run on top of `structure`."""
    spreads = run.map(_scattered, [(structure, data, base, s) for s in scatters])
    return [
        replace(tried((*structure.effects, s), spread.fit, spread.data), spread=spread)
        for s, spread in zip(scatters, spreads, strict=True)
        if spread is not None
    ]


def _scattered(item: tuple[Structure, Dataset, Fit, Scatter]) -> Spread | None:
    return fit_scatter(*item)


def without_effects(structure: Structure, data: Dataset, tries: Sequence[Tried]) -> Fit | None:
    """The declared model fitted from where the best of `tries` ended, their effects left out.

    None where nothing finite comes of it. Several effects that do equally well are often a sign
    that the declared fit itself had ended in the wrong minimum.
    """
    count = len(structure.parameters)
    best = sorted((t for t in tries if np.isfinite(t.fit.chi2)), key=misfit)[:4]
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
