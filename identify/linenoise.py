"""Noise at a line from what stands beside it, where the two differ.

In white noise the bins beside a line say what is in it. Inside a loop that oscillates they do not:

* A free limit cycle has no phase to return to: noise that drives it (the flame's own) makes its
  phase walk at random. With E Δφ² = D τ, the phase's Fourier coefficients over a record T fall as
  D T/(2π m)² over bins m, and the least-squares frequency has var ω = (6/5) D/T, many times what
  white noise of the same power would leave.
* A forced one returns with the rate at which it locks. Near the edge of the tongue that is a few
  hertz, and the noise peaks at the line as a Lorentzian narrower than the bins looked at. (A peak
  in nearly all runs, well locked ones too, is a modulation: that is for the diagnosis to find.)

Both are fitted to the bins' powers by maximum likelihood (exponential, Whittle's): a part that is
the same in all bins, and one of the expected shape.
"""

import numpy as np
import numpy.typing as npt

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

WHITE = 12 / (2 * np.pi) ** 2  # var f · T² for phase noise of unit power in every bin …
WALK = 6 / 5  # … and for a phase whose bins have the power 1/m²
WIDTHS = (1.0, 1.5, 2.5, 4.0, 6.0, 10.0)  # bins, of a locked line's noise
PEAKED = 12.0  # twice the log-likelihood that a peak must gain to be believed
OUTLIER = 8.0  # times the expected power: a foreign tone's bin
ROUNDS = 40


def frequency_stderr(c1: complex, side: ComplexArray, duration_s: float) -> float:
    """Standard error (Hz) of a free line's least-squares frequency over a record.

    Parameters
    ----------
    c1 : the line's coefficient.
    side : (2M,) what is left in the bins −M…−1, 1…M beside it, in the same scale.
    """
    up, down = _sides(side / c1)
    power = np.abs((up - down.conj()) / 2) ** 2  # of the phase, rad²
    white, walk = _parts(power[:, None], np.arange(1.0, up.size + 1) ** -2.0)[0][:, 0]
    return float(np.sqrt(WHITE * white + WALK * walk)) / duration_s


def peak(side: ComplexArray) -> FloatArray:
    """Power of the noise at forced lines, (K,), by the bins −M…−1, 1…M beside them, (2M, K); zero
    where it stands no higher there than beside them."""
    up, down = _sides(side)
    power = (np.abs(up) ** 2 + np.abs(down) ** 2) / 2
    m = np.arange(1.0, up.shape[0] + 1)
    _, least = _parts(power, np.zeros_like(m))
    best, gained = np.zeros(power.shape[1]), PEAKED
    for width in WIDTHS:
        parts, cost = _parts(power, 1 / (1 + (m / width) ** 2))
        gain = 4 * float(np.sum(least - cost))  # two bins a power
        if gain > gained:
            best, gained = parts.sum(axis=0), gain
    return best


def _sides(side: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """The bins above and below the line, from the nearest on."""
    half = side.shape[0] // 2
    return side[half:], side[:half][::-1]


def _parts(power: FloatArray, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The most likely sizes (2, K) ≥ 0 of a flat part and of one of that `shape` (M,) in powers
    (M, K), and Σ (ln μ + P/μ), (K,).

    By the multiplicative rule x ← x √(Σ s P/μ² / Σ s/μ), which never leaves x ≥ 0 and never makes
    the likelihood less (the rule of non-negative factorisation by Itakura and Saito's divergence).
    """
    tiny = 1e-300
    shapes = np.stack([np.ones_like(shape), shape])  # (2, M)
    sizes = np.stack([power.mean(axis=0) + tiny] * 2) * np.array([[0.5], [0.5]])
    if not shape.any():
        sizes[1] = 0.0
    kept = power
    for _ in range(ROUNDS):
        expected = shapes.T @ sizes + tiny
        kept = np.minimum(power, OUTLIER * expected)
        up = shapes @ (kept / expected**2)
        down = shapes @ (1 / expected) + tiny
        sizes = sizes * np.sqrt(up / down)
    expected = shapes.T @ sizes + tiny
    kept = np.minimum(power, OUTLIER * expected)
    return sizes, np.sum(np.log(expected) + kept / expected, axis=0)
