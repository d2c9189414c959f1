"""From the drive to a pressure channel over frequency: amplifier, speaker and what lies between.

Stepped sine gives each frequency its own settled record and an uncertainty; the sweep is quicker
and moves the tone a little with every block (phase-continuously, which the driver guarantees), and
the ratio of cross to auto spectrum gives the response. Both record the drive, so the amplifier's
own response cancels or not according to where it is recorded (thesis Fig. 5.4).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import signal

from daq.acquire import Acquisition
from daq.conduct import Columns, look
from daq.errors import CampaignError
from drivers.types import Tone

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
SETTLE_S = 0.3
LOOKS = 4


@dataclass(frozen=True)
class FrequencyResponse:
    """Pressure over drive, in the channel's unit per volt; `sigma` is that of the magnitude."""

    frequency_hz: FloatArray
    response: ComplexArray
    sigma: FloatArray


def stepped_sine(
    acquisition: Acquisition,
    columns: Columns,
    frequencies_hz: Sequence[float],
    amplitude_v: float,
    seconds: float = 0.5,
) -> FrequencyResponse:
    """Tone by tone; the output is silent afterwards, whatever happens.

    Raises
    ------
    CampaignError
        The drive is not recorded, so there is no reference.
    """
    _require_drive(columns)
    values, sigmas = [], []
    try:
        for frequency in frequencies_hz:
            acquisition.rig.drive(Tone(frequency, amplitude_v))
            wait = amplitude_v / acquisition.rig.limits.max_slew_v_per_s + SETTLE_S
            acquisition.catch_up(acquisition.rig.clock.now() + wait)
            seen = [look(acquisition, columns, frequency, seconds / LOOKS) for _ in range(LOOKS)]
            ratios = np.array([s.forced / (s.drive_v or math.nan) for s in seen])
            values.append(complex(np.mean(ratios)))
            sigmas.append(float(np.std(np.abs(ratios), ddof=1) / math.sqrt(LOOKS)))
    finally:
        acquisition.rig.silence()
    return FrequencyResponse(np.asarray(frequencies_hz), np.asarray(values), np.asarray(sigmas))


def sweep(
    acquisition: Acquisition,
    columns: Columns,
    low_hz: float,
    high_hz: float,
    amplitude_v: float,
    seconds: float = 10.0,
    segment_s: float = 1.0,
) -> FrequencyResponse:
    """Logarithmic sweep in small steps; see `stepped_sine`."""
    _require_drive(columns)
    rig = acquisition.rig
    block_s = 0.02
    steps = max(2, round(seconds / block_s))
    pressure, drive = [], []
    try:
        for frequency in np.geomspace(low_hz, high_hz, steps):
            rig.drive(Tone(float(frequency), amplitude_v))
            stretch = acquisition.read_seconds(block_s)
            pressure.append(columns.pressure_of(stretch))
            recorded = columns.drive_of(stretch)
            if recorded is not None:
                drive.append(recorded)
    finally:
        rig.silence()
    x, y = np.concatenate(drive), np.concatenate(pressure)
    size = round(segment_s * rig.sample_rate_hz)
    f, power = signal.welch(x, rig.sample_rate_hz, nperseg=size)
    _, other = signal.welch(y, rig.sample_rate_hz, nperseg=size)
    _, cross = signal.csd(x, y, rig.sample_rate_hz, nperseg=size)
    band = (f >= low_hz) & (f <= high_hz)
    response = cross[band] / power[band]
    coherence = np.clip(np.abs(cross[band]) ** 2 / (power[band] * other[band]), 1e-9, 1.0)
    # a sweep passes each frequency in about two segments
    sigma = np.abs(response) * np.sqrt((1 - coherence) / (4 * coherence))
    return FrequencyResponse(f[band], response, sigma)


def _require_drive(columns: Columns) -> None:
    if columns.drive is None:
        raise CampaignError("the rig records no channel named 'drive': wire it back to an input")
