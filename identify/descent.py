"""Levenberg–Marquardt, several descents side by side.

A residual is evaluated for many parameter vectors in one call, at little more than the price of
one, so descents from several starts go on together, each with a damping of its own. What differs
from the textbook is what fits of oscillations need: a trial beyond which no orbit exists is a
refused step, long valleys are followed with steps bent by the second order, and descents that are
stuck or hopeless end early and say why.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

AT_REST = "no step lowers the misfit any further"
HOPE = 20  # iterations for what may be given up as hopeless …
VALLEY = 20  # iterations after which a descent is taken to follow one
STUCK = 8  # accepted steps of which nothing comes although the tangents promise nearly all …
FAR = 30.0  # … of so many times what noise leaves
PROBE = 0.3  # of a step, where its curvature is looked at
BENT = 0.4  # of the step that the bend may be


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
