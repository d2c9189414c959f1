"""Each run's own deviations as unknowns of a fit, beside the parameters that all runs share.

Run r deviates by x_r along the directions of an `identify.effects.scatter.Scatter`:

    minimise  Σ_r |ρ_r(θ, x_r)|² + Σ_r |x_r / σ|²    over θ and all x_r together.

What is not linear in the deviations is then in the solved orbits themselves, and runs that deviate
a lot lead θ nowhere. Where the declared model absorbs what all runs deviate by together (a gain),
the deviations keep a sum of zero, x = B z with orthonormal columns of B: the rest is θ's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from identify.dataset import Batch
from identify.descent import Descent, Evaluated, Residual, levenberg_marquardt
from identify.effect import Conditions, Deviation, Effect
from identify.effects.scatter import Direction
from identify.parameters import Parameter
from identify.pieces import Mode, Values
from identify.residual import OrbitResidual, Pulled, Straightened, soften
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Own(Effect):
    """What each of the runs of these identities has of each direction."""

    name, location = "own", "experiment"

    def __init__(
        self, directions: Sequence[Direction], identities: IntArray, absorbed: bool = True
    ) -> None:
        """`absorbed`: what is common to the runs is for the declared model, which is fitted too."""
        self.directions = tuple(directions)
        self.identities = identities
        self.bases = tuple(_basis(identities.size, absorbed and d.common) for d in directions)
        self.parameters = tuple(
            Parameter(f"own.{d.name}_{j}", d.unit, scale=d.scale)
            for d, basis in zip(self.directions, self.bases, strict=True)
            for j in range(basis.shape[1])
        )

    @property
    def of_direction(self) -> IntArray:
        """The direction that each parameter belongs to."""
        counts = [basis.shape[1] for basis in self.bases]
        return np.repeat(np.arange(len(counts)), counts)

    def pulls(self, unknowns: int, sizes: FloatArray) -> FloatArray:
        """Rows (own parameters, unknowns) whose products with θ and the own parameters behind it
        are z/σ."""
        scale = np.array([q.scale for q in self.parameters])
        rows = np.zeros((scale.size, unknowns))
        rows[:, unknowns - scale.size :] = np.diag(scale / sizes[self.of_direction])
        return rows

    def placed(self, batch: Batch, own: FloatArray) -> Batch:
        """The batch with its runs known to deviate as the unknowns `own` of this effect say."""
        row = {int(i): r for r, i in enumerate(self.identities)}
        z = own * np.array([q.scale for q in self.parameters])
        deviations = []
        for j, (d, basis) in enumerate(zip(self.directions, self.bases, strict=True)):
            x = basis @ z[self.of_direction == j]
            known = [x[row[int(i)]] if int(i) in row else 0.0 for i in batch.at.identity]
            deviations.append(Deviation(d, np.array(known)))
        return replace(batch, at=replace(batch.at, deviations=tuple(deviations)))

    def _sizes(self, p: Values, at: Conditions, j: int) -> Any:
        """x along direction j, one row a run."""
        names = [q.name for q, d in zip(self.parameters, self.of_direction, strict=True) if d == j]
        weights = (at.identity[:, None] == self.identities) @ self.bases[j]
        total: Any = 0.0
        for i, name in enumerate(names):
            total = p[name] * weights[:, i : i + 1] + total
        return total

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        for j, d in enumerate(self.directions):
            modes = d.modes({d.parameters[0].name: self._sizes(p, at, j)}, at, modes)
        return modes

    def generator(self, p: Values, at: Conditions) -> Any:
        out: Any = 1.0
        for j, d in enumerate(self.directions):
            out = d.generator({d.parameters[0].name: self._sizes(p, at, j)}, at) * out
        return out


def _basis(count: int, common: bool) -> FloatArray:
    """Orthonormal columns that span all of so many numbers, or, with what is `common` to them left
    out, those of a sum of zero."""
    if not common:
        return np.eye(count)
    ones = np.ones((count, 1)) / np.sqrt(count)
    return np.asarray(np.linalg.qr(np.c_[ones, np.eye(count)[:, 1:]])[0][:, 1:])


@dataclass(frozen=True)
class Led:
    """Where a descent ended: shared and own unknowns, and whether it had converged."""

    theta: FloatArray
    own: FloatArray
    cost: float
    converged: bool
    reason: str
    iterations: int


def lead(
    structure: Structure,
    own: Own,
    batches: Sequence[Batch],
    starts: FloatArray,
    sizes: FloatArray,
    *,
    share: float = 0.0,
    steps: int | None = None,
    iterations: int = 150,
    hopeless: float = np.inf,
) -> list[Led]:
    """Descents from `starts` (starts, p + own parameters) at noise raised by a `share` of each
    coefficient's size, with orbits solved or approached by so many Newton `steps`; best first.
    What stays beyond a misfit of `hopeless` is given up."""
    larger = structure.with_effects(own)
    balanced = [b.balanced(larger) for b in batches]
    residual = OrbitResidual(larger, soften(balanced, share), steps)
    pulled = Pulled(residual, own.pulls(starts.shape[1], sizes))
    straight = Straightened(pulled, larger)
    descents = levenberg_marquardt(
        straight,
        straight.inside(starts),
        iterations=iterations,
        tolerance=1e-6 if share == 0 else 1e-2,
        hopeless=hopeless,
        bounds=straight.bounds(larger),
    )
    count = starts.shape[1] - len(own.parameters)
    ends = [None if d is None else straight.outside(d.theta) for d in descents]
    return _best_first(descents, ends, count)


def settle(
    structure: Structure, own: Own, theta: FloatArray, batch: Batch, sizes: FloatArray
) -> Led | None:
    """The likeliest deviations of a batch's runs for given shared parameters; None without any."""
    if not own.parameters:
        return None
    larger = structure.with_effects(own)
    residual = OrbitResidual(larger, [batch.balanced(larger)])
    held = _Held(Pulled(residual, own.pulls(theta.size + len(own.parameters), sizes)), theta)
    descents = levenberg_marquardt(held, np.zeros((1, len(own.parameters))))
    found = [None if d is None else np.r_[theta, d.theta] for d in descents]
    return next(iter(_best_first(descents, found, theta.size)), None)


def _best_first(
    descents: Sequence[Descent | None], ends: Sequence[FloatArray | None], count: int
) -> list[Led]:
    out = [
        Led(end[:count], end[count:], d.cost, d.converged, d.reason, d.iterations)
        for d, end in zip(descents, ends, strict=True)
        if d is not None and end is not None and np.isfinite(d.cost)
    ]
    return sorted(out, key=lambda led: led.cost)


@dataclass(frozen=True)
class _Held:
    """A residual in its last unknowns alone, the first ones held at `theta`."""

    inner: Residual
    theta: FloatArray

    def __call__(self, thetas: FloatArray, which: IntArray, jacobian: bool) -> Evaluated:
        both = np.concatenate([np.tile(self.theta, (len(thetas), 1)), thetas], axis=1)
        found = self.inner(both, which, jacobian)
        if found.jacobian is not None:
            found.jacobian = found.jacobian[..., self.theta.size :]
        return found
