"""Coefficients of the fourth-order exponential integrator (Cox & Matthews 2002, ETDRK4).

For x' = A x + Σ_c b_c g_c and step h the linear part is exact (E = e^{Ah}), and each scalar
g_c is integrated with fourth order from its values at the step's start (0), twice at its middle
(a, b) and at its end (c):

    x₊ = E x + Σ_c [β₁ g₀ + β₂ (g_a + g_b) + β₃ g_c],
    β₁ = h(φ₁ − 3φ₂ + 4φ₃) b,  β₂ = h(2φ₂ − 4φ₃) b,  β₃ = h(4φ₃ − φ₂) b,   φ_k = φ_k(Ah)
    stages: x_a = E½ x + α g₀,  x_b = E½ x + α g_a,  x_c = E½ x_a + α(2 g_b − g₀),  α = ½h φ₁(½Ah) b

Because each g needs only one number of a stage (a row times the stage's state), the stages are
never formed: the rows are projected through E½ and α here, once.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from simulated_rig.statespace import FloatArray, StateSpace

VECTOR = 4  # doubles in a SIMD register; more on some machines, none the worse


@dataclass(frozen=True)
class Coefficients:
    """Arrays for the kernel; rows are ordered z, loss; channels flame, loss, drive, noise.

    `matrix` (n, padded): column j of e^{Ah}, then of the kernel's `ROWS`, then zeros; `beta`
    (4 · 3, n padded): β₁, β₂, β₃ of each channel; `alpha`, `alpha_half` (2, 4): rows times α and
    E½α; `rate_row` (1 + m, n) and `rate_b` (1 + m, 4): z' and the microphones' pressures.
    """

    h: float
    matrix: FloatArray
    beta: FloatArray
    alpha: FloatArray
    alpha_half: FloatArray
    rate_row: FloatArray
    rate_b: FloatArray


def _padded(rows: FloatArray) -> FloatArray:
    """(k, m) with zeros appended until m fills whole vectors."""
    missing = -rows.shape[1] % VECTOR
    return np.ascontiguousarray(np.pad(rows, ((0, 0), (0, missing))))


def _phi(a: FloatArray, b: FloatArray, h: float, order: int) -> tuple[FloatArray, list[FloatArray]]:
    """e^{Ah} and φ_k(Ah) b for k = 1…order, from one exponential of an augmented matrix."""
    n, m = b.shape
    # Columns of unit size: expm scales and squares by the norm, and each squaring costs digits.
    size = np.maximum(np.max(np.abs(b), axis=0), 1e-300)
    big = np.zeros((n + order * m, n + order * m))
    big[:n, :n] = a * h
    big[:n, n : n + m] = b / size * np.max(np.abs(a * h))
    for k in range(order - 1):
        big[n + k * m : n + (k + 1) * m, n + (k + 1) * m : n + (k + 2) * m] = np.eye(m)
    full = np.asarray(expm(big))
    size = size / np.max(np.abs(a * h))
    return full[:n, :n], [full[:n, n + k * m : n + (k + 1) * m] * size for k in range(order)]


def coefficients(system: StateSpace, h: float) -> Coefficients:
    """The integrator's coefficients for one step of `h` seconds."""
    # Balance: η is thousands of times smaller than v, which would cost expm some digits.
    size = np.ones(system.order)
    size[: system.modes] = 1.0 / np.maximum(
        1.0, np.sqrt(-np.diag(system.a[system.modes :, :])[: system.modes])
    )
    a = system.a / size[:, None] * size[None, :]
    b = system.b / size[:, None]
    full, (f1, f2, f3) = _phi(a, b, h, 3)
    half, (h1,) = _phi(a, b, h / 2, 1)
    full = full * size[:, None] / size[None, :]
    half = half * size[:, None] / size[None, :]
    f1, f2, f3, h1 = (f * size[:, None] for f in (f1, f2, f3, h1))
    alpha = h / 2 * h1
    beta = h * np.stack([f1 - 3 * f2 + 4 * f3, 2 * f2 - 4 * f3, 4 * f3 - f2])
    rows = np.stack([system.z, system.loss])
    rates = np.vstack([system.z[None, :], system.pressure])
    static = np.vstack([np.zeros((1, system.order)), system.pressure_static])
    now, middle, end = rows, rows @ half, rows @ full
    rate_row = rates @ system.a + static
    stacked = [full, now[:1], middle[:1], end[:1], rate_row[:1], now[1:], middle[1:], end[1:]]
    return Coefficients(
        h=h,
        matrix=_padded(np.vstack(stacked).T),
        beta=_padded(beta.transpose(2, 0, 1).reshape(-1, system.order)),
        alpha=np.ascontiguousarray(rows @ alpha),
        alpha_half=np.ascontiguousarray(rows @ half @ alpha),
        rate_row=np.ascontiguousarray(rate_row),
        rate_b=np.ascontiguousarray(rates @ system.b),
    )
