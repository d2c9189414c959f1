"""Frames counted against a monotonic clock, because a driver's flags miss some losses.

At time t since the first callback a stream of rate fs should have delivered fs·t frames. What it
is short of, d = fs·t − n, is jitter (callbacks come late, never early) on top of what was lost,
so the smallest d within a window is free of jitter. Two clocks that run apart let that minimum
creep, by 0.1 frame in a thousand at 100 ppm; a loss lets it jump. A jump between neighbouring
windows by more than `tolerance_s` therefore counts as a loss of that many frames.

Limits: a loss shorter than the tolerance is not seen, and neither is one after which the server
plays catch-up; a sample counter (`drivers.counter`) sees both.
"""

import math


class ClockCheck:
    """Scalars only: `add` may run inside an audio callback."""

    __slots__ = ("_baseline", "_ends_s", "_frames", "_lowest", "_rate", "_tolerance", "_window_s")

    def __init__(self, rate_hz: float, window_s: float = 1.0, tolerance_s: float = 0.02) -> None:
        self._rate = rate_hz
        self._window_s = window_s
        self._tolerance = tolerance_s * rate_hz
        self._baseline = math.nan
        self._lowest = math.inf
        self._ends_s = math.nan
        self._frames = 0

    def add(self, now_s: float, frames: int) -> int:
        """Count a callback's frames; returns how many frames were found missing just now."""
        self._frames += frames
        deficit = self._rate * now_s - self._frames
        if math.isnan(self._ends_s):
            self._ends_s = now_s + self._window_s
        self._lowest = min(self._lowest, deficit)
        if now_s < self._ends_s:
            return 0
        lowest, self._lowest = self._lowest, math.inf
        self._ends_s = now_s + self._window_s
        missing = 0 if math.isnan(self._baseline) else lowest - self._baseline
        self._baseline = lowest
        return round(missing) if missing > self._tolerance else 0
