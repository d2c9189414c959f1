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


def _lost(y: FloatArray, samples: int = 3) -> FloatArray:
    return np.r_[y[:3000], y[3000 + samples :], y[:samples]]


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


def _sweep(samples: int, times: int) -> FloatArray:
    """Up from 30 to 130 Hz and down again, so many times."""
    up = np.linspace(0.0, 1.0, samples // (2 * times), endpoint=False)
    hz = np.tile(30.0 + 100.0 * np.r_[up, 1.0 - up], times)
    return np.asarray(0.02 * np.sin(2 * np.pi * np.cumsum(hz) / RATE))


def _flagged(lost: int, cubic: float, times: int = 2) -> tuple[list[str], list[str], str]:
    """What excludes such a sweep, what is claimed of it, and the verdict."""
    u = _sweep(4 * PERIOD, times)
    y = duffing_output(u, cubic=cubic)
    y = y + 3e-4 * np.random.default_rng(8).standard_normal(y.size)
    found = _diagnosed(u, _lost(y, lost))
    excluded = [q.flag for q in found.quality if q.severity == "excluded"]
    return excluded, [w.score.candidate.kind for w in found.claims], found.verdict


@pytest.mark.parametrize(("cubic", "times"), [(12.0, 2), (12.0, 1), (24.0, 1)])
def test_a_sweep_past_a_bent_resonance_has_lost_no_samples(cubic: float, times: int) -> None:
    assert _flagged(0, cubic, times) == ([], ["cubic"], "traced")


@pytest.mark.parametrize("cubic", [6.0, 12.0])
def test_a_sweep_of_which_a_sample_is_lost(cubic: float) -> None:
    assert _flagged(1, cubic) == (["dropped_samples"], [], "unexplained")


def test_a_record_that_no_model_follows_is_not_explained() -> None:
    """The linear oscillator had ended where it says nothing of the response, and what it leaves
    did not follow such a motion: no discrepancy. It is started from elsewhere too."""
    *_, verdict = _flagged(3, 6.0)
    assert verdict == "unexplained"
