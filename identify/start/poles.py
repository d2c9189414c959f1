"""The balance in polynomial form, scanned over the flame's poles and tied back to modes.

Multiplied by all its denominators, the loop's equation is linear in polynomial coefficients once
the flame's poles P(s) = Π (s + ω_j) are assumed (closed-loop form, Eq. 4.17 with L1 = 0):

    D(s) Y = s P(s) A(s) U + s² P(s) Σ_{d≥2} C_d(s) N̂_d,       N̂_d: harmonics of w^d,  w = H Y
    D(s) = P(s) Π_i den_i(s) − κ s² R(s),   C_d = c_d R(s),   κ: numerator of H

With D monic, that is one linear least-squares problem for each assumed pole, so a scan over the
pole finds all of it without a guess (Figs. 4.11, 4.12). Rows are weighted by 1/(σ |D|) from the
previous solution (Sanathanan–Koerner), which makes the equation error an output error. The flame
poles are roots of D + κ s² R, and R is known up to the scale c_3: that condition fixes the scale,
and roots and residues of what remains are the modes.

Measured velocities appear among the regressors, so noise biases this: good for a start, not for
an answer.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify import periods
from identify.dataset import Batch, Dataset
from identify.start.vectors import named, near
from identify.structure import Structure
from identify.thesis.rows import regressors

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

SHARES = (1e-3, 1e-2, 0.0)  # share of a coefficient's size that its weight counts as noise
SCAN = 24  # assumed flame poles


@dataclass(frozen=True)
class Polynomials:
    """A solution of the polynomial balance for one assumed set of flame poles.

    Coefficients by rising power of x = s/ω₀; `cost` is the weighted squared error.
    """

    poles: FloatArray  # in units of ω₀
    D: FloatArray
    A: FloatArray
    C: tuple[FloatArray, ...]
    cost: float
    scale_rad: float


def _degree(structure: Structure) -> int:
    """Highest power of w that stands for the nonlinearity while starting."""
    return min(structure.highest_power, 5)


@dataclass(frozen=True)
class _Rows:
    """Regressors of the polynomial balance, one row a coefficient of a run."""

    matrix: ComplexArray
    target: ComplexArray
    sigma: FloatArray
    x: ComplexArray


def _rows(
    structure: Structure, batch: Batch, poles: FloatArray, w0: float, share: float, count: int
) -> _Rows:
    n, m = structure.mode_count, structure.flame_order
    K = batch.at.harmonics
    harmonics = np.arange(1, K + 1)
    x = np.asarray(1j * batch.at.omega[:, None] * harmonics / w0, dtype=np.complex128)
    P: ComplexArray = np.ones_like(x)
    for pole in poles:
        P = P * (x + pole)
    Y = batch.at.velocity
    kappa = float(np.prod(poles[1:])) if m else 1.0
    w_time = periods.to_time(kappa * Y / P, K)
    basis = [periods.to_harmonics(w_time**d, K) for d in range(2, _degree(structure) + 1)]
    columns, known = regressors(
        np.asarray(x, dtype=np.complex128), Y, batch.at.drive, basis, 2 * n + m, 2 * n - 1, P
    )
    size = np.maximum(np.abs(batch.measured), 0.003 * np.abs(batch.measured[:, :1]))
    sigma = np.sqrt(batch.noise + (share * size) ** 2)[:, :count]
    target: ComplexArray = known[:, :count].ravel()
    matrix: ComplexArray = columns[:, :count].reshape(target.size, -1)
    warm = np.repeat(batch.at.flame_on > 0, sigma.shape[1])  # a cold run has another D
    return _Rows(
        matrix[warm],
        target[warm],
        sigma.ravel()[warm],
        np.asarray(x[:, :count], dtype=complex).ravel()[warm],
    )


def polynomial_balance(
    structure: Structure, data: Dataset, poles: FloatArray, share: float, rounds: int = 4
) -> Polynomials:
    """Reweighted linear least squares for assumed flame `poles` (in units of the free ω)."""
    w0 = 2 * np.pi * data.free_hz
    n, m = structure.mode_count, structure.flame_order
    rows = [_rows(structure, b, poles, w0, share, b.compared) for b in data.fit]
    matrix = np.concatenate([r.matrix for r in rows])
    target = np.concatenate([r.target for r in rows])
    sigma = np.concatenate([r.sigma for r in rows])
    x = np.concatenate([r.x for r in rows])
    weight = 1.0 / (sigma * np.abs(x) ** (2 * n + m))
    solution = np.zeros(matrix.shape[1])
    cost = np.inf
    for _ in range(rounds):
        A = matrix * weight[:, None]
        b = target * weight
        A_real = np.concatenate([A.real, A.imag])
        b_real = np.concatenate([b.real, b.imag])
        norm = np.sqrt(np.sum(A_real**2, axis=0)) + 1e-300
        solution = np.linalg.lstsq(A_real / norm, b_real, rcond=1e-11)[0]
        cost = float(np.sum((b_real - A_real / norm @ solution) ** 2))
        solution = solution / norm
        D_at = x ** (2 * n + m) + sum(solution[j] * x**j for j in range(2 * n + m))
        weight = 1.0 / (sigma * np.maximum(np.abs(D_at), 1e-6))
    D = np.r_[solution[: 2 * n + m], 1.0]
    parts = solution[2 * n + m :].reshape(-1, 2 * n - 1)
    return Polynomials(poles, D, parts[0], tuple(parts[1:]), cost, w0)


def to_parameters(structure: Structure, found: Polynomials) -> FloatArray | None:
    """Internal parameters from polynomials; None where their roots are no modes."""
    n, m = structure.mode_count, structure.flame_order
    kappa = float(np.prod(found.poles[1:])) if m else 1.0
    degree = _degree(structure)
    c: list[float] = []
    if degree >= 3 and m >= 1:
        main = found.C[1]
        at = -found.poles
        left = kappa * at**2 * np.polyval(main[::-1], at)
        right = np.polyval(found.D[::-1], at)
        scale = -float(left @ left / (left @ right)) if left @ right != 0 else np.nan
        if not np.isfinite(scale) or scale == 0:
            return None
        R = main / scale
        c = [float(C @ R / (R @ R + 1e-300)) for C in found.C]
    else:
        R = np.zeros(2 * n - 1)
    full = found.D.copy()
    full[2 : 2 + R.size] += kappa * R
    P = np.poly(-found.poles) if m else np.array([1.0])
    modes, _ = np.polydiv(full[::-1], P)
    roots = np.roots(modes)
    roots = roots[roots.imag > 1e-6]
    roots = roots[np.argsort(np.abs(roots))]
    if roots.size != n:
        return None
    values: dict[str, float] = {}
    w0 = found.scale_rad
    for i, root in enumerate(roots):
        others = np.prod(
            [root**2 + 2 * (-r.real) * root + abs(r) ** 2 for r in np.delete(roots, i)]
        )
        values[f"mode{i + 1}.frequency_hz"] = float(abs(root)) * w0 / (2 * np.pi)
        values[f"mode{i + 1}.damping"] = float(np.clip(-root.real / abs(root), 0.003, 0.3))
        r = np.polyval(R[::-1], root) / others
        a = np.polyval(found.A[::-1], root) / others
        values[f"mode{i + 1}.flame_residue"] = float(r.real) * w0
        values[f"mode{i + 1}.speaker_residue"] = float(a.real) * w0
    for j, pole in enumerate(found.poles):
        key = "flame.pole_hz" if j == 0 else f"flame.pole{j + 1}_hz"
        values[key] = float(pole) * w0 / (2 * np.pi)
    # w here is H Y with s in units of ω₀: w_physical = w / ω₀, so c_d scales with ω₀^(d−1)
    coefficients = [cd * w0 ** (d - 1) for d, cd in enumerate(c, start=2)]
    return named(structure, values, coefficients)


def pole_scan(
    structure: Structure, data: Dataset, share: float, points: int = SCAN
) -> list[Polynomials]:
    """Polynomial balances over assumed flame poles, best first, the minimum refined.

    With several flame poles the draws are low-discrepancy; with one, a logarithmic grid from a
    twelfth to eight times the free frequency, its best interval narrowed by golden section.
    """
    m = structure.flame_order
    if m == 0:
        return [polynomial_balance(structure, data, np.empty(0), share)]
    if m > 1:
        draws = _evenly(4 * points, m)
        grid = np.sort(np.exp(np.log(0.08) + np.log(100.0) * draws), axis=1)
        found = [polynomial_balance(structure, data, p, share) for p in grid]
        return sorted(found, key=lambda f: f.cost)
    grid1 = np.geomspace(0.08, 8.0, points)
    found = [polynomial_balance(structure, data, np.array([p]), share) for p in grid1]
    best = int(np.argmin([f.cost for f in found]))
    low, high = np.log(grid1[max(best - 1, 0)]), np.log(grid1[min(best + 1, points - 1)])
    golden = 0.5 * (np.sqrt(5) - 1)
    for _ in range(10):
        a, b = high - golden * (high - low), low + golden * (high - low)
        fa, fb = (polynomial_balance(structure, data, np.array([np.exp(q)]), share) for q in (a, b))
        found += [fa, fb]
        low, high = (low, b) if fa.cost < fb.cost else (a, high)
    return sorted(found, key=lambda f: f.cost)


def _evenly(count: int, dimensions: int) -> FloatArray:
    """Low-discrepancy points in the unit cube, (count, dimensions): the additive recurrence with
    steps φ^−i, φ the root of x^(d+1) = x + 1 (the golden ratio's generalisation)."""
    phi = 2.0
    for _ in range(40):
        phi = (1 + phi) ** (1 / (dimensions + 1))
    steps = phi ** -np.arange(1.0, dimensions + 1)
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0)


def candidates(structure: Structure, data: Dataset, keep: int = 4) -> Iterator[FloatArray]:
    """Starting vectors, most promising first: per weighting the best distinct poles."""
    seen: list[FloatArray] = []
    for share in SHARES:
        taken = 0
        for found in pole_scan(structure, data, share):
            theta = to_parameters(structure, found)
            if theta is None or not np.isfinite(theta).all():
                continue
            if any(near(structure, theta, other) for other in seen):
                continue
            seen.append(theta)
            taken += 1
            yield theta
            if taken >= keep:
                break
