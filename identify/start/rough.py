"""Starts by their misfit at coarse noise: many at once, few led on.

At a tenth of each coefficient as noise the misfit has fewer and wider valleys, and approximate
orbits tell which of them a start lies in.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.dataset import Dataset
from identify.descent import levenberg_marquardt
from identify.residual import OrbitResidual, Pulled, Straightened, soften
from identify.start.vectors import near, of_others
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]

AT_ONCE = 256  # starts solved for side by side: thousands need gigabytes, and are no faster
WIDTHS = {"frequency": 0.1, "damping": 1.0, "pole": 1.0, "delay": 2.0}  # of `_weak_pulls`


@dataclass(frozen=True)
class CoarseStart:
    """A start with its misfit at coarse noise."""

    cost: float
    theta: FloatArray


def coarse(
    structure: Structure, data: Dataset, starts: Iterable[FloatArray], share: float = 0.1
) -> list[CoarseStart]:
    """Starts with their misfit at ten per cent noise (or another `share`), best first."""
    every = list(starts)
    residual = OrbitResidual(structure, soften(data.fit, share), newton_steps=2)
    found = []
    for first in range(0, len(every), AT_ONCE):
        thetas = every[first : first + AT_ONCE]
        outcome = residual(np.stack(thetas), np.arange(len(thetas)), False)
        costs = np.where(outcome.exists, np.sum(outcome.residual**2, axis=1), np.inf)
        found += [CoarseStart(float(c), t) for c, t in zip(costs, thetas, strict=True)]
    return sorted((c for c in found if np.isfinite(c.cost)), key=lambda c: c.cost)


def polish(
    structure: Structure,
    data: Dataset,
    starts: Sequence[CoarseStart],
    shares: Sequence[float] = (0.1, 0.02),
    iterations: int = 12,
) -> list[CoarseStart]:
    """Starts led through coarse fits, side by side, with weak priors around them; best first."""
    if not starts:
        return []
    centre, pulls = np.stack([s.theta for s in starts]), _weak_pulls(structure)
    thetas, costs = centre, np.full(len(starts), np.inf)
    for share in shares:
        residual = OrbitResidual(structure, soften(data.fit, share), newton_steps=2)
        straight = Straightened(Pulled(residual, pulls, centre @ pulls.T), structure)
        descents = levenberg_marquardt(
            straight,
            straight.inside(thetas),
            iterations=iterations,
            tolerance=3e-2,
            patience=6,  # a start that hardly moves any more is where it goes
            bounds=straight.bounds(structure),
        )
        pairs = zip(thetas, descents, strict=True)
        thetas = np.stack([t if d is None else straight.outside(d.theta) for t, d in pairs])
        costs = np.array([np.inf if d is None else d.cost for d in descents])
    found = [CoarseStart(float(c), t) for c, t in zip(costs, thetas, strict=True)]
    return sorted((c for c in found if np.isfinite(c.cost)), key=lambda c: c.cost)


def distinct(structure: Structure, starts: Sequence[CoarseStart]) -> list[CoarseStart]:
    """Of sorted starts those that are not near one before them."""
    out: list[CoarseStart] = []
    for start in starts:
        if not any(near(structure, start.theta, other.theta) for other in out):
            out.append(start)
    return out


def best_of_each(structure: Structure, starts: Sequence[CoarseStart]) -> list[CoarseStart]:
    """Of sorted starts the first for each row of effect values, placement and signs."""
    if not starts:
        return []
    index, residues = structure.parameters.index, of_others(structure, "flame_residue")
    own = [index[q.name] for e in structure.effects for q in e.parameters]
    where = [*of_others(structure, "frequency_hz"), *own]
    thetas = np.stack([found.theta for found in starts])
    kinds = np.c_[np.round(thetas[:, where], 6), np.sign(thetas[:, residues])]
    best: dict[bytes, CoarseStart] = {}
    for kind, found in zip(kinds, starts, strict=True):
        best.setdefault(kind.tobytes(), found)
    return list(best.values())


def _weak_pulls(structure: Structure) -> FloatArray:
    """Rows (pulls, p) of weak pulls on the logarithms of poles and dampings.

    At coarse noise the misfit is flat along trades between a pole and a gain; the pull keeps
    frequencies within some 10 % of the guess, dampings and poles within a factor of three, one
    standard deviation each. The final fit has no prior.
    """
    weights = np.zeros(len(structure.parameters))
    for i, p in enumerate(structure.parameters.parameters):
        for word, width in WIDTHS.items():
            if p.kind == "positive" and word in p.name.split(".")[-1]:
                weights[i] = 1.0 / width
    return np.asarray(np.diag(weights)[weights > 0])
