"""A rig sampled faster than wanted, filtered and thinned out: anti-aliasing in software.

`OversamplingRig` stands behind the same protocol as the rig inside it, at the lower rate. Output
verbs go straight through. Frames come `delay` later than they were sampled and are numbered and
timed as sampled; a gap inside starts the filter anew and shows as a gap outside.
"""

from typing import Any

import numpy as np

from daq.decimate import Decimator, design
from drivers.protocols import DuplexRig
from drivers.types import (
    Block,
    Flag,
    FloatArray,
    Gap,
    StreamStatus,
    require,
)
from drivers.wrapped import WrappedRig

INPUT_BLOCK_S = 0.01


class OversamplingRig(WrappedRig):
    """`rig` at 1/`factor` of its sample rate."""

    def __init__(self, rig: DuplexRig, factor: int, *, passband: float = 0.8) -> None:
        super().__init__(rig)
        self.filter = design(rig.sample_rate_hz, factor, passband=passband)
        self._gaps: list[Gap] = []
        self._origin_s: float | None = None  # clock time of frame 0
        self._ready: FloatArray = np.empty((0, len(rig.channels)))
        self._next = 0  # number of the first frame of `_ready`
        self._skip = 0
        self._inner_next: int | None = None
        self._begin(0)

    def run_notes(self) -> dict[str, Any]:
        """What a run should say of the filter."""
        return {"decimation": self.filter.notes()}

    # what it is

    @property
    def sample_rate_hz(self) -> float:
        return self.inner.sample_rate_hz / self.filter.factor

    def status(self) -> StreamStatus:
        """The inner stream's, counted in frames of the lower rate."""
        inner = self.inner.status()
        return StreamStatus(
            running=inner.running,
            frames=inner.frames // self.filter.factor,
            lost_frames=sum(gap.frames for gap in self._gaps),
            xruns=inner.xruns,
            gaps=tuple(self._gaps),
            output_v=inner.output_v,
            muted=inner.muted,
            fault=inner.fault,
            detail=inner.detail,
        )

    # input

    def start(self) -> None:
        if not self.inner.status().running:
            self._gaps = []
            self._origin_s = None
            self._begin(0)
        self.inner.start()

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        require(frames >= 1, "frames", frames, "an integer >= 1")
        flags: set[Flag] = set()
        while len(self._ready) < frames:
            flags |= self._take_in(timeout_s)
        samples, self._ready = self._ready[:frames].copy(), self._ready[frames:]
        first = self._next
        self._next += frames
        time_s = (self._origin_s or 0.0) + first / self.sample_rate_hz
        return Block(first, samples, time_s, frozenset(flags))

    def stop(self) -> None:
        self.inner.stop()
        self._begin(0)

    # output

    def close(self) -> None:
        self.inner.close()
        self._begin(0)

    # the filter's course

    def _begin(self, next_frame: int, skip: int = 0) -> None:
        """A fresh filter; `skip` inner frames first, so that numbers stay on the low grid."""
        self._decimator = Decimator(self.filter, len(self.inner.channels))
        self._ready = np.empty((0, len(self.inner.channels)))
        self._next = next_frame
        self._skip = skip
        self._inner_next = None

    def _take_in(self, timeout_s: float) -> set[Flag]:
        """One block from inside, through the filter."""
        size = max(self.filter.factor, round(INPUT_BLOCK_S * self.inner.sample_rate_hz))
        block = self.inner.read(size, timeout_s)
        flags: set[Flag] = set(block.flags)
        if self._origin_s is None:
            self._origin_s = block.time_s - block.first_frame / self.inner.sample_rate_hz
        if self._inner_next is not None and block.first_frame != self._inner_next:
            self._jump(block.first_frame)
            flags.add("gap")
        self._inner_next = block.end_frame
        out = self._decimator.feed(block.samples[self._skip :])
        self._skip = max(0, self._skip - block.frames)
        self._ready = np.concatenate([self._ready, out])
        return flags

    def _jump(self, inner_frame: int) -> None:
        """After a gap: what was waiting is given up with it, since a block never spans one."""
        first = -(-inner_frame // self.filter.factor)
        self._gaps.append(Gap(self._next, first - self._next))
        self._begin(first, first * self.filter.factor - inner_frame)
