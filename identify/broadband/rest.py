"""What a fitted model leaves: is it noise, and how much more than noise is it?

Three ways to know the noise, the best one that the record allows:

- a weakly excited stretch, named by the experimenter: its residual is noise;
- whole periods of one excitation that come back: what differs between them is noise;
- neither: the noise is unknown, but noise does not follow the motion. A generic regression of the
  residual on products of the simulated y, y′ and u, each also passed through the resonance, is
  tried on stretches that it was not fitted to (cross-validation). What it predicts there is no
  noise; what it does not predict is taken for noise only where it is as large all the time.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement, pairwise

import numpy as np
import numpy.typing as npt
from scipy import special
from scipy.signal import welch

from identify.broadband.fit import Fit
from identify.broadband.lines import Lines
from identify.broadband.model import Excitation
from identify.chances import f_tail

FloatArray = npt.NDArray[np.float64]

SIGNIFICANT = 1e-3
ALIKE = 0.02  # relative difference below which two periods of the input are one excitation
BANDS = 16
UNPREDICTED = "residual that the motion does not predict"  # a source of noise, for want of better
FOLDS = 20  # stretches of the cross-validation
LAGS = 24  # samples of the past of u that the regression may use
DEGREE = 3  # of the products of y, y′ and u


@dataclass(frozen=True)
class Noise:
    """What is known of the noise: samples of it (samples,), and where they come from."""

    samples: FloatArray
    source: str

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean((self.samples - self.samples.mean()) ** 2)))


@dataclass(frozen=True)
class Remainder:
    """A residual against noise: RMS of both, worst band, and the corrected p of that band.

    Where the noise is unknown, `follows` is the share of the residual's power that the motion
    predicts, and p that of noise being so well predicted or so uneven.
    """

    rms: float
    noise_rms: float | None = None
    noise_source: str | None = None
    chi2_per_dof: float | None = None
    p_value: float | None = None
    worst_band_hz: tuple[float, float] | None = None
    follows: float | None = None

    @property
    def significant(self) -> bool:
        return self.p_value is not None and self.p_value < SIGNIFICANT

    def excess(self) -> float:
        """Mean square beyond the noise; all of it where the noise is unknown."""
        return max(self.rms**2 - (self.noise_rms or 0.0) ** 2, 0.0)


def noise_of(fitted: Fit, u: FloatArray, lines: Lines | None, quiet: slice | None) -> Noise | None:
    """Noise samples from the named stretch, else from periods that come back; None if neither."""
    if quiet is not None:
        return Noise(fitted.residual[quiet], "weakly excited stretch")
    if lines is None:
        return None
    differences = lines.differences(fitted.residual, u, ALIKE)
    return Noise(differences, "repeated periods") if differences.size else None


def remainder(record: Excitation, fitted: Fit, estimation: slice, noise: Noise | None) -> Remainder:
    """The residual of `fitted` on the estimation samples, judged."""
    residual = fitted.residual[estimation]
    rms = float(np.sqrt(np.mean(residual**2)))
    if noise is None:
        share, p = follows_motion(record, fitted, estimation)
        uneven, _ = unevenness(residual, record.y[estimation], record.sample_rate_hz)
        return Remainder(rms, p_value=min(1.0, 2 * min(p, uneven)), follows=share)
    ratio, p, band = _against(residual, noise.samples, record.sample_rate_hz)
    return Remainder(rms, noise.rms, noise.source, ratio, p, band)


def _against(
    residual: FloatArray, quiet: FloatArray, rate: float
) -> tuple[float, float, tuple[float, float]]:
    """Residual power over noise power in bands: mean ratio, p of the worst, and that band.

    F statistics, Bonferroni-corrected. A band of Welch's spectrum with B bins from M
    half-overlapping Hann segments has about 2·B·M·0.65/1.5 degrees of freedom (neighbouring bins
    of a Hann window share half their power).
    """
    segment = int(2 ** np.floor(np.log2(quiet.size / 6)))
    f, power = welch(residual, rate, nperseg=segment, detrend="constant")
    _, floor = welch(quiet, rate, nperseg=segment, detrend="constant")
    edges = np.linspace(1, f.size - 1, BANDS + 1).astype(int)
    ratios, ps = [], []
    for low, high in pairwise(edges.tolist()):
        ratio = float(power[low:high].sum() / max(floor[low:high].sum(), 1e-300))
        dof = [
            max(2.0, 2 * (high - low) * (2 * x.size / segment - 1) * 0.65 / 1.5)
            for x in (residual, quiet)
        ]
        ratios.append(ratio)
        ps.append(f_tail(ratio, *dof))
    worst = int(np.argmin(ps))
    band = (float(f[edges[worst]]), float(f[edges[worst + 1]]))
    return float(np.mean(ratios)), min(1.0, min(ps) * len(ps)), band


def stretches(samples: int) -> list[slice]:
    """The stretches in which a residual is looked at."""
    edges = np.linspace(0, samples, FOLDS + 1).astype(int)
    return [slice(a, b) for a, b in pairwise(edges.tolist())]


def unevenness(residual: FloatArray, motion: FloatArray, rate: float) -> tuple[float, int]:
    """How probable it is that noise of one power, or of one share of the `motion`, is so uneven
    over the stretches, and where it is largest.

    Each stretch's power against the median one: an F statistic with as many degrees of freedom as
    the residual's bandwidth allows, 2·B·T with B = (∫S)²/∫S²; Bonferroni-corrected.
    """
    parts = stretches(residual.size)
    power = np.array([np.mean(residual[p] ** 2) for p in parts])
    moved = np.array([np.mean(motion[p] ** 2) for p in parts])
    f, density = welch(residual, rate, nperseg=min(1024, residual.size // 8))
    width = float(density.sum() ** 2 / max(float(np.sum(density**2)), 1e-300)) * float(f[1])
    dof = max(2.0, 2 * width * residual.size / FOLDS / rate)
    chances = []
    for size in (power, power / np.maximum(moved, 1e-300)):
        ratio = float(size.max() / max(float(np.median(size)), 1e-300))
        chances.append(FOLDS * f_tail(ratio, dof, dof * FOLDS / 2))
    return min(1.0, max(chances)), int(np.argmax(power))


def follows_motion(record: Excitation, fitted: Fit, where: slice) -> tuple[float, float]:
    """Share of the residual's power that products of the motion predict where they were not
    fitted, and how probable so much is by luck: of the whole record and of each half, in which a
    loop that changes once is one loop; the likeliest of the three to be no luck.

    Noise that the motion does not know is not predicted, whatever its colour: a stretch then loses.
    """
    residual = fitted.residual[where]
    columns = _motion(record, fitted)[where]
    columns = columns - columns.mean(axis=0)
    columns /= np.linalg.norm(columns, axis=0) + 1e-300
    middle = residual.size // 2
    parts = (slice(0, residual.size), slice(0, middle), slice(middle, residual.size))
    found = [_predicted(residual[p], columns[p]) for p in parts]
    share, p_value = min(found, key=lambda item: (item[1], -item[0]))
    return share, min(1.0, len(parts) * p_value)


def _predicted(residual: FloatArray, columns: FloatArray) -> tuple[float, float]:
    """Share of the power of `residual` (samples,) that a regression on `columns` (samples, n)
    predicts where it was not fitted: the median over stretches; and the sign test's p."""
    parts = stretches(residual.size)
    normal = [columns[p].T @ columns[p] for p in parts]
    right = [columns[p].T @ residual[p] for p in parts]
    together, total = np.sum(normal, axis=0), np.sum(right, axis=0)
    ridge = 1e-6 * np.eye(columns.shape[1])
    gains = []
    for part, own, mine in zip(parts, normal, right, strict=True):
        weights = np.linalg.solve(together - own + ridge, total - mine)
        rest = residual[part] - columns[part] @ weights
        gains.append(1 - float(rest @ rest) / max(float(residual[part] @ residual[part]), 1e-300))
    better = sum(gain > 0 for gain in gains)
    return max(float(np.median(gains)), 0.0), float(special.bdtrc(better - 1, FOLDS, 0.5))


def _motion(record: Excitation, fitted: Fit) -> FloatArray:
    """Regressors (samples, n): products of y, y′ and u up to `DEGREE`, plain and as forces on the
    fitted resonance (what it answers, and how fast), and the past of u."""
    f = np.fft.rfftfreq(record.samples, 1 / record.sample_rate_hz)
    value = fitted.parameters(record)
    hz = float(value["mode1.frequency_hz"]["value"])
    zeta = min(abs(float(value["mode1.damping"]["value"])), 1.0)
    s = np.asarray(1j * f / hz, dtype=np.complex128)
    answer = np.asarray(1 / (s * s + 2 * zeta * s + 1), dtype=np.complex128)

    def unit(x: FloatArray) -> FloatArray:
        return np.asarray(x / max(float(x.std()), 1e-300))

    def passed(x: FloatArray, through: npt.NDArray[np.complex128]) -> FloatArray:
        return np.asarray(np.fft.irfft(np.fft.rfft(x) * through, record.samples))

    y = unit(fitted.prediction)
    speed = unit(passed(y, s))
    u = unit(record.u)
    base = [y, speed, u]
    forces = [
        np.prod([base[i] for i in which], axis=0)
        for degree in range(1, DEGREE + 1)
        for which in combinations_with_replacement(range(3), degree)
    ]
    forces += [np.abs(y), np.abs(speed), np.tanh(5 * speed), np.abs(y) * y, np.abs(speed) * speed]
    answers = [passed(x, answer) for x in forces]
    speeds = [passed(x, s * answer) for x in forces]
    past = [np.roll(u, lag) for lag in range(1, LAGS + 1)]
    return np.stack([*forces, *answers, *speeds, *past], axis=1)
