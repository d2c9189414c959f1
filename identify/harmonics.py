"""From a recording to Fourier coefficients with the covariance of their noise.

Velocity from two microphones (Eq. 5.1, 5.2):  û = −(p̂2 − p̂1) / (ρ Δx jω), x2 > x1.

A forced run is a sum of harmonics of the drive's frequency: c_k with y(t) = Re Σ c_k e^{jkωt},
found by linear least squares over the record (for a whole number of periods, the DFT). The
frequency is the drive's own, estimated from the drive channel; a free run's is estimated from
the velocity. What the harmonics leave is noise, and its spectrum within a few hertz of kω gives
the covariance of c_k, across harmonics too, because jitter of phase or amplitude correlates them;
where noise inside the loop stands higher at a line than beside it, `identify.linenoise` says by how
much.
A coarse converter adds what these neighbours do not show (`identify.quantisation`).

No microphone, amplifier and converter are together more linear than a part in a million, whatever
their noise: that share of the fundamental counts in every harmonic.

Foreign tones that are known are fitted beside the harmonics, so that they leak into none. One that
stands on a harmonic cannot be told from it: its size counts there as noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
import numpy.typing as npt

from identify.linenoise import frequency_stderr, peak
from identify.quantisation import added_variance
from identify.record import Campaign, Kind, Medium, Role, Run

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

SIDE_BINS = 20  # neighbours on either side that give a coefficient's noise
VARIANCE_DOF = 4 * SIDE_BINS  # real degrees of freedom behind each estimated variance
SEGMENTS = 256  # a record's demodulated signal is averaged to this many points
USABLE = 0.45  # of the sample rate: nearer to half of it, a line's phase is lost in its image
APART_BINS = 2.0  # a tone nearer to a harmonic cannot be fitted beside it
DISTORTION = 1e-6  # of the fundamental in each harmonic: the best of recording chains, −120 dB
BARELY_LOCKED = 0.8  # share of forced runs that may be: a peak in more is a modulation
NO_TONES: Mapping[float, float] = MappingProxyType({})


class RecordError(ValueError):
    """A recording cannot be used; the message names the run, the channel and what is wrong."""


@dataclass(frozen=True)
class Harmonics:
    """Fourier coefficients of one run.

    `velocity`, `drive`, `pressure` (mean of the two microphones): (K,) complex, phases relative
    to the drive's fundamental (free runs: to the velocity's). `covariance`: (2K, 2K) of
    [Re, Im] of the velocity's coefficients; `side`: (2M, K) complex coefficients of the noise at
    the neighbouring bins, from which it was estimated. `pressure_noise` is E|n_P|² and
    `shared_noise` E[n_V n_P*], (K,): nothing where both microphones are as loud; `drive_variance`
    is E|n|² of the drive's coefficients. `frequency_stderr_hz` is 0 for forced runs.
    """

    name: str
    kind: Kind
    role: Role
    frequency_hz: float
    frequency_stderr_hz: float
    velocity: ComplexArray
    drive: ComplexArray
    pressure: ComplexArray
    covariance: FloatArray
    side: ComplexArray
    pressure_noise: FloatArray
    shared_noise: ComplexArray
    drive_variance: float
    started_s: float
    duration_s: float
    nominal_hz: float | None
    amplitude_v: float | None

    @property
    def count(self) -> int:
        return int(self.velocity.size)

    @property
    def variance(self) -> FloatArray:
        """E|noise|² of each coefficient, (K,)."""
        v = np.diag(self.covariance)
        return np.asarray(v[: self.count] + v[self.count :])

    def doubted(self, factor: float, error: float = 0.0) -> "Harmonics":
        """The same with `factor` times the standard errors, and a relative `error` of harmonic k
        that grows with k, and is the same of velocity and pressure."""
        wrong = (error * np.arange(1, self.count + 1)) ** 2
        own, shared = np.abs(self.velocity) ** 2, self.velocity * self.pressure.conj()
        return replace(
            self,
            covariance=self.covariance * factor**2 + np.diag(np.tile(wrong * own / 2, 2)),
            pressure_noise=self.pressure_noise * factor**2 + wrong * np.abs(self.pressure) ** 2,
            shared_noise=self.shared_noise * factor**2 + wrong * shared,
            frequency_stderr_hz=self.frequency_stderr_hz * factor,
        )

    def limited(self, count: int) -> "Harmonics":
        """The first `count` harmonics only."""
        keep = np.r_[0:count, self.count : self.count + count]
        return replace(
            self,
            velocity=self.velocity[:count],
            drive=self.drive[:count],
            pressure=self.pressure[:count],
            covariance=self.covariance[np.ix_(keep, keep)],
            side=self.side[:, :count],
            pressure_noise=self.pressure_noise[:count],
            shared_noise=self.shared_noise[:count],
        )


@dataclass(frozen=True)
class Microphones:
    """The two pressure channels, x growing from the closed end: names and positions."""

    lower: str
    upper: str
    x_lower_m: float
    x_upper_m: float

    @property
    def spacing_m(self) -> float:
        return self.x_upper_m - self.x_lower_m

    @property
    def centre_m(self) -> float:
        return 0.5 * (self.x_lower_m + self.x_upper_m)


def microphones(run: Run) -> Microphones | None:
    """The two pressure channels with positions, or None where a velocity is recorded itself."""
    placed = [
        (s.position_m, n)
        for n, s in run.signals.items()
        if s.quantity == "pressure" and s.position_m is not None
    ]
    if any(s.quantity == "velocity" for s in run.signals.values()):
        return None
    if len(placed) != 2:
        raise RecordError(
            f"run {run.name!r}: {len(placed)} pressure channels with position_m; "
            "two are required for the velocity (or one channel of quantity 'velocity')"
        )
    (x1, n1), (x2, n2) = sorted(placed)
    if not x2 > x1:
        raise RecordError(f"run {run.name!r}: position_m of {n1!r} and {n2!r} are both {x1}")
    return Microphones(n1, n2, x1, x2)


def measure(
    run: Run, medium: Medium, harmonics: int = 7, tones: Mapping[float, float] = NO_TONES
) -> Harmonics:
    """Fourier coefficients and their noise of one run.

    `harmonics` is reduced to those below `USABLE` of the sample rate. `tones`: foreign ones, peak
    amplitude of the velocity (m/s) by frequency (Hz).
    """
    values = {n: np.asarray(s.values, dtype=float) for n, s in run.signals.items()}
    for name, x in values.items():
        if not np.isfinite(x).all():
            first = int(np.flatnonzero(~np.isfinite(x))[0])
            raise RecordError(f"run {run.name!r}, channel {name!r}: sample {first} is not finite")
    mics = microphones(run)
    rate = run.sample_rate_hz
    drive = values.get("drive")
    if run.kind != "free" and (drive is None or not np.ptp(drive) > 0):
        raise RecordError(f"run {run.name!r}: channel 'drive' is missing or constant")
    if mics is None:
        name = next(n for n, s in run.signals.items() if s.quantity == "velocity")
        names = [name]
    else:
        names = [mics.lower, mics.upper]
    inputs = [values[n] for n in names]
    if run.kind == "free":
        # the pressure sum is the strongest signal and has the same frequency as the velocity
        reference = inputs[0] if mics is None else inputs[0] + inputs[1]
        frequency = estimate_frequency(reference, rate)
    else:
        assert drive is not None
        frequency = drive_frequency(drive, rate, run.frequency_hz)
    K = usable_harmonics(harmonics, frequency, rate)
    k = np.arange(1, K + 1)
    omega = 2 * np.pi * frequency * k
    signals = np.stack([*inputs, drive if drive is not None else np.zeros_like(inputs[0])])
    on = {f: harmonic_under(f, frequency, run.duration_s, K) for f in tones}
    c, rest = fit_harmonics(signals, rate, frequency, K, [f for f in tones if on[f] is None])
    side = side_bins(rest, rate, frequency, K)
    hidden = np.zeros(len(signals))
    for i, name in enumerate([*names, "drive"]):
        if name in run.signals:
            hidden[i] = added_variance(
                run.signals[name].resolution,
                float(np.abs(c[i, 0])),
                float(typical(np.abs(side[i]) ** 2)),
                frequency,
                rate,
                signals.shape[1],
            )
    if mics is None:
        velocity, pressure = c[0], np.zeros(K, dtype=complex)
        noise, pressure_noise, shared_noise = side[0], np.zeros(K), np.zeros(K, dtype=complex)
        coarse = np.full(K, hidden[0])
    else:
        offset = 2 * np.pi * side_offsets(run.duration_s)[:, None]
        scale = medium.density_kg_m3 * mics.spacing_m
        velocity = -(c[1] - c[0]) / (scale * 1j * omega)
        pressure = 0.5 * (c[0] + c[1])
        noise = -(side[1] - side[0]) / (scale * 1j * (omega + offset))
        beside = 0.5 * (side[0] + side[1])
        pressure_noise = np.mean(np.abs(beside) ** 2, axis=0) + hidden[:2].sum() / 4
        shared_noise = np.mean(noise * beside.conj(), axis=0)
        coarse = hidden[:2].sum() / (scale * omega) ** 2
    covered = np.zeros(K)
    for f, order in on.items():
        if order is not None:
            covered[order - 1] += tones[f] ** 2
    drive_c = c[-1]
    reference_c = velocity[0] if run.kind == "free" else drive_c[0]
    turn = np.exp(-1j * np.angle(reference_c) * k)
    noise = noise * turn
    distorted = (DISTORTION * np.abs(velocity[0])) ** 2
    added = coarse + covered + distorted
    covariance = coefficient_covariance(noise)
    covariance = covariance + np.diag(np.tile(added, 2) / 2)
    stderr = 0.0
    if run.kind == "free":
        both = slice(0, len(inputs))
        reference_noise = side[both, :, 0].sum(axis=0)
        stderr = frequency_stderr(complex(c[both, 0].sum()), reference_noise, run.duration_s)
    return Harmonics(
        name=run.name,
        kind=run.kind,
        role=run.role,
        frequency_hz=frequency,
        frequency_stderr_hz=stderr,
        velocity=velocity * turn,
        drive=(drive_c * turn) if run.kind != "free" else np.zeros(K, dtype=complex),
        pressure=pressure * turn,
        covariance=covariance,
        side=noise,
        pressure_noise=pressure_noise,
        shared_noise=shared_noise,
        drive_variance=float(np.mean(np.abs(side[-1][:, 0]) ** 2) + hidden[-1]),
        started_s=run.started_s,
        duration_s=run.duration_s,
        nominal_hz=run.frequency_hz,
        amplitude_v=run.amplitude_v,
    )


def harmonic_under(
    tone_hz: float, frequency_hz: float, duration_s: float, count: int
) -> int | None:
    """Which of the first `count` harmonics of `frequency_hz` a tone cannot be told from, if any."""
    order = round(tone_hz / frequency_hz)
    near = abs(tone_hz - order * frequency_hz) * duration_s < APART_BINS
    return order if near and 1 <= order <= count else None


def fit_harmonics(
    signals: FloatArray, rate: float, frequency: float, count: int, tones: Sequence[float] = ()
) -> tuple[ComplexArray, FloatArray]:
    """Coefficients (signals, K) and what remains (signals, samples), by linear least squares.

    A constant is fitted too, and `tones` (Hz), each with an amplitude that grows linearly, which
    makes up for an error of its frequency. For a whole number of periods and no tone the normal
    matrix is diagonal and this is the DFT at the harmonics.
    """
    n = signals.shape[1]
    # centred: the best-conditioned time origin
    t = np.asarray((np.arange(n) - (n - 1) / 2) / rate, dtype=np.float64)
    basis = harmonic_basis(t, frequency, count)
    for f in tones:
        line = harmonic_basis(t, f, 1)[:2]
        basis = np.concatenate([basis, line, line * (2 * t / t[-1])])
    normal = basis @ basis.T
    solution = np.linalg.solve(normal, basis @ signals.T)
    rest = signals - solution.T @ basis
    c = (solution[:count] + 1j * solution[count : 2 * count]).T
    # back to the phase at the first sample
    shift = np.exp(-1j * 2 * np.pi * frequency * t[0] * np.arange(1, count + 1))
    return np.asarray(c / shift), np.asarray(rest)


def side_offsets(duration_s: float, bins: int = SIDE_BINS) -> FloatArray:
    """Frequency offsets (Hz) of the neighbouring bins, −M…−1, 1…M, shape (2M,)."""
    m = np.r_[-bins:0, 1 : bins + 1]
    return np.asarray(m / duration_s)


def side_bins(
    rest: FloatArray, rate: float, frequency: float, count: int, bins: int = SIDE_BINS
) -> ComplexArray:
    """Coefficients of `rest` at kω + offsets: (signals, 2M, K), scaled as `fit_harmonics` does."""
    n = rest.shape[1]
    t = np.arange(n) / rate
    rotor = np.exp(-2j * np.pi * frequency * t)
    edges = np.linspace(0, n, min(SEGMENTS, n) + 1).astype(int)[:-1]
    centres = (edges + np.r_[edges[1:], n] - 1) / (2 * n)
    m = np.r_[-bins:0, 1 : bins + 1]
    to_bins = np.exp(-2j * np.pi * np.outer(m, centres))
    out = np.empty((rest.shape[0], 2 * bins, count), dtype=complex)
    z = np.ones(n, dtype=complex)
    for j in range(count):
        z = z * rotor
        sums = np.add.reduceat(rest * z, edges, axis=1)
        out[:, :, j] = (2.0 / n) * (sums @ to_bins.T)
    return out


def typical(power: FloatArray, axis: int | None = None) -> FloatArray:
    """Mean power of noise in bins, from their median, which a foreign tone in one does not move."""
    return np.asarray(np.median(power, axis=axis) / np.log(2))


def coefficient_covariance(side: ComplexArray) -> FloatArray:
    """Covariance (2K, 2K) of [Re, Im] of the coefficients from neighbouring bins, (2M, K).

    Variances always; the correlations across harmonics, which jitter causes, only where they
    exceed what 2M independent bins would show by chance (threshold 4/√(2M)), because a matrix
    estimated from 40 bins and inverted would otherwise overstate its own precision.
    """
    power = np.abs(side) ** 2
    # a foreign tone in one or two bins must not pass for noise: median-based outlier removal
    limit = 8.0 * typical(power, axis=0)
    weight = (power <= limit).astype(float)
    used = np.maximum(weight.sum(axis=0), 1.0)
    variance = (power * weight).sum(axis=0) / used
    K = side.shape[1]
    covariance = np.diag(np.r_[variance, variance] / 2)
    both = np.where(weight > 0, side, 0.0)
    half = side.shape[0] // 2
    scale = np.sqrt(np.outer(variance, variance)) + 1e-300
    C = (both.T @ both.conj()) / side.shape[0] / scale
    mirrored = both[::-1]
    G = (both.T @ mirrored) / side.shape[0] / scale
    threshold = 4.0 / np.sqrt(2 * half)
    significant = (np.abs(C) > threshold) | (np.abs(G) > threshold)
    if not significant[~np.eye(K, dtype=bool)].any() and not (np.abs(np.diag(G)) > threshold).any():
        return np.asarray(covariance)
    C, G = C * scale, 0.5 * (G + G.T) * scale
    rr, ii = (C + G).real / 2, (C - G).real / 2
    ri = (G.imag - C.imag) / 2
    full = np.block([[rr, ri], [ri.T, ii]])
    # shrink towards the diagonal by the estimation noise of 2M bins; keeps it positive definite
    shrink = min(0.5, 2 * K / side.shape[0])
    return np.asarray((1 - shrink) * full + shrink * np.diag(np.diag(full)))


def raised(covariance: FloatArray, power: FloatArray) -> FloatArray:
    """The covariance (2K, 2K) with variances of at least `power` (K,); correlations as before."""
    K = power.size
    own = np.diag(covariance)[:K] + np.diag(covariance)[K:]
    factor = np.sqrt(np.maximum(1.0, power / np.maximum(own, 1e-300)))
    return np.asarray(covariance * np.outer(np.tile(factor, 2), np.tile(factor, 2)))


def estimate_frequency(x: FloatArray, rate: float, low_hz: float = 20.0) -> float:
    """Frequency of the strongest line: peak of the spectrum, refined by demodulated phase.

    The refinement regresses the phase of the signal, demodulated at the peak and averaged over
    segments, on time; repeated, it converges to the least-squares frequency.
    """
    n = x.size
    window = np.hanning(n)
    spectrum = np.abs(np.fft.rfft((x - x.mean()) * window))
    f = np.arange(spectrum.size) * rate / n
    spectrum[(f < low_hz) | (f > USABLE * rate)] = 0.0
    peak = int(np.argmax(spectrum))
    frequency = float(f[peak])
    if 0 < peak < spectrum.size - 1:
        a, b, c = np.log(spectrum[peak - 1 : peak + 2] + 1e-300)
        bend = a - 2 * b + c
        if bend < 0:
            frequency += 0.5 * (a - c) / bend * rate / n
    return refine_frequency(x, rate, frequency)


def refine_frequency(x: FloatArray, rate: float, frequency: float, harmonics: int = 5) -> float:
    """Least-squares frequency of a periodic signal near `frequency`.

    Gauss–Newton on y(t) = c₀ + Σ_k Re c_k e^{jkωt}: the linear fit of the coefficients takes
    ∂y/∂ω as one more column, whose coefficient is the correction of ω. Converged, it reaches the
    Cramér–Rao bound in white noise.
    """
    n = x.size
    count = usable_harmonics(harmonics, frequency, rate)
    t = np.asarray((np.arange(n) - (n - 1) / 2) / rate, dtype=np.float64)
    for _ in range(8):
        basis = harmonic_basis(t, frequency, count)
        solution = np.linalg.solve(basis @ basis.T, basis @ x)
        k = np.arange(1, count + 1)
        re, im = solution[:count], solution[count : 2 * count]
        # ∂/∂ω of Re c e^{jkωt} = −k t Im(c e^{jkωt}) = −k t (re sin + im cos), sin = −basis
        slope = t * ((k * re) @ basis[count : 2 * count] - (k * im) @ basis[:count])
        slope = slope - np.linalg.solve(basis @ basis.T, basis @ slope) @ basis
        power = float(slope @ slope)
        if not power > 0:
            return frequency
        step = float(slope @ x) / power / (2 * np.pi)
        step = float(np.clip(step, -0.5 * rate / n, 0.5 * rate / n))
        frequency += step
        if abs(step) < 1e-9 * frequency:
            break
    return frequency


def usable_harmonics(most: int, frequency: float, rate: float) -> int:
    """How many harmonics of a frequency, of `most`, lie below `USABLE` of the sample rate; the
    first in any case."""
    return max(1, min(most, int(USABLE * rate / frequency)))


def harmonic_basis(t: FloatArray, frequency: float, count: int) -> FloatArray:
    """Rows cos and −sin of e^{jkωt} (k = 1…count) and a constant, shape (2·count + 1, samples)."""
    basis = np.empty((2 * count + 1, t.size))
    basis[-1] = 1.0
    rotor = np.exp(2j * np.pi * frequency * t)
    z = np.ones(t.size, dtype=complex)
    for j in range(count):
        z = z * rotor
        basis[j], basis[count + j] = z.real, -z.imag
    return basis


def drive_frequency(drive: FloatArray, rate: float, nominal: float | None) -> float:
    """The drive's frequency; the nominal one where the record agrees with it to within noise."""
    found = estimate_frequency(drive, rate) if nominal is None else None
    if found is None:
        assert nominal is not None
        found = refine_frequency(drive, rate, nominal)
        # a sine's frequency is known to about 1e-3 of a bin here: below that, trust the setting
        if abs(found - nominal) < 1e-3 * rate / drive.size:
            return nominal
    return found


Level = Literal["all", "fit", "validation"]


def measure_campaign(
    campaign: Campaign,
    harmonics: int = 7,
    skip: Sequence[str] = (),
    tones: Mapping[float, float] = NO_TONES,
) -> list[Harmonics]:
    """All usable runs of a campaign, in the order recorded; `skip` names runs left out."""
    found = [
        measure(run, campaign.medium, harmonics, tones)
        for run in campaign.runs
        if run.exit_status == "success" and run.name not in skip
    ]
    peaks = {h.name: peak(h.side) for h in found if h.kind == "forced"}
    peaked = {name: power for name, power in peaks.items() if power.any()}
    if len(peaked) > BARELY_LOCKED * len(peaks):
        return found
    return [
        replace(h, covariance=raised(h.covariance, peaked[h.name])) if h.name in peaked else h
        for h in found
    ]
