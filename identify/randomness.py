"""Whether differences from run to run are random, or follow a law of the runs' conditions.

Let r ~ N(0, I) be what was measured, whitened by noise and spread together and projected off what
the fitted parameters absorb. The runs' deviations span a space S of it; deviations that are a
linear function of covariates, one, two or three at a time, span L ⊂ S. Where they are random,

    (|P_L r|² / dim L) / ((|P_S r|² − |P_L r|²) / (dim S − dim L)) ~ F(dim L, dim S − dim L),

however large the spread is: a law takes more than its share. What the parameters absorb nearly is
left out of S: such a direction holds noise, which a law that leaves nothing of the deviations would
be measured by.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.chances import f_tail

FloatArray = npt.NDArray[np.float64]

LAW_P = 0.002  # a law less probable than this by chance is one
SEEN = 0.5  # of a standard deviation of r that deviations must make in a direction to be seen there


@dataclass(frozen=True)
class Law:
    """The most improbable of the laws asked for: which of the deviations follow what."""

    directions: tuple[int, ...]
    covariates: tuple[str, ...]
    p_value: float


def law_in(
    residual: FloatArray,
    jacobian: FloatArray,
    deviations: FloatArray,
    covariates: Mapping[str, FloatArray],
    groups: Sequence[Sequence[str]],
) -> Law | None:
    """The law that the deviations follow, or None where they may be random.

    Parameters
    ----------
    residual : (n,), whitened by noise and spread; jacobian : (n, p), by the fitted parameters.
    deviations : (n, m, q), what m runs' q deviations of one standard deviation do to r.
    covariates : (m,) each; groups : names of those that a law may join.
    """
    base = _span(jacobian)
    rest = residual - base @ (base.T @ residual)
    n, m, q = deviations.shape
    flat = deviations.reshape(n, -1)
    free = (flat - base @ (base.T @ flat)).reshape(n, m, q)
    U, S, _ = np.linalg.svd(free.reshape(n, -1), full_matrices=False)
    whole = U[:, SEEN < S]
    total, room = float(np.sum((whole.T @ rest) ** 2)), whole.shape[1]
    if not total > 0:
        return None
    found = []
    for names in groups:
        columns = np.stack([_standard(covariates[name]) for name in names], axis=1)
        for which in [*((j,) for j in range(q)), *([tuple(range(q))] if q > 1 else [])]:
            along = np.concatenate([free[:, :, j] @ columns for j in which], axis=1)
            law = whole @ _span(whole.T @ along)
            size = law.shape[1]
            if 0 < size < room:
                taken = float(np.sum((law.T @ rest) ** 2))
                left = max(total - taken, 1e-12 * total) / (room - size)
                p_value = f_tail(taken / size / left, size, room - size)
                found.append(Law(which, tuple(names), p_value))
    best = min(found, key=lambda law: law.p_value, default=None)
    return best if best is not None and best.p_value < LAW_P else None


def _standard(values: FloatArray) -> FloatArray:
    spread = float(np.std(values))
    return np.asarray((values - np.mean(values)) / (spread if spread > 0 else 1.0))


def _span(columns: FloatArray) -> FloatArray:
    """An orthonormal basis."""
    size = np.sqrt(np.sum(columns**2, axis=0))
    U, S, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    return np.asarray(U[:, 1e-6 * max(float(S[0]), 1e-300) < S])
