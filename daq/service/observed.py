"""A rig seen by an audience: what is read also goes to the live stream, thinned, at no risk.

`observe` wraps a rig; every block that the campaign reads is put into a bounded queue, from which
a thread of its own makes levels, a waveform and a spectrum a few times a second. When that thread
lags, blocks are dropped for the audience only.
"""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from daq.service.run_data import amplitude_spectrum
from drivers.protocols import DuplexRig
from drivers.types import Block, Channel
from drivers.wrapped import WrappedRig

FloatArray = npt.NDArray[np.float64]
Publish = Callable[[str, dict[str, Any], npt.NDArray[Any] | None], None]
PERIOD_S = 0.125  # between two pictures
WAVE_S = 0.06  # ten periods of 170 Hz
WAVE_POINTS = 400
SPECTRUM_S = 1.0
SPECTRUM_TOP_HZ = 1000.0
ABILITIES = (
    *("flame_off", "flame_on", "operating_ranges", "operate", "run_notes"),
    *("interlock_tripped", "interlock_open", "reset_interlock"),
)


class Audience:
    """Turns blocks into events `levels`, `waveform` and `spectrum`."""

    def __init__(self, rig: DuplexRig, publish: Publish, period_s: float = PERIOD_S) -> None:
        self._rig = rig
        self._publish = publish
        self._period_s = period_s
        self._blocks: deque[Block] = deque(maxlen=200)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="audience")
        self._pictures = 0

    def start(self) -> None:
        self._thread.start()

    def put(self, block: Block) -> None:
        """From the campaign's thread; never waits."""
        self._blocks.append(block)

    def close(self) -> None:
        """Show what is left, and end."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def _run(self) -> None:
        rate = self._rig.sample_rate_hz
        recent = np.zeros((0, len(self._rig.channels)))
        while True:
            last = self._over.wait(self._period_s)
            blocks = []
            while self._blocks:
                blocks.append(self._blocks.popleft().samples)
            if blocks:
                recent = np.concatenate([recent, *blocks])[-round(SPECTRUM_S * rate) :]
                self._picture(recent, rate)
            if last:
                return

    def _picture(self, recent: FloatArray, rate: float) -> None:
        channels = self._rig.channels
        values = recent / np.array([channel.volts_per_unit for channel in channels])
        newest = recent[-max(1, round(self._period_s * rate)) :]
        status, limits = self._rig.status(), self._rig.limits
        self._publish(
            "levels",
            {
                "channels": [_level(c, newest[:, i]) for i, c in enumerate(channels)],
                "output_v": status.output_v,
                "limit_v": limits.max_amplitude_v,
                "muted": status.muted,
                "fault": status.fault,
                "frames": status.frames,
                "lost_frames": status.lost_frames,
            },
            None,
        )
        wave = values[-round(WAVE_S * rate) :]
        step = max(1, wave.shape[0] // WAVE_POINTS)
        about = {"channels": [c.name for c in channels], "units": [c.unit for c in channels]}
        self._publish("waveform", {**about, "rate_hz": rate / step}, wave[::step])
        self._pictures += 1
        if self._pictures % 3 == 1 and recent.shape[0] > 0.2 * rate:
            frequency, lines = amplitude_spectrum(values, rate)
            inside = frequency <= SPECTRUM_TOP_HZ
            shown = 20 * np.log10(np.maximum(lines[inside], 1e-9))
            step_hz = rate / recent.shape[0]
            self._publish("spectrum", {**about, "step_hz": step_hz, "unit": "dB"}, shown)


def _level(channel: Channel, volts: FloatArray) -> dict[str, Any]:
    peak = float(np.max(np.abs(volts)))
    return {
        "name": channel.name,
        "unit": channel.unit,
        "rms": float(np.sqrt(np.mean(volts**2)) / abs(channel.volts_per_unit)),
        "peak": peak / abs(channel.volts_per_unit),
        "of_full_scale": peak / channel.full_scale_v,
    }


class ObservedRig(WrappedRig):
    """A `DuplexRig` that shows what is read to an audience; all else goes straight through."""

    def __init__(self, rig: DuplexRig, publish: Publish) -> None:
        super().__init__(rig)
        self._audience = Audience(rig, publish)
        self._audience.start()

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        block = self.inner.read(frames, timeout_s)
        self._audience.put(block)
        return block

    def close(self) -> None:
        self.inner.close()
        self._audience.close()


def observe(rig: DuplexRig, publish: Publish) -> ObservedRig:
    """Wrap `rig`, keeping what it can do beyond a duplex rig."""
    watched = ObservedRig(rig, publish)
    for verb in ABILITIES:
        if hasattr(rig, verb):
            setattr(watched, verb, getattr(rig, verb))
    return watched
