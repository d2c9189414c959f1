"""The kinds of start: of the polynomial balance, exact where the model is, and of the slow flow,
robust where it is not, with the other modes at assumed places."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from identify.dataset import Dataset
from identify.start.poles import candidates
from identify.start.rough import CoarseStart, best_of_each, coarse
from identify.start.slow_flow import slow_flow_vectors
from identify.start.vectors import dense_placements, signed
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]

DISTANT = 40  # of those from the slow flow, of either sign, where the declared fit went astray
SCREENED = 4  # harmonics solved for to choose among thousands: noise of a tenth hides the others


def balanced_starts(structure: Structure, data: Dataset) -> list[CoarseStart]:
    """Those of the polynomial balance, best first."""
    return coarse(structure, data, candidates(structure, data))


def physical_starts(
    structure: Structure,
    data: Dataset,
    effect_values: Sequence[Sequence[float]] = ((),),
    placements: Sequence[tuple[float, ...]] | None = None,
) -> list[CoarseStart]:
    """Starts from the slow flow for assumed dampings and positions of the other modes, best first.

    Mode 1 sings. Each row of `effect_values` is assumed for the parameters of the structure's
    effects, in order. The misfit is that of approximate orbits at ten per cent noise.
    """
    return coarse(structure, data, slow_flow_vectors(structure, data, effect_values, placements))


def signed_starts(
    structure: Structure,
    data: Dataset,
    effect_values: Sequence[Sequence[float]] = ((),),
    placements: Sequence[tuple[float, ...]] | None = None,
) -> list[CoarseStart]:
    """The same with a fifth of mode 1's flame residue, of either sign, in each of the other modes:
    for each row, placement and signs the best, best first.

    A residue does not come through zero on its way down a misfit that it is not alone to blame for.
    """
    thetas = signed(structure, slow_flow_vectors(structure, data, effect_values, placements))
    return best_of_each(structure, coarse(structure, data.coarse(SCREENED), thetas))


def distant_starts(
    structure: Structure, data: Dataset, effect_values: Sequence[float]
) -> list[CoarseStart]:
    """The polynomial balance's best starts, and those of the slow flow with the other modes placed
    densely and of either sign: for data that lead the declared fit astray."""
    exact = [] if structure.effects else balanced_starts(structure, data)[:6]
    dense = dense_placements(structure.mode_count - 1)
    return [*exact, *signed_starts(structure, data, [effect_values], dense)[:DISTANT]]


def every_start(structure: Structure, data: Dataset) -> list[CoarseStart]:
    """The polynomial balance's best starts and the slow flow's, best first."""
    exact = balanced_starts(structure, data)[:6]
    return sorted([*exact, *physical_starts(structure, data)], key=lambda c: c.cost)
