"""Values with which one structure responds as another does: where to start in another form."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.dataset import Dataset
from identify.fit import Fit
from identify.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

NEARBY = 0.7  # of the logarithm: how far the declared model's own may move


def matched(
    larger: Structure, theta: FloatArray, fit: Fit, data: Dataset, moving: str = "mode"
) -> FloatArray | None:
    """Unknowns of `larger` with which it responds as `fit` does at the measured harmonics, from
    `theta`: its last effect's, and those whose names begin with `moving`, which stay nearby. None
    where the responses cannot be brought within a tenth."""
    from scipy.optimize import least_squares  # a third of a second that only this costs

    names = larger.parameters.names
    own = {q.name for q in larger.effects[-1].parameters}
    free = [i for i, n in enumerate(names) if n.startswith(moving) or n in own]

    def responses(structure: Structure, at: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """At all harmonics (n,), and their derivatives by the unknowns (n, p)."""
        parts, slopes = [], []
        for b in data.fit:
            given = replace(b.at, drive=np.ones_like(b.at.drive))
            s = given.s
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
