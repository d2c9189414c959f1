"""Characterisation of recordings without forcing: measured ones, and simulated with known truth."""

import json
import os
from pathlib import Path

import numba
import numpy as np
import numpy.typing as npt
import pytest

from identify.characterise import (
    RecordingError,
    characterise,
    characterise_file,
    figure,
    identify_envelope,
    read_text,
)
from identify.characterise.envelope import demodulate

MEASURED = Path(
    os.environ.get(
        "ENTRAIN_MEASURED_DATA", Path(__file__).resolve().parents[2] / "shared" / "measured"
    )
)
COMBUSTOR = MEASURED / "combustor"


@numba.njit(cache=False)
def _van_der_pol(  # type: ignore[no-untyped-def]
    nu, kappa, noise, frequency_hz, rate, kicks
):  # pragma: no cover - compiled
    """y'' + ω²y = (2ν − 8κ y²)·y' + 2ω√D·ξ: averages to dA = (νA − κA³ + D/A)dt + √(2D)dW."""
    w = 2 * np.pi * frequency_hz
    count, sub = kicks.shape
    h = 1 / rate / sub
    y, v = 0.0, 0.0
    out = np.empty(count)
    for i in range(count):
        for j in range(sub):
            kick = 2 * w * np.sqrt(noise * h) * kicks[i, j]
            v += h * (-w * w * y + (2 * nu - 8 * kappa * y * y) * v) + kick
            y += h * v
        out[i] = y
    return out[int(rate) :]


def _simulated(nu: float, kappa: float, noise: float, seed: int) -> npt.NDArray[np.float64]:
    kicks = np.random.default_rng(seed).standard_normal((16_000, 8))
    return np.asarray(_van_der_pol(nu, kappa, noise, 120.0, 4000.0, kicks))


@pytest.mark.parametrize(
    ("nu", "kappa", "noise"),
    [(-25.0, 1.0, 1.0), (3.0, 20.0, 1.0), (15.0, 15.0, 0.15)],
    ids=["damped", "near onset", "limit cycle"],
)
def test_growth_rate_intervals_cover_the_truth(nu: float, kappa: float, noise: float) -> None:
    """16 records of 3 s: mean of z within 1, spread at most 1.4, noise intensity within 25 %.

    z = (estimate − truth)/stderr. For unit-normal z the mean of 16 has standard deviation 0.25, so
    |mean| < 1 is four of them, less what second-order filter bias takes; the spread of 16 normal
    values exceeds 1.4 with probability 1 %, and the seeds are fixed. D of one record is known to
    √(2·2T_c/T) ≈ 15 %, its median over 16 to 5 %; the rest is for the filter's second order.
    """
    z, ratios = [], []
    for seed in range(16):
        y = _simulated(nu, kappa, noise, seed)
        envelope = np.abs(demodulate(y, 4000.0, 120.0, 40.0))[100:-100]
        mode = identify_envelope(envelope, 1 / 4000.0, 40.0)
        growth = mode.growth_rate_per_s
        z.append((growth.value - nu) / growth.stderr)
        ratios.append(mode.noise_intensity.value / noise)
    assert abs(np.mean(z)) < 1
    assert np.std(z) < 1.4
    assert np.median(ratios) == pytest.approx(1, abs=0.25)


def test_pure_tone_with_harmonics_is_a_limit_cycle_with_them() -> None:
    """Amplitudes 1, 0.05, 0.2 at 170, 340, 510 Hz: −26.02 and −13.98 dB, phase +30° by closed form.

    White noise of 0.01 leaves z about 0.01·√(2·band/rate), so the mean is known to about 1e-4 and
    a level of 0.05 to 0.02 dB; 0.1 dB is five of them.
    """
    rng = np.random.default_rng(7)
    t = np.arange(20_000) / 5000.0
    tone = 2 * np.pi * 170.0 * t
    signal = np.cos(tone) + 0.05 * np.cos(2 * tone) + 0.2 * np.cos(3 * tone + 1.0)
    light = 0.3 * np.cos(tone + np.pi / 6)
    result = characterise(
        signal + 0.01 * rng.standard_normal(t.size),
        5000.0,
        {"light": light + 0.01 * rng.standard_normal(t.size)},
    )
    assert result.regime == "limit_cycle"
    assert result.frequency_hz.value == pytest.approx(170.0, abs=0.01)
    assert result.amplitude.value == pytest.approx(1.0, abs=2e-3)
    assert result.harmonics_db[1:3] == pytest.approx([-26.02, -13.98], abs=0.1)
    assert result.phase_deg["light"].value == pytest.approx(30.0, abs=0.2)
    assert result.saturation_parity == "odd"


def test_driven_damped_mode_is_noise_and_noise_driven_cycle_is_not() -> None:
    assert characterise(_simulated(-25.0, 0.0, 1.0, 3), 4000.0).regime == "noise"
    assert characterise(_simulated(25.0, 25.0, 0.1, 3), 4000.0).regime == "limit_cycle"


FACTS = {  # measured/README.md
    "p3": ("noise", None, None),
    "p8": ("intermittent", (90.0, 4.0), None),
    "p16": ("limit_cycle", (109.6, 0.4), (0.276, 0.006)),
    "p19": ("limit_cycle", (120.0, 7.0), None),
    "p21": ("limit_cycle", (120.0, 3.0), None),
}


@pytest.mark.shared
@pytest.mark.skipif(not COMBUSTOR.is_dir(), reason=f"{COMBUSTOR} is missing")
@pytest.mark.parametrize("name", sorted(FACTS))
def test_combustor_facts(name: str, tmp_path: Path) -> None:
    """Regime, frequency, amplitude and harmonics as the data's README states them."""
    path = COMBUSTOR / f"{name}.txt"
    result = characterise_file(path)
    regime, frequency, amplitude = FACTS[name]
    assert result.regime == regime
    assert result.sample_rate_hz == pytest.approx(10_000.0, rel=1e-6)
    if frequency is not None:
        assert result.frequency_hz.value == pytest.approx(frequency[0], abs=frequency[1])
    if amplitude is not None:
        assert result.amplitude.value == pytest.approx(amplitude[0], abs=amplitude[1])
    if name in {"p19", "p21"}:
        assert result.harmonics_db[2] > result.harmonics_db[1]
    answer = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert answer["format"] == "characterisation/1"
    assert set(answer["phase_deg"]) == {"light"}
    written = tmp_path / f"{name}.png"
    drawing = figure(result, read_text(path).signals["pressure"], written, title=name)
    assert written.stat().st_size > 10_000
    assert all(axes.get_xlabel() and axes.get_ylabel() for axes in drawing.axes)


def test_quantised_labview_clock_gives_the_rate(tmp_path: Path) -> None:
    """3.5e9 s in a double has steps of 2⁻²¹ s; the slope over 5000 rows knows the rate to 1e-7."""
    time = 3.5065e9 + np.arange(5000) * 1.23e-4
    signal = np.sin(np.arange(5000))
    path = tmp_path / "run.txt"
    path.write_text("".join(f"{t:.16E}\t{y:.9e}\n" for t, y in zip(time, signal, strict=True)))
    recording = read_text(path)
    assert recording.sample_rate_hz == pytest.approx(1 / 1.23e-4, rel=1e-7)
    assert list(recording.signals) == ["pressure"]
    assert recording.started_unix_s == pytest.approx(3.5065e9 - 2_082_844_800.0, abs=1e-3)
    np.testing.assert_allclose(recording.signals["pressure"], signal, atol=1e-9)


def test_missing_rows_and_wrong_names_are_refused(tmp_path: Path) -> None:
    rows = [f"{i * 1e-3},{np.sin(i)},{np.cos(i)}" for i in range(1000)]
    path = tmp_path / "run.csv"
    path.write_text("time,light,pressure\n" + "\n".join(rows[:500] + rows[510:]))
    with pytest.raises(RecordingError, match="missing or repeated"):
        read_text(path)
    path.write_text("time,light,pressure\n" + "\n".join(rows))
    assert list(read_text(path).signals) == ["light", "pressure"]
    with pytest.raises(RecordingError, match="not 2 different names"):
        read_text(path, names=["pressure"])
    with pytest.raises(RecordingError, match="time column"):
        read_text(path, sample_rate_hz=500.0)


@pytest.mark.parametrize(
    ("signal", "message"),
    [(np.ones(1000), "varying"), (np.full(1000, np.nan), "finite"), (np.ones((500, 2)), "channel")],
)
def test_unusable_signals_are_named(signal: npt.NDArray[np.float64], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        characterise(signal, 1000.0)
