"""Channels that carry no usable signal: missing, not finite, dead, clipped."""

import numpy as np
import numpy.typing as npt

from identify.harmonics import RecordError
from identify.quality.findings import Severity, finding
from identify.quality.samples import high_frequency_noise
from identify.quality.view import View, velocity_channels
from identify.record import Run, Signal
from identify.results import QualityFlag

FloatArray = npt.NDArray[np.float64]

SHORT_PERIODS = 5  # fewer give no coefficient
FEW_PERIODS = 41  # fewer, and the neighbours that give the noise reach the next harmonic
PLATEAU = 3  # samples in a row that a flat top must have
CODES = 10  # values below the largest to compare its count with,
PILE, PILE_RATIO = 20, 8.0  # which it exceeds by this factor when they were cut
SIGNIFICANT_SHARE = 5e-3  # of the samples clipped, beyond which a run is excluded
DEAD_RATIO = 1e-3  # of the size of the other channel's harmonics


def broken(run: Run) -> list[QualityFlag]:
    """What keeps a run from being analysed at all; every flag here excludes."""
    out: list[QualityFlag] = []

    def bad(flag: str, detail: str) -> None:
        out.append(finding(run.name, flag, "excluded", detail))

    if run.exit_status != "success":
        reason = run.notes.get("exit_reason") or "no reason recorded"
        bad("not_completed", f"exit status {run.exit_status!r}: {reason}; record the run again")
        return out
    try:
        inputs, _ = velocity_channels(run)
    except (RecordError, StopIteration) as error:
        bad("missing_channel", str(error))
        return out
    driven = run.kind != "free"
    if driven and "drive" not in run.signals:
        bad("missing_channel", "no channel 'drive' in a forced run; record the drive's voltage")
        return out
    sizes = {n: s.values.size for n, s in run.signals.items()}
    if len(set(sizes.values())) > 1:
        bad("unequal_lengths", f"samples by channel: {sizes}; every channel needs as many")
        return out
    needed = [*inputs, "drive"] if driven else list(inputs)
    for name in needed:
        x = np.asarray(run.signals[name].values, dtype=float)
        wrong = np.flatnonzero(~np.isfinite(x))
        if wrong.size:
            bad(
                "not_finite",
                f"{name}: {wrong.size} samples are not finite, the first is {wrong[0]}; "
                "look at the recording's file",
            )
        elif x.size == 0 or not np.ptp(x) > 2.5 * (run.signals[name].resolution or 0.0):
            bad(
                "dead_channel",
                f"{name}: constant over {x.size} samples (peak to peak "
                f"{np.ptp(x) if x.size else 0.0:.3g} {run.signals[name].unit}); "
                "check its cable and supply",
            )
    nominal = run.frequency_hz
    if not out and nominal is not None and run.duration_s * nominal < SHORT_PERIODS:
        bad(
            "too_short",
            f"{run.duration_s * nominal:.3g} periods of {nominal:g} Hz; "
            f"at least {SHORT_PERIODS} are required, {FEW_PERIODS} for its noise",
        )
    return out


def weak(view: View) -> list[QualityFlag]:
    """A channel that has hardly any of its neighbour's harmonics a few centimetres away."""
    if len(view.inputs) < 2 or not view.level.max() > 0:
        return []
    sizes = np.linalg.norm(view.coefficients[: len(view.inputs)], axis=1)
    ratio = float(sizes.min() / sizes.max())
    if ratio > DEAD_RATIO:
        return []
    name = view.inputs[int(np.argmin(sizes))]
    detail = (
        f"{name}: its harmonics are {ratio:.1e} of the other pressure channel's; "
        "check its cable and supply"
    )
    return [finding(view.name, "dead_channel", "excluded", detail)]


def short(view: View) -> list[QualityFlag]:
    periods = view.run.duration_s * view.frequency_hz
    if periods >= FEW_PERIODS:
        return []
    detail = (
        f"{periods:.3g} periods; with fewer than {FEW_PERIODS} the noise of a coefficient is "
        "taken from bins that reach the next harmonic: record longer"
    )
    severity: Severity = "excluded" if periods < SHORT_PERIODS else "noted"
    return [finding(view.name, "too_short", severity, detail)]


def clipped(view: View) -> list[QualityFlag]:
    """Samples at full scale, or tops cut flat below it."""
    out = []
    driven = view.run.kind != "free"
    names = (*view.inputs, "drive") if driven else view.inputs
    for i, name in enumerate(names):
        signal = view.run.signals[name]
        x = view.values[name]
        row = i if name != "drive" else view.rest.shape[0] - 1
        share, level = at_full_scale(x, signal), signal.full_scale or 0.0
        where = "at full scale"
        if share == 0.0:
            share, level = flat_tops(x, view.rest[row], signal.resolution)
            where = "flat"
        if share == 0.0:
            continue
        harmless = name == "drive" and where == "flat"  # a distorted drive, truly recorded
        severity: Severity = "noted" if harmless else "down_weighted"
        if share > SIGNIFICANT_SHARE and not harmless:
            severity = "excluded"
        detail = (
            f"{name}: {100 * share:.2g} % of the samples {where} at {level:.4g} {signal.unit}; "
            "reduce the gain before the converter or the drive, and record again"
        )
        out.append(finding(view.name, "clipped", severity, detail))
    return out


def at_full_scale(x: FloatArray, signal: Signal) -> float:
    """Share of samples at the converter's ends; 0 for one lone sample (a true peak may touch)."""
    if signal.full_scale is None:
        return 0.0
    limit = signal.full_scale - 1.5 * (signal.resolution or 1e-6 * signal.full_scale)
    count = int(np.count_nonzero(np.abs(x) >= limit))
    return count / x.size if count > 1 else 0.0


def flat_tops(x: FloatArray, rest: FloatArray, resolution: float | None) -> tuple[float, float]:
    """Share of samples cut at the signal's extremes, and the level: the worse of two tests."""
    size = float(np.max(np.abs(x)))
    step = 1.01 * max(resolution or 0.0, 1e-9 * size)
    found = [piled_up(sign * x, sign * rest, step) for sign in (1.0, -1.0)]
    noise = 4 * high_frequency_noise(rest)
    if noise > step and noise < 0.05 * size:
        found += [plateaus(sign * x, noise) for sign in (1.0, -1.0)]
    worst = int(np.argmax(found))
    sign = 1.0 if worst % 2 == 0 else -1.0
    return found[worst], sign * float((sign * x).max())


def piled_up(x: FloatArray, rest: FloatArray, step: float) -> float:
    """Share of samples on one value, the largest, while the harmonics say that they differ.

    Without clipping, the samples on the largest value are fewer than those on the values below
    (noise) or, noise being absent, differ by no more than the converter's step from the harmonics.
    """
    top = float(x.max())
    at = x >= top - 0.5 * step
    count = int(np.count_nonzero(at))
    below = np.count_nonzero((x < top - 0.5 * step) & (x >= top - (0.5 + CODES) * step)) / CODES
    if count < PILE or count < PILE_RATIO * below:
        return 0.0
    return count / x.size if float(np.std((x - rest)[at])) > 2 * step else 0.0


def plateaus(x: FloatArray, delta: float) -> float:
    """Share of samples on flat tops under noise, which spreads them over `delta`.

    A smooth top holds m samples within δ only if its curvature κ ≤ 8δ/m², and then the steps down
    at its edges are at most κ(m + 1)/2 ≤ 4δ(m + 1)/m² ≤ 1.8 δ for m ≥ 3. A cut top has the
    full slope there: steps beyond 6 δ, at three tops or more, are none of a smooth signal's.
    """
    inside = np.r_[False, x >= float(x.max()) - delta, False]
    edges = np.flatnonzero(np.diff(inside.astype(np.int8)))
    start, stop = edges[0::2], edges[1::2]
    kept = (stop - start >= PLATEAU) & (start > 0) & (stop < x.size)
    start, stop = start[kept], stop[kept]
    cut = np.minimum(x[start] - x[start - 1], x[stop - 1] - x[stop]) > 6 * delta
    return float(np.sum((stop - start)[cut])) / x.size if np.count_nonzero(cut) >= 3 else 0.0
