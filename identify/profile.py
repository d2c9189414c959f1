"""95 % intervals of the parameters: Gaussian where the likelihood is so, else by its profile.

The Gaussian interval v ± 1.96 s stands on χ² being a parabola in v. Whether it is, is asked where
it matters: one 1.96 s step along the valley that the linearised fit predicts (the straightened
unknowns' column of the covariance, so that a curved but harmless valley raises no alarm). There

    t = (v − v̂)/s    and    √Δχ²

must agree to a tenth. Where they do not, the interval is where the profile, χ² minimised over all
other parameters, has risen by 3.84 (Wilks): found by a secant on ±√Δχ², nearly straight in v, all
parameters and both sides fitted side by side. An end that no drive of the parameter reaches is
open: «not bounded by these data».
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from identify.dataset import Dataset
from identify.descent import levenberg_marquardt
from identify.fit import Fit, covariance_of, resolutions
from identify.residual import OrbitResidual, Straightened

FloatArray = npt.NDArray[np.float64]

Z95 = 1.959964
AGREE = 0.1  # relative difference of t and √Δχ² up to which an interval counts as Gaussian
ROUNDS = 6  # of the secant
NEAR = 0.02  # of √Δχ², where it ends: a fortieth of a standard error
FARTHEST = 8.0  # standard errors within which an end is looked for


@dataclass(frozen=True)
class Interval:
    """95 % interval of a physical value; None: not bounded on that side by these data."""

    lower: float | None
    upper: float | None
    method: Literal["gaussian", "profile"]


def intervals(fit: Fit, data: Dataset) -> dict[str, Interval]:
    """One interval for each parameter of a converged fit; none for another."""
    if not fit.converged:
        return {}
    estimates = fit.estimates
    out = {}
    for name, e in estimates.items():
        low, high = e.interval(Z95)
        known = np.isfinite(e.stderr)
        out[name] = Interval(low if known else None, high if known else None, "gaussian")
    doubtful = _doubtful(fit, data)
    for j, (low_end, high_end) in _profiled(fit, data, doubtful).items():
        out[fit.structure.parameters.names[j]] = Interval(low_end, high_end, "profile")
    return out


def _along_valleys(fit: Fit, data: Dataset) -> FloatArray:
    """θ after a step of ±1.96 s of each parameter along its valley, (2, p, p)."""
    straight = Straightened(OrbitResidual(fit.structure, data.fit), fit.structure)
    u = straight.inside(fit.theta)
    J = straight.to_inside(fit.jacobian[None], u[None])[0]
    covariance = covariance_of(J)
    # ∂θ/∂u, column by column of the map's own inverse: rows of the identity carried outside
    to_u = straight.to_inside(np.eye(fit.theta.size)[None], u[None])[0]
    by_theta = to_u @ covariance  # Cov(θ_j, u)
    spread = np.sqrt(np.maximum(np.diag(to_u @ covariance @ to_u.T), 1e-300))
    steps = Z95 * by_theta / spread[:, None]
    return np.stack([straight.outside(u + steps), straight.outside(u - steps)])


def _rise(fit: Fit, data: Dataset, thetas: FloatArray) -> FloatArray:
    """√Δχ² at several θ, infinite where no orbit exists."""
    found = OrbitResidual(fit.structure, data.fit)(thetas, np.arange(thetas.shape[0]), False)
    cost = np.where(found.exists, np.sum(found.residual**2, axis=1), np.inf)
    return np.asarray(np.sqrt(np.maximum(cost - fit.chi2, 0.0)))


def _doubtful(fit: Fit, data: Dataset) -> list[int]:
    """Parameters whose Gaussian interval is not what the likelihood says."""
    moved = _along_valleys(fit, data)
    p = fit.theta.size
    parameters = fit.structure.parameters
    centre = parameters.to_physical(fit.theta)
    stderr = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0)) * np.abs(
        parameters.slopes(fit.theta)
    )
    rise = _rise(fit, data, moved.reshape(2 * p, p)).reshape(2, p)
    out = []
    known = resolutions(fit.structure, fit.theta)
    for j in (j for j in range(p) if j not in known):
        ends = np.array([parameters.to_physical(m[j])[j] for m in moved])
        t = np.abs(ends - centre[j]) / max(float(stderr[j]), 1e-300)
        ratio = rise[:, j] / np.maximum(t, 1e-300)
        if not np.all(np.abs(ratio - 1) <= AGREE):
            out.append(j)
    return out


def _profiled(
    fit: Fit, data: Dataset, which: list[int]
) -> dict[int, tuple[float | None, float | None]]:
    """Both ends of each profile interval."""
    if not which:
        return {}
    moved = _along_valleys(fit, data)
    sides = [(j, side) for j in which for side in (0, 1)]
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 1e-300))
    place = np.array([Z95 if side == 0 else -Z95 for _, side in sides])  # in s, of θ_j
    starts = np.stack([moved[side, j] for j, side in sides])
    column = np.array([j for j, _ in sides])
    rows = np.arange(len(sides))
    # secant from the optimum, where √Δχ² is 0
    before_place, before_rise = np.zeros(len(sides)), np.zeros(len(sides))
    done = np.zeros(len(sides), dtype=bool)
    found = np.full(len(sides), np.nan)
    low, high = fit.structure.parameters.bounds()
    for _ in range(ROUNDS):
        pinned = starts.copy()
        pinned[rows, column] = fit.theta[column] + place * sigma[column]
        pinned = np.clip(pinned, low, high)
        bottom, top = np.tile(low, (rows.size, 1)), np.tile(high, (rows.size, 1))
        bottom[rows, column] = top[rows, column] = pinned[rows, column]
        descents = levenberg_marquardt(
            OrbitResidual(fit.structure, data.fit),
            pinned,
            iterations=25,
            tolerance=1e-3,
            bounds=(bottom, top),
        )
        for i, descent in enumerate(descents):
            if done[i]:
                continue
            if descent is None:  # no orbit there: half way back
                place[i] = 0.5 * (place[i] + before_place[i])
                continue
            rise = float(np.sqrt(max(descent.cost - fit.chi2, 0.0)))
            starts[i] = descent.theta
            if abs(rise - Z95) < NEAR:
                done[i], found[i] = True, place[i]
                continue
            slope = (rise - before_rise[i]) / (place[i] - before_place[i] or 1e-300)
            before_place[i], before_rise[i] = place[i], rise
            towards = np.sign(place[i])
            step = (Z95 - rise) / slope if slope * towards > 1e-3 else towards * FARTHEST
            place[i] = float(np.clip(place[i] + step, -FARTHEST, FARTHEST))
            if place[i] * towards <= 0:
                place[i] = 0.5 * before_place[i]
        if done.all():
            break
    ends: dict[int, list[float | None]] = {j: [None, None] for j in which}
    parameters = fit.structure.parameters
    centre = parameters.to_physical(fit.theta)
    for i, (j, _) in enumerate(sides):
        if np.isfinite(found[i]):
            there = fit.theta.copy()
            there[j] += found[i] * sigma[j]
            even = parameters.parameters[j].kind == "even"
            passed = even and fit.theta[j] * there[j] < 0  # its size is least at zero
            value = 0.0 if passed else float(parameters.to_physical(there)[j])
            ends[j][int(value > centre[j])] = value
    return {j: (a, b) for j, (a, b) in ends.items()}
