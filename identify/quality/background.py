"""Broad noise at low frequency in one run: wind, a door, a pump; told from the other runs."""

from collections.abc import Sequence

import numpy as np

from identify.quality.findings import finding
from identify.quality.view import View
from identify.results import QualityFlag

TIMES = 5.0  # the other runs' rms
RELATIVE = 5e-3  # of the fundamental
BAND = 0.3  # of the fundamental's frequency


def low_frequency(view: View) -> float:
    """Rms of the inputs' mean between two bins and BAND of the run's frequency."""
    high = max(4, int(BAND * view.frequency_hz / view.bin_hz))
    power = np.abs(view.spectrum[:, 2:high].mean(axis=0)) ** 2
    return float(np.sqrt(power.sum() / 4))  # amplitude²/2 each, window's bandwidth two bins


def excess(views: Sequence[View]) -> list[QualityFlag]:
    """`excess_low_frequency`: a run's noise below its oscillation stands out of the campaign's."""
    if len(views) < 3:
        return []
    rms = np.array([low_frequency(v) for v in views])
    usual = float(np.median(rms))
    out = []
    for v, r in zip(views, rms, strict=True):
        if r > TIMES * usual and r > RELATIVE * float(v.level.max()):
            detail = (
                f"rms {r:.3g} below {BAND * v.frequency_hz:.0f} Hz, {r / usual:.1f} times that of "
                "the other runs; look for wind, doors, vibration"
            )
            out.append(finding(v.name, "excess_low_frequency", "noted", detail))
    return out
