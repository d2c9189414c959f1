"""Calibrations against signals made with known gains, delays and phases, and a real exchange."""

import math
import os
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import signal

from daq.acquire import Acquisition
from daq.calibration import (
    Calibration,
    CalibrationBook,
    exchange_calibration,
    inter_channel_skew,
    pistonphone,
    stepped_sine,
    sweep,
    tolerable_skew,
)
from daq.conduct import find_columns
from daq.errors import CorruptFile, InputError
from daq.records import RunHeader
from daq.store_writer import RunWriter
from daq.two_microphones import validity
from drivers.types import Channel
from identify.load import advanced, load_run
from simulated_rig.build import build_rig
from simulated_rig.rig import SimulatedRig

RATE = 20_000.0
MEASURED = Path(
    os.environ.get(
        "ENTRAIN_MEASURED_DATA", Path(__file__).resolve().parents[2] / "shared" / "measured"
    )
)


def delayed(x: np.ndarray, seconds: float, rate_hz: float = RATE) -> np.ndarray:
    """Circular delay by a phase ramp: exact for what it is, a band-limited periodic signal."""
    f = np.fft.rfftfreq(x.size, 1 / rate_hz)
    return np.asarray(np.fft.irfft(np.fft.rfft(x) * np.exp(-2j * np.pi * f * seconds), x.size))


def noise(size: int, seed: int) -> np.ndarray:
    """White noise below 0.35 of the rate, so that fractional delays are well defined."""
    x = np.random.default_rng(seed).standard_normal(size)
    b = signal.firwin(201, 0.7)
    return np.asarray(signal.lfilter(b, 1.0, x))


# -- pistonphone ---------------------------------------------------------------------------------


def test_pistonphone_gives_the_sensitivity() -> None:
    t = np.arange(40_000) / RATE
    pascals = math.sqrt(2) * 20e-6 * 10 ** (94 / 20)  # 94 dB: 1.002 Pa rms
    assert pascals / math.sqrt(2) == pytest.approx(1.0024, abs=1e-3)
    volts = 0.05 * pascals * np.sin(2 * np.pi * 1000.3 * t) + 1e-4 * noise(t.size, 1)
    found = pistonphone(volts, RATE, "SN7", level_sigma_db=0.1)
    assert found.value == pytest.approx(0.05, rel=1e-4)
    # 0.1 dB is ln(10)/20 · 0.1 = 1.15 %; the scatter adds nothing visible
    assert found.uncertainty == pytest.approx(0.0115, rel=0.02)
    assert found.unit == "V/Pa"


def test_pistonphone_refuses_the_wrong_tone() -> None:
    t = np.arange(40_000) / RATE
    with pytest.raises(InputError, match=r"250\.0 Hz, not at the calibrator's 1000 Hz"):
        pistonphone(np.sin(2 * np.pi * 250 * t), RATE, "SN7")
    with pytest.raises(InputError, match="too short"):
        pistonphone(np.sin(2 * np.pi * 1000 * t[:900]), RATE, "SN7")
    with pytest.raises(InputError, match="varies"):
        pistonphone(np.sin(2 * np.pi * 1000 * t) * (1 + 0.3 * t), RATE, "SN7")


# -- exchange ------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [2e-5, 2e-4])
def test_exchange_separates_microphone_from_field(delay_s: float) -> None:
    """Channel b: gain 0.8 and a delay; the longer one turns by 90° at 1.25 kHz and by far more
    above, where the principal root would flip its sign."""
    size = 200_000
    source = noise(size, 2)
    field = delayed(source, 7e-5) * 0.6 + 0.3 * delayed(source, 3e-4)
    direct = (source, 0.8 * delayed(field, delay_s))
    exchanged = (field, 0.8 * delayed(source, delay_s))
    found = exchange_calibration(direct, exchanged, RATE)
    for frequency in (200.0, 600.0, 2000.0, 4000.0):
        ratio, sigma = found.at(frequency, width_hz=20.0)
        expected = 0.8 * np.exp(-2j * np.pi * frequency * delay_s)
        # noise-free: what is left is the leakage of the segments (Hann, 4096 samples, delays of
        # up to 6 samples: relative bias below 1 %)
        assert abs(ratio / expected - 1) < 0.01
        assert sigma < 0.02


def test_exchange_needs_common_sound() -> None:
    a, b = noise(50_000, 3), noise(50_000, 4)
    with pytest.raises(InputError, match="coherence stays below"):
        exchange_calibration((a, b), (b, a), RATE, least_coherence=0.9)
    with pytest.raises(InputError, match="equal lengths"):
        exchange_calibration((a[:100], b[:100]), (b, a), RATE)


@pytest.mark.shared
@pytest.mark.skipif(not MEASURED.exists(), reason="../shared/measured is not here")
def test_exchange_on_a_real_impedance_tube() -> None:
    """Two condenser microphones of one make: their ratio is smooth and close to one, although
    the field's ratio between the places swings from 0.2 to 5 and through all phases."""
    recordings = []
    for name in ("empty_00_11_22_33_44_55", "empty_01_10_22_33_44_55"):
        with h5py.File(MEASURED / "impedance_tube" / f"{name}.h5") as file:
            data = np.asarray(file["time_data"][:, :2], dtype=np.float64)
            rate = float(file["time_data"].attrs["sample_freq"])
        recordings.append((data[:, 0], data[:, 1]))
    found = exchange_calibration(recordings[0], recordings[1], rate)
    band = (found.frequency_hz > 300) & (found.frequency_hz < 3000) & (found.coherence > 0.97)
    assert band.sum() > 50
    assert np.all(np.abs(np.angle(found.ratio[band])) < 0.15)  # same make: no branch flip anywhere
    assert np.all(np.abs(np.abs(found.ratio[band]) - 1.08) < 0.12)
    pieces = [found.at(f, 50.0)[0] for f in (400.0, 800.0, 1600.0, 2500.0)]
    assert np.ptp(np.abs(pieces)) < 0.08


# -- skew ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("skew_s", [0.0, 2e-5, -3.3e-5, 7.1e-4])
def test_skew_to_a_small_part_of_a_sample(skew_s: float) -> None:
    source = noise(100_000, 5)
    rng = np.random.default_rng(6)
    second = 1.3 * delayed(source, skew_s) + 0.01 * rng.standard_normal(source.size)
    found = inter_channel_skew(source, second, RATE)
    assert found.sigma < 2e-7
    assert found.seconds == pytest.approx(skew_s, abs=max(5 * found.sigma, 2e-8))
    assert found.gain == pytest.approx(1.3, rel=0.01)


def test_skew_needs_a_common_signal() -> None:
    with pytest.raises(InputError, match="no common signal"):
        inter_channel_skew(noise(50_000, 7), noise(50_000, 8), RATE)


def test_tolerable_skew_is_what_the_velocity_allows() -> None:
    # physics.md §3: 20 µs over 5.08 cm at 343 m/s costs c·τ/s = 13.5 % of the velocity
    assert 2e-5 / tolerable_skew(0.0508, 343.0, 1.0) == pytest.approx(0.135, abs=0.001)


def test_a_known_skew_is_taken_out_at_analysis(tmp_path: Path) -> None:
    t = np.arange(4000) / RATE
    skew = 3.3e-5
    tone = np.sin(2 * np.pi * 170 * t)
    late = np.sin(2 * np.pi * 170 * (t - skew))
    header = RunHeader(
        "r", "free", RATE, (Channel("p1", "pressure", "Pa"), Channel("p2", "pressure", "Pa")),
        dtype="float64", skew_s=(0.0, skew),
    )  # fmt: skip
    with RunWriter(tmp_path / "r.h5", header, "c") as writer:
        writer.append(np.stack([tone, late], axis=1))
        writer.finish()
    run = load_run(tmp_path / "r.h5")
    np.testing.assert_array_equal(run.signals["p1"].values, tone)
    # eight-point Lagrange at 170 Hz of 20 kHz: error below 1e-12; the last points see the edge
    np.testing.assert_allclose(run.signals["p2"].values[8:-8], tone[8:-8], atol=1e-9)
    np.testing.assert_allclose(advanced(advanced(tone, 0.7), -0.7)[20:-20], tone[20:-20], atol=1e-9)


# -- frequency response --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cold() -> Iterator[SimulatedRig]:
    """The tube without its flame: a linear system from drive to pressure."""
    with build_rig(seed=2) as rig:
        rig.flame_off()
        rig.start()
        yield rig


def test_sweep_and_stepped_sine_agree(cold: SimulatedRig) -> None:
    """At 300 … 400 Hz the modes are broad (ζ = 0.05 at 281 Hz): both must see the same response;
    the sweep's segments of 1 s smear it by less than 3 %."""
    acquisition = Acquisition(cold)
    columns = find_columns(acquisition)
    steps = stepped_sine(acquisition, columns, [310.0, 350.0, 390.0], 0.5, seconds=0.4)
    swept = sweep(acquisition, columns, 250.0, 450.0, 0.5, seconds=8.0)
    acquisition.read_seconds(0.1)
    assert cold.status().output_v == 0.0
    for frequency, response in zip(steps.frequency_hz, steps.response, strict=True):
        near = np.interp(frequency, swept.frequency_hz, np.abs(swept.response))
        assert near == pytest.approx(abs(response), rel=0.05)
    assert np.all(steps.sigma < 1e-2 * np.abs(steps.response))


# -- the book ------------------------------------------------------------------------------------


def test_book_applies_the_newest_and_names_what_is_stale_or_missing(tmp_path: Path) -> None:
    book = CalibrationBook(tmp_path / "calibrations")
    now = datetime(2026, 6, 1, tzinfo=UTC)
    old = (now - timedelta(days=400)).isoformat()
    new = (now - timedelta(days=3)).isoformat()
    book.add(Calibration("SN1", "pistonphone", 0.0021, 0.01, "V/Pa", at=old))
    book.add(Calibration("SN1", "pistonphone", 0.0022, 0.01, "V/Pa", at=new))
    book.add(Calibration("SN2", "pistonphone", 0.0019, 0.01, "V/Pa", at=old))
    book.add(Calibration("p2", "skew", 2e-5, 1e-7, "s", at=new))
    book.add(Calibration("drive", "pistonphone", 0.1, 0.01, "V/Pa", at=new))  # a voltage has none
    channels = [
        Channel("p1", "pressure", "Pa", 0.002, serial_number="SN1"),
        Channel("p2", "pressure", "Pa", 0.002, serial_number="SN2"),
        Channel("p3", "pressure", "Pa", 0.002),
        Channel("drive", "voltage", "V"),
    ]
    applied, skews, remarks = book.apply(channels, now)
    assert [channel.volts_per_unit for channel in applied] == [0.0022, 0.0019, 0.002, 1.0]
    assert skews == (0.0, 2e-5, 0.0, 0.0)
    assert len(remarks) == 2
    assert "p2: pistonphone of 2025-04-27 is stale" in remarks
    assert "p3: no calibration of 'p3', nominal value used" in remarks
    assert book.newest("SN1", "exchange") is None
    (book.folder / "broken.json").write_text("{}")
    with pytest.raises(CorruptFile, match=r"broken\.json"):
        book.all()


def test_two_microphone_validity() -> None:
    """research.md: 180 Hz and two harmonics above at 350 m/s need 0.097 … 0.249 m."""
    found = validity(0.6604, 0.7112, 180.0, 3, 350.0)
    assert found.outside == (1,)
    assert found.better_spacing_m is not None
    assert found.better_spacing_m[0] == pytest.approx(0.0972, abs=2e-4)
    assert found.better_spacing_m[1] == pytest.approx(0.2593, abs=2e-4)
    assert found.remark is not None
    assert "50.8 mm" in found.remark
    assert validity(0.0, 0.15, 180.0, 3, 350.0).remark is None
    none = validity(0.0, 0.15, 180.0, 12, 350.0)
    assert none.better_spacing_m is None
    assert "three or more microphones" in (none.remark or "")
