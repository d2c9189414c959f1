"""Relative calibration of two microphones by exchange.

Recorded once as mounted and once with the microphones in each other's place, the ratio of channel
b to channel a is H_direct = g·T and H_exchanged = g/T, with T the field's own ratio between the
places and g that of the channels: g = sqrt(H_direct · H_exchanged). The root has two branches; the
principal one flips where the phases differ by more than 90°. Here the product's phase is followed
continuously over frequency from its most coherent region, where g's phase is taken to be the
smaller one, so the sign is right as long as the microphones agree to 90° there.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import signal

from daq.errors import InputError

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Exchange:
    """g (b over a) at `frequency_hz`, with its relative standard error and the least coherence."""

    frequency_hz: FloatArray
    ratio: ComplexArray
    relative_sigma: FloatArray
    coherence: FloatArray

    def at(self, frequency_hz: float, width_hz: float = 50.0) -> tuple[complex, float]:
        """Weighted mean of g within ±`width_hz`, and its standard error; raises `InputError`."""
        near = np.abs(self.frequency_hz - frequency_hz) <= width_hz
        near &= np.isfinite(self.relative_sigma)
        if not near.any():
            raise InputError(f"frequency_hz={frequency_hz:g}: nothing coherent within {width_hz:g}")
        weights = 1 / self.relative_sigma[near] ** 2
        mean = complex(np.sum(weights * self.ratio[near]) / weights.sum())
        return mean, float(1 / math.sqrt(weights.sum()))


def exchange_calibration(
    direct: tuple[FloatArray, FloatArray],
    exchanged: tuple[FloatArray, FloatArray],
    rate_hz: float,
    *,
    segment: int = 4096,
    least_coherence: float = 0.5,
) -> Exchange:
    """g from both recordings.

    Parameters
    ----------
    direct, exchanged : the channels (a, b) of each recording, (samples,); a channel belongs to
        its microphone, which changed its place.

    Raises
    ------
    InputError
        A recording is too short, or nowhere coherent.
    """
    ratios, coherences, averages = [], [], 0
    frequency: FloatArray = np.zeros(0)
    for first, second in (direct, exchanged):
        if first.size < 4 * segment or first.size != second.size:
            raise InputError(
                f"recordings of {first.size} and {second.size} samples: equal lengths of at least "
                f"4 segments of {segment} are needed"
            )
        frequency, power = signal.welch(first, rate_hz, nperseg=segment)
        _, other = signal.welch(second, rate_hz, nperseg=segment)
        _, cross = signal.csd(first, second, rate_hz, nperseg=segment)
        ratios.append(cross / power)
        coherences.append(np.abs(cross) ** 2 / (power * other))
        averages = 2 * first.size // segment - 1
    coherence = np.minimum(*coherences)
    coherence[0] = 0.0  # offset
    usable = coherence >= least_coherence
    if not usable.any():
        raise InputError(f"coherence stays below {least_coherence:g}: no common sound in both")
    product = ratios[0] * ratios[1]
    phase = _followed(np.angle(product), usable, int(np.argmax(_smooth(coherence))))
    ratio = np.sqrt(np.abs(product)) * np.exp(0.5j * phase)
    # H1's relative variance is (1 − γ²)/(2 n γ²) (Bendat and Piersol 9.2.4); g takes half of both
    sigma = np.full(coherence.size, np.inf)
    spread = [(1 - c[usable]) / (2 * averages * c[usable]) for c in coherences]
    sigma[usable] = 0.5 * np.sqrt(spread[0] + spread[1])
    return Exchange(frequency, ratio, sigma, coherence)


def _followed(phase: FloatArray, usable: npt.NDArray[np.bool_], start: int) -> FloatArray:
    """`phase` without jumps along the usable bins, starting with its principal value."""
    out = phase.copy()
    indices = np.flatnonzero(usable)
    origin = int(np.argmin(np.abs(indices - start)))
    up = np.unwrap(phase[indices[origin:]])
    down = np.unwrap(phase[indices[: origin + 1]][::-1])[::-1]
    out[indices[origin:]] = up
    out[indices[: origin + 1]] = down
    return out


def _smooth(values: FloatArray, width: int = 15) -> FloatArray:
    return np.asarray(np.convolve(values, np.ones(width) / width, mode="same"))
