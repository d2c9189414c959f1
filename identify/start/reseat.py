"""A declared mode that does nothing, put where it does most.

A start may have one mode too many where something else stands for it (a resonance of the speaker),
and none where coarse noise hides one. Led to the end, the shares of the first in flame and speaker
vanish, and no descent carries it over to the place of the second; all other numbers are right.
"""

import numpy as np
import numpy.typing as npt

from identify.assess import lack_of_fit_p
from identify.dataset import Dataset
from identify.fit import Fit, fit_orbits
from identify.start.rough import coarse, distinct, polish
from identify.start.vectors import placed

FloatArray = npt.NDArray[np.float64]

NOISE_P = 1e-3  # chance of leaving so much, above which it may be noise
IDLE = 9.0  # times what the misfit lets χ² vary: what a mode that does nothing takes away at most
PLACES = tuple(1.2 * 1.06**j for j in range(22))  # over the free frequency, up to four times it
APART = 0.05  # of a place from another mode: nearer, the two are one
PART = 0.1  # of the singing mode's shares in flame and speaker
FIRST, SECOND = 0.05, 0.01  # shares of each coefficient's size that count as noise, by stage
LED, KEPT = 24, 4  # starts that are led through these, and that are fitted


def reseated(fit: Fit, data: Dataset) -> Fit:
    """The fit with its idle mode where that leaves least; `fit` itself, where it leaves no more
    than noise, none is idle, or all other places leave more."""
    idle = _idle(fit)
    if idle is None or lack_of_fit_p(fit.chi2, fit.dof) > NOISE_P:
        return fit
    structure, rough = fit.structure, data.coarse()
    starts = coarse(structure, rough, _elsewhere(fit, idle, data.free_hz), FIRST)
    led = distinct(structure, polish(structure, rough, starts[:LED], (FIRST, SECOND), 8))
    if not led:
        return fit
    thetas = np.stack([s.theta for s in led[:KEPT]])
    again = fit_orbits(structure, data, thetas, continuation=(0.003, 0.0))
    return min((fit, again), key=lambda f: f.chi2)


def _idle(fit: Fit) -> int | None:
    """The mode that does least, of those that do not sing, if that is nothing: without its shares
    in flame and speaker, all else at its best, χ² would hardly be more, by the tangents."""
    if not np.isfinite(fit.chi2):
        return None
    index = fit.structure.parameters.index
    taken = {}
    for i in range(2, fit.structure.mode_count + 1):
        at = [index[f"mode{i}.{kind}"] for kind in ("flame_residue", "speaker_residue")]
        shares = fit.theta[at]
        taken[i] = float(shares @ np.linalg.pinv(fit.covariance[np.ix_(at, at)]) @ shares)
    least = min(taken, key=lambda i: taken[i], default=None)
    varies = max(fit.chi2_per_dof, 1.0)
    return least if least is not None and taken[least] < IDLE * varies else None


def _elsewhere(fit: Fit, idle: int, free_hz: float) -> list[FloatArray]:
    """The fit's values with the idle mode at each place where there is none, with small shares of
    either sign."""
    values = fit.values
    modes = range(1, fit.structure.mode_count + 1)
    others = np.array([values[f"mode{i}.frequency_hz"] for i in modes if i != idle])
    out = []
    for frequency in (ratio * free_hz for ratio in PLACES):
        if np.abs(frequency / others - 1.0).min() < APART:
            continue
        for flame in (PART, -PART):
            for speaker in (PART, -PART):
                there = placed(values, idle, frequency, flame=flame, speaker=speaker)
                out.append(fit.structure.parameters.unknowns(values | there))
    return out
