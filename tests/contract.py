"""The one contract of every duplex rig, simulated or real.

Derive a test class from `RigContract`, say how to open the rig and which input column carries the
voltage at the speaker output, and every test below runs against it::

    class TestMyRig(RigContract):
        drive_column = 3

        def open_rig(self, limits):
            return MyRig(..., limits=limits)

`InputContract` is the part that holds for a `PressureInput` alone.

What the class attributes bound is the bench, not the rig: the loop's noise and its latency.
Tolerances: a recorded sine of amplitude A may differ from the ideal one by `noise_v` at each
sample, so amplitudes fitted over whole stretches are held to `noise_v` as well (a fit averages).
"""

import itertools
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.errors import DriverError, InterlockOpen, SettingError
from drivers.protocols import DuplexRig, EmergencyStop, PressureInput, SpeakerOutput
from drivers.types import Block, FloatArray, OutputLimits, Tone

LIMITS = OutputLimits(
    max_amplitude_v=1.0,
    min_frequency_hz=50.0,
    max_frequency_hz=500.0,
    max_slew_v_per_s=5.0,
    dead_man_s=0.6,
)


class InputContract:
    """What every `PressureInput` must do; `open_rig` may return one that does more."""

    time_jitter_s: float = 1e-9  # most by which a block's time_s is off
    block_s: float = 0.02  # length of the blocks that the tests read

    def open_rig(self, limits: OutputLimits) -> Any:
        raise NotImplementedError

    @pytest.fixture
    def rig(self) -> Iterator[Any]:
        rig = self.open_rig(LIMITS)
        try:
            yield rig
        finally:
            rig.stop()
            rig.close()

    @pytest.fixture
    def running(self, rig: Any) -> Any:
        rig.start()
        return rig

    def blocks(self, rig: Any, seconds: float, feed: bool = True) -> list[Block]:
        """Read for `seconds` of the rig's frames, feeding the dead-man timer unless told not to."""
        frames = max(1, round(self.block_s * rig.sample_rate_hz))
        found = []
        for _ in range(max(1, round(seconds / self.block_s))):
            if feed and isinstance(rig, SpeakerOutput):
                rig.feed()
            found.append(rig.read(frames))
        return found

    def test_offers_the_verbs_of_an_input(self, rig: PressureInput) -> None:
        assert isinstance(rig, PressureInput)
        assert rig.sample_rate_hz > 0
        names = [channel.name for channel in rig.channels]
        assert len(set(names)) == len(names) >= 1

    def test_blocks_are_contiguous_in_order_and_in_volts(self, running: PressureInput) -> None:
        found = self.blocks(running, 0.2)
        full_scale = np.array([channel.full_scale_v for channel in running.channels])
        for block in found:
            assert block.samples.dtype == np.float64
            assert block.samples.shape[1] == len(running.channels)
            assert np.all(np.isfinite(block.samples))
            assert np.all(np.abs(block.samples) <= full_scale * (1 + 1e-6))
        for before, after in itertools.pairwise(found):
            assert after.first_frame == before.end_frame
            step_s = before.frames / running.sample_rate_hz
            assert after.time_s - before.time_s == pytest.approx(step_s, abs=self.time_jitter_s)

    def test_frames_count_from_start(self, running: PressureInput) -> None:
        assert running.read(7).first_frame == 0
        block = running.read(1)
        assert (block.first_frame, block.frames) == (7, 1)

    def test_a_block_keeps_its_samples(self, running: PressureInput) -> None:
        """A reused buffer must not change what was handed out."""
        first = running.read(64)
        copy = first.samples.copy()
        self.blocks(running, 0.1)
        assert np.array_equal(first.samples, copy)

    @pytest.mark.parametrize("frames", [0, -1])
    def test_refuses_to_read_no_frames(self, running: PressureInput, frames: int) -> None:
        with pytest.raises(SettingError, match="frames"):
            running.read(frames)

    def test_refuses_to_read_before_start(self, rig: PressureInput) -> None:
        with pytest.raises(SettingError, match="start"):
            rig.read(1)

    def test_refuses_to_read_after_stop(self, running: PressureInput) -> None:
        running.read(1)
        running.stop()
        with pytest.raises(SettingError, match="start"):
            running.read(1)

    def test_stop_is_harmless_before_start_and_twice(self, rig: PressureInput) -> None:
        rig.stop()
        rig.start()
        rig.read(1)
        rig.stop()
        rig.stop()

    def test_starts_again_after_stop(self, running: PressureInput) -> None:
        self.blocks(running, 0.05)
        running.stop()
        running.start()
        assert running.read(3).first_frame == 0


class RigContract(InputContract):
    """Override `open_rig`, and whichever of these differ on your bench."""

    drive_column: int  # input column that carries the output's voltage
    drive_gain: float = 1.0  # volts in that column per volt at the output
    noise_v: float = 1e-3  # most by which a sample of that column is off
    latency_s: float = 0.0  # most that passes between a command and its arrival there

    def open_rig(self, limits: OutputLimits) -> DuplexRig:
        raise NotImplementedError

    # -- helpers ---------------------------------------------------------------------------

    def output(self, rig: DuplexRig, seconds: float, feed: bool = True) -> FloatArray:
        """The output voltage over the next `seconds`, from the column that records it."""
        column = [block.samples[:, self.drive_column] for block in self.blocks(rig, seconds, feed)]
        return np.concatenate(column) / self.drive_gain

    def amplitude(self, rig: DuplexRig, samples: FloatArray, frequency_hz: float) -> float:
        """Amplitude of the sine of that frequency, by least squares."""
        angle = 2 * np.pi * frequency_hz * np.arange(samples.size) / rig.sample_rate_hz
        design = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(angle)])
        cosine, sine, _ = np.linalg.lstsq(design, samples, rcond=None)[0]
        return float(np.hypot(cosine, sine))

    def settle(self, rig: DuplexRig, amplitude_v: float = LIMITS.max_amplitude_v) -> None:
        """Let a ramp of that height and the loop's latency pass."""
        self.blocks(rig, amplitude_v / LIMITS.max_slew_v_per_s + self.latency_s + self.block_s)

    def test_offers_the_verbs_of_a_duplex_rig(self, rig: DuplexRig) -> None:
        assert isinstance(rig, DuplexRig)
        assert rig.name
        assert len(rig.channels) > self.drive_column

    def test_status_is_a_snapshot(self, running: DuplexRig) -> None:
        before = running.status()
        last = self.blocks(running, 0.1)[-1]
        after = running.status()
        assert before.running
        assert after.frames >= max(before.frames, last.end_frame)
        assert (after.lost_frames, after.gaps, after.fault) == (0, (), None)

    # -- output ----------------------------------------------------------------------------

    def test_is_silent_until_driven(self, running: DuplexRig) -> None:
        assert np.max(np.abs(self.output(running, 0.1))) <= self.noise_v
        assert running.status().output_v == 0.0

    def test_reaches_the_tone_it_reads_back(self, running: DuplexRig) -> None:
        reached = running.drive(Tone(170.0, 0.5))
        assert reached.frequency_hz == pytest.approx(170.0, rel=1e-4)
        assert reached.amplitude_v == pytest.approx(0.5, rel=1e-2)
        self.settle(running)
        samples = self.output(running, 0.2)
        found = self.amplitude(running, samples, reached.frequency_hz)
        assert found == pytest.approx(reached.amplitude_v, abs=self.noise_v)
        assert running.status().output_v == pytest.approx(reached.amplitude_v, rel=1e-6)

    @pytest.mark.parametrize(
        ("tone", "parameter"),
        [
            (Tone(170.0, 1.01), "amplitude_v=1.01"),
            (Tone(49.0, 0.5), "frequency_hz=49"),
            (Tone(501.0, 0.5), "frequency_hz=501"),
        ],
    )
    def test_refuses_a_tone_beyond_its_limits_and_keeps_the_old_one(
        self, running: DuplexRig, tone: Tone, parameter: str
    ) -> None:
        running.drive(Tone(170.0, 0.25))
        self.settle(running)
        with pytest.raises(SettingError, match=parameter):
            running.drive(tone)
        self.settle(running)
        found = self.amplitude(running, self.output(running, 0.1), 170.0)
        assert found == pytest.approx(0.25, abs=self.noise_v)

    def test_never_exceeds_the_limit_or_the_slew(self, running: DuplexRig) -> None:
        """|y| ≤ s·(t − t₀) from the first sample that stands out of the noise on."""
        running.drive(Tone(333.0, 1.0))
        samples = np.abs(self.output(running, 0.3 + self.latency_s))
        assert np.max(samples) <= LIMITS.max_amplitude_v + self.noise_v
        assert np.max(samples) >= 0.9 * LIMITS.max_amplitude_v
        onset = int(np.argmax(samples > self.noise_v))
        # A sine starting at zero phase stays below the noise for a while: the envelope may have
        # begun up to one period before the first sample that shows.
        since = (np.arange(samples.size) - onset) / running.sample_rate_hz + 1 / 333.0
        envelope = LIMITS.max_slew_v_per_s * np.maximum(since, 0.0)
        assert np.all(samples <= envelope + self.noise_v)

    def test_changes_are_phase_continuous(self, running: DuplexRig) -> None:
        """Neighbouring samples differ by at most (2πfA + s)/fs, whatever the change."""
        running.drive(Tone(170.0, 0.5))
        self.settle(running)
        parts = []
        for frequency, amplitude in [(171.0, 0.5), (400.0, 0.5), (60.0, 1.0), (170.0, 0.25)]:
            running.drive(Tone(frequency, amplitude))
            parts.append(self.output(running, 0.1 + self.latency_s))
        samples = np.concatenate(parts)
        steepest = 2 * np.pi * 400.0 * 1.0 + LIMITS.max_slew_v_per_s
        assert np.max(np.abs(np.diff(samples))) <= (
            steepest / running.sample_rate_hz + 2 * self.noise_v
        )
        assert np.max(np.abs(samples)) > 0.5

    # -- silence ---------------------------------------------------------------------------

    def is_silent(self, rig: DuplexRig) -> bool:
        """After the silence ramp and the latency nothing leaves the output."""
        self.blocks(rig, LIMITS.silence_ramp_s + self.latency_s + 2 * self.block_s)
        quiet = bool(np.max(np.abs(self.output(rig, 0.1))) <= self.noise_v)
        return quiet and rig.status().output_v == 0.0

    def loud(self, rig: DuplexRig) -> DuplexRig:
        rig.drive(Tone(170.0, 1.0))
        self.settle(rig)
        assert np.max(np.abs(self.output(rig, 0.05))) > 0.9
        return rig

    def test_silence_silences_twice_and_may_be_followed_by_a_tone(self, running: DuplexRig) -> None:
        self.loud(running)
        running.silence()
        running.silence()
        assert self.is_silent(running)
        self.loud(running)

    def test_silence_from_another_thread_during_a_read(self, running: DuplexRig) -> None:
        self.loud(running)
        caller = threading.Thread(target=running.silence)
        caller.start()
        running.read(round(0.1 * running.sample_rate_hz))
        caller.join(1.0)
        assert not caller.is_alive()
        assert self.is_silent(running)

    def test_dead_man_silences_and_feeding_alone_does_not_wake(self, running: DuplexRig) -> None:
        self.loud(running)
        held = self.output(running, 0.5 * LIMITS.dead_man_s, feed=False)
        assert np.max(np.abs(held[-held.size // 4 :])) > 0.9
        self.blocks(running, LIMITS.dead_man_s + self.latency_s, feed=False)
        assert self.is_silent(running)
        muted = running.status().muted
        assert muted is not None
        assert "dead man" in muted
        running.feed()
        assert self.is_silent(running)
        self.loud(running)
        assert running.status().muted is None

    def test_stop_silences(self, running: DuplexRig) -> None:
        self.loud(running)
        running.stop()
        running.stop()
        status = running.status()
        assert (status.running, status.output_v) == (False, 0.0)

    def test_leaving_by_an_exception_silences(self) -> None:
        rig = self.open_rig(LIMITS)

        def fail_while_loud() -> None:
            with rig:
                rig.start()
                self.loud(rig)
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            fail_while_loud()
        status = rig.status()
        assert (status.running, status.output_v) == (False, 0.0)

    def test_close_twice_then_silence_is_harmless(self) -> None:
        rig = self.open_rig(LIMITS)
        rig.start()
        self.loud(rig)
        rig.close()
        rig.close()
        rig.silence()
        assert rig.status().output_v == 0.0
        with pytest.raises(DriverError):
            rig.read(1)

    def test_emergency_stop_holds_until_reset(self, running: DuplexRig) -> None:
        if not isinstance(running, EmergencyStop):
            pytest.skip(f"{type(running).__name__} has no emergency stop of its own")
        self.loud(running)
        running.emergency_stop("red button")
        assert self.is_silent(running)
        with pytest.raises(InterlockOpen, match="red button"):
            running.drive(Tone(170.0, 0.1))
        running.reset_stop()
        assert self.is_silent(running)
        self.loud(running)
