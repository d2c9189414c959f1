"""Maximum likelihood on the solved orbit.

Each run's Fourier coefficients are predicted by solving the harmonic balance, and the parameters
minimise the noise-weighted difference to the measured ones:

    χ²(θ) = Σ_runs |W (Y − Ŷ(θ))|²

by Levenberg–Marquardt with the exact Jacobian of `identify.balance`. For Gaussian noise this is
the maximum-likelihood estimate; (JᵀJ)⁻¹ is its covariance and, at the truth, the Cramér–Rao bound.

The measured branch is followed: the inner solver starts from the last accepted orbit, else from
the measurement; a step on which it fails is refused and shortened. `softening` adds a share of
each coefficient's own size to its noise: far from the optimum, where the balance is stiff, it lets
all runs pull evenly; lowered step by step to zero, it leads the fit in (continuation).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Protocol

import numpy as np
import numpy.typing as npt

from identify import balance
from identify.balance import Orbits
from identify.dataset import Batch, Dataset, whitener
from identify.parameters import Estimate
from identify.structure import MODAL, Conditions, Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

LEAD_IN_STEPS = 3  # Newton steps towards each orbit while leading in
AT_REST = "no step lowers the misfit any further"
HOPE = 20  # iterations for what may be given up as hopeless …
SHORTLY = 10  # … and for fits of which only those near to the noise matter
VALLEY = 20  # iterations after which a descent is taken to follow one
STUCK = 8  # accepted steps of which nothing comes although the tangents promise nearly all …
FAR = 30.0  # … of so many times what noise leaves
PROBE = 0.3  # of a step, where its curvature is looked at
BENT = 0.4  # of the step that the bend may be
FADES = 0.1  # of another's flame residue: less of it in mode 1 may be none
SAME = 1.0  # of χ²: what two ends of descents differ by that are the same, modes renumbered or not


@dataclass(frozen=True)
class Fit:
    """The outcome of a fit: an answer only where `converged`; `reason` says why not.

    `theta` are the internal unknowns; `covariance` (p, p) theirs; `residual` the whitened
    residuals in the order of the batches; `jacobian` theirs.
    """

    structure: Structure
    theta: FloatArray
    chi2: float
    dof: int
    covariance: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    converged: bool
    reason: str
    iterations: int

    @property
    def ended(self) -> bool:
        """Whether its descent came to an end: converged, or where rounding, a corner or an edge
        lets no step down."""
        return self.converged or self.reason == AT_REST

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / max(self.dof, 1)

    @property
    def estimates(self) -> dict[str, Estimate]:
        return self.structure.parameters.estimates(self.theta, self.covariance)

    @property
    def values(self) -> dict[str, float]:
        return self.structure.parameters.plain(self.theta)


def no_better(fit: Fit, data: Dataset) -> float:
    """The misfit of a fit, in times what noise leaves: what adds to its model, or takes its place,
    and promises no less than that has gone where nothing is."""
    return fit.chi2 / data.residuals if fit.converged else np.inf


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


@dataclass
class Evaluated:
    """Residuals (vectors, n) of several parameter vectors, their Jacobians (vectors, n, p) where
    asked for, and which of them exist (vectors,)."""

    residual: FloatArray
    jacobian: FloatArray | None
    exists: BoolArray


class Residual(Protocol):
    """θ → whitened residuals, for several vectors at once.

    `which` says which of the descents each vector belongs to, for whatever is remembered.
    """

    def __call__(self, thetas: FloatArray, which: IntArray, jacobian: bool) -> Evaluated: ...


class OrbitResidual:
    """Whitened residuals of solved orbits, with the last orbits to start the next ones from.

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
        exists &= np.isfinite(residual).all(axis=1)
        if not jacobian:
            self.solved = thetas.copy(), orbits
            return Evaluated(residual, None, exists)
        J_all = np.concatenate(jacobians, axis=1)
        exists &= np.isfinite(J_all).all(axis=(1, 2))
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


@dataclass(frozen=True)
class Descent:
    """Where Levenberg–Marquardt ended."""

    theta: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    converged: bool
    reason: str
    iterations: int

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)


@dataclass(frozen=True)
class _Factors:
    """Scaled Jacobian J = U diag(sv) Vt at one place, without the unknowns `held` at a bound, and
    what steps from there take of it."""

    scale: FloatArray
    jacobian: FloatArray
    gradient: FloatArray
    values: FloatArray
    Vt: FloatArray
    U: FloatArray
    along: FloatArray  # Uᵀ ρ

    @property
    def promise(self) -> float:
        """Decrease of χ² that a Gauss–Newton step would bring."""
        return float(np.sum(self.along**2 * (self.values > 1e-9 * self.values[0])))

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """The damped step in unscaled unknowns, and the decrease of χ² that it predicts."""
        step = -(self.Vt.T @ (self.values / (self.values**2 + damping) * self.along))
        slope = 2 * self.gradient + self.jacobian.T @ (self.jacobian @ step)
        return step / self.scale, -float(step @ slope)

    def bend(self, damping: float, step: FloatArray, curvature: FloatArray) -> FloatArray:
        """What the second order adds to a step along which the residuals curve so, in unscaled
        unknowns; none where it would be no correction any more."""
        along = self.values / (self.values**2 + damping) * (self.U.T @ curvature)
        bend = -0.5 * (self.Vt.T @ along)
        small = np.linalg.norm(bend) < BENT * np.linalg.norm(step * self.scale)
        return np.asarray(bend / self.scale if small else np.zeros_like(bend))


@dataclass
class _State:
    """One descent in progress."""

    theta: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    scale: FloatArray
    damping: float
    grow: float = 2.0
    refused: int = 0
    iterations: int = 0
    factors: _Factors | None = None
    ended: str | None = None
    converged: bool = False
    costs: list[float] = field(default_factory=list)  # at the start of each iteration
    afresh: int = -1  # iteration at which it last began anew

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    def begin_anew(self, damping: float) -> bool:
        """Forget the scales and the damping of the way here; False where that has been of no use.

        Scales hold the steepest slope of the whole way: one steep place, by an edge perhaps, bars
        an unknown from then on. Far from the noise the end of a descent does not matter so much.
        """
        if self.afresh == self.iterations or self.cost > FAR * self.residual.size:
            return False
        self.scale, self.damping = np.zeros_like(self.scale), damping
        self.grow, self.refused, self.afresh = 2.0, 0, self.iterations
        return True

    @property
    def stuck(self) -> bool:
        """Whether it creeps along an edge beyond which no orbit exists, far from the noise: what
        remains is as good as linear, and yet hardly a step is taken."""
        assert self.factors is not None
        now, far = self.costs[-1], FAR * self.residual.size
        if len(self.costs) <= STUCK or now < far or self.factors.promise < 0.99 * now:
            return False
        return self.costs[-1 - STUCK] - now < 1e-3 * now


def levenberg_marquardt(
    function: Residual,
    thetas: FloatArray,
    *,
    iterations: int = 60,
    tolerance: float = 1e-6,
    damping: float = 1e-3,
    patience: int = 12,
    hopeless: float = np.inf,
    hope: int = HOPE,
    bounds: tuple[FloatArray, FloatArray] | None = None,
) -> list[Descent | None]:
    """Minimise |ρ(θ)|² from each of `thetas`, (starts, p), side by side.

    A descent is None where the residual does not exist at its start. Converged means that the
    step still to come would lower χ² by less than `tolerance` (absolute and relative): a hundredth
    of what a thousandth of a standard error is worth. Unknowns are scaled by the Jacobian's
    columns (Marquardt), damping follows the gain ratio (Nielsen); a descent ends after more than
    `patience` refused steps in a row (near the noise, twice as many, of which the latter half with
    scales and damping begun anew), where it creeps along an edge of what exists, or where after
    `hope` iterations even what its tangents promise of |ρ|² is beyond `hopeless`. Unknowns at a
    bound that the gradient pushes against are held there; `bounds` are (p,) each, or (starts, p).
    """
    count, p = thetas.shape
    limits = bounds if bounds is not None else (np.full(p, -np.inf), np.full(p, np.inf))
    low, high = (np.broadcast_to(limit, (count, p)) for limit in limits)
    everyone = np.arange(count)
    begin = np.clip(thetas, low, high)
    first = function(begin, everyone, True)
    assert first.jacobian is not None
    states: list[_State | None] = [
        _State(begin[n], first.residual[n], first.jacobian[n], np.zeros(p), damping)
        if first.exists[n]
        else None
        for n in everyone
    ]  # fmt: skip
    while True:
        active = [(n, s) for n, s in enumerate(states) if s is not None and s.ended is None]
        trials, steps = [], []
        for n, s in active:
            step = _propose(
                s, low[n], high[n], tolerance, damping, iterations, patience, hopeless, hope
            )
            if step is not None:
                trials.append((n, s))
                steps.append(step)
        if not trials:
            break
        which = np.array([n for n, _ in trials])
        moved = np.stack([s.theta for _, s in trials]) + _bent(function, trials, steps)
        moved = np.clip(moved, low[which], high[which])
        outcome = function(moved, which, False)
        accepted = []
        for m, ((_, s), (_, predicted)) in enumerate(zip(trials, steps, strict=True)):
            new = float(outcome.residual[m] @ outcome.residual[m]) if outcome.exists[m] else np.inf
            gain = (s.cost - new) / max(predicted, 1e-300)
            if gain > 1e-4:
                accepted.append(m)
                s.damping = max(s.damping * max(1 / 5, 1 - (2 * min(gain, 1.0) - 1) ** 3), 1e-12)
                s.grow, s.refused = 2.0, 0
            else:
                s.damping *= s.grow
                s.grow *= 2.0
                s.refused += 1
        if accepted:
            full = function(moved[accepted], which[accepted], True)
            assert full.jacobian is not None
            for row, m in enumerate(accepted):
                s = trials[m][1]
                if not full.exists[row]:
                    s.ended = "the balance has no solution ahead"
                    continue
                s.theta, s.residual = moved[m], full.residual[row]
                s.jacobian = full.jacobian[row]
    return [
        None
        if s is None
        else Descent(
            s.theta, s.residual, s.jacobian, s.converged, s.ended or "stopped", s.iterations
        )
        for s in states
    ]


def _propose(
    s: _State,
    low: FloatArray,
    high: FloatArray,
    tolerance: float,
    damping: float,
    iterations: int,
    patience: int,
    hopeless: float,
    hope: int,
) -> tuple[FloatArray, float] | None:
    """The next step of a descent and its predicted decrease, or None where it has ended."""
    if s.refused == 0:
        s.iterations += 1
        s.costs.append(s.cost)
        s.factors = _factors(s, low, high)
    assert s.factors is not None
    promise = s.factors.promise
    enough = 1.0 + 1e-3 * s.cost
    if promise < tolerance * enough:
        s.converged, s.ended = True, "converged"
        return None
    if s.refused > patience:
        if promise < 1e-3 * enough:
            s.converged, s.ended = True, "converged"
            return None
        if not s.begin_anew(damping):
            s.ended = AT_REST
            return None
        s.factors = _factors(s, low, high)
    if s.stuck:
        s.ended = "stuck at an edge beyond which no orbit exists"
        return None
    if s.iterations > hope and s.cost - promise > hopeless:
        s.ended = "given up far from any solution"
        return None
    if s.iterations > iterations:
        s.ended = f"not converged in {iterations} iterations"
        return None
    step, predicted = s.factors.step(s.damping)
    return np.clip(s.theta + step, low, high) - s.theta, predicted


def _bent(
    function: Residual,
    trials: Sequence[tuple[int, _State]],
    steps: Sequence[tuple[FloatArray, float]],
) -> FloatArray:
    """The steps, in long descents bent by the second order as valleys are (geodesic acceleration,
    Transtrum & Sethna 2012): its derivative along a step costs one more residual."""
    out = np.stack([step for step, _ in steps])
    far = [m for m, (_, s) in enumerate(trials) if s.iterations > VALLEY]
    if not far:
        return out
    nearer = np.stack([trials[m][1].theta + PROBE * out[m] for m in far])
    probe = function(nearer, np.array([trials[m][0] for m in far]), False)
    for row, m in enumerate(far):
        s = trials[m][1]
        assert s.factors is not None
        if probe.exists[row]:
            straight = s.factors.jacobian @ (out[m] * s.factors.scale)
            curvature = 2 / PROBE * ((probe.residual[row] - s.residual) / PROBE - straight)
            out[m] += s.factors.bend(s.damping, out[m], curvature)
    return out


def _factors(s: _State, low: FloatArray, high: FloatArray) -> _Factors:
    norm = np.sqrt(np.sum(s.jacobian * s.jacobian, axis=0))
    s.scale = np.maximum(s.scale, np.where(norm > 0, norm, 1e-100))
    scale = np.where(s.scale > 1e-100, s.scale, 1.0)
    J = s.jacobian / scale
    g = J.T @ s.residual
    held = ((s.theta <= low) & (g > 0)) | ((s.theta >= high) & (g < 0))
    J, g = np.where(held, 0.0, J), np.where(held, 0.0, g)
    U, sv, Vt = np.linalg.svd(J, full_matrices=False)
    return _Factors(scale, J, g, sv, Vt, U, U.T @ s.residual)


def covariance_of(jacobian: FloatArray) -> FloatArray:
    """(JᵀJ)⁻¹; undetermined directions get a very large variance."""
    norm, sv, Vt = _scaled(jacobian)
    return np.asarray(((Vt.T * (1.0 / sv**2)) @ Vt) / np.outer(norm, norm))


def resolved(structure: Structure, theta: FloatArray, jacobian: FloatArray) -> FloatArray:
    """The covariance of θ's unknowns, with what the tangents do not say (`Effect.resolution`)."""
    out, slopes = covariance_of(jacobian), structure.parameters.slopes(theta)
    for i, stderr in resolutions(structure, theta).items():
        out[i], out[:, i] = 0.0, 0.0
        out[i, i] = (stderr / slopes[i]) ** 2
    return out


def resolutions(structure: Structure, theta: FloatArray) -> dict[int, float]:
    """Standard deviations of the values that lie between two runs, wherever: by unknown."""
    values, index = structure.parameters.plain(theta), structure.parameters.index
    known = [e.resolution(values) for e in structure.effects]
    return {index[name]: stderr for each in known for name, stderr in each.items()}


def log_determinant_of(jacobian: FloatArray) -> float:
    """ln det JᵀJ: minus that of `covariance_of`, which need not be formed for it."""
    norm, sv, _ = _scaled(jacobian)
    return float(2 * (np.log(norm).sum() + np.log(sv).sum()))


def _scaled(jacobian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lengths of the columns, and singular values and directions of all of one length, none of the
    values below what can be told from zero."""
    norm = np.sqrt(np.sum(jacobian**2, axis=0))
    norm = np.where(norm > 1e-100, norm, 1e-100)
    _, sv, Vt = np.linalg.svd(jacobian / norm, full_matrices=False)
    return norm, np.maximum(sv, 1e-13 * max(float(sv[0]), 1e-300)), Vt


def fit_orbits(
    structure: Structure,
    data: Dataset,
    thetas: FloatArray,
    *,
    continuation: Sequence[float] = (0.03, 0.003, 0.0),
    iterations: int = 60,
    hopeless: float = np.inf,
) -> Fit:
    """Maximum-likelihood fit from one start (p,) or several (starts, p); the best one is returned.

    Each is led in by decreasing `continuation` shares, the last of which must be 0. It ends early
    where its tangents promise no less than `hopeless` times what noise leaves. Where it turns out
    that another mode sings than the first, that one is called the first, if all is the same so.
    """
    fit = _from_each(structure, data, thetas, continuation, iterations, hopeless)
    other = _another_sings(fit)
    if other is None:
        return fit
    enough = min(hopeless, (fit.chi2 + SAME) / data.residuals)
    again = _from_each(structure, data, other, (0.0,), iterations, enough)
    same = again.chi2 < fit.chi2 + SAME and again.converged >= fit.converged
    return again if same else fit


def _another_sings(fit: Fit) -> FloatArray | None:
    """Unknowns with the modes renumbered, where the flame's part in mode 1 is within its error of
    nothing, or fades on a way that has no end, and that in another is not. `Straightened` leads
    along the valley of mode 1: down that of another, a descent creeps for thousands of steps. None
    where mode 1 sings, or none does.
    """
    names = fit.structure.parameters.names
    if fit.structure.mode_count == 1 or not np.isfinite(fit.chi2):
        return None
    modes = range(1, fit.structure.mode_count + 1)
    at = [names.index(f"mode{i}.flame_residue") for i in modes]
    parts = np.abs(fit.theta[at])
    known = parts > np.sqrt(np.diag(fit.covariance)[at])
    fades = not known[0] or (not fit.converged and parts[0] < FADES * parts.max())
    if not fades or not known[1:].any():
        return None
    sings = int(np.argmax(np.where(known[1:], parts[1:], 0.0))) + 2
    theta = fit.theta.copy()
    for kind in MODAL:
        own, other = names.index(f"mode1.{kind}"), names.index(f"mode{sings}.{kind}")
        theta[own], theta[other] = fit.theta[other], fit.theta[own]
    return theta


def repeated(fit: Fit, data: Dataset, counted: Dataset) -> tuple[Dataset, Fit]:
    """`counted`, which is `data` with other covariances, and `fit` repeated on them; `data` and
    `fit` themselves where they are the same, or where nothing comes of it."""
    if counted is data:
        return data, fit
    again = fit_orbits(fit.structure, counted, fit.theta, continuation=(0.0,))
    return (counted, again) if np.isfinite(again.chi2) else (data, fit)


def _from_each(
    structure: Structure,
    data: Dataset,
    thetas: FloatArray,
    continuation: Sequence[float],
    iterations: int,
    hopeless: float,
) -> Fit:
    current = np.atleast_2d(thetas)
    batches = [b.balanced(structure) for b in data.fit]
    reason = "the harmonic balance has no solution at the start"
    best: Descent | None = None
    for share in continuation:
        last = share == 0
        residual = OrbitResidual(structure, soften(batches, share), None if last else LEAD_IN_STEPS)
        straight = Straightened(residual, structure)
        descents = levenberg_marquardt(
            straight,
            straight.inside(current),
            iterations=iterations if last else 20,
            tolerance=1e-6 if last else 1e-2,
            hopeless=hopeless * data.residuals,
            hope=SHORTLY,
            bounds=straight.bounds(structure),
        )
        if last:
            usable = [d for d in descents if d is not None]
            least = min((d.cost for d in usable), default=np.inf)
            # one that has not converged yet, but is far below, shows that the others are astray
            near = [d for d in usable if d.cost <= least + SAME]
            best = min(near, key=lambda d: (not d.converged, d.cost), default=None)
        else:
            pairs = zip(current, descents, strict=True)
            current = np.stack([c if d is None else straight.outside(d.theta) for c, d in pairs])
    if best is None:
        return failed(structure, data, current[0], reason)
    dof = best.residual.size - best.theta.size
    theta = straight.outside(best.theta)
    # the covariance is formed where the unknowns are well scaled, and carried over
    jacobian = straight.to_outside(best.jacobian[None], best.theta[None])[0]
    return Fit(
        structure,
        theta,
        best.cost,
        dof,
        resolved(structure, theta, jacobian),
        best.residual,
        jacobian,
        best.converged,
        best.reason,
        best.iterations,
    )


def failed(structure: Structure, data: Dataset, theta: FloatArray, reason: str) -> Fit:
    """The outcome of a fit that produced nothing to rely on."""
    n, p = data.residuals, theta.size
    nothing = np.full((p, p), np.inf)
    return Fit(
        structure, theta, np.inf, n - p, nothing, np.full(n, np.inf), np.zeros((n, p)), False,
        reason, 0,
    )  # fmt: skip
