"""The rule of every output, pure: from what is asked, known and sounding to what sounds next.

`step` looks at one instant and steers the oscillator. What mutes, in this order: a stop, an open
interlock, a hot coil, a caller that no longer feeds. A mute holds until a new request.

The coil's temperature follows the dissipated power with time constant τ = `thermal_time_s`,

    τ dP̄/dt = P − P̄,   P = A²/(2R),

and output is muted while P̄ is above `max_mean_power_w`, until it has fallen to 80 % of it.
"""

import math
from dataclasses import dataclass, field, replace

from drivers.oscillator import Oscillator, amplitude_now, retune
from drivers.types import OutputLimits, Tone, require

THERMAL_RELEASE = 0.8  # share of the power budget at which a muted coil may sound again


@dataclass(frozen=True, slots=True)
class Request:
    """A tone, and the number of silences that its caller had seen when asking for it."""

    tone: Tone
    silences: int


@dataclass(frozen=True, slots=True)
class Inputs:
    """What the other threads want, as seen at one instant."""

    request: Request | None = None
    silences: int = 0
    silence_reason: str | None = None
    fed_s: float = -math.inf
    stopped: str | None = None
    interlock: str | None = None


@dataclass(frozen=True, slots=True)
class GuardState:
    """What the output does; `muted` says why it is silent against the caller's wish."""

    oscillator: Oscillator = field(default_factory=Oscillator)
    served: Request | None = None
    dropped: Request | None = None
    mean_power_w: float = 0.0
    hot: bool = False
    muted: str | None = None


def check(tone: Tone, limits: OutputLimits, sample_rate_hz: float = math.inf) -> None:
    """Raise `SettingError` unless `tone` lies within the limits and below half the rate."""
    require(
        tone.amplitude_v <= limits.max_amplitude_v,
        "amplitude_v",
        tone.amplitude_v,
        f"at most the output's limit of {limits.max_amplitude_v} V; "
        "lower it, or raise max_amplitude_v in the rig's limits if the speaker allows it",
    )
    require(
        limits.min_frequency_hz <= tone.frequency_hz <= limits.max_frequency_hz,
        "frequency_hz",
        tone.frequency_hz,
        f"within the output's {limits.min_frequency_hz}...{limits.max_frequency_hz} Hz",
    )
    require(
        tone.frequency_hz < sample_rate_hz / 2,
        "frequency_hz",
        tone.frequency_hz,
        f"below half the sample rate of {sample_rate_hz} Hz",
    )


def why_muted(state: GuardState, inputs: Inputs, limits: OutputLimits, now_s: float) -> str | None:
    """The first reason for which no request may sound now; `None` when one may."""
    if inputs.stopped is not None:
        return inputs.stopped
    if inputs.interlock is not None:
        return f"interlock open: {inputs.interlock}"
    if state.hot:
        return (
            f"thermal budget: mean power {state.mean_power_w:.3g} W "
            f"of {limits.max_mean_power_w} W; let the coil cool"
        )
    if now_s - inputs.fed_s > limits.dead_man_s:
        return f"dead man: not fed for more than {limits.dead_man_s} s"
    return None


def step(
    state: GuardState,
    inputs: Inputs,
    limits: OutputLimits,
    sample_rate_hz: float,
    now_s: float,
    frames: int,
) -> GuardState:
    """Decide what the next `frames` frames do; the oscillator is steered but not yet advanced."""
    state = _heat(state, limits, sample_rate_hz, frames)
    request = inputs.request
    if request is None or request.silences != inputs.silences:
        return _mute(state, inputs.silence_reason, limits, sample_rate_hz)
    if request is state.dropped:
        # A mute holds until asked anew: feeding again does not bring an old tone back.
        return state
    reason = why_muted(state, inputs, limits, now_s)
    if reason is not None:
        state = _mute(state, reason, limits, sample_rate_hz)
        return replace(state, dropped=request, muted=reason)
    if request is state.served:
        return state
    return replace(
        state,
        served=request,
        muted=None,
        oscillator=retune(
            state.oscillator,
            sample_rate_hz,
            target_v=min(request.tone.amplitude_v, limits.max_amplitude_v),
            slew_v_per_s=limits.max_slew_v_per_s,
            frequency_hz=request.tone.frequency_hz,
        ),
    )


def _mute(
    state: GuardState, reason: str | None, limits: OutputLimits, sample_rate_hz: float
) -> GuardState:
    """Send what sounds to zero within `silence_ramp_s`; what is silent already keeps its reason."""
    if state.served is None:
        return state
    needed = amplitude_now(state.oscillator, sample_rate_hz) / limits.silence_ramp_s
    falling = retune(
        state.oscillator,
        sample_rate_hz,
        target_v=0.0,
        slew_v_per_s=max(limits.max_slew_v_per_s, needed),
    )
    return replace(state, served=None, muted=reason, oscillator=falling)


def _heat(
    state: GuardState, limits: OutputLimits, sample_rate_hz: float, frames: int
) -> GuardState:
    """Let the block's dissipation flow into the coil: exact for a constant amplitude."""
    if limits.max_mean_power_w is None:
        return state
    amplitude = amplitude_now(state.oscillator, sample_rate_hz)
    power = amplitude**2 / (2.0 * limits.load_ohm)
    keep = math.exp(-frames / (sample_rate_hz * limits.thermal_time_s))
    mean = power + (state.mean_power_w - power) * keep
    threshold = limits.max_mean_power_w * (THERMAL_RELEASE if state.hot else 1.0)
    return replace(state, mean_power_w=mean, hot=mean > threshold)
