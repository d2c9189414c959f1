"""Following a forced orbit through folds: pseudo-arclength continuation of the harmonic balance.

A point is (W/|W₀|, p) with p the frequency or the drive in units of its start. Predictor: the
tangent (the null vector of [R_W R_p]); corrector: Newton on R = 0 with the step's length along the
tangent fixed. Where the branch turns back in p the tangent's last component changes its sign,
which Newton at fixed p would not survive.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from simulated_rig.orbits import Balance, Orbit
from simulated_rig.plant import Plant
from simulated_rig.statespace import FloatArray
from simulated_rig.threads import one_thread

Parameter = Literal["frequency", "volts"]
CORRECTIONS = 12
ACCURACY = 1e-10
MOST_TURN = 0.97  # least cosine between successive tangents


@dataclass(frozen=True)
class Branch:
    """Orbits along a branch in order, and the indices after which the parameter turned back."""

    orbits: tuple[Orbit, ...]
    folds: tuple[int, ...]
    ended: str  # why the continuation stopped


class _Path:
    """The extended problem in scaled unknowns."""

    def __init__(self, balance: Balance, start: Orbit, parameter: Parameter) -> None:
        self.balance, self.parameter = balance, parameter
        values = balance.to_real(start.seen)
        rows = values.reshape(balance.functions, -1)
        size = np.linalg.norm(rows, axis=1, keepdims=True)
        self.scale = (np.ones_like(rows) * np.maximum(size, 1e-12)).ravel()
        self.frequency, self.volts = start.frequency_hz, start.volts
        self.point = np.append(values / self.scale, 1.0)

    def conditions(self, p: float) -> tuple[float, float]:
        """Angular frequency and volts at parameter `p`."""
        if self.parameter == "frequency":
            return 2 * np.pi * self.frequency * p, self.volts
        return 2 * np.pi * self.frequency, self.volts * p

    def residual(self, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """R/scale and [R_W R_p], shapes (n,) and (n, n + 1)."""
        values = point[:-1] * self.scale
        error, jacobian = self.balance.residual(values, *self.conditions(float(point[-1])))
        step = 1e-7
        ahead, _ = self.balance.residual(values, *self.conditions(float(point[-1]) + step))
        by_p = (ahead - error) / step / self.scale
        scaled = jacobian * self.scale[None, :] / self.scale[:, None]
        return error / self.scale, np.column_stack([scaled, by_p])

    def tangent(self, jacobian: FloatArray, along: FloatArray) -> FloatArray:
        """Unit null vector of `jacobian` on the side of `along`."""
        square = np.vstack([jacobian, along])
        right = np.zeros(along.size)
        right[-1] = 1.0
        direction = np.linalg.solve(square, right)
        return np.asarray(direction / np.linalg.norm(direction))

    def correct(self, guess: FloatArray, tangent: FloatArray) -> tuple[FloatArray, bool]:
        """Newton at right angles to the tangent."""
        point = guess.copy()
        for _ in range(CORRECTIONS):
            error, jacobian = self.residual(point)
            full = np.append(error, tangent @ (point - guess))
            if np.linalg.norm(full) < ACCURACY:
                return point, True
            point = point - np.linalg.solve(np.vstack([jacobian, tangent]), full)
        return point, False

    def orbit(self, point: FloatArray) -> Orbit:
        omega, volts = self.conditions(float(point[-1]))
        error, _ = self.residual(point)
        size = float(np.linalg.norm(error))
        return self.balance.orbit(point[:-1] * self.scale, omega, volts, size)


@one_thread
def follow(
    plant: Plant,
    start: Orbit,
    parameter: Parameter,
    until: float,
    step: float = 0.02,
    most: int = 2000,
) -> Branch:
    """Follow `start` (a converged forced orbit) until `parameter` passes `until`.

    Parameters
    ----------
    until : frequency in Hz, or volts; on the far side of where the branch starts. A branch that
        turns back ends when it passes the start again by as much on the other side.
    step : greatest arclength of one step, in units of the start's size.

    Raises
    ------
    ValueError
        When `start` has not converged.
    """
    if not start.converged or start.volts == 0.0:
        raise ValueError("start is not a converged forced orbit")
    path = _Path(Balance(plant, start.velocity.size - 1), start, parameter)
    begin = start.frequency_hz if parameter == "frequency" else start.volts
    goal = until / begin
    along = np.zeros(path.point.size)
    along[-1] = np.sign(goal - 1.0)
    point = path.point
    tangent = path.tangent(path.residual(point)[1], along)
    orbits: list[Orbit] = [start]
    folds: list[int] = []
    length = step
    for _ in range(most):
        guess = point + length * tangent
        new, converged = path.correct(guess, tangent)
        after = path.tangent(path.residual(new)[1], tangent) if converged else tangent
        if not converged or float(after @ tangent) < MOST_TURN:
            length /= 2
            if length < 1e-7:
                return Branch(tuple(orbits), tuple(folds), "step became too small")
            continue
        if after[-1] * tangent[-1] < 0:
            folds.append(len(orbits) - 1)
        point, tangent = new, after
        orbits.append(path.orbit(point))
        length = min(1.5 * length, step)
        p = float(point[-1])
        if (p - goal) * np.sign(goal - 1.0) > 0:
            return Branch(tuple(orbits), tuple(folds), "reached the end")
        if (p - (2.0 - goal)) * np.sign(goal - 1.0) < 0 or p <= 0:
            return Branch(tuple(orbits), tuple(folds), "turned back past the start")
    return Branch(tuple(orbits), tuple(folds), "took all steps")
