"""A ring of frames between one writer that must never wait and one reader that may.

The writer is an audio callback or another process: it copies into memory laid out beforehand and
publishes by storing one integer, so it takes no lock and creates no array. The reader owns the
other integer. A ring that is full drops the newest frames and says so: losing the newest keeps
what is already recorded in order, and the loss becomes one `Gap` at a known frame.

Frames are numbered from the start, lost ones included. Losses are kept in a short table of
(slot, frames lost before it); slot k is the k-th frame that was stored. A stream that loses frames
more often than the table is long is `overfull`: its frame numbers are void and it must be given up.

All state lies in two arrays, so that a ring may live in shared memory (`layout`, `Ring(buffer)`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.types import Gap

Samples = npt.NDArray[np.float32]
TABLE = 4096  # losses that a stream can tell apart; one with more of them is of no use
_WRITTEN, _READ, _LOST, _LOSSES = range(4)
_HEADER = 4 + 2 * TABLE


@dataclass(frozen=True, slots=True)
class Span:
    """Consecutive frames taken out of a ring; `gap` when frames were lost right before them."""

    first_frame: int
    samples: Samples
    gap: Gap | None


def size_bytes(capacity: int, channels: int) -> int:
    """Memory that a ring of that shape needs."""
    return _HEADER * 8 + capacity * channels * 4


class Ring:
    """`capacity` frames of `channels` float32 samples.

    Parameters
    ----------
    buffer : writable buffer of at least `size_bytes`, optional
        Shared memory; both ends open the same one. Memory of its own when absent.
    """

    def __init__(self, capacity: int, channels: int, buffer: memoryview | None = None) -> None:
        memory = memoryview(bytearray(size_bytes(capacity, channels))) if buffer is None else buffer
        self._header: npt.NDArray[np.int64] = np.frombuffer(memory, np.int64, _HEADER)
        self._table = self._header[4:].reshape(TABLE, 2)
        self._frames: Samples = np.frombuffer(
            memory, np.float32, capacity * channels, offset=_HEADER * 8
        ).reshape(capacity, channels)
        self.capacity = capacity
        self._losses_seen = 0
        self._lost_before = 0

    @property
    def available(self) -> int:
        """Frames stored and not yet taken."""
        return int(self._header[_WRITTEN] - self._header[_READ])

    @property
    def frames(self) -> int:
        """Frames since the start, lost ones included."""
        return int(self._header[_WRITTEN] + self._header[_LOST])

    @property
    def lost_frames(self) -> int:
        return int(self._header[_LOST])

    @property
    def overfull(self) -> bool:
        """More losses than can be told apart."""
        return bool(self._header[_LOSSES] > TABLE)

    # -- writer ----------------------------------------------------------------------------

    def write(self, samples: Samples) -> int:
        """Store what fits of `samples` (frames, channels); returns the frames dropped."""
        written = int(self._header[_WRITTEN])
        wanted = len(samples)
        kept = min(wanted, self.capacity - (written - int(self._header[_READ])))
        start = written % self.capacity
        first = min(kept, self.capacity - start)
        self._frames[start : start + first] = samples[:first]
        self._frames[: kept - first] = samples[first:kept]
        self._header[_WRITTEN] = written + kept
        if kept < wanted:
            self.lose(wanted - kept)
        return wanted - kept

    def lose(self, frames: int) -> None:
        """Note that `frames` frames never came, right after the last one stored."""
        slot = int(self._header[_WRITTEN])
        losses = int(self._header[_LOSSES])
        self._header[_LOST] += frames
        if losses and self._table[min(losses, TABLE) - 1, 0] == slot:
            self._table[min(losses, TABLE) - 1, 1] += frames
            return
        if losses < TABLE:
            self._table[losses] = (slot, frames)
        self._header[_LOSSES] = losses + 1

    # -- reader ----------------------------------------------------------------------------

    def take(self, frames: int) -> Span:
        """Up to `frames` consecutive frames, copied out; fewer only right before a loss.

        The caller has seen `available` ≥ `frames`.
        """
        read = int(self._header[_READ])
        gap = self._gap_at(read)
        count = min(frames, self._next_loss() - read)
        start = read % self.capacity
        first = min(count, self.capacity - start)
        samples = np.concatenate(
            [self._frames[start : start + first], self._frames[: count - first]]
        )
        self._header[_READ] = read + count
        return Span(read + self._lost_before, samples, gap)

    def gaps(self) -> tuple[Gap, ...]:
        """Every loss so far, read or not."""
        found = []
        before = 0
        for slot, frames in self._table[: self._losses()].tolist():
            found.append(Gap(slot + before, frames))
            before += frames
        return tuple(found)

    def _losses(self) -> int:
        return min(int(self._header[_LOSSES]), TABLE)

    def _next_loss(self) -> int:
        """Slot of the first loss that the reader has not passed; far away when there is none."""
        if self._losses_seen >= self._losses():
            return 2**62
        return int(self._table[self._losses_seen, 0])

    def _gap_at(self, slot: int) -> Gap | None:
        if self._next_loss() != slot:
            return None
        lost = int(self._table[self._losses_seen, 1])
        gap = Gap(slot + self._lost_before, lost)
        self._losses_seen += 1
        self._lost_before += lost
        return gap
