"""A sample counter that travels through the loop and tells on every lost or repeated frame.

Frame n leaves a spare output channel as the float32 (n mod 2²³ + 1)/2²⁴, exact and at most ½ of
full scale, and comes back on a spare input channel of a digital loop (or a sound server's monitor).
The lag «input frame − counter» is the loop's latency in frames; it must not change. A fall by n
means that n frames never arrived; a rise that some arrived twice, or that the output was
interrupted for so long. Zero means «nothing yet», and later on «interrupted».

A sound server may first play back what an earlier stream left in it. Each stream therefore counts
from a base of its own, and a counter that claims to have left before the stream began is passed
over.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.types import FloatArray

PERIOD = 2**23
SCALE = 2.0**24


def stamp(first_frame: int, index: FloatArray, out: FloatArray) -> None:
    """Write the counter of the frames `first_frame` + `index` into `out`; creates no array."""
    np.add(index, float(first_frame % PERIOD), out=out)
    np.mod(out, PERIOD, out=out)
    np.add(out, 1.0, out=out)
    np.divide(out, SCALE, out=out)


@dataclass(frozen=True, slots=True)
class Slip:
    """At row `row` of a block the lag fell by `missing` frames (rose where negative)."""

    row: int
    missing: int


@dataclass(frozen=True, slots=True)
class Counted:
    """What a block's counters say; `interrupted` when the output fell silent in between."""

    lag: int | None
    slips: tuple[Slip, ...] = ()
    interrupted: bool = False


def compare(
    first_frame: int, column: npt.NDArray[np.float32], lag: int | None, base: int = 0
) -> Counted:
    """Compare the counters in `column` (frames,) with the `lag` seen so far (`None`: none yet).

    `base` is the counter that left with frame 0. Rows without a counter of this stream are passed
    over; once there has been one, they mean that the server ran out of output.
    """
    # What is no counter, such as the noise of an open input, is passed over as well.
    scaled = np.rint(column.astype(np.float64) * SCALE)
    counters = np.where((scaled >= 1) & (scaled <= PERIOD), scaled, 0).astype(np.int64) - 1
    frames = first_frame + np.arange(column.size)
    all_lags = (frames + base - counters) % PERIOD
    # Later on a lag may well be negative: losses take from it.
    rows = np.flatnonzero((counters >= 0) & ((all_lags <= frames) | (lag is not None)))
    if rows.size == 0:
        return Counted(lag, interrupted=lag is not None)
    lags = all_lags[rows]
    before = np.concatenate([[lags[0] if lag is None else lag], lags[:-1]])
    # The lag is known modulo the counter's period; the shorter way round is the true change.
    missing = (before - lags + PERIOD // 2) % PERIOD - PERIOD // 2
    slips = tuple(Slip(int(rows[k]), int(missing[k])) for k in np.flatnonzero(missing))
    start = int(rows[0]) if lag is None else 0
    return Counted(int(lags[-1]), slips, interrupted=rows.size < column.size - start)
