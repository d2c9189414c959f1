"""Periodic steady states of the loop by harmonic balance, with exact parameter derivatives.

Unknowns are the Fourier coefficients of every nonlinearity's input, v_a,k (k = 1…K), collected in
real form x = [Re v, Im v]. The balance (Section 4.3 of the thesis)

    R_a,k = v_a,k − Σ_b P_ab(jkω) N̂_b,k(v_b) − Q_a(jkω) = 0

is solved by Newton's method, all runs of a campaign at once; N̂ is taken through 4K or more time
samples a period. A free run has a free phase, fixed by Im v_0,1 = 0, and an unknown ω in its
place. Started from the measured orbit, Newton stays on the measured branch where several exist.

Derivatives come from the implicit function theorem, ∂x/∂θ = −R_x⁻¹ R_θ, with R_θ by automatic
differentiation of the assembled equations: exact, and the solver itself is never differenced. Only
Newton's own steps take the slopes by a free run's ω from a difference.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.dual import Dual
from identify.effect import Conditions, at_the_flame
from identify.newton import add_held, newton, slopes
from identify.periods import period_matrices, period_waves, to_harmonics, to_time
from identify.pieces import Characteristic, Preceded, Values
from identify.polynomial import Polynomial
from identify.structure import Loop, Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

TOLERANCE = 1e-10  # relative Newton residual: far below any noise, above rounding
MAX_ITERATIONS = 12  # Newton steps; twice as many where ω is an unknown too
NEAR = 1e-7  # of ω: within that, the terms' first order in ω is exact to far below any noise
APART = 1e-8  # of ω: over that far slopes by ω are taken, to 1e-6 of themselves at the sharpest
FINE = 1024  # samples a period of a `Preceded` characteristic: turning points to 5e-6 of the swing


@dataclass(frozen=True)
class Orbits:
    """Steady states of a batch of runs.

    `inputs`: nonlinearity inputs (loops, runs, K); `velocity`: predicted measurement (runs, K);
    `omega`: rad/s (solved for in free runs); `converged`: (runs,). With derivatives asked for,
    `d_velocity` is (runs, K, p), `d_omega` (runs, p) where a run is free and `d_inputs` (loops,
    runs, K, p), with respect to the unknowns.
    """

    inputs: ComplexArray
    velocity: ComplexArray
    omega: FloatArray
    converged: BoolArray
    d_velocity: ComplexArray | None = None
    d_omega: FloatArray | None = None
    d_inputs: ComplexArray | None = None

    @property
    def seen(self) -> "Orbits":
        """The same without the inputs, of which no measurement tells."""
        return replace(self, inputs=self.inputs[:0], d_inputs=None)

    def take(self, part: npt.NDArray[np.int64]) -> "Orbits":
        """Some of the rows."""
        return Orbits(
            self.inputs[:, part],
            self.velocity[part],
            self.omega[part],
            self.converged[part],
            None if self.d_velocity is None else self.d_velocity[part],
            None if self.d_omega is None else self.d_omega[part],
            None if self.d_inputs is None else self.d_inputs[:, part],
        )


def solve(
    structure: Structure,
    theta: FloatArray,
    at: Conditions,
    *,
    start: ComplexArray | None = None,
    start_omega: FloatArray | None = None,
    derivatives: bool = False,
    iterations: int | None = None,
) -> Orbits:
    """Steady states of runs of any kind.

    Parameters
    ----------
    theta : internal parameters, (p,), or (vectors, p) for several at once: the orbits' rows are
        then vector by vector, the runs of `at` in each.
    at : conditions; a free run's `at.omega` is where the search for its ω starts.
    start : nonlinearity inputs to start from, (loops, rows, K); default: from the measured
        velocity. A row that does not converge from `start` is tried from the measurement too.
    start_omega : where the search for ω starts instead, (rows,).
    iterations : at most that many Newton steps (default `MAX_ITERATIONS`). Few of them give an
        approximate orbit, marked as not converged, for a search still far from any solution.
    """
    vectors = theta[None] if theta.ndim == 1 else theta
    rows = at.tile(vectors.shape[0])
    limit = np.where(rows.free, 2, 1) * MAX_ITERATIONS
    if iterations is not None:
        limit = np.full(rows.runs, iterations)
    columns = structure.parameters.columns(vectors, at.runs)
    begin = rows.omega if start_omega is None else start_omega
    first = _inputs_from_velocity(structure, columns, rows) if start is None else start
    orbits = _newton(structure, columns, rows, begin, first, limit)
    if start is not None and not orbits.converged.all():
        again = np.flatnonzero(~orbits.converged)
        some, fewer = columns[again], rows.take(again)
        measured = _inputs_from_velocity(structure, some, fewer)
        found = _newton(structure, some, fewer, fewer.omega, measured, limit[again])
        orbits = _merge(orbits, found, again)
    return differentiate(structure, vectors, at, orbits) if derivatives else orbits


def differentiate(
    structure: Structure, vectors: FloatArray, at: Conditions, orbits: Orbits
) -> Orbits:
    """The same orbits with derivatives by the unknowns; arguments as given to `solve`."""
    rows = at.tile(vectors.shape[0])
    values = structure.parameters.plain(vectors, at.runs)
    return _differentiate(structure, vectors, values, rows, at.runs, orbits)


def _inputs_from_velocity(
    structure: Structure, columns: FloatArray, at: Conditions
) -> ComplexArray:
    """Nonlinearity inputs implied by the measured velocity: the start on the measured branch."""
    values = structure.parameters.by_name(columns)
    s = at.s
    with np.errstate(all="ignore"):
        y = at_the_flame(structure.effects, values, at, s)
        y = np.where(np.isfinite(y), y, at.velocity)
        w = np.asarray(structure.flame_path(values, at, s) * y, dtype=complex)
    return np.stack([w] + [y] * (len(structure.characteristics(values, at)) - 1))


def _newton(
    structure: Structure,
    columns: FloatArray,
    at: Conditions,
    omega: FloatArray,
    start: ComplexArray,
    limit: IntArray,
) -> Orbits:
    """Orbits of all rows, from `start` and `omega`; `columns` (rows, p) are physical values."""
    K, free = at.harmonics, at.free_rows
    v, omega = start.copy(), omega.copy()
    if free.size:
        v[:, free] *= np.exp(-1j * np.angle(v[0, free, :1]) * np.arange(1, K + 1))
    error, predicted = np.full(at.runs, np.inf), np.empty((at.runs, K), dtype=complex)
    rows, left = np.arange(at.runs), limit
    with np.errstate(all="ignore"):
        while rows.size:
            near = _assembled(structure, columns, at, omega[rows], len(v))
            found = _solved(near, v[:, rows], omega[rows], at.free, left)
            away = found[1] - omega[rows]
            v[:, rows], omega[rows], error[rows], taken, forces = found
            predicted[rows] = near.velocity(forces, away)
            # the others were solved where the terms were assembled, or near enough
            again = np.flatnonzero(at.free & (taken > 0) & ~(np.abs(away) < NEAR * omega[rows]))
            rows, left, columns = rows[again], (left - taken)[again], columns[again]
            at = at.of_free if np.array_equal(again, at.free_rows) else at.take(again)
    converged = (error < 1e-8) & np.isfinite(predicted).all(axis=1)
    return Orbits(v, predicted, omega, converged)


@dataclass(frozen=True)
class _Assembled:
    """The equations of some rows at harmonics of given frequencies, and their slopes by ω.

    P (loops, loops, rows, K), Q (loops, rows, K); of free runs `loop` holds one row more each,
    behind the others: at a frequency higher by `apart`, (free runs,), from which the slopes come.
    """

    loop: Loop
    N: tuple[Characteristic, ...]
    P: ComplexArray
    Q: ComplexArray
    dP: ComplexArray
    dQ: ComplexArray
    free: IntArray
    apart: FloatArray

    def velocity(self, forces: ComplexArray, away: FloatArray) -> ComplexArray:
        """Predicted measurement (rows, K) where ω is so far away, to first order."""
        y = np.array(_velocity(self.loop, np.concatenate([forces, forces[:, self.free]], axis=1)))
        rows = forces.shape[1]
        slope = (y[rows:] - y[self.free]) / self.apart[:, None]
        y[self.free] += slope * away[self.free, None]
        return y[:rows]


def _assembled(
    structure: Structure, columns: FloatArray, at: Conditions, omega: FloatArray, loops: int
) -> _Assembled:
    K, rows, free = at.harmonics, at.runs, at.free_rows
    apart, p = APART * omega[free], structure.parameters.by_name(columns)
    N = structure.characteristics(p, at)
    if free.size:
        p = structure.parameters.by_name(np.concatenate([columns, columns[free]]))
        omega, at = np.concatenate([omega, omega[free] + apart]), at.with_free_again
    loop = structure.assemble(p, at, 1j * omega[:, None] * np.arange(1, K + 1))
    P = np.empty((loops, loops, at.runs, K), dtype=complex)
    Q = np.empty((loops, at.runs, K), dtype=complex)
    for a in range(loops):
        Q[a] = loop.Q[a]
        for b in range(loops):
            P[a, b] = loop.P[a][b]
    dP, dQ = np.zeros_like(P[:, :, :rows]), np.zeros_like(Q[:, :rows])
    dP[:, :, free] = (P[:, :, rows:] - P[:, :, free]) / apart[:, None]
    dQ[:, free] = (Q[:, rows:] - Q[:, free]) / apart[:, None]
    P, Q = np.ascontiguousarray(P[:, :, :rows]), np.ascontiguousarray(Q[:, :rows])
    return _Assembled(loop, N, P, Q, dP, dQ, free, apart)


def _solved(
    near: _Assembled,
    v: ComplexArray,
    omega: FloatArray,
    free: BoolArray,
    left: IntArray,
) -> tuple[ComplexArray, FloatArray, FloatArray, IntArray, ComplexArray]:
    """Inputs, frequencies, relative residuals, steps taken and N̂ with the terms as they are."""
    if not all(isinstance(n, Polynomial) for n in near.N):
        return _sampled_newton(near, v, omega, free, left)
    curves, waves = (
        _tables(near.N, omega.size),
        period_waves(v.shape[2], _samples(near.N, v.shape[2])),
    )
    terms = near.P, near.Q, near.dP, near.dQ
    v = np.ascontiguousarray(v)  # of one kind: another would be compiled for again
    found = newton(*terms, curves, v, omega, *waves, free, left, TOLERANCE)
    return v, omega, *found


def _tables(curves: Sequence[Characteristic], rows: int) -> FloatArray:
    """Coefficients (loops, rows, degree + 1) of all loops' curves, as `newton` takes them."""
    tables = [n.table(rows) for n in curves if isinstance(n, Polynomial)]
    out = np.zeros((len(tables), rows, max(t.shape[1] for t in tables)))
    for own, t in zip(out, tables, strict=True):
        own[:, : t.shape[1]] = t
    return out


def _sampled_newton(
    near: _Assembled,
    v: ComplexArray,
    omega: FloatArray,
    free: BoolArray,
    limit: IntArray,
) -> tuple[ComplexArray, FloatArray, FloatArray, IntArray, ComplexArray]:
    """What `identify.newton.newton` does, for characteristics of any kind: all rows together."""
    K, begin, taken = v.shape[2], omega, np.zeros_like(limit)
    while True:
        away = (omega - begin)[:, None]
        P, Q = near.P + away * near.dP, near.Q + away * near.dQ
        forces = np.stack([_force(n, x, K) for n, x in zip(near.N, v, strict=True)])
        R = v - Q - np.einsum("abrk,brk->ark", P, forces)
        size = np.sqrt(np.sum(np.abs(v) ** 2, axis=2)) + 1e-300
        error = np.max(np.sqrt(np.sum(np.abs(R) ** 2, axis=2)) / size, axis=0)
        error = np.where(np.isfinite(error), error, np.inf)
        going = (taken < limit) & (error >= TOLERANCE) & np.isfinite(error)
        if not going.any():
            return v, omega, error, taken, forces
        J = _jacobian(tuple(map(tuple, P)), _slopes(near.N, v), K)
        if free.any():  # the column of Im v_0,1, which stays 0, becomes ω's
            by_omega = -near.dQ - np.einsum("abrk,brk->ark", near.dP, forces)
            J[free, :, K] = _stack(by_omega)[free]
        step = np.where(going[:, None], _solve(J, _stack(R)), 0.0)
        away_by = np.where(free, np.clip(step[:, K], -0.05 * omega, 0.05 * omega), 0.0)
        omega = omega - away_by
        step[free, K] = 0.0
        # A full Newton step far outside the orbit's size is a step off the branch: damp it.
        length = np.max(np.abs(step), axis=1) / np.max(size, axis=0)
        step = step * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))[:, None]
        v = v - _unstack(step, v.shape)
        taken = taken + going


def residual(structure: Structure, values: Values, at: Conditions, v: ComplexArray) -> ComplexArray:
    """The balance R of forced runs at any inputs `v`, both (loops, runs, K)."""
    s = at.s
    loop = structure.assemble(values, at, s)
    return np.stack(
        _balance(loop, v, [_force(n, x, at.harmonics) for n, x in zip(loop.N, v, strict=True)])
    )


def _balance(loop: Loop, v: Any, forces: Sequence[Any]) -> list[Any]:
    out = []
    for a, row in enumerate(loop.P):
        total: Any = v[a] - loop.Q[a]
        for P, F in zip(row, forces, strict=True):
            total = total - P * F
        out.append(total)
    return out


def _velocity(loop: Loop, forces: Iterable[Any]) -> Any:
    total: Any = loop.G_u
    for G, F in zip(loop.G, forces, strict=True):
        total = total + G * F
    return loop.sensor(total)


def slope_along(n: Characteristic, x: FloatArray) -> FloatArray:
    """N′ at time samples, by automatic differentiation with respect to the input."""
    if isinstance(n, Polynomial):
        return n.curve(x)[1]
    out = n(Dual(x, np.ones((*x.shape, 1))))
    return np.asarray(dual.derivative(out, x.shape, 1)[..., 0], dtype=float)


def _force(n: Characteristic, v: ComplexArray, K: int) -> Any:
    """N̂, the Fourier coefficients of one nonlinearity's output."""
    curve, samples = (n.curve, FINE) if isinstance(n, Preceded) else (n, _samples([n], K))
    x, by = to_time(v, K, samples), []
    if isinstance(n, Preceded):
        passed = n.operator(x)
        x, by = passed.output, [(d, q) for d, q in passed.by if isinstance(q, Dual)]
    if not isinstance(curve, Polynomial):
        return to_harmonics(curve(dual.chain(x, *by)), K, samples)
    # parameters vary all samples alike: their derivatives go to harmonics before the seeds
    value, slope = curve.curve(x)
    terms = [*curve.terms(x), *((slope * d, q) for d, q in by)]
    parts = [(to_harmonics(partial, K, samples), q) for partial, q in terms]
    return dual.chain(to_harmonics(value, K, samples), *parts)


def _samples(N: Sequence[Characteristic], K: int) -> int | None:
    """Samples a period that are enough for all of these; None: as many as usual.

    A polynomial makes no harmonics above its degree times K, and its slope none above the degree
    less one times K: with (degree + 1) K + 1 samples, none of them is taken for one up to K, nor
    of the slope's for one up to 2K.
    """
    smooth = [n for n in N if isinstance(n, Polynomial) and n.bent is None]
    if len(smooth) < len(N):
        return None
    return (max(len(n.coefficients) for n in smooth) + 1) * K + 1


def _slopes(N: Sequence[Characteristic], v: ComplexArray) -> Sequence[ComplexArray]:
    """∂N̂/∂x of every nonlinearity, (runs, K, 2K) each."""
    K = v.shape[2]
    if all(isinstance(n, Polynomial) for n in N):
        waves = period_waves(K, _samples(N, K))
        return tuple(slopes(_tables(N, v.shape[1]), np.ascontiguousarray(v), *waves))
    return [_force_jacobian(n, x, K) for n, x in zip(N, v, strict=True)]


def _force_jacobian(n: Characteristic, v: ComplexArray, K: int) -> ComplexArray:
    """∂N̂/∂x of one nonlinearity, (runs, K, 2K)."""
    if not isinstance(n, Preceded):
        return _from_slope(slope_along(n, to_time(v, K)), K)
    x, own = to_time(v, K, FINE), np.arange(FINE)
    passed = n.operator(x)
    slope = slope_along(n.curve, passed.output)
    moving = sum(share * (at == own) for share, at in passed.follows)
    out = _from_slope(slope * moving, K, FINE)
    for share, at in passed.follows:
        if not np.all(at == own):
            add_held(slope * share, at, *period_matrices(K, FINE), out)
    return out


def _from_slope(slope: FloatArray, K: int, samples: int | None = None) -> ComplexArray:
    """∂N̂/∂x (runs, K, 2K) of a characteristic without memory from its slope (runs, T), by the
    slope's Fourier coefficients as in `identify.newton`."""
    k = np.arange(1, K + 1)
    S = _orders(slope, K, samples)
    gap, far = S[:, K - 1 + k[:, None] - k], S[:, K - 1 + k[:, None] + k]
    return np.concatenate([gap + far, 1j * (gap - far)], axis=2)


def _orders(slope: FloatArray, K: int, samples: int | None) -> ComplexArray:
    """⟨N′ e^{−jmτ}⟩ of the orders m = 1 − K … 2K, (runs, 3K)."""
    cosines, sines = period_waves(K, samples)
    re, im = slope @ cosines / len(cosines), slope @ sines / -len(sines)
    below = slice(K - 1, 0, -1)  # of a real slope: the conjugates
    return np.concatenate([re[:, below] - 1j * im[:, below], re + 1j * im], axis=1)


def _jacobian(P: Sequence[Sequence[Any]], by_input: Sequence[ComplexArray], K: int) -> FloatArray:
    """∂R/∂x in real form, (runs, 2KL, 2KL) for L loops, unknowns loop by loop.

    `P` as in `Loop`; `by_input` are the ∂N̂/∂x of each nonlinearity.
    """
    loops, runs = len(by_input), by_input[0].shape[0]
    J = np.zeros((runs, 2 * K * loops, 2 * K * loops))
    for b in range(loops):
        for a in range(loops):
            block = -np.broadcast_to(P[a][b], (runs, K))[:, :, None] * by_input[b]
            rows, cols = slice(2 * K * a, 2 * K * (a + 1)), slice(2 * K * b, 2 * K * (b + 1))
            J[:, rows, cols] = np.concatenate([block.real, block.imag], axis=1)
    J[:, np.arange(2 * K * loops), np.arange(2 * K * loops)] += 1.0
    return J


def _differentiate(
    structure: Structure,
    vectors: FloatArray,
    plain_values: Values,
    at: Conditions,
    runs_each: int,
    orbits: Orbits,
) -> Orbits:
    K, runs, p = at.harmonics, at.runs, vectors.shape[1]
    k = np.arange(1, K + 1)
    free, searched = at.free, bool(at.free.any())
    seeds = p + int(searched)
    values = structure.parameters.seeded(vectors, runs_each, extra=int(searched))
    s: Any = 1j * orbits.omega[:, None] * k
    if searched:
        ds = np.zeros((runs, K, seeds), dtype=complex)
        ds[free, :, p] = 1j * k
        s = Dual(s, ds)
    loop = structure.assemble(values, at, s)
    v, shaping = orbits.inputs, structure.shaping
    shaped = {**plain_values, **structure.parameters.seeded(vectors, runs_each, only=shaping)}
    forces = []
    for n, x in zip(structure.characteristics(shaped, at), v, strict=True):
        force = _force(n, x, K)
        d = np.zeros((runs, K, seeds), dtype=complex)
        d[..., shaping] = dual.derivative(force, (runs, K), shaping.size)
        forces.append(Dual(dual.value(force), d))
    # derivatives by inputs need characteristics that carry none by parameters
    by_input = _slopes(structure.characteristics(plain_values, at), v)
    R = _balance(loop, v, forces)
    explicit = np.stack([np.asarray(dual.derivative(r, (runs, K), seeds)) for r in R])
    right = np.concatenate([np.concatenate([x.real, x.imag], axis=1) for x in explicit], axis=1)
    J = _jacobian([[dual.value(P) for P in row] for row in loop.P], by_input, K)
    dx = np.zeros_like(right)
    if searched:
        J[free, :, K] = right[free, :, p]
    dx[:, :, :p] = -_solve(J, right[:, :, :p])
    d_omega = None
    if searched:
        d_omega = np.where(free[:, None], dx[:, K, :p], 0.0)
        dx[free, K] = 0.0
    total: Any = loop.G_u
    for b, (G, F) in enumerate(zip(loop.G, forces, strict=True)):
        inner = by_input[b] @ dx[:, 2 * K * b : 2 * K * (b + 1)]
        total = total + G * Dual(dual.value(F), dual.derivative(F, (runs, K), seeds) + inner)
    y = loop.sensor(total)
    dy = np.array(dual.derivative(y, (runs, K), seeds), dtype=complex)
    if d_omega is not None:  # chain rule through the free frequency
        dy = dy[:, :, :p] + dy[:, :, p:] * d_omega[:, None, :]
    d_inputs = np.stack(
        [
            dx[:, 2 * K * a : 2 * K * a + K, :p] + 1j * dx[:, 2 * K * a + K : 2 * K * (a + 1), :p]
            for a in range(v.shape[0])
        ]
    )
    return Orbits(v, dual.value(y), orbits.omega, orbits.converged, dy, d_omega, d_inputs)


def drive_sensitivity(
    structure: Structure, theta: FloatArray, at: Conditions, orbits: Orbits
) -> FloatArray:
    """∂[Re Y, Im Y]/∂[Re U, Im U] of forced runs, (runs, 2K, 2K): how an error of the recorded
    drive shows in the prediction. Exact where the drive enters linearly."""
    K = at.harmonics
    s = 1j * orbits.omega[:, None] * np.arange(1, K + 1)
    values = structure.parameters.plain(theta)
    # linear in the drive but for its distortion, whose slope is near one: with a drive of one, and
    # without the distortion, the equations give its transfer functions
    unit = structure.undistorted.assemble(values, replace(at, drive=np.ones_like(at.drive)), s)
    loop = structure.assemble(values, at, s)
    by_input = _slopes(loop.N, orbits.inputs)
    entering = np.concatenate([_diagonal(q, at.runs, K) for q in unit.Q], axis=1)
    dv = _solve(_jacobian(loop.P, by_input, K), entering)
    direct = _diagonal(unit.G_u, at.runs, K)
    total: ComplexArray = direct[:, :K] + 1j * direct[:, K:]
    for b, G in enumerate(loop.G):
        inner = by_input[b] @ dv[:, 2 * K * b : 2 * K * (b + 1)]
        total = total + np.broadcast_to(G, (at.runs, K))[:, :, None] * inner
    nudge = 1e-6 * np.abs(orbits.velocity[:, :1])
    seen = (loop.sensor(orbits.velocity + nudge) - loop.sensor(orbits.velocity)) / nudge
    total = np.asarray(seen)[:, :, None] * total
    return np.concatenate([total.real, total.imag], axis=1)


def _diagonal(c: Any, runs: int, K: int) -> FloatArray:
    """Multiplication by complex `c` (runs, K) in real form, (runs, 2K, 2K)."""
    c = np.broadcast_to(c, (runs, K))
    out = np.zeros((runs, 2 * K, 2 * K))
    k = np.arange(K)
    out[:, k, k] = out[:, K + k, K + k] = c.real
    out[:, k, K + k], out[:, K + k, k] = -c.imag, c.imag
    return out


def _stack(c: ComplexArray) -> FloatArray:
    """(loops, runs, K) complex to (runs, 2K·loops) real."""
    return np.concatenate([np.concatenate([x.real, x.imag], axis=1) for x in c], axis=1)


def _unstack(x: FloatArray, shape: Sequence[int]) -> ComplexArray:
    loops, _, K = shape
    parts = [x[:, 2 * K * a : 2 * K * (a + 1)] for a in range(loops)]
    return np.stack([q[:, :K] + 1j * q[:, K:] for q in parts])


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Batched solve; a singular member yields NaN in its own row instead of an exception."""
    vector = right.ndim == 2
    rhs = right[..., None] if vector else right
    try:
        out = np.linalg.solve(matrix, rhs)
    except np.linalg.LinAlgError:
        out = np.full(rhs.shape, np.nan)
        for i, (m, r) in enumerate(zip(matrix, rhs, strict=True)):
            try:
                out[i] = np.linalg.solve(m, r)
            except np.linalg.LinAlgError:
                continue
    return np.asarray(out[..., 0] if vector else out)


def _merge(orbits: Orbits, other: Orbits, rows: npt.NDArray[np.int64]) -> Orbits:
    inputs, velocity = orbits.inputs.copy(), orbits.velocity.copy()
    omega, converged = orbits.omega.copy(), orbits.converged.copy()
    inputs[:, rows], velocity[rows] = other.inputs, other.velocity
    omega[rows], converged[rows] = other.omega, other.converged
    return Orbits(inputs, velocity, omega, converged)
