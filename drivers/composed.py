"""A duplex rig out of two devices: one that samples and one that sounds.

Their clocks are not the same. Between a generator's crystal and a converter's lie 10 to 100 ppm:
at 170 Hz that is a phase drift of up to 0.1 rad/s against a reference computed from the frame
number. Record the drive on an input channel, or let the analysis find the frequency in the data.
"""

import contextlib
from types import TracebackType
from typing import Protocol, Self

from drivers.clock import MonotonicClock
from drivers.errors import DriverError
from drivers.protocols import PressureInput
from drivers.stepped_output import SteppedOutput
from drivers.types import Block, Channel, OutputLimits, StreamStatus, Tone


class ClosableInput(PressureInput, Protocol):
    """An input that can be released and asked how it is."""

    def status(self) -> StreamStatus: ...

    def close(self) -> None: ...


class ComposedRig:
    """`DuplexRig` and `EmergencyStop`; a lost input silences the output."""

    def __init__(self, name: str, acquisition: ClosableInput, output: SteppedOutput) -> None:
        self._name = name
        self._input = acquisition
        self._output = output
        self._clock = MonotonicClock()
        self._closed = False

    @property
    def name(self) -> str:
        return self._name

    @property
    def clock(self) -> MonotonicClock:
        return self._clock

    @property
    def channels(self) -> tuple[Channel, ...]:
        return tuple(self._input.channels)

    @property
    def sample_rate_hz(self) -> float:
        return self._input.sample_rate_hz

    @property
    def limits(self) -> OutputLimits:
        return self._output.limits

    def start(self) -> None:
        self._input.start()

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        try:
            return self._input.read(frames, timeout_s)
        except DriverError:
            self._output.silence()
            raise

    def drive(self, tone: Tone) -> Tone:
        return self._output.drive(tone)

    def feed(self) -> None:
        self._output.feed()

    def silence(self) -> None:
        self._output.silence()

    def emergency_stop(self, reason: str = "emergency stop") -> None:
        self._output.emergency_stop(reason)

    def reset_stop(self) -> None:
        self._output.reset_stop()

    def status(self) -> StreamStatus:
        """The input's, with what is known of the output."""
        status = self._input.status()
        faults = [fault for fault in (status.fault, self._output.fault) if fault is not None]
        return StreamStatus(
            running=status.running,
            frames=status.frames,
            lost_frames=status.lost_frames,
            xruns=status.xruns,
            gaps=status.gaps,
            output_v=self._output.output_v,
            muted=self._output.muted,
            fault="; ".join(faults) or None,
            detail=status.detail | {"clocks": "separate"},
        )

    def stop(self) -> None:
        """Silence, as far as the output answers, then end sampling."""
        self._output.silence()
        self._output.settle()
        self._input.stop()

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        # The input is released even where the output no longer answers.
        try:
            self._output.close()
        finally:
            with contextlib.suppress(DriverError):
                self._input.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
