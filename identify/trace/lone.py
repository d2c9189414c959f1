"""Whether one run alone contradicts the declared model.

A recording with a fault that no test of its signals sees (another gain, a drive that is not what
was recorded) is explained by several effects, by chance from run to run or by nothing: all of them
say less than that the rest of the campaign has no discrepancy. So before such a verdict each run is
left out in turn; a law of one or two numbers that accounts for all runs stands without this.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from identify.dataset import Batch, Dataset
from identify.executor import Executor
from identify.fit import Fit, fit_orbits
from identify.start import NEARLY, fit_declared, fit_from_balance
from identify.structure import Structure
from identify.trace.tried import tried

FloatArray = npt.NDArray[np.float64]
LEAST = 4  # fitted runs that must be left


def without_run(data: Dataset, name: str) -> Dataset:
    """The same runs but for one."""

    def rest(batches: Sequence[Batch]) -> tuple[Batch, ...]:
        kept = [(b, np.flatnonzero([n != name for n in b.names])) for b in batches]
        return tuple(b if rows.size == b.runs else b.take(rows) for b, rows in kept if rows.size)

    return replace(data, fit=rest(data.fit), validation=rest(data.validation))


def lone_run(
    structure: Structure,
    data: Dataset,
    thetas: Sequence[FloatArray],
    executor: Executor,
    anew: bool,
) -> tuple[str, Fit] | None:
    """The one run without which the declared model explains all others, and that fit.

    `thetas` are unknowns of the declared model to start from; `anew`: from the data as well. None
    where no run is such, several are, or what is left says little.
    """
    fitted = [n for b in data.fit for n in b.names]
    if len(fitted) <= LEAST:
        return None
    names = [*fitted, *(n for b in data.validation for n in b.names)]
    rests = [without_run(data, n) for n in names]
    items = [
        (structure, r, thetas, anew and n in fitted) for n, r in zip(names, rests, strict=True)
    ]
    fits = executor.map(_fitted, items)
    found = [
        (name, fit)
        for name, rest, fit in zip(names, rests, fits, strict=True)
        if np.isfinite(fit.chi2) and fit.dof >= fit.theta.size and tried((), fit, rest).adequate
    ]
    return found[0] if len(found) == 1 else None


def _fitted(item: tuple[Structure, Dataset, Sequence[FloatArray], bool]) -> Fit:
    structure, rest, thetas, anew = item
    fit = fit_orbits(structure, rest, np.stack(thetas), continuation=(0.003, 0.0))
    if not anew or fit.chi2 < 2 * fit.dof:
        return fit
    fits = [fit]
    # with a mode at the wrong place, one of these would leave no more than that
    if not fit.chi2_per_dof < NEARLY:
        exact, _ = fit_from_balance(structure, rest)
        fits += [] if exact is None else [exact]
    if any(f.chi2_per_dof < NEARLY for f in fits):
        fits.append(fit_declared(structure, rest))
    return min(fits, key=lambda f: f.chi2)
