"""Random differences from run to run, of each kind, on top of a structure."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from identify.dataset import Dataset
from identify.effects.scatter import Scatter
from identify.executor import Executor
from identify.fit import Fit
from identify.scatter import Spread, fit_scatter
from identify.structure import Structure
from identify.trace.tried import Tried, tried


def try_scatters(
    structure: Structure,
    data: Dataset,
    base: Fit,
    scatters: Sequence[Scatter],
    run: Executor,
    most: float = np.inf,
    far: bool = False,
) -> list[Tried]:
    """Each kind of random difference from run to run on top of `structure`, but for those whose
    evidence (χ² + p ln n) is surely beyond `most`; from the slow flow too where `base` is `far`."""
    left = most - base.theta.size * float(np.log(data.residuals))  # of χ² and penalty
    spreads = run.map(_scattered, [(structure, data, base, s, left, far) for s in scatters])
    return [
        replace(tried((*structure.effects, s), spread.fit, spread.data), spread=spread)
        for s, spread in zip(scatters, spreads, strict=True)
        if spread is not None
    ]


def _scattered(item: tuple[Structure, Dataset, Fit, Scatter, float, bool]) -> Spread | None:
    return fit_scatter(*item)
