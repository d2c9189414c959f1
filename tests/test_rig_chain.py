"""The measuring chain: filters, converter, clock, losses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import ellip, sosfreqz

from drivers.errors import DeviceLost
from drivers.types import OutputLimits, Tone
from simulated_rig import RigConfig, SimulatedRig, build_config, build_rig
from simulated_rig.campaigns import PlannedRun, settle_time, simulate_run
from simulated_rig.config import Converter, Interference
from simulated_rig.sensors import ELLIPTIC, Chain, ColouredNoise, quantised, resampling_taps

M = 5


def quiet(**converter: object) -> RigConfig:
    """No microphone noise, 24 bits, and the converter as asked."""
    config = build_config()
    microphones = tuple(replace(m, noise_pa=0.0) for m in config.microphones)
    chosen = replace(Converter(bits=24), **converter)  # type: ignore[arg-type]
    return replace(config, microphones=microphones, converter=chosen)  # type: ignore[arg-type]


def through(config: RigConfig, frequency_hz: float, seconds: float = 1.0) -> np.ndarray:
    """Complex amplitudes of the three channels for a tone of 100 Pa, 100 Pa and 1 V (sine)."""
    frames = round(seconds * 1e4) + 1000
    t = np.arange(frames * M) / (1e4 * M)
    wave = np.sin(2 * np.pi * frequency_hz * t)
    volts = Chain(config, M, 0).process(np.column_stack([100 * wave] * 2), wave)[1000:]
    turn = np.exp(-2j * np.pi * frequency_hz * (1000 + np.arange(frames - 1000)) / 1e4)
    return 2j * np.mean(volts * turn[:, None], axis=0) / np.array([0.2, 0.2, 1.0])


@pytest.mark.parametrize("frequency", [50.0, 170.0, 510.0, 1500.0])
def test_default_filter_is_a_common_delay(frequency: float) -> None:
    """12 frames for all channels; ripple 130 dB down, and 24-bit steps (6e-7 V of 0.2 V)."""
    expected = np.exp(-2j * np.pi * frequency * 12e-4)
    assert through(quiet(), frequency) == pytest.approx([expected] * 3, abs=1e-6)


def test_what_lies_above_the_stop_band_does_not_fold_back() -> None:
    """9 kHz would fold to 1 kHz. Amplitude at 9 kHz itself is asked for: the same samples."""
    found = through(quiet(), 9000.0)
    assert np.max(np.abs(found[:2])) < 3e-5


def test_elliptic_filter_has_the_thesis_poles_in_all_channels() -> None:
    order, ripple, stop, corner = ELLIPTIC
    sos = ellip(order, ripple, stop, corner, fs=1e4 * M, output="sos")
    for frequency in (170.0, 510.0, 1400.0, 2500.0):
        expected = sosfreqz(sos, [frequency], fs=1e4 * M)[1][0]
        found = through(quiet(antialias="elliptic"), frequency)
        delay = np.exp(-2j * np.pi * frequency * 12e-4)
        assert found == pytest.approx([expected * delay] * 3, abs=1e-4)
    assert abs(expected) < 10 ** (-stop / 20) * 1.01


def test_multiplexer_samples_each_channel_later() -> None:
    found = through(quiet(multiplex_s=2e-5), 170.0)
    step = 2 * np.pi * 170.0 * 2e-5
    assert np.angle(found / found[0]) == pytest.approx([0.0, step, 2 * step], abs=1e-6)


def test_filter_refuses_a_skew_beyond_its_reach() -> None:
    with pytest.raises(ValueError, match="delay"):
        resampling_taps(5, 4.5)


def test_converter_rounds_and_clips() -> None:
    converter = Converter(full_scale_v=10.0, bits=16)
    step = 10.0 / 32768
    found = quantised(np.array([0.0, 0.4 * step, 0.6 * step, 9.99999, 12.0, -12.0]), converter)
    assert found == pytest.approx([0.0, 0.0, step, 10.0 - step, 10.0 - step, -10.0], abs=1e-12)


def test_clipping_is_flagged() -> None:
    config = build_config()
    small = replace(config, converter=replace(config.converter, full_scale_v=0.3))
    with SimulatedRig(small) as rig:
        rig.start()
        assert "clipped" in rig.read(2000).flags
    with build_rig() as rig:
        rig.start()
        assert rig.read(2000).flags == frozenset()


def test_jitter_is_noise_in_proportion_to_the_slope() -> None:
    """rms of jitter · dv/dt: 2πf A σ/√2, from 1e4 samples known to 1 % (√(1/2n))."""
    sigma, frequency = 1e-6, 510.0
    plain, shaken = (
        Chain(quiet(jitter_s=j), M, 0).process(*_tone(frequency, 11000)) for j in (0.0, sigma)
    )
    expected = 2 * np.pi * frequency * 0.2 * sigma / np.sqrt(2)
    assert np.std((shaken - plain)[1000:, 0]) == pytest.approx(expected, rel=0.04)


def _tone(frequency_hz: float, frames: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(frames * M) / (1e4 * M)
    wave = np.sin(2 * np.pi * frequency_hz * t)
    return np.column_stack([100 * wave] * 2), wave


def test_a_wrong_clock_moves_the_free_frequency_the_other_way() -> None:
    """1 % too fast a clock: 1 % more frames a period, so the free cycle reads 1 % lower."""
    found = []
    for error in (0.0, 0.01):
        run = simulate_run(quiet(clock_error=error), PlannedRun("free"), [0])
        up = np.flatnonzero((run.velocity[:-1] < 0) & (run.velocity[1:] >= 0))
        v = run.velocity
        at = up - v[up] / (v[up + 1] - v[up])
        found.append((up.size - 1) / ((at[-1] - at[0]) / 1e4))
    assert found[0] == pytest.approx(169.713, abs=0.002)
    assert found[1] == pytest.approx(169.713 / 1.01, abs=0.002)


def test_amplifier_noise_reaches_the_tube_but_not_the_record() -> None:
    run = PlannedRun("cold", 168.0, 0.0001, duration_s=0.5)
    config = quiet()
    loud = replace(config, amplifier_noise_v=0.1)
    without, with_noise = (simulate_run(c, run, [1]) for c in (config, loud))
    assert np.array_equal(without.drive, with_noise.drive)
    assert np.std(with_noise.velocity) > 10 * np.std(without.velocity)


def test_interference_is_in_both_channels_as_told() -> None:
    hum = Interference(50.0, 3.0, share2=0.5)
    config = replace(quiet(), interference=(hum,))
    volts = Chain(config, M, 0).process(np.zeros((50000, 2)), np.zeros(50000))
    turn = np.exp(-2j * np.pi * 50.0 * np.arange(10000) / 1e4)
    found = np.abs(2 * np.mean(volts * turn[:, None], axis=0)) / 0.002
    assert found[:2] == pytest.approx([3.0, 1.5], rel=1e-4)


def test_coloured_noise_has_unit_variance_and_its_corner() -> None:
    """Correlation after one sample is e^{−2πf/fs}; 4e5 samples at 100 correlated: 2 %."""
    noise = ColouredNoise(np.random.default_rng(2), 100.0, 10000.0)
    values = np.concatenate([noise.take(n) for n in (1, 999, 399000)])
    assert np.var(values) == pytest.approx(1.0, rel=0.05)
    lag = np.mean(values[1:] * values[:-1]) / np.var(values)
    assert lag == pytest.approx(np.exp(-2 * np.pi * 0.01), abs=2e-3)


def test_lost_frames_show_as_a_gap_and_nothing_is_joined_over_it() -> None:
    with build_rig(seed=2) as rig:
        rig.start()
        rig.read(150)
        rig.drop_frames(250)
        after = rig.read(500)
        assert "gap" in after.flags
        assert after.first_frame == 500  # 200 were sampled, 300 lost (whole quanta of 100)
        status = rig.status()
        assert (status.lost_frames, len(status.gaps), status.xruns) == (300, 1, 1)
        assert rig.read(100).flags == frozenset()
    with build_rig(seed=2) as same:
        same.start()
        whole = same.read(1000).samples
    # The plant does not notice what the converter loses.
    assert np.array_equal(after.samples[:, :2].round(9).shape, whole[500:, :2].shape)


def test_random_drops_come_at_their_rate() -> None:
    config = build_config()
    config = replace(config, converter=replace(config.converter, drops_per_s=5.0))
    with SimulatedRig(config, seed=3) as rig:
        rig.start()
        for _ in range(20):
            rig.read(1000)
        status = rig.status()
    seconds = status.frames / 1e4
    # Poisson with mean 5 a second over at least 2 s: 3 σ.
    assert abs(status.lost_frames / 100 - 5 * seconds) < 3 * np.sqrt(5 * seconds) + 1


def test_unplugging_silences_and_is_told() -> None:
    limits = OutputLimits(max_amplitude_v=1.0)
    with build_rig(limits=limits) as rig:
        rig.start()
        rig.drive(Tone(170.0, 0.5))
        rig.read(1000)
        rig.unplug()
        with pytest.raises(DeviceLost, match="unplugged"):
            rig.read(1)
        with pytest.raises(DeviceLost, match="unplugged"):
            rig.drive(Tone(170.0, 0.5))
        rig.silence()
        status = rig.status()
        assert (status.running, status.output_v) == (False, 0.0)
        assert status.fault is not None
        rig.replug()
        rig.start()
        assert np.max(np.abs(rig.read(100).samples[:, 2])) == 0.0


def test_flame_off_and_on() -> None:
    """Off: e^{−ζωt} with ζω = 10.6/s, so 1.5 s leave 1e-7 (the noise); on: the cycle again."""
    with SimulatedRig(quiet()) as rig:
        rig.start()
        loud = np.std(rig.read(5000).samples[:, 0])
        rig.flame_off()
        rig.read(15000)
        assert np.std(rig.read(5000).samples[:, 0]) < 1e-3 * loud
        rig.flame_on()
        rig.read(60000)
        assert np.std(rig.read(5000).samples[:, 0]) == pytest.approx(loud, rel=0.01)


def test_frames_wait_while_nobody_reads_and_time_goes_on() -> None:
    with build_rig(seed=5) as rig:
        rig.start()
        rig.clock.sleep(1.0)
        assert rig.status().frames == 10000
        before = rig.clock.now()
        block = rig.read(10000)
        assert (block.first_frame, block.flags) == (0, frozenset())
        assert rig.clock.now() == before


def test_real_time_keeps_up() -> None:
    """Half a second of frames takes half a second of wall time, give or take a quantum."""
    with build_rig(clock="realtime", seed=1) as rig:
        rig.start()
        start = rig.clock.now()
        block = rig.read(5000, timeout_s=5.0)
        took = rig.clock.now() - start
    assert block.frames == 5000
    assert 0.45 < took < 2.0


def test_settling_with_a_wrong_clock_still_locks() -> None:
    assert settle_time(quiet(clock_error=1e-3), PlannedRun("forced", 168.0, 1.0)) is not None
