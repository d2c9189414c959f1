"""A sine whose phase is a function of the frame index, and whose amplitude ramps linearly.

With f and the amplitude's target fixed since the anchor frame n₀, frame n is

    y(n) = A(n) · sin 2π(φ₀ + f·(n − n₀)/fs),    A(n) = A₀ + clip(A₁ − A₀, ±s·(n − n₀)/fs),

so nothing accumulates: after hours the phase is as exact as at the start (one rounding of
f·n/fs, 1e-10 of a cycle at 1e6 cycles). A change of frequency or amplitude moves the anchor to
the present frame with the phase and amplitude reached there, hence both are continuous.

States are values: `advance` returns the next one and leaves its argument alone. With `out` and a
`Scratch` it creates no array, and so may run inside an audio callback.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from drivers.types import FloatArray


@dataclass(frozen=True, slots=True)
class Oscillator:
    """State at the next frame to be written.

    `phase` (cycles) and `amplitude_v` hold at `anchor`; `target_v` is approached at
    `slew_v_per_s`. `frame` counts the frames written since the stream started.
    """

    frequency_hz: float = 100.0
    phase: float = 0.0
    amplitude_v: float = 0.0
    target_v: float = 0.0
    slew_v_per_s: float = 1.0
    anchor: int = 0
    frame: int = 0


class Scratch:
    """Work arrays for blocks of up to `frames` frames, allocated once."""

    def __init__(self, frames: int) -> None:
        self.index: FloatArray = np.arange(frames, dtype=np.float64)
        self.phase: FloatArray = np.empty(frames)
        self.ramp: FloatArray = np.empty(frames)

    @property
    def frames(self) -> int:
        return int(self.index.size)


def phase_now(state: Oscillator, sample_rate_hz: float) -> float:
    """Phase of the next frame, in cycles, within [0, 1)."""
    elapsed = state.frame - state.anchor
    return math.fmod(state.phase + state.frequency_hz * elapsed / sample_rate_hz, 1.0)


def amplitude_now(state: Oscillator, sample_rate_hz: float) -> float:
    """Amplitude of the next frame, in volts."""
    reach = state.slew_v_per_s * (state.frame - state.anchor) / sample_rate_hz
    difference = state.target_v - state.amplitude_v
    if reach >= abs(difference):
        return state.target_v
    return state.amplitude_v + math.copysign(reach, difference)


def retune(
    state: Oscillator,
    sample_rate_hz: float,
    *,
    target_v: float,
    slew_v_per_s: float,
    frequency_hz: float | None = None,
) -> Oscillator:
    """Head for another amplitude, and another frequency if given, from the next frame on."""
    return replace(
        state,
        phase=phase_now(state, sample_rate_hz),
        amplitude_v=amplitude_now(state, sample_rate_hz),
        anchor=state.frame,
        target_v=target_v,
        slew_v_per_s=slew_v_per_s,
        frequency_hz=state.frequency_hz if frequency_hz is None else frequency_hz,
    )


def advance(
    state: Oscillator,
    frames: int,
    sample_rate_hz: float,
    out: FloatArray | None = None,
    scratch: Scratch | None = None,
) -> tuple[Oscillator, FloatArray]:
    """The next `frames` frames.

    Parameters
    ----------
    out : (frames,) float64, optional
        Written and returned; a new array when absent.
    scratch : Scratch, optional
        Work arrays for at least `frames` frames; made afresh when absent.

    Examples
    --------
    >>> tone = Oscillator(frequency_hz=125.0, amplitude_v=1.0, target_v=1.0)
    >>> tone, samples = advance(tone, 4, 1000.0)
    >>> samples.round(3).tolist(), tone.frame
    ([0.0, 0.707, 1.0, 0.707], 4)
    """
    work = Scratch(frames) if scratch is None else scratch
    samples = np.empty(frames) if out is None else out
    elapsed = state.frame - state.anchor
    start = phase_now(state, sample_rate_hz)

    phase = work.phase[:frames]
    np.multiply(work.index[:frames], state.frequency_hz / sample_rate_hz, out=phase)
    np.add(phase, start, out=phase)
    np.multiply(phase, 2.0 * math.pi, out=phase)
    np.sin(phase, out=samples)

    difference = state.target_v - state.amplitude_v
    step = state.slew_v_per_s / sample_rate_hz
    if step * elapsed >= abs(difference):
        np.multiply(samples, state.target_v, out=samples)
    else:
        ramp = work.ramp[:frames]
        np.add(work.index[:frames], float(elapsed), out=ramp)
        np.multiply(ramp, step, out=ramp)
        np.minimum(ramp, abs(difference), out=ramp)
        np.multiply(ramp, math.copysign(1.0, difference), out=ramp)
        np.add(ramp, state.amplitude_v, out=ramp)
        np.multiply(samples, ramp, out=samples)
    return replace(state, frame=state.frame + frames), samples
