"""What a bent microphone heard, from what it read, compiled.

It reads r = p + a pⁿ less its mean; p, of no mean itself, is found by Newton's method, sample by
sample, row by row: a search asks for it thousands of times.
"""

from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from identify import dual
from identify.periods import to_harmonics, to_time

ComplexArray = npt.NDArray[np.complex128]

STEPS, EXACT = 12, 1e-12  # of Newton's method, and its last, of the loudest
FLATTEST, LOUDEST = 0.1, 3.0  # least slope of what is read, and most heard of what is: no more bent


def unbent(read: ComplexArray, a: Any, power: int) -> Any:
    """Harmonics (rows, K) of what was heard less what was read, of p + a pⁿ less its mean: p of no
    mean that this is said of. `a` is a number, (rows, 1), or a Dual of either."""
    r, K = to_time(read, read.shape[1]), read.shape[1]
    size = dual.column(a, r.shape[0])
    more, by_size = _solved(r, size, power)
    return to_harmonics(dual.chain(more, (by_size, a)), K)


# NaN and infinity keep their meaning: what diverges must be seen to.
@numba.njit(cache=True, error_model="numpy")
def _solved(r, size, power):  # type: ignore[no-untyped-def]
    """p − r (rows, T), and its derivative by the size (rows,) of what bends."""
    rows, T = r.shape
    more, by_size = np.empty_like(r), np.empty_like(r)
    p, inverse, rest = np.empty(T), np.empty(T), np.empty(T)
    loudest = LOUDEST * np.max(np.abs(r))
    for i in range(rows):
        a = size[i]
        for t in range(T):
            p[t] = r[i, t]
        for _ in range(STEPS):
            weight, mean = 0.0, 0.0
            for t in range(T):
                bent = p[t] ** (power - 1)
                inverse[t] = 1.0 / max(1.0 + power * a * bent, FLATTEST)
                rest[t] = r[i, t] - p[t] - a * bent * p[t]
                weight += inverse[t]
                mean += rest[t] * inverse[t]
            mean /= weight
            largest = 0.0
            for t in range(T):
                step = (rest[t] - mean) * inverse[t]
                p[t] = min(max(p[t] + step, -loudest), loudest)  # where no p fits, none runs away
                largest = max(largest, abs(step))
            if largest < EXACT * loudest:
                break
        mean = 0.0
        for t in range(T):
            rest[t] = p[t] ** power
            mean += rest[t] * inverse[t] / weight
        for t in range(T):
            more[i, t] = p[t] - r[i, t]
            by_size[i, t] = (mean - rest[t]) * inverse[t]
    return more, by_size
