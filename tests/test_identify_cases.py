"""The recorded campaigns: two live here, the others in ../shared/cases where that is present."""

from pathlib import Path

import numpy as np
import pytest

import identify
from daq.importers import open_campaign
from identify.load import load_campaign
from identify.results import Diagnosis

HERE = Path(__file__).parent / "data"
SHARED = Path(__file__).parents[2] / "shared" / "cases"

# Case: effect, location, and {parameter: value} of physics.md §4.
TRUTH = {
    "a-clean": None,
    "b-flame-delay": ("flame_delay", "flame", {"flame_delay.delay_s": 4e-4}),
    "c-speaker-resonance": (
        "actuator_dynamics",
        "actuator",
        {"actuator_dynamics.frequency_hz": 140.0, "actuator_dynamics.damping": 0.12},
    ),
    "d-extra-mode": (
        "acoustic_mode",
        "forward",
        {"acoustic_mode.frequency_hz": 393.86, "acoustic_mode.damping": 0.05},
    ),
    "e-mic-skew": ("channel_mismatch", "sensor", {"channel_mismatch.skew_s": 2e-5}),
    "f-drift": ("parameter_drift", "experiment", {"parameter_drift.relative_change": 6e-3}),
}


def diagnose(name: str) -> Diagnosis:
    folder = HERE / name if (HERE / name).exists() else SHARED / name
    if not folder.exists():
        pytest.skip(f"{folder} is missing: ../shared/cases holds it")
    return identify.diagnose(load_campaign(open_campaign(folder)))


# Measuring coverage doubles the time: one case that is measured shows as much as all.
MEASURED = "b-flame-delay"
CASES = [n if n == MEASURED else pytest.param(n, marks=pytest.mark.no_cover) for n in TRUTH]


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", CASES)
def test_case_is_diagnosed(name: str) -> None:
    found = diagnose(name)
    told = found.to_json()
    assert told["after"]["validation_error"] < 3 * told["noise_floor"]
    expected = TRUTH[name]
    if expected is None:
        assert found.verdict == "no_discrepancy"
        assert found.effects == ()
        return
    assert found.verdict == "traced", found.explanation
    # no rival remains: a distributed delay without spread is the delay itself, not its equal
    assert not any(c.equivalent_to for c in found.candidates if c.adequate)
    assert [(e.effect, e.location) for e in found.effects] == [expected[:2]]
    assert told["before"]["validation_error"] > 5 * told["after"]["validation_error"]
    for parameter, value in expected[2].items():
        estimate = found.effects[0].parameters[parameter]
        assert abs(estimate.value - value) < 3 * estimate.stderr, parameter
        assert np.isfinite(estimate.stderr)
