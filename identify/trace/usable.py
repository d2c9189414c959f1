"""Which candidates can be added to a declared model and asked of the data."""

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects.scatter import Scatter
from identify.structure import Structure


def knows_pressure(data: Dataset) -> bool:
    """Whether a pressure was measured beside the velocity."""
    return any(np.any(b.at.pressure != 0) for b in data.fit)


def usable(effect: Effect, data: Dataset, structure: Structure) -> bool:
    """Whether the effect can be added to this declared model and asked of these data."""
    if isinstance(effect, Scatter):  # no parameter describes it: `try_scatters`
        return False
    if not effect.extends(structure):
        return False
    if "flame_pole" in effect.needs and structure.flame_order == 0:
        return False
    absent = "velocity" if knows_pressure(data) else "pressure"
    return absent not in effect.needs
