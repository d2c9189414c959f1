"""What has been found, contested: fewer effects, other forms, others in their places, to the end.

A search grows sets one effect at a time and drops what falls behind. Before one of them is
claimed, what might do as well from where it ended is tried.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from identify import assess, dual
from identify.dataset import Dataset
from identify.executor import Executor, Progress
from identify.fit import Fit, fit_orbits
from identify.start import coarse
from identify.structure import MODAL, Effect, Structure
from identify.trace.stages import (
    NO_RIVAL,
    beside,
    known_sizes,
    louder,
    loudness,
    try_effects,
)
from identify.trace.tried import (
    ALPHA,
    EVIDENCE,
    GROSS,
    Tried,
    best_by_name,
    best_form,
    best_of_each_form,
    gain_p,
    key_of_forms,
    misfit,
    tried,
)

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
#: A set of effects, those of them that are kept, the one that is not, what comes in its place.
_Exchange = tuple[Tried, tuple[Effect, ...], Effect, Effect, Dataset]

TOGETHER = ("nonlinearity_shape", "actuator_nonlinearity")  # of which two laws may be met at once
UNSETTLED = 60.0  # of χ² + p ln n: within that, led on or in another form, it may yet be a rival
SETTLED = 16  # of the nearest of them are led on
RUNNERS_UP = 2  # sets whose other forms are tried for that
#: Places whose effects are responses that others may be like, and what else is moved for that.
MOVING = {"flame": "flame.", "actuator": "flame.", "forward": "mode"}
#: Lags at one end of the way from the drive to the record, and at the other.
OTHER_END = {
    "actuator_dynamics": "sensor_dynamics",
    "sensor_dynamics": "actuator_dynamics",
}
NEARBY = 0.7  # of the logarithm, where another form is matched
REFINED = 1500  # iterations of a form that refines another: a long valley may lie between …
NEAREST = 2  # … from so many starts at most
LED_ON = 4  # of the best of a level that had not converged …
FARTHEST = 300  # … by so many iterations more
NEEDLESS = 100.0  # of χ²: what leaving an effect out adds at most, if it is to be left out
REFORMED = 3  # sets of effects of which other forms are tried: the best one, and others …
NEAR = 100.0  # … that leave no more than so much χ²/dof …
VARIANTS = 3  # of the best set, in other forms, of which others are tried in turn
BEHIND = 3.0  # … and, where forms of a better one explain the data, than so many times its χ²


def part_of(
    t: Tried,
    effects: tuple[Effect, ...],
    data: Dataset,
    values: Mapping[str, float] | None = None,
) -> Fit:
    """The values of `t`, or those given, with some of its effects, not fitted again: as loud as
    with all."""
    structure = replace(t.fit.structure, effects=effects)
    names, values = structure.parameters.names, values or t.fit.values
    gone = [e for e in t.effects if e not in effects]
    theta = structure.parameters.to_internal([values[n] for n in names])
    theta = louder(theta, names, loudness(data, gone, values))
    return replace(t.fit, structure=structure, theta=theta)


def with_fewer(t: Tried, effects: tuple[Effect, ...], data: Dataset) -> Fit:
    """The fit with only some of the effects of `t`, started from its values: led in, and straight
    where that ends no nearer. What an effect that stands for nothing leaves is at its minimum
    already, which coarser noise may lead away from."""
    smaller = replace(t.fit.structure, effects=effects)
    names = smaller.parameters.names
    known = [t.fit.values]
    for e in t.effects:
        if e not in effects:
            known += _named_otherwise(e, t)
            known += [p for p in (_merged(e, t, q) for q in known) if p is not None]
    thetas = np.stack([smaller.parameters.to_internal([p[n] for n in names]) for p in known])
    led = fit_orbits(smaller, data, thetas, continuation=(0.003, 0.0))
    if led.chi2 < t.fit.chi2 + NEEDLESS:
        return led
    enough = (t.fit.chi2 + NEEDLESS) / data.residuals
    straight = fit_orbits(smaller, data, thetas[0], continuation=(0.0,), hopeless=enough)
    return min(led, straight, key=lambda f: f.chi2)


def _named_otherwise(effect: Effect, t: Tried) -> list[dict[str, float]]:
    """The values of `t` with another mode in the place of the one that `effect` adds, of which it
    has the name only: any of those that do not sing may be the one too many."""
    values, plain = t.fit.values, replace(t.fit.structure, effects=())
    count = plain.mode_count
    if not _adds_a_mode(effect, plain):
        return []
    full = {**values, **effect.to_restated(plain, values)}
    out = []
    for added in range(2, count + 1):
        stay = [i for i in range(1, count + 2) if i != added]
        moved = {
            f"mode{new}.{kind}": full[f"mode{old}.{kind}"]
            for new, old in enumerate(stay, start=1)
            for kind in MODAL
        }
        for q, kind in zip(effect.parameters, MODAL, strict=True):
            moved[q.name] = full[f"mode{added}.{kind}"]
        out.append({**values, **moved})
    return out


def _adds_a_mode(effect: Effect, plain: Structure) -> bool:
    richer = effect.restated(plain)
    return richer is not None and richer.mode_count == plain.mode_count + 1


def _merged(effect: Effect, t: Tried, p: Mapping[str, float]) -> dict[str, float] | None:
    """Values `p` where the mode that `effect` adds lies within the width of a declared one: that
    one does for both, with their residues together. None where it does not."""
    plain = replace(t.fit.structure, effects=())
    count = plain.mode_count
    if not _adds_a_mode(effect, plain):
        return None
    f, zeta, *residues = (p[q.name] for q in effect.parameters)
    near = min(range(1, count + 1), key=lambda i: abs(p[f"mode{i}.frequency_hz"] - f))
    own = f"mode{near}"
    wide = zeta * f + p[f"{own}.damping"] * p[f"{own}.frequency_hz"]
    if abs(p[f"{own}.frequency_hz"] - f) > wide:
        return None
    both = zip(MODAL[2:], residues, strict=True)
    return {**p, **{f"{own}.{kind}": p[f"{own}.{kind}"] + r for kind, r in both}}


def eliminate(candidate: Tried, data: Dataset) -> Tried:
    """Backward elimination: effects without which the fit is no worse than chance are dropped. Of
    what predicts the held-out runs, they have a say in it."""
    current = candidate
    while len(current.effects) > 1:
        smaller = []
        for leave in current.effects:
            rest = tuple(e for e in current.effects if e is not leave)
            without = tried(rest, with_fewer(current, rest, data), data)
            gain = without.fit.chi2 - current.fit.chi2
            if current.adequate:
                gain = without.chi2_of_all - current.chi2_of_all
            if np.isfinite(gain) and gain_p(gain, current, without.fit) > ALPHA:
                smaller.append((gain, without))
        if not smaller:
            break
        _, current = min(smaller, key=lambda item: item[0])
    return current


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
) -> list[Tried]:
    """Each effect of `t` in its other forms, but for what (by forms) is `done`."""
    items = [
        (t, kept, e, form, data)
        for t, kept, e, form, data in _other_forms(t, data, available, done)
        if not (form.refines and t.explains)
        and not (t.explains and kept and len(form.parameters) >= len(e.parameters))
    ]
    items.sort(key=lambda item: not item[3].refines)  # which take longest: not to be waited for
    return _refitted(items, data, run)


def _other_forms(
    t: Tried, data: Dataset, available: Sequence[Effect], done: Collection[tuple[str, ...]]
) -> list[_Exchange]:
    """Each effect of `t` against each other form of it that may stand there, but for what (by
    forms) is `done`."""
    out: list[_Exchange] = []
    for e in t.effects:
        kept = tuple(o for o in t.effects if o is not e)
        out += [
            (t, kept, e, form, data)
            for form in available
            if form.name == e.name
            and form.key != e.key
            and suits(form, t.fit.structure, kept)
            and joins(form, kept)
            and key_of_forms((*kept, form)) not in done
        ]
    return out


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


def _refitted(items: Sequence[_Exchange], data: Dataset, run: Executor) -> list[Tried]:
    fits = [fit for fit in run.map(_in_form, items) if fit is not None and np.isfinite(fit.chi2)]
    return [tried(fit.structure.effects, fit, data) for fit in fits]


def _in_form(item: _Exchange) -> Fit | None:
    """`t` with one of its effects in another form, or another effect in its place, beside those
    kept; None where none starts."""
    t, kept, old, form, data = item
    larger = replace(t.fit.structure, effects=(*kept, form))

    def start(row: Sequence[float], values: Mapping[str, float]) -> FloatArray:
        base = part_of(t, kept, data, values)
        others = beside(base.structure, base.theta, data, form, row)
        return np.concatenate([others, form.to_internal(row)])

    known = [t.fit.values, *_named_otherwise(old, t), *old.plainer(t.fit.values)]
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


def matched(
    larger: Structure, theta: FloatArray, fit: Fit, data: Dataset, moving: str = "mode"
) -> FloatArray | None:
    """Unknowns of `larger` with which it responds as `fit` does at the measured harmonics, from
    `theta`: its last effect's, and those whose names begin with `moving`, which stay nearby. None
    where the responses cannot be brought within a tenth."""
    names = larger.parameters.names
    own = {q.name for q in larger.effects[-1].parameters}
    free = [i for i, n in enumerate(names) if n.startswith(moving) or n in own]

    def responses(structure: Structure, at: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """At all harmonics (n,), and their derivatives by the unknowns (n, p)."""
        parts, slopes = [], []
        for b in data.fit:
            given = replace(b.at, drive=np.ones_like(b.at.drive))
            s = 1j * given.omega[:, None] * np.arange(1, given.harmonics + 1)
            loop = structure.assemble(structure.parameters.seeded(at[None], b.runs), given, s)
            for x in (loop.G[0], loop.G_u, loop.H):
                parts.append(np.broadcast_to(dual.value(x), s.shape).ravel())
                slopes.append(dual.derivative(x, s.shape, at.size).reshape(s.size, at.size))
        return np.concatenate(parts), np.concatenate(slopes)

    target, _ = responses(fit.structure, fit.theta)
    scale = np.where(target == 0, 1.0, target)  # of the flame in cold runs

    @lru_cache(maxsize=1)
    def compared(x: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
        moved = theta.copy()
        moved[free] = x
        with np.errstate(all="ignore"):
            there, slopes = responses(larger, moved)
            rest, slopes = (there - target) / scale, slopes[:, free] / scale[:, None]
        both = (np.concatenate([c.real, c.imag]) for c in (rest, slopes))
        rest, slopes = (np.nan_to_num(c, nan=1e6, posinf=1e6, neginf=-1e6) for c in both)
        return rest, slopes

    low, high = (np.asarray(limit)[free] for limit in larger.parameters.bounds())
    begin = np.clip(theta[free], low + 1e-9, high - 1e-9)
    near = np.array(
        [larger.parameters.parameters[i].kind == "positive" and names[i] not in own for i in free]
    )
    low = np.where(near, np.maximum(low, begin - NEARBY), low)
    high = np.where(near, np.minimum(high, begin + NEARBY), high)

    def difference(x: FloatArray) -> FloatArray:
        return compared(tuple(x))[0]

    def jacobian(x: FloatArray) -> FloatArray:
        return compared(tuple(x))[1]

    found = least_squares(
        difference, begin, jacobian, bounds=(low, high), x_scale="jac", max_nfev=150
    )
    if not np.sqrt(np.mean(found.fun**2)) < 0.1:
        return None
    out = theta.copy()
    out[free] = found.x
    return out


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
    items: list[_Exchange] = []
    for t in best_by_name(good):
        behind = t.key != best.key and not best.parts < t.parts
        if behind and t.evidence >= best.evidence + EVIDENCE:
            items += _other_forms(t, data, finer, done)
    return _refitted(items, data, run)


def at_the_same_place(
    tries: Sequence[Tried], data: Dataset, available: Sequence[Effect], run: Executor
) -> list[Tried]:
    """Other effects at the location of each that explains the data, from where it ended; of those
    at the other end of the way from the drive to the record, those that its values start.

    They are the likeliest to predict the same, and may have lost their way on coarse noise.
    """
    good = [t for t in tries if t.explains]
    if not good:
        return []
    best = best_form(good)
    done = {t.key_of_forms for t in tries if t.adequate}
    items = [
        (best, kept, old, e, data)
        for old in best.effects
        for kept in [tuple(o for o in best.effects if o is not old)]
        for e in available
        if _may_stand_for(e, old, best)
        and e.name not in best.names
        and not e.refines
        and key_of_forms((*kept, e)) not in done
    ]
    return _refitted(items, data, run)


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
            out += _from_the_end(best, kept, data, available, run, tries)
            continue
        if not np.isfinite(base.chi2):
            continue
        if kept and extended.get(key_of_forms(kept), np.inf) < 2 * base.chi2:
            continue  # what stands beside it from about there has been seen
        names = {e.name for e in kept}
        out += try_effects(
            base.structure, data, base,
            [a for a in available if a.name not in names and a.key not in already],
            executor=run, keep=5, far=False, scores=None if kept else {}, rivals=True,
            progress=lambda share, text: report(0.95 + 0.05 * share, text),
        )  # fmt: skip
    return [eliminate(t, data) if t.explains else t for t in out]


def _from_the_end(
    t: Tried,
    kept: tuple[Effect, ...],
    data: Dataset,
    available: Sequence[Effect],
    run: Executor,
    tries: Sequence[Tried],
) -> list[Tried]:
    """Other effects beside those `kept` of `t`, in the place of the one that is not."""
    (old,) = (e for e in t.effects if e not in kept)
    done = {o.key_of_forms for o in tries if o.adequate}
    others = [
        (t, kept, old, e, data)
        for e in available
        if e.name not in t.names and not e.refines and key_of_forms((*kept, e)) not in done
    ]
    return _refitted(others, data, run)


def led_on(tries: Sequence[Tried], data: Dataset, run: Executor) -> list[Tried]:
    """The best of `tries` that had not converged, where none explains the data: a gross effect is
    a long way from the declared fit, whatever its direction."""
    if any(t.explains for t in tries):
        return []
    far = [t for t in best_of_each_form(tries)[:LED_ON] if not t.fit.converged]
    return _where_better(far, run.map(_further, [(t, data) for t in far]), data)


def _where_better(tries: Sequence[Tried], fits: Iterable[Fit], data: Dataset) -> list[Tried]:
    """Those of `tries` that were fitted again to a lower misfit, so."""
    pairs = zip(tries, fits, strict=True)
    return [tried(t.effects, fit, data) for t, fit in pairs if fit.chi2 < t.fit.chi2]


def _further(item: tuple[Tried, Dataset]) -> Fit:
    t, data = item
    return fit_orbits(t.fit.structure, data, t.fit.theta, continuation=(0.0,), iterations=FARTHEST)


def settled(tries: Sequence[Tried], data: Dataset, run: Executor) -> list[Tried]:
    """What had not converged and might yet be a rival of the best, or is the best, led to the end.

    Weak effects leave long flat valleys: a rival must not be ruled out for want of iterations. Each
    form for itself: which of an effect's forms comes nearest before the end says little.
    """
    good = [t for t in tries if t.explains]
    if not good:
        return []
    best = best_form(good)
    near = [
        t
        for t in best_of_each_form([t for t in tries if t.spread is None])
        if not t.fit.converged
        and t.evidence < best.evidence + UNSETTLED
        and not best.parts < t.parts  # no rival, whatever it comes to
    ]
    near = sorted(near, key=lambda t: t.evidence)[:SETTLED]
    found = _where_better(near, run.map(_to_the_end, [(t, data) for t in near]), data)
    claimed = best_form([*good, *(t for t in found if t.explains)])
    if claimed.has_values:
        return found
    return [*found, *_where_better([claimed], [_further((claimed, data))], data)]


def _to_the_end(item: tuple[Tried, Dataset]) -> Fit:
    t, data = item
    last = t.effects[-1]
    others = t.fit.theta[: -len(last.parameters)]
    inner = [last.to_internal(row) for row in last.starts(known_sizes(data, t.fit))]
    again = [s.theta for s in coarse(t.fit.structure, data, [np.r_[others, r] for r in inner])]
    thetas = np.stack([t.fit.theta, *again[:3]])
    return fit_orbits(t.fit.structure, data, thetas, continuation=(0.003, 0.0), iterations=200)
