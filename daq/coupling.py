"""κ, what a volt of drive does to the limit cycle, from what a window shows; with its uncertainty.

Each of four observations bears on κ through the law of the tongue (`daq.tongue`), as ln κ with a
standard error:

    forced line     ε(a) = κ D at its amplitude a; a channel misreads a where other modes sound or
                    its microphone is near a node of the mode: by `CHANNEL`, more by far than noise
    free line       beside a forced line of amplitude a it dies at the law's rate λ(a): no channel
                    misreads a rate
    drift           near the limit cycle: D_lock from the phase's mean rotation
    a neighbour     κ at a frequency nearby, which the speaker makes another by `SLOPE` a unit ln ω

While the free line is suppressed the first, second and last are weighed together over a grid of a,
each with its standard error, on the branch that is stable: the mean of ln κ over that posterior is
the estimate, its spread the standard error. This matters where a disturbance returns without
turning (a node): one rate then belongs to two amplitudes, and only the others tell which.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daq.tongue import Law, lock_from_drift

CHANNEL = 0.15  # standard error of ln a: how far a control channel's scale may be off
SLOPE = 1.0  # of ln κ over ln ω: a speaker is flat within its band, and falls as 1/ω² outside
LAW = 0.01  # what a law of first order leaves open of ln κ
LOCK = 0.03  # what the drift's formula leaves open (its error is at most 3.7 %)
RATE = 0.05  # relative error of a rate measured over a few windows: the last nonlinear part of it
SLOWEST = 0.02  # what does not stand out of drift, as a part of ν

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Coupling:
    """κ (1/s per volt) at a frequency, and the standard error of ln κ."""

    per_s_per_v: float
    sigma: float
    frequency_hz: float

    def at(self, frequency_hz: float) -> "Coupling":
        """As known at another frequency."""
        moved = SLOPE * abs(math.log(frequency_hz / self.frequency_hz))
        return Coupling(self.per_s_per_v, math.hypot(self.sigma, moved), frequency_hz)

    def joined(self, other: "Coupling | None") -> "Coupling":
        """Both, weighed by their errors."""
        if other is None:
            return self
        mine, theirs = 1 / self.sigma**2, 1 / other.sigma**2
        log = mine * math.log(self.per_s_per_v) + theirs * math.log(other.per_s_per_v)
        total = mine + theirs
        return Coupling(math.exp(log / total), 1 / math.sqrt(total), self.frequency_hz)


@dataclass(frozen=True)
class Decay:
    """The rate (1/s, negative) at which the free line dies, and its standard error."""

    per_s: float
    sigma: float


def from_forced_line(
    law: Law, drive_v: float, forced: float, free: float, detuning: float, frequency_hz: float
) -> Coupling:
    """κ from the two lines' relative amplitudes, while the free one is not suppressed."""
    epsilon = law.forcing(forced, free, detuning)
    return Coupling(epsilon / drive_v, math.hypot(CHANNEL, LAW), frequency_hz)


def from_drift(
    law: Law, drive_v: float, drift: float, detuning: float, frequency_hz: float
) -> Coupling | None:
    """κ from the phase's mean rotation; None where it is not slower than the detuning."""
    lock = lock_from_drift(drive_v, detuning, drift)
    if lock is None:
        return None
    return Coupling(law.threshold(detuning) / lock, LOCK, frequency_hz)


def when_suppressed(
    law: Law,
    drive_v: float,
    forced: float,
    detuning: float,
    decay: Decay | None,
    neighbour: Coupling | None,
    frequency_hz: float,
) -> Coupling | None:
    """κ from a forced line beside which the free one dies, or is dead; see the module.

    None where the law has no stable forced state of any size: ν is not known.
    """
    sizes, epsilon, rate = law.suppressing(detuning)
    if sizes.size == 0:
        return None
    log_kappa = np.log(epsilon / drive_v)
    cost = (np.log(forced / sizes) / CHANNEL) ** 2
    if decay is not None:
        error = math.hypot(decay.sigma, SLOWEST * law.growth_rate_per_s)
        cost += ((rate - decay.per_s) / np.hypot(error, RATE * rate)) ** 2
    if neighbour is not None:
        spread = math.hypot(neighbour.sigma, LAW)
        cost += ((log_kappa - math.log(neighbour.per_s_per_v)) / spread) ** 2
    weight = np.exp(-(cost - cost.min()) / 2)
    weight /= weight.sum()
    mean = float(weight @ log_kappa)
    spread = math.sqrt(float(weight @ (log_kappa - mean) ** 2))
    return Coupling(math.exp(mean), math.hypot(spread, LAW), frequency_hz)


def decay_of(fall: Sequence[Point]) -> Decay | None:
    """The slope of ln level over time (points: time, ln level, standard error of that) by
    weighted least squares; None while it is not known to about a seventh, or rises."""
    if len(fall) < 2:
        return None
    t, y, error = np.array(fall).T
    weights = 1 / error**2
    t = t - np.average(t, weights=weights)
    spread = float(weights @ t**2)
    if spread <= 0:
        return None
    slope, sigma = float(weights @ (t * y)) / spread, 1 / math.sqrt(spread)
    return Decay(slope, sigma) if slope < 0 and sigma < 0.15 * abs(slope) else None
