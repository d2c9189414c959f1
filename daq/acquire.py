"""From a rig's stream to whoever needs it: the control loop, the recording, live listeners.

One thread (the campaign's) reads blocks and hands each to

- the recording, if one is on (`daq.store_writer.RunWriter`: a queue and a thread of its own);
- the taps: bounded queues for live views. A tap that lags loses its oldest blocks and counts
  them; it can neither slow nor change the recording.

Every read feeds the rig's dead-man timer, so a caller that hangs falls silent.
"""

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from daq.errors import CampaignError
from daq.store_writer import RunWriter
from drivers.protocols import DuplexRig
from drivers.types import Block, Flag, Gap

OVERLOADS: frozenset[Flag] = frozenset({"overload", "clipped"})
MAX_GAPS = 10_000


class Tap:
    """A live view of the stream: the newest blocks, at most `depth` of them."""

    def __init__(self, source: "Acquisition", depth: int) -> None:
        self._source = source
        self._blocks: deque[Block] = deque(maxlen=depth)
        self._arrived = threading.Condition()
        self.dropped = 0

    def get(self, timeout_s: float = 1.0) -> Block | None:
        """The oldest block that is still there; None when none came in time."""
        with self._arrived:
            self._arrived.wait_for(lambda: bool(self._blocks), timeout_s)
            return self._blocks.popleft() if self._blocks else None

    def close(self) -> None:
        """Stop listening; harmless twice."""
        self._source.remove_tap(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def put(self, block: Block) -> None:
        """Called by the acquisition; never waits for a listener's work."""
        with self._arrived:
            if len(self._blocks) == self._blocks.maxlen:
                self.dropped += 1
            self._blocks.append(block)
            self._arrived.notify()


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames as one array, shape (frames, channels), in volts, with what befell them.

    `end_s` is the rig clock's time just after the last frame.
    """

    samples: npt.NDArray[np.float64]
    first_frame: int
    end_s: float
    flags: frozenset[Flag]
    gaps: tuple[Gap, ...]

    @property
    def overload(self) -> bool:
        """Whether a channel reached its converter's limit."""
        return bool(self.flags & OVERLOADS)

    @property
    def intact(self) -> bool:
        """No frame is missing, doubtful or out of range."""
        return not self.gaps and not self.flags


@dataclass(frozen=True)
class Counters:
    """What the stream has brought so far."""

    frames: int = 0
    lost_frames: int = 0
    flags: dict[str, int] = field(default_factory=dict)  # blocks that carried each flag
    gaps: tuple[Gap, ...] = ()


class Acquisition:
    """Reads one rig, block by block.

    Parameters
    ----------
    block_s
        Length of a block. Blocks must be much shorter than the rig's dead-man time.
    guard
        Sees every block first; when it raises, the output is silenced and the exception goes on
        to the caller (after the block has been recorded).
    """

    def __init__(
        self,
        rig: DuplexRig,
        block_s: float = 0.05,
        guard: Callable[[Block], None] | None = None,
    ) -> None:
        self.rig = rig
        self.guard = guard
        if not 0 < block_s <= rig.limits.dead_man_s / 4:
            raise CampaignError(
                f"block_s={block_s} is not a time up to a quarter of the rig's dead-man time, "
                f"{rig.limits.dead_man_s:g} s"
            )
        self._block_frames = max(1, round(block_s * rig.sample_rate_hz))
        self._taps: tuple[Tap, ...] = ()
        self._lock = threading.Lock()
        self._next_frame: int | None = None
        self._end_s = -math.inf  # rig clock's time just after the last frame read
        self._frames = 0
        self._gaps: list[Gap] = []
        self._lost = 0
        self._flags: dict[str, int] = {}

    def tap(self, depth: int = 64) -> Tap:
        """Listen from now on; from any thread."""
        made = Tap(self, depth)
        with self._lock:
            self._taps = (*self._taps, made)
        return made

    def remove_tap(self, tap: Tap) -> None:
        """Stop handing blocks to `tap`."""
        with self._lock:
            self._taps = tuple(other for other in self._taps if other is not tap)

    @property
    def counters(self) -> Counters:
        """A snapshot, from any thread."""
        return Counters(self._frames, self._lost, dict(self._flags), tuple(self._gaps))

    def read(self, frames: int, writer: RunWriter | None = None) -> Stretch:
        """The next `frames` frames; each block also goes to `writer` and to the taps.

        Lost frames are listed in `gaps` (and filled by the writer); they do not count as read.
        """
        blocks: list[Block] = []
        gaps: list[Gap] = []
        missing = frames
        while missing > 0:
            self.rig.feed()
            block = self.rig.read(min(missing, self._block_frames))
            gap = self._account(block)
            if gap is not None:
                gaps.append(gap)
            if writer is not None:
                writer.append(block.samples, block.first_frame, block.flags)
            for tap in self._taps:
                tap.put(block)
            self._watch(block)
            blocks.append(block)
            missing -= block.frames
        return Stretch(
            samples=np.concatenate([block.samples for block in blocks]),
            first_frame=blocks[0].first_frame,
            end_s=self._end_s,
            flags=frozenset().union(*(block.flags for block in blocks)),
            gaps=tuple(gaps),
        )

    def read_seconds(self, seconds: float) -> Stretch:
        """The next `seconds`, at least one frame."""
        return self.read(max(1, round(seconds * self.rig.sample_rate_hz)))

    def read_block(self) -> Block:
        """The next single block."""
        stretch = self.read(self._block_frames)
        start_s = stretch.end_s - len(stretch.samples) / self.rig.sample_rate_hz
        return Block(stretch.first_frame, stretch.samples, start_s, stretch.flags)

    def catch_up(self, time_s: float) -> None:
        """Let the stream pass up to the rig clock's `time_s`.

        What a device has buffered was sampled before now, so waiting means reading on until
        frames come that were sampled late enough, not reading a number of frames.
        """
        rate = self.rig.sample_rate_hz
        if self._end_s == -math.inf:
            self.read(1)
        while (missing := round((time_s - self._end_s) * rate)) > 0:
            self.read(min(missing, self._block_frames))

    def _watch(self, block: Block) -> None:
        if self.guard is None:
            return
        try:
            self.guard(block)
        except BaseException:
            self.rig.silence()
            raise

    def _account(self, block: Block) -> Gap | None:
        gap = None
        if self._next_frame is not None and block.first_frame != self._next_frame:
            gap = Gap(self._next_frame, block.first_frame - self._next_frame)
            self._lost += gap.frames
            if len(self._gaps) < MAX_GAPS:
                self._gaps.append(gap)
        self._next_frame = block.end_frame
        self._end_s = block.time_s + block.frames / self.rig.sample_rate_hz
        self._frames += block.frames
        for flag in block.flags:
            self._flags[flag] = self._flags.get(flag, 0) + 1
        return gap
