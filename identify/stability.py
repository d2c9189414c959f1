"""Is a steady state of the model stable? Floquet exponents from the model's own equations.

A small disturbance e^{λt} Σ_k p_k e^{jkωt} of the nonlinearities' inputs on an orbit obeys

    p_a,k = Σ_b P_ab(λ + jkω) Σ_m N'_b,k−m p_b,m,        k, m = −K … K             (Hill)

with N'_b,n the Fourier coefficients of the slope N_b' along the orbit. The exponents are the roots
of Δ(λ) = det(I − P(λ) T), once each in a strip of height ω. The open loop's own poles are stable
(resonators, flame, speaker), so the exponents to the right of Re λ = ε are counted by Nyquist's
criterion: by the turns of Δ(ε + jΩ) round 0 while Ω falls from ω/2 to −ω/2; the strip's far sides
cancel. No state space is needed: delays and every effect of the catalogue are covered.

A free cycle has the exponent 0, its phase: counting a little to the right leaves it out.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify import balance, periods
from identify.balance import Orbits
from identify.effect import Conditions
from identify.pieces import Values
from identify.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

MARGIN = 1e-5  # of ω: what grows slower than that counts as neutral
GRID = 129  # points of the first contour; refined where Δ turns faster than by TURN
TURN = 0.6  # rad
HARMONICS = 8  # that carry the disturbance


@dataclass(frozen=True)
class Disturbed:
    """An orbit's linearisation: `toeplitz` (rows, loops, 2K+1, 2K+1) of N', one row an orbit."""

    structure: Structure
    values: Values
    at: Conditions
    omega: FloatArray
    toeplitz: ComplexArray

    @classmethod
    def around(
        cls,
        structure: Structure,
        values: Values,
        at: Conditions,
        omega: FloatArray,
        v: ComplexArray,
    ) -> "Disturbed":
        """Orbits with nonlinearity inputs `v` (loops, rows, K); `values` plain, floats or
        (rows, 1)."""
        K = at.harmonics
        kept = min(K, HARMONICS)
        loop = structure.assemble(values, at, 1j * omega[:, None] * np.arange(1, K + 1))
        order = np.arange(-kept, kept + 1)
        blocks = []
        for n, x in zip(loop.N, v, strict=True):
            slope = balance.slope_along(n, periods.to_time(x, K))
            c = np.fft.fft(slope, axis=1) / slope.shape[1]
            blocks.append(c[:, order[:, None] - order])
        still = replace(at, drive=np.zeros((at.runs, 1), dtype=complex),
                        pressure=np.zeros((at.runs, 1), dtype=complex),
                        velocity=np.zeros((at.runs, 1), dtype=complex))  # fmt: skip
        return cls(structure, values, still, omega, np.stack(blocks, axis=1))

    def determinant(self, exponents: npt.ArrayLike) -> ComplexArray:
        """Δ at one λ for each row, (rows,)."""
        lam = np.asarray(exponents, dtype=np.complex128)
        kept = (self.toeplitz.shape[-1] - 1) // 2
        s = lam[:, None] + 1j * self.omega[:, None] * np.arange(-kept, kept + 1)
        loop = self.structure.assemble(self.values, self.at, s)
        loops, size = self.toeplitz.shape[1], self.toeplitz.shape[-1]
        M = np.zeros((lam.size, loops * size, loops * size), dtype=complex)
        for a in range(loops):
            for b in range(loops):
                P = np.broadcast_to(loop.P[a][b], s.shape)
                rows, cols = slice(a * size, (a + 1) * size), slice(b * size, (b + 1) * size)
                M[:, rows, cols] = -P[:, :, None] * self.toeplitz[:, b]
        diagonal = np.arange(loops * size)
        M[:, diagonal, diagonal] += 1.0
        return np.asarray(np.linalg.det(M), dtype=complex)

    def repeated(self, row: int, times: int) -> "Disturbed":
        """One of the orbits `times` times, for as many λ at once."""
        rows = np.full(times, row)
        values = {
            n: v[rows] if np.ndim(v) == 2 and np.shape(v)[0] > 1 else v
            for n, v in self.values.items()
        }
        return Disturbed(
            self.structure, values, self.at.take(rows), self.omega[rows], self.toeplitz[rows]
        )


def unstable_exponents(orbit: Disturbed, row: int = 0) -> int | None:
    """How many Floquet exponents of one orbit have Re λ > `MARGIN`·ω; None where Δ vanishes on
    the contour itself."""
    omega = float(orbit.omega[row])
    points = omega * np.sin(0.5 * np.pi * np.linspace(-1, 1, GRID)) ** 3 / 2  # denser near 0
    found = orbit.repeated(row, points.size).determinant(MARGIN * omega + 1j * points)
    for _ in range(14):
        turn = np.abs(np.angle(found[1:] / found[:-1]))
        if not np.isfinite(turn).all():
            return None
        wide = np.flatnonzero(turn > TURN)
        if not wide.size:
            break
        middle = 0.5 * (points[wide] + points[wide + 1])
        more = orbit.repeated(row, middle.size).determinant(MARGIN * omega + 1j * middle)
        points = np.insert(points, wide + 1, middle)
        found = np.insert(found, wide + 1, more)
    else:
        return None
    turns = float(np.sum(np.angle(found[1:] / found[:-1]))) / (2 * np.pi)
    return max(0, round(-turns))


def leading_exponent(orbit: Disturbed, row: int = 0, free: bool = False) -> complex | None:
    """The exponent (1/s, 0 ≤ Im λ ≤ ω/2) with the largest real part that Newton finds from a grid
    of starts; the phase of a `free` cycle is left out."""
    omega = float(orbit.omega[row])
    real, imag = np.meshgrid(omega * np.array([0.0, -3e-3, -1e-2, -4e-2]), np.linspace(0, 0.5, 17))
    lam = (real + 1j * omega * imag).ravel()
    h = 1e-7 * omega
    step = np.full(lam.size, np.inf, dtype=complex)
    moving = np.arange(lam.size)
    with np.errstate(all="ignore"):
        for _ in range(30):
            many, here = orbit.repeated(row, moving.size), lam[moving]
            ahead, behind = many.determinant(here + h), many.determinant(here - h)
            newton = 0.5 * (ahead + behind) * 2 * h / (ahead - behind)
            newton = newton * np.minimum(1.0, 0.02 * omega / np.maximum(np.abs(newton), 1e-300))
            lam[moving], step[moving] = here - newton, newton
            moving = moving[(np.abs(newton) >= 1e-9 * omega) & np.isfinite(lam[moving])]
            if not moving.size:
                break
        good = np.isfinite(lam) & (np.abs(step) < 1e-7 * omega)
    good &= np.abs(lam.imag) < 0.52 * omega
    if free:
        good &= np.abs(lam) > 3e-5 * omega
    if not good.any():
        return None
    best = lam[good][np.argmax(lam[good].real)]
    return complex(best.real, abs(best.imag))


def stable(structure: Structure, theta: FloatArray, at: Conditions, orbits: Orbits) -> list[bool]:
    """For each run of one batch, whether its solved orbit is stable."""
    values = structure.parameters.plain(theta)
    disturbed = Disturbed.around(structure, values, at, orbits.omega, orbits.inputs)
    return [
        bool(orbits.converged[i]) and unstable_exponents(disturbed, i) == 0 for i in range(at.runs)
    ]
