"""Recordings that cannot be identified from are refused on their way in, with what and where.

Refused: samples that are not finite, a channel that is constant (a cable that is not plugged in),
a drive that is silent in a forced run, a forced run whose frequency is not known. Clipping and
noise are not refused: they are flags of quality, judged where the record is used.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from daq.errors import InputError
from daq.records import Kind
from drivers.types import Channel

MOST_V = 1e4  # of a drive; more is a slip


def require_forcing(
    where: str,
    kind: Kind,
    frequency_hz: float | None,
    amplitude_v: float | None,
    sample_rate_hz: float,
) -> None:
    """What is declared of a run's forcing can be; raises `InputError`."""
    if frequency_hz is None:
        if kind == "forced":
            raise InputError(f"{where}: a forced run needs frequency_hz")
    elif not (math.isfinite(frequency_hz) and frequency_hz > 0):
        raise InputError(f"{where}: frequency_hz={frequency_hz} is not a finite frequency > 0")
    elif frequency_hz >= sample_rate_hz / 2:
        raise InputError(
            f"{where}: frequency_hz={frequency_hz} is not below half the sample rate, "
            f"{sample_rate_hz / 2:g} Hz"
        )
    if amplitude_v is not None and not 0 <= amplitude_v <= MOST_V:
        raise InputError(f"{where}: amplitude_v={amplitude_v} is not from 0 to {MOST_V:g} V")


def require_apart(where: str, channels: Sequence[Channel]) -> None:
    """Microphones stand at more than one place, where places are told; raises `InputError`."""
    placed = [c for c in channels if c.quantity == "pressure" and c.position_m is not None]
    if len(placed) > 1 and len({c.position_m for c in placed}) == 1:
        raise InputError(
            f"{where}: {', '.join(c.name for c in placed)} are all at "
            f"position_m={placed[0].position_m:g}: the velocity needs two places; give each its own"
        )


@dataclass
class SampleCheck:
    """Watches the samples of one recording go by, slice by slice.

    Call `see` with slices of shape (frames, channels) in order, then `conclude`.
    """

    where: str
    kind: Kind
    channels: Sequence[Channel]
    sample_rate_hz: float
    frames: int = 0
    low: npt.NDArray[Any] | None = None
    high: npt.NDArray[Any] | None = None

    def see(self, samples: npt.NDArray[Any]) -> None:
        """Raises `InputError` for the first sample that is not a finite number."""
        if samples.dtype.kind == "f" and not np.isfinite(samples).all():
            row, column = np.argwhere(~np.isfinite(samples))[0]
            frame = self.frames + int(row)
            raise InputError(
                f"{self.where}: channel {self.channels[column].name!r} is "
                f"{samples[row, column]} at sample {frame} ({frame / self.sample_rate_hz:.4f} s)"
            )
        low, high = samples.min(axis=0), samples.max(axis=0)
        self.low = low if self.low is None else np.minimum(low, self.low)
        self.high = high if self.high is None else np.maximum(high, self.high)
        self.frames += len(samples)

    def conclude(self) -> None:
        """Raises `InputError` for a constant channel and for a silent drive in a forced run."""
        if self.low is None or self.high is None:
            raise InputError(f"{self.where}: holds no samples")
        for channel, low, high in zip(self.channels, self.low, self.high, strict=True):
            if low != high:
                continue
            if channel.name != "drive":
                raise InputError(
                    f"{self.where}: channel {channel.name!r} is constant at {low:g} over all "
                    f"{self.frames} samples; is it connected?"
                )
            if self.kind == "forced":
                raise InputError(
                    f"{self.where}: a forced run whose drive channel is constant at {low:g}: "
                    "record the drive, or declare the run free"
                )
