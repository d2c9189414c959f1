"""A run that is spoilt but kept weighs no more than what it may err by."""

from pathlib import Path

import numpy as np
import pytest

import identify
from identify.effects import by_key
from identify.harmonics import Harmonics
from identify.identification import DOUBT
from simulated_rig.effects import make_effect
from simulated_rig.random_rigs import MOST_TWO, random_rig
from tests.trace_material import record


def test_another_mode_that_sings_in_one_run_hides_no_effect(tmp_path: Path) -> None:
    """With the damping that falls, the second mode sings at -20.5 dB beside the forcing of one run,
    whose response is nine per cent off by that, at 80 dB of noise (48024)."""
    change = -0.0477
    rig = random_rig(48024, modes=MOST_TWO)
    drift = make_effect("parameter_drift/damping", {"damping_change": change})
    ready = record(tmp_path, 48024, rig, [drift], forced=10, validation=3)
    (run,) = ready.quality.doubted
    error = ready.quality.doubted[run]
    assert {f.flag for f in ready.quality.flags if f.run == run} >= {"another_oscillation"}
    assert 0.07 < error < 0.12
    (measured,) = (h for h in ready.measured if h.name == run)
    assert np.sqrt(measured.variance[0]) > error * abs(measured.velocity[0])
    catalogue = [by_key("parameter_drift:damping")]
    found = identify.diagnose(ready.campaign, catalogue=catalogue)
    assert found.verdict == "traced"
    value = found.effects[0].parameters["parameter_drift.relative_change"]
    last_s = max(r.started_s for r in ready.campaign.runs)
    assert value.value == pytest.approx(change * last_s / 1200, abs=4 * value.stderr)


def test_a_doubted_run_errs_by_its_noise_and_by_what_spoils_it(tmp_path: Path) -> None:
    """The error grows with the harmonic's number; without one, only the noise is larger."""
    rig = random_rig(3, noise_db=(60.0, 60.0), coloured=False, modes=(1,))
    h = record(tmp_path, 3, rig, [], forced=4, validation=1, modes=1).measured[1]
    k = np.arange(1, h.count + 1)
    noise = DOUBT**2 * h.variance
    np.testing.assert_allclose(h.doubted(DOUBT).variance, noise)
    wrong = h.doubted(DOUBT, 0.01)
    expected = noise + (0.01 * k * np.abs(h.velocity)) ** 2
    np.testing.assert_allclose(wrong.variance, expected)
    # of the velocity a·Y + b·P, as a correction leaves it, likewise
    a, b = 0.9, 0.2j * np.abs(h.velocity).max() / np.abs(h.pressure).max()

    def corrected(h: Harmonics) -> np.ndarray:
        shared = 2 * np.real(a * np.conj(b) * h.shared_noise)
        return a**2 * h.variance + np.abs(b) ** 2 * h.pressure_noise + shared

    left = DOUBT**2 * corrected(h) + (0.01 * k * np.abs(a * h.velocity + b * h.pressure)) ** 2
    np.testing.assert_allclose(corrected(wrong), left)
