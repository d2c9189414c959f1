"""95 % intervals of the parameters: Gaussian where the likelihood is so, else by its profile.

The Gaussian interval v ± 1.96 s stands on χ² being a parabola in v. Whether it is, is asked where
it matters: one 1.96 s step along the valley that the linearised fit predicts (the straightened
unknowns' column of the covariance, so that a curved but harmless valley raises no alarm). There

    t = (v − v̂)/s    and    √Δχ²

must agree to a tenth. Where they do not, the interval is where the profile, χ² minimised over all
other parameters, has risen by 3.84 (Wilks): found by a secant on √Δχ², nearly straight in v, all
parameters and both sides fitted side by side. An end is open, «not bounded by these data», where
χ² has not risen so much at the parameter's own limit or as many standard errors away as is looked.
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
ROUNDS = 10  # of the secant
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
        low, high = e.interval(Z95) if e.determined else (None, None)
        out[name] = Interval(low, high, "gaussian")
    doubtful = _doubtful(fit, data)
    for j, (low_end, high_end) in _profiled(fit, data, doubtful).items():
        out[fit.structure.parameters.names[j]] = Interval(low_end, high_end, "profile")
    return out


def _along_valleys(fit: Fit, data: Dataset) -> FloatArray:
    """θ after a step of ±1.96 s of each parameter along its valley, (2, p, p); others that are at
    their limit stay there."""
    straight = Straightened(OrbitResidual(fit.structure, data.fit), fit.structure)
    u = straight.inside(fit.theta)
    J = straight.to_inside(fit.jacobian[None], u[None])[0]
    # ∂θ/∂u, column by column of the map's own inverse: rows of the identity carried outside
    to_u = straight.to_inside(np.eye(fit.theta.size)[None], u[None])[0]
    low, high = fit.structure.parameters.bounds()
    held = (fit.theta <= low) | (fit.theta >= high)
    free = _by_theta(J, to_u, np.flatnonzero(~held))
    for j in np.flatnonzero(held):
        free[j] = _by_theta(J, to_u, np.flatnonzero(~held | (np.arange(held.size) == j)))[j]
    own = np.einsum("ji,ji->j", to_u, free)
    steps = Z95 * free / np.sqrt(np.maximum(own, 1e-300))[:, None]
    return np.stack([straight.outside(u + steps), straight.outside(u - steps)])


def _by_theta(J: FloatArray, to_u: FloatArray, moving: npt.NDArray[np.int64]) -> FloatArray:
    """Cov(θ_j, u), (p, p), with none but the `moving` u."""
    covariance = np.zeros((J.shape[1], J.shape[1]))
    covariance[np.ix_(moving, moving)] = covariance_of(J[:, moving])
    return np.asarray(to_u @ covariance)


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
    low, high = fit.structure.parameters.bounds()
    searches = []
    for j, side in sides:
        room = (high[j] - fit.theta[j] if side == 0 else fit.theta[j] - low[j]) / sigma[j]
        away = moved[side, j] - fit.theta
        valley = fit.theta, away / abs(away[j] / sigma[j] or 1e-300)
        searches.append(_End(min(FARTHEST, max(float(room), 0.0)), *valley))
    for _ in range(ROUNDS):
        left = [i for i, end in enumerate(searches) if not end.done]
        if not left:
            break
        starts = [(i, start) for i in left for start in searches[i].starts]
        column = np.array([sides[i][0] for i, _ in starts])
        towards = np.array([1.0 if sides[i][1] == 0 else -1.0 for i, _ in starts])
        place = np.array([searches[i].place for i, _ in starts])
        rows = np.arange(len(starts))
        pinned = np.stack([start for _, start in starts])
        pinned[rows, column] = fit.theta[column] + towards * place * sigma[column]
        pinned = np.clip(pinned, low, high)
        bottom, top = np.tile(low, (rows.size, 1)), np.tile(high, (rows.size, 1))
        bottom[rows, column] = top[rows, column] = pinned[rows, column]
        descents = levenberg_marquardt(
            OrbitResidual(fit.structure, data.fit),
            pinned,
            iterations=40,
            tolerance=1e-3,
            bounds=(bottom, top),
        )
        for i in left:
            mine = [d for (n, _), d in zip(starts, descents, strict=True) if n == i]
            lowest = min((d for d in mine if d is not None), key=lambda d: d.cost, default=None)
            if lowest is None:
                searches[i].at(np.inf)
            else:
                rise = float(np.sqrt(max(lowest.cost - fit.chi2, 0.0)))
                searches[i].at(rise, lowest.theta)
    ends: dict[int, list[float | None]] = {j: [None, None] for j in which}
    parameters = fit.structure.parameters
    centre = parameters.to_physical(fit.theta)
    for (j, side), end in zip(sides, searches, strict=True):
        if end.found is not None:
            there = fit.theta.copy()
            there[j] += (end.found if side == 0 else -end.found) * sigma[j]
            even = parameters.parameters[j].kind == "even"
            passed = even and fit.theta[j] * there[j] < 0  # its size is least at zero
            value = 0.0 if passed else float(parameters.to_physical(there)[j])
            ends[j][int(value > centre[j])] = value
    return {j: (a, b) for j, (a, b) in ends.items()}


class _End:
    """The search for one end, by how many s it lies from the optimum: a secant on √Δχ², kept
    between what is known to lie inside and outside."""

    def __init__(self, room: float, centre: FloatArray, valley: FloatArray) -> None:
        self.room = room  # that far there is anything to look for
        self.place = min(Z95, room)
        self._centre, self._valley = centre, valley  # the optimum, and the way from there by s
        self._followed: FloatArray | None = None
        self._inside, self._rise = 0.0, 0.0
        self._outside, self._above = np.inf, np.inf
        self._exact: float | None = None

    @property
    def starts(self) -> list[FloatArray]:
        """Where to begin for the other parameters: along the valley, and beside the last place
        that lies inside."""
        along = self._centre + self.place * self._valley
        return [along] if self._followed is None else [along, self._followed]

    def at(self, rise: float, theta: FloatArray | None = None) -> None:
        """√Δχ² of the profile at `place`, and where; infinite where no orbit exists."""
        if abs(rise - Z95) < NEAR:
            self._exact = self.place
        elif rise < Z95:
            self._inside, self._rise, self._followed = self.place, rise, theta
        else:
            self._outside, self._above = self.place, rise
        self.place = self._next()

    def _next(self) -> float:
        """Where to look next: where the secant says, but no nearer than a tenth to either end of
        what is left to look in, so that it shrinks."""
        near, far = self._inside, min(self._outside, self.room)
        if np.isfinite(self._above):
            share = (Z95 - self._rise) / (self._above - self._rise)
            guess, margin = near + share * (far - near), 0.1
        elif np.isfinite(self._outside):  # beyond it no orbit exists
            guess, margin = 0.5 * (near + far), 0.1
        else:
            slope = self._rise / near if near > 0 else 0.0
            guess, margin = (Z95 / slope if slope > 0 else far), 0.0
        least = near + margin * (far - near)
        return float(np.clip(guess, least, far - margin * (far - near)))

    @property
    def done(self) -> bool:
        """Whether it is found, or known to be open."""
        return self._exact is not None or self._inside >= self.room

    @property
    def found(self) -> float | None:
        """The end; where it has not been met to `NEAR`, what is known to lie outside: an interval
        that may be a little too wide. None where there is none."""
        if self._exact is not None:
            return self._exact
        return self._outside if np.isfinite(self._outside) else None
