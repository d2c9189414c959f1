"""Runs that are not periodic: a second oscillation, near the run's own or far from it.

A modulated oscillation (a second oscillator in the loop, a generator with hum on its amplitude, a
torus) has a pair of lines at equal distances from the run's own. Another mode that sings far away
makes combinations g ± f, g ± 2f with the drive's frequency f. A tone that merely gets into the
channels has no such images.
"""

import numpy as np
import numpy.typing as npt

from identify.quality.entrainment import PURE, SIGNIFICANT, FreeLine, bias, worst_bias
from identify.quality.findings import Severity, decibel, finding
from identify.quality.lines import lines, peaks
from identify.quality.spectrum import local_noise, purity
from identify.quality.view import MAIN_LOBE, View
from identify.results import QualityFlag

FloatArray = npt.NDArray[np.float64]

LEAST = 3e-3  # of the run's own line
EXCLUDING_DB = -20.0
LEAST_FAR = 0.01  # of the run's own line: a line far away below this biases nothing
IMAGES = 2  # combinations that must be seen
REACH = 0.4  # of the run's frequency


def quasi_periodic(view: View) -> list[QualityFlag]:
    power = np.abs(np.mean(view.spectrum, axis=0)) ** 2
    own = float(abs(np.mean(view.coefficients[: len(view.inputs), 0])))
    centre = round(view.frequency_hz / view.bin_hz)
    most = min(int(REACH * centre), power.size - centre - 2 * MAIN_LOBE)
    offsets = np.arange(MAIN_LOBE + 1, most)
    if offsets.size < 3 * MAIN_LOBE or not own > 0:
        return []
    noise = local_noise(power, np.ones(power.shape, dtype=bool))
    ratio = power / noise
    # where the frequency lies between bins, the mirrored one is found within a bin
    weaker = np.minimum(ratio[centre + offsets], _largest(ratio, centre - offsets))
    d = int(offsets[np.argmax(weaker)])
    upper = centre + d
    lower = centre - d - 1 + int(np.argmax(ratio[centre - d - 1 : centre - d + 2]))
    level = float(np.sqrt(min(power[upper], power[lower]))) / own
    pure = min(purity(power, upper), purity(power, lower))
    if float(weaker.max()) < SIGNIFICANT or pure < PURE or level < LEAST:
        return []
    size = float(np.sqrt(max(power[upper], power[lower])))
    severity: Severity = "excluded" if decibel(size / own) > EXCLUDING_DB else "down_weighted"
    detail = (
        f"lines at {lower * view.bin_hz:.2f} and {upper * view.bin_hz:.2f} Hz, "
        f"{decibel(size / own):.1f} dB re the run's own: modulated, biased by about "
        f"{bias(size, own):.1e}; look for a second oscillation or hum on the generator"
    )
    worst = worst_bias(size, own)
    return [finding(view.name, "quasi_periodic", severity, detail, error=worst)]


def another_oscillation(view: View, free: FreeLine | None) -> list[QualityFlag]:
    """A line far from a forced run's own, with combinations: another mode sings beside it."""
    if view.run.kind != "forced":
        return []
    spectrum = np.abs(view.spectrum[: len(view.inputs)])
    own = np.abs(view.coefficients[: len(view.inputs), :1])
    relative = np.max(spectrum / np.maximum(own, 1e-300), axis=0)
    searched = lines(view, free)
    found = [p for p in peaks(searched, 0) if p.purity > PURE and relative[p.bin] > LEAST_FAR]
    if not found:
        return []
    line = max(found, key=lambda p: float(relative[p.bin]))
    f = view.frequency_hz
    images = [abs(line.frequency_hz + m * f) for m in (-2, -1, 1, 2)]
    seen = [g for g in images if searched.at(g)[1] > SIGNIFICANT]
    if len(seen) < IMAGES:
        return []
    level = float(relative[line.bin])
    severity: Severity = "excluded" if decibel(level) > EXCLUDING_DB else "down_weighted"
    detail = (
        f"line at {line.frequency_hz:.2f} Hz, {decibel(level):.1f} dB re the run's own, with "
        f"combinations at {', '.join(f'{g:.1f}' for g in seen)} Hz: another mode sings beside the "
        "forcing; lower the drive or force elsewhere"
    )
    worst = worst_bias(level, 1.0)
    return [finding(view.name, "another_oscillation", severity, detail, error=worst)]


def _largest(ratio: FloatArray, at: npt.NDArray[np.int64]) -> FloatArray:
    return np.asarray(np.maximum(np.maximum(ratio[at - 1], ratio[at]), ratio[at + 1]))
