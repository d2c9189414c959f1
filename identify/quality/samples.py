"""Samples that are lost, repeated or held: seen in the phase of every channel, and in the values.

A lost sample moves the phase of all that follows by 2πf/rate, at once: the drive's phase, which
is known to a small part of that, shows one sample in any place. Losing nearly whole periods moves
it by little, and harms as little.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from identify.quality.findings import Severity, finding
from identify.quality.view import View
from identify.results import QualityFlag

FloatArray = npt.NDArray[np.float64]

SIDE = 3  # periods averaged on either side of a step
STEP_SIGMAS = 10.0
STEP_SAMPLES = 0.4  # smallest step, in samples' worth of phase
LONE = 0.3  # of a step of one channel against the other that any step elsewhere may have
SUDDEN = 0.85  # of a step that must come within two periods: what relaxes takes longer
BLOCK = 16  # samples that are equal elsewhere only when a buffer came twice
HELD = 3  # equal samples in a row while the signal must have moved
MANY_HELD = 20


def recorded_gaps(view: View) -> list[QualityFlag]:
    """Gaps that the acquisition itself noted (and filled)."""
    gaps = view.run.notes.get("gaps")
    if not gaps:
        return []
    lost = sum(int(g[1]) for g in gaps)
    detail = f"{lost} samples lost in {len(gaps)} places, says the acquisition; record again"
    return [finding(view.name, "dropped_samples", "excluded", detail)]


def phase_steps(view: View, names: Sequence[str]) -> list[QualityFlag]:
    """Sudden steps of a channel's phase; the channels' largest is named, with its instant."""
    largest: tuple[float, str, float] | None = None
    for name in names:
        phase, times = period_phases(view, name)
        found = largest_step(view, phase)
        if found is not None and (largest is None or abs(found[0]) > abs(largest[0])):
            largest = (found[0], name, float(times[found[1] + SIDE]))
    return [] if largest is None else [_lost(view, *largest)]


def lost_in_one(view: View) -> list[QualityFlag]:
    """One sudden step of one pressure channel's phase against the other's, which samples lost in it
    alone make. What beats moves both, to and fro."""
    if len(view.inputs) != 2:
        return []
    (first, times), (second, _) = (period_phases(view, name) for name in view.inputs)
    if first.size != second.size:
        return []
    apart = np.unwrap(second - first)  # a whole turn of either alone is noise, where it is weak
    found = largest_step(view, apart)
    if found is None:
        return []
    height, at = found
    steps = np.abs(step_heights(apart))
    others = np.delete(steps, np.s_[max(at - 2 * SIDE, 0) : at + 2 * SIDE + 1])
    if others.size == 0 or others.max() > LONE * abs(height):
        return []
    own = [float(step_heights(phase)[at]) for phase in (first, second)]
    moved = int(np.argmax(np.abs(own)))
    return [_lost(view, own[moved], view.inputs[moved], float(times[at + SIDE]))]


def largest_step(view: View, phase: FloatArray) -> tuple[float, int] | None:
    """Height (rad) and place of the largest step of a phase, if it is none of the noise's and makes
    up STEP_SAMPLES of a sample."""
    if phase.size < 4 * SIDE:
        return None
    steps = step_heights(phase)
    steps = steps - np.median(steps)
    sigma = 1.4826 * float(np.median(np.abs(steps)))
    at = int(np.argmax(np.abs(steps)))
    if abs(steps[at]) <= max(STEP_SIGMAS * sigma, STEP_SAMPLES * _per_sample(view)):
        return None
    around = phase[at : at + 2 * SIDE + 1]
    if np.max(np.abs(around[2:] - around[:-2])) < SUDDEN * abs(steps[at]):
        return None  # as a run that begins before it has settled
    return float(steps[at]), at


def _per_sample(view: View) -> float:
    return 2 * np.pi * view.frequency_hz / view.run.sample_rate_hz


def _lost(view: View, height: float, name: str, when: float) -> QualityFlag:
    detail = (
        f"{name}: the phase steps by {height:+.3g} rad at {when:.3f} s, as if "
        f"{abs(height) / _per_sample(view):.1f} samples (or whole periods besides) were "
        f"{'lost' if height > 0 else 'inserted'}; check the buffers, record again"
    )
    return finding(view.name, "dropped_samples", "excluded", detail)


def period_phases(view: View, name: str) -> tuple[FloatArray, FloatArray]:
    """Phase (rad) of the fundamental, period by period, and the periods' centres (s)."""
    row = view.inputs.index(name) if name in view.inputs else view.rest.shape[0] - 1
    c = complex(view.coefficients[row, 0])
    rest = view.rest[row]
    if abs(c) == 0:
        return np.zeros(0), np.zeros(0)
    edges = np.round(np.arange(0, rest.size, view.run.sample_rate_hz / view.frequency_hz)).astype(
        int
    )
    sums = np.add.reduceat(rest * view.rotor, edges[:-1])[:-1]
    z = 1 + 2 * sums / np.diff(edges[:-1]) / c
    times = 0.5 * (edges[:-2] + edges[1:-1]) / view.run.sample_rate_hz
    return np.asarray(np.unwrap(np.angle(z))), np.asarray(times)


def step_heights(phase: FloatArray) -> FloatArray:
    """Mean of the SIDE periods after each period less that of the SIDE before it."""
    total = np.concatenate([[0.0], np.cumsum(phase)])
    means = (total[SIDE:] - total[:-SIDE]) / SIDE
    return np.asarray(means[SIDE + 1 :] - means[: -SIDE - 1])


def repeated(view: View) -> list[QualityFlag]:
    """Stretches that occur twice to the last bit, in signals whose noise forbids it."""
    for i, name in enumerate(view.inputs):
        x = view.values[name]
        step = view.run.signals[name].resolution or 0.0
        noise = high_frequency_noise(view.rest[i])
        if x.size < 2 * BLOCK or noise < max(2 * step, 1e-6 * float(view.level[i])):
            continue
        count, first = repeats(x)
        if count == 0:
            continue
        detail = (
            f"{name}: {count + BLOCK - 1} samples repeat an earlier stretch exactly, first at "
            f"{first / view.run.sample_rate_hz:.3f} s; check the buffers, record again"
        )
        return [finding(view.name, "repeated_samples", "excluded", detail)]
    return []


def repeats(x: FloatArray) -> tuple[int, int]:
    """Number of windows of BLOCK samples seen before, and the first of them.

    Windows are compared by a 64-bit sum of their samples' mixed bits times fixed random numbers;
    two that differ agree with a chance of 2⁻⁶⁴. (Unmixed, samples on a binary grid would share
    their zeros.)
    """
    bits = mixed(np.ascontiguousarray(x).view(np.uint64))
    weights = np.random.default_rng(20).integers(0, 2**63, BLOCK, dtype=np.uint64) * 2 + 1
    size = x.size - BLOCK + 1
    total = np.zeros(size, dtype=np.uint64)
    for j, w in enumerate(weights):
        total += bits[j : j + size] * w
    _, first = np.unique(total, return_index=True)
    again = np.ones(size, dtype=bool)
    again[first] = False
    if not again.any():
        return 0, 0
    # a constant stretch repeats itself; that is what `held` looks for
    again &= np.ptp(np.lib.stride_tricks.sliding_window_view(x, BLOCK), axis=1) > 0
    found = np.flatnonzero(again)
    return int(found.size), int(found[0]) if found.size else 0


def mixed(bits: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Every bit of the input in every bit of the output (splitmix64's finaliser)."""
    out = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    out = (out ^ (out >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(out ^ (out >> np.uint64(31)))


def held(view: View) -> list[QualityFlag]:
    """Equal samples in a row while the harmonics say that the signal moves."""
    out = []
    names = (*view.inputs, "drive") if view.run.kind != "free" else view.inputs
    for name in names:
        row = view.inputs.index(name) if name in view.inputs else view.rest.shape[0] - 1
        x, rest = view.values[name], view.rest[row]
        step = view.run.signals[name].resolution or 0.0
        start, stop, stuck = held_runs(x, x - rest, 8 * high_frequency_noise(rest) + 4 * step)
        if start.size == 0:
            continue
        silent = _silent_end(view, start, stop) if name == "drive" else None
        if silent is not None:
            out.append(silent)
            continue
        extreme = (np.abs(x[start] - x.max()) <= step) | (np.abs(x[start] - x.min()) <= step)
        stuck &= ~extreme  # flat tops are clipping
        count = int(np.sum((stop - start)[stuck]))
        if count == 0:
            continue
        severity: Severity = "excluded" if count > MANY_HELD else "down_weighted"
        detail = (
            f"{name}: {count} samples repeat the one before, the first at "
            f"{start[stuck][0] / view.run.sample_rate_hz:.3f} s, while the signal moves; "
            "check the converter and its driver"
        )
        out.append(finding(view.name, "repeated_samples", severity, detail))
    return out


def _silent_end(
    view: View, start: npt.NDArray[np.int64], stop: npt.NDArray[np.int64]
) -> QualityFlag | None:
    """The drive was switched on after the recording began, or off before it ended: it says nothing
    for a whole period at least."""
    rate, last = view.run.sample_rate_hz, view.rest.shape[1] - 1
    for first, end in zip(start, stop, strict=True):
        lasting = (end - first) / rate
        if lasting * view.frequency_hz < 1.0 or (first > 0 and end < last):
            continue
        how = (
            f"the drive is silent for the first {lasting:.3f} s: let it settle before recording"
            if first == 0
            else f"the drive is silent for the last {lasting:.3f} s: record while it drives"
        )
        return finding(view.name, "unsettled", "excluded", how)
    return None


def held_runs(
    x: FloatArray, model: FloatArray, reach: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Runs of HELD equal samples or more, start … stop, and during which of them the `model` moves
    by more than `reach`."""
    same = np.r_[False, np.diff(x) == 0, False]
    edges = np.flatnonzero(np.diff(same.astype(np.int8)))
    start, stop = edges[0::2], edges[1::2]  # samples start … stop are equal
    long = stop - start >= HELD - 1
    start, stop = start[long], stop[long]
    moved = [np.ptp(model[a : b + 1]) for a, b in zip(start, stop, strict=True)]
    return start, stop, np.array(moved, dtype=float) > reach


def high_frequency_noise(rest: FloatArray) -> float:
    """Standard deviation of white noise, from second differences (variance 6 σ²), robustly."""
    return float(np.median(np.abs(np.diff(rest, 2)))) / (0.6745 * float(np.sqrt(6.0)))
