"""Is a forced run locked to its drive? Side lines near the free cycle's frequency, phase slips.

An oscillator that is not entrained keeps a line of its own between the drive's frequency and the
free one (pulled by the drive), with images about the drive's. The thesis calls a run entrained
when that line has fallen by 20 dB; its effect on the drive's coefficients is of second order,
about 2 (B/A)² for a line B beside A in a cubic loop.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from identify.quality.findings import decibel, finding
from identify.quality.spectrum import floor, purity
from identify.quality.view import MAIN_LOBE, View
from identify.results import QualityFlag

ENTRAINED_DB = -20.0  # the thesis's criterion, re the free run's level
SIGNIFICANT = 30.0  # a line's power over the noise's mean in one bin
CERTAIN_DB = -10.0  # beyond this a line may be as broad as it likes
SLIP_BLOCKS = 50
LINE_SHARE = 0.3  # of the power in BAND (of the frequency) that a limit cycle has
BAND = 0.3
PURE = 8.0  # its power over that of the bins beside it
WORTH_NOTING = 5e-4  # 2 (B/A)² below which nothing is said
AMPLIFIED = 5.0  # times that the response may err by, near a resonance
QUENCHED = 0.2  # of a forced run's level: a cycle below that does not survive it …
ALIKE = 1.4  # … to within such a factor (the window's loss between bins is 1.1)
LEAST_KEPT = 3
KEPT_SHARE = 0.75  # of the forced runs that could show it


@dataclass(frozen=True)
class FreeLine:
    """The free cycle as recorded: its frequency and its amplitude in the inputs' mean."""

    frequency_hz: float
    level: float


@dataclass(frozen=True)
class SideLine:
    """The strongest line between drive and free frequency, and its images.

    `power_ratio` is over the noise farther out; `purity` its power over that of the bins next to
    its main lobe: a peak of noise that the rig's resonance shapes is impure.
    """

    frequency_hz: float
    level: float
    power_ratio: float
    purity: float


def free_line(views: Sequence[View]) -> FreeLine | None:
    """From the free runs: medians of frequency and level."""
    free = [v for v in views if v.run.kind == "free"]
    if not free:
        return None
    level = [abs(np.mean(v.coefficients[: len(v.inputs), 0])) for v in free]
    frequency = float(np.median([v.frequency_hz for v in free]))
    return FreeLine(frequency, float(np.median(level)))


def quiet(view: View) -> list[QualityFlag]:
    """`no_limit_cycle`: a free run in which no steady line stands out of its band.

    Its coefficient is then that of noise: the rig does not oscillate, or its phase walks so fast
    that the record holds no one frequency.
    """
    if view.run.kind != "free":
        return []
    inputs = len(view.inputs)
    own = abs(view.coefficients[:inputs, 0].mean()) ** 2 / 2
    bins = np.arange(view.spectrum.shape[1]) * view.bin_hz
    band = np.abs(bins - view.frequency_hz) < BAND * view.frequency_hz
    # amplitude²/2 a bin, over the window's bandwidth of two bins
    noise = np.abs(view.spectrum[:, band].mean(axis=0)) ** 2 / 4
    share = own / max(own + float(np.sum(noise)), 1e-300)
    if share > LINE_SHARE and own > SIGNIFICANT * float(np.mean(noise)):
        return []
    detail = (
        f"the strongest line, at {view.frequency_hz:.1f} Hz, has {100 * share:.0f} % of the power "
        "around it: no steady limit cycle; nothing to do if the rig is quiet, else record longer"
    )
    return [finding(view.name, "no_limit_cycle", "excluded", detail)]


def foreign_cycle(views: Sequence[View]) -> list[QualityFlag]:
    """`no_limit_cycle`: a free run's line that stands as high in forced runs far above it.

    Such forcing quenches a cycle of the rig's own; a foreign tone it leaves as it is.
    """
    forced = [v for v in views if v.run.kind == "forced"]
    out = []
    for v in views:
        if v.run.kind != "free":
            continue
        own = float(np.linalg.norm(v.level))
        strong = [w for w in forced if own < QUENCHED * np.linalg.norm(w.level)]
        levels = [level for w in strong if (level := _beside(w, v.frequency_hz)) is not None]
        kept = sum(own / ALIKE < level < own * ALIKE for level in levels)
        if kept >= LEAST_KEPT and kept > KEPT_SHARE * len(levels):
            detail = (
                f"its line, at {v.frequency_hz:.2f} Hz, stands as high in {kept} forced runs of "
                f"{len(levels)}: a foreign tone, not a limit cycle; nothing to do if the rig is "
                "quiet, else look for its source"
            )
            out.append(finding(v.name, "no_limit_cycle", "excluded", detail))
    return out


def _beside(view: View, frequency_hz: float) -> float | None:
    """Level of a line in a run's rest; None where it is too near to the run's harmonics, or beyond
    its spectrum."""
    order = max(1, round(frequency_hz / view.frequency_hz))
    if abs(frequency_hz - order * view.frequency_hz) < 2 * MAIN_LOBE * view.bin_hz:
        return None
    centre = round(frequency_hz / view.bin_hz)
    if not 0 < centre < view.spectrum.shape[1] - 1:
        return None
    around = view.spectrum[:, centre - 1 : centre + 2]
    return float(np.linalg.norm(np.abs(around), axis=0).max())


def side_line(view: View, free: FreeLine | None) -> SideLine | None:
    """The strongest line near the drive's that is not the drive's; None where there is no bin."""
    away = 0.05 * view.frequency_hz
    if free is not None:
        away = 1.3 * abs(free.frequency_hz - view.frequency_hz) + 2 * view.bin_hz
    bins = np.arange(view.spectrum.shape[1])
    offset = np.abs(bins * view.bin_hz - view.frequency_hz)
    near = (offset <= min(away, 0.4 * view.frequency_hz)) & (offset > 0)
    if not near.any():
        return None
    power = np.abs(np.mean(view.spectrum, axis=0)) ** 2
    where = bins[near]
    peak = int(where[np.argmax(power[near])])
    outside = (offset > away + MAIN_LOBE * view.bin_hz) & (
        offset < away + (MAIN_LOBE + 30) * view.bin_hz
    )
    noise = floor(power[outside])
    return SideLine(
        frequency_hz=peak * view.bin_hz,
        level=float(np.sqrt(power[peak])),
        power_ratio=float(power[peak] / noise),
        purity=purity(power, peak),
    )


def slips(view: View) -> float:
    """Turns by which the response's phase moved against the drive's, start to end.

    The response, demodulated at the drive's frequency, is averaged over SLIP_BLOCKS
    stretches; a locked run stays within a small part of a turn.
    """
    n = view.rest.shape[1]
    if n < 4 * SLIP_BLOCKS:
        return 0.0
    edges = np.linspace(0, n, SLIP_BLOCKS + 1).astype(int)
    inputs = len(view.inputs)
    rest = view.rest[:inputs].mean(axis=0)
    sums = np.add.reduceat(rest * view.rotor, edges[:-1])
    z = complex(view.coefficients[:inputs, 0].mean()) + 2 * sums / np.diff(edges)
    return float(np.ptp(np.unwrap(np.angle(z))) / (2 * np.pi))


def bias(side: float, own: float) -> float:
    """Relative error of the coefficients of a line `own` beside a line `side`, in a cubic loop."""
    return 2 * (side / own) ** 2


def worst_bias(side: float, own: float) -> float:
    """The same of a response near a resonance, which answers so much more."""
    return AMPLIFIED * bias(side, own)


def entrainment(view: View, free: FreeLine | None) -> list[QualityFlag]:
    """`not_entrained`, `incompletely_entrained`, or nothing, of a forced run."""
    if view.run.kind != "forced":
        return []
    own = float(abs(np.mean(view.coefficients[: len(view.inputs), 0])))
    side = side_line(view, free)
    turns = slips(view)
    reference = own if free is None else free.level
    if side is None or not reference > 0:
        return []
    ratio = side.level / reference
    line = side.power_ratio > SIGNIFICANT
    where = f"line at {side.frequency_hz:.2f} Hz, {decibel(ratio):.1f} dB re " + (
        "the drive's line" if free is None else "the free run's"
    )
    if (turns > 0.6 and ratio > 0.1) or (line and side.level > 0.5 * own):
        detail = f"{where}; phase against the drive moves by {turns:.1f} turns: raise the drive"
        return [finding(view.name, "not_entrained", "excluded", detail)]
    if not line or (side.purity < PURE and decibel(ratio) < CERTAIN_DB):
        return []
    if decibel(ratio) > ENTRAINED_DB:
        detail = f"{where} (−20 dB is required): raise the drive or wait longer before recording"
        return [finding(view.name, "incompletely_entrained", "excluded", detail)]
    error = bias(side.level, own)
    if error > WORTH_NOTING:
        detail = f"{where}: biases the coefficients by about {error:.1e}; raise the drive or wait"
        worst = worst_bias(side.level, own)
        return [finding(view.name, "incompletely_entrained", "down_weighted", detail, error=worst)]
    return []
