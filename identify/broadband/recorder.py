"""The recorder's own low-pass, in both channels alike, and exact band-limited interpolation.

A sampled record is what the converter's anti-alias filter A left. When input and output pass the
same A, a linear loop cannot tell: A cancels from their ratio. A nonlinear one can: the spring acts
on the voltage before the filter. So the input is freed of A, u = A⁻¹u_m, the loop is simulated at
a multiple of the sample rate, and its output sent through A and decimated.

A is a Chebyshev low-pass of order 10 with 0.1 dB ripple (steep and flat, as decimating recorders
have; the edge is a parameter) and a further all-pass phase −κ(f/edge)³ for what the true design
adds in dispersion. A common pure delay is immaterial.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import cheb1ap

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

ORDER, RIPPLE_DB = 10, 0.1
_LEAST_GAIN = 0.3  # the inverse is not amplified beyond 1/0.3: no signal lives there
_LARGEST_RATIO = 1.6  # f/edge at which the all-pass phase stays: beyond lies the stop band


@dataclass(frozen=True)
class RecorderFilter:
    """`edge_hz` of the passband, and the all-pass coefficient κ in rad."""

    edge_hz: float
    dispersion_rad: float

    def response(self, f: FloatArray) -> ComplexArray:
        """A(f), shape of `f`."""
        _, poles, gain = cheb1ap(ORDER, RIPPLE_DB)
        s = 1j * f / self.edge_hz
        low_pass = np.full(f.shape, gain, dtype=np.complex128)
        for pole in poles:
            low_pass /= s - pole
        low_pass /= np.prod(-1 / poles) * gain  # unit gain at rest
        return np.asarray(low_pass * np.exp(-1j * self.dispersion_rad * self._cube(f)))

    def slopes(self, f: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """∂A/∂edge_hz and ∂A/∂dispersion_rad."""
        _, poles, _ = cheb1ap(ORDER, RIPPLE_DB)
        s = 1j * f / self.edge_hz
        logarithmic = np.zeros(f.shape, dtype=np.complex128)
        for pole in poles:
            logarithmic += s / (s - pole)
        inside = f < _LARGEST_RATIO * self.edge_hz
        logarithmic += np.where(inside, 3j * self.dispersion_rad * self._cube(f), 0)
        a = self.response(f)
        return np.asarray(a * logarithmic / self.edge_hz), np.asarray(-1j * self._cube(f) * a)

    def _cube(self, f: FloatArray) -> FloatArray:
        return np.asarray(np.minimum(f / self.edge_hz, _LARGEST_RATIO) ** 3)


def inverse(a: ComplexArray) -> ComplexArray:
    """A⁻¹, bounded: Ā/max(|A|², 0.09)."""
    return np.asarray(np.conj(a) / np.maximum(np.abs(a) ** 2, _LEAST_GAIN**2))


def inverse_slope(a: ComplexArray, da: ComplexArray) -> ComplexArray:
    """∂(A⁻¹) for ∂A."""
    free = np.abs(a) > _LEAST_GAIN
    return np.asarray(np.where(free, -da / np.where(free, a, 1) ** 2, np.conj(da) / _LEAST_GAIN**2))


def interpolate(spectrum: ComplexArray, samples: int, factor: int) -> FloatArray:
    """Band-limited interpolation of a record's rfft to `factor` times its rate, one more sample.

    The record is taken as one period, so that its ends should be at rest or alike.
    """
    wide = np.zeros(samples * factor // 2 + 1, dtype=np.complex128)
    wide[: spectrum.size] = spectrum
    if samples % 2 == 0:
        wide[spectrum.size - 1] *= 0.5
    fine = np.fft.irfft(wide, samples * factor) * factor
    return np.append(fine, fine[0])
