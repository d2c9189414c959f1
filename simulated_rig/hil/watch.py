"""Is the plant keeping up? Deadlines, losses, and when either is a fault.

A block's deadline is its own duration: a plant that takes longer to compute a block than the block
lasts falls behind, and lives on buffers. One such miss is counted; `misses_in_a_row` are a fault,
as no buffer lasts. Data that were lost (a flagged xrun, frames missing from the counter) are a
fault at once, beyond `settle_s` after the start, in which servers fill their buffers. A fault is
final: it has a reason, the outputs are silent from then on, and the run ends with it.
"""

import time
from dataclasses import dataclass

from drivers.types import require


@dataclass(frozen=True)
class WatchSettings:
    """What is tolerated."""

    misses_in_a_row: int = 8
    allowed_losses: int = 0
    late_s: float = 0.25  # behind the clock, where the clock paces the plant
    settle_s: float = 1.0

    def __post_init__(self) -> None:
        require(self.misses_in_a_row >= 1, "misses_in_a_row", self.misses_in_a_row, ">= 1")
        require(self.allowed_losses >= 0, "allowed_losses", self.allowed_losses, ">= 0")
        require(self.late_s > 0, "late_s", self.late_s, "> 0")
        require(self.settle_s >= 0, "settle_s", self.settle_s, ">= 0")


@dataclass(frozen=True)
class Timing:
    """`load` is computing time over the blocks' duration: the mean, and the worst block's."""

    blocks: int = 0
    frames: int = 0
    misses: int = 0
    xruns: int = 0
    lost_frames: int = 0
    load: float = 0.0
    worst_load: float = 0.0
    worst_late_s: float = 0.0


class Watch:
    """Written by the plant's thread alone, read by any."""

    def __init__(self, settings: WatchSettings, rate_hz: float) -> None:
        self.settings = settings
        self.rate_hz = rate_hz
        self.fault: str | None = None
        self._blocks = self._frames = self._misses = self._row = 0
        self._xruns = self._lost = self._losses = 0
        self._busy_s = self._worst = self._late = 0.0
        self._settled_s = time.monotonic() + settings.settle_s

    def restart(self) -> None:
        """The stream begins now: `settle_s` counts from here."""
        self._settled_s = time.monotonic() + self.settings.settle_s

    @property
    def settled(self) -> bool:
        """Whether servers have had the time to fill their buffers."""
        return time.monotonic() >= self._settled_s

    @property
    def timing(self) -> Timing:
        lasted = self._frames / self.rate_hz
        return Timing(
            blocks=self._blocks,
            frames=self._frames,
            misses=self._misses,
            xruns=self._xruns,
            lost_frames=self._lost,
            load=self._busy_s / lasted if lasted else 0.0,
            worst_load=self._worst,
            worst_late_s=self._late,
        )

    def block(self, frames: int, took_s: float) -> None:
        """A block was computed in `took_s`."""
        load = took_s * self.rate_hz / frames
        self._blocks += 1
        self._frames += frames
        self._busy_s += took_s
        self._worst = max(self._worst, load)
        self._row = self._row + 1 if load > 1.0 else 0
        self._misses += load > 1.0
        if self._row >= self.settings.misses_in_a_row:
            self.fail(
                f"overload: {self._row} blocks in a row took longer than they last "
                f"(the last one {load:.1f} times)"
            )

    def late(self, seconds: float) -> None:
        """How far the plant is behind the clock that paces it."""
        self._late = max(self._late, seconds)
        if seconds > self.settings.late_s:
            self.fail(f"overload: {seconds:.3f} s behind real time, more than late_s")

    def xrun(self, where: str) -> None:
        """The sound server flagged a loss."""
        self._xruns += 1
        self._loss(f"xrun at the {where}")

    def lost(self, frames: int, where: str) -> None:
        """So many frames did not arrive."""
        self._lost += frames
        self._loss(f"{frames} frames lost at the {where}")

    def fail(self, reason: str) -> None:
        """The first reason stays."""
        if self.fault is None:
            self.fault = reason

    def _loss(self, reason: str) -> None:
        if not self.settled:
            return
        self._losses += 1
        if self._losses > self.settings.allowed_losses:
            self.fail(f"{reason}: the data are no longer continuous")
