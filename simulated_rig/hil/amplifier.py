"""A power amplifier on a serial line: gain, mute, temperature, and what it does to the volts.

One command a line, answered by ``OK value`` or ``ERR text`` (the protocol of
`drivers.serial_devices`): ``GAIN -6.0``, ``MUTE 1``, ``TEMP``. It is muted when switched on. Its
output clips at the rails, and its heat sink follows

    T' = (R_th P − (T − T_0)) / τ,     P = mean of V²/R into the loudspeaker,

so that sustained power ends in a trip at 90 °C: muted, ``MUTE 0`` refused until below 70 °C.
"""

import threading
from dataclasses import dataclass

import numpy as np

from drivers.types import FloatArray


@dataclass(frozen=True)
class AmplifierSettings:
    """Limits and the heat sink's constants."""

    least_gain_db: float = -60.0
    most_gain_db: float = 26.0
    rail_v: float = 15.0
    load_ohm: float = 8.0
    ambient_c: float = 23.0
    kelvin_per_w: float = 6.0
    time_constant_s: float = 40.0
    trip_c: float = 90.0
    release_c: float = 70.0


class Amplifier:
    """`answer` serves the line, `process` the signal; they may run in different threads."""

    def __init__(self, settings: AmplifierSettings | None = None) -> None:
        self.settings = settings or AmplifierSettings()
        self.gain_db = 0.0
        self.muted = True
        self.tripped = False
        self.temperature_c = self.settings.ambient_c
        self.clipped_samples = 0
        self._lock = threading.Lock()

    def process(self, volts: FloatArray, rate_hz: float) -> FloatArray:
        """At the loudspeaker's terminals."""
        with self._lock:
            gain = 0.0 if self.muted else 10 ** (self.gain_db / 20)
        wanted = gain * volts
        rail = self.settings.rail_v
        self.clipped_samples += int(np.count_nonzero(np.abs(wanted) > rail))
        out: FloatArray = np.clip(wanted, -rail, rail)
        self._heat(float(np.mean(out**2)) / self.settings.load_ohm, volts.size / rate_hz)
        return out

    def _heat(self, power_w: float, seconds: float) -> None:
        s = self.settings
        final = s.ambient_c + s.kelvin_per_w * power_w
        keep = float(np.exp(-seconds / s.time_constant_s))
        with self._lock:
            self.temperature_c = final + (self.temperature_c - final) * keep
            if self.temperature_c >= s.trip_c:
                self.tripped = self.muted = True
            elif self.temperature_c < s.release_c:
                self.tripped = False

    def answer(self, line: str) -> str:
        """The answer to one line."""
        word, _, text = line.strip().partition(" ")
        if word not in ("GAIN", "MUTE", "TEMP"):
            return f"ERR unknown command {word!r}"
        try:
            value = float(text) if text.strip() else None
        except ValueError:
            return f"ERR {text!r} is not a number"
        if value is not None and not np.isfinite(value):
            return f"ERR {text!r} is not finite"
        with self._lock:
            if word == "TEMP":
                return "ERR read only" if value is not None else f"OK {self.temperature_c:.1f}"
            return self._gain(value) if word == "GAIN" else self._mute(value)

    def _gain(self, value: float | None) -> str:
        s = self.settings
        if value is not None:
            if not s.least_gain_db <= value <= s.most_gain_db:
                return f"ERR out of range {s.least_gain_db}...{s.most_gain_db} dB"
            self.gain_db = round(value * 10) / 10  # tenths of a decibel
        return f"OK {self.gain_db:.2f}"

    def _mute(self, value: float | None) -> str:
        if value is not None:
            if value not in (0.0, 1.0):
                return "ERR 0 or 1"
            if self.tripped and value == 0.0:
                return f"ERR over temperature {self.temperature_c:.1f}"
            self.muted = bool(value)
        return f"OK {int(self.muted)}"
