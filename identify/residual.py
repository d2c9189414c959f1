"""Whitened residuals of solved orbits: what a descent minimises.

    ρ(θ) = W (Y − Ŷ(θ)) of every run, free ones turned so that their fundamental is real

`OrbitResidual` solves each run's harmonic balance, from the last accepted orbit, else from the
measurement: the measured branch is followed, and a step on which that fails is refused and
shortened. `Pulled` adds weak knowledge to it, `Straightened` restates it in unknowns in which its
long valley is straight, and `soften` lets all runs pull evenly while a fit is far from its end.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, reduce

import numpy as np
import numpy.typing as npt

from identify import balance
from identify.balance import Orbits
from identify.dataset import Batch, whitener
from identify.descent import Evaluated, Residual
from identify.effect import Conditions
from identify.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

LARGEST = 1e100  # of a residual in units of noise, or its slope: the square of more may overflow


def soften(batches: Sequence[Batch], share: float) -> tuple[Batch, ...]:
    """Batches whose noise is raised by `share` of each coefficient's size."""
    if share == 0:
        return tuple(batches)
    out = []
    for b in batches:
        size = np.abs(b.measured)
        # no coefficient counts for less than a hundredth of its run's fundamental
        size = np.maximum(size, 0.01 * size[:, :1])
        extra = np.concatenate([size, size], axis=1) * share
        if b.free:
            extra[:, b.compared] = share * b.at.omega / (2 * np.pi) * 0.1
        covariance = b.covariance + extra[:, :, None] ** 2 * np.eye(2 * b.compared)
        out.append(
            replace(b, covariance=covariance, whitener=np.stack([whitener(c) for c in covariance]))
        )
    return tuple(out)


class OrbitResidual:
    """Whitened residuals of solved orbits, with the last orbits to start the next ones from.

    A residual does not exist where an orbit does not, or where it is beyond numbers.
    With `newton_steps` the orbits are only approached by that many steps from the measurement:
    the residual then exists for nearly every θ and has fewer local minima, close to a solution it
    is the same. (The plain equation error with the measured velocity fed to the nonlinearity has
    no such use: a loop gain of one explains any measurement by itself.)
    """

    def __init__(
        self, structure: Structure, batches: Sequence[Batch], newton_steps: int | None = None
    ) -> None:
        self.structure = structure
        self.batches = tuple(batches)
        self.newton_steps = newton_steps
        self.known: dict[int, tuple[FloatArray, Orbits]] = {}
        self.solved: tuple[FloatArray, Orbits] | None = None
        self.tiled: dict[int, list[tuple[Batch, IntArray]]] = {}

    def __call__(self, thetas: FloatArray, which: IntArray, jacobian: bool) -> Evaluated:
        vectors = thetas.shape[0]
        exists = np.ones(vectors, dtype=bool)
        rows, jacobians = [], []
        with np.errstate(all="ignore"):
            orbits = self._orbits(thetas, which, jacobian)
            seen = orbits.seen
            for batch, own in self._parts(vectors):
                rho, J = compare(batch, seen.take(own))
                rows.append(rho.reshape(vectors, -1))
                if J is not None:
                    jacobians.append(J.reshape(vectors, -1, J.shape[-1]))
        if self.newton_steps is None:
            exists &= orbits.converged.reshape(vectors, -1).all(axis=1)
        residual = np.concatenate(rows, axis=1)
        exists &= (np.abs(residual) < LARGEST).all(axis=1)
        if not jacobian:
            self.solved = thetas.copy(), orbits
            return Evaluated(residual, None, exists)
        J_all = np.concatenate(jacobians, axis=1)
        exists &= (np.abs(J_all) < LARGEST).all(axis=(1, 2))
        if self.newton_steps is None:
            for n, descent in enumerate(which):
                if exists[n]:
                    self.known[int(descent)] = thetas[n].copy(), orbits.take(self._rows(n))
        return Evaluated(residual, J_all, exists)

    @cached_property
    def at(self) -> Conditions:
        """All batches' runs, solved side by side."""
        return reduce(Conditions.joined, [b.at for b in self.batches])

    def _rows(self, vector: int) -> IntArray:
        """The rows of one parameter vector among those of several."""
        return vector * self.at.runs + np.arange(self.at.runs)

    def _parts(self, vectors: int) -> list[tuple[Batch, IntArray]]:
        """Each batch, tiled for so many vectors, and its rows among the solved ones."""
        if vectors not in self.tiled:
            ends = np.cumsum([b.runs for b in self.batches])
            self.tiled[vectors] = [
                (
                    b.tile(vectors),
                    np.concatenate([self._rows(n)[end - b.runs : end] for n in range(vectors)]),
                )
                for b, end in zip(self.batches, ends, strict=True)
            ]
        return self.tiled[vectors]

    def _orbits(self, thetas: FloatArray, which: IntArray, jacobian: bool) -> Orbits:
        """All runs' orbits; those that the last trial solved already are only differentiated."""
        if jacobian and self.solved is not None:
            same = [np.flatnonzero((self.solved[0] == t).all(axis=1)) for t in thetas]
            if all(s.size for s in same):
                orbits = self.solved[1].take(np.concatenate([self._rows(int(s[0])) for s in same]))
                return balance.differentiate(self.structure, thetas, self.at, orbits)
        start, start_omega = self._predict(thetas, which)
        return balance.solve(
            self.structure,
            thetas,
            self.at,
            start=start,
            start_omega=start_omega,
            derivatives=jacobian,
            iterations=self.newton_steps,
        )

    def _predict(
        self, thetas: FloatArray, which: IntArray
    ) -> tuple[ComplexArray | None, FloatArray | None]:
        """Where the orbits are expected: the last ones, carried along their derivatives."""
        if any(int(n) not in self.known for n in which):
            return None, None
        inputs, omegas = [], []
        for theta, n in zip(thetas, which, strict=True):
            before, orbits = self.known[int(n)]
            assert orbits.d_inputs is not None
            step = theta - before
            inputs.append(orbits.inputs + orbits.d_inputs @ step)
            drift = 0.0 if orbits.d_omega is None else orbits.d_omega @ step
            omegas.append(orbits.omega + drift)
        return np.concatenate(inputs, axis=1), np.concatenate(omegas)


def compare(batch: Batch, orbits: Orbits) -> tuple[FloatArray, FloatArray | None]:
    """Whitened residuals (runs·2K,) of one batch and their Jacobian (runs·2K, p)."""
    K = batch.compared
    y = orbits.velocity[:, :K]
    dy = None if orbits.d_velocity is None else orbits.d_velocity[:, :K]
    if batch.free:
        y, dy, measured = _turned(batch, y, dy)
    else:
        measured = batch.measured
    error = measured - y
    real = np.concatenate([error.real, error.imag], axis=1)
    d_real = None if dy is None else -np.concatenate([dy.real, dy.imag], axis=1)
    if batch.free:
        real[:, K] = (batch.at.omega - orbits.omega) / (2 * np.pi)
        if d_real is not None and orbits.d_omega is not None:
            d_real[:, K] = -orbits.d_omega / (2 * np.pi)
    rho = np.einsum("rij,rj->ri", batch.whitener, real).ravel()
    if d_real is None:
        return rho, None
    return rho, (batch.whitener @ d_real).reshape(rho.size, -1)


def _turned(
    batch: Batch, y: ComplexArray, dy: ComplexArray | None
) -> tuple[ComplexArray, ComplexArray | None, ComplexArray]:
    """Prediction and measurement of free runs, both turned so that the fundamental is real."""
    k = np.arange(1, batch.compared + 1)
    phase = np.angle(y[:, :1])
    turned = y * np.exp(-1j * phase * k)
    if dy is not None:
        d_phase = (dy[:, :1] / y[:, :1, None]).imag
        dy = (dy - 1j * k[:, None] * d_phase * y[..., None]) * np.exp(-1j * phase * k)[..., None]
    measured = batch.measured * np.exp(-1j * np.angle(batch.measured[:, :1]) * k)
    return turned, dy, measured


class Pulled:
    """A residual with more rows that pull linear combinations of the unknowns towards targets.

    `rows` (pulls, p), in units of one standard deviation each; `targets` (descents, pulls), zero
    where none are given.
    """

    def __init__(
        self, inner: Residual, rows: FloatArray, targets: FloatArray | None = None
    ) -> None:
        self.inner, self.rows, self.targets = inner, rows, targets

    def __call__(self, thetas: FloatArray, which: IntArray, jacobian: bool) -> Evaluated:
        found = self.inner(thetas, which, jacobian)
        pull = thetas @ self.rows.T
        if self.targets is not None:
            pull = pull - self.targets[which]
        residual = np.concatenate([found.residual, pull], axis=1)
        if found.jacobian is None:
            return Evaluated(residual, None, found.exists)
        more = np.broadcast_to(self.rows, (thetas.shape[0], *self.rows.shape))
        return Evaluated(residual, np.concatenate([found.jacobian, more], axis=1), found.exists)


class Straightened:
    """The same residual in unknowns u in which its long valley is straight.

    Near the limit cycle a gain of the flame is balanced by damping and detuning of the mode that
    sings: 2ζ₁ω₁ and ω₁² move in proportion to r₁, while the products r₁ c_d and the ratios
    r_i/r₁ stay. So u holds ζ₁ itself (not its logarithm), κ_i = r_i/r₁ and ρ_d = c_d r₁ in place
    of ln ζ₁, r_i and c_d; along such a valley only r₁, ζ₁ and f₁ change, and linearly.
    """

    def __init__(self, inner: Residual, structure: Structure) -> None:
        self.inner = inner
        names = structure.parameters.names
        self.r1 = names.index("mode1.flame_residue")
        self.zeta = names.index("mode1.damping")
        later = [n for n in names if n.endswith("flame_residue") and n != names[self.r1]]
        self.ratios = np.array([names.index(n) for n in later], dtype=int)
        kept = [i for i, n in enumerate(names) if n.startswith("nonlinearity.c")]
        self.products = np.array(kept, dtype=int)

    def inside(self, thetas: FloatArray) -> FloatArray:
        u = thetas.copy()
        r = self._safe(thetas[..., self.r1])
        u[..., self.zeta] = np.exp(thetas[..., self.zeta])
        u[..., self.ratios] = thetas[..., self.ratios] / r[..., None]
        u[..., self.products] = thetas[..., self.products] * r[..., None]
        return u

    def outside(self, u: FloatArray) -> FloatArray:
        thetas = u.copy()
        r = self._safe(u[..., self.r1])
        thetas[..., self.zeta] = np.log(np.maximum(u[..., self.zeta], 1e-12))
        thetas[..., self.ratios] = u[..., self.ratios] * r[..., None]
        thetas[..., self.products] = u[..., self.products] / r[..., None]
        return thetas

    @staticmethod
    def _safe(r: FloatArray) -> FloatArray:
        return np.asarray(np.where(np.abs(r) > 1e-12, r, 1e-12))

    def to_inside(self, jacobian: FloatArray, u: FloatArray) -> FloatArray:
        """∂ρ/∂u from ∂ρ/∂θ, (vectors, n, p)."""
        J = jacobian.copy()
        r = self._safe(u[:, self.r1])[:, None, None]
        kappa, rho = u[:, None, self.ratios], u[:, None, self.products]
        J[..., self.r1] += np.sum(jacobian[..., self.ratios] * kappa, axis=2)
        J[..., self.r1] -= np.sum(jacobian[..., self.products] * rho / r**2, axis=2)
        J[..., self.ratios] = jacobian[..., self.ratios] * r
        J[..., self.products] = jacobian[..., self.products] / r
        J[..., self.zeta] = jacobian[..., self.zeta] / np.maximum(u[:, self.zeta], 1e-12)[:, None]
        return J

    def to_outside(self, jacobian: FloatArray, u: FloatArray) -> FloatArray:
        """∂ρ/∂θ from ∂ρ/∂u: the inverse of `to_inside`."""
        J = jacobian.copy()
        r = self._safe(u[:, self.r1])[:, None, None]
        kappa, rho = u[:, None, self.ratios], u[:, None, self.products]
        J[..., self.ratios] = jacobian[..., self.ratios] / r
        J[..., self.products] = jacobian[..., self.products] * r
        J[..., self.zeta] = jacobian[..., self.zeta] * np.maximum(u[:, self.zeta], 1e-12)[:, None]
        J[..., self.r1] -= np.sum(J[..., self.ratios] * kappa, axis=2)
        J[..., self.r1] += np.sum(J[..., self.products] * rho / r**2, axis=2)
        return J

    def __call__(self, thetas: FloatArray, which: IntArray, jacobian: bool) -> Evaluated:
        found = self.inner(self.outside(thetas), which, jacobian)
        if found.jacobian is not None:
            found.jacobian = self.to_inside(found.jacobian, thetas)
        return found

    def bounds(self, structure: Structure) -> tuple[FloatArray, FloatArray]:
        low, high = structure.parameters.bounds()
        low, high = low.copy(), high.copy()
        low[self.zeta], high[self.zeta] = np.exp(low[self.zeta]), np.exp(high[self.zeta])
        return low, high
