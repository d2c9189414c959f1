"""The oscillation's slow complex amplitude, and statistics that honour its slowness.

A signal near f₀ is y(t) = Re z(t) e^{jω₀t}; z is the signal moved down by f₀ and low-passed. The
low-pass is Gaussian in frequency with standard deviation `bandwidth_hz`: no ringing, and its
memory in time is Gaussian too, 1/(2π·bandwidth), after which samples of z know nothing of the
filter. |z| is the envelope, its phase's slope the frequency.

What is averaged over a record of correlated samples gets its standard error from the means of
consecutive blocks longer than the correlation: `block_mean`.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import welch

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error."""

    value: float
    stderr: float


def dominant_frequency(
    signal: FloatArray, sample_rate_hz: float, low_hz: float, high_hz: float
) -> float:
    """Centre of the strongest hump of the spectrum between `low_hz` and `high_hz`.

    The Welch spectrum is smoothed over 4 % of the frequency before the maximum is taken, so that
    a broad noisy hump is not mistaken for its highest spike; the centroid around it refines.
    """
    segment = min(signal.size, int(2 ** np.ceil(np.log2(sample_rate_hz))))
    f, power = welch(signal - signal.mean(), sample_rate_hz, nperseg=segment)
    inside = (f >= low_hz) & (f <= high_hz)
    f, power = f[inside], power[inside]
    width = 0.02 * f[:, None] + f[1] - f[0]
    kernel = np.exp(-0.5 * ((f[None, :] - f[:, None]) / width) ** 2)
    smooth = (kernel @ power) / kernel.sum(axis=1)
    centre = f[int(np.argmax(smooth))]
    near = np.abs(f - centre) <= 0.06 * centre
    return float((f[near] @ power[near]) / power[near].sum())


def demodulate(
    signal: FloatArray, sample_rate_hz: float, frequency_hz: float, bandwidth_hz: float
) -> ComplexArray:
    """z(t), shape (samples,): y ≈ Re z e^{jω₀t} in the band (Gaussian, std `bandwidth_hz`)."""
    n = signal.size
    f = np.fft.fftfreq(n, 1 / sample_rate_hz)
    window = np.exp(-0.5 * ((f - frequency_hz) / bandwidth_hz) ** 2)
    window[f <= 0] = 0.0
    analytic = np.fft.ifft(2 * np.fft.fft(signal - signal.mean()) * window)
    t = np.arange(n) / sample_rate_hz
    return np.asarray(analytic * np.exp(-2j * np.pi * frequency_hz * t), dtype=np.complex128)


def correlation_time(values: FloatArray, step_s: float) -> float:
    """Integral time scale of `values` about their mean: ½ + Σρ up to the first ρ < 0."""
    x = values - values.mean()
    spectrum = np.abs(np.fft.rfft(x, 2 * x.size)) ** 2
    covariance = np.fft.irfft(spectrum)[: x.size]
    if covariance[0] <= 0:
        return step_s
    rho = covariance / covariance[0]
    below = np.flatnonzero(rho < 0)
    end = int(below[0]) if below.size else x.size
    return float(step_s * (0.5 + rho[1:end].sum()))


def block_mean(values: FloatArray, step_s: float) -> Estimate:
    """Mean and its standard error: σ² · 2T_c / T with T_c the integral time scale."""
    duration = values.size * step_s
    share = min(1.0, 2 * max(correlation_time(values, step_s), step_s) / duration)
    return Estimate(float(values.mean()), float(values.std() * np.sqrt(share)))


def mean_frequency(z: ComplexArray, sample_rate_hz: float, centre_hz: float) -> Estimate:
    """Power-weighted mean of the instantaneous frequency, robust where |z| passes zero.

    ⟨f⟩ = f₀ + Im Σ z̄ₙ zₙ₊₁ / (2π Δt Σ|z|²); its error by the same weighting of deviations.
    """
    turned = np.conj(z[:-1]) * z[1:]
    rate = np.imag(turned) * sample_rate_hz / (2 * np.pi)
    weight = np.abs(z[:-1]) ** 2
    offset = float(rate.sum() / weight.sum())
    deviation = (rate - offset * weight) / weight.mean()
    error = block_mean(deviation, 1 / sample_rate_hz).stderr
    # A phase that diffuses has white frequency deviations but for the band-pass: the integral
    # time scale of such a sequence is short and noisy, so the spread of block means bounds it.
    blocks = np.array_split(deviation, 12)
    spread = float(np.std([b.mean() for b in blocks], ddof=1) / np.sqrt(len(blocks)))
    return Estimate(centre_hz + offset, max(error, spread))
