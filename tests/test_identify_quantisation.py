"""A coarse converter errs where the harmonics are, and its neighbours in the spectrum do not show
it: what it adds is foreseen, and is no discovery."""

from pathlib import Path

import numpy as np
import pytest

from daq.importers import open_campaign
from identify import assess, drive, start
from identify.harmonics import fit_harmonics, side_bins, typical
from identify.identification import prepare
from identify.load import load_campaign
from identify.quantisation import added_variance, repeated, repetition
from simulated_rig import build_config
from simulated_rig.campaigns import simulate_campaign, write_campaign
from simulated_rig.random_rigs import random_campaign

RATE, SAMPLES, STEP = 10_000.0, 20_000, 20 / 2**16


@pytest.mark.parametrize(
    ("frequency_hz", "period"), [(166.0, 5000), (167.0, 10_000), (175.0, 400), (2500.0, 4)]
)
def test_whole_hertz_repeat(frequency_hz: float, period: int) -> None:
    found, slipped = repetition(frequency_hz, RATE, SAMPLES, slip=1e-6)
    assert found == period
    assert slipped < 1e-9


def test_a_free_cycle_can_nearly_repeat() -> None:
    """The thesis's: 13 periods are 766 samples but for 3e-6 of one."""
    found, slipped = repetition(169.71275, RATE, SAMPLES, slip=1e-4)
    assert found == 766
    assert slipped == pytest.approx(20_000 * abs(0.016971275 - 13 / 766))
    assert repetition(np.sqrt(2) * 120, RATE, SAMPLES, slip=1e-6) == (SAMPLES, 0.0)


def test_the_repeated_part_fades_under_noise() -> None:
    assert repeated(STEP, 0.0).sum() == pytest.approx(STEP**2 / 12, rel=0.03)
    assert repeated(STEP, STEP).sum() < 1e-15 * STEP**2


def test_no_step_adds_nothing() -> None:
    assert added_variance(None, 1.0, 0.0, 166.0, RATE, SAMPLES) == 0.0
    assert added_variance(STEP, 0.0, 0.0, 166.0, RATE, SAMPLES) == 0.0


@pytest.mark.parametrize("frequency_hz", [162.0, 166.0, 175.0, 169.71275])
@pytest.mark.parametrize("noise", [0.0, 0.15, 0.3])
def test_the_error_is_as_large_as_foreseen(frequency_hz: float, noise: float) -> None:
    """Rounded sines with a few harmonics: the coefficients' squared errors over what the bins
    beside them and `added_variance` say, averaged over 30 signals and three harmonics."""
    rng = np.random.default_rng(round(100 * noise) + round(frequency_hz))
    t = np.arange(SAMPLES) / RATE
    k = np.arange(1, 4)
    ratios = []
    for _ in range(30):
        c = np.array([1.5 * rng.uniform(0.7, 1.3), 0.02, 0.01]) * np.exp(2j * np.pi * rng.random(3))
        exact = (c @ np.exp(2j * np.pi * frequency_hz * np.outer(k, t))).real
        noisy = exact + noise * STEP * rng.standard_normal(SAMPLES)
        rounded = np.round(noisy / STEP) * STEP
        found, rest = fit_harmonics(rounded[None], RATE, frequency_hz, 3)
        power = np.abs(side_bins(rest, RATE, frequency_hz, 3)[0]) ** 2
        level = float(typical(power))
        added = added_variance(STEP, abs(c[0]), level, frequency_hz, RATE, SAMPLES)
        ratios.append(np.abs(found[0] - c) ** 2 / (level + added))
    # neighbours that hold some of the repeated part already count it twice: at most 3 times less
    assert 0.3 < np.mean(ratios) < 1.5


@pytest.mark.parametrize("noise_db", [48.0, 60.0])
def test_sixteen_bits_are_no_discrepancy(tmp_path: Path, noise_db: float) -> None:
    """Noise of 0.2 and 0.05 of the converter's step: before, χ²/dof 2 to 6."""
    for seed in (0, 2):
        rig, plan = random_campaign(seed, build_config(noise_db=noise_db), forced=9, validation=2)
        assert rig.converter.bits == 16
        folder = tmp_path / str(seed)
        write_campaign(simulate_campaign(rig, plan, seed, declared_modes=2), folder)
        ready = prepare(load_campaign(open_campaign(folder)))
        data, fit = drive.refitted(start.fit_from_data(ready.structure, ready.data), ready.data)
        held = [assess.predict(fit.structure, fit.theta, b) for b in data.validation]
        assert fit.converged
        assert assess.lack_of_fit_p(fit.chi2, fit.dof) > 1e-3
        assert assess.validation_p(held, fit.covariance) > 1e-3
