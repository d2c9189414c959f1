"""Sample fast, keep less: decimation by a linear-phase filter, block by block.

Where the hardware has no analogue anti-aliasing filter, oversample and decimate. The filter is a
Kaiser-windowed FIR, symmetric, so its phase is exactly linear: a delay of (taps − 1)/2 samples at
the input rate, which is taken out of the frame times. What goes into the run's notes: passband,
stopband, ripple, delay.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import signal

from daq.errors import InputError

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Filter:
    """One within ±`ripple` up to `passband_hz`; `attenuation_db` down from `stopband_hz` on."""

    factor: int
    input_rate_hz: float
    passband_hz: float
    stopband_hz: float
    attenuation_db: float
    ripple: float
    taps: FloatArray

    @property
    def delay_frames(self) -> int:
        """Delay of the filter, in frames of the input; always whole."""
        return (self.taps.size - 1) // 2

    def notes(self) -> dict[str, Any]:
        """For the run: everything but the taps."""
        described = asdict(self)
        del described["taps"]
        return {**described, "taps": int(self.taps.size), "phase": "linear, delay removed"}


def design(
    input_rate_hz: float, factor: int, *, passband: float = 0.8, attenuation_db: float = 100.0
) -> Filter:
    """A filter for decimation by `factor`.

    Parameters
    ----------
    passband : edge of the passband as a share of the output's Nyquist frequency; what would alias
        into the passband is attenuated, what aliases above it need not be.
    """
    if factor < 2 or not 0 < passband < 1:
        raise InputError(f"factor={factor}, passband={passband}: need an integer >= 2, a share < 1")
    nyquist = input_rate_hz / factor / 2
    edge, stop = passband * nyquist, (2 - passband) * nyquist
    width = (stop - edge) / (input_rate_hz / 2)
    count, beta = signal.kaiserord(attenuation_db, width)
    count = int(count) | 1  # odd: a whole delay
    taps = signal.firwin(count, nyquist, window=("kaiser", beta), fs=input_rate_hz)
    frequencies, response = signal.freqz(taps, worN=16384, fs=input_rate_hz)
    inside = np.abs(response[frequencies <= edge])
    outside = np.abs(response[frequencies >= stop])
    return Filter(
        factor=factor,
        input_rate_hz=input_rate_hz,
        passband_hz=edge,
        stopband_hz=stop,
        attenuation_db=-20 * float(np.log10(max(outside.max(initial=0.0), 1e-16))),
        ripple=float(np.max(np.abs(inside - 1))),
        taps=np.asarray(taps, dtype=np.float64),
    )


class Decimator:
    """Feeds on blocks of any size; what comes out does not depend on their sizes.

    The filter's delay is taken out: output frame m stands for input frame m · factor. The last
    `delay_frames` input frames need what follows them, so `finish` gives what is left, with zeros
    behind it.
    """

    def __init__(self, design: Filter, channels: int) -> None:
        self.design = design
        self._pending: FloatArray = np.zeros((design.delay_frames, channels))
        self._skip = 0  # frames of `_pending` before the next output's window begins

    def feed(self, samples: FloatArray) -> FloatArray:
        """Output frames, shape (n, channels), that the input so far allows."""
        joined = np.concatenate([self._pending, samples])
        taps, factor = self.design.taps, self.design.factor
        available = joined.shape[0] - self._skip - taps.size
        count = available // factor + 1 if available >= 0 else 0
        if count == 0:
            self._pending = joined
            return np.empty((0, joined.shape[1]))
        last = self._skip + (count - 1) * factor + taps.size
        windows = np.lib.stride_tricks.sliding_window_view(
            joined[self._skip : last], taps.size, axis=0
        )
        out = windows[::factor] @ taps  # symmetric, so no reversal
        consumed = self._skip + count * factor
        keep = min(consumed, joined.shape[0])
        self._pending = joined[keep:].copy()
        self._skip = consumed - keep
        return np.asarray(out)

    def finish(self) -> FloatArray:
        """What the last frames give, with silence behind them."""
        return self.feed(np.zeros((self.design.delay_frames, self._pending.shape[1])))
