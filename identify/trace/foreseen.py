"""Pairs that the score tests foresee, for where nothing that was grown explains the data.

A search that adds one effect at a time grows from the singles that leave least, and two effects may
each leave more than what follows either a little (54169, a loss and a delay of the flame, behind a
dozen others), or hide in one another (42077). Where each single has ended, the tangents of all
others tell what a pair would leave if they went on straight: those that promise least are fitted.
"""

from collections.abc import Collection, Sequence

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect
from identify.executor import Executor, InProcess
from identify.fit import Fit, fit_orbits
from identify.trace.exchange import joins
from identify.trace.restated import canonical
from identify.trace.scores import most_promising, score_tests, stepped
from identify.trace.tried import Tried, few_of_each, key_of_forms, misfit, tried

BESIDE = 3  # effects that are looked at beside each single, of those that promise most
FORMS = 2  # of the same two effects
FITTED = 16  # pairs

_Promise = tuple[float, Effect]  # χ² that is left, beside which other effect


def foreseen(
    singles: Sequence[Tried],
    data: Dataset,
    available: Sequence[Effect],
    done: Collection[tuple[str, ...]],
    run: Executor,
) -> list[Tried]:
    """Two effects fitted from where the first of them has ended alone, but for what (by forms) is
    `done`: those of which the tangents promise least misfit."""
    tests = run.map(_promises, [(t, data, available) for t in singles])
    ranked = sorted(
        ((left, t, e) for t, found in zip(singles, tests, strict=True) for left, e in found),
        key=lambda item: item[0],
    )
    ranked = [item for item in ranked if key_of_forms((*item[1].effects, item[2])) not in done]
    chosen = few_of_each(ranked, lambda item: frozenset({*item[1].names, item[2].name}), FORMS)
    fits = run.map(_fitted, [(t, e, data) for _, t, e in chosen[:FITTED]])
    return [tried(f.structure.effects, f, data) for f in fits if np.isfinite(f.chi2)]


def _promises(item: tuple[Tried, Dataset, Sequence[Effect]]) -> list[_Promise]:
    t, data, available = item
    beside = [e for e in available if joins(e, t.effects)]
    scores = score_tests(t.fit.structure, data, t.fit, beside, InProcess())
    best = most_promising(scores, beside, BESIDE)
    return [(misfit(t) - scores[e.key].drop, e) for e in best]


def _fitted(item: tuple[Tried, Effect, Dataset]) -> Fit:
    t, effect, data = item
    neutral = effect.neutral()
    assert neutral is not None  # it has a score test
    row = effect.to_internal(neutral)
    thetas = [np.r_[t.fit.theta, row], *stepped(t.fit.structure, data, t.fit, effect, [row])]
    larger = t.fit.structure.with_effects(effect)
    return canonical(fit_orbits(larger, data, np.stack(thetas), continuation=(0.0,)), data)
