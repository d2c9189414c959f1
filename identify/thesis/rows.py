"""The balance in polynomial form, linear in the coefficients of its polynomials.

    D(x) Y = x F(x) A(x) U + x² F(x) Σ_d C_d(x) N̂_d,        x = s/ω₀,  D monic

with N̂_d the harmonics of the d-th basis function of the nonlinearity, and F known. The thesis's
Eq. 4.17 has F = 1 and D of the acoustic order 2n: with L1 = 0 that is an approximation, because
the closed loop contains the flame's poles too. With F = P, the flame's denominator, and D of order
2n + m the equation is exact (`identify.start`).
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

ComplexArray = npt.NDArray[np.complex128]


def regressors(
    x: ComplexArray,
    velocity: ComplexArray,
    drive: ComplexArray,
    basis: Sequence[ComplexArray],
    order: int,
    zeros: int,
    factor: ComplexArray | float = 1.0,
) -> tuple[ComplexArray, ComplexArray]:
    """Columns and target of the balance.

    Parameters
    ----------
    x : (runs, K) frequencies s/ω₀ of the coefficients.
    velocity, drive : (runs, K).
    basis : each (runs, K), the harmonics of the nonlinearity's basis functions.
    order : of D, monic.
    zeros : coefficients in A and in each C_d.
    factor : F at x.

    Returns
    -------
    columns : (runs, K, order + zeros·(1 + len(basis))), in the order D, A, C_1, C_2 …, by rising
        power of x.
    target : (runs, K), x^order Y.
    """
    columns = [-(x**j) * velocity for j in range(order)]
    columns += [x ** (j + 1) * factor * drive for j in range(zeros)]
    for harmonics in basis:
        columns += [x ** (j + 2) * factor * harmonics for j in range(zeros)]
    return np.stack(columns, axis=-1), np.asarray(x**order * velocity)
