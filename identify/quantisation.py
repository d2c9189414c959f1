"""What a converter's steps add to the error of a Fourier coefficient.

Rounded to steps q, a signal carries an error of q²/12. Where noise of standard deviation σ dithers
it, that error is fresh in every sample but for a part that repeats with the signal (Widrow):

    σ_c² = Σ_m q²/(2π² m²) · exp(−4π² m² σ²/q²)          (q²/12 without noise, 0 beyond σ ≈ q/2)

A signal whose frequency is in a whole ratio to the sample rate meets the same P sample instants in
every P samples. The repeated part then stands in the lines that the harmonics share, N/P times as
strong as in the record's N lines on average, where the bins beside a harmonic do not show it:
E|c|² = 4 σ_c²/P instead of 4 σ_c²/N. Where the ratio is nearly whole, the signal slips over the
record, by d steps at its steepest, and of N/P − 1 there remains the share ⟨sinc²(m d cos φ)⟩.
"""

import math

import numpy as np
import numpy.typing as npt

TERMS = np.arange(1, 31)
SLIPS = (1e-3, 1.0, 6.0, 40.0)  # steps that a repetition looked for may slip over the record
COSINES = np.cos(np.pi * (np.arange(64) + 0.5) / 64)


def repetition(frequency_hz: float, rate_hz: float, samples: int, slip: float) -> tuple[int, float]:
    """After how many samples a periodic signal's repeat to `slip` periods over the record, and by
    how many they do slip. `samples` where they never repeat."""
    ratio = frequency_hz / rate_hz
    width = max(slip, 1e-9) / samples
    numerator, denominator = _simplest(ratio - width, ratio + width)
    if denominator >= samples:
        return samples, 0.0
    return denominator, abs(ratio - numerator / denominator) * samples


def _simplest(low: float, high: float) -> tuple[int, int]:
    """Numerator and denominator of the simplest fraction between two positive numbers."""
    whole = math.floor(low)
    if whole + 1 <= high:
        return whole + 1, 1
    if whole == low:
        return whole, 1
    numerator, denominator = _simplest(1 / (high - whole), 1 / (low - whole))
    return whole * numerator + denominator, numerator


def repeated(step: float, noise: float) -> npt.NDArray[np.float64]:
    """The terms of σ_c² for steps `step` under noise of standard deviation `noise`."""
    damped = np.exp(-((2 * np.pi * TERMS * noise / step) ** 2)) / TERMS**2
    return np.asarray(step**2 / (2 * np.pi**2) * damped)


def added_variance(
    step: float | None,
    amplitude: float,
    bin_power: float,
    frequency_hz: float,
    rate_hz: float,
    samples: int,
) -> float:
    """E|c|² that quantisation adds to each harmonic's coefficient beyond what its neighbours show.

    `amplitude` is the signal's; `bin_power` E|n|² of the coefficients beside the harmonics, noise
    and steps together: 4 (σ² + q²/12)/N.
    """
    if not step or not amplitude > 0:
        return 0.0
    noise = np.sqrt(max(samples * bin_power / 4 - step**2 / 12, 0.0))
    terms = repeated(step, float(noise))
    steepest = 2 * np.pi * amplitude / step  # steps a period of slip
    added = 0.0
    for slip in SLIPS:
        period, slipped = repetition(frequency_hz, rate_hz, samples, slip / steepest)
        share = np.mean(np.sinc(np.outer(TERMS * slipped * steepest, COSINES)) ** 2, axis=1)
        shown = 1 / samples if 2 * period >= samples else 0.0  # of lines in every other bin
        added = max(added, 4 * float(terms @ share) * (1 / period - shown))
    return added
