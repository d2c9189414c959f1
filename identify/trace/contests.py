"""What has been found, contested: other forms of it, and other effects in the places of its own.

A search grows sets one effect at a time and drops what falls behind. Before one of them is
claimed, what might do as well from where it ended is tried.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect
from identify.executor import Executor, Progress
from identify.trace.claims import claimed
from identify.trace.exchange import Exchange, exchanged, forms_in_place, in_each_form, joins
from identify.trace.fewer import eliminate, part_of, with_fewer
from identify.trace.stages import try_effects
from identify.trace.to_the_end import UNSETTLED
from identify.trace.tried import (
    EVIDENCE,
    GROSS,
    Tried,
    best_by_name,
    best_form,
    best_of_each_form,
    first_of_each,
    key_of_forms,
    misfit,
)

#: Lags at one end of the way from the drive to the record, and at the other.
OTHER_END = {
    "actuator_dynamics": "sensor_dynamics",
    "sensor_dynamics": "actuator_dynamics",
}
RUNNERS_UP = 2  # sets that come near whose other forms are tried
REFORMED = 3  # sets of effects of which other forms are tried: the best one, and others …
NEAR = 100.0  # … that leave no more than so much χ²/dof …
VARIANTS = 3  # of the best set, in other forms, of which others are tried in turn
BEHIND = 3.0  # … and, where forms of a better one explain the data, than so many times its χ²


def reformed(
    grown: Sequence[Tried],
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    done: set[tuple[str, ...]],
) -> list[Tried]:
    """Other forms of the best few sets near to the noise, and of what comes of them; where even the
    best leaves a gross misfit, of those near to it.

    Those in `done` (keys of forms) have had theirs; what is seen to here joins them.
    """
    out: list[Tried] = []
    least = np.inf  # misfit of the best set of which a form explains the data
    best = best_by_name(grown)[:REFORMED]
    for first in best:
        if best[0].fit.chi2_per_dof > GROSS:
            near = first.fit.chi2 < BEHIND * best[0].fit.chi2
        else:
            near = first is best[0] or first.fit.chi2_per_dof < NEAR
        if not near or first.fit.chi2 > BEHIND * least:
            continue
        found = _in_all_forms(first, data, available, run, done)
        out += found
        if any(t.explains for t in found):
            least = min(least, first.fit.chi2)
    return out


def _in_all_forms(
    first: Tried,
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    done: set[tuple[str, ...]],
) -> list[Tried]:
    """A set of effects in their other forms, one effect after the other while that brings gain;
    what was tried on the way is not tried again."""
    out: list[Tried] = []
    current, seen = first, {first.key_of_forms}
    for _ in first.effects:
        if current.key_of_forms in done:
            break
        found = in_each_form(current, data, available, run, seen)
        done.add(current.key_of_forms)
        seen |= {t.key_of_forms for t in found}
        out += found
        best = min(found, key=misfit, default=current)
        if best.explains or best.fit.chi2 >= current.fit.chi2 - EVIDENCE:
            break
        current = best
    return out


def varied(
    tries: Sequence[Tried],
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    done: set[tuple[str, ...]],
) -> list[Tried]:
    """Other forms of what the best set of several effects is in other forms, where that leaves
    little too: which form of one does best depends on the form of the other."""
    best = min((t for t in tries if len(t.effects) > 1), key=misfit, default=None)
    if best is None or best.fit.chi2_per_dof > NEAR:
        return []
    near = [
        t
        for t in best_of_each_form([t for t in tries if t.key == best.key])
        if t.fit.chi2 < BEHIND * best.fit.chi2 and t.key_of_forms not in done
    ]
    out: list[Tried] = []
    for t in near[:VARIANTS]:
        done.add(t.key_of_forms)
        known = {o.key_of_forms for o in [*tries, *out] if o.fit.converged}
        out += in_each_form(t, data, available, run, known)
        if any(o.explains for o in out):
            break
    return out


def runners_up(
    tries: Sequence[Tried],
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    done: set[tuple[str, ...]],
) -> list[Tried]:
    """What comes near to several effects that explain the data, in other forms of what it has in
    the place of one of them: a search of sets refits but the forms that seem best from afar."""
    certain = [t for t in tries if t.spread is None]
    good = [t for t in certain if t.explains]
    if not good:
        return []
    best = best_form(good)
    near = [
        t
        for t in best_by_name(certain)
        if not t.explains
        and len(t.effects) == len(best.effects) > 1
        and t.evidence < best.evidence + UNSETTLED
        and t.key_of_forms not in done
    ]
    out: list[Tried] = []
    for t in near[:RUNNERS_UP]:
        done.add(t.key_of_forms)
        out += in_each_form(t, data, [e for e in available if e.name not in best.names], run)
    return out


def in_finer_forms(
    tries: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """Other effects than the best that explain the data but are far less likely, in the forms that
    refine theirs: what is coarse may have left what the finer form takes up."""
    good = [t for t in tries if t.explains and t.spread is None]
    if not good:
        return []
    best = best_form(good)
    done = {t.key_of_forms for t in tries if t.adequate}
    finer = [form for form in available if form.refines]
    items: list[Exchange] = []
    for t in best_by_name(good):
        behind = t.key != best.key and not best.parts < t.parts
        if behind and t.evidence >= best.evidence + EVIDENCE:
            items += forms_in_place(t, data, finer, done)
    return exchanged(items, data, run)


def of_the_dismissed(
    tries: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """Several effects that explain the data, and that all runs call less likely than what would be
    claimed, in other forms of as many numbers: a search of sets refits but the forms that seem best
    on the fitted runs (100131, a late microphone as its high-pass, behind that of both)."""
    good = [t for t in tries if t.explains and t.spread is None]
    if not good:
        return []
    best, rivals = claimed(good, good)
    named = {t.key for t in (best, *rivals)}
    done = {t.key_of_forms for t in tries if t.adequate}
    dismissed = [
        t
        for t in best_by_name(good)
        if len(t.effects) > 1 and t.key not in named and not best.parts < t.parts
    ]
    items = [
        (t, kept, old, form, data)
        for t in dismissed
        for _, kept, old, form, _ in forms_in_place(t, data, available, done)
        if not form.refines and len(form.parameters) == len(old.parameters)
    ]
    return exchanged(items, data, run)


def at_the_same_place(
    tries: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """Other effects at the location of each that explains the data, from where it ended; of those
    at the other end of the way from the drive to the record, those that its values start.

    They are the likeliest to predict the same, and may have lost their way on coarse noise. A law
    whose values cannot be true may stand for one of theirs, and is started from as well.
    """
    explaining = [t for t in tries if t.explains]
    laws = [t for t in tries if t.adequate and t.spread is None]
    best = [best_form(good) for good in (explaining, laws) if good]
    done = {t.key_of_forms for t in tries if t.adequate}
    items: list[Exchange] = []
    for t in first_of_each(best, lambda t: t.key_of_forms).values():
        for old in t.effects:
            near = [e for e in available if _may_stand_for(e, old, t)]
            items += _in_the_place(t, old, data, near, done)
    return exchanged(items, data, run)


def _in_the_place(
    t: Tried,
    old: Effect,
    data: Dataset,
    available: Sequence[Effect],
    done: Collection[tuple[str, ...]],
) -> list[Exchange]:
    """Other effects against `old`, one of those of `t`, but for what (by forms) is `done`."""
    kept = tuple(o for o in t.effects if o is not old)
    return [
        (t, kept, old, e, data)
        for e in available
        if e.name != old.name
        and joins(e, kept)
        and not e.refines
        and key_of_forms((*kept, e)) not in done
    ]


def _may_stand_for(e: Effect, old: Effect, t: Tried) -> bool:
    """Whether `e` may predict what `old`, one of the effects of `t`, does. A lag of the sound is
    one of the record: what oscillates freely has no phase to tell them by."""
    if e.location == old.location:
        return True
    return OTHER_END.get(old.name) == e.name and bool(e.starts_from(old, t.fit.values))


def in_their_places(
    tries: Sequence[Tried],
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    extended: Mapping[tuple[str, ...], float],
    report: Progress,
) -> list[Tried]:
    """Other effects in the place of each of several that explain the data together.

    The set was grown from one of them, so that only the places of the others have been contested.
    Where what remains without an effect is gross, the others start from where the set has ended.
    One effect in the place of them all is sought too, from what they say of the declared model.
    `extended` are the sets (of keys, sorted) that have been grown from already, with the misfit
    that they had there.
    """
    good = [t for t in tries if t.explains and t.spread is None]
    if not good:
        return []
    best = best_form(good)
    if len(best.effects) == 1:
        return []
    already = {e.key for e in best.effects}
    out: list[Tried] = []
    for kept in [*combinations(best.effects, len(best.effects) - 1), ()]:
        base = with_fewer(best, kept, data) if kept else part_of(best, (), data)
        if kept and not base.chi2_per_dof < GROSS:  # no place to start from
            (old,) = (e for e in best.effects if e not in kept)
            done = {t.key_of_forms for t in tries if t.adequate}
            out += exchanged(_in_the_place(best, old, data, available, done), data, run)
            continue
        if not np.isfinite(base.chi2):
            continue
        if kept and extended.get(key_of_forms(kept), np.inf) < 2 * base.chi2:
            continue  # what stands beside it from about there has been seen
        out += try_effects(
            base.structure, data, base,
            [a for a in available if joins(a, kept) and a.key not in already],
            executor=run, keep=5, far=False, scores=None if kept else {}, rivals=True,
            progress=lambda share, text: report(0.95 + 0.05 * share, text),
        )  # fmt: skip
    return [eliminate(t, data) if t.explains else t for t in out]
