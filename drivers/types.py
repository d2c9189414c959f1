"""What flows between devices and the acquisition: channels, blocks, tones, limits, status.

All values are SI. Samples are volts at the converter; `Channel.volts_per_unit` turns them into
the channel's own unit, and that division happens at analysis, so raw data stay raw.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from drivers.errors import SettingError

Quantity = Literal["pressure", "voltage", "velocity", "heat_release", "temperature", "flow"]
Flag = Literal["overload", "clipped", "xrun", "gap", "repeated", "rate", "muted"]
FloatArray = npt.NDArray[np.float64]


# Units of the same quantities that are not SI, and how many of the SI unit they are.
NOT_SI: dict[str, dict[str, float]] = {
    "Pa": {"µPa": 1e-6, "uPa": 1e-6, "mPa": 1e-3, "hPa": 1e2, "kPa": 1e3, "mbar": 1e2, "bar": 1e5},
    "V": {"µV": 1e-6, "uV": 1e-6, "mV": 1e-3, "kV": 1e3},
    "m/s": {"µm/s": 1e-6, "um/s": 1e-6, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6},
}


FARTHEST_M = 1000.0  # of a microphone from the tube's end; more is a slip


def require(condition: bool, parameter: str, value: object, requirement: str) -> None:
    """Raise `SettingError` naming parameter, value and requirement unless `condition` holds."""
    if not condition:
        raise SettingError(f"{parameter}={value!r} is not {requirement}")


def is_number(value: object) -> bool:
    """Whether it is a finite number; ``true`` is none, nor is text that looks like one."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True)
class Channel:
    """One input channel, in the column order of a block.

    `position_m` is measured from the closed end of the tube; `sensitivity` of a microphone is
    `volts_per_unit` (V/Pa).
    """

    name: str
    quantity: Quantity
    unit: str
    volts_per_unit: float = 1.0
    full_scale_v: float = 10.0
    position_m: float | None = None
    serial_number: str | None = None

    def __post_init__(self) -> None:
        named = (
            self.name.isprintable() and "/" not in self.name and self.name not in ("", ".", "..")
        )
        require(named, "channel name", self.name, "printable text without '/', nor . or ..")
        placed = self.position_m is None or bool(abs(self.position_m) <= FARTHEST_M)
        require(
            placed,
            f"channel {self.name!r}: position_m",
            self.position_m,
            f"a place within {FARTHEST_M:g} m of the closed end",
        )
        require(
            bool(np.isfinite(self.volts_per_unit)) and self.volts_per_unit != 0,
            f"channel {self.name!r}: volts_per_unit",
            self.volts_per_unit,
            "a finite number other than zero",
        )
        require(
            bool(np.isfinite(self.full_scale_v)) and self.full_scale_v > 0,
            f"channel {self.name!r}: full_scale_v",
            self.full_scale_v,
            "a number of volts > 0",
        )


def require_si(channel: Channel) -> Channel:
    """The channel, if its unit is not a known multiple of the SI unit: values would be taken for
    the SI unit's. Raises `SettingError` with what to give instead."""
    for si, others in NOT_SI.items():
        if channel.unit in others:
            scale = channel.volts_per_unit / others[channel.unit]
            raise SettingError(
                f"channel {channel.name!r}: unit={channel.unit!r} is not SI; "
                f"give unit {si!r} and volts_per_unit={scale:.9g}"
            )
    if channel.unit.lower().startswith("db"):
        raise SettingError(
            f"channel {channel.name!r}: unit={channel.unit!r} is no unit of samples; "
            "give the recording's volts and volts_per_unit"
        )
    return channel


@dataclass(frozen=True)
class Block:
    """Consecutive frames of all channels, sampled simultaneously.

    `samples` has shape (frames, channels), in volts. `first_frame` counts frames since the stream
    started, lost ones included: two blocks are contiguous exactly when the second's
    `first_frame` is the first's `first_frame + frames`.
    """

    first_frame: int
    samples: FloatArray
    time_s: float  # the rig clock's time of the first frame
    flags: frozenset[Flag] = frozenset()

    @property
    def frames(self) -> int:
        return int(self.samples.shape[0])

    @property
    def end_frame(self) -> int:
        """Frame number just after the last one here."""
        return self.first_frame + self.frames


@dataclass(frozen=True)
class Tone:
    """A sine at the speaker output: `amplitude_v` · sin(2π `frequency_hz` t + phase).

    The phase is the oscillator's own and stays continuous over changes of either.
    """

    frequency_hz: float
    amplitude_v: float

    def __post_init__(self) -> None:
        require(
            bool(np.isfinite(self.frequency_hz)) and self.frequency_hz > 0,
            "frequency_hz",
            self.frequency_hz,
            "a finite frequency > 0",
        )
        require(
            bool(np.isfinite(self.amplitude_v)) and self.amplitude_v >= 0,
            "amplitude_v",
            self.amplitude_v,
            "a finite amplitude >= 0",
        )


@dataclass(frozen=True)
class OutputLimits:
    """Hard limits that the output driver itself enforces, whatever the caller asks.

    A tone above `max_amplitude_v`, or outside the frequency range, is refused (`SettingError`);
    what leaves the converter is clamped to `max_amplitude_v` besides. Amplitude changes ramp at
    no more than `max_slew_v_per_s`. Unless fed every `dead_man_s`, the output ramps to zero.
    `max_mean_power_w` over `thermal_time_s` into `load_ohm` guards the voice coil (15 W RMS in
    the thesis); `None`: no such budget. Silence is the one change that may be steeper than the
    slew: it takes at most `silence_ramp_s`, long enough not to click the cone, short enough
    to count as at once.
    """

    max_amplitude_v: float
    min_frequency_hz: float = 20.0
    max_frequency_hz: float = 2000.0
    max_slew_v_per_s: float = 20.0
    dead_man_s: float = 2.0
    max_mean_power_w: float | None = None
    thermal_time_s: float = 30.0
    load_ohm: float = 8.0
    silence_ramp_s: float = 0.02

    def __post_init__(self) -> None:
        for name in (
            "max_amplitude_v",
            "min_frequency_hz",
            "max_frequency_hz",
            "max_slew_v_per_s",
            "dead_man_s",
            "thermal_time_s",
            "load_ohm",
            "silence_ramp_s",
        ):
            value = getattr(self, name)
            require(bool(np.isfinite(value)) and value > 0, name, value, "a finite number > 0")
        require(
            self.min_frequency_hz < self.max_frequency_hz,
            "min_frequency_hz",
            self.min_frequency_hz,
            f"below max_frequency_hz={self.max_frequency_hz}",
        )


@dataclass(frozen=True)
class Gap:
    """Frames that never arrived: `frames` of them, starting at `first_frame`."""

    first_frame: int
    frames: int


@dataclass(frozen=True)
class StreamStatus:
    """What is known about a running stream; counts are since `start()`."""

    running: bool
    frames: int = 0
    lost_frames: int = 0
    xruns: int = 0
    gaps: tuple[Gap, ...] = ()
    output_v: float = 0.0  # the amplitude that now leaves the output
    muted: str | None = None  # why the output is silent against the caller's wish
    fault: str | None = None
    detail: dict[str, str] = field(default_factory=dict)
