"""Records of oscillators under a broadband drive, by a scheme that the product does not know."""

import numba
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

RATE = 600.0
TRUTH = {
    "mode1.frequency_hz": 70.0,
    "mode1.damping": 0.05,
    "static_gain": 1.0,
    "bias": 0.0,
    "nonlinearity.c3": 4.0,
}


def multisine(samples: int, seed: int, rms: float = 0.03) -> FloatArray:
    """Odd lines up to a third of the rate, random phases, one period; starts and ends alike."""
    rng = np.random.default_rng(seed)
    spectrum = np.zeros(samples // 2 + 1, dtype=complex)
    lines = np.arange(1, samples // 3, 2)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size))
    u = np.fft.irfft(spectrum, samples)
    return np.asarray(u * rms / u.std())


@numba.njit(cache=False)
def _reference(drive, w0, zeta, quadratic, cubic, h):  # type: ignore[no-untyped-def]
    """Velocity-Verlet, damping by a fixed point: shares no formula with the product."""
    y, v = 0.0, 0.0
    out = np.empty(drive.size)
    out[0] = 0.0
    a = w0 * w0 * drive[0]
    for i in range(drive.size - 1):
        y += h * v + 0.5 * h * h * a
        spring = y + quadratic * y * y + cubic * y * y * y
        rest = w0 * w0 * (drive[i + 1] - spring)
        new = v + h * a
        for _ in range(4):
            new = v + 0.5 * h * (a + rest - 2 * zeta * w0 * new)
        a = rest - 2 * zeta * w0 * new
        v = new
        out[i + 1] = y
    return out


def duffing_output(
    u: FloatArray,
    *,
    cubic: float = 4.0,
    quadratic: float = 0.0,
    hz: float = TRUTH["mode1.frequency_hz"],
) -> FloatArray:
    """Output of the physical equation for the band-limited input `u`, started at rest.

    Verlet's relative frequency error is (ωh)²/24 = (2π·70/600/40)²/24 = 1.4e-5 at 70 Hz.
    """
    fine = 40
    spectrum = np.fft.rfft(u)
    padded = np.zeros(u.size * fine // 2 + 1, dtype=complex)
    padded[: spectrum.size] = spectrum
    drive = np.fft.irfft(padded, u.size * fine) * fine
    w0 = 2 * np.pi * hz
    h = 1 / RATE / fine
    out = _reference(drive, w0, TRUTH["mode1.damping"], quadratic, cubic, h)
    return np.asarray(out[::fine])
