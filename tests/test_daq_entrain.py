"""The controller as a pure function: it ends, it stays within its limits, it names what it sees."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.entrain import (
    Command,
    Settings,
    State,
    Strategy,
    Task,
    begin,
    off_target,
    step,
)
from daq.lockin import FreeCycle, Measurement, measure
from daq.tongue import Law

FREE = FreeCycle(170.0, 100.0, (100.0, 5.0), 0.1)
LIMITS = Settings(limit_v=2.0, max_windows=40)
RATE = 10_000.0


def seen(
    frequency: float,
    forced: float,
    free: float = 0.0,
    other: tuple[float, float] = (300.0, 0.0),
    overload: bool = False,
) -> Measurement:
    """What the lock-in makes of that many lines in 0.5 s; free line at 170 Hz."""
    t = np.arange(5000) / RATE
    x = forced * np.cos(2 * np.pi * frequency * t) + free * np.cos(2 * np.pi * 170.0 * t + 1.0)
    x += other[1] * np.cos(2 * np.pi * other[0] * t)
    x += 0.01 * np.random.default_rng(1).standard_normal(t.size)
    return measure(x, RATE, frequency, overload=overload)


windows = st.builds(
    seen,
    frequency=st.just(166.0),
    forced=st.floats(0, 500),
    free=st.floats(0, 150),
    other=st.tuples(st.floats(200, 400), st.floats(0, 20)),
    overload=st.booleans(),
)


@settings(max_examples=60, deadline=None)
@given(
    sequence=st.lists(windows, min_size=1, max_size=6),
    strategy=st.sampled_from(["predict", "step"]),
    amplitude=st.one_of(st.none(), st.floats(0.01, 5)),
    known=st.booleans(),
)
def test_it_ends_within_its_limits_whatever_it_sees(
    sequence: list[Measurement], strategy: Strategy, amplitude: float | None, known: bool
) -> None:
    state, command = begin(
        Task(166.0, amplitude),
        FREE,
        replace(LIMITS, strategy=strategy),
        law=Law(6.0, 3.0, 0.01) if known else None,
    )
    for number in range(LIMITS.max_windows + 1):
        assert 0.0 <= command.amplitude_v <= LIMITS.limit_v
        if command.final:
            break
        assert command.window_s > 0
        before = state
        state, command = step(state, sequence[number % len(sequence)])
        assert state is not before
    assert command.final
    if command.kind == "give_up":
        assert command.amplitude_v == 0.0
        assert command.reason


def test_a_drive_that_is_not_what_was_asked_for_is_said_so() -> None:
    """1.3 times the threshold, as it was thought to be, were 1.085 times what it is."""
    state, _ = begin(Task(160.0, over_threshold=1.3), FREE, LIMITS)
    near = replace(state, amplitude_v=0.78, threshold_v=0.592)
    assert off_target(near) == []
    (said,) = off_target(replace(near, amplitude_v=0.642))
    assert said == (
        "the drive of 0.642 V is 1.08 times the threshold as now known; 1.3 were asked for"
    )
    (said,) = off_target(replace(near, amplitude_v=2.0, task=Task(160.0, over_threshold=1e9)))
    assert "2 V (the output's limit) is 3.38 times" in said
    assert off_target(replace(near, amplitude_v=0.642, task=Task(160.0, amplitude_v=0.642))) == []


def at_limit(measurement: Measurement, task: Task | None = None) -> Command:
    """What is said when the drive cannot go higher."""
    state, _ = begin(task or Task(measurement.frequency_hz), FREE, LIMITS)
    state = replace(state, amplitude_v=LIMITS.limit_v, level=measurement.free_amplitude)
    return step(state, measurement)[1]


@pytest.mark.parametrize(
    ("measurement", "outcome", "says"),
    [
        (seen(150.0, 5.0, 95.0), "not_entrained", "170.0"),
        (seen(166.0, 60.0, 70.0), "beating", "two lines beat"),
        (seen(166.0, 90.0, 0.0, (281.3, 40.0)), "another_mode", "282.00 Hz"),
        (seen(166.0, 90.0, 0.0, (83.0, 40.0)), "subharmonic", "1/2 of the forcing"),
        (seen(166.0, 90.0, 0.0, (249.0, 40.0)), "subharmonic", "3/2 of the forcing"),
        (seen(166.0, 90.0, overload=True), "overload", "full scale"),
    ],
)
def test_failures_have_names(measurement: Measurement, outcome: str, says: str) -> None:
    command = at_limit(measurement)
    assert (command.kind, command.outcome) == ("give_up", outcome)
    assert says in command.reason


def test_one_probe_then_straight_to_the_margin() -> None:
    """A probe at 0.05 V in a Stuart–Landau world of κ = 70/(s V) leads to 1.5 times the threshold
    at once; the forced amplitude of the probe is what the law says."""
    law, kappa = Law(6.0, 0.0, 0.01), 70.0
    detuning = 2 * math.pi * 4.0
    state, command = begin(Task(166.0, over_threshold=1.5), FREE, LIMITS, law=law)
    assert command.amplitude_v == 0.05
    # a · hypot(ν (1 − a² − 2b²), Δω) = κ · 0.05 with b² = 1 − 2a²
    forced = kappa * 0.05 / detuning
    for _ in range(20):
        gain = 1 - forced**2 - 2 * (1 - 2 * forced**2)
        forced = kappa * 0.05 / math.hypot(law.growth_rate_per_s * gain, detuning)
    free = math.sqrt(1 - 2 * forced**2)
    state, command = step(state, seen(166.0, 100 * forced, 100 * free))
    threshold = law.threshold(detuning) / kappa
    assert command.kind == "measure"
    # the offset is found to an eighth of a bin, 0.25 Hz: the lines are read to a few percent
    assert command.amplitude_v == pytest.approx(1.5 * threshold, rel=0.03)


def test_a_falling_line_is_given_time_and_a_standing_one_is_not() -> None:
    state, _ = begin(Task(166.0, amplitude_v=0.5), FREE, LIMITS)
    falling: State = state
    for level in (60.0, 40.0, 25.0):
        falling, command = step(falling, seen(166.0, 90.0, level))
        assert command.kind == "measure"
    standing, command = step(state, seen(166.0, 90.0, 60.0))
    standing, command = step(standing, seen(166.0, 90.0, 60.0))
    assert command.outcome == "beating"


def test_noise_on_the_edge_of_the_criterion_does_not_pass() -> None:
    """−20 dB is 10; a line of 9 with a standard error of 1 is not surely below."""
    sure = replace(seen(166.0, 90.0), free_amplitude=9.0, free_sigma=0.1)
    unsure = replace(sure, free_sigma=1.0)
    state, _ = begin(Task(166.0, amplitude_v=0.5), FREE, LIMITS)
    assert step(state, sure)[0].phase == "settle"
    assert step(state, unsure)[0].phase == "approach"
