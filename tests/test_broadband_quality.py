"""Spoilt broadband recordings: named, and never taken for an effect."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from identify.broadband import BroadbandDiagnosis, diagnose_broadband
from tests.broadband_material import RATE, duffing_output, multisine

FloatArray = npt.NDArray[np.float64]
PERIOD = 2048


def _record(cubic: float) -> tuple[FloatArray, FloatArray]:
    u = np.concatenate([multisine(PERIOD, seed) for seed in (1, 2, 3, 4)])
    y = duffing_output(u, cubic=cubic)
    return u, y + 3e-4 * np.random.default_rng(8).standard_normal(y.size)


def _diagnosed(u: FloatArray, y: FloatArray) -> BroadbandDiagnosis:
    return diagnose_broadband(
        u, y, RATE, declared="linear", title="one",
        estimation=slice(300, 3 * PERIOD), test=slice(3 * PERIOD, 4 * PERIOD),
    )  # fmt: skip


def _clipped(y: FloatArray) -> FloatArray:
    return np.clip(y, -2.0 * y.std(), 2.0 * y.std())


def _held(y: FloatArray) -> FloatArray:
    out = y.copy()
    for start in range(1000, 6000, 1000):
        out[start : start + 8] = out[start]
    return out


def _repeated(y: FloatArray) -> FloatArray:
    out = y.copy()
    out[2100:2200] = out[2000:2100]
    return out


def _lost(y: FloatArray) -> FloatArray:
    return np.r_[y[:3000], y[3003:], y[:3]]


def _knocked(y: FloatArray) -> FloatArray:
    out = y.copy()
    out[3000:3040] += 0.2 * y.std() * np.random.default_rng(2).standard_normal(40)
    return out


def _hum(y: FloatArray) -> FloatArray:
    return y + 0.03 * y.std() * np.sin(2 * np.pi * 50 / RATE * np.arange(y.size))


def _dead(y: FloatArray) -> FloatArray:
    return 1e-4 * np.random.default_rng(1).standard_normal(y.size)


@pytest.mark.parametrize(
    ("spoil", "flag", "severity", "verdict"),
    [
        (_clipped, "clipped", "excluded", "unexplained"),
        (_held, "repeated_samples", "excluded", "unexplained"),
        (_repeated, "repeated_samples", "excluded", "unexplained"),
        (_lost, "dropped_samples", "excluded", "unexplained"),
        (_knocked, "uneven_residual", "noted", "unexplained"),
        (_dead, "dead_channel", "excluded", "unexplained"),
        (_hum, "mains_hum", "noted", "no_discrepancy"),
    ],
)
def test_a_spoilt_recording_is_named_and_nothing_is_claimed(
    spoil: Callable[[FloatArray], FloatArray], flag: str, severity: str, verdict: str
) -> None:
    u, y = _record(cubic=0.0)
    found = _diagnosed(u, spoil(y))
    assert (flag, severity) in [(q.flag, q.severity) for q in found.quality]
    assert found.verdict == verdict
    assert found.claims == ()


def test_swapped_channels_are_named() -> None:
    u, y = _record(cubic=0.0)
    found = _diagnosed(y, u)
    assert [q.flag for q in found.quality if q.severity == "excluded"] == ["dead_channel"]
    assert found.claims == ()


@pytest.mark.parametrize("cubic", [0.0, 4.0])
def test_a_sound_recording_has_no_flags(cubic: float) -> None:
    """And hum beside an effect does not hide it."""
    u, y = _record(cubic)
    assert _diagnosed(u, y).quality == ()
    kinds = ["cubic"] if cubic else []
    assert [w.score.candidate.kind for w in _diagnosed(u, _hum(y)).claims] == kinds
