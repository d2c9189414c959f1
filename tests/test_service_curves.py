"""The page's curves of a fitted model, against the closed forms of its structure."""

import numpy as np
import pytest

from daq.service.curves import _column, _grid, _loop, _output
from identify.structure import Structure

VALUES = {
    "mode1.frequency_hz": 168.79,
    "mode1.damping": 0.01,
    "mode1.flame_residue": 44.0,
    "mode1.speaker_residue": 0.035,
    "mode2.frequency_hz": 281.33,
    "mode2.damping": 0.05,
    "mode2.flame_residue": -16.0,
    "mode2.speaker_residue": -0.034,
    "flame.pole_hz": 100.0,
    "nonlinearity.c2": -0.3,
    "nonlinearity.c3": -2.0,
}


def test_loop_gain_is_the_thesiss_product_of_flame_and_acoustics() -> None:
    frequency = np.array([100.0, 168.79, 250.0, 400.0])
    gain = _column(_loop(Structure(), VALUES, frequency).P[0][0], frequency)
    s = 2j * np.pi * frequency
    acoustics = sum(
        VALUES[f"mode{i}.flame_residue"]
        * s**2
        / (
            s**2
            + 2
            * VALUES[f"mode{i}.damping"]
            * (w := 2 * np.pi * VALUES[f"mode{i}.frequency_hz"])
            * s
            + w**2
        )
        for i in (1, 2)
    )
    # Eq. 4.12: q' + ω_f q = Y; rounding in double precision only.
    np.testing.assert_allclose(gain, acoustics / (s + 2 * np.pi * 100.0), rtol=1e-12)


def test_nonlinearity_is_the_polynomial_with_slope_one() -> None:
    w = np.linspace(-0.5, 0.5, 11)
    output = _output(_loop(Structure(), VALUES, np.array([100.0])), w)
    np.testing.assert_allclose(output, w - 0.3 * w**2 - 2 * w**3, atol=1e-15)


@pytest.mark.parametrize("damping", [1e-4, 0.01, 0.2])
def test_the_grid_follows_every_resonance(damping: float) -> None:
    values = {**VALUES, "mode1.damping": damping}
    grid = _grid(values, 169.7)
    gain = _column(_loop(Structure(), values, grid).P[0][0], grid)
    # 121 steps over 3.08 rad of the mode's phase: 0.026 rad, which is 1/39 of the circle's
    # diameter; an even grid of 300 points would cross a sharp mode in one step.
    assert np.max(np.abs(np.diff(gain))) < np.max(np.abs(gain)) / 15
