"""From the ring's raw frames to blocks in volts, numbered and flagged.

Runs in the reader's thread. Losses come from two sides: those that the ring knows (it was full, or
the frame count fell behind the clock), and those that only the sample counter shows. The latter
shift the numbering of everything that follows; `shift` holds their sum.
"""

from dataclasses import dataclass, field

import numpy as np

from drivers import counter
from drivers.audio_callback import XRUNS, AudioCallback
from drivers.audio_settings import SoundCardSettings
from drivers.counter import Counted, Slip
from drivers.ring import Samples, Span
from drivers.types import Block, Flag, FloatArray, Gap

CLIP = 1.0 - 2.0**-15  # a 16-bit converter's largest sample


@dataclass
class BlockMaker:
    """The reader's state of one stream."""

    settings: SoundCardSettings
    rate_hz: float
    callback: AudioCallback
    lag: int | None = None
    shift: int = 0
    gaps: list[Gap] = field(default_factory=list)
    _clock_losses: int = 0

    def blocks(self, span: Span, muted: bool) -> list[Block]:
        """`span` in volts, cut where the sample counter slipped."""
        raw = span.samples[:, list(self.settings.columns)]
        scale = np.array([channel.full_scale_v for channel in self.settings.channels])
        return self._cut(span, raw.astype(np.float64) * scale, self._flags(span, raw, muted))

    def _flags(self, span: Span, raw: Samples, muted: bool) -> set[Flag]:
        flags: set[Flag] = set()
        if np.any(np.abs(raw) >= CLIP):
            flags.add("clipped")
        xruns = self.callback.xrun_frames[: min(self.callback.xruns, XRUNS)]
        if np.any((xruns >= span.first_frame) & (xruns < span.first_frame + len(raw))):
            flags.add("xrun")
        if self.callback.clock_losses != self._clock_losses:
            self._clock_losses = self.callback.clock_losses
            flags.add("rate")
        if muted:
            flags.add("muted")
        return flags

    def _cut(self, span: Span, volts: FloatArray, flags: set[Flag]) -> list[Block]:
        if span.gap is not None:
            self._lost(span.gap.first_frame, span.gap.frames, flags)
        blocks = []
        row = 0
        counted = self._counted(span)
        if counted.interrupted:
            flags.add("xrun")
        for slip in (*counted.slips, Slip(len(volts), 0)):
            if slip.row > row:
                first = span.first_frame + row + self.shift
                piece = volts[row : slip.row]
                blocks.append(Block(first, piece, self.time_s(first), frozenset(flags)))
                flags -= {"gap", "repeated"}
            row = slip.row
            if slip.missing > 0:
                self._lost(span.first_frame + row, slip.missing, flags)
                self.shift += slip.missing
            elif slip.missing < 0:
                flags.add("repeated")
        return blocks

    def _lost(self, ring_frame: int, frames: int, flags: set[Flag]) -> None:
        self.gaps.append(Gap(ring_frame + self.shift, frames))
        flags.add("gap")

    def _counted(self, span: Span) -> Counted:
        """On the ring's own numbering, where losses that the ring knows leave the lag alone."""
        if self.settings.counter is None:
            return Counted(None)
        column = span.samples[:, self.settings.counter[1]]
        counted = counter.compare(span.first_frame, column, self.lag, self.callback.counter_base)
        self.lag = counted.lag
        return counted

    def time_s(self, frame: int) -> float:
        """The monotonic clock's time of a frame, reckoned from the first callback."""
        return (self.callback.started_s or 0.0) + frame / self.rate_hz
