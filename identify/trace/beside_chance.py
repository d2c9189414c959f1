"""Laws beside random differences from run to run, from where either has been led to.

A spread forgives the runs that lead a law's fit astray, and a law takes from a spread what looks
like no chance: each is tried from where the other ended, in other forms, and without.
"""

from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt

from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects.scatter import Scatter
from identify.executor import Executor, Progress
from identify.fit import Fit, fit_orbits
from identify.trace.exchange import in_each_form
from identify.trace.fewer import part_of, with_fewer
from identify.trace.scores import most_promising, scan, score_tests, stepped
from identify.trace.sizes import known_sizes
from identify.trace.spreads import try_scatters
from identify.trace.stages import try_effects
from identify.trace.tried import (
    EVIDENCE,
    Tried,
    best_by_name,
    best_form,
    first_of_each,
    misfit,
    tried,
)

FloatArray = npt.NDArray[np.float64]

BESIDE = 3  # effects that are tried beside a spread, of those that promise most
LITTLE = 5.0  # χ²/dof up to which a law of some parameters may follow chance, and hide it


def without_chance(tries: Sequence[Tried], data: Dataset) -> list[Tried]:
    """Effects beside a spread that comes to the noise, fitted from there without it.

    A spread forgives the runs that had led the effect astray, and may have been needed for no more.
    """
    out = []
    for t in tries:
        if t.adequate:
            # what it knows to within the noise, coarse noise would lose
            fits = [
                fit_orbits(t.fit.structure, data, t.fit.theta, continuation=steps)
                for steps in ((0.003, 0.0), (0.0,))
            ]
            fit = min(fits, key=lambda f: f.chi2)
            if np.isfinite(fit.chi2):
                out.append(tried(t.fit.structure.effects, fit, data))
    return out


def without_law(
    tries: Sequence[Tried], known: Collection[tuple[str, ...]], data: Dataset, run: Executor
) -> list[Tried]:
    """Spreads alone, from where the first effect ended that comes to the noise beside each of them,
    but for those `known`: from the declared fit they may have led nowhere."""
    out: list[Tried] = []
    for t in first_of_each([t for t in tries if t.adequate], lambda t: t.effects[-1].key).values():
        chance = t.effects[-1]
        assert isinstance(chance, Scatter)
        if (chance.key,) not in known:
            base = part_of(t, (), data)
            out += try_scatters(base.structure, data, base, [chance], run)
    return out


def simpler_beside_chance(
    tries: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """The simpler forms of laws that come to the noise with a spread beside them: which form was
    nearest without it, the scattered runs decided."""
    out: list[Tried] = []
    for t in tries:
        if t.adequate:
            most = {e.name: len(e.parameters) for e in t.effects}
            forms = [e for e in available if len(e.parameters) < most.get(e.name, 0)]
            out += _in_forms_beside_chance(t, data, forms, run)
    return out


def other_forms_beside_chance(
    tries: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """The other forms of the law that comes nearest to the noise beside each kind of chance, where
    none explains the data: a spread that looks like no chance may follow what its form lacks. The
    kind that takes up most leaves least whatever the law is: each is asked."""
    near = [t for t in tries if t.spread and len(t.effects) == 2 and t.fit.chi2_per_dof < LITTLE]
    near.sort(key=lambda t: (not t.adequate, misfit(t)))
    out: list[Tried] = []
    for t in first_of_each(near, lambda t: t.effects[-1].key).values():
        found = _in_forms_beside_chance(t, data, available, run)
        out += [*found, *simpler_beside_chance(found, data, available, run)]
        if any(o.explains for o in out):
            break
    return out


def _in_forms_beside_chance(
    t: Tried, data: Dataset, forms: Sequence[Effect], run: Executor
) -> list[Tried]:
    """Some other forms of the laws of `t`, beside the same spread."""
    chance = t.effects[-1]
    assert isinstance(chance, Scatter)
    assert t.spread is not None
    wide = t.spread.data
    law = tried(t.fit.structure.effects, t.fit, wide)
    others = in_each_form(law, wide, forms, run)
    near = [o for o in others if o.adequate or misfit(o) < misfit(law)]
    out: list[Tried] = []
    for o in near:
        out += try_scatters(o.fit.structure, data, o.fit, [chance], run)
    return out


def beside_chance(
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
        for e, none in _promising_most(base, wide, available, run):
            thetas = stepped(base.structure, wide, base, e, [none])
            if thetas:
                larger = base.structure.with_effects(e)
                fit = fit_orbits(larger, wide, thetas[0], continuation=(0.0,))
                out += try_scatters(larger, data, fit, [chance], run)
    return out


def _promising_most(
    base: Fit, data: Dataset, available: Sequence[Effect], run: Executor
) -> list[tuple[Effect, FloatArray]]:
    """The effects whose tangents take most off the misfit of `base`, each in its best form, and of
    those whose shape is unknown the best one; with internal values at which they vanish."""
    scores = score_tests(base.structure, data, base, available, run)
    best = most_promising(scores, available, BESIDE)
    out = [(e, e.to_internal(none)) for e in best if (none := e.neutral()) is not None]
    known = known_sizes(data, base)
    scanned = [
        (drop, e, none)
        for e in available
        if e.key not in scores and (shapes := e.shapes(known))
        for drop, none, _ in scan(base.structure, data, base, e, shapes)[:1]
    ]
    scanned.sort(key=lambda item: -item[0])
    return [*out, *((e, none) for _, e, none in scanned[:1])]


def in_the_place_of_chance(
    tries: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """What changes in the course of a campaign, in the place of what is no chance after all beside
    a law that comes to the noise with it."""
    out: list[Tried] = []
    spreads = [t for t in tries if t.spread and t.adequate and not t.plausible]
    for t in best_by_name([t for t in spreads if len(t.effects) == 2])[:BESIDE]:
        structure = t.fit.structure
        base = fit_orbits(structure, data, t.fit.theta, continuation=(0.0,), iterations=0)
        courses = [e for e in available if e.location == "experiment" and e.name not in t.names]
        if np.isfinite(base.chi2):
            out += try_effects(
                structure, data, base, courses, executor=run, keep=3, far=False,
                progress=lambda done, text: None,
            )  # fmt: skip
    return out


def beside_the_same_chance(
    tries: Sequence[Tried],
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    report: Progress,
) -> list[Tried]:
    """Other effects in the place of the one that explains the data with a spread beside it, and of
    what is likelier by far, but for values that cannot be true: a law of another place may do the
    same with some that can (80206, a lag of the microphones for a delay of the speaker).

    Only the nearest had a spread tried beside them; which those are, the scattered runs decided.
    """
    good = [t for t in tries if t.explains]
    best = [best_form(good)] if good else []
    least = min((t.evidence for t in best), default=np.inf)
    better = [t for t in tries if t.but_for_values and t.evidence < least - EVIDENCE]
    better.sort(key=lambda t: t.evidence)
    out: list[Tried] = []
    for t in [*best, *better[:1]]:
        if t.spread is not None and len(t.effects) == 2:
            out += _in_the_place_of_its_law(t, data, available, run, report)
    return [*out, *without_chance(out, data)]


def _in_the_place_of_its_law(
    t: Tried, data: Dataset, available: Sequence[Effect], run: Executor, report: Progress
) -> list[Tried]:
    """Other laws than that of `t`, which fit beside the same spread of the same size."""
    law, chance = t.effects
    assert isinstance(chance, Scatter)
    assert t.spread is not None
    wide = t.spread.data
    base = with_fewer(t, (), wide)
    if not np.isfinite(base.chi2):
        return []
    others = [a for a in available if a.name != law.name]
    found = try_effects(
        base.structure, wide, base, others, executor=run, keep=5, far=False, rivals=True,
        progress=lambda share, text: report(0.95 + 0.05 * share, text),
    )  # fmt: skip
    out: list[Tried] = []
    for o in best_by_name(found):
        if o.explains:
            out += try_scatters(o.fit.structure, data, o.fit, [chance], run)
    return out
