"""Which sound card a rig uses, through which channels, and at what rate."""

from dataclasses import dataclass

import numpy as np

from drivers.types import Channel, require


@dataclass(frozen=True)
class SoundCardSettings:
    """Which card, which channels, how fast.

    `input_columns` are the card's input channels of `channels`, in order (default: the first
    ones). `counter` is the (output, input) pair of a digital loop for the sample counter.
    `check_clock` is off only where the server does not run in real time (JACK freewheel).
    """

    input_device: str
    output_device: str
    host_api: str
    channels: tuple[Channel, ...]
    sample_rate_hz: float = 48000.0
    input_columns: tuple[int, ...] | None = None
    speaker: int = 0
    output_full_scale_v: float = 1.0
    latency_s: float = 0.05
    counter: tuple[int, int] | None = None
    ring_s: float = 10.0
    check_clock: bool = True
    name: str = "sound card"

    def __post_init__(self) -> None:
        require(len(self.channels) > 0, "channels", self.channels, "at least one channel")
        require(
            len(self.columns) == len(self.channels) and min(self.columns) >= 0,
            "input_columns",
            self.input_columns,
            f"one channel number >= 0 for each of the {len(self.channels)} channels",
        )
        require(self.speaker >= 0, "speaker", self.speaker, "an output channel number >= 0")
        require(
            1000.0 <= self.sample_rate_hz <= 192000.0,
            "sample_rate_hz",
            self.sample_rate_hz,
            "within 1 kHz...192 kHz",
        )
        for name in ("output_full_scale_v", "latency_s", "ring_s"):
            value = getattr(self, name)
            require(bool(np.isfinite(value)) and value > 0, name, value, "a finite number > 0")

    @property
    def columns(self) -> tuple[int, ...]:
        return self.input_columns or tuple(range(len(self.channels)))

    @property
    def input_channels(self) -> int:
        """Channels to open: up to the highest one in use."""
        used = [*self.columns, *([self.counter[1]] if self.counter else [])]
        return 1 + max(used)

    @property
    def output_channels(self) -> int:
        used = [self.speaker, *([self.counter[0]] if self.counter else [])]
        return 1 + max(used)
