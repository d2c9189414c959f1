"""Foreign tones: lines that are there whatever the rig does.

A line is interference when it stands at the same frequency, to within a bin, in more than half of
the runs where it could be seen. A rig's own narrow resonance, shaken by turbulence, peaks
elsewhere in every run: where such scattered peaks surround it, a line is not believed.

What the free cycle and the drive combine to moves with the drive, and a line among all that, where
no single run could tell it apart, is foreign where runs at several forcings have it at one place.

A line of the mains brings its multiples. One of those is believed wherever the rig's own lines
leave it to be seen, be it in a single run: forced at three times 50 Hz, no run shows what it takes
for its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from identify.chances import chi2_tail
from identify.harmonics import harmonic_under
from identify.quality.entrainment import FreeLine
from identify.quality.findings import finding
from identify.quality.lines import Lines, Peak, crest, lines, peaks
from identify.quality.spectrum import tail
from identify.quality.view import View
from identify.results import QualityFlag

ALONE = 100.0  # power over noise of a line that is named though no other run has it
PURE = 4.0  # power over that of the bins beside it, of a line; of one found alone twice that
PURE_KNOWN = 1.0  # where other runs have a line: what the chance PRESENT stands for
PRESENT = 1e-3  # chance below which a known tone counts as present in a run
ALPHA = 1e-6  # chance of a tone among noise, all runs and bins considered
CREST_BINS = 0.01  # to which the parabola through a line's three bins places it
SAME_BINS = 0.75  # peaks this near belong together
AROUND_BINS = 15.0  # where scattered peaks betray a resonance
OWN = 0.2  # of the run's frequency, next to which the rig's own resonance stands
ORDERS = 200  # harmonics of a discontinuous loop that may fold into the band
LEAST_ALONE = 5e-4  # of the fundamental: a smaller line in one run harms nothing
SEEN_SHARE = 0.4  # of the runs in which a tone must not be hidden by the rig's own lines
DIFFERENT = 4  # forcing frequencies, at least, of runs that have a line at the same place
MAINS_HZ = (50.0, 60.0)
MAINS_ORDERS = 20


@dataclass(frozen=True)
class Tone:
    """A foreign tone. `amplitude` (peak) and `stderr` are of the velocity, in `unit`; `runs`
    those where it is significant; `p_value` that of noise doing this anywhere in the spectra."""

    frequency_hz: float
    frequency_stderr_hz: float
    amplitude: float
    stderr: float
    unit: str
    runs: tuple[str, ...]
    p_value: float


@dataclass(frozen=True)
class Sighting:
    """A tone in one run: its bin and power over noise there."""

    where: Lines
    bin: int
    ratio: float

    @property
    def view(self) -> View:
        return self.where.view

    @property
    def chance(self) -> float:
        """Of noise being so high in one of the three bins looked at."""
        return min(1.0, 3 * float(tail(self.ratio)))


def tones(
    views: Sequence[View], free: FreeLine | None
) -> tuple[tuple[Tone, ...], list[QualityFlag]]:
    """Tones common to most runs, and flags of every run's foreign lines."""
    searched = [lines(v, free) for v in views]
    found = [p for i, s in enumerate(searched) for p in peaks(s, i)]
    if not found:
        return (), []
    width = float(np.median([v.bin_hz for v in views]))
    out: list[Tone] = []
    flags: list[QualityFlag] = []
    for members in clusters([p for p in found if p.purity > PURE], SAME_BINS * width):
        frequency = float(np.median([p.frequency_hz for p in members]))
        around = scattered(found, frequency, width)
        present = sightings(searched, frequency)
        if len({p.run for p in members}) > 1 and present and 4 * around <= len(present):
            tone = common(searched, frequency, present)
            if tone is not None:
                out.append(tone)
                flags += [line_flag(s, frequency, True) for s in present]
                continue
        for p in members:
            lone = p.ratio > ALONE and p.purity > 2 * PURE and around == 0
            where = searched[p.run]
            own = where.view.frequency_hz
            level = np.abs(where.view.spectrum[:, p.bin]) / np.maximum(where.view.level, 1e-300)
            lone = lone and bool(level.max() > LEAST_ALONE)
            if lone and abs(p.frequency_hz - own) > OWN * own and not derived(p, found, where.view):
                sighting = Sighting(where, p.bin, p.ratio)
                flags.append(line_flag(sighting, p.frequency_hz, False))

    def add(where: Sequence[Lines], frequency: float, present: Sequence[Sighting]) -> None:
        known = any(abs(tone.frequency_hz - frequency) < SAME_BINS * width for tone in out)
        tone = common(where, frequency, present) if present and not known else None
        if tone is not None:
            out.append(tone)
            flags.extend(line_flag(s, frequency, True) for s in present)

    for frequency in multiples(out):
        add(searched, frequency, sightings(searched, frequency, credible=True))
    bare = [lines(v, free, combinations=False) for v in views]
    for frequency in constant(bare, SAME_BINS * width):
        add(bare, frequency, sightings(bare, frequency, credible=True))
    return tuple(out), flags


def constant(searched: Sequence[Lines], width_hz: float) -> list[float]:
    """Frequencies at which runs have a line, forced as they are at different ones."""
    found = [p for i, s in enumerate(searched) for p in peaks(s, i)]
    out = []
    for members in clusters([p for p in found if p.purity > PURE], width_hz):
        runs = {p.run for p in members}
        forced = {searched[i].view.frequency_hz for i in runs}
        frequency = float(np.median([p.frequency_hz for p in members]))
        around = scattered(found, frequency, width_hz / SAME_BINS)
        if len(forced) >= DIFFERENT and 4 * around <= len(runs):
            out.append(frequency)
    return out


def multiples(found: Sequence[Tone]) -> list[float]:
    """Multiples of the mains' frequency, where a line of it has been found, in Hz."""
    out = []
    for mains in MAINS_HZ:
        orders = [(t, round(t.frequency_hz / mains)) for t in found]
        own = [(t, k) for t, k in orders if mains_order(t.frequency_hz, 0.0) == (k, mains)]
        if own:
            base = float(np.median([t.frequency_hz / k for t, k in own]))
            out += [k * base for k in range(1, MAINS_ORDERS + 1)]
    return out


def on_harmonics(views: Sequence[View], known: Sequence[Tone]) -> list[QualityFlag]:
    """`tone_on_harmonic`: a known tone stands where it cannot be told from a run's harmonic."""
    out = []
    for v in views:
        for tone in known:
            count = v.coefficients.shape[1]
            order = harmonic_under(tone.frequency_hz, v.frequency_hz, 1 / v.bin_hz, count)
            if order is not None:
                detail = (
                    f"harmonic {order}, {order * v.frequency_hz:.2f} Hz, coincides with the tone "
                    f"at {tone.frequency_hz:.2f} Hz, which counts as noise there "
                    f"({tone.amplitude:.3g} {tone.unit}); force at another frequency"
                )
                out.append(finding(v.name, "tone_on_harmonic", "down_weighted", detail, (order,)))
    return out


def clusters(found: Sequence[Peak], width_hz: float) -> list[list[Peak]]:
    """Peaks that lie within `width_hz` of the next lower one."""
    out: list[list[Peak]] = []
    for p in sorted(found, key=lambda q: q.frequency_hz):
        if out and p.frequency_hz - out[-1][-1].frequency_hz < width_hz:
            out[-1].append(p)
        else:
            out.append([p])
    return out


def scattered(found: Sequence[Peak], frequency_hz: float, width_hz: float) -> int:
    """Number of peaks around a frequency, but not at it."""
    distance = np.array([abs(p.frequency_hz - frequency_hz) for p in found]) / width_hz
    return int(np.count_nonzero((distance > 1.5) & (distance < AROUND_BINS)))


def derived(peak: Peak, found: Sequence[Peak], view: View) -> bool:
    """Whether a line is k·f folded, or k·f ± m·g of the run's forcing f and a stronger line g."""
    rate = view.run.sample_rate_hz
    harmonics = view.frequency_hz * np.arange(ORDERS)
    folded = np.abs(harmonics - rate * np.round(harmonics / rate))
    if np.min(np.abs(folded - peak.frequency_hz)) < 0.3 * view.bin_hz:
        return True
    stronger = [p.frequency_hz for p in found if p.run == peak.run and p.ratio > peak.ratio]
    k = np.arange(-6, 7)[:, None]
    m = np.arange(1, 4)[None, :]
    for g in stronger:
        at = np.abs(k * view.frequency_hz + m * g)
        if np.min(np.abs(at - peak.frequency_hz)) < 2 * view.bin_hz:
            return True
    return False


def sightings(
    searched: Sequence[Lines], frequency_hz: float, credible: bool = False
) -> list[Sighting]:
    """The runs in which a tone is, if they are most of those that could show it; else none.

    Unless there is more to say for it, two must show it, and SEEN_SHARE of all be able to.
    """
    seen = [Sighting(s, *s.at(frequency_hz)) for s in searched]
    seen = [s for s in seen if s.ratio >= 0]
    present = [s for s in seen if s.chance < PRESENT and s.where.purity(s.bin) > PURE_KNOWN]
    if 2 * len(present) <= len(seen):
        return []
    enough = len(present) > 1 and len(seen) >= SEEN_SHARE * len(searched)
    return present if enough or credible else []


def common(
    searched: Sequence[Lines], frequency_hz: float, present: Sequence[Sighting]
) -> Tone | None:
    """The tone with its mean amplitude; None when noise could do it (Fisher's sum over runs)."""
    seen = [Sighting(s, *s.at(frequency_hz)) for s in searched]
    chance = np.array([s.chance for s in seen if s.ratio >= 0])
    statistic = -2 * float(np.sum(np.log(np.maximum(chance, 1e-300))))
    bins = max(s.ratio.size for s in searched)
    p_value = min(1.0, bins * chi2_tail(statistic, 2 * chance.size))
    if p_value > ALPHA:
        return None
    amplitude = np.array([velocity(s) for s in present])
    noise = amplitude / np.sqrt([max(s.ratio, 1.0) for s in present])
    # seen in one run, it may be another in the next one
    spread = (
        float(np.std(amplitude, ddof=1)) / np.sqrt(amplitude.size)
        if amplitude.size > 1
        else float(amplitude[0]) / 2
    )
    stderr = max(spread, float(np.sqrt(np.sum(noise**2)) / amplitude.size))
    places = np.array([(s.bin + crest(s.view, s.bin)[0]) * s.view.bin_hz for s in present])
    wander = float(np.std(places, ddof=1)) / np.sqrt(places.size) if places.size > 1 else 0.0
    first = present[0].view
    placed = float(np.hypot(wander, CREST_BINS * first.bin_hz))
    unit = "m/s" if first.microphones is not None else first.run.signals[first.inputs[0]].unit
    names = tuple(s.view.name for s in present)
    amplitude_mean = float(np.mean(amplitude))
    return Tone(frequency_hz, placed, amplitude_mean, stderr, unit, names, p_value)


def velocity(sighting: Sighting) -> float:
    """Amplitude of the velocity there, with the window's loss between bins taken back."""
    view, b = sighting.view, sighting.bin
    _, factor = crest(view, b)
    return abs(view.velocity_of(view.spectrum[:, b], b * view.bin_hz)) * factor


def mains_order(frequency_hz: float, tolerance_hz: float) -> tuple[int, float] | None:
    """(order, mains frequency) when a frequency is a multiple of 50 or 60 Hz."""
    for mains in MAINS_HZ:
        order = round(frequency_hz / mains)
        if (
            1 <= order <= MAINS_ORDERS
            and abs(frequency_hz - order * mains) < tolerance_hz + 0.1 * order
        ):
            return order, mains
    return None


def line_flag(sighting: Sighting, frequency_hz: float, consistent: bool) -> QualityFlag:
    view = sighting.view
    own = np.abs(view.spectrum[:, sighting.bin])
    i = int(np.argmax(own / np.maximum(view.level, 1e-300)))
    mains = mains_order(frequency_hz, 0.5 * view.bin_hz)
    text = (
        f"line at {frequency_hz:.2f} Hz, {own[i]:.3g} {view.run.signals[view.inputs[i]].unit} in "
        f"{view.inputs[i]} ({own[i] / view.level[i]:.1e} of the fundamental, "
        f"{10 * np.log10(sighting.ratio):.0f} dB above the noise), "
        + ("in most runs that can show it" if consistent else "in this run alone")
    )
    if mains is not None:
        remedy = f"; {mains[0]} × {mains[1]:g} Hz: look for a ground loop"
        return finding(view.name, "mains_hum", "noted", text + remedy)
    return finding(view.name, "foreign_tone", "noted", text + "; look for its source")
