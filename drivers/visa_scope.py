"""An oscilloscope or digitiser over VISA, as a pressure input that records block by block.

Each record is simultaneous over its channels and contiguous in itself; between records time
passes unrecorded while the memory is read out, which shows as a gap whose length is taken from
the clock (to a few milliseconds: frame numbers of different records are not phase-exact).

Speaks the command set of Keysight InfiniiVision scopes (Programmer's Guide: ``:DIGitize``,
``:WAVeform:PREamble?``, ``:WAVeform:DATA?``). Checked against our emulator only.
"""

import time
from dataclasses import dataclass

import numpy as np

from drivers.blocks import enough, take
from drivers.errors import DeviceFault, SettingError
from drivers.types import Block, Channel, Flag, FloatArray, Gap, StreamStatus, require
from drivers.visa_link import VisaLink

ERRORS = ":SYST:ERR?"
FULL_SCALE_CODES = (-32768, 32767)


@dataclass(frozen=True, slots=True)
class Preamble:
    """What turns codes into volts: v = (code − `y_reference`)·`y_increment` + `y_origin`."""

    points: int
    x_increment: float
    y_increment: float
    y_origin: float
    y_reference: float

    @classmethod
    def parse(cls, answer: str) -> "Preamble":
        """From ``:WAV:PRE?``: format, type, points, count, xinc, xorg, xref, yinc, yorg, yref."""
        fields = answer.split(",")
        if len(fields) != 10:
            raise DeviceFault(f"preamble {answer!r} has {len(fields)} fields instead of 10")
        try:
            return cls(
                points=int(float(fields[2])),
                x_increment=float(fields[4]),
                y_increment=float(fields[7]),
                y_origin=float(fields[8]),
                y_reference=float(fields[9]),
            )
        except ValueError as error:
            raise DeviceFault(f"preamble {answer!r} holds something else than numbers") from error


class ScopeInput:
    """`PressureInput` on a scope's channels 1…n, in records of `record_frames`."""

    def __init__(
        self,
        link: VisaLink,
        channels: tuple[Channel, ...],
        sample_rate_hz: float,
        record_frames: int,
    ) -> None:
        require(1 <= len(channels) <= 8, "channels", len(channels), "1...8 channels")
        require(record_frames >= 2, "record_frames", record_frames, ">= 2")
        self.link = link
        self._channels = channels
        self._record_frames = record_frames
        self.identity = link.query("*IDN?")
        link.errors(ERRORS)
        duration_s = record_frames / sample_rate_hz
        for command in (":STOP", ":ACQ:TYPE NORM", f":TIM:RANG {duration_s:.9g}"):
            link.set(command, ERRORS)
        for number, channel in enumerate(channels, start=1):
            link.set(f":CHAN{number}:DISP 1", ERRORS)
            link.set(f":CHAN{number}:RANG {2 * channel.full_scale_v:.9g}", ERRORS)
        for command in (":WAV:FORM WORD", ":WAV:BYT LSBF", ":WAV:UNS 0", ":WAV:POIN:MODE RAW"):
            link.set(command, ERRORS)
        link.set(f":WAV:POIN {record_frames}", ERRORS)
        self._rate_hz = float(link.query(":ACQ:SRAT?"))
        require(
            abs(self._rate_hz - sample_rate_hz) <= 1e-3 * sample_rate_hz,
            "sample_rate_hz",
            sample_rate_hz,
            f"a rate of this scope for {record_frames} points, which runs at {self._rate_hz} Hz",
        )
        self._started_s: float | None = None
        self._end_frame = 0
        self._gaps: list[Gap] = []
        self._pending: list[Block] = []

    @property
    def channels(self) -> tuple[Channel, ...]:
        return self._channels

    @property
    def sample_rate_hz(self) -> float:
        return self._rate_hz

    def start(self) -> None:
        self._started_s = time.monotonic()
        self._end_frame = 0
        self._gaps = []
        self._pending = []

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        """Next `frames` frames of the present record, fewer at its end; then a new record."""
        require(frames >= 1, "frames", frames, ">= 1")
        if self._started_s is None:
            raise SettingError("read() of a scope that is not running; start() it")
        if not self._pending:
            self._pending.append(self._record(self._started_s))
        if enough(self._pending, frames):
            return take(self._pending, frames, self._rate_hz)
        return self._pending.pop(0)

    def _record(self, started_s: float) -> Block:
        sources = ",".join(f"CHAN{number + 1}" for number in range(len(self._channels)))
        with self.link.lock:
            began_s = time.monotonic()
            self.link.write(f":DIG {sources}")
            self.link.query("*OPC?")
            columns, clipped = [], False
            for number in range(len(self._channels)):
                volts, overrun = self._fetch(number + 1)
                columns.append(volts)
                clipped = clipped or overrun
            errors = self.link.errors(ERRORS)
        if errors:
            raise DeviceFault(f"{self.link.address}: {'; '.join(errors)}")
        # A slow clock must not let records overlap.
        elapsed = round((began_s - started_s) * self._rate_hz)
        first = 0 if self._end_frame == 0 else max(self._end_frame, elapsed)
        flags: set[Flag] = {"clipped"} if clipped else set()
        if first > self._end_frame:
            self._gaps.append(Gap(self._end_frame, first - self._end_frame))
            flags.add("gap")
        samples = np.column_stack(columns)
        self._end_frame = first + len(samples)
        return Block(first, samples, began_s, frozenset(flags))

    def _fetch(self, number: int) -> tuple[FloatArray, bool]:
        self.link.write(f":WAV:SOUR CHAN{number}")
        preamble = Preamble.parse(self.link.query(":WAV:PRE?"))
        data = self.link.query_block(":WAV:DATA?")
        codes = np.frombuffer(data, "<i2")
        if codes.size != preamble.points or codes.size != self._record_frames:
            raise DeviceFault(
                f"{self.link.address}: channel {number} sent {codes.size} points, its preamble "
                f"says {preamble.points}, asked were {self._record_frames}"
            )
        clipped = bool(np.any((codes <= FULL_SCALE_CODES[0]) | (codes >= FULL_SCALE_CODES[1])))
        steps = codes.astype(np.float64) - preamble.y_reference
        return steps * preamble.y_increment + preamble.y_origin, clipped

    def stop(self) -> None:
        self._started_s = None

    def status(self) -> StreamStatus:
        return StreamStatus(
            running=self._started_s is not None,
            frames=self._end_frame,
            lost_frames=sum(gap.frames for gap in self._gaps),
            gaps=tuple(self._gaps),
            detail={"identity": self.identity, "address": self.link.address},
        )

    def close(self) -> None:
        self.stop()
        self.link.close()
