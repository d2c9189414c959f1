"""Lines in a run's spectrum that are not the rig's own: where to look, and what stands out.

Not searched are the bins of the forcing's (or the free cycle's) harmonics, folded ones included,
and of the combinations of drive and free cycle next to the first harmonics. What stands there above
the free cycle's own line is none of them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from identify.quality.entrainment import FreeLine
from identify.quality.spectrum import local_noise, purity
from identify.quality.view import MAIN_LOBE, View

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

PEAK = 25.0  # power over noise of a peak that may be a line
SMALLEST = 1e-6  # re the fundamental: below, it is arithmetic
STEPS = 0.1  # re the converter's step: below, it is quantisation
LOWEST_HZ = 5.0
RESOLVED = 2  # bins on either side of a line, beyond which another one is seen
FOLDED = 60  # harmonics whose folded images are expected


@dataclass(frozen=True)
class Peak:
    """A local maximum beyond PEAK in run number `run`; `purity` as of `spectrum.purity`."""

    run: int
    bin: int
    frequency_hz: float
    ratio: float
    purity: float


@dataclass(frozen=True)
class Lines:
    """One run's spectrum, ready for the search: power over noise (bins,), the larger of the
    channels', 0 at bins where a line of the rig's own may stand; `power` (bins,) that
    of the channels, each over its fundamental's, 0 there too."""

    view: View
    usable: BoolArray
    ratio: FloatArray
    power: FloatArray

    def purity(self, b: int) -> float:
        return purity(self.power, b)

    def at(self, frequency_hz: float) -> tuple[int, float]:
        """(bin, ratio) of the largest within a bin of a frequency; ratio −1: not to be seen."""
        centre = round(frequency_hz / self.view.bin_hz)
        low, high = max(centre - 1, 0), min(centre + 2, self.ratio.size)
        if low >= high or not self.usable[low:high].all():
            return centre, -1.0
        peak = low + int(np.argmax(self.ratio[low:high]))
        return peak, float(self.ratio[peak])


def lines(view: View, free: FreeLine | None, combinations: bool = True) -> Lines:
    power = np.abs(view.spectrum) ** 2
    usable = expected(view, free, combinations)
    ratio = np.zeros(power.shape)
    for i, name in enumerate(view.inputs):
        noise = local_noise(power[i], usable)
        step = view.run.signals[name].resolution or 0.0
        least = max(SMALLEST * view.level[i], STEPS * step) ** 2
        ratio[i] = np.where(power[i] > least, power[i] / noise, 0.0)
    return Lines(view, usable, ratio.max(axis=0), np.where(usable, view.relative_power, 0.0))


def expected(view: View, free: FreeLine | None, combinations: bool = True) -> BoolArray:
    """Bins (bins,) where no line of the rig's own is expected: True where one may search.

    Without `combinations`, of what the free cycle brings only its own line counts, no wider than it
    is: what combines with the drive lies elsewhere in a run at another frequency.
    """
    count, width, rate = view.spectrum.shape[1], view.bin_hz, view.run.sample_rate_hz
    usable = np.ones(count, dtype=bool)
    usable[: max(8, int(np.ceil(LOWEST_HZ / width)))] = False
    usable[-2 * MAIN_LOBE :] = False

    def hide(frequencies: npt.NDArray[np.floating[Any]], reach: int) -> None:
        folded = np.abs(frequencies - rate * np.round(frequencies / rate))
        at = np.round(folded / width).astype(int)
        around = at[:, None] + np.arange(-reach, reach + 1)
        usable[np.clip(around, 0, count - 1)] = False

    harmonics = np.asarray(view.frequency_hz * np.arange(FOLDED + 1), dtype=np.float64)
    unfolded = harmonics < rate / 2
    hide(harmonics[unfolded], 2 * MAIN_LOBE)
    hide(harmonics[~unfolded], 2)
    if free is not None and not combinations:
        hide(free.frequency_hz * np.arange(1, 8), RESOLVED)
    elif free is not None and view.run.kind != "free":
        beat = free.frequency_hz - view.frequency_hz
        cycle = free.frequency_hz * np.arange(1, 8)
        mixed = [harmonics[:7] + m * beat for m in (-3, -2, -1, 1, 2, 3)]
        own = np.concatenate([*mixed, cycle])
        hide(own[~_above_the_cycle(view, own, beat)], MAIN_LOBE)
    return usable


def _above_the_cycle(
    view: View, centres: npt.NDArray[np.floating[Any]], beat_hz: float
) -> BoolArray:
    """Where, away from the drive's frequency, a line is above all between that and the free
    cycle's: no combination of the two is."""
    power, own = view.relative_power, view.frequency_hz
    low, high = sorted((own, own + beat_hz))
    first, last = (round(f / view.bin_hz) for f in (low, high))
    strongest = float(power[max(first - MAIN_LOBE, 0) : last + MAIN_LOBE + 1].max())
    at = np.clip(np.round(centres / view.bin_hz).astype(int), MAIN_LOBE, power.size - MAIN_LOBE - 1)
    around = at[:, None] + np.arange(-MAIN_LOBE, MAIN_LOBE + 1)
    away = np.abs(centres - own) > 3.5 * abs(beat_hz) + MAIN_LOBE * view.bin_hz
    return np.asarray(away & (power[around].max(axis=1) > strongest))


def peaks(found: Lines, run: int) -> list[Peak]:
    """Every local maximum beyond PEAK, the highest within a main lobe, placed between bins."""
    r = found.ratio
    out = []
    for b in np.flatnonzero(r > PEAK).tolist():
        low, high = max(b - MAIN_LOBE, 0), b + MAIN_LOBE + 1
        if r[b] < r[low:high].max():
            continue
        shift, _ = crest(found.view, b)
        at = (b + shift) * found.view.bin_hz
        out.append(Peak(run, b, at, float(r[b]), found.purity(b)))
    return out


def crest(view: View, b: int) -> tuple[float, float]:
    """Of a line near bin b: its place in bins from b, and the factor by which it exceeds bin b.

    A parabola through the logarithms: the main lobe is nearly a Gaussian.
    """
    power = np.sum(np.abs(view.spectrum[:, b - 1 : b + 2]) ** 2, axis=0)
    a0, a1, a2 = np.log(power + 1e-300)
    bend = a0 - 2 * a1 + a2
    if not bend < 0:
        return 0.0, 1.0
    shift = float(np.clip(0.5 * (a0 - a2) / bend, -0.5, 0.5))
    return shift, float(np.exp(-bend * shift**2 / 4))
