"""The drive's way from the recorded volts to the plant's input: static distortion, then delay.

Lag and resonance are linear and live in the state space. The delay is a fractional shift by
eighth-point Lagrange interpolation at the rate of half steps: at 40 kHz and 1 kHz its error is
below 1e-7.
"""

import numpy as np

from simulated_rig.plant import Actuator
from simulated_rig.statespace import FloatArray

POINTS = 8


def distorted(actuator: Actuator, volts: FloatArray) -> FloatArray:
    """Compression, even distortion and soft clipping, acting sample by sample."""
    out = volts
    if actuator.quadratic_per_v or actuator.cubic_per_v2:
        out = out + actuator.quadratic_per_v * out**2 - actuator.cubic_per_v2 * out**3
    if actuator.clip_v is not None:
        # A smooth knee: harmonic of order 8, hard enough to be called clipping.
        out = out / (1.0 + np.abs(out / actuator.clip_v) ** 8) ** 0.125
    return out


def lagrange(delay: float) -> tuple[int, FloatArray]:
    """Whole samples to go back, and weights of the `POINTS` samples from there on backwards."""
    base = max(0, int(np.floor(delay)) - POINTS // 2 + 1)
    at = delay - base
    nodes = np.arange(POINTS)
    weights = np.ones(POINTS)
    for k in nodes:
        for j in nodes[nodes != k]:
            weights[k] *= (at - j) / (k - j)
    return base, weights


class DrivePath:
    """Distortion and delay of a stream that comes in pieces.

    Parameters
    ----------
    rate_hz : samples per second of what comes in (two per integration step).
    """

    def __init__(self, actuator: Actuator, rate_hz: float) -> None:
        self.actuator = actuator
        self._base, self._weights = lagrange(actuator.delay_s * rate_hz)
        self._past: FloatArray = np.zeros(self._base + POINTS - 1)

    def process(self, volts: FloatArray) -> FloatArray:
        """The next samples at the speaker's terminals, delayed."""
        out = distorted(self.actuator, volts)
        if self.actuator.delay_s == 0.0:
            return out
        joined = np.concatenate([self._past, out])
        self._past = joined[joined.size - self._past.size :]
        reach = POINTS - 1
        useful = joined[: joined.size - self._base]
        return np.convolve(useful, self._weights, mode="valid")[-volts.size :] if reach else out
