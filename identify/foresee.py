"""What fitted models say of runs that nobody has made yet: harmonics, their noise, their slopes.

A possible run becomes a row of a `Batch` like a recorded one, so that the same equations solve it:
the recorded run nearest to it gives the start of the solution, the noise of the campaign its
covariance. White noise of the pressures at density S is, in the velocity of two microphones at
harmonic k of a record of T seconds,

    E|n_k|² = S / (T (kω)²),

S from the median over the recorded runs. Effects at the sensors are formed from the measured
pressure (`identify.effects.sensor`): its ratio to the velocity, interpolated in frequency over the
campaign, stands in for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify import balance
from identify.dataset import Batch, free_covariance, whitener
from identify.descent import Evaluated, levenberg_marquardt
from identify.fit import Fit
from identify.identification import Prepared
from identify.reach import Option
from identify.residual import OrbitResidual, Straightened, compare
from identify.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

SAME_BRANCH = 0.5  # models that differ by more at the fundamental are not on the same branch
LATER_S = 60.0  # from the campaign's last run to the next one
SETTLED = 0.05  # of χ²: what a refit may still gain, far less than decides between rivals


@dataclass(frozen=True)
class Seen:
    """One model at the possible runs, (n, …) in the order of the options.

    `rho` (n, m) is the whitened difference of a placeholder, the same for all models, and the
    prediction, so that ρ_b − ρ_a = W (y_a − y_b); `jacobian` (n, m, p) is its own by the model's
    unknowns; `velocity` (n, K) and `omega` (n,) are the orbits', where `solved`.
    """

    rho: FloatArray
    jacobian: FloatArray
    velocity: ComplexArray
    omega: FloatArray
    solved: BoolArray


@dataclass(frozen=True)
class Possible:
    """Runs that could be made, as batches that any model can be asked about."""

    options: tuple[Option, ...]
    batches: tuple[Batch, ...]  # the options in their order

    def seen_by(self, structure: Structure, theta: FloatArray) -> Seen:
        """What a model says of every run."""
        parts = [_predict(structure, theta, batch) for batch in self.batches]
        names = ("rho", "jacobian", "velocity", "omega", "solved")
        return Seen(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))

    def measured_as(self, seen: Seen, rows: Sequence[int]) -> tuple[Batch, ...]:
        """Some of the runs as if they had been made, and had turned out as a model says."""
        out, first = [], 0
        for batch in self.batches:
            own = np.array([r - first for r in rows if first <= r < first + batch.runs], dtype=int)
            if own.size:
                some = batch.take(own)
                omega = seen.omega[first + own] if batch.free else some.at.omega
                at = replace(some.at, omega=omega)
                out.append(replace(some, measured=seen.velocity[first + own], at=at))
            first += batch.runs
        return tuple(out)

    def only(self, keep: BoolArray) -> "Possible":
        """Those of the runs that `keep` (n,) marks."""
        batches, first = [], 0
        for batch in self.batches:
            own = np.flatnonzero(keep[first : first + batch.runs])
            first += batch.runs
            if own.size:
                batches.append(batch.take(own))
        kept = tuple(o for o, k in zip(self.options, keep, strict=True) if k)
        return Possible(kept, tuple(batches))


def possible(
    options: Sequence[Option], ready: Prepared, fits: Sequence[Fit], misfit: float = 1.0
) -> Possible:
    """The options that every one of `fits` solves, on the same branch.

    Standard deviations of the noise are taken `misfit` times as large as measured.
    """
    groups = _alike(options)
    batches = tuple(_batch(group, ready, fits[0], misfit) for group in groups)
    every = Possible(tuple(o for group in groups for o in group), batches)
    seen = [every.seen_by(f.structure, f.theta) for f in fits]
    keep = np.logical_and.reduce([s.solved for s in seen])
    first = np.abs(seen[0].velocity[:, 0])
    free = np.array([o.kind == "free" for o in every.options])
    for s in seen[1:]:
        apart = s.velocity[:, 0] - seen[0].velocity[:, 0]
        apart[free] = np.abs(s.velocity[free, 0]) - first[free]  # a free run has no phase
        keep &= np.abs(apart) < SAME_BRANCH * first
    return every.only(keep)


@dataclass(frozen=True)
class Past:
    """What a fit knows of its unknowns, as a quadratic in straightened ones: |R (u − u₀)|².

    RᵀR = JᵀJ + diag(1/size²): no unknown is wider than its own size. In `Straightened` unknowns the
    quadratic holds far along the valley in which a fit to one campaign is uncertain.
    """

    structure: Structure
    straight: Straightened
    centre: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, fit: Fit) -> "Past":
        straight = Straightened(OrbitResidual(fit.structure, ()), fit.structure)
        centre = straight.inside(fit.theta)
        J = straight.to_inside(fit.jacobian[None], centre[None])[0]
        logs = np.array([q.kind == "positive" for q in fit.structure.parameters.parameters])
        logs[straight.zeta] = False  # the damping itself
        small = np.ones(centre.size)
        small[straight.zeta] = 1e-4
        size = np.where(logs, 1.0, np.maximum(np.abs(centre), small))
        stacked = np.concatenate([J * size, np.eye(size.size)])
        return cls(fit.structure, straight, centre, np.linalg.qr(stacked, mode="r") / size)

    @property
    def spread(self) -> FloatArray:
        """Σ = (RᵀR)⁻¹, (p, p)."""
        inner = np.linalg.inv(self.root)
        return np.asarray(inner @ inner.T)

    def slopes(self, seen: Seen, u: FloatArray) -> FloatArray:
        """A model's Jacobian (n, m, p) at `u`, by the straightened unknowns."""
        n, m, p = seen.jacobian.shape
        flat = self.straight.to_inside(seen.jacobian.reshape(1, n * m, p), u[None])
        return np.asarray(flat.reshape(n, m, p))

    def theta(self, u: FloatArray) -> FloatArray:
        """The unknowns themselves."""
        return self.straight.outside(u)

    def refit(self, runs: Sequence[Batch], start: FloatArray) -> tuple[float, FloatArray] | None:
        """Least of |R (u − u₀)|² and the new runs' χ² together, and where; None: no orbit there."""
        ahead = _Ahead(self, Straightened(OrbitResidual(self.structure, runs), self.structure))
        bounds = self.straight.bounds(self.structure)
        (descent,) = levenberg_marquardt(
            ahead, start[None], iterations=25, tolerance=SETTLED, bounds=bounds
        )
        return None if descent is None else (descent.cost, descent.theta)


@dataclass(frozen=True)
class _Ahead:
    """u → residuals of old runs, by their quadratic, and new ones, solved anew for every u."""

    past: Past
    new: Straightened

    def __call__(self, thetas: FloatArray, which: IntArray, jacobian: bool) -> Evaluated:
        new = self.new(thetas, which, jacobian)
        root = self.past.root
        old = (thetas - self.past.centre) @ root.T
        residual = np.concatenate([old, new.residual], axis=1)
        if new.jacobian is None:
            return Evaluated(residual, None, new.exists)
        roots = np.broadcast_to(root, (thetas.shape[0], *root.shape))
        return Evaluated(residual, np.concatenate([roots, new.jacobian], axis=1), new.exists)


def _alike(options: Sequence[Option]) -> list[list[Option]]:
    """Options that one batch can hold: free ones apart, exchanged ones apart."""
    groups: dict[tuple[bool, bool], list[Option]] = {}
    for o in options:
        groups.setdefault((o.kind == "free", o.exchanged), []).append(o)
    return list(groups.values())


def _predict(structure: Structure, theta: FloatArray, batch: Batch) -> Seen:
    with np.errstate(all="ignore"):
        orbits = balance.solve(structure, theta, batch.at)
        orbits = _again(structure, theta, batch, orbits)
        orbits = balance.differentiate(structure, theta[None], batch.at, orbits)
        residual, jacobian = compare(batch, orbits)
    assert jacobian is not None
    n = batch.runs
    rho, jacobian = residual.reshape(n, -1), jacobian.reshape(n, -1, jacobian.shape[-1])
    finite = np.isfinite(rho).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    velocity = orbits.velocity[:, : batch.compared]
    return Seen(rho, jacobian, velocity, orbits.omega, orbits.converged & finite)


def _again(
    structure: Structure, theta: FloatArray, batch: Batch, orbits: balance.Orbits
) -> balance.Orbits:
    """Rows without a solution once more, each from the solved row nearest to it."""
    failed, solved = np.flatnonzero(~orbits.converged), np.flatnonzero(orbits.converged)
    if not failed.size or not solved.size or batch.free:
        return orbits
    drive, omega = np.abs(batch.at.drive[:, 0]), batch.at.omega
    apart = np.abs(np.log(drive[failed, None] / drive[solved])) + 10 * np.abs(
        np.log(omega[failed, None] / omega[solved])
    )
    apart = apart + 100 * (batch.cold[failed, None] != batch.cold[solved])
    start = orbits.inputs.copy()
    start[:, failed] = orbits.inputs[:, solved[np.argmin(apart, axis=1)]]
    return balance.solve(structure, theta, batch.at, start=start, iterations=30)


def _batch(options: Sequence[Option], ready: Prepared, reference: Fit, misfit: float) -> Batch:
    """The options as rows of a batch, what is «measured» being `reference`'s prediction."""
    recorded = ready.data.fit[0]
    free = options[0].kind == "free"
    n, K, total = len(options), recorded.compared, recorded.at.harmonics
    k = np.arange(1, total + 1)
    frequency = np.array([o.frequency_hz or ready.data.free_hz for o in options])
    omega = 2 * np.pi * frequency
    drive = np.zeros((n, total), dtype=complex)
    drive[:, 0] = [o.amplitude_v or 0.0 for o in options]
    span = max((h.started_s for h in ready.measured), default=0.0)
    rows = _nearest(options, ready, frequency)
    sign = -1.0 if options[0].exchanged else 1.0
    at = replace(
        recorded.at.take(rows),
        omega=omega,
        drive=drive,
        time=np.full(n, 1.0 + LATER_S / span if span > 0 else 1.0),
        flame_on=np.array([0.0 if o.kind == "cold" else 1.0 for o in options]),
        identity=len(ready.measured) + np.arange(n),
        free=np.full(n, free),
        spacing_m=sign * recorded.at.spacing_m[rows],
    )
    velocity = _free_cycle(ready, at.velocity) if free else at.velocity
    ratio = _pressure_over_velocity(ready, omega[:, None] * k / (2 * np.pi))
    for _ in range(2):  # once for the velocity, once for the sensors' effects that come of it
        at = replace(at, velocity=velocity, pressure=ratio * velocity)
        with np.errstate(all="ignore"):
            found = balance.solve(reference.structure, reference.theta, at)
        velocity = np.where(found.converged[:, None], found.velocity, velocity)
    measured = velocity[:, :K]
    seconds = np.array([o.record_s for o in options])
    variance = (
        misfit**2 * _pressure_noise(ready, K) / (seconds[:, None] * (omega[:, None] * k[:K]) ** 2)
    )
    covariance = np.stack([np.diag(np.r_[v, v] / 2) for v in variance])
    stderr = np.zeros(n)
    if free:
        # a line's frequency from its phase over the record: σ_ω = √12 σ_φ / T
        phase = np.sqrt(variance[:, 0] / 2) / np.abs(measured[:, 0])
        stderr = np.sqrt(12.0) * phase / seconds / (2 * np.pi)
        covariance = np.stack(
            [free_covariance(c, y, s) for c, y, s in zip(covariance, measured, stderr, strict=True)]
        )
    return Batch(
        names=tuple(o.words() for o in options),
        at=at,
        measured=measured,
        covariance=covariance,
        whitener=np.stack([whitener(c) for c in covariance]),
        noise=variance,
        frequency_stderr_hz=stderr,
        cold=np.array([o.kind == "cold" for o in options]),
        started_s=np.full(n, span + LATER_S),
    )


def _free_cycle(ready: Prepared, otherwise: ComplexArray) -> ComplexArray:
    """The recorded free run's velocity, (1, harmonics), where there is one."""
    for batch in ready.data.fit:
        if batch.free:
            shared = min(otherwise.shape[1], batch.at.harmonics)
            out = np.zeros_like(otherwise)
            out[:, :shared] = batch.at.velocity[:1, :shared]
            return out
    return otherwise


def _nearest(
    options: Sequence[Option], ready: Prepared, frequency: FloatArray
) -> npt.NDArray[np.int64]:
    """The row of the first fitted batch (forced and cold runs) nearest to each option."""
    recorded = ready.data.fit[0]
    drive = np.maximum(np.abs(recorded.at.drive[:, 0]), 1e-12)
    rows = []
    for o, f in zip(options, frequency, strict=True):
        apart = 10 * np.abs(np.log(recorded.at.omega / (2 * np.pi * f)))
        if o.amplitude_v is not None:
            apart = apart + np.abs(np.log(drive / o.amplitude_v))
        if (o.kind == "cold") in recorded.cold:
            apart = np.where(recorded.cold == (o.kind == "cold"), apart, np.inf)
        rows.append(int(np.argmin(apart)))
    return np.array(rows, dtype=np.int64)


def _pressure_noise(ready: Prepared, count: int) -> FloatArray:
    """S of the module's equation at each harmonic, (count,): the median over the runs."""
    levels = []
    for h in ready.measured:
        k = np.arange(1, min(count, h.count) + 1)
        level = np.full(count, np.nan)
        level[: k.size] = (
            h.variance[: k.size] * h.duration_s * (2 * np.pi * h.frequency_hz * k) ** 2
        )
        levels.append(level)
    return np.asarray(np.nanmedian(np.stack(levels), axis=0))


def _pressure_over_velocity(ready: Prepared, frequency: FloatArray) -> ComplexArray:
    """P/V at `frequency` (any shape), interpolated over what the campaign measured."""
    places, ratios = [], []
    for h in ready.measured:
        sure = np.abs(h.velocity) > 5 * np.sqrt(h.variance)
        k = np.arange(1, h.count + 1)
        places.append(h.frequency_hz * k[sure])
        ratios.append(h.pressure[sure] / h.velocity[sure])
    f, z = np.concatenate(places), np.concatenate(ratios)
    order = np.argsort(f)
    real = np.interp(frequency, f[order], z[order].real)
    return np.asarray(real + 1j * np.interp(frequency, f[order], z[order].imag))
