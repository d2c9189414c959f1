"""Effects started once more as if their values were known: on data corrected for them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from identify.dataset import Dataset
from identify.executor import Executor
from identify.fit import Fit, fit_orbits
from identify.start import candidates, coarse, corrected, physical_starts, polish
from identify.trace.restated import by_name
from identify.trace.tried import Tried, best_by_name, misfit, tried

FloatArray = npt.NDArray[np.float64]

AGAIN = 30.0  # χ²/dof of a refitted effect that a bad start may have caused


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
    return sorted([*singles, *again], key=misfit)


def _again(item: tuple[Tried, Dataset]) -> Fit:
    t, data = item
    larger, plain = t.fit.structure, replace(t.fit.structure, effects=())
    values = t.fit.values
    row = [values[q.name] for e in t.effects for q in e.parameters]
    own = t.fit.theta[len(plain.parameters) :]
    rough = data.coarse()
    clean = corrected(data, t.effects, values)
    exact = [] if clean is None else [np.r_[theta, own] for theta in candidates(plain, clean)]
    exact += [] if clean is None else _restated_starts(t, clean)
    starts = coarse(larger, rough, exact)[:5] + physical_starts(larger, rough, [row])[:5]
    polished = polish(larger, rough, starts, shares=(0.05, 0.01), iterations=10)[:3]
    thetas = np.stack([*(s.theta for s in polished), t.fit.theta])
    worse = t.fit.chi2 / data.residuals
    steps = (0.003, 0.0)
    return fit_orbits(larger, data, thetas, continuation=steps, iterations=100, hopeless=worse)


def _restated_starts(t: Tried, clean: Dataset) -> list[FloatArray]:
    """Starts of `t`, of several effects, from the richer structure that says the same as one of
    them, on data corrected for the others."""
    if len(t.effects) == 1:
        return []
    plain = replace(t.fit.structure, effects=())
    for effect in t.effects:
        richer = effect.restated(plain)
        if richer is not None:
            found = [richer.parameters.plain(theta) for theta in candidates(richer, clean)]
            return [by_name(effect, t.fit.structure, {**t.fit.values, **p}) for p in found]
    return []
