"""Making flags, in one voice: numbers first, then what to do."""

from typing import Literal

import numpy as np

from identify.results import QualityFlag

Severity = Literal["noted", "down_weighted", "excluded"]


def finding(
    run: str,
    flag: str,
    severity: Severity,
    detail: str,
    harmonics: tuple[int, ...] = (),
    error: float = 0.0,
) -> QualityFlag:
    return QualityFlag(run, flag, detail, severity, harmonics, error)


def decibel(ratio: float) -> float:
    """20 log10 of an amplitude ratio; a zero is −400 dB."""
    return float(20 * np.log10(max(ratio, 1e-20)))
