"""Noise inside the loop is no effect: clean campaigns with it, of rigs that had raised an alarm."""

from pathlib import Path

import pytest

import identify
from simulated_rig.random_rigs import MOST_TWO, random_rig
from tests.trace_material import record

pytestmark = pytest.mark.no_cover


@pytest.mark.parametrize(
    ("seed", "turbulence_v", "coloured", "forced"),
    [
        # a damped mode's noise, as hum at 6 × 50 Hz
        pytest.param(50122, 0.0333, False, 9, marks=pytest.mark.slow),
        (50052, 0.0205, True, 11),  # noise that the pressure has too, as a sensor elsewhere
        (50026, 0.0114, False, 9),
    ],
)
def test_noise_in_the_loop_is_no_effect(
    tmp_path: Path, seed: int, turbulence_v: float, coloured: bool, forced: int
) -> None:
    rig = random_rig(
        seed,
        coloured=coloured,
        turbulence_v=turbulence_v,
        modes=MOST_TWO,
    )
    modes = len(rig.plant.modes)
    ready = record(tmp_path, seed, rig, [], forced=forced, validation=3, modes=modes)
    assert ready.quality.tones == ()
    found = identify.diagnose(ready.campaign)
    assert (found.verdict, found.effects) == ("no_discrepancy", ()), found.explanation
