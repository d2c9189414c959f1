"""From pressure at the microphones to recorded volts.

Each channel: sensitivity error, own low-pass, anti-aliasing and decimation with the channel's own
delay, white noise, converter. The anti-aliasing filter is the linear-phase kind of a delta-sigma
converter: a Kaiser-windowed sinc (pass band to 0.27 of the sample rate, 140 dB down at 0.73), whose
constant group delay of `LATENCY_FRAMES` is the same in every channel, the recorded drive included.
A channel's skew moves its sinc, so it is exact for any band-limited signal.

The low-pass is a single pole driven by a cubic through four samples (error O((ωΔt)⁴)).
"""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import ellip, lfilter, sosfilt

from simulated_rig.config import Converter, Interference, Microphone, RigConfig
from simulated_rig.statespace import FloatArray

LATENCY_FRAMES = 12  # group delay of every channel
HALF_WIDTH = 10.0  # frames on either side of the sinc
KAISER_BETA = 14.47  # 140 dB: 0.1102 (A − 8.7)
# The thesis's filter: 8 poles at 1.5 kHz; ripple and stop band are usual ones, it gives neither.
ELLIPTIC = (8, 0.1, 60.0, 1500.0)


def resampling_taps(oversampling: int, delay_frames: float) -> FloatArray:
    """Taps of one channel's decimator: newest sample first, delayed by `LATENCY_FRAMES` + delay.

    Raises
    ------
    ValueError
        When the delay leaves the filter's reach.
    """
    reach = LATENCY_FRAMES - HALF_WIDTH
    if abs(delay_frames) > reach:
        raise ValueError(
            f"a channel's delay of {delay_frames!r} frames is not within ±{reach}; "
            "take a higher sample rate or a smaller skew"
        )
    count = (2 * LATENCY_FRAMES) * oversampling + 1
    t = np.arange(count) / oversampling - LATENCY_FRAMES - delay_frames  # in frames
    inside = np.clip(1.0 - (t / HALF_WIDTH) ** 2, 0.0, None)
    window = np.where(np.abs(t) < HALF_WIDTH, np.i0(KAISER_BETA * np.sqrt(inside)), 0.0)
    taps = np.sinc(t) * window
    return np.asarray(taps / taps.sum())


def cubic_lowpass(pole_hz: float, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """b, a of y' = ω (u − y) with u a cubic through the last four samples (one step late).

    The cubic passes u_{n-2}…u_{n+1}; the output is y_{n+1}, so the newest sample is included and
    there is no extra delay. Weights: ∫₀^h ω e^{−ω(h−s)} L_j(s) ds by 16-point Gauss.
    """
    w = 2 * np.pi * pole_hz / rate_hz
    nodes = np.array([1.0, 0.0, -1.0, -2.0])  # newest first, in steps from n
    x, g = np.polynomial.legendre.leggauss(16)
    s = (x + 1) / 2
    kernel = w * np.exp(-w * (1 - s)) * g / 2
    b = np.empty(4)
    for j in range(4):
        others = np.delete(nodes, j)
        basis = np.prod([(s - o) / (nodes[j] - o) for o in others], axis=0)
        b[j] = float(kernel @ basis)
    return b, np.array([1.0, -np.exp(-w)])


class Elliptic:
    """The analogue low-pass as a recursion at the fine rate."""

    def __init__(self, rate_hz: float) -> None:
        order, ripple_db, stop_db, corner_hz = ELLIPTIC
        self._sos = ellip(order, ripple_db, stop_db, corner_hz, fs=rate_hz, output="sos")
        self._state: FloatArray = np.zeros((self._sos.shape[0], 2))

    def process(self, values: FloatArray) -> FloatArray:
        out, self._state = sosfilt(self._sos, values, zi=self._state)
        return np.asarray(out)


class MicrophoneChannel:
    """One microphone with its memory: `process` takes fine pressures, gives frames in Pa.

    `late_s`: how much later than the first channel a multiplexer samples this one.
    """

    def __init__(
        self,
        microphone: Microphone,
        sample_rate_hz: float,
        oversampling: int,
        late_s: float = 0.0,
    ) -> None:
        self._gain = microphone.gain
        self._m = oversampling
        delay = (microphone.delay_s - late_s) * sample_rate_hz
        self._taps = resampling_taps(oversampling, delay)[::-1]
        self._past: FloatArray = np.zeros(self._taps.size - 1)
        self._lowpass = None
        if microphone.lowpass_hz is not None:
            self._lowpass = cubic_lowpass(microphone.lowpass_hz, sample_rate_hz * oversampling)
            self._zi: FloatArray = np.zeros(3)

    def process(self, pressure_pa: FloatArray) -> FloatArray:
        """Frames at the first fine sample of each group of `oversampling`, delayed."""
        p = pressure_pa * self._gain
        if self._lowpass is not None:
            b, a = self._lowpass
            p, self._zi = lfilter(b, a, p, zi=self._zi)
        joined = np.concatenate([self._past, p])
        self._past = joined[joined.size - self._past.size :]
        windows = sliding_window_view(joined, self._taps.size)[:: self._m]
        return np.asarray(windows @ self._taps)


class Delay:
    """The same whole number of frames for the channels that need no filter."""

    def __init__(self, frames: int = LATENCY_FRAMES) -> None:
        self._past: FloatArray = np.zeros(frames)

    def process(self, values: FloatArray) -> FloatArray:
        joined = np.concatenate([self._past, values])
        self._past = joined[values.size :]
        return joined[: values.size]


class ColouredNoise:
    """First-order Gauss-Markov noise of unit variance, sampled at `rate_hz`."""

    def __init__(self, rng: np.random.Generator, corner_hz: float, rate_hz: float) -> None:
        self._rng = rng
        self._keep = float(np.exp(-2 * np.pi * corner_hz / rate_hz))
        self._last = float(rng.standard_normal())

    def take(self, count: int) -> FloatArray:
        """The next `count` values."""
        if count == 0:
            return np.zeros(0)
        push = np.sqrt(1 - self._keep**2) * self._rng.standard_normal(count)
        out, _ = lfilter([1.0], [1.0, -self._keep], push, zi=[self._keep * self._last])
        self._last = float(out[-1])
        return np.asarray(out)


def interference(tones: Sequence[Interference], time_s: FloatArray) -> FloatArray:
    """Pressure-equivalent hum in the two microphones, shape (2, frames)."""
    out = np.zeros((2, time_s.size))
    for tone in tones:
        wave = np.sin(2 * np.pi * tone.frequency_hz * time_s)
        for k, relative in enumerate(tone.harmonics, start=2):
            wave = wave + relative * np.sin(2 * np.pi * k * tone.frequency_hz * time_s + k)
        out += tone.amplitude_pa * np.array([1.0, tone.share2])[:, None] * wave
    return out


def quantised(volts: FloatArray, converter: Converter) -> FloatArray:
    """What the converter's codes stand for: clipped at full scale, rounded to its step."""
    step = converter.full_scale_v / 2 ** (converter.bits - 1)
    top = converter.full_scale_v - step
    rounded = np.round(volts / step) * step
    return np.asarray(np.clip(rounded, -converter.full_scale_v, top))


class Chain:
    """All channels of a rig with their noise; `process` gives (frames, 3) volts: p1, p2, drive."""

    def __init__(self, config: RigConfig, oversampling: int, seed: int | Sequence[int]) -> None:
        self._config = config
        self._m = oversampling
        rng = np.random.default_rng(seed)
        rumble_rng, self._white, self._jitter, *own = rng.spawn(3 + len(config.microphones))
        rate, step = config.sample_rate_hz, config.converter.multiplex_s
        self._channels = [
            MicrophoneChannel(m, rate, oversampling, i * step)
            for i, m in enumerate(config.microphones)
        ]
        self._filters: list[Elliptic] = []
        if config.converter.antialias == "elliptic":
            self._filters = [Elliptic(rate * oversampling) for _ in range(3)]
        self._late = 2 * step * rate
        self._drive_taps = resampling_taps(oversampling, -self._late)[::-1]
        self._drive_past: FloatArray = np.zeros(self._drive_taps.size - 1)
        self._drive = Delay()
        self._rumble = ColouredNoise(rumble_rng, config.rumble.corner_hz, rate)
        self._coloured = [
            None if m.noise_corner_hz is None else ColouredNoise(r, m.noise_corner_hz, rate)
            for m, r in zip(config.microphones, own, strict=True)
        ]
        self._frame = 0
        self._last: FloatArray = np.zeros(3)
        self._start_s = float(rng.uniform(0.0, 1.0))  # the mains' phase is not ours

    def process(self, pressures: FloatArray, drive: FloatArray) -> FloatArray:
        """`pressures` (frames · oversampling, 2) in Pa and `drive` (frames · oversampling,) in V,
        both at the fine rate."""
        config = self._config
        frames = drive.size // self._m
        time_s = self._start_s + (self._frame + np.arange(frames)) / config.sample_rate_hz
        self._frame += frames
        added = interference(config.interference, time_s)
        if config.rumble.level_pa:
            added = added + config.rumble.level_pa * self._rumble.take(frames)
        white = self._white.standard_normal((frames, 3))
        volts = np.empty((frames, 3))
        for k, (channel, microphone) in enumerate(
            zip(self._channels, config.microphones, strict=True)
        ):
            source = self._coloured[k]
            own = white[:, k] if source is None else source.take(frames)
            fine = pressures[:, k]
            if self._filters:
                fine = self._filters[k].process(fine)
            pascal = channel.process(fine) + added[k] + microphone.noise_pa * own
            volts[:, k] = pascal * microphone.volts_per_pa
        volts[:, 2] = self._sampled_drive(drive) + config.converter.drive_noise_v * white[:, 2]
        if config.converter.jitter_s:
            volts = self._jittered(volts)
        return quantised(volts, config.converter)

    def _sampled_drive(self, drive: FloatArray) -> FloatArray:
        """The drive channel: what the generator put out, sampled as the converter samples."""
        if self._filters:
            drive = self._filters[2].process(drive)
        if self._late == 0.0:
            return self._drive.process(drive[:: self._m])
        joined = np.concatenate([self._drive_past, drive])
        self._drive_past = joined[joined.size - self._drive_past.size :]
        windows = sliding_window_view(joined, self._drive_taps.size)[:: self._m]
        return np.asarray(windows @ self._drive_taps)

    def _jittered(self, volts: FloatArray) -> FloatArray:
        """First order in the jitter: the slope at a frame times how much too late it was taken."""
        rate = self._config.sample_rate_hz
        before = np.vstack([self._last, volts[:-1]])
        self._last = volts[-1].copy()
        late = self._config.converter.jitter_s * self._jitter.standard_normal((volts.shape[0], 1))
        return np.asarray(volts + (volts - before) * rate * late)
