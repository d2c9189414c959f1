"""One effect of a set in another form, or another in its place, from where the set has ended."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from identify import assess
from identify.dataset import Dataset
from identify.effect import Effect
from identify.executor import Executor
from identify.fit import Fit, fit_orbits
from identify.start import coarse
from identify.structure import Structure
from identify.trace.fewer import named_otherwise, part_of
from identify.trace.matched import matched
from identify.trace.sizes import beside, known_sizes
from identify.trace.stages import NO_RIVAL
from identify.trace.to_the_end import FARTHEST
from identify.trace.tried import ALPHA, Tried, key_of_forms, misfit, tried

FloatArray = npt.NDArray[np.float64]
#: A set of effects, those of them that are kept, the one that is not, what comes in its place.
Exchange = tuple[Tried, tuple[Effect, ...], Effect, Effect, Dataset]

#: Of which two laws may be met at once.
TOGETHER = ("nonlinearity_shape", "actuator_nonlinearity", "flame_dynamics")
#: Places whose effects are responses that others may be like, and what else is moved for that.
MOVING = {"flame": "flame.", "actuator": "flame.", "forward": "mode"}
REFINED = 1500  # iterations of a form that refines another: a long valley may lie between …
NEAREST = 2  # … from so many starts at most


def suits(form: Effect, structure: Structure, beside: Sequence[Effect]) -> bool:
    """Whether a form is for as many modes as are declared, or as there are with those of an effect
    that it stands beside."""
    plain = replace(structure, effects=())
    fuller = [r.mode_count for e in beside if (r := e.restated(plain)) is not None]
    return form.mode_count in (None, plain.mode_count, *fuller)


def joins(effect: Effect, beside: Sequence[Effect]) -> bool:
    """Whether an effect may stand beside others: one of the same name does where two such laws are
    met together, and where none of its parameters is theirs."""
    known = {q.name for o in beside for q in o.parameters}
    if all(o.name != effect.name for o in beside):
        return True
    return effect.name in TOGETHER and not known & {q.name for q in effect.parameters}


def in_other_forms(
    tries: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """The other forms of the effects of the best of `tries`, started from where it ended.

    A form with one parameter less may do as well, and is then what should be named (of several
    effects that explain the data, no other forms are tried); where none explains the data, another
    may be nearer to the truth than the one that was refitted first.
    """
    good = [t for t in tries if t.explains]
    best = min(good, key=lambda t: t.evidence) if good else min(tries, key=misfit, default=None)
    if best is None:
        return []
    done = {t.key_of_forms for t in tries if t.adequate}
    return in_each_form(best, data, available, run, done)


def in_each_form(
    t: Tried,
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    done: Collection[tuple[str, ...]] = (),
    richer: bool = False,
) -> list[Tried]:
    """Each effect of `t` in its other forms, but for what (by forms) is `done`; of several effects
    that explain the data, in those of fewer numbers only, unless `richer` ones are wanted."""
    items = [
        (t, kept, e, form, data)
        for t, kept, e, form, data in forms_in_place(t, data, available, done)
        if not (form.refines and t.explains)
        and (richer or not (t.explains and kept) or len(form.parameters) < len(e.parameters))
    ]
    items.sort(key=lambda item: not item[3].refines)  # which take longest: not to be waited for
    return exchanged(items, data, run)


def forms_in_place(
    t: Tried, data: Dataset, available: Sequence[Effect], done: Collection[tuple[str, ...]]
) -> list[Exchange]:
    """Each effect of `t` against each other form of it that may stand there, but for what (by
    forms) is `done`; and against its own form for the modes too that effects beside it bring."""
    out: list[Exchange] = []
    for e in t.effects:
        kept = tuple(o for o in t.effects if o is not e)
        out += [
            (t, kept, e, form, data)
            for form in available
            if form.name == e.name
            and suits(form, t.fit.structure, kept)
            and joins(form, kept)
            and (
                _for_more_modes(form, e)
                if form.key == e.key
                else key_of_forms((*kept, form)) not in done
            )
        ]
    return out


def _for_more_modes(form: Effect, old: Effect) -> bool:
    """Whether the same form has a share of more modes than it had."""
    return (form.mode_count or 0) > (old.mode_count or 0) > 0


def exchanged(items: Sequence[Exchange], data: Dataset, run: Executor) -> list[Tried]:
    """What comes of each exchange, refitted; nothing of those that come to nothing finite."""
    fits = [fit for fit in run.map(_in_form, items) if fit is not None and np.isfinite(fit.chi2)]
    return [tried(fit.structure.effects, fit, data) for fit in fits]


def _in_form(item: Exchange) -> Fit | None:
    """`t` with one of its effects in another form, or another effect in its place, beside those
    kept; None where none starts."""
    t, kept, old, form, data = item
    larger = replace(t.fit.structure, effects=(*kept, form))

    def start(row: Sequence[float], values: Mapping[str, float]) -> FloatArray:
        base = part_of(t, kept, data, values)
        others = beside(base.structure, base.theta, data, form, row)
        return np.concatenate([others, form.to_internal(row)])

    known = [t.fit.values, *named_otherwise(old, t), *old.plainer(t.fit.values)]
    taken = [start(row, values) for values in known for row in form.starts_from(old, values)]
    if form.refines:
        alike = [matched(larger, row, t.fit, data) for row in taken]
        apart = [] if kept else form.apart_from(old, t.fit.values)
        valleys = [x for x in alike if x is not None], [start(row, t.fit.values) for row in apart]
        return _refined(larger, data, valleys, t.fit.chi2)
    rows = [start(row, t.fit.values) for row in form.starts(known_sizes(data, t.fit))]
    if form.location == old.location and form.location in MOVING:
        moving = MOVING[form.location]
        near = taken if moving == "mode" else rows  # of a mode there are starts anywhere
        alike = [matched(larger, row, t.fit, data, moving) for row in near]
        taken += [theta for theta in alike if theta is not None]
    starts = [s.theta for s in coarse(larger, data, [*rows, *taken])[:2]]
    bar = NO_RIVAL if t.explains else np.inf  # of rivals only those near to the noise matter
    # what `t` knows to within the noise, coarse noise would lose
    fits = [
        fit_orbits(larger, data, np.stack(begun), continuation=steps, iterations=30, hopeless=bar)
        for begun, steps in ((starts, (0.003, 0.0)), (taken, (0.0,)))
        if begun
    ]
    return min(fits, key=lambda f: f.chi2, default=None)


def _refined(
    larger: Structure, data: Dataset, valleys: Sequence[Sequence[FloatArray]], coarser: float
) -> Fit | None:
    """The fit from the nearest of each of the `valleys`, down these as far as the noise tells,
    where that comes below the χ² of the form that it refines, `coarser`."""
    fits: list[Fit] = []
    for begun in (s for starts in valleys for s in coarse(larger, data, starts)[:NEAREST]):
        fit = fit_orbits(larger, data, begun.theta, continuation=(0.003, 0.0), iterations=FARTHEST)
        misfits = assess.lack_of_fit_p(fit.chi2, fit.dof) < ALPHA
        if misfits and fit.chi2 < coarser and not fit.converged:
            fit = fit_orbits(larger, data, fit.theta, continuation=(0.0,), iterations=REFINED)
        fits.append(fit)
        if assess.lack_of_fit_p(fit.chi2, fit.dof) > ALPHA:
            break
    return min(fits, key=lambda f: f.chi2, default=None)
