"""Noise at a line by what stands beside it: a phase that walks, and a locked line's peak.

Both against many realisations: what is stated must be what scatters.
"""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from identify.harmonics import estimate_frequency, fit_harmonics, raised, side_bins
from identify.linenoise import frequency_stderr, peak

FloatArray = npt.NDArray[np.float64]
RATE, SAMPLES, LINE_HZ = 2000.0, 4000, 100.0
SECONDS = SAMPLES / RATE
TIMES = 60


def walking(rng: np.random.Generator, white: float, diffusion: float) -> FloatArray:
    """A line with E Δφ² = diffusion · τ in white noise of that standard deviation."""
    t = np.arange(SAMPLES) / RATE
    phase = np.cumsum(rng.standard_normal(SAMPLES)) * np.sqrt(diffusion / RATE)
    return np.cos(2 * np.pi * LINE_HZ * t + phase) + white * rng.standard_normal(SAMPLES)


def locked(rng: np.random.Generator, width_hz: float, size: float) -> FloatArray:
    """A line whose phase is held at a rate of 2π · width, in white noise."""
    t = np.arange(SAMPLES) / RATE
    kept = np.exp(-2 * np.pi * width_hz / RATE)
    push = rng.standard_normal(2 * SAMPLES) * np.sqrt(1 - kept**2)
    phase = size * lfilter([1.0], [1.0, -kept], push)[SAMPLES:]
    white = 1e-3 * rng.standard_normal(SAMPLES)
    return np.asarray(np.cos(2 * np.pi * LINE_HZ * t + phase) + white)


@pytest.mark.parametrize(
    ("white", "diffusion"), [(1e-3, 0.0), (1e-3, 1e-5), (1e-2, 1e-3), (1e-5, 1e-3)]
)
def test_a_free_lines_frequency_scatters_as_stated(white: float, diffusion: float) -> None:
    """By white noise alone, that of a walking phase had been stated five times too small."""
    rng = np.random.default_rng(5)
    found, stated = [], []
    for _ in range(TIMES):
        x = walking(rng, white, diffusion)
        f = estimate_frequency(x, RATE)
        c, rest = fit_harmonics(x[None], RATE, f, 3)
        side = side_bins(rest, RATE, f, 3)[0, :, 0]
        found.append(f)
        stated.append(frequency_stderr(complex(c[0, 0]), side, SECONDS))
    ratio = float(np.std(found, ddof=1)) / float(np.median(stated))
    assert 0.7 < ratio < 1.4  # of 60: 9 % standard error
    if diffusion:
        walk = np.sqrt(6 / 5 * diffusion / SECONDS) / (2 * np.pi)
        assert np.median(stated) == pytest.approx(walk, rel=0.15)


@pytest.mark.parametrize(("width_hz", "low", "high"), [(1.0, 0.5, 1.6), (3.0, 0.5, 1.6)])
def test_a_locked_lines_noise_is_what_scatters(width_hz: float, low: float, high: float) -> None:
    rng = np.random.default_rng(6)
    lines, powers, beside = [], [], []
    for _ in range(TIMES):
        x = locked(rng, width_hz, 0.02)
        c, rest = fit_harmonics(x[None], RATE, LINE_HZ, 3)
        side = side_bins(rest, RATE, LINE_HZ, 3)[0]
        lines.append(c[0, 0])
        beside.append(float(np.mean(np.abs(side[:, 0]) ** 2)))
        powers.append(max(float(peak(side)[0]), beside[-1]))
    scatter = float(np.var(lines, ddof=1))
    assert scatter > 2 * np.mean(beside)  # what the neighbours alone would say
    assert low < np.mean(powers) / scatter < high


def test_white_noise_hardly_ever_has_a_peak() -> None:
    """In one of thirty records at most, and then a small one."""
    rng = np.random.default_rng(7)
    found = 0
    for _ in range(200):
        side = rng.standard_normal((40, 7)) + 1j * rng.standard_normal((40, 7))
        power = peak(side)
        found += bool(power.any())
        assert power.max() < 10 * np.mean(np.abs(side) ** 2)
    assert found <= 200 / 30


def test_a_foreign_tone_beside_a_line_is_no_noise_of_it() -> None:
    rng = np.random.default_rng(8)
    side = rng.standard_normal(40) + 1j * rng.standard_normal(40)
    without = frequency_stderr(1000.0, side, SECONDS)
    side[26] += 300.0
    assert frequency_stderr(1000.0, side, SECONDS) == pytest.approx(without, rel=0.5)


def test_a_peak_raises_variances_and_keeps_correlations() -> None:
    rng = np.random.default_rng(9)
    root = rng.standard_normal((6, 6))
    covariance = root @ root.T
    own = np.diag(covariance)[:3] + np.diag(covariance)[3:]
    power = own * np.array([4.0, 0.5, 1.0])
    found = raised(covariance, power)

    def correlations(c: FloatArray) -> FloatArray:
        size = np.sqrt(np.diag(c))
        return np.asarray(c / np.outer(size, size))

    np.testing.assert_allclose(correlations(found), correlations(covariance))
    now = np.diag(found)[:3] + np.diag(found)[3:]
    np.testing.assert_allclose(now, np.maximum(own, power))
