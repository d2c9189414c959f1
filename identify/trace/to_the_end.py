"""What had not converged, led to the end where it is the best, or might yet be its rival."""

from collections.abc import Iterable, Sequence

import numpy as np

from identify.dataset import Dataset
from identify.executor import Executor
from identify.fit import Fit, fit_orbits
from identify.start import coarse
from identify.trace.sizes import known_sizes
from identify.trace.tried import Tried, best_form, best_of_each_form, tried

UNSETTLED = 60.0  # of χ² + p ln n: within that, led on or in another form, it may yet be a rival
SETTLED = 16  # of the nearest of them are led on
LED_ON = 4  # of the best of a level that had not converged …
FARTHEST = 300  # … by so many iterations more


def led_on(tries: Sequence[Tried], data: Dataset, run: Executor) -> list[Tried]:
    """The best of `tries` that had not converged, where none explains the data: a gross effect is
    a long way from the declared fit, whatever its direction."""
    if any(t.explains for t in tries):
        return []
    far = [t for t in best_of_each_form(tries)[:LED_ON] if not t.fit.converged]
    return _where_better(far, run.map(_further, [(t, data) for t in far]), data)


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


def _where_better(tries: Sequence[Tried], fits: Iterable[Fit], data: Dataset) -> list[Tried]:
    """Those of `tries` that were fitted again to a lower misfit, so."""
    pairs = zip(tries, fits, strict=True)
    return [tried(t.effects, fit, data) for t, fit in pairs if fit.chi2 < t.fit.chi2]


def _further(item: tuple[Tried, Dataset]) -> Fit:
    t, data = item
    return fit_orbits(t.fit.structure, data, t.fit.theta, continuation=(0.0,), iterations=FARTHEST)


def _to_the_end(item: tuple[Tried, Dataset]) -> Fit:
    t, data = item
    last = t.effects[-1]
    others = t.fit.theta[: -len(last.parameters)]
    inner = [last.to_internal(row) for row in last.starts(known_sizes(data, t.fit))]
    again = [s.theta for s in coarse(t.fit.structure, data, [np.r_[others, r] for r in inner])]
    thetas = np.stack([t.fit.theta, *again[:3]])
    return fit_orbits(t.fit.structure, data, thetas, continuation=(0.003, 0.0), iterations=200)
