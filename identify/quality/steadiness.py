"""Does a run stand still? The trend of amplitude and phase inside it, against its own noise.

The response, demodulated at the run's frequency, is averaged over BLOCKS stretches. Its mean over
the first half of the run, m₁ (that over the second being −m₁, the whole run's mean being fitted),
is what the first half spoils in the run's coefficient. Noise is taken from the slow part of what
the best of a few trends (a line, decays) leaves: its variance per bin of the stretches' DFT is
that of m₁, and coloured noise, as of a slowly flickering flame, counts for what it is.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify.quality.findings import Severity, finding
from identify.quality.spectrum import floor
from identify.quality.view import View
from identify.results import QualityFlag

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

BLOCKS = 64
SLOW = 6  # bins on either side that give the noise
DECAYS = (0.005, 0.015, 0.04, 0.1, 0.3, 1.0)  # time constants over the run's length
SIGMAS = 5.0  # chance 2e-6, the noise being known from eleven bins: (1 + 25/11)⁻¹¹
SIGMAS_FREE = 12.0  # its amplitude alone: Student's t of eleven degrees of freedom, 1e-7
SPOILT = 1e-3  # relative error of the coefficient beyond which a decaying run is excluded,
SPOILT_LINE = 1e-2  # a linearly drifting one: its mean is that of its middle
WORTH_NOTING = 2e-4


@dataclass(frozen=True)
class Trend:
    """`shift` is m₁ relative to the fundamental, `stderr` its standard error, `decay` the time
    constant over the run's length (None: a line), `sigmas` what makes it significant."""

    shift: complex
    stderr: float
    decay: float | None
    sigmas: float = SIGMAS

    @property
    def size(self) -> float:
        return abs(self.shift)

    @property
    def significant(self) -> bool:
        return bool(self.size > self.sigmas * self.stderr)


def envelope(view: View, rest: FloatArray, fundamental: complex) -> ComplexArray:
    """Relative deviation from the fundamental, (BLOCKS,) complex, of mean 0."""
    n = rest.size
    edges = np.linspace(0, n, BLOCKS + 1).astype(int)
    sums = np.add.reduceat(rest * view.rotor, edges[:-1])
    z = 2 * sums / np.diff(edges) / fundamental
    return np.asarray(z - z.mean())


def trend(z: ComplexArray) -> Trend:
    """The trend of an envelope (BLOCKS,), see the module."""
    n = z.size
    t = (np.arange(n) + 0.5) / n
    best: tuple[float, ComplexArray, float | None] | None = None
    for decay in (None, *DECAYS):
        # (of the stretches' means: a decay may be shorter than one)
        g = t - 0.5 if decay is None else np.exp(-t / decay) * 2 * decay * np.sinh(0.5 / decay / n)
        g = g - g.mean()
        left = z - g * (np.vdot(g, z) / np.vdot(g, g))
        power = float(np.sum(np.abs(left) ** 2))
        if best is None or power < best[0]:
            best = (power, left, decay)
    assert best is not None
    _, left, decay = best
    spectrum = np.abs(np.fft.fft(left) / z.size) ** 2
    slow = np.r_[spectrum[1 : SLOW + 1], spectrum[-SLOW:]]
    wide = np.r_[spectrum[1 : z.size // 3], spectrum[-z.size // 3 :]]
    # one complex amplitude was fitted, mostly to these bins
    variance = max(float(np.sum(slow)) / (2 * SLOW - 1), floor(wide))
    return Trend(complex(z[: z.size // 2].mean()), float(np.sqrt(variance)), decay)


def response_trend(view: View) -> Trend:
    rest = view.rest[: len(view.inputs)].mean(axis=0)
    c = complex(view.coefficients[: len(view.inputs), 0].mean())
    z = envelope(view, rest, c)
    # a free run's phase walks freely, and its frequency was fitted: only its amplitude tells
    if view.run.kind == "free":
        return replace(trend(z.real.astype(complex)), sigmas=SIGMAS_FREE)
    return trend(z)


def drive_trend(view: View) -> Trend:
    c = complex(view.coefficients[-1, 0])
    return trend(envelope(view, view.rest[-1], c))


def velocity_stderr(view: View) -> float:
    """Relative standard error of the velocity's fundamental, from the spectrum beside it.

    The window's equivalent noise bandwidth is two bins, the coefficient's one.
    """
    weights = np.array([1.0]) if len(view.inputs) == 1 else np.array([-1.0, 1.0])
    c = abs(weights @ view.coefficients[: len(view.inputs), 0])
    b = round(view.frequency_hz / view.bin_hz)
    beside = np.r_[max(b - 25, 1) : max(b - 5, 2), b + 5 : b + 25]
    beside = beside[beside < view.spectrum.shape[1]]
    noise = floor(np.abs(weights @ view.spectrum[:, beside]) ** 2) / 2
    return float(np.sqrt(noise)) / max(float(c), 1e-300)


def steadiness(view: View) -> list[QualityFlag]:
    """`unsettled` (decaying) or `drift_inside_run` (linear), of the response or the drive."""
    driven = view.run.kind != "free"
    response = response_trend(view)
    drive = drive_trend(view) if driven else None
    if drive is not None and drive.significant and drive.size > WORTH_NOTING:
        return [_flag(view, drive, "the drive's", "look at the generator and its amplifier")]
    harm = velocity_stderr(view)
    if not driven and response.size > SPOILT_LINE:
        harm = 0.0  # whatever the noise: what dies away is the ringing of a rig that is quiet
    if not response.significant or response.size < max(WORTH_NOTING, harm):
        return []
    return [_flag(view, response, "the response's", "wait longer before recording")]


def _flag(view: View, found: Trend, whose: str, remedy: str) -> QualityFlag:
    line = found.decay is None
    limit = SPOILT_LINE if line else SPOILT
    severity: Severity = "excluded" if found.size > limit else "down_weighted"
    amplitude, phase = -2 * found.shift.real, -2 * found.shift.imag
    shape = "steadily" if line else f"with a time constant of {_seconds(view, found):.2g} s"
    detail = (
        f"{whose} amplitude changes by {amplitude:+.1e} and its phase by {phase:+.1e} rad from the "
        f"first half to the second, {shape} ({found.size / found.stderr:.0f} standard errors); "
        f"shifts the coefficient by {found.size:.1e}: {remedy}"
    )
    if line:  # its mean is that of its middle
        return finding(view.name, "drift_inside_run", severity, detail)
    return finding(view.name, "unsettled", severity, detail, error=found.size)


def _seconds(view: View, found: Trend) -> float:
    return (found.decay or 0.0) * view.run.duration_s
