"""The smallest duplex rig: the guard's output is its only input, paced by the machine's clock.

It stands in for a device where a test is about what surrounds the device, as for the process that
`IsolatedRig` puts a rig in. `freeze_after_s` and `fail_after_s` make it misbehave.
"""

import time
from types import TracebackType
from typing import Self

import numpy as np

from drivers.clock import MonotonicClock
from drivers.errors import DeviceLost, SettingError
from drivers.guard import OutputGuard
from drivers.types import Block, Channel, OutputLimits, StreamStatus, Tone, require


class LoopRig:
    """Renders what is due whenever it is read; a `DuplexRig` with `EmergencyStop`."""

    name = "loop"
    channels = (Channel("drive", "voltage", "V"),)
    sample_rate_hz = 8000.0

    def __init__(self, limits: OutputLimits, fail_after_s: float | None = None) -> None:
        self.guard = OutputGuard(limits, self.sample_rate_hz, time.monotonic)
        self.clock = MonotonicClock()
        self._fail_after_s = fail_after_s
        self._started_s: float | None = None
        self._frames = 0

    @property
    def limits(self) -> OutputLimits:
        return self.guard.limits

    def start(self) -> None:
        self._started_s = time.monotonic()
        self._frames = 0

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        require(frames >= 1, "frames", frames, ">= 1")
        if self._started_s is None:
            raise SettingError("read() of a stream that is not running; start() it")
        first, start_s = self._frames, self._started_s
        samples = np.empty((frames, 1))
        for row in range(0, frames, 64):
            count = min(64, frames - row)
            due_s = start_s + (first + row + count) / self.sample_rate_hz
            time.sleep(max(0.0, due_s - time.monotonic()))
            if self._fail_after_s is not None and time.monotonic() - start_s > self._fail_after_s:
                self.guard.restart()
                raise DeviceLost("loop: device lost: told to fail")
            samples[row : row + count, 0] = self.guard.render(count)
        self._frames += frames
        return Block(first, samples, start_s + first / self.sample_rate_hz)

    def stop(self) -> None:
        self._started_s = None
        self.guard.restart()

    def drive(self, tone: Tone) -> Tone:
        return self.guard.drive(tone)

    def feed(self) -> None:
        self.guard.feed()

    def silence(self) -> None:
        self.guard.silence()

    def emergency_stop(self, reason: str = "emergency stop") -> None:
        self.guard.stop(reason)

    def reset_stop(self) -> None:
        self.guard.reset()

    def status(self) -> StreamStatus:
        return StreamStatus(
            running=self._started_s is not None,
            frames=self._frames,
            output_v=self.guard.output_v,
            muted=self.guard.muted,
        )

    def close(self) -> None:
        self.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
