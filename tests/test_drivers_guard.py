"""The oscillator and the output's rule, on time that the test itself turns on."""

import math
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import InterlockOpen, SettingError
from drivers.guard import OutputGuard
from drivers.oscillator import Oscillator, Scratch, advance, retune
from drivers.types import FloatArray, OutputLimits, Tone

RATE = 8000.0
BLOCK = 80  # 10 ms
LIMITS = OutputLimits(
    max_amplitude_v=2.0, max_slew_v_per_s=10.0, dead_man_s=1.0, max_frequency_hz=3000.0
)


class Bench:
    """A guard, and a clock that follows the frames it renders."""

    def __init__(self, limits: OutputLimits = LIMITS) -> None:
        self.now = 0.0
        self.guard = OutputGuard(limits, RATE, lambda: self.now, max_frames=BLOCK)

    def run(self, seconds: float, feed: bool = True) -> FloatArray:
        parts = []
        for _ in range(round(seconds * RATE / BLOCK)):
            if feed:
                self.guard.feed()
            parts.append(self.guard.render(BLOCK).copy())
            self.now += BLOCK / RATE
        return np.concatenate(parts)


# -- oscillator --------------------------------------------------------------------------------


@given(
    frequency=st.floats(1.0, 3000.0),
    sizes=st.lists(st.integers(1, 400), min_size=1, max_size=8),
)
@settings(max_examples=40, deadline=None)
def test_blocks_of_any_size_make_the_closed_form_sine(frequency: float, sizes: list[int]) -> None:
    """Against sin(2πf n/fs) directly; the phase is exact to 2π·ε·(cycles), far below 1e-9."""
    state = Oscillator(frequency_hz=frequency, amplitude_v=1.0, target_v=1.0)
    parts = []
    for size in sizes:
        state, samples = advance(state, size, RATE)
        parts.append(samples)
    n = np.arange(sum(sizes))
    expected = np.sin(2 * np.pi * frequency * n / RATE)
    assert np.max(np.abs(np.concatenate(parts) - expected)) < 1e-9


def test_phase_is_exact_after_a_day() -> None:
    """1.5e7 cycles: f·n/fs rounds to 2e-9 of a cycle, 1.2e-8 rad."""
    day = round(86400 * RATE)
    state = Oscillator(frequency_hz=171.3, amplitude_v=1.0, target_v=1.0, frame=day)
    _, samples = advance(state, 100, RATE)
    cycles = np.array([(1713 * (day + n)) % (10 * 8000) / (10 * 8000) for n in range(100)])
    assert np.max(np.abs(samples - np.sin(2 * np.pi * cycles))) < 2e-8


@given(changes=st.lists(st.tuples(st.floats(20, 1000), st.floats(0, 1)), max_size=6))
@settings(max_examples=40, deadline=None)
def test_changes_are_continuous_in_phase_and_amplitude(changes: list[tuple[float, float]]) -> None:
    """|y(n+1) − y(n)| ≤ (2π f_max A_max + slew)/fs: the steepest sine plus the ramp."""
    state, parts = Oscillator(), []
    for frequency, target in changes:
        state = retune(state, RATE, target_v=target, slew_v_per_s=20.0, frequency_hz=frequency)
        state, samples = advance(state, 333, RATE)
        parts.append(samples)
    joined = np.concatenate([*parts, np.zeros(0)])
    bound = (2 * np.pi * 1000 + 20) / RATE
    assert joined.size < 2 or np.max(np.abs(np.diff(joined))) <= bound + 1e-12


def test_advance_leaves_its_argument_alone_and_writes_where_told() -> None:
    state = Oscillator(frequency_hz=100.0, target_v=1.0, slew_v_per_s=10.0)
    out, scratch = np.full(64, np.nan), Scratch(64)
    later, samples = advance(state, 64, RATE, out, scratch)
    assert samples is out
    assert (state.frame, later.frame) == (0, 64)
    assert np.array_equal(out, advance(state, 64, RATE)[1])


# -- limits ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tone", "text"),
    [
        (Tone(170.0, 2.001), "amplitude_v=2.001"),
        (Tone(19.0, 1.0), "frequency_hz=19"),
        (Tone(3001.0, 1.0), "frequency_hz=3001"),
    ],
)
def test_refuses_and_keeps_what_sounds(tone: Tone, text: str) -> None:
    bench = Bench()
    bench.guard.drive(Tone(170.0, 1.0))
    bench.run(0.5)
    with pytest.raises(SettingError, match=text):
        bench.guard.drive(tone)
    assert np.max(np.abs(bench.run(0.5))) == pytest.approx(1.0, rel=1e-2)


def test_refuses_above_half_the_rate() -> None:
    guard = OutputGuard(OutputLimits(2.0, max_frequency_hz=9000.0), RATE, lambda: 0.0)
    with pytest.raises(SettingError, match="half the sample rate"):
        guard.drive(Tone(4000.0, 1.0))


def test_refuses_a_block_longer_than_it_was_made_for() -> None:
    with pytest.raises(SettingError, match="frames=81"):
        Bench().guard.render(BLOCK + 1)


@given(amplitudes=st.lists(st.floats(0.0, 2.0), min_size=1, max_size=6))
@settings(max_examples=30, deadline=None)
def test_ramps_no_faster_than_the_slew(amplitudes: list[float]) -> None:
    bench = Bench()
    seen = [bench.guard.output_v]
    for amplitude in amplitudes:
        bench.guard.drive(Tone(170.0, amplitude))
        for _ in range(7):
            bench.run(0.01)
            seen.append(bench.guard.output_v)
    assert np.max(np.abs(np.diff(seen))) <= LIMITS.max_slew_v_per_s * 0.01 + 1e-12


# -- silence -----------------------------------------------------------------------------------


def loud(bench: Bench, amplitude: float = 2.0) -> None:
    bench.guard.drive(Tone(170.0, amplitude))
    bench.run(0.5)
    assert bench.guard.output_v == amplitude


def test_silence_is_reached_within_its_ramp() -> None:
    bench = Bench()
    loud(bench)
    bench.guard.silence()
    assert np.max(np.abs(bench.run(0.02)[:40])) > 0.5  # a ramp, not a click
    assert np.all(bench.run(0.1) == 0.0)
    assert bench.guard.muted is None  # as wished


def test_dead_man_falls_and_only_a_new_drive_wakes_it() -> None:
    bench = Bench()
    loud(bench)
    assert np.max(np.abs(bench.run(0.9, feed=False))) == pytest.approx(2.0, rel=1e-2)
    bench.run(0.2, feed=False)
    assert np.all(bench.run(0.1, feed=True) == 0.0)
    assert bench.guard.muted == "dead man: not fed for more than 1.0 s"
    loud(bench)
    assert bench.guard.muted is None


def test_a_request_overtaken_by_a_silence_is_dropped() -> None:
    """The silence falls while `drive` is between its entry and its hand-over."""
    bench = Bench()
    bench.guard._clock = lambda: (bench.guard.silence(), bench.now)[1]
    bench.guard.drive(Tone(170.0, 1.0))
    bench.guard._clock = lambda: bench.now
    assert np.all(bench.run(0.5) == 0.0)


def test_emergency_stop_holds_until_reset_and_interlock_until_closed() -> None:
    bench = Bench()
    loud(bench)
    bench.guard.stop("red button")
    bench.run(0.05)
    assert np.all(bench.run(0.2) == 0.0)
    assert bench.guard.muted == "red button"
    with pytest.raises(InterlockOpen, match="red button"):
        bench.guard.drive(Tone(170.0, 1.0))
    bench.guard.reset()
    assert np.all(bench.run(0.2) == 0.0)
    loud(bench)
    bench.guard.set_interlock("door")
    bench.run(0.05)
    assert np.all(bench.run(0.2) == 0.0)
    with pytest.raises(InterlockOpen, match="door"):
        bench.guard.drive(Tone(170.0, 1.0))
    bench.guard.set_interlock(None)
    assert np.all(bench.run(0.2) == 0.0)
    loud(bench)


def test_stop_from_many_threads_while_rendering() -> None:
    bench = Bench()
    loud(bench)
    threads = [threading.Thread(target=bench.guard.stop) for _ in range(20)]
    for thread in threads:
        thread.start()
    bench.run(0.1)
    for thread in threads:
        thread.join()
    bench.run(0.05)
    assert np.all(bench.run(0.1) == 0.0)


# -- heat --------------------------------------------------------------------------------------


def test_thermal_budget_mutes_when_the_integrated_power_says_so() -> None:
    """τ dP̄/dt = P − P̄ from 0 reaches the budget at t = τ ln(P/(P − P_max)).

    A = 2 V into 4 Ω is P = 0.5 W; with P_max = 0.25 W and τ = 5 s that is 5 ln 2 = 3.47 s. The
    0.2 s ramp delivers less: it delays by between 0 and 0.2 s.
    """
    limits = OutputLimits(
        2.0, max_slew_v_per_s=10.0, max_mean_power_w=0.25, thermal_time_s=5.0, load_ohm=4.0
    )
    bench = Bench(limits)
    bench.guard.drive(Tone(170.0, 2.0))
    while bench.guard.muted is None and bench.now < 10.0:
        bench.run(0.01)
    muted_at = bench.now
    assert 5 * math.log(2) <= muted_at <= 5 * math.log(2) + 0.2 + 0.02
    assert "thermal budget" in str(bench.guard.muted)
    with pytest.raises(InterlockOpen, match="thermal budget"):
        bench.guard.drive(Tone(170.0, 0.1))
    # It cools to 80 % in 5 ln(1/0.8) = 1.12 s.
    bench.run(1.05)
    with pytest.raises(InterlockOpen):
        bench.guard.drive(Tone(170.0, 0.1))
    bench.run(0.15)
    bench.guard.drive(Tone(170.0, 0.1))
