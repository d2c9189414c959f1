"""The time between two channels' samples, from one signal that both record.

A delay τ of channel b turns the phase of the cross spectrum by −2πfτ: a line through the origin,
fitted with weights from the coherence. One hardware-independent way to find a multiplexed
converter, which samples its channels one after the other.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import signal

from daq.errors import InputError

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Skew:
    """`seconds` > 0: the second channel shows the common signal that much later."""

    seconds: float
    sigma: float
    gain: float  # second over first


def inter_channel_skew(
    first: FloatArray,
    second: FloatArray,
    rate_hz: float,
    *,
    low_hz: float = 20.0,
    high_hz: float | None = None,
    segment: int = 2048,
) -> Skew:
    """The delay of `second` against `first`, to a fraction of a sample.

    Noise, a sweep or any signal with lines from `low_hz` to `high_hz` will do, fed to both inputs.

    Raises
    ------
    InputError
        Too short, or the channels have no signal in common.
    """
    if first.size != second.size or first.size < 2 * segment:
        raise InputError(
            f"{first.size} and {second.size} samples: equal lengths of at least {2 * segment}"
        )
    frequency, power = signal.welch(first, rate_hz, nperseg=segment)
    _, other = signal.welch(second, rate_hz, nperseg=segment)
    _, cross = signal.csd(first, second, rate_hz, nperseg=segment)
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.nan_to_num(np.abs(cross) ** 2 / (power * other))
    band = (frequency >= low_hz) & (frequency <= (high_hz or 0.4 * rate_hz)) & (coherence > 0.8)
    if int(band.sum()) < 5:
        raise InputError("the two channels have no common signal: feed one source to both")
    f, gamma2 = frequency[band], np.minimum(coherence[band], 1 - 1e-9)
    # phase variance (1 − γ²)/(2 n γ²), and lines with little power count little
    averages = 2 * first.size // segment - 1
    weights = 2 * averages * gamma2 / (1 - gamma2)
    coarse = _whole_samples(first, second) / rate_hz
    phase = np.angle(cross[band] * np.exp(2j * np.pi * f * coarse))
    slope = float(np.sum(weights * f * phase) / np.sum(weights * f**2))
    sigma = 1 / math.sqrt(float(np.sum(weights * (2 * np.pi * f) ** 2)))
    gain = float(np.sqrt(np.sum(other[band]) / np.sum(power[band])))
    return Skew(coarse - slope / (2 * np.pi), sigma, gain)


def _whole_samples(first: FloatArray, second: FloatArray) -> int:
    """The delay to the nearest sample, from the peak of the cross-correlation."""
    size = 1 << (2 * first.size - 1).bit_length()
    spectra = np.conj(np.fft.rfft(first - first.mean(), size))
    correlation = np.fft.irfft(spectra * np.fft.rfft(second - second.mean(), size), size)
    lag = int(np.argmax(np.abs(correlation)))
    return lag - size if lag > size // 2 else lag


def tolerable_skew(spacing_m: float, sound_speed_m_s: float, relative_error: float = 0.01) -> float:
    """The skew that costs `relative_error` of the velocity between two microphones.

    A mismatch δ of the pressures costs δ/(k·s) of the velocity (Eqs. 5.1, 5.2); a skew τ is a
    mismatch ωτ, so the cost is cτ/s whatever the frequency.
    """
    return relative_error * spacing_m / sound_speed_m_s
