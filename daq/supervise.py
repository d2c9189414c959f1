"""Watching over a campaign: limits on channels, drift of the limit cycle, ways to break off.

A `Limit` bounds what a channel reads, block by block, in the channel's own unit. Crossing it
silences the drive at once (before anybody decides anything), then either ends the campaign or
suspends it: the campaign waits until the channel has stayed inside the limit, less a hysteresis,
for `clear_s`, looks at the limit cycle anew and repeats the condition that was interrupted. An
interlock that opens has stopped the rig already; an `InterlockRule` says what the campaign does.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from daq.errors import CampaignError
from drivers.types import Block, Channel


class Interruption(Exception):
    """Something ends what a campaign is doing; not an error of the program."""


class StopRequested(Interruption):
    """The campaign shall end now; the output is silenced. It can be resumed."""


class SkipRequested(Interruption):
    """The present condition shall be left out."""


class Paused(Interruption):
    """The operator wants silence for a while."""


def end_asked(control: Callable[[], None]) -> str | None:
    """Why a campaign's `control` asks for its end; None where it does not."""
    try:
        control()
    except StopRequested as asked:
        return str(asked) or "stopped on request"
    except SkipRequested:
        pass
    return None


class LimitExceeded(Interruption):
    """A channel left its bounds."""

    def __init__(self, limit: "Limit", value: float) -> None:
        super().__init__(limit.describe(value))
        self.limit = limit


class InterlockTripped(Interruption):
    """An interlock opened and stopped the rig."""


class LimitCycleLost(Interruption):
    """There is no limit cycle any more: blow-off, a change of the operating point."""


@dataclass(frozen=True)
class Limit:
    """Bounds of one channel, in its unit.

    `statistic`: the largest magnitude in a block (pressure), or its mean (temperature, flow).
    `hysteresis`: how far inside, relative to the bound, the channel must be to go on.
    """

    channel: str
    high: float | None = None
    low: float | None = None
    statistic: Literal["peak", "mean"] = "peak"
    action: Literal["suspend", "end"] = "suspend"
    hysteresis: float = 0.05
    clear_s: float = 2.0
    wait_s: float = 600.0

    def broken(self, value: float, *, margin: float = 0.0) -> bool:
        """Whether `value` lies outside the bounds, narrowed by `margin` of each."""
        above = self.high is not None and value > self.high - margin * abs(self.high)
        below = self.low is not None and value < self.low + margin * abs(self.low)
        return above or below

    def describe(self, value: float) -> str:
        """What was crossed, by how much."""
        bound = f"<= {self.high:g}" if self.high is not None else ""
        if self.low is not None:
            bound = f"{bound} and >= {self.low:g}" if bound else f">= {self.low:g}"
        return f"channel {self.channel!r}: {self.statistic} {value:.4g} is not {bound}"


@dataclass(frozen=True)
class InterlockRule:
    """What follows when an interlock opens: the campaign ends, or is suspended until all of them
    have been closed for `clear_s` on end, resets the stop itself and goes on; it ends after
    `wait_s`."""

    action: Literal["suspend", "end"] = "suspend"
    clear_s: float = 5.0
    wait_s: float = 600.0


def problem(limits: Sequence[Limit], channels: Sequence[Channel]) -> str | None:
    """What of the limits cannot be watched on a rig of these channels."""
    names = [channel.name for channel in channels]
    for limit in limits:
        if limit.channel not in names:
            return f"limits name the channel {limit.channel!r}; the rig has {', '.join(names)}"
    return None


class Supervisor:
    """Applies limits to blocks. Raises `CampaignError` for a limit on an unknown channel."""

    def __init__(self, limits: Sequence[Limit], channels: Sequence[Channel]) -> None:
        if text := problem(limits, channels):
            raise CampaignError(text)
        names = [channel.name for channel in channels]
        self._watched = [
            (limit, names.index(limit.channel), channels[names.index(limit.channel)].volts_per_unit)
            for limit in limits
        ]

    def check(self, block: Block) -> None:
        """Raises `LimitExceeded` for the first limit that the block breaks."""
        for limit, column, volts_per_unit in self._watched:
            value = _value(limit, block, column, volts_per_unit)
            if limit.broken(value):
                raise LimitExceeded(limit, value)

    def clear(self, block: Block) -> bool:
        """Whether every channel is inside its limits, hysteresis included."""
        return not any(
            limit.broken(_value(limit, block, column, scale), margin=limit.hysteresis)
            for limit, column, scale in self._watched
        )


def _value(limit: Limit, block: Block, column: int, volts_per_unit: float) -> float:
    values = block.samples[:, column] / volts_per_unit
    return float(np.max(np.abs(values)) if limit.statistic == "peak" else np.mean(values))
