"""What one stretch of pressure says about entrainment: the forced line, the free line, the rest.

The signal is cut into chunks of about two forcing periods. In each chunk, least squares of

    p(t) ≈ c_0 + Re Σ_k c_k e^{jkωt},   k = 1 … H

gives the complex amplitude z = c_1 in the frame that rotates with the forcing; harmonics and
offset do not leak into it. While the limit cycle is entrained z stands still. A free line of
frequency ω + Ω and amplitude A turns as A e^{jΩt} around the mean of z, so

    forced line = what stands in z,  deviation = rms of the rest,  drift = slope of arg z,

and the strongest line in the spectrum of the rest, fitted together with what stands, gives the
free line alone and, with what remains, its uncertainty. Nothing here depends on windows or bins,
so the forcing's own leakage never poses as a free line.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

HARMONICS = 3
CHUNK_PERIODS = 2.0
NEAR = 0.15  # relative distance within which a line counts as the limit cycle's own


@dataclass(frozen=True)
class Measurement:
    """One window, seen from the forcing at `frequency_hz`; amplitudes in the channel's unit.

    `forced` is the complex amplitude at the forcing frequency, its phase relative to the drive
    where the drive is recorded. `deviation` is the rms of what turns around it, `free_amplitude`
    the strongest line in that, `free_offset_hz` where, `free_sigma` its standard error.
    `drift_rad_s` is the mean rotation of the phase (zero when locked), `phase_span_rad` how far it
    strayed from its mean. `change` is the relative change of the forced line across the window.
    `purity` is everything but the forced line and its harmonics, relative to the forced line.
    `other_amplitude` is the strongest line elsewhere (beyond `NEAR` of the forcing, not one of
    its harmonics), at `other_hz`: another mode, a subharmonic, interference.
    """

    frequency_hz: float
    time_s: float
    window_s: float
    forced: complex
    deviation: float
    free_amplitude: float
    free_offset_hz: float
    free_sigma: float
    drift_rad_s: float
    phase_span_rad: float
    change: float
    purity: float
    other_hz: float = 0.0
    other_amplitude: float = 0.0
    overload: bool = False
    drive_v: float | None = None

    @property
    def amplitude(self) -> float:
        """Amplitude of the forced line."""
        return abs(self.forced)


def baseband(
    samples: FloatArray, rate_hz: float, frequency_hz: float, start_s: float = 0.0
) -> tuple[ComplexArray, float, float]:
    """Complex amplitude at `frequency_hz` chunk by chunk.

    Parameters
    ----------
    samples : (frames,) real
    start_s : time of the first frame; the phase refers to time zero.

    Returns
    -------
    z : (chunks,) complex amplitudes
    step_s : time from chunk to chunk
    rest : rms of what neither offset nor harmonics explain
    """
    size = max(2 * HARMONICS + 3, round(CHUNK_PERIODS * rate_hz / frequency_hz))
    count = samples.size // size
    if count < 1:
        raise ValueError(
            f"samples.size={samples.size} is not at least one chunk of {size} "
            f"({CHUNK_PERIODS:g} periods of {frequency_hz:g} Hz)"
        )
    omega = 2 * np.pi * frequency_hz / rate_hz
    n = np.arange(size) - (size - 1) / 2
    columns = [np.ones(size)]
    for k in range(1, HARMONICS + 1):
        columns += [np.cos(k * omega * n), -np.sin(k * omega * n)]
    design = np.stack(columns, axis=1)
    chunks = samples[: count * size].reshape(count, size)
    weights = np.linalg.pinv(design)
    coefficients = chunks @ weights.T
    rest = float(np.sqrt(np.mean((chunks - coefficients @ design.T) ** 2)))
    middle = (np.arange(count) * size + (size - 1) / 2) / rate_hz + start_s
    z = (coefficients[:, 1] + 1j * coefficients[:, 2]) * np.exp(-2j * np.pi * frequency_hz * middle)
    return z, size / rate_hz, rest


def measure(
    pressure: FloatArray,
    rate_hz: float,
    frequency_hz: float,
    *,
    time_s: float = 0.0,
    drive: FloatArray | None = None,
    overload: bool = False,
) -> Measurement:
    """Judge one window.

    Parameters
    ----------
    pressure, drive : (frames,) in physical units; the drive gives the phase's reference.
    time_s : clock time of the window's end.
    """
    z, step, rest = baseband(pressure, rate_hz, frequency_hz)
    drive_v = None
    reference: complex = 1.0 + 0.0j
    if drive is not None:
        tone = complex(np.mean(baseband(drive, rate_hz, frequency_hz)[0]))
        drive_v = abs(tone)
        # sin(ωt) is Re(−j e^{jωt}): the phase of a drive's sine is its angle plus a quarter turn
        reference = tone / abs(tone) if abs(tone) > 0 else reference
    mean = complex(np.mean(z))
    amplitude, offset, sigma = strongest_line(z - mean, step)
    if abs(offset) * pressure.size / rate_hz >= 1.0:
        mean, _ = together(pressure, rate_hz, frequency_hz, offset)
        _, offset, sigma = strongest_line(z - mean, step)
        mean, amplitude = together(pressure, rate_hz, frequency_hz, offset)
    deviation = float(np.sqrt(np.mean(np.abs(z - mean) ** 2)))
    half = z.size // 2
    first = complex(np.mean(z[:half])) if half else mean
    last = complex(np.mean(z[half:]))
    turning = np.unwrap(np.angle(z))
    span = float(np.max(np.abs(turning - turning.mean())))
    scale = max(abs(mean), 1e-300)
    other_hz, other = line_elsewhere(pressure, rate_hz, frequency_hz)
    return Measurement(
        frequency_hz=frequency_hz,
        time_s=time_s,
        window_s=pressure.size / rate_hz,
        forced=mean / reference,
        deviation=deviation,
        free_amplitude=amplitude,
        free_offset_hz=offset,
        free_sigma=sigma,
        drift_rad_s=_slope(turning) / step,
        phase_span_rad=span,
        change=float(abs(abs(last) - abs(first)) / scale),
        purity=math.hypot(deviation / scale, math.sqrt(2.0) * rest / scale),
        other_hz=other_hz,
        other_amplitude=other,
        overload=overload,
        drive_v=drive_v,
    )


def line_elsewhere(samples: FloatArray, rate_hz: float, frequency_hz: float) -> tuple[float, float]:
    """Frequency and amplitude of the strongest line that is neither near the forcing nor one of
    its harmonics. The Hann window's skirts are four bins wide; as much is left out beside each."""
    window = np.hanning(samples.size)
    lines = np.abs(np.fft.rfft((samples - samples.mean()) * window)) * 2 / window.sum()
    bins = np.fft.rfftfreq(samples.size, 1 / rate_hz)
    order = np.round(bins / frequency_hz)
    distance = np.abs(bins - order * frequency_hz)
    skirt = 4 * rate_hz / samples.size
    kept = (distance > skirt) & (np.abs(bins - frequency_hz) > NEAR * frequency_hz)
    kept &= bins > skirt
    if not kept.any():
        return 0.0, 0.0
    best = int(np.argmax(np.where(kept, lines, 0.0)))
    return float(bins[best]), float(lines[best])


def together(
    samples: FloatArray, rate_hz: float, frequency_hz: float, offset_hz: float
) -> tuple[complex, float]:
    """The forced line and the amplitude of a free one `offset_hz` beside it, fitted at once.

    Chunk by chunk a strong free line bleeds a little into the forced one's mean (its incomplete
    last turn, its image within a chunk); on the samples themselves, with harmonics and offset,
    both are exact.
    """
    t = 2j * np.pi / rate_hz * np.arange(samples.size)
    turns = [np.exp(k * frequency_hz * t) for k in range(1, HARMONICS + 1)]
    turns.append(np.exp((frequency_hz + offset_hz) * t))
    columns = [part for turn in turns for part in (turn.real, -turn.imag)]
    design = np.stack([np.ones(samples.size), *columns], axis=1)
    solved = np.linalg.solve(design.T @ design, design.T @ samples)
    return complex(solved[1], solved[2]), float(math.hypot(solved[-2], solved[-1]))


def strongest_line(z: ComplexArray, step_s: float) -> tuple[float, float, float]:
    """The strongest rotating line in `z`: amplitude, frequency (Hz), standard error.

    The frequency is found on a spectrum padded eightfold, with a parabola through its peak, then
    the amplitude by least squares.
    """
    if z.size < 4:
        return float(np.sqrt(np.mean(np.abs(z) ** 2))), 0.0, float("inf")
    padded = 8 * z.size
    spectrum = np.abs(np.fft.fft(z, padded))
    peak = int(np.argmax(spectrum))
    before, at, after = (float(spectrum[(peak + i) % padded]) for i in (-1, 0, 1))
    bend = before - 2 * at + after
    shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    offset = float(np.fft.fftfreq(padded, step_s)[peak]) + shift / (padded * step_s)
    line = np.exp(2j * np.pi * offset * step_s * np.arange(z.size))
    amplitude = complex(np.vdot(line, z) / z.size)
    rest = z - amplitude * line
    # complex residual of variance σ² a sample: |c| has standard error σ / sqrt(2 n)
    sigma = float(np.sqrt(np.sum(np.abs(rest) ** 2) / max(1, z.size - 2) / (2 * z.size)))
    return abs(amplitude), offset, sigma


@dataclass(frozen=True)
class FreeCycle:
    """The unforced limit cycle: what entrainment is measured against.

    `harmonics` are the amplitudes at k·frequency (k = 1 …), `noise` the rms of the rest.
    `amplitude_sigma` and `frequency_sigma_hz` are standard errors from the scatter over chunks.
    """

    frequency_hz: float
    amplitude: float
    harmonics: tuple[float, ...]
    noise: float
    frequency_sigma_hz: float = 0.0
    amplitude_sigma: float = 0.0

    def suppression_db(self, free_amplitude: float) -> float:
        """How far a free line of that amplitude lies below the free level (negative: below)."""
        return 20 * math.log10(max(free_amplitude, 1e-12 * self.amplitude) / self.amplitude)


def free_cycle(
    pressure: FloatArray,
    rate_hz: float,
    *,
    low_hz: float = 20.0,
    high_hz: float | None = None,
    harmonics: int = 5,
) -> FreeCycle:
    """Frequency, amplitude and harmonics of the strongest line between `low_hz` and `high_hz`.

    The spectrum's peak starts a search: the drift of the phase over the whole record corrects the
    frequency until it stands still.
    """
    centred = pressure - pressure.mean()
    high = 0.4 * rate_hz if high_hz is None else high_hz
    spectrum = np.abs(np.fft.rfft(centred * np.hanning(centred.size)))
    bins = np.fft.rfftfreq(centred.size, 1 / rate_hz)
    band = np.flatnonzero((bins >= low_hz) & (bins <= high))
    if band.size == 0:
        raise ValueError(f"low_hz={low_hz}, high_hz={high} do not hold one line of the spectrum")
    frequency = float(bins[band[int(np.argmax(spectrum[band]))]])
    z = np.zeros(1, complex)
    step = rest = 0.0
    for _ in range(4):
        z, step, rest = baseband(centred, rate_hz, frequency)
        if z.size < 3:
            break
        frequency += _slope(np.unwrap(np.angle(z))) / step / (2 * np.pi)
    omega = 2 * np.pi * frequency / rate_hz
    n = np.arange(centred.size)
    levels = []
    for k in range(1, harmonics + 1):
        if k * frequency >= rate_hz / 2:
            break
        levels.append(float(2 * abs(np.mean(centred * np.exp(-1j * k * omega * n)))))
    amplitude = float(np.mean(np.abs(z)))
    phases = np.unwrap(np.angle(z)) - _slope(np.unwrap(np.angle(z))) * np.arange(z.size)
    scatter = float(np.std(phases)) if z.size > 2 else 0.0
    duration = z.size * step
    return FreeCycle(
        frequency_hz=frequency,
        amplitude=amplitude,
        harmonics=(amplitude, *levels[1:]),
        noise=rest,
        # a straight line through n phases of scatter s over T: σ_slope = s sqrt(12/n)/T
        frequency_sigma_hz=scatter * math.sqrt(12 / z.size) / max(duration, step) / (2 * np.pi),
        amplitude_sigma=float(np.std(np.abs(z))) / math.sqrt(z.size),
    )


def _slope(values: FloatArray) -> float:
    """Least-squares slope a step."""
    if values.size < 2:
        return 0.0
    n = np.arange(values.size) - (values.size - 1) / 2
    return float(n @ values / (n @ n))
