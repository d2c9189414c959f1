"""Noise in windowed spectra: levels by the median, and what a peak is worth against them."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

REACH = 20  # bins on either side that give the noise at a line
STRIDE = 8
SKIRT = 12  # bins on either side in which a line must stand out
GUARD = 5  # bins next to a line that it fills itself
DEGREES = 20  # independent ones among 2·REACH bins under the Blackman–Harris window (1/2)


def floor(power: FloatArray) -> float:
    """Mean power of noise from the median of exponentially distributed bins."""
    if power.size == 0:
        return 1e-300
    return max(float(np.median(power)) / float(np.log(2)), 1e-300)


def local_noise(power: FloatArray, usable: BoolArray) -> FloatArray:
    """Noise power (bins,) at every usable bin, from the usable ones around it; inf elsewhere.

    The median over REACH bins on either side beyond the GUARD: a line does not raise its own
    noise, a slope or a broad resonance does. Found at every STRIDE-th bin, interpolated between.
    """
    kept = power[usable]
    out = np.full(power.shape, np.inf)
    width = 2 * (REACH + GUARD) + 1
    if kept.size < width:
        return out
    padded = np.pad(kept, REACH + GUARD, mode="reflect")
    frames = np.lib.stride_tricks.sliding_window_view(padded, width)[::STRIDE]
    ring = np.r_[0:REACH, width - REACH : width]
    level = np.log(np.maximum(np.median(frames[:, ring], axis=1) / np.log(2), 1e-300))
    at = STRIDE * np.arange(level.size)
    out[usable] = np.exp(np.interp(np.arange(kept.size), at, level))
    return out


def tail(ratio: FloatArray | float, degrees: int = DEGREES) -> FloatArray:
    """P(power / estimated noise > ratio) for noise: (1 + ratio/M)^−M, an F distribution's."""
    return np.asarray((1 + np.asarray(ratio) / degrees) ** -float(degrees))


def purity(power: FloatArray, peak: int) -> float:
    """A peak's power within its main lobe over that of the bins next to it, out to SKIRT bins.

    Large for a line; of order one for a peak of noise, also where a resonance narrower than the
    ring of `local_noise` shapes it.
    """
    low = max(peak - SKIRT, 0)
    around = power[low : peak + SKIRT + 1]
    lobe = np.abs(np.arange(low, low + around.size) - peak) < GUARD
    return float(around[lobe].sum()) / (float(around[~lobe].sum()) + 1e-300)
