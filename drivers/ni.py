"""National Instruments: analogue input and output of one device on one clock, continuously.

The output task takes the input task's sample clock and start trigger, so that frame n leaves and
frame n is sampled at the same edge. Output runs `lead_frames` ahead in the card's buffer, which is
the loop's latency. One thread reads a block into an array that it uses again and again, renders
the next block of the guarded oscillator, and writes it.

What is verified: against `nidaqmx`'s own classes (names, arguments, array shapes) with an emulated
card behind them, and without a driver installed (errors). What is not: any real card. Before use,
`entrain check` has to confirm latency, skew and silence on the very device. After a kill -9 an
analogue output holds its last value, a constant voltage, unless the process that owns it is
another one (`drivers.isolated`) or the device has a watchdog of its own.
"""

import contextlib
import queue
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np

from drivers.blocks import enough, take
from drivers.clock import MonotonicClock
from drivers.errors import DeviceTimeout, DriverError, SettingError
from drivers.guard import OutputGuard
from drivers.ni_library import daqmx, translated
from drivers.types import (
    Block,
    Channel,
    Flag,
    FloatArray,
    Gap,
    OutputLimits,
    StreamStatus,
    Tone,
    require,
)

CLIP = 0.9999  # share of the range at which a converter counts as clipped
QUEUE = 1000  # blocks that may wait for a reader


@dataclass(frozen=True)
class NiSettings:
    """`inputs` are physical channels in the order of `channels`, as ``ai0``; `output` as ``ao0``.

    `terminal` is a `TerminalConfiguration` of nidaqmx by name: DEFAULT, RSE, NRSE, DIFF,
    PSEUDO_DIFF.
    """

    device: str
    channels: tuple[Channel, ...]
    inputs: tuple[str, ...]
    output: str = "ao0"
    sample_rate_hz: float = 51200.0
    terminal: str = "DEFAULT"
    block_frames: int = 1024
    lead_blocks: int = 3
    name: str = "NI"

    def __post_init__(self) -> None:
        require(
            0 < len(self.channels) == len(self.inputs),
            "inputs",
            self.inputs,
            f"one physical channel for each of the {len(self.channels)} channels",
        )
        require(self.sample_rate_hz > 0, "sample_rate_hz", self.sample_rate_hz, "> 0")
        require(self.block_frames >= 16, "block_frames", self.block_frames, ">= 16")
        require(self.lead_blocks >= 2, "lead_blocks", self.lead_blocks, ">= 2")


class NiRig:
    """`DuplexRig` and `EmergencyStop` on an NI device.

    Raises `MissingDependency` without nidaqmx or its driver, `SettingError` for a channel or a
    rate that the device refuses.
    """

    def __init__(self, settings: NiSettings, limits: OutputLimits) -> None:
        self._ni = daqmx()
        self.settings = settings
        self._clock = MonotonicClock()
        self._rate_hz = settings.sample_rate_hz
        self.guard = OutputGuard(
            limits, settings.sample_rate_hz, time.monotonic, settings.block_frames
        )
        self._tasks: tuple[Any, Any] | None = None
        self._running = False
        self._thread: threading.Thread | None = None
        self._reset()

    def _reset(self) -> None:
        self._blocks: queue.Queue[Block] = queue.Queue(QUEUE)
        self._pending: list[Block] = []
        self._gaps: list[Gap] = []
        self._frames = 0
        self._delivered = 0
        self._failed: DriverError | None = None
        self._started_s = time.monotonic()

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
        """The rate that the device coerced the asked one to, once started."""
        return self._rate_hz

    @property
    def limits(self) -> OutputLimits:
        return self.guard.limits

    # -- tasks -----------------------------------------------------------------------------

    def start(self) -> None:
        if self._running:
            raise SettingError(f"{self.name}: start() while running; stop() first")
        self._reset()
        try:
            self._tasks = self._configured()
            output, acquisition = self._tasks
            # The output waits for the input's trigger, so it has to be armed first.
            output.start()
            acquisition.start()
        except self._ni.error as error:
            self._release()
            raise SettingError(f"{self.name}: {translated(error)}") from error
        self._started_s = time.monotonic()
        self._running = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _configured(self) -> tuple[Any, Any]:
        ni, settings = self._ni, self.settings
        acquisition = ni.task()
        self._tasks = (None, acquisition)
        for channel, physical in zip(settings.channels, settings.inputs, strict=True):
            acquisition.ai_channels.add_ai_voltage_chan(
                f"{settings.device}/{physical}",
                terminal_config=ni.terminal(settings.terminal),
                min_val=-channel.full_scale_v,
                max_val=channel.full_scale_v,
            )
        acquisition.timing.cfg_samp_clk_timing(
            settings.sample_rate_hz,
            sample_mode=ni.continuous,
            samps_per_chan=16 * settings.block_frames,
        )
        self._rate_hz = float(acquisition.timing.samp_clk_rate)
        self.guard.sample_rate_hz = self._rate_hz

        output = ni.task()
        self._tasks = (output, acquisition)
        limit = self.limits.max_amplitude_v
        output.ao_channels.add_ao_voltage_chan(
            f"{settings.device}/{settings.output}", min_val=-limit, max_val=limit
        )
        lead = settings.lead_blocks * settings.block_frames
        output.timing.cfg_samp_clk_timing(
            self._rate_hz,
            source=f"/{settings.device}/ai/SampleClock",
            sample_mode=ni.continuous,
            samps_per_chan=lead,
        )
        # An output that is not fed must stop rather than repeat what it has.
        output.out_stream.regen_mode = ni.no_regeneration
        output.triggers.start_trigger.cfg_dig_edge_start_trig(f"/{settings.device}/ai/StartTrigger")
        self._reader = ni.reader(acquisition.in_stream)
        self._writer = ni.writer(output.out_stream)
        self._writer.write_many_sample(np.zeros(lead))
        return output, acquisition

    def _run(self) -> None:
        frames, width = self.settings.block_frames, len(self.channels)
        # The reader wants (channels, frames); both arrays live as long as the stream.
        raw: FloatArray = np.empty((width, frames))
        drive: FloatArray = np.empty(frames)
        patience_s = 1.0 + frames / self._rate_hz
        try:
            while self._running:
                self._reader.read_many_sample(raw, frames, timeout=patience_s)
                self._hand_over(raw)
                self.guard.render(frames, drive)
                self._writer.write_many_sample(drive, timeout=patience_s)
        except self._ni.error as error:
            self._failed = translated(error)
        except DriverError as error:
            self._failed = error

    def _hand_over(self, raw: FloatArray) -> None:
        full_scale = np.array([channel.full_scale_v for channel in self.channels])
        first, frames = self._frames, raw.shape[1]
        self._frames += frames
        flags: set[Flag] = set()
        if np.any(np.abs(raw) >= CLIP * full_scale[:, None]):
            flags.add("clipped")
        if first != self._delivered:
            flags.add("gap")
        time_s = self._started_s + first / self._rate_hz
        try:
            self._blocks.put_nowait(Block(first, raw.T.copy(), time_s, frozenset(flags)))
        except queue.Full:
            return  # the reader lags by QUEUE blocks: the next one that fits is after a gap
        if first != self._delivered:
            self._gaps.append(Gap(self._delivered, first - self._delivered))
        self._delivered = self._frames

    # -- input -----------------------------------------------------------------------------

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        """Next `frames` frames in volts; fewer only right before lost ones."""
        require(frames >= 1, "frames", frames, ">= 1")
        if not self._running:
            raise SettingError(f"{self.name}: read() of a stream that is not running; start() it")
        deadline = time.monotonic() + timeout_s
        while not enough(self._pending, frames):
            try:
                self._pending.append(self._blocks.get(timeout=0.05))
            except queue.Empty:
                if self._failed is not None:
                    raise self._failed from None
                if time.monotonic() > deadline:
                    raise DeviceTimeout(
                        f"{self.name}: fewer than {frames} frames within {timeout_s} s"
                    ) from None
        return take(self._pending, frames, self._rate_hz)

    # -- output ----------------------------------------------------------------------------

    def drive(self, tone: Tone) -> Tone:
        if not self._running:
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
        failed = self._failed
        return StreamStatus(
            running=self._running and failed is None,
            frames=self._frames,
            lost_frames=sum(gap.frames for gap in tuple(self._gaps)),
            gaps=tuple(self._gaps),
            output_v=self.guard.output_v if self._running and failed is None else 0.0,
            muted=self.guard.muted,
            fault=None if failed is None else str(failed),
            detail={"device": self.settings.device, "rate_hz": repr(self._rate_hz)},
        )

    def stop(self) -> None:
        """Ramp to zero, let the lead play out, end both tasks; harmless when not running."""
        if not self._running:
            return
        self.guard.silence()
        lead_s = (self.settings.lead_blocks + 1) * self.settings.block_frames / self._rate_hz
        deadline = time.monotonic() + self.limits.silence_ramp_s + lead_s + 1.0
        while self.guard.output_v > 0 and self._failed is None and time.monotonic() < deadline:
            time.sleep(0.002)
        if self._failed is None:
            time.sleep(lead_s)
        self._running = False
        if self._thread is not None:
            self._thread.join()
        self._release()
        self.guard.restart()

    def _release(self) -> None:
        tasks, self._tasks = self._tasks, None
        for task in tasks or ():
            if task is not None:
                with contextlib.suppress(self._ni.error):
                    task.close()

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
