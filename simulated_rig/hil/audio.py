"""The plant behind a sound card: loudspeaker line in, microphone lines out, one PortAudio stream.

Input channel `speaker` carries the drive, outputs 0, 1, 2 the lines p1, p2, drive; what comes in on
the counter's channel (`drivers.counter`) goes out again in the same frame, so that an acquisition
sees every frame that was lost on its way out and back, and the plant every one lost on the way in.
On a fault all outputs are zero, the counter too, which the other side sees at once, and the stream
ends.
"""

import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np

from drivers import counter
from drivers.audio_devices import find_audio_device, portaudio
from drivers.clockcheck import ClockCheck
from drivers.errors import SettingError
from drivers.types import require
from simulated_rig.hil.device import Device

LINES = 3
STALL_S = 1.0
RESTART_S = 5.0  # a counter that moved by more belongs to another stream
SILENT_BLOCKS = 20  # callbacks that carry zeros after a fault, before the stream ends


@dataclass(frozen=True)
class AudioSettings:
    """Which card, how fast, and what a sample of 1 means on the way in.

    `counter` is the (input, output) pair of channels of the sample counter, or None.
    """

    input_device: str
    output_device: str
    host_api: str = "ALSA"
    sample_rate_hz: float = 48000.0
    speaker: int = 0
    speaker_full_scale_v: float = 1.0
    latency_s: float = 0.05
    counter: tuple[int, int] | None = (3, 3)
    check_clock: bool = True

    def __post_init__(self) -> None:
        require(self.sample_rate_hz >= 8000, "sample_rate_hz", self.sample_rate_hz, ">= 8000")
        require(self.speaker >= 0, "speaker", self.speaker, "an input channel >= 0")
        require(self.latency_s > 0, "latency_s", self.latency_s, "> 0")
        require(
            self.speaker_full_scale_v > 0, "speaker_full_scale_v", self.speaker_full_scale_v, "> 0"
        )
        require(
            self.counter is None or self.counter[1] >= LINES,
            "counter",
            self.counter,
            f"a pair whose output channel is >= {LINES}",
        )

    @property
    def inputs(self) -> int:
        return 1 + max(self.speaker, self.counter[0] if self.counter else 0)

    @property
    def outputs(self) -> int:
        return 1 + self.counter[1] if self.counter else LINES


class CounterWatch:
    """Follows the counter that the other side sends, over its restarts."""

    def __init__(self, rate_hz: float) -> None:
        self._rate = rate_hz
        self._lag: int | None = None
        self._frames = 0

    def add(self, column: Any) -> int:
        """Frames that are missing before or within this block."""
        first, self._frames = self._frames, self._frames + len(column)
        stamped = np.flatnonzero(column)
        if stamped.size == 0:
            return 0
        if self._lag is None:
            row = int(stamped[0])
            heard = round(float(column[row]) * counter.SCALE) - 1
            self._lag = (first + row - heard) % counter.PERIOD
        found = counter.compare(first, column, self._lag)
        self._lag = found.lag
        jumps = [abs(slip.missing) for slip in found.slips]
        return sum(jump for jump in jumps if jump < RESTART_S * self._rate)


class AudioSide:
    """Runs `device` from `__enter__` to `__exit__`, or until its fault.

    Raises `MissingDependency` without PortAudio, `DeviceNotFound`, or `SettingError` for what the
    card refuses.
    """

    def __init__(self, device: Device, settings: AudioSettings, full_scale_v: float) -> None:
        self.device, self.settings = device, settings
        self._per_volt = 1.0 / full_scale_v
        self._sd = portaudio()
        source = find_audio_device(settings.input_device, settings.host_api, inputs=settings.inputs)
        sink = find_audio_device(
            settings.output_device, settings.host_api, outputs=settings.outputs
        )
        self._check = ClockCheck(settings.sample_rate_hz) if settings.check_clock else None
        self._counter = CounterWatch(settings.sample_rate_hz)
        self._silent = 0
        self._last_s: float | None = None
        self._busy_since_s: float | None = None
        self._finished = False
        try:
            self._stream = self._sd.Stream(
                samplerate=settings.sample_rate_hz,
                blocksize=0,  # see `drivers.soundcard`
                device=(source.index, sink.index),
                channels=(settings.inputs, settings.outputs),
                dtype="float32",
                latency=settings.latency_s,
                callback=self._callback,
                finished_callback=self._finish,
                clip_off=True,
                dither_off=True,
            )
        except self._sd.PortAudioError as error:
            raise SettingError(
                f"sample_rate_hz={settings.sample_rate_hz}, {settings.inputs} inputs, "
                f"{settings.outputs} outputs is not accepted by {source.name!r}/{sink.name!r}: "
                f"{error}"
            ) from error

    @property
    def latency_s(self) -> tuple[float, float]:
        """In and out, as PortAudio reports them."""
        first, second = self._stream.latency
        return float(first), float(second)

    def check(self) -> None:
        """A stream that ended by itself or stands still is a fault, and so is a block that takes
        so long that its own end cannot be waited for."""
        watch, busy = self.device.watch, self._busy_since_s
        if busy is not None and time.monotonic() - busy > STALL_S:
            watch.fail(f"overload: one block took more than {STALL_S} s")
        elif self._finished:
            watch.fail("device lost: the audio stream ended by itself")
        elif self._last_s is not None and time.monotonic() - self._last_s > STALL_S:
            watch.fail(f"device lost: no audio callback for {STALL_S} s")

    def __enter__(self) -> Self:
        self._stream.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stream.abort(ignore_errors=True)
        self._stream.close(ignore_errors=True)

    def _finish(self) -> None:
        self._finished = True

    def _callback(self, indata: Any, outdata: Any, frames: int, _time: Any, status: Any) -> None:
        watch = self.device.watch
        outdata.fill(0.0)
        try:
            self._last_s = self._busy_since_s = now = time.monotonic()
            self._count(indata, frames, now, status)
            if watch.fault is None:
                settings = self.settings
                line_in = indata[:, settings.speaker].astype(np.float64)
                volts = self.device.process(line_in * settings.speaker_full_scale_v)
                if watch.fault is None:
                    outdata[:, :LINES] = volts * self._per_volt
                    if settings.counter is not None:
                        outdata[:, settings.counter[1]] = indata[:, settings.counter[0]]
        except Exception as error:
            watch.fail(f"audio callback failed: {error!r}")
        self._busy_since_s = None
        if watch.fault is not None:
            self._silent += 1
            if self._silent > SILENT_BLOCKS:
                raise self._sd.CallbackStop

    def _count(self, indata: Any, frames: int, now: float, status: Any) -> None:
        watch = self.device.watch
        if status.input_overflow or status.input_underflow:
            watch.xrun("line in")
        if status.output_underflow or status.output_overflow:
            watch.xrun("lines out")
        # Not before: a loss in the first second would be seen in the next, as if it were there.
        if self._check is not None and watch.settled and (missing := self._check.add(now, frames)):
            watch.lost(missing, "sound server")
        if self.settings.counter is not None:
            missing = self._counter.add(indata[:, self.settings.counter[0]])
            if missing:
                watch.lost(missing, "line in")
