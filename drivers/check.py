"""The harmless part of the contract on real hardware: is this rig fit for a campaign?

With the flame off and the speaker connected, `check_rig` records silence, then raises the drive in
three small steps, then silences. It measures

    noise floor       rms of each channel over `silence_s`
    clipping margin   20 log₁₀(full scale / peak) of each channel at the highest step
    drive level       amplitude at `frequency_hz` against the drive: proportional within 5 %
    round trip        from the drive command to its first sound on any channel
    channel skew      phase between channels of the same quantity over 2πf: a delay only where
                      they hear the same signal, and then modulo a period
    silence           from `silence()` to the last sound above the noise
    losses            gaps and xruns on the way

Every number is a measurement with its requirement; nothing is assumed from a data sheet.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.protocols import DuplexRig
from drivers.types import Block, FloatArray, Tone, require

MARGIN_DB = 6.0  # headroom below clipping at the highest step
LINEAR = 0.05  # departure from proportionality between steps
SILENT_WITHIN_S = 0.5
NOISE_FACTOR = 6.0  # peak over rms of Gaussian noise: exceeded once in 5e8 samples
STEPS = (0.25, 0.5, 1.0)


@dataclass(frozen=True)
class Finding:
    """One measurement; `ok` is `None` where there is a value but no requirement."""

    name: str
    value: float
    unit: str
    ok: bool | None
    text: str


def check_rig(
    rig: DuplexRig,
    level_v: float,
    frequency_hz: float = 170.0,
    silence_s: float = 1.0,
    step_s: float = 0.5,
) -> list[Finding]:
    """Start the rig, measure, and leave it stopped and silent whatever happens.

    Raises `SettingError` for a level beyond the limits, and what the rig itself raises.
    """
    limits = rig.limits
    require(
        0 < level_v <= limits.max_amplitude_v,
        "level_v",
        level_v,
        f"within 0...{limits.max_amplitude_v} V",
    )
    rig.start()
    try:
        return _measured(rig, level_v, frequency_hz, silence_s, step_s)
    finally:
        rig.silence()
        rig.stop()


def _measured(
    rig: DuplexRig, level_v: float, frequency_hz: float, silence_s: float, step_s: float
) -> list[Finding]:
    quiet = _record(rig, silence_s)
    noise = _Noise(np.mean(quiet.samples, axis=0), np.std(quiet.samples, axis=0))
    findings = [
        Finding(f"noise floor {channel.name}", float(rms), "V rms", None, "output silent")
        for channel, rms in zip(rig.channels, noise.rms_v, strict=True)
    ]
    ramp_s = level_v / rig.limits.max_slew_v_per_s
    levels = []
    for share in STEPS:
        told_s = rig.clock.now()
        rig.drive(Tone(frequency_hz, share * level_v))
        onset = _record(rig, ramp_s + step_s)
        if share == STEPS[0]:
            findings.append(_round_trip(onset, noise, told_s))
        steady = _record(rig, step_s)
        levels.append(_phasor(steady, noise, frequency_hz))
    findings += _margins(rig, steady)
    findings += _linearity(rig, np.abs(np.array(levels)), noise, steady)
    findings += _skews(rig, levels[-1], frequency_hz, noise)
    told_s = rig.clock.now()
    rig.silence()
    findings.append(_silence(_record(rig, SILENT_WITHIN_S + step_s), noise, told_s))
    status = rig.status()
    text = f"{len(status.gaps)} gaps, {status.xruns} xruns"
    lost = status.lost_frames
    whole = lost == 0 and status.xruns == 0
    return [*findings, Finding("lost frames", float(lost), "frames", whole, text)]


@dataclass(frozen=True)
class _Recording:
    samples: FloatArray  # (frames, channels)
    time_s: float
    rate_hz: float


@dataclass(frozen=True)
class _Noise:
    mean_v: FloatArray
    rms_v: FloatArray

    def sound(self, recording: _Recording) -> FloatArray:
        """Times of the frames in which any channel stands out of its noise."""
        # A digital loop has no noise at all: then a part in a million of a volt counts.
        threshold = NOISE_FACTOR * self.rms_v + 1e-6
        rows = np.flatnonzero(np.any(np.abs(recording.samples - self.mean_v) > threshold, axis=1))
        return recording.time_s + rows / recording.rate_hz


def _record(rig: DuplexRig, seconds: float) -> _Recording:
    blocks: list[Block] = []
    wanted = round(seconds * rig.sample_rate_hz)
    while wanted > 0:
        rig.feed()
        block = rig.read(min(wanted, max(1, round(0.02 * rig.sample_rate_hz))))
        blocks.append(block)
        wanted -= block.frames
    samples = np.concatenate([block.samples for block in blocks])
    return _Recording(samples, blocks[0].time_s, rig.sample_rate_hz)


def _phasor(
    recording: _Recording, noise: _Noise, frequency_hz: float
) -> npt.NDArray[np.complex128]:
    """Complex amplitude of each channel at the drive's frequency, by least squares."""
    angle = 2 * np.pi * frequency_hz * np.arange(len(recording.samples)) / recording.rate_hz
    design = np.column_stack([np.cos(angle), -np.sin(angle)])
    parts = np.linalg.lstsq(design, recording.samples - noise.mean_v, rcond=None)[0]
    return np.asarray(parts[0] + 1j * parts[1])


def _round_trip(onset: _Recording, noise: _Noise, told_s: float) -> Finding:
    times = noise.sound(onset)
    if times.size == 0:
        text = "the drive is heard on no channel: is the amplifier on, the level high enough?"
        return Finding("round trip", float("nan"), "s", False, text)
    return Finding("round trip", float(times[0]) - told_s, "s", None, "command to first sound")


def _silence(tail: _Recording, noise: _Noise, told_s: float) -> Finding:
    times = noise.sound(tail)
    after_s = float(times[-1]) - told_s if times.size else 0.0
    text = f"within {SILENT_WITHIN_S} s of silence(), latency included"
    return Finding("silence", max(0.0, after_s), "s", after_s <= SILENT_WITHIN_S, text)


def _margins(rig: DuplexRig, steady: _Recording) -> list[Finding]:
    findings = []
    peaks = np.max(np.abs(steady.samples), axis=0)
    for channel, peak in zip(rig.channels, peaks, strict=True):
        margin = 20.0 * math.log10(channel.full_scale_v / max(float(peak), 1e-12))
        text = f"at least {MARGIN_DB:g} dB to full scale at the highest step"
        name = f"clipping margin {channel.name}"
        findings.append(Finding(name, margin, "dB", margin >= MARGIN_DB, text))
    return findings


def _linearity(
    rig: DuplexRig, levels: FloatArray, noise: _Noise, steady: _Recording
) -> list[Finding]:
    """Largest departure from level ∝ drive, where the lowest step is heard above its noise."""
    shares = np.array(STEPS)[:, None]
    # Standard error of an amplitude fitted over N samples: σ√(2/N).
    error = noise.rms_v * math.sqrt(2.0 / len(steady.samples))
    findings = []
    for k, channel in enumerate(rig.channels):
        if levels[0, k] <= 10.0 * error[k] + 1e-9:
            continue
        ratio = levels[:, k] / shares[:, 0]
        departure = float(np.max(np.abs(ratio / ratio[-1] - 1.0)))
        text = f"three steps, within {LINEAR:.0%}"
        findings.append(
            Finding(f"drive level {channel.name}", departure, "", departure <= LINEAR, text)
        )
    return findings


def _skews(
    rig: DuplexRig, phasors: npt.NDArray[np.complex128], frequency_hz: float, noise: _Noise
) -> list[Finding]:
    findings = []
    heard = [k for k, phasor in enumerate(phasors) if abs(phasor) > 10.0 * noise.rms_v[k] + 1e-9]
    for a, b in itertools.combinations(heard, 2):
        first, second = rig.channels[a], rig.channels[b]
        if first.quantity == second.quantity:
            # Re c·exp(jωt) delayed by τ has the phase −ωτ.
            delay = -float(np.angle(phasors[b] / phasors[a])) / (2 * math.pi * frequency_hz)
            text = "a delay of the second, if both hear the same signal"
            findings.append(Finding(f"skew {first.name} to {second.name}", delay, "s", None, text))
    return findings
