"""The model's own lock-in boundary: the least drive that holds the entrained state, with its error.

From the measured drive downwards the entrained orbit is followed; where it loses its stability
(a fold: a Floquet exponent passes 0; or a torus: a pair jΩ crosses, the free oscillation comes
back) the drive is found exactly as the solution z = (v, ln α, Ω) of

    R(v; αU, θ) = 0,   Δ(jΩ; v, θ) = 0            (balance and Hill's determinant)

with U the run's measured drive and Ω = 0, Im Δ dropped at a fold. Its uncertainty is the
parameters', carried by the implicit function: d ln α/dθ = −(G_z⁻¹ G_θ)_α. G is a closed formula;
its derivatives are central differences, the solver itself is never differenced.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from identify import balance
from identify.balance import Orbits
from identify.dataset import Batch
from identify.effect import Conditions
from identify.fit import Fit
from identify.stability import Disturbed, leading_exponent, unstable_exponents
from identify.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

STEP = 0.85  # factor on the drive from one orbit to the next
LOWEST, HIGHEST = 0.02, 6.0  # of the measured drive: how far the boundary is looked for
STEP_SIZE = 1e-6  # of the differences, relative: errs by 1e-12 and by rounding 1e-10


@dataclass(frozen=True)
class LockIn:
    """The boundary at one run's frequency. `log_stderr` is that of ln(boundary); `margin` how
    many standard errors the run's own drive lies above it."""

    run: str
    frequency_hz: float
    measured_v: float
    boundary_v: float
    log_stderr: float
    kind: Literal["fold", "torus"]

    @property
    def stderr_v(self) -> float:
        return self.boundary_v * self.log_stderr

    @property
    def interval_v(self) -> tuple[float, float]:
        """95 % interval."""
        factor = float(np.exp(1.959964 * self.log_stderr))
        return self.boundary_v / factor, self.boundary_v * factor


def boundary(fit: Fit, batch: Batch) -> list[LockIn]:
    """The boundary at the frequency of each forced run of a batch with the flame on.

    A run is left out where the model has no entrained state, keeps it down to 2 % of the drive,
    or where no solution of the equations above is found.
    """
    if batch.free:
        return []
    lit = np.flatnonzero(~batch.cold)
    found = [_one(fit, batch.take(lit[i : i + 1])) for i in range(lit.size)]
    return [f for f in found if f is not None]


def _scaled(at: Conditions, factor: float) -> Conditions:
    return replace(at, drive=at.drive * factor)


def _one(fit: Fit, run: Batch) -> LockIn | None:
    bracket = _bracket(fit.structure, fit.theta, run.at)
    if bracket is None:
        return None
    low, (high, orbits) = bracket
    values = fit.structure.parameters.plain(fit.theta)
    lead = leading_exponent(
        Disturbed.around(fit.structure, values, run.at, orbits.omega, orbits.inputs)
    )
    if lead is None:
        return None
    omega = float(run.at.omega[0])
    torus = lead.imag > 1e-6 * omega
    solved = _polished(fit, run.at, orbits, high, lead.imag if torus else 0.0)
    if solved is None:
        return None
    log_alpha, slope = solved
    if not low * 0.5 < np.exp(log_alpha) < high * 1.5:
        return None
    drive = float(np.abs(run.at.drive[0, 0]))
    variance = float(slope @ np.nan_to_num(fit.covariance, posinf=0.0) @ slope)
    return LockIn(
        run.names[0],
        omega / (2 * np.pi),
        drive,
        drive * float(np.exp(log_alpha)),
        float(np.sqrt(max(variance, 0.0))),
        "torus" if torus else "fold",
    )


def _bracket(
    structure: Structure, theta: FloatArray, at: Conditions
) -> tuple[float, tuple[float, Orbits]] | None:
    """Factors on the drive between which the entrained state is lost, the upper with its orbit."""

    def held(factor: float, start: ComplexArray | None) -> Orbits | None:
        with np.errstate(all="ignore"):
            orbits = balance.solve(structure, theta, _scaled(at, factor), start=start)
        if not orbits.converged[0]:
            return None
        values = structure.parameters.plain(theta)
        disturbed = Disturbed.around(structure, values, at, orbits.omega, orbits.inputs)
        return orbits if unstable_exponents(disturbed) == 0 else None

    high = 1.0
    orbits = held(high, None)
    while orbits is None:
        high /= STEP**2
        if high > HIGHEST:
            return None
        orbits = held(high, None)
    low = high
    while True:
        low *= STEP
        if low < LOWEST:
            return None
        below = held(low, orbits.inputs)
        if below is None:
            break
        high, orbits = low, below
    for _ in range(3):
        middle = float(np.sqrt(low * high))
        between = held(middle, orbits.inputs)
        if between is None:
            low = middle
        else:
            high, orbits = middle, between
    return low, (high, orbits)


def _polished(
    fit: Fit, at: Conditions, orbits: Orbits, factor: float, beat: float
) -> tuple[float, FloatArray] | None:
    """ln α at the boundary and its derivative by θ (p,), by Newton's method; None if it fails."""
    shape = orbits.inputs.shape
    size = float(np.max(np.abs(orbits.inputs)))
    torus = beat > 0
    omega = float(at.omega[0])
    x = np.concatenate([orbits.inputs.real.ravel(), orbits.inputs.imag.ravel()]) / size
    z = np.r_[x, np.log(factor), beat / omega] if torus else np.r_[x, np.log(factor)]
    sigma = np.sqrt(np.nan_to_num(np.diag(fit.covariance), posinf=0.0))
    theta_step = STEP_SIZE * (np.abs(fit.theta) + sigma)

    def G(rows: FloatArray, thetas: FloatArray) -> FloatArray:
        n = rows.shape[0]
        parts = rows[:, : x.size] * size
        half = x.size // 2
        v = (parts[:, :half] + 1j * parts[:, half:]).reshape(n, shape[0], shape[2])
        v = np.moveaxis(v, 1, 0)
        here = at.tile(n)
        here = replace(here, drive=here.drive * np.exp(rows[:, x.size])[:, None])
        values = fit.structure.parameters.plain(thetas, 1)
        R = balance.residual(fit.structure, values, here, v) / size
        disturbed = Disturbed.around(fit.structure, values, here, here.omega, v)
        lam = 1j * omega * rows[:, -1] if torus else np.zeros(n, dtype=complex)
        det = disturbed.determinant(lam)
        flat = np.moveaxis(R, 0, 1).reshape(n, -1)
        hill = np.stack([det.real, det.imag], axis=1) if torus else det.real[:, None]
        return np.concatenate([flat.real, flat.imag, hill], axis=1)

    def slopes(z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """G, ∂G/∂z, ∂G/∂θ at z."""
        q, p = z.size, fit.theta.size
        dz, dt = STEP_SIZE * np.eye(q), np.diag(theta_step)
        rows = np.concatenate([z[None], z + dz, z - dz, np.tile(z, (2 * p, 1))])
        thetas = np.concatenate(
            [np.tile(fit.theta, (2 * q + 1, 1)), fit.theta + dt, fit.theta - dt]
        )
        g = G(rows, thetas)
        by_z = (g[1 : 1 + q] - g[1 + q : 1 + 2 * q]).T / (2 * STEP_SIZE)
        by_theta = (g[1 + 2 * q : 1 + 2 * q + p] - g[1 + 2 * q + p :]).T / (2 * theta_step)
        return g[0], by_z, by_theta

    with np.errstate(all="ignore"):
        for _ in range(15):
            g, by_z, by_theta = slopes(z)
            try:
                step = np.linalg.solve(by_z, g)
            except np.linalg.LinAlgError:
                return None
            length = float(np.max(np.abs(step)))
            if not np.isfinite(length):
                return None
            z = z - step * min(1.0, 0.1 / max(length, 1e-300))
            if length < 1e-9:
                g, by_z, by_theta = slopes(z)
                slope = -np.linalg.solve(by_z, by_theta)[x.size]
                return float(z[x.size]), np.asarray(slope)
    return None
