"""A pistonphone or acoustic calibrator: a known sound pressure level at one frequency.

The sine in the recording is fitted block by block; its mean amplitude over the known pressure is
the sensitivity, the scatter of the blocks and the calibrator's own tolerance its uncertainty.
"""

import math

import numpy as np

from daq.calibration.book import Calibration
from daq.errors import InputError
from daq.lockin import FloatArray, free_cycle, measure

REFERENCE_PA = 20e-6
BLOCKS = 10


def pistonphone(
    volts: FloatArray,
    rate_hz: float,
    subject: str,
    *,
    level_db: float = 94.0,
    frequency_hz: float = 1000.0,
    level_sigma_db: float = 0.2,
    reference: str = "",
) -> Calibration:
    """Sensitivity of a microphone in V/Pa.

    Parameters
    ----------
    volts : (samples,) recording with the calibrator on.
    level_db : rms level re 20 µPa; `level_sigma_db` its standard uncertainty.

    Raises
    ------
    InputError
        The recording is too short, holds no steady tone, or one at another frequency.
    """
    size = volts.size // BLOCKS
    if size < 10 * rate_hz / frequency_hz:
        raise InputError(
            f"{volts.size / rate_hz:.2f} s of recording are too short: {BLOCKS} blocks of ten "
            f"periods of {frequency_hz:g} Hz are needed"
        )
    found = free_cycle(volts, rate_hz, low_hz=20.0, harmonics=1)
    if abs(found.frequency_hz / frequency_hz - 1) > 0.02:
        raise InputError(
            f"the strongest line is at {found.frequency_hz:.1f} Hz, not at the calibrator's "
            f"{frequency_hz:g} Hz"
        )
    amplitudes = np.array(
        [
            measure(volts[i * size : (i + 1) * size], rate_hz, found.frequency_hz).amplitude
            for i in range(BLOCKS)
        ]
    )
    scatter = float(np.std(amplitudes, ddof=1) / np.mean(amplitudes))
    if scatter > 0.02:
        raise InputError(f"the tone varies by {100 * scatter:.1f} %: seat the calibrator anew")
    pascals = math.sqrt(2.0) * REFERENCE_PA * 10 ** (level_db / 20)
    relative = math.hypot(scatter / math.sqrt(BLOCKS), math.log(10) / 20 * level_sigma_db)
    return Calibration(
        subject=subject,
        method="pistonphone",
        value=float(np.mean(amplitudes)) / pascals,
        uncertainty=relative,
        unit="V/Pa",
        reference=reference,
        data={"level_db": level_db, "frequency_hz": found.frequency_hz, "scatter": scatter},
    )
