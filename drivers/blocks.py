"""Cutting and joining blocks: what every `read` does with what its device delivers.

Frames that belong together stay together: a block never spans a gap, so `take` returns fewer
frames than asked right before one.
"""

from collections.abc import Sequence

import numpy as np

from drivers.types import Block


def part(block: Block, start: int, stop: int, rate_hz: float) -> Block:
    """Rows `start`…`stop` of a block; what happened right before it stays with its first row."""
    flags = block.flags if start == 0 else block.flags - {"gap", "repeated"}
    time_s = block.time_s + start / rate_hz
    return Block(block.first_frame + start, block.samples[start:stop], time_s, flags)


def _reach(pending: Sequence[Block]) -> int:
    """How many of the first blocks are contiguous."""
    for number in range(1, len(pending)):
        if pending[number].first_frame != pending[number - 1].end_frame:
            return number
    return len(pending)


def enough(pending: Sequence[Block], frames: int) -> bool:
    """Whether `take` can give `frames` frames, or all there are before a gap."""
    reach = _reach(pending)
    return reach < len(pending) or sum(block.frames for block in pending) >= frames


def take(pending: list[Block], frames: int, rate_hz: float) -> Block:
    """Remove the first `frames` frames, or those before a gap, from `pending`; see `enough`."""
    taken: list[Block] = []
    missing = frames
    for _ in range(_reach(pending)):
        block = pending.pop(0)
        if block.frames > missing:
            pending.insert(0, part(block, missing, block.frames, rate_hz))
            block = part(block, 0, missing, rate_hz)
        taken.append(block)
        missing -= block.frames
        if missing == 0:
            break
    return Block(
        first_frame=taken[0].first_frame,
        samples=np.concatenate([block.samples for block in taken]),
        time_s=taken[0].time_s,
        flags=frozenset().union(*(block.flags for block in taken)),
    )
