"""What runs on the audio thread: copy in, play the guarded oscillator, count. Nothing else.

No array is created, no lock is taken and no file or socket is touched here; whatever other
threads need is left in a `Ring` or in single attributes. An exception ends the stream through
`failed` and PortAudio's finished callback, with the output at zero.
"""

import math
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers import counter
from drivers.clockcheck import ClockCheck
from drivers.guard import OutputGuard
from drivers.oscillator import Scratch
from drivers.ring import Ring
from drivers.types import FloatArray

MAX_FRAMES = 8192  # a callback with more frames is served in parts
XRUNS = 4096  # positions of flagged blocks that are remembered


class AudioCallback:
    """The callback's state; one object per stream, called by one thread.

    Parameters
    ----------
    speaker : int
        Output channel of the drive.
    full_scale_v : float
        Volts at the output for a sample of 1.
    counter_out : int, optional
        Output channel of the sample counter.

    Attributes
    ----------
    dry_s : float
        A callback that comes later than this after the one before it finds the output played out,
        and counts as an xrun whether or not PortAudio says so: its flag depends on who is quicker,
        the server that catches up or the stream that looks. Infinite until the stream is open and
        its buffer known.
    """

    def __init__(
        self,
        guard: OutputGuard,
        ring: Ring,
        clock_check: ClockCheck | None,
        *,
        speaker: int,
        full_scale_v: float,
        counter_out: int | None,
        abort: type[Exception],
    ) -> None:
        self._guard = guard
        self._ring = ring
        self._check = clock_check
        self._speaker = speaker
        self._per_volt = 1.0 / full_scale_v
        self._counter_out = counter_out
        self._abort = abort
        self._drive: FloatArray = np.zeros(MAX_FRAMES)
        self._stamps: FloatArray = np.zeros(MAX_FRAMES)
        self._index = Scratch(MAX_FRAMES).index
        # Any number that another stream is unlikely to have had.
        self.counter_base = time.monotonic_ns() // 1000 % counter.PERIOD
        self.frames = 0
        self.started_s: float | None = None
        self.last_s: float | None = None
        self.dry_s = math.inf
        self.xruns = 0
        self.xrun_frames: npt.NDArray[np.int64] = np.zeros(XRUNS, np.int64)
        self.clock_losses = 0
        self.failed: Exception | None = None

    def __call__(self, indata: Any, outdata: Any, frames: int, timing: object, status: Any) -> None:
        try:
            if self.started_s is None and status.input_underflow:
                # The card has not sampled yet: PortAudio fills its output first.
                outdata.fill(0.0)
                return
            self._serve(indata, outdata, frames, bool(status))
        except Exception as error:
            outdata.fill(0.0)
            self.failed = error
            raise self._abort from error

    def _serve(self, indata: Any, outdata: Any, frames: int, xrun: bool) -> None:
        now = time.monotonic()
        late = self.last_s is not None and now - self.last_s > self.dry_s
        self.last_s = now
        if self.started_s is None:
            self.started_s = now - frames / self._guard.sample_rate_hz
        if xrun or late:
            # The rate of flags is bounded by the rate of callbacks, so the table lasts.
            self.xrun_frames[self.xruns % XRUNS] = self._ring.frames
            self.xruns += 1
        if self._check is not None:
            missing = self._check.add(now, frames)
            if missing:
                self.clock_losses += 1
                if self._counter_out is None:
                    self._ring.lose(missing)
        self._ring.write(indata)
        outdata.fill(0.0)
        for start in range(0, frames, MAX_FRAMES):
            stop = min(start + MAX_FRAMES, frames)
            drive = self._guard.render(stop - start, self._drive[: stop - start])
            np.multiply(drive, self._per_volt, out=drive)
            outdata[start:stop, self._speaker] = drive
            if self._counter_out is not None:
                stamps = self._stamps[: stop - start]
                counter.stamp(
                    self.counter_base + self.frames + start, self._index[: stop - start], stamps
                )
                outdata[start:stop, self._counter_out] = stamps
        self.frames += frames
