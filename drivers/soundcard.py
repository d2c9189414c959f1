"""A sound card as a duplex rig: one full-duplex stream, so that output and input share a clock.

The stream's callback (`drivers.audio_callback`) fills a ring and plays the guarded oscillator;
`read` empties the ring from the caller's thread and turns samples into volts. Losses are found
four ways, each of which sees what the others miss: the driver's xrun flags, a callback that comes
after the output must have played out, the frame count against the monotonic clock, and, where a
digital loop is wired, a sample counter.

A card's analogue range is not known to the computer: `output_full_scale_v` and each channel's
`full_scale_v` come from the rig's description and are measured at calibration.
"""

import contextlib
import math
import time
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any, Self

from drivers.audio_blocks import BlockMaker
from drivers.audio_callback import AudioCallback
from drivers.audio_devices import find_audio_device, portaudio
from drivers.audio_settings import SoundCardSettings
from drivers.blocks import enough, take
from drivers.clock import MonotonicClock
from drivers.clockcheck import ClockCheck
from drivers.errors import DeviceFault, DeviceLost, DeviceTimeout, SettingError
from drivers.guard import OutputGuard
from drivers.ring import Ring
from drivers.types import (
    Block,
    Channel,
    OutputLimits,
    StreamStatus,
    Tone,
    require,
)

POLL_S = 0.002  # how often a waiting `read` looks; the callback may not wake anybody
DRY = 2.0  # output latencies without a callback after which the output has certainly played out
HELD_BACK_S = 0.1  # a sound server may hold more than its latency says: ramps were cut without it
STALL_S = 1.0  # a stream without a callback for so long is lost (longest buffers are ~0.2 s)
# PortAudio 19.6 gives up an ALSA stream whose input overruns before it first looks: under load a
# tenth of all starts. Nothing was recorded or played by then, so it may begin again.
STARTS = 5


@dataclass
class _Stream:
    """What exists between `start` and `stop`; `handle` is PortAudio's."""

    ring: Ring
    callback: AudioCallback
    maker: BlockMaker
    handle: Any = None
    finished: bool = False
    pending: list[Block] = field(default_factory=list)


class SoundCardRig:
    """`DuplexRig` on PortAudio; also offers `EmergencyStop`.

    Raises `MissingDependency` without PortAudio, `DeviceNotFound` for an unknown device and
    `SettingError` for a rate or channel count that the card refuses.
    """

    def __init__(self, settings: SoundCardSettings, limits: OutputLimits) -> None:
        require(
            limits.max_amplitude_v <= settings.output_full_scale_v,
            "max_amplitude_v",
            limits.max_amplitude_v,
            f"at most the card's full scale of {settings.output_full_scale_v} V",
        )
        self.settings = settings
        self._sd = portaudio()
        self._input = find_audio_device(
            settings.input_device, settings.host_api, inputs=settings.input_channels
        )
        self._output = find_audio_device(
            settings.output_device, settings.host_api, outputs=settings.output_channels
        )
        self._clock = MonotonicClock()
        self._rate_hz = settings.sample_rate_hz
        self.guard = OutputGuard(limits, settings.sample_rate_hz, time.monotonic)
        self._stream: _Stream | None = None
        self._last = StreamStatus(running=False)

    # -- description -----------------------------------------------------------------------

    @property
    def name(self) -> str:
        return self.settings.name

    @property
    def clock(self) -> MonotonicClock:
        return self._clock

    @property
    def channels(self) -> tuple[Channel, ...]:
        return self.settings.channels

    @property
    def sample_rate_hz(self) -> float:
        return self._rate_hz

    @property
    def limits(self) -> OutputLimits:
        return self.guard.limits

    # -- input -----------------------------------------------------------------------------

    def start(self) -> None:
        """Open the stream and wait for its first frames, at most a second.

        A second call while running is a `SettingError`; `DeviceLost` if the stream ends before its
        first frame however often it is begun.
        """
        if self._stream is not None:
            raise SettingError(f"{self.name}: start() while running; stop() first")
        for _ in range(STARTS):
            stream = self._stream = self._open()
            if self._begins(stream):
                return
            self._stream = None
            self._discard(stream)
        raise DeviceLost(
            f"{self.name}: device lost: the audio stream of {self._input.name!r}/"
            f"{self._output.name!r} ended before its first frame, {STARTS} times"
        )

    def _open(self) -> _Stream:
        """A new stream with a ring of its own, started."""
        settings = self.settings
        ring = Ring(round(settings.ring_s * settings.sample_rate_hz), settings.input_channels)
        callback = AudioCallback(
            self.guard,
            ring,
            ClockCheck(settings.sample_rate_hz) if settings.check_clock else None,
            speaker=settings.speaker,
            full_scale_v=settings.output_full_scale_v,
            counter_out=settings.counter[0] if settings.counter else None,
            abort=self._sd.CallbackAbort,
        )
        maker = BlockMaker(settings, settings.sample_rate_hz, callback)
        stream = _Stream(ring, callback, maker)
        try:
            stream.handle = self._sd.Stream(
                samplerate=settings.sample_rate_hz,
                # Never a fixed size: PortAudio 19.6 then begins a full-duplex ALSA stream with a
                # bufferful of uninitialised memory, at any amplitude, past every limit here.
                blocksize=0,
                device=(self._input.index, self._output.index),
                channels=(settings.input_channels, settings.output_channels),
                dtype="float32",
                latency=settings.latency_s,
                callback=callback,
                finished_callback=lambda: setattr(stream, "finished", True),
                # Volts must leave as computed: no dither, and clipping is the guard's business.
                clip_off=True,
                dither_off=True,
            )
            self._rate_hz = maker.rate_hz = float(stream.handle.samplerate)
            require(
                abs(self._rate_hz - settings.sample_rate_hz) <= 1e-3 * settings.sample_rate_hz,
                "sample_rate_hz",
                settings.sample_rate_hz,
                f"a rate of this card, which runs at {self._rate_hz} Hz",
            )
            callback.dry_s = DRY * max(float(stream.handle.latency[1]), settings.latency_s)
            stream.handle.start()
        except self._sd.PortAudioError as error:
            self._discard(stream)
            raise SettingError(
                f"{self.name}: sample_rate_hz={settings.sample_rate_hz}, "
                f"{settings.input_channels} inputs, {settings.output_channels} outputs is not "
                f"accepted by {self._input.name!r}/{self._output.name!r}: {error}"
            ) from error
        except BaseException:
            self._discard(stream)
            raise
        return stream

    def _begins(self, stream: _Stream) -> bool:
        """Whether `stream` does not end before its first frame; silence is for `read` to judge."""
        callback = stream.callback
        deadline = time.monotonic() + STALL_S
        while callback.started_s is None and not stream.finished and time.monotonic() < deadline:
            time.sleep(POLL_S)
        return not stream.finished or callback.started_s is not None or callback.failed is not None

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        """Next `frames` frames in volts; fewer only right before lost ones."""
        require(frames >= 1, "frames", frames, ">= 1")
        stream = self._stream
        if stream is None:
            raise SettingError(f"{self.name}: read() of a stream that is not running; start() it")
        deadline = time.monotonic() + timeout_s
        while not enough(stream.pending, frames):
            missing = frames - sum(block.frames for block in stream.pending)
            self._await(stream, missing, deadline, timeout_s)
            span = stream.ring.take(missing)
            stream.pending += stream.maker.blocks(span, self.guard.muted is not None)
        return take(stream.pending, frames, self._rate_hz)

    def _await(self, stream: _Stream, frames: int, deadline: float, timeout_s: float) -> None:
        while stream.ring.available < frames:
            fault = self._fault(stream)
            if fault is not None:
                self.guard.silence(fault)
                raise DeviceLost(f"{self.name}: {fault}") from stream.callback.failed
            if time.monotonic() > deadline:
                raise DeviceTimeout(
                    f"{self.name}: {stream.ring.available} of {frames} frames within {timeout_s} s"
                )
            time.sleep(POLL_S)
        if stream.ring.overfull:
            raise DeviceFault(f"{self.name}: frames are lost too often to be counted; stop()")

    def _fault(self, stream: _Stream) -> str | None:
        """Why no more frames will come; `None` while they may."""
        if stream.callback.failed is not None:
            return f"audio callback failed: {stream.callback.failed!r}"
        if stream.finished:
            return "device lost: the audio stream ended by itself"
        last = stream.callback.last_s
        if last is not None and time.monotonic() - last > STALL_S:
            return f"device lost: no audio callback for {STALL_S} s"
        return None

    # -- output ----------------------------------------------------------------------------

    def drive(self, tone: Tone) -> Tone:
        """Ramp to `tone`; raises `SettingError` also when the stream is not running."""
        if self._stream is None:
            raise SettingError(f"{self.name}: drive() of a stream that is not running; start() it")
        return self.guard.drive(tone)

    def feed(self) -> None:
        self.guard.feed()

    def silence(self) -> None:
        self.guard.silence()

    def emergency_stop(self, reason: str = "emergency stop") -> None:
        self.guard.stop(reason)

    def reset_stop(self) -> None:
        self.guard.reset()

    # -- life ------------------------------------------------------------------------------

    def status(self) -> StreamStatus:
        stream = self._stream
        if stream is None:
            return self._last
        fault = self._fault(stream)
        maker = stream.maker
        return StreamStatus(
            running=fault is None,
            frames=stream.ring.frames + maker.shift,
            lost_frames=stream.ring.lost_frames + maker.shift,
            xruns=stream.callback.xruns,
            gaps=tuple(maker.gaps),
            output_v=self.guard.output_v if fault is None else 0.0,
            muted=self.guard.muted,
            fault=fault,
            detail={
                "input": f"{self._input.name} ({self._input.host_api})",
                "output": f"{self._output.name} ({self._output.host_api})",
                "clock_losses": str(stream.callback.clock_losses),
                "loop_latency_frames": "unknown" if maker.lag is None else str(maker.lag),
            },
        )

    def stop(self) -> None:
        """Ramp to zero, let it play out, end the stream; harmless when not running."""
        stream = self._stream
        if stream is None:
            return
        self.guard.silence()
        self._play_out(stream)
        self._last = replace(self.status(), running=False, output_v=0.0)
        self._stream = None
        self._discard(stream)
        self.guard.restart()

    def _play_out(self, stream: _Stream) -> None:
        """Wait until the ramp has left the card's buffer, which stopping would throw away.

        Takes the ramp, the output's latency and what a server holds beyond that, and is cut short
        when the device is gone.
        """
        latency = max(float(stream.handle.latency[1]), self.settings.latency_s)
        quiet = math.inf
        deadline = time.monotonic() + self.limits.silence_ramp_s + latency + 2 * HELD_BACK_S
        while self._fault(stream) is None and time.monotonic() < min(
            deadline, quiet + latency + HELD_BACK_S
        ):
            if self.guard.output_v == 0.0:
                quiet = min(quiet, time.monotonic())
            time.sleep(POLL_S)

    def _discard(self, stream: _Stream) -> None:
        if stream.handle is None:
            return
        # A stream whose device is gone fails to stop; it is given up either way.
        with contextlib.suppress(self._sd.PortAudioError):
            stream.handle.stop(ignore_errors=True)
        with contextlib.suppress(self._sd.PortAudioError):
            stream.handle.close(ignore_errors=True)

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
