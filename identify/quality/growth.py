"""Does a line grow or die away inside a run? One that does is a mode of the rig's own, that begins
to sing or still rings; a tone from outside stands.

The rest of the recording is demodulated at the line's frequency over BLOCKS stretches under a Hann
window; the logarithm of their amplitudes is a straight line in time where it grows exponentially,
and its scatter about that, be it of noise or of a beat, gives the standard error.
"""

from dataclasses import dataclass

import numpy as np

from identify.quality.view import View

BLOCKS = 8
SIGMAS = 10.0  # Student's t of six degrees of freedom: 6e-5
LEAST = 0.05  # change over the run, relative, below which a line stands


@dataclass(frozen=True)
class Growth:
    """Exponential rate of a line's amplitude (negative: it dies away) and its standard error, in
    1/s, over a run of `seconds`."""

    rate: float
    stderr: float
    seconds: float

    @property
    def significant(self) -> bool:
        changes = abs(self.rate) * self.seconds > LEAST
        return changes and abs(self.rate) > SIGMAS * self.stderr


def growth(view: View, channel: int, frequency_hz: float) -> Growth:
    """Of the line at `frequency_hz` in input number `channel`."""
    rate, size = view.run.sample_rate_hz, view.rest.shape[1] // BLOCKS
    rest = view.rest[channel, : BLOCKS * size].reshape(BLOCKS, size)
    turn = np.exp(-2j * np.pi * frequency_hz / rate * np.arange(size))
    amplitude = np.abs(rest @ (np.hanning(size) * turn))
    t = (np.arange(BLOCKS) - (BLOCKS - 1) / 2) * size / rate
    log = np.log(np.maximum(amplitude, 1e-300))
    slope = float(t @ log / (t @ t))
    left = log - log.mean() - slope * t
    stderr = float(np.sqrt(left @ left / (BLOCKS - 2) / (t @ t)))
    return Growth(slope, stderr, BLOCKS * size / rate)
