"""Starting values from data alone: the balance in polynomial form, tied back to modes.

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
an answer. Low-discrepancy guesses of the poles stand by where it leads nowhere.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt

from identify import assess, periods
from identify.dataset import Batch, Dataset
from identify.descent import levenberg_marquardt
from identify.fit import Fit, failed, fit_orbits, no_better
from identify.residual import OrbitResidual, Pulled, Straightened, soften
from identify.structure import Effect, Mode, Structure, Values, at_the_flame, driven
from identify.thesis.rows import regressors

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

SHARES = (1e-3, 1e-2, 0.0)  # share of a coefficient's size that its weight counts as noise
SCAN = 24  # assumed flame poles
DENSE = 96  # starts that are polished where sparser ones led nowhere
DISTANT = 40  # of those from the slow flow, of either sign, where the declared fit went astray
NEARLY = 100.0  # χ²/dof beyond which the model is to blame, not a mode at the wrong place
WIDTHS = {"frequency": 0.1, "damping": 1.0, "pole": 1.0, "delay": 2.0}  # of `_weak_pulls`
LONG = 600  # iterations that lead on what comes nearest and has not converged
DAMPED = (3e-4, 0.5)  # damping ratios between which a mode is one
REFUSED = 1e-3  # chance of held-out runs below which another minimum is sought that suits them too
SAME_DEPTH = 1e-3  # share of χ² by which two minima differ
SCREENED = 4  # harmonics solved for to choose among thousands: noise of a tenth hides the others
FEW = 4.0  # degrees of freedom an unknown: with fewer, a misplaced mode may look worse than that


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
    return _named(structure, values, coefficients)


def _named(structure: Structure, values: dict[str, float], coefficients: list[float]) -> FloatArray:
    """Internal vector from modal values and polynomial coefficients c2, c3, …."""
    for d in range(2, structure.degree + 1):
        known = d - 2 < len(coefficients)
        values[f"nonlinearity.c{d}"] = coefficients[d - 2] if known else 0.0
    cubic = coefficients[1] if len(coefficients) > 1 else -1.0
    values["nonlinearity.level"] = float(1.0 / np.sqrt(3 * max(-cubic, 1e-12)))
    for j, node in enumerate(structure.nodes, start=1):
        excess = [cd * node**d for d, cd in enumerate(coefficients, start=2)]
        values[f"nonlinearity.value{j}"] = node + sum(excess)
    values.setdefault("flame.delay_s", 1e-4)
    names = structure.parameters.names
    return structure.parameters.to_internal([values[name] for name in names])


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
            if any(_near(structure, theta, other) for other in seen):
                continue
            seen.append(theta)
            taken += 1
            yield theta
            if taken >= keep:
                break


def _near(structure: Structure, a: FloatArray, b: FloatArray) -> bool:
    """Whether two starts have the same poles to within 3 % (frequencies) and 30 % (the rest), and
    their effects' signed parameters to within 30 %."""
    plain = len(structure.base_parameters)
    for i, (p, u, v) in enumerate(zip(structure.parameters.parameters, a, b, strict=True)):
        if p.kind == "positive":
            limit = 0.03 if p.name.endswith("frequency_hz") else 0.3
        else:
            limit = np.inf if i < plain else 0.3 * max(abs(u), abs(v))
        if abs(u - v) > limit:
            return False
    return True


def corrected(data: Dataset, effects: Sequence[Effect], p: Values) -> Dataset | None:
    """The data as they would be without `effects` of assumed values `p`, as far as these stand
    between the recorded drive and the sound, or between the velocity and its measurement.

    None where the values are so extreme that nothing finite is left.
    """

    def clean(b: Batch) -> Batch:
        s = b.at.s
        drive, y = driven(effects, p, b.at, b.at.drive), at_the_flame(effects, p, b.at, s)
        for e in effects:
            drive = e.actuator(p, b.at, s) * drive
        at = replace(b.at, drive=np.broadcast_to(drive, y.shape), velocity=y)
        return replace(b, at=at, measured=y[:, : b.compared])

    with np.errstate(all="ignore"):
        batches = tuple(clean(b) for b in data.fit)
    finite = all(np.isfinite(b.at.drive).all() and np.isfinite(b.measured).all() for b in batches)
    return replace(data, fit=batches) if finite else None


@dataclass(frozen=True)
class SlowFlow:
    """What the fundamentals alone tell: U₁/Y₁ = z₀ + z₁ (ω − ω₀) + z₂ |Y₁|² (complex z).

    For a single mode, a U₁/Y₁ ≈ 2ζω₁ + 2j(ω − ω₁) − r jω H(jω) (1 + ¾ c₃ |w|²): the slope gives
    the speaker residue, the argument of z₂ the flame's phase and so its pole, z₀ the growth.
    """

    a: float
    z0: complex
    z2: complex
    pole: float  # rad/s
    omega: float
    flame_phase: complex
    misfit: float


def slow_flow(data: Dataset, effects: Sequence[Effect] = (), p: Values | None = None) -> SlowFlow:
    """Least squares over the forced runs' fundamentals, the free run included as U = 0.

    `effects` with assumed values `p` correct drive, velocity, flame phase and modal frequency
    first, through their own hooks. The misfit is relative to the drive.
    """
    p = p or {}
    rows, right, w0 = [], [], 2 * np.pi * data.free_hz
    phase = 1.0 + 0j
    for b in data.fit:
        s = b.at.s
        drive, y = driven(effects, p, b.at, b.at.drive), at_the_flame(effects, p, b.at, s)
        modes = [Mode(1.0, 1.0, 1.0, 1.0)]
        for e in effects:
            drive = e.actuator(p, b.at, s) * drive
            modes = e.modes(p, b.at, modes)
        shift = np.broadcast_to(np.asarray(modes[0].frequency_hz, dtype=float), (b.runs, 1))[:, 0]
        Y, U = y[:, 0], np.broadcast_to(drive, y.shape)[:, 0]
        columns = [Y, Y * (b.at.omega - w0 * shift), Y * np.abs(Y) ** 2]
        weight = 1.0 / (np.abs(Y) + 1e-300) * b.at.flame_on
        rows.append(np.stack(columns, axis=1) * weight[:, None])
        right.append(U * weight)
    one = data.fit[0].at.take(np.array([0]))
    for e in effects:
        phase = phase * complex(np.ravel(e.flame(p, one, np.array([[1j * w0]])))[0])
    A, target = np.concatenate(rows), np.concatenate(right)
    scale = np.sqrt(np.sum(np.abs(A) ** 2, axis=0)) + 1e-300
    z = np.linalg.lstsq(A / scale, target, rcond=1e-9)[0] / scale
    rest = target - A @ z
    misfit = float(np.sum(np.abs(rest) ** 2) / (np.sum(np.abs(target) ** 2) + 1e-300))
    slope = 2j / z[1] if z[1] != 0 else 1.0 + 0j
    a = float(np.sign(slope.real) * np.abs(slope)) or 1.0
    # −r jω H φ |H|² · ¾ c₃: with r > 0 and c₃ < 0 its argument is that of jωφ/(jω + ω_f)
    angle = float(np.angle(a * z[2] / phase))
    pole = w0 * np.tan(np.clip(angle, 0.1, 1.45))
    return SlowFlow(a, complex(z[0]), complex(z[2]), float(pole), w0, phase, misfit)


@dataclass(frozen=True)
class CoarseStart:
    """A start with its misfit at coarse noise."""

    cost: float
    theta: FloatArray


def physical_starts(
    structure: Structure,
    data: Dataset,
    effect_values: Sequence[Sequence[float]] = ((),),
    placements: Sequence[tuple[float, ...]] | None = None,
) -> list[CoarseStart]:
    """Starts from the slow flow for assumed dampings and positions of the other modes, best first.

    Mode 1 sings. Each row of `effect_values` is assumed for the parameters of the structure's
    effects, in order. The misfit is that of approximate orbits at ten per cent noise.
    """
    thetas: list[FloatArray] = []
    for row in effect_values:
        thetas += _slow_flow_thetas(structure, data, row, placements)
    return coarse(structure, data, thetas)


def signed_starts(
    structure: Structure,
    data: Dataset,
    effect_values: Sequence[Sequence[float]] = ((),),
    placements: Sequence[tuple[float, ...]] | None = None,
) -> list[CoarseStart]:
    """The same with a fifth of mode 1's flame residue, of either sign, in each of the other modes:
    for each row, placement and signs the best, best first.

    A residue does not come through zero on its way down a misfit that it is not alone to blame for.
    """
    thetas = []
    for row in effect_values:
        thetas += _signed(structure, _slow_flow_thetas(structure, data, row, placements))
    return _best_of_each(structure, coarse(structure, data.coarse(SCREENED), thetas))


def _of_others(structure: Structure, kind: str) -> list[int]:
    """Which unknowns are of this kind in the modes that do not sing."""
    index = structure.parameters.index
    return [index[f"mode{i}.{kind}"] for i in range(2, structure.mode_count + 1)]


def _signed(structure: Structure, thetas: Sequence[FloatArray]) -> list[FloatArray]:
    """Each with four times the flame residues of the modes that do not sing, of either sign."""
    residues = _of_others(structure, "flame_residue")
    out = []
    for theta in thetas:
        for signs in product((1.0, -1.0), repeat=len(residues)):
            signed = theta.copy()
            signed[residues] *= 4 * np.array(signs)
            out.append(signed)
    return out


def _best_of_each(structure: Structure, starts: Sequence[CoarseStart]) -> list[CoarseStart]:
    """Of sorted starts the first for each row of effect values, placement and signs."""
    if not starts:
        return []
    index, residues = structure.parameters.index, _of_others(structure, "flame_residue")
    own = [index[q.name] for e in structure.effects for q in e.parameters]
    where = [*_of_others(structure, "frequency_hz"), *own]
    thetas = np.stack([found.theta for found in starts])
    kinds = np.c_[np.round(thetas[:, where], 6), np.sign(thetas[:, residues])]
    best: dict[bytes, CoarseStart] = {}
    for kind, found in zip(kinds, starts, strict=True):
        best.setdefault(kind.tobytes(), found)
    return list(best.values())


def _slow_flow_thetas(
    structure: Structure,
    data: Dataset,
    effect_values: Sequence[float],
    placements: Sequence[tuple[float, ...]] | None,
) -> list[FloatArray]:
    names = [q.name for e in structure.effects for q in e.parameters]
    p = dict(zip(names, effect_values, strict=True))
    flow = slow_flow(data, structure.effects, {**p, "flame.pole_hz": data.free_hz})
    w0, others = flow.omega, _of_others(structure, "frequency_hz")
    unknowns = [structure.parameters.parameters[i] for i in others]
    placed = [
        [q.to_internal(x * w0 / (2 * np.pi)) for q, x in zip(unknowns, ratios, strict=True)]
        for ratios in placements or _placements(len(others))
    ]
    thetas = []
    for pole in (flow.pole, 0.6 * w0) if structure.flame_order else (0.0,):
        gain = 1j * w0 / (1j * w0 + pole) * flow.flame_phase
        for zeta in (0.004, 0.012, 0.035):
            # Re: 2ζω₁ − r Re(jωH) = Re(a z₀);  Im: 2(ω₀ − ω₁) − r Im(jωH) = Im(a z₀)
            r = (2 * zeta * w0 - (flow.a * flow.z0).real) / (gain.real or 1e-9)
            w1 = w0 - 0.5 * ((flow.a * flow.z0).imag + r * gain.imag)
            h2 = 1.0 / abs(1j * w0 + pole) ** 2
            c3 = -float(np.abs(flow.a * flow.z2) / (0.75 * abs(r * gain) * h2 + 1e-300))
            values: dict[str, float] = {
                **p,
                "mode1.frequency_hz": float(np.clip(w1, 0.9 * w0, 1.1 * w0)) / (2 * np.pi),
                "mode1.damping": zeta,
                "mode1.flame_residue": float(r),
                "mode1.speaker_residue": flow.a,
            }
            for i in range(2, structure.mode_count + 1):
                values[f"mode{i}.frequency_hz"] = w0 / (2 * np.pi)
                values[f"mode{i}.damping"] = 0.03
                values[f"mode{i}.flame_residue"] = 0.05 * float(r)
                values[f"mode{i}.speaker_residue"] = 0.05 * flow.a
            for j in range(1, structure.flame_order + 1):
                key = "flame.pole_hz" if j == 1 else f"flame.pole{j}_hz"
                values[key] = pole * (1.0 if j == 1 else 5.0 * j) / (2 * np.pi)
            theta = _named(structure, values, [0.0, c3])
            for frequencies in placed:
                moved = theta.copy()
                moved[others] = frequencies
                thetas.append(moved)
    return thetas


def coarse(
    structure: Structure, data: Dataset, starts: Iterable[FloatArray], share: float = 0.1
) -> list[CoarseStart]:
    """Starts with their misfit at ten per cent noise (or another `share`), best first."""
    thetas = list(starts)
    if not thetas:
        return []
    residual = OrbitResidual(structure, soften(data.fit, share), newton_steps=2)
    outcome = residual(np.stack(thetas), np.arange(len(thetas)), False)
    costs = np.where(outcome.exists, np.sum(outcome.residual**2, axis=1), np.inf)
    found = [CoarseStart(float(c), t) for c, t in zip(costs, thetas, strict=True)]
    return sorted((c for c in found if np.isfinite(c.cost)), key=lambda c: c.cost)


def polish(
    structure: Structure,
    data: Dataset,
    starts: Sequence[CoarseStart],
    shares: Sequence[float] = (0.1, 0.02),
    iterations: int = 12,
) -> list[CoarseStart]:
    """Starts led through coarse fits, side by side, with weak priors around them; best first."""
    if not starts:
        return []
    centre, pulls = np.stack([s.theta for s in starts]), _weak_pulls(structure)
    thetas, costs = centre, np.full(len(starts), np.inf)
    for share in shares:
        residual = OrbitResidual(structure, soften(data.fit, share), newton_steps=2)
        straight = Straightened(Pulled(residual, pulls, centre @ pulls.T), structure)
        descents = levenberg_marquardt(
            straight,
            straight.inside(thetas),
            iterations=iterations,
            tolerance=3e-2,
            patience=6,  # a start that hardly moves any more is where it goes
            bounds=straight.bounds(structure),
        )
        pairs = zip(thetas, descents, strict=True)
        thetas = np.stack([t if d is None else straight.outside(d.theta) for t, d in pairs])
        costs = np.array([np.inf if d is None else d.cost for d in descents])
    found = [CoarseStart(float(c), t) for c, t in zip(costs, thetas, strict=True)]
    return sorted((c for c in found if np.isfinite(c.cost)), key=lambda c: c.cost)


def distinct(structure: Structure, starts: Sequence[CoarseStart]) -> list[CoarseStart]:
    """Of sorted starts those that are not near one before them."""
    out: list[CoarseStart] = []
    for start in starts:
        if not any(_near(structure, start.theta, other.theta) for other in out):
            out.append(start)
    return out


def _placements(count: int) -> list[tuple[float, ...]]:
    """Assumed frequencies of the other modes over the singing one's: from a closed-open tube's
    odd ratios, an open or closed tube's whole ones, and in between."""
    single = (1.35, 1.67, 2.0, 2.4, 3.0)
    pairs = [(1.67, 2.33), (2.0, 3.0), (1.4, 2.4), (1.67, 3.0), (2.4, 3.2)]
    return _laddered(count, single, pairs)


def dense_placements(count: int) -> list[tuple[float, ...]]:
    """The same a tenth apart, every pair of two, further ones regularly above."""
    grid = [1.35 * 1.11**j for j in range(10)]
    pairs = [(low, high) for i, low in enumerate(grid) for high in grid[i + 2 :]]
    return _laddered(count, grid, pairs)


def _laddered(
    count: int, single: Sequence[float], pairs: Sequence[tuple[float, float]]
) -> list[tuple[float, ...]]:
    """Places of so many modes: one of `single`, or of `pairs`, and further ones regularly above."""
    if count == 0:
        return [()]
    if count == 1:
        return [(q,) for q in single]
    return [(low, high, *(high + 0.8 * j for j in range(1, count - 1))) for low, high in pairs]


def _weak_pulls(structure: Structure) -> FloatArray:
    """Rows (pulls, p) of weak pulls on the logarithms of poles and dampings.

    At coarse noise the misfit is flat along trades between a pole and a gain; the pull keeps
    frequencies within some 10 % of the guess, dampings and poles within a factor of three, one
    standard deviation each. The final fit has no prior.
    """
    weights = np.zeros(len(structure.parameters))
    for i, p in enumerate(structure.parameters.parameters):
        for word, width in WIDTHS.items():
            if p.kind == "positive" and word in p.name.split(".")[-1]:
                weights[i] = 1.0 / width
    return np.asarray(np.diag(weights)[weights > 0])


def balanced_starts(structure: Structure, data: Dataset) -> list[CoarseStart]:
    """Those of the polynomial balance, best first."""
    return coarse(structure, data, candidates(structure, data))


def distant_starts(
    structure: Structure, data: Dataset, effect_values: Sequence[float]
) -> list[CoarseStart]:
    """The polynomial balance's best starts, and those of the slow flow with the other modes placed
    densely and of either sign: for data that lead the declared fit astray."""
    exact = [] if structure.effects else balanced_starts(structure, data)[:6]
    dense = dense_placements(structure.mode_count - 1)
    return [*exact, *signed_starts(structure, data, [effect_values], dense)[:DISTANT]]


def every_start(structure: Structure, data: Dataset) -> list[CoarseStart]:
    """The polynomial balance's best starts and the slow flow's, best first."""
    exact = balanced_starts(structure, data)[:6]
    return sorted([*exact, *physical_starts(structure, data)], key=lambda c: c.cost)


def fit_from_balance(structure: Structure, data: Dataset) -> tuple[Fit | None, list[CoarseStart]]:
    """The fit from the best start of the polynomial balance, exact where the model is, if there is
    any; and all of these starts, best first."""
    starts = balanced_starts(structure, data)
    return (fit_orbits(structure, data, starts[0].theta) if starts else None), starts


def fit_from_data(structure: Structure, data: Dataset) -> Fit:
    """The maximum-likelihood fit from data alone, over several starts; the best one wins.

    A start of the polynomial balance that reaches the noise (χ² within five standard deviations
    of its expectation) settles it. Otherwise all kinds of start are led in side by side: those of
    the polynomial balance, exact where the model is, and of the slow flow, robust where it is not.
    Where that ends near the noise but not at it, or the runs are few, or a mode has strayed, the
    other modes are placed more densely.
    """
    exact, starts = fit_from_balance(structure, data)
    if exact is not None and _adequate(exact):
        return exact
    rough = data.coarse()
    starts = sorted([*starts[:6], *physical_starts(structure, rough)], key=lambda c: c.cost)
    polished = polish(structure, rough, starts[:12])
    if not polished:
        p = len(structure.parameters)
        return failed(structure, data, np.zeros(p), "no start exists for these data")
    thetas = np.stack([s.theta for s in polished[:4]])
    fit = fit_orbits(structure, data, thetas, continuation=(0.003, 0.0), iterations=120)
    hopeless = fit.chi2_per_dof > NEARLY and fit.dof >= FEW * fit.theta.size and not _strayed(fit)
    if structure.mode_count < 2 or _adequate(fit) or hopeless:
        return fit
    found = [fit, *_replaced(structure, data, rough, fit)]
    best = min(found, key=lambda f: f.chi2)
    if not best.converged:  # in a long valley, with few runs
        found.append(fit_orbits(structure, data, best.theta, continuation=(0.0,), iterations=LONG))
    return min(found, key=lambda f: (not f.converged, f.chi2))


def fit_declared(structure: Structure, data: Dataset) -> Fit:
    """`fit_from_data`, unless the held-out runs refuse what it found and have a solution in common
    with the fitted ones: a few runs may have several, of which they are fitted by the wrong one.

    The fit is of the fitted runs alone, from there.
    """
    fit = fit_from_data(structure, data)
    if not (data.validation and _adequate(fit)) or not _refused(fit, data):
        return fit
    everything = replace(data, fit=(*data.fit, *data.validation), validation=())
    whole = fit_from_data(structure, everything)
    if not _adequate(whole):
        return fit
    other = fit_orbits(structure, data, whole.theta, continuation=(0.0,))
    return other if other.chi2 < _noise(other.dof) and not _refused(other, data) else fit


def _strayed(fit: Fit) -> bool:
    """Whether a mode has gone where none is: hardly damped at all, or hardly ringing."""
    modes = range(1, fit.structure.mode_count + 1)
    dampings = [fit.values[f"mode{i}.damping"] for i in modes]
    return not all(DAMPED[0] < zeta < DAMPED[1] for zeta in dampings)


def _refused(fit: Fit, data: Dataset) -> bool:
    """Whether the held-out runs are beyond noise and the parameters' own uncertainty."""
    held_out = [assess.predict(fit.structure, fit.theta, b) for b in data.validation]
    return assess.validation_p(held_out, fit.covariance) < REFUSED


def _moved(
    structure: Structure, near: Fit, free_hz: float, placement: Sequence[float]
) -> list[FloatArray]:
    """A fit's values with small modes elsewhere, the flame's share of either sign."""
    out = []
    for sign in (1.0, -1.0):
        values = near.values
        for i, ratio in enumerate(placement, start=2):
            values[f"mode{i}.frequency_hz"] = ratio * free_hz
            values[f"mode{i}.damping"] = 0.03
            values[f"mode{i}.flame_residue"] = sign * 0.2 * values["mode1.flame_residue"]
            values[f"mode{i}.speaker_residue"] = 0.05 * values["mode1.speaker_residue"]
        names = structure.parameters.names
        out.append(structure.parameters.to_internal([values[n] for n in names]))
    return out


def _adequate(fit: Fit) -> bool:
    return fit.converged and fit.chi2 < _noise(fit.dof)


def _noise(dof: int) -> float:
    """χ² that noise hardly exceeds: five standard deviations above its mean."""
    return dof + 5 * float(np.sqrt(2 * dof))


def _replaced(structure: Structure, data: Dataset, rough: Dataset, near: Fit) -> list[Fit]:
    """The fit from starts with the other modes placed more densely; none where none exists."""
    chosen = _denser(structure, rough, near, data.free_hz)
    if not chosen:
        return []
    worse, steps = no_better(near, data), (0.003, 0.0)
    thetas = np.stack(chosen)
    return [fit_orbits(structure, data, thetas, continuation=steps, iterations=120, hopeless=worse)]


def _denser(structure: Structure, rough: Dataset, near: Fit, free_hz: float) -> list[FloatArray]:
    """Starts with the other modes placed more densely than at first, best first.

    Modes that do not sing are seen at a few harmonics only: between those, a fit with one of them
    at the wrong place is a local minimum in its own right, from which no descent comes back. What
    such a fit says of the singing mode, flame and nonlinearity is good all the same.
    """
    dense = dense_placements(structure.mode_count - 1)
    thetas = _signed(structure, _slow_flow_thetas(structure, rough, (), dense))
    for placement in dense:
        thetas += _moved(structure, near, free_hz, placement)
    starts = _best_of_each(structure, coarse(structure, rough, thetas))
    polished = polish(structure, rough, starts[:DENSE])
    return [s.theta for s in distinct(structure, polished)[:8]]


def other_minima(structure: Structure, data: Dataset, near: Fit, times: float) -> list[Fit]:
    """Fits of the declared model that converge elsewhere and leave no more than so many times what
    `near` leaves, best first: where the model lacks something, the least misfit may be of a mode
    that has gone to the wrong place to make up for it."""
    if structure.mode_count < 2:
        return []
    out = [near]
    starts = _denser(structure, data.coarse(), near, data.free_hz)
    fits = [fit_orbits(structure, data, t, continuation=(0.003, 0.0)) for t in starts]
    for fit in sorted(fits, key=lambda f: f.chi2):
        # of the same depth are those in which two modes have changed names
        new = not any(abs(fit.chi2 - o.chi2) < SAME_DEPTH * o.chi2 for o in out)
        if fit.converged and new and fit.chi2 < times * near.chi2:
            out.append(fit)
    return out[1:]
