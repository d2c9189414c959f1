"""What is wrong with a broadband recording itself, before any effect is believed.

The checks are those of single runs (`identify.quality`) where they need no harmonics: flat tops,
repeated stretches, held samples, foreign tones. The declared fit's residual stands for what the
signal is not. A recording has no other runs to stand in for it: where it is spoilt, nothing is
claimed.
"""

import numpy as np
import numpy.typing as npt
from scipy.signal.windows import blackmanharris

from identify.broadband.fit import Fit
from identify.broadband.lines import Lines
from identify.broadband.model import Excitation
from identify.broadband.rest import SIGNIFICANT, stretches, unevenness
from identify.quality.channels import SIGNIFICANT_SHARE, flat_tops
from identify.quality.findings import Severity, finding
from identify.quality.samples import (
    MANY_HELD,
    STEP_SAMPLES,
    STEP_SIGMAS,
    held_runs,
    high_frequency_noise,
    repeats,
)
from identify.quality.spectrum import local_noise, purity, tail
from identify.quality.tones import mains_order
from identify.results import QualityFlag

FloatArray = npt.NDArray[np.float64]

TONE_P = 1e-6  # chance of a tone among noise, all bins considered
PURE = 8.0  # power of a tone's main lobe over that of the bins beside it
MOST = 5  # tones that are named
LAGS = 12  # samples by which one channel may have slipped
SIDE = 3  # stretches on either side of a slip
FAR_LESS = 0.5  # of what the declared model leaves, RMS
WEAK = 0.02  # share of the response's power that the drive must account for


def quality(
    record: Excitation, declared: Fit, best: Fit, estimation: slice, lines: Lines | None, name: str
) -> tuple[QualityFlag, ...]:
    """Flags of one recording, given the fits of the declared and of the richest model."""
    residual = best.residual
    return (
        *_clipped(record, declared, name),
        *_repeated(record, declared, lines, name),
        *_held(record, declared, name),
        *_lost(record, _standing(declared, best, estimation), estimation, name),
        *_tones(record, residual[estimation], name),
        *_weak(record, best, estimation, name),
        *_uneven(record, residual, estimation, name),
    )


def spoilt(flags: tuple[QualityFlag, ...]) -> bool:
    """Whether nothing may be claimed from this recording."""
    return any(f.severity == "excluded" for f in flags)


def _step(x: FloatArray) -> float:
    """The converter's step, as far as the values show one."""
    differences = np.abs(np.diff(x))
    moved = differences[differences > 0]
    return float(moved.min()) if moved.size else 0.0


def _clipped(record: Excitation, declared: Fit, name: str) -> list[QualityFlag]:
    share, level = flat_tops(record.y, declared.residual, _step(record.y))
    if share == 0.0:
        return []
    severity: Severity = "excluded" if share > SIGNIFICANT_SHARE else "noted"
    unit = record.scale.output_unit
    detail = (
        f"response: {100 * share:.2g} % of the samples flat at {level:.4g} {unit}; reduce the "
        "gain before the converter, and record again"
    )
    return [finding(name, "clipped", severity, detail)]


def _repeated(
    record: Excitation, declared: Fit, lines: Lines | None, name: str
) -> list[QualityFlag]:
    noise = high_frequency_noise(declared.residual)
    if lines is not None or noise < max(2 * _step(record.y), 1e-6 * record.scale.output):
        return []  # periods without noise repeat themselves
    count, first = repeats(record.y)
    if count == 0:
        return []
    detail = (
        f"response: {count} stretches repeat an earlier one exactly, the first at "
        f"{first / record.sample_rate_hz:.3f} s; check the buffers, record again"
    )
    return [finding(name, "repeated_samples", "excluded", detail)]


def _held(record: Excitation, declared: Fit, name: str) -> list[QualityFlag]:
    x = record.y
    reach = 8 * high_frequency_noise(declared.residual) + 4 * _step(x)
    start, stop, stuck = held_runs(x, declared.prediction, reach)
    count = int(np.sum((stop - start)[stuck]))
    if count == 0:
        return []
    severity: Severity = "excluded" if count > MANY_HELD else "noted"
    detail = (
        f"response: {count} samples repeat the one before, the first at "
        f"{start[stuck][0] / record.sample_rate_hz:.3f} s, while the motion goes on; check the "
        "converter and its driver"
    )
    return [finding(name, "repeated_samples", severity, detail)]


def _standing(declared: Fit, best: Fit, estimation: slice) -> Fit:
    """The richest model where it leaves far less than the declared one does: past a resonance that
    bends, a linear model is ahead of a sweep by samples. Else what it adds may have gone astray."""
    left = [float(np.linalg.norm(f.residual[estimation])) for f in (declared, best)]
    return best if left[1] < FAR_LESS * left[0] else declared


def _lost(record: Excitation, fitted: Fit, estimation: slice, name: str) -> list[QualityFlag]:
    """A step of the response's lag behind the model's, stretch by stretch: samples of one channel
    were lost, or inserted."""
    y, model = record.y[estimation], fitted.prediction[estimation]
    parts = stretches(y.size)
    if y.size < 8 * LAGS * len(parts):
        return []  # too short to tell
    lag = np.array([_lag(y[p], model[p]) for p in parts])

    splits = range(SIDE, lag.size - SIDE + 1)
    steps = [float(np.median(lag[at:]) - np.median(lag[:at])) for at in splits]
    off = [
        np.concatenate([part - np.median(part) for part in (lag[:at], lag[at:])]) for at in splits
    ]
    where = int(np.argmin([np.sum(np.abs(x)) for x in off]))
    at, step, sigma = splits[where], steps[where], 1.4826 * float(np.median(np.abs(off[where])))
    if abs(step) < max(STEP_SIGMAS * sigma, STEP_SAMPLES):
        return []
    when = (estimation.start + parts[at].start) / record.sample_rate_hz
    detail = (
        f"response: from about {when:.1f} s on it comes {abs(step):.1f} samples "
        f"{'early' if step < 0 else 'late'} against before, as if one channel had lost some; "
        "check the buffers, record again"
    )
    return [finding(name, "dropped_samples", "excluded", detail)]


def _lag(y: FloatArray, model: FloatArray) -> float:
    """Samples by which `y` follows `model`, by the peak of their correlation within LAGS."""
    inner = slice(LAGS, y.size - LAGS)
    shifts = np.arange(-LAGS, LAGS + 1)
    like = np.array([y[LAGS + k : y.size - LAGS + k] @ model[inner] for k in shifts])
    top = int(np.argmax(like[1:-1])) + 1
    left, middle, right = like[top - 1 : top + 2]
    bend = 2 * middle - left - right
    return float(shifts[top] + (0.5 * (right - left) / bend if bend > 0 else 0.0))


def _tones(record: Excitation, residual: FloatArray, name: str) -> list[QualityFlag]:
    """Lines in what the richest model leaves: of the mains, or foreign ones."""
    window = blackmanharris(residual.size)
    power = np.abs(np.fft.rfft((residual - residual.mean()) * window)) ** 2
    noise = local_noise(power, np.ones(power.size, dtype=bool))
    chance = tail(power / noise) * power.size
    hz = record.sample_rate_hz / residual.size
    flags: list[QualityFlag] = []
    amplitude = 2 * np.sqrt(power) / window.sum()
    hidden = np.zeros(power.size, dtype=bool)
    for b in np.argsort(chance):
        if chance[b] > TONE_P or len(flags) == MOST:
            break
        if hidden[b] or b < 8 or purity(power, int(b)) < PURE:
            continue
        hidden[max(b - 8, 0) : b + 9] = True
        mains = mains_order(float(b * hz), 0.5 * hz)
        detail = (
            f"line at {b * hz:.2f} Hz in the residual, {amplitude[b]:.3g} "
            f"{record.scale.output_unit}, {10 * np.log10(power[b] / noise[b]):.0f} dB above what "
            "surrounds it; "
        )
        flag = "foreign_tone" if mains is None else "mains_hum"
        remedy = (
            "look for its source"
            if mains is None
            else f"{mains[0]} × {mains[1]:g} Hz: look for a ground loop"
        )
        flags.append(finding(name, flag, "noted", detail + remedy))
    return flags


def _weak(record: Excitation, best: Fit, estimation: slice, name: str) -> list[QualityFlag]:
    y = record.y[estimation]
    share = 1 - float(np.sum(best.residual[estimation] ** 2) / np.sum((y - y.mean()) ** 2))
    if share > WEAK:
        return []
    detail = (
        f"response: the drive accounts for {100 * max(share, 0.0):.1f} % of its power; check that "
        "both channels are connected, in this order"
    )
    return [finding(name, "dead_channel", "excluded", detail)]


def _uneven(
    record: Excitation, residual: FloatArray, estimation: slice, name: str
) -> list[QualityFlag]:
    """A stretch whose residual is far larger than elsewhere, though the motion is not."""
    p, worst = unevenness(residual[estimation], record.y[estimation], record.sample_rate_hz)
    if p > SIGNIFICANT:
        return []
    part = stretches(estimation.stop - estimation.start)[worst]
    inside = residual[estimation][part]
    at = estimation.start + part.start + int(np.argmax(np.abs(inside)))
    detail = (
        f"response: what the model leaves is far larger near {at / record.sample_rate_hz:.2f} s "
        "than elsewhere; look for lost samples, a knock, or a change of the rig"
    )
    return [finding(name, "uneven_residual", "noted", detail)]
