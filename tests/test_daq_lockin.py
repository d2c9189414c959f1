"""The lock-in against signals whose lines are known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.lockin import baseband, free_cycle, measure, strongest_line

RATE = 10_000.0


def signal(
    lines: list[tuple[float, float, float]], seconds: float, noise: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Sum of amplitude · cos(2π f t + phase)."""
    t = np.arange(round(seconds * RATE)) / RATE
    out = noise * np.random.default_rng(seed).standard_normal(t.size)
    for frequency, amplitude, phase in lines:
        out += amplitude * np.cos(2 * np.pi * frequency * t + phase)
    return out


@settings(max_examples=40, deadline=None)
@given(
    frequency=st.floats(120, 300),
    amplitude=st.floats(0.1, 1e4),
    phase=st.floats(-3, 3),
    second=st.floats(0, 0.3),
    offset=st.floats(-1, 1),
)
def test_harmonics_and_offset_do_not_leak(
    frequency: float, amplitude: float, phase: float, second: float, offset: float
) -> None:
    lines = [(frequency, amplitude, phase), (2 * frequency, second * amplitude, 1.0)]
    x = signal(lines, 0.3) + offset * amplitude
    z, _, rest = baseband(x, RATE, frequency)
    # the model holds the signal exactly: only rounding (1e-16 · condition of the design) is left
    np.testing.assert_allclose(z, amplitude * np.exp(1j * phase), rtol=1e-9)
    assert rest < 1e-9 * amplitude


def test_two_lines_are_told_apart() -> None:
    """Window of 0.5 s, lines 4 Hz apart: two whole beats, so mean and rest separate exactly but
    for the free line's turning within a chunk of 12 ms (relative size (π·4·0.012)²/6 < 0.4 %)."""
    x = signal([(166.0, 500.0, 0.3), (170.0, 50.0, 1.0)], 0.5)
    seen = measure(x, RATE, 166.0, drive=signal([(166.0, 2.0, -math.pi / 2)], 0.5))
    assert seen.amplitude == pytest.approx(500.0, rel=0.01)
    assert seen.free_amplitude == pytest.approx(50.0, rel=0.02)
    assert seen.free_offset_hz == pytest.approx(4.0, abs=0.3)
    # the drive is 2 sin ωt: its phasor is −2j, so the pressure leads it by 0.3 + π/2
    assert np.angle(seen.forced) == pytest.approx(0.3 + math.pi / 2, abs=0.02)
    assert seen.drive_v == pytest.approx(2.0, rel=1e-9)


def test_drift_of_a_slipping_phase() -> None:
    seen = measure(signal([(170.0, 100.0, 0.0)], 1.0), RATE, 168.0)
    assert seen.drift_rad_s == pytest.approx(2 * math.pi * 2.0, rel=0.01)
    assert seen.phase_span_rad > math.pi


def test_noise_is_not_taken_for_a_line() -> None:
    """The strongest of n noise bins exceeds its standard error by about sqrt(2 ln n) ≈ 2.9 times
    (n = 83 chunks, complex), so 4 σ separates noise from a line, as the controller assumes."""
    exceeded = [
        m.free_amplitude > 4 * m.free_sigma * math.sqrt(2)
        for m in (
            measure(signal([(166.0, 500.0, 0.0)], 1.0, noise=5.0, seed=s), RATE, 166.0)
            for s in range(30)
        )
    ]
    assert sum(exceeded) <= 2


def test_standard_error_of_a_line() -> None:
    """Over 200 draws the scatter of the fitted amplitude is the error claimed, within 15 %
    (relative standard error of a standard deviation from 200 draws: 5 %)."""
    rng = np.random.default_rng(3)
    n, sigma = 100, 0.1
    line = np.exp(0.7j * np.arange(n))
    fitted, claimed = [], []
    for _ in range(200):
        noise = sigma * (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / math.sqrt(2)
        amplitude, _, error = strongest_line(line + noise, 1.0)
        fitted.append(amplitude)
        claimed.append(error)
    assert np.std(fitted) == pytest.approx(np.mean(claimed), rel=0.15)


def test_free_cycle_to_a_thousandth_of_a_bin() -> None:
    x = signal([(169.7123, 350.0, 0.4), (339.4246, 25.0, 1.0)], 2.0, noise=0.2)
    found = free_cycle(x, RATE)
    # phase noise 0.2/350·sqrt(2/120) per chunk over 2 s: σ_f ≈ 3e-6 Hz; ten of them
    assert found.frequency_hz == pytest.approx(169.7123, abs=5e-5)
    assert found.amplitude == pytest.approx(350.0, rel=1e-4)
    assert found.harmonics[1] == pytest.approx(25.0, rel=0.01)
    assert found.suppression_db(35.0) == pytest.approx(-20.0, abs=0.01)


def test_too_short_a_record_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one chunk"):
        measure(np.ones(50), RATE, 166.0)
