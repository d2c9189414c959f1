"""Tail probabilities and rank correlation, from `scipy.special`.

`scipy.stats` has them too, and takes longer to import than everything else here together.
"""

from functools import lru_cache
from itertools import permutations

import numpy as np
import numpy.typing as npt
from scipy import special

FEW = 7  # values whose orders are all gone through


def chi2_tail(x: float, dof: float) -> float:
    """P(χ² with `dof` degrees of freedom > x)."""
    return float(special.chdtrc(dof, max(x, 0.0)))


def chi2_points(p: float, dof: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """What χ² with so many degrees of freedom each exceeds with probability p."""
    return np.asarray(special.chdtri(dof, p))


def f_tail(x: float, dof_above: float, dof_below: float) -> float:
    """P(F > x) of Fisher's ratio."""
    return float(special.fdtrc(dof_above, dof_below, max(x, 0.0)))


def beta_tail(x: float, a: float, b: float) -> float:
    """P(X > x) of a Beta(a, b): of one square's share in a sum of n, a = 1/2, b = (n − 1)/2."""
    return float(special.betaincc(a, b, x))


def rank_correlation(a: npt.ArrayLike, b: npt.ArrayLike) -> tuple[float, float]:
    """Spearman's ρ and its two-sided p-value; NaN for a constant.

    Of up to `FEW` values by all their orders, since Student's t with n − 2 degrees of freedom calls
    six values that happen to be in order impossible: two of their 720 orders are.
    """
    x, y = _ranks(a), _ranks(b)
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x @ x) * (y @ y)))
    dof = x.size - 2
    if size == 0 or dof < 1:
        return float("nan"), float("nan")
    rho = float(np.clip(x @ y / size, -1.0, 1.0))
    if x.size <= FEW:
        products = x[_orders(x.size)] @ y
        return rho, float(np.mean(np.abs(products) >= abs(x @ y) * (1 - 1e-9)))
    t = abs(rho) * np.sqrt(dof / max(1 - rho**2, 1e-300))
    return rho, float(2 * special.stdtr(dof, -t))


@lru_cache(maxsize=FEW)
def _orders(count: int) -> npt.NDArray[np.int64]:
    """All orders of so many things, (count!, count)."""
    return np.array(list(permutations(range(count))), dtype=np.int64)


def _ranks(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Ranks from 1, equal values sharing their mean rank."""
    _, inverse, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    return np.asarray((last - 0.5 * (count - 1))[inverse.ravel()], dtype=float)
