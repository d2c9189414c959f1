"""Ring, clock check and sample counter: what is lost must show, at the right frame."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import counter
from drivers.clockcheck import ClockCheck
from drivers.ring import TABLE, Ring, size_bytes
from drivers.types import Gap


def numbered(first: int, frames: int) -> np.ndarray:
    """Frames that carry their own number in both channels."""
    column = np.arange(first, first + frames, dtype=np.float32)
    return np.column_stack([column, -column])


@given(st.lists(st.tuples(st.sampled_from(["write", "lose", "take"]), st.integers(1, 60))))
@settings(max_examples=80, deadline=None)
def test_every_frame_comes_out_at_its_number_or_in_a_gap(steps: list[tuple[str, int]]) -> None:
    """The model: frame n holds n, so content and numbering are checked against each other."""
    ring, produced, seen = Ring(100, 2), 0, []
    gaps: list[Gap] = []
    for verb, frames in steps:
        if verb == "write":
            ring.write(numbered(produced, frames))
            produced += frames
        elif verb == "lose":
            ring.lose(frames)
            produced += frames
        elif ring.available:
            span = ring.take(min(frames, ring.available))
            assert np.array_equal(span.samples, numbered(span.first_frame, span.samples.shape[0]))
            seen.extend(span.samples[:, 0].astype(int).tolist())
            if span.gap is not None:
                gaps.append(span.gap)
                assert span.gap.first_frame + span.gap.frames == span.first_frame
    while ring.available:
        span = ring.take(ring.available)
        seen.extend(span.samples[:, 0].astype(int).tolist())
        gaps += [span.gap] if span.gap is not None else []
    assert ring.frames == produced
    assert len(seen) + ring.lost_frames == produced
    assert seen == sorted(set(seen))
    assert tuple(gaps) == ring.gaps()[: len(gaps)]


def test_one_writer_and_one_reader_at_once_through_shared_memory() -> None:
    memory = memoryview(bytearray(size_bytes(500, 2)))
    writer, reader = Ring(500, 2, memory), Ring(500, 2, memory)
    total = 100_000

    def write() -> None:
        first = 0
        while first < total:
            if writer.capacity - writer.available >= 100:
                writer.write(numbered(first, 100))
                first += 100

    thread = threading.Thread(target=write)
    thread.start()
    expected = 0
    while expected < total:
        if reader.available >= 64 or expected + reader.available == total:
            span = reader.take(min(64, reader.available))
            frames = span.samples.shape[0]
            assert np.array_equal(span.samples, numbered(expected, frames))
            expected += frames
    thread.join()
    assert reader.lost_frames == 0


def test_says_when_losses_are_past_counting() -> None:
    ring = Ring(8, 1)
    for _ in range(TABLE + 1):
        assert not ring.overfull
        ring.write(np.zeros((1, 1), np.float32))
        ring.take(1)
        ring.lose(1)
    assert ring.overfull


def deliver(check: ClockCheck, seconds: float, rate: float, start_s: float = 0.0) -> int:
    """Callbacks of 256 frames with up to 3 ms of lateness; returns the frames found missing."""
    late = np.random.default_rng(4).uniform(0.0, 0.003, round(seconds * rate / 256))
    return sum(
        check.add(start_s + (k + 1) * 256 / rate + float(delay), 256)
        for k, delay in enumerate(late)
    )


def test_clock_check_tolerates_jitter_and_drift() -> None:
    """200 ppm apart for a minute is 12 ms, over fifty windows of 0.2 ms each."""
    assert deliver(ClockCheck(48000.0), 60.0, 48000.0 * (1 - 200e-6)) == 0


def test_clock_check_finds_a_silent_loss() -> None:
    """50 ms vanish. The least of 187 latenesses within 3 ms has mean 16 µs and exceeds 100 µs
    (5 frames) with probability e⁻⁶; 8 frames, e⁻¹⁰, in each of the two windows."""
    check = ClockCheck(48000.0)
    assert deliver(check, 6.0, 48000.0) == 0
    found = deliver(check, 6.0, 48000.0, start_s=6.05)
    assert found == pytest.approx(2400, abs=8)


@given(
    start=st.integers(0, 2**25),
    latency=st.integers(300, 5000),
    lost=st.integers(-300, 300).filter(bool),
    base=st.integers(0, counter.PERIOD - 1),
)
@settings(max_examples=60, deadline=None)
def test_counter_finds_slips_over_its_own_wrap(
    start: int, latency: int, lost: int, base: int
) -> None:
    start += latency + 400
    index = np.arange(2000, dtype=np.float64)
    left, right = np.empty(2000), np.empty(2000)
    counter.stamp(base + start - latency, index, left)
    counter.stamp(base + start - latency + lost, index, right)
    column = np.concatenate([left[:700], right[700:]]).astype(np.float32)
    found = counter.compare(start, column, None, base)
    assert found == counter.Counted(latency - lost, (counter.Slip(700, lost),))


def test_counter_passes_over_silence_and_what_an_older_stream_left() -> None:
    old = np.empty(500)
    counter.stamp(4_000_000, np.arange(500.0), old)
    column = np.concatenate([old, np.zeros(500)]).astype(np.float32)
    assert counter.compare(0, column, None, base=77) == counter.Counted(None)


def test_counter_tells_an_interrupted_output_from_one_that_has_not_begun() -> None:
    stamps = np.empty(300)
    counter.stamp(0, np.arange(300.0), stamps)
    column = np.concatenate([np.zeros(50), stamps[:150], np.zeros(20), stamps[150:]])
    begun = counter.compare(0, column[:200].astype(np.float32), None)
    assert begun == counter.Counted(50)
    cut = counter.compare(200, column[200:].astype(np.float32), begun.lag)
    assert cut == counter.Counted(70, (counter.Slip(20, -20),), interrupted=True)
