"""Foreign tones: lines that are there whatever the rig does.

A line is interference when it stands at the same frequency, to within a bin, in more than half of
the runs where it could be seen. A rig's own narrow resonance, shaken by turbulence, peaks
elsewhere, and more or less, in every run: where such scattered peaks surround it, or it does so
itself, a line is not believed.

What the free cycle and the drive combine to moves with the drive, and a line among all that, where
no single run could tell it apart, is foreign where runs at several forcings have it at one place.

Hum is so usual that it is believed where most runs have a little of it, though none would show it
by itself. A line of the mains brings its multiples. One of those is believed wherever the rig's own
lines leave it to be seen, be it in a single run: forced at three times 50 Hz, no run shows what it
takes for its own. Where none leaves it to be seen, it is supposed to be as large as the rest of the
hum, and the harmonic on which it would stand counts for so much less.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.chances import chi2_tail
from identify.harmonics import harmonic_under
from identify.quality.entrainment import FreeLine
from identify.quality.findings import finding
from identify.quality.growth import growth
from identify.quality.lines import Lines, Peak, crest, lines, peaks
from identify.quality.spectrum import tail
from identify.quality.view import View
from identify.results import QualityFlag

FloatArray = npt.NDArray[np.float64]

ALONE = 100.0  # power over noise of a line that is named though no other run has it
PURE = 4.0  # power over that of the bins beside it, of a line; of one found alone twice that
PURE_MEAN = 2.0  # the same on an average of runs, of a line where the mains have one
PURE_KNOWN = 1.0  # where other runs have a line: what the chance PRESENT stands for
PRESENT = 1e-3  # chance below which a known tone counts as present in a run …
HUM_PRESENT = 0.03  # … and one at the mains' frequency, of which all runs together must be sure
ALPHA = 1e-6  # chance of a tone among noise, all runs and bins considered
STILL_BINS, STILL = 0.45, 1e-3  # deviation between runs, in bins or of the frequency, of a tone
SHAKEN_BINS, SHAKEN = 0.2, 0.35  # the same of a resonance in noise, and its amplitude's, relative
CREST_BINS = 0.01  # to which the parabola through a line's three bins places it
SAME_BINS = 0.75  # peaks this near belong together
AROUND_BINS = 15.0  # where scattered peaks betray a resonance
OWN = 0.2  # of the run's frequency, next to which the rig's own resonance stands
ORDERS = 200  # harmonics of a discontinuous loop that may fold into the band
LEAST_ALONE = 5e-4  # of the fundamental: a smaller line in one run harms nothing
SEEN_SHARE = 0.4  # of the runs in which a tone must not be hidden by the rig's own lines
LEAST_SEEN = 3  # runs: where noise is sound, a lightly damped mode has a line in two by chance
DIFFERENT = 4  # forcing frequencies, at least, of runs that have a line at the same place
MAINS_HZ = (50.0, 60.0)
MAINS_ORDERS = 20


@dataclass(frozen=True)
class Tone:
    """A foreign tone. `amplitude` (peak) and `stderr` are of the velocity, in `unit`; `runs`
    those where it is significant; `p_value` that of noise doing this anywhere in the spectra. One
    that is only `supposed` stands where no run could show it."""

    frequency_hz: float
    frequency_stderr_hz: float
    amplitude: float
    stderr: float
    unit: str
    runs: tuple[str, ...]
    p_value: float
    supposed: bool = False


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


@dataclass(frozen=True)
class Place:
    """Peaks that belong together, and how many scattered ones surround them."""

    frequency_hz: float
    members: tuple[Peak, ...]
    around: int

    @property
    def runs(self) -> frozenset[int]:
        return frozenset(p.run for p in self.members)


def tones(
    views: Sequence[View], free: FreeLine | None
) -> tuple[tuple[Tone, ...], list[QualityFlag]]:
    """Tones common to most runs, those supposed under a harmonic, and flags of every run's foreign
    lines."""
    searched = [lines(v, free) for v in views]
    if not searched:
        return (), []
    found = [p for i, s in enumerate(searched) for p in peaks(s, i)]
    width = float(np.median([v.bin_hz for v in views]))
    out: list[Tone] = []
    flags: list[QualityFlag] = []

    def believed(
        where: Sequence[Lines], frequencies: Sequence[float], chance: float = PRESENT
    ) -> None:
        for frequency in frequencies:
            if any(abs(tone.frequency_hz - frequency) < SAME_BINS * width for tone in out):
                continue
            seen = seen_at(where, frequency)
            present = present_in(seen, chance)
            tone = common(frequency, seen, present) if present else None
            if tone is not None:
                out.append(tone)
                flags.extend(line_flag(s, frequency, True) for s in present)

    for place in places(found, width):
        seen = seen_at(searched, place.frequency_hz)
        present = present_in(seen)
        most = len(present) >= LEAST_SEEN and len(seen) >= SEEN_SHARE * len(searched)
        if most and len(place.runs) > 1 and 4 * place.around <= len(present):
            tone = common(place.frequency_hz, seen, present)
            if tone is not None:
                out.append(tone)
                flags += [line_flag(s, place.frequency_hz, True) for s in present]
                continue
        alone = [p for p in place.members if lone(p, place, found, searched[p.run].view)]
        flags += [
            line_flag(Sighting(searched[p.run], p.bin, p.ratio), p.frequency_hz, False)
            for p in alone
        ]
    bare = [lines(v, free, combinations=False) for v in views]
    believed(searched, hum(searched, found, width), HUM_PRESENT)
    believed(searched, multiples(out))
    believed(bare, constant(bare, width))
    return (*out, *unseen(bare, out)), flags


def places(found: Sequence[Peak], width_hz: float) -> list[Place]:
    """Where pure peaks of several runs, or of one, lie together, in bins of `width_hz`."""
    out = []
    for members in clusters([p for p in found if p.purity > PURE], SAME_BINS * width_hz):
        frequency = float(np.median([p.frequency_hz for p in members]))
        out.append(Place(frequency, tuple(members), scattered(found, frequency, width_hz)))
    return out


def lone(peak: Peak, place: Place, found: Sequence[Peak], view: View) -> bool:
    """Whether a line that no other run has is to be named all the same."""
    own = view.frequency_hz
    level = np.abs(view.spectrum[:, peak.bin]) / np.maximum(view.level, 1e-300)
    return (
        peak.ratio > ALONE
        and peak.purity > 2 * PURE
        and place.around == 0
        and bool(level.max() > LEAST_ALONE)
        and abs(peak.frequency_hz - own) > OWN * own
        and not derived(peak, found, view)
    )


def constant(searched: Sequence[Lines], width_hz: float) -> list[float]:
    """Frequencies at which runs have a line, forced as they are at different ones."""
    found = [p for i, s in enumerate(searched) for p in peaks(s, i)]
    out = []
    for place in places(found, width_hz):
        forced = {searched[i].view.frequency_hz for i in place.runs}
        if len(forced) >= DIFFERENT and 4 * place.around <= len(place.runs):
            out.append(place.frequency_hz)
    return out


def hum(searched: Sequence[Lines], found: Sequence[Peak], width_hz: float) -> list[float]:
    """The mains' frequencies, where most runs have a line too faint to be named in any of them."""
    out = []
    for mains in MAINS_HZ:
        present = present_in(seen_at(searched, mains), HUM_PRESENT)
        purity = [s.where.purity(s.bin) for s in present]
        alone = scattered(found, mains, width_hz) == 0
        if len(purity) > 1 and alone and float(np.mean(purity)) > PURE_MEAN:
            out.append(mains)
    return out


def multiples(found: Sequence[Tone]) -> list[float]:
    """Multiples of the mains' frequency, where a line of it has been found, in Hz."""
    out = []
    orders = [(t.frequency_hz, mains_order(t.frequency_hz, 0.0)) for t in found]
    for mains in MAINS_HZ:
        own = [f / order[0] for f, order in orders if order is not None and order[1] == mains]
        if own:
            out += [k * float(np.median(own)) for k in range(1, MAINS_ORDERS + 1)]
    return out


def unseen(searched: Sequence[Lines], found: Sequence[Tone]) -> list[Tone]:
    """Multiples of a hum that no run could show, under a harmonic of some run."""
    hums = [t for t in found if mains_order(t.frequency_hz, 0.0) is not None]
    pressures = searched[0].view.microphones is not None  # velocity is theirs over ω
    out = []
    for frequency in multiples(hums):
        under = (order_under(frequency, s.view) is not None for s in searched)
        if any(under) and not seen_at(searched, frequency):
            most = max(
                t.amplitude * (t.frequency_hz / frequency if pressures else 1.0) for t in hums
            )
            stderr, unit = hums[0].frequency_stderr_hz, hums[0].unit
            out.append(Tone(frequency, stderr, most, most / 2, unit, (), 1.0, supposed=True))
    return out


def order_under(frequency_hz: float, view: View) -> int | None:
    """Which of a run's harmonics a tone cannot be told from, if any."""
    count = view.coefficients.shape[1]
    return harmonic_under(frequency_hz, view.frequency_hz, 1 / view.bin_hz, count)


def on_harmonics(views: Sequence[View], known: Sequence[Tone]) -> list[QualityFlag]:
    """`tone_on_harmonic`: a tone stands where it cannot be told from a run's harmonic."""
    out = []
    for v in views:
        for tone in known:
            order = order_under(tone.frequency_hz, v)
            if order is not None:
                what = "a multiple of the hum, unseen in any run," if tone.supposed else "the tone"
                detail = (
                    f"harmonic {order}, {order * v.frequency_hz:.2f} Hz, coincides with {what} "
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


def seen_at(searched: Sequence[Lines], frequency_hz: float) -> list[Sighting]:
    """What there is at a frequency in each of the runs whose own lines do not hide it."""
    seen = [Sighting(s, *s.at(frequency_hz)) for s in searched]
    return [s for s in seen if s.ratio >= 0]


def present_in(seen: Sequence[Sighting], chance: float = PRESENT) -> list[Sighting]:
    """The runs in which a tone is, if they are most of those that could show it; else none."""
    present = [s for s in seen if s.chance < chance and s.where.purity(s.bin) > PURE_KNOWN]
    return present if 2 * len(present) > len(seen) else []


def common(
    frequency_hz: float, seen: Sequence[Sighting], present: Sequence[Sighting]
) -> Tone | None:
    """The tone with its mean amplitude; None when noise could do it (Fisher's sum over runs), or
    where it wanders from run to run as the highest bin of a resonance in noise does."""
    chance = np.array([s.chance for s in seen])
    statistic = -2 * float(np.sum(np.log(np.maximum(chance, 1e-300))))
    bins = max(s.where.ratio.size for s in seen)
    p_value = min(1.0, bins * chi2_tail(statistic, 2 * chance.size))
    if p_value > ALPHA:
        return None
    at = np.array([(s.bin + crest(s.view, s.bin)[0]) * s.view.bin_hz for s in present])
    still = max(STILL_BINS * present[0].view.bin_hz, STILL * frequency_hz)
    if at.size > 1 and float(np.std(at, ddof=1)) > still:
        return None
    amplitude = np.array([velocity(s) for s in present])
    if mains_order(frequency_hz, 0.0) is None and shaken(at / present[0].view.bin_hz, amplitude):
        return None
    noise = amplitude / np.sqrt([max(s.ratio, 1.0) for s in present])
    # seen in one run, it may be another in the next one
    spread = _of_mean(amplitude, alone=float(amplitude[0]) / 2)
    stderr = max(spread, float(np.sqrt(np.sum(noise**2)) / amplitude.size))
    wander = _of_mean(at, alone=0.0)
    first = present[0].view
    placed = float(np.hypot(wander, CREST_BINS * first.bin_hz))
    unit = "m/s" if first.microphones is not None else first.run.signals[first.inputs[0]].unit
    names = tuple(s.view.name for s in present)
    amplitude_mean = float(np.mean(amplitude))
    return Tone(frequency_hz, placed, amplitude_mean, stderr, unit, names, p_value)


def shaken(at_bins: FloatArray, amplitude: FloatArray) -> bool:
    """Whether a line wanders, and is as high as chance has it, run by run, as a narrow resonance
    in noise is (56426, a lightly damped mode taken for a tone in thirteen runs): a tone that does
    either for a reason does not do both."""
    if at_bins.size < LEAST_SEEN:
        return False
    varies = float(np.std(amplitude, ddof=1)) > SHAKEN * float(np.mean(amplitude))
    return varies and float(np.std(at_bins, ddof=1)) > SHAKEN_BINS


def _of_mean(values: FloatArray, alone: float) -> float:
    """Standard error of the values' mean, or `alone` where there is but one."""
    if values.size == 1:
        return alone
    return float(np.std(values, ddof=1)) / float(np.sqrt(values.size))


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
    size = np.abs(view.spectrum[:, sighting.bin])
    i = int(np.argmax(size / np.maximum(view.level, 1e-300)))
    mains = mains_order(frequency_hz, 0.5 * view.bin_hz)
    text = (
        f"line at {frequency_hz:.2f} Hz, {size[i]:.3g} {view.run.signals[view.inputs[i]].unit} in "
        f"{view.inputs[i]} ({size[i] / view.level[i]:.1e} of the fundamental, "
        f"{10 * np.log10(sighting.ratio):.0f} dB above the noise), "
        + ("in most runs that can show it" if consistent else "in this run alone")
    )
    if mains is not None:
        remedy = f"; {mains[0]} × {mains[1]:g} Hz: look for a ground loop"
        return finding(view.name, "mains_hum", "noted", text + remedy)
    if not consistent and (own := growth(view, i, frequency_hz)).significant:
        does, what = "dies away", "still rings; wait longer before recording"
        if own.rate > 0:
            does = "grows"
            what = "begins to sing beside the forcing; lower the drive or force elsewhere"
        text += f"; it {does} at {abs(own.rate):.2g} ± {own.stderr:.1g} 1/s: a mode that {what}"
        return finding(view.name, "another_oscillation", "noted", text)
    return finding(view.name, "foreign_tone", "noted", text + "; look for its source")
