"""Starts as vectors of unknowns: made of values, told apart, with other modes elsewhere.

Mode 1 sings. The modes that do not are seen at a few harmonics only, so that where they lie and of
which sign the flame's share in them is has to be tried.
"""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
import numpy.typing as npt

from identify.fit import Fit
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]

DAMPING = 0.03  # of a mode that is placed somewhere


def named(structure: Structure, values: dict[str, float], coefficients: list[float]) -> FloatArray:
    """Internal vector from modal values and polynomial coefficients c2, c3, …."""
    for d in range(2, structure.degree + 1):
        known = d - 2 < len(coefficients)
        values[f"nonlinearity.c{d}"] = coefficients[d - 2] if known else 0.0
    cubic = coefficients[1] if len(coefficients) > 1 else -1.0
    values["nonlinearity.level"] = float(1.0 / np.sqrt(3 * max(-cubic, 1e-12)))
    for j, node in enumerate(structure.nodes, start=1):
        excess = [cd * node**d for d, cd in enumerate(coefficients, start=2)]
        values[f"nonlinearity.value{j}"] = node + sum(excess)
    values.setdefault("flame.delay_s", 1e-4)
    return structure.parameters.unknowns(values)


def near(structure: Structure, a: FloatArray, b: FloatArray) -> bool:
    """Whether two starts have the same poles to within 3 % (frequencies) and 30 % (the rest), and
    their effects' signed parameters to within 30 %."""
    plain = len(structure.base_parameters)
    for i, (p, u, v) in enumerate(zip(structure.parameters.parameters, a, b, strict=True)):
        if p.kind == "positive":
            limit = 0.03 if p.name.endswith("frequency_hz") else 0.3
        else:
            limit = np.inf if i < plain else 0.3 * max(abs(u), abs(v))
        if abs(u - v) > limit:
            return False
    return True


def of_others(structure: Structure, kind: str) -> list[int]:
    """Which unknowns are of this kind in the modes that do not sing."""
    index = structure.parameters.index
    return [index[f"mode{i}.{kind}"] for i in range(2, structure.mode_count + 1)]


def signed(structure: Structure, thetas: Sequence[FloatArray]) -> list[FloatArray]:
    """Each with four times the flame residues of the modes that do not sing, of either sign."""
    residues = of_others(structure, "flame_residue")
    out = []
    for theta in thetas:
        for signs in product((1.0, -1.0), repeat=len(residues)):
            signed = theta.copy()
            signed[residues] *= 4 * np.array(signs)
            out.append(signed)
    return out


def moved(
    structure: Structure, near: Fit, free_hz: float, placement: Sequence[float]
) -> list[FloatArray]:
    """A fit's values with small modes elsewhere, the flame's share of either sign."""
    out = []
    for sign in (1.0, -1.0):
        values = near.values
        for i, ratio in enumerate(placement, start=2):
            values |= placed(values, i, ratio * free_hz, flame=sign * 0.2, speaker=0.05)
        out.append(structure.parameters.unknowns(values))
    return out


def placed(
    values: Mapping[str, float], mode: int, frequency_hz: float, *, flame: float, speaker: float
) -> dict[str, float]:
    """Values of a mode at this frequency, hardly damped, its parts in flame and speaker these times
    the singing mode's."""
    return {
        f"mode{mode}.frequency_hz": frequency_hz,
        f"mode{mode}.damping": DAMPING,
        f"mode{mode}.flame_residue": flame * values["mode1.flame_residue"],
        f"mode{mode}.speaker_residue": speaker * values["mode1.speaker_residue"],
    }


def usual_placements(count: int) -> list[tuple[float, ...]]:
    """Assumed frequencies of the other modes over the singing one's: from a closed-open tube's
    odd ratios, an open or closed tube's whole ones, and in between."""
    single = (1.35, 1.67, 2.0, 2.4, 3.0)
    pairs = [(1.67, 2.33), (2.0, 3.0), (1.4, 2.4), (1.67, 3.0), (2.4, 3.2)]
    return _laddered(count, single, pairs)


def dense_placements(count: int) -> list[tuple[float, ...]]:
    """The same a tenth apart, every pair of two, further ones regularly above."""
    grid = [1.35 * 1.11**j for j in range(10)]
    pairs = [(low, high) for i, low in enumerate(grid) for high in grid[i + 2 :]]
    return _laddered(count, grid, pairs)


def _laddered(
    count: int, single: Sequence[float], pairs: Sequence[tuple[float, float]]
) -> list[tuple[float, ...]]:
    """Places of so many modes: one of `single`, or of `pairs`, and further ones regularly above."""
    if count == 0:
        return [()]
    if count == 1:
        return [(q,) for q in single]
    return [(low, high, *(high + 0.8 * j for j in range(1, count - 1))) for low, high in pairs]
