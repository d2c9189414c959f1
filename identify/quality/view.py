"""One run as the checks see it: harmonics removed, what remains, and its windowed spectrum.

Everything is taken from the channels that give the velocity (two pressures, or the velocity
itself) and from the drive. The window is Blackman–Harris (four terms, side lobes at −92 dB,
Harris 1978), so that a line shows within ±4 bins only and a weak one stands beside a strong one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from identify.harmonics import (
    Microphones,
    drive_frequency,
    estimate_frequency,
    fit_harmonics,
    microphones,
    usable_harmonics,
)
from identify.record import Medium, Run

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

HARMONICS = 7
MAIN_LOBE = 4  # bins on either side of a line that the window fills
_TERMS = (0.35875, -0.48829, 0.14128, -0.01168)


@dataclass(frozen=True)
class View:
    """A run with its forcing (forced, cold) or its own line (free) taken apart.

    `inputs` (names of the velocity's channels); `coefficients` (channels, K), `rest` (channels,
    samples): of the inputs, then of the drive. `frequency_hz` is the drive's or the free line's.
    """

    run: Run
    medium: Medium
    inputs: tuple[str, ...]
    microphones: Microphones | None
    values: Mapping[str, FloatArray]
    frequency_hz: float
    coefficients: ComplexArray
    rest: FloatArray

    @property
    def name(self) -> str:
        return self.run.name

    @property
    def bin_hz(self) -> float:
        return float(self.run.sample_rate_hz / self.rest.shape[1])

    @property
    def drive(self) -> FloatArray | None:
        return self.values.get("drive")

    @property
    def level(self) -> FloatArray:
        """Amplitude of each input's fundamental, (inputs,)."""
        return np.asarray(np.abs(self.coefficients[: len(self.inputs), 0]))

    @cached_property
    def spectrum(self) -> ComplexArray:
        """Of the inputs' rest, (inputs, bins); |X| is the amplitude of a line on its bin."""
        n = self.rest.shape[1]
        return np.asarray(np.fft.rfft(self.rest[: len(self.inputs)] * window(n)) * (2 / n))

    @cached_property
    def relative_power(self) -> FloatArray:
        """Power (bins,) of the inputs, each over its fundamental's, added."""
        level = np.maximum(self.level[:, None], 1e-300)
        return np.asarray(np.sum((np.abs(self.spectrum) / level) ** 2, axis=0))

    @cached_property
    def rotor(self) -> ComplexArray:
        """exp(−jωt) at the samples, (samples,)."""
        turn = -2j * np.pi * self.frequency_hz / self.run.sample_rate_hz
        return np.asarray(np.exp(turn * np.arange(self.rest.shape[1])))

    @cached_property
    def total(self) -> FloatArray:
        """Mean of the inputs, (samples,): the strongest signal of the rig's state."""
        return np.asarray(np.mean([self.values[n] for n in self.inputs], axis=0))

    def velocity_of(self, spectrum: ComplexArray, frequency_hz: float) -> complex:
        """The velocity (m/s) that amplitudes (inputs,) at one frequency stand for (Eq. 5.2)."""
        if self.microphones is None:
            return complex(spectrum[0])
        scale = self.medium.density_kg_m3 * self.microphones.spacing_m
        return complex(-(spectrum[1] - spectrum[0]) / (scale * 2j * np.pi * frequency_hz))


@lru_cache(maxsize=4)
def window(n: int) -> FloatArray:
    """Blackman–Harris window of n samples with mean 1."""
    phase = 2 * np.pi * np.arange(n) / n
    w = sum(a * np.cos(j * phase) for j, a in enumerate(_TERMS))
    return np.asarray(w / _TERMS[0])


def velocity_channels(run: Run) -> tuple[tuple[str, ...], Microphones | None]:
    """Names of the channels that give the velocity, x growing.

    Raises
    ------
    identify.harmonics.RecordError : neither a velocity nor two placed pressure channels.
    """
    mics = microphones(run)
    if mics is not None:
        return (mics.lower, mics.upper), mics
    return (next(n for n, s in run.signals.items() if s.quantity == "velocity"),), None


def view(run: Run, medium: Medium) -> View:
    """Take a run apart; its channels must be finite, of equal length and alive."""
    inputs, mics = velocity_channels(run)
    values = {n: np.asarray(s.values, dtype=float) for n, s in run.signals.items()}
    rate = run.sample_rate_hz
    signals = [values[n] for n in inputs]
    drive = values.get("drive")
    if run.kind == "free" or drive is None:
        frequency = estimate_frequency(np.mean(signals, axis=0), rate)
    else:
        frequency = drive_frequency(drive, rate, run.frequency_hz)
    count = usable_harmonics(HARMONICS, frequency, rate)
    stacked = np.stack([*signals, drive if drive is not None else np.zeros_like(signals[0])])
    c, rest = fit_harmonics(stacked, rate, frequency, count)
    return View(run, medium, inputs, mics, values, frequency, c, rest)
