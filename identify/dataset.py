"""Measured harmonics of a whole campaign in the form that a fit needs: batches and whiteners.

Runs are split by role (fit, validation) and by kind: forced and cold runs have a given frequency,
free runs an unknown one and a free phase. Each run's measured coefficients become real residuals

    ρ = W (measurement − prediction),      Wᵀ W = C⁻¹,

C being the noise covariance of its coefficients. A free run is compared after turning both sides
so that the fundamental is real: the phase is no information; the frequency takes its place.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify.effect import Conditions, Effect
from identify.harmonics import Harmonics, Microphones
from identify.record import Medium
from identify.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

EXTRA_HARMONICS = 6  # balanced beyond those compared, so that truncation stays below the noise …
CORNERS_HARMONICS = 20  # … and of a structure with corners, whose harmonics fall off slowly


@dataclass(frozen=True)
class Batch:
    """Runs of like kind with all that their residuals need.

    `measured` (runs, K) complex at the compared harmonics, `whitener` (runs, m, m) with m = 2K;
    `names` and `rows` identify the runs within the campaign; `noise` (runs, K) is E|n|².
    """

    names: tuple[str, ...]
    at: Conditions
    measured: ComplexArray
    covariance: FloatArray
    whitener: FloatArray
    noise: FloatArray
    frequency_stderr_hz: FloatArray
    cold: npt.NDArray[np.bool_]
    started_s: FloatArray
    drive_noise: FloatArray | None = None  # E|n|² of each run's drive coefficients, (runs,)
    pressure_noise: FloatArray | None = None  # of the pressure's at the harmonics balanced
    shared_noise: ComplexArray | None = None  # E[n n_P*] with that, likewise

    @property
    def runs(self) -> int:
        return len(self.names)

    @property
    def free(self) -> bool:
        """Whether these are free runs; like kind means all or none."""
        return bool(self.at.free.all())

    @property
    def compared(self) -> int:
        """Number of harmonics compared."""
        return int(self.measured.shape[1])

    def take(self, rows: npt.NDArray[np.int64]) -> "Batch":
        arrays = (
            "measured",
            "covariance",
            "whitener",
            "noise",
            "frequency_stderr_hz",
            "cold",
            "started_s",
        )
        picked = {n: getattr(self, n)[rows] for n in arrays}
        for n in ("drive_noise", "pressure_noise", "shared_noise"):
            if getattr(self, n) is not None:
                picked[n] = getattr(self, n)[rows]
        names = tuple(self.names[int(i)] for i in rows)
        return replace(self, names=names, at=self.at.take(rows), **picked)

    def limited(self, compared: int, balanced: int) -> "Batch":
        """The first `compared` harmonics compared, the first `balanced` solved for."""
        K, total = min(compared, self.compared), min(balanced, self.at.harmonics)
        keep = np.r_[0:K, self.compared : self.compared + K]
        covariance = self.covariance[:, keep][:, :, keep]
        names = ("drive", "pressure", "velocity")
        at = replace(self.at, **{n: getattr(self.at, n)[:, :total] for n in names})
        return replace(
            self,
            at=at,
            measured=self.measured[:, :K],
            noise=self.noise[:, :K],
            covariance=covariance,
            whitener=np.stack([whitener(c) for c in covariance]),
            pressure_noise=None if self.pressure_noise is None else self.pressure_noise[:, :total],
            shared_noise=None if self.shared_noise is None else self.shared_noise[:, :total],
        )

    def balanced(self, structure: Structure) -> "Batch":
        """The same with as many harmonics as the structure needs to be solved for."""
        if not structure.cornered:
            return self
        return replace(self, at=self.at.padded(self.compared + CORNERS_HARMONICS))

    def tile(self, times: int) -> "Batch":
        """All runs repeated `times` times, for as many parameter vectors at once."""
        return self.take(np.tile(np.arange(self.runs), times)) if times > 1 else self

    def as_free(self, omega: float) -> "Batch":
        """The same runs posed as free ones near `omega`: no drive, the phase unknown."""
        at = replace(
            self.at,
            free=np.ones(self.runs, dtype=bool),
            omega=np.full(self.runs, omega),
            drive=np.zeros_like(self.at.drive),
        )
        return replace(self, at=at)


@dataclass(frozen=True)
class Dataset:
    """The batches to fit on and to validate on. Free runs may be absent."""

    fit: tuple[Batch, ...]
    validation: tuple[Batch, ...]
    free_hz: float

    @property
    def residuals(self) -> int:
        return sum(2 * b.compared * b.runs for b in self.fit)

    def among(self, effects: Sequence[Effect]) -> tuple[Effect, ...]:
        """The effects for these runs."""
        fitted = [float(t) for b in self.fit for t in b.at.time]
        held_out = [float(t) for b in self.validation for t in b.at.time]
        return tuple(e.among(fitted, held_out) for e in effects)

    @property
    def span_s(self) -> float:
        """Seconds from the campaign's start to that of its last run."""
        return max(float(b.started_s.max()) for b in (*self.fit, *self.validation))

    def coarse(self, solved: int = 6) -> "Dataset":
        """For searching from afar: three harmonics compared, so many `solved` for."""
        return replace(self, fit=tuple(b.limited(3, solved) for b in self.fit))

    def noise_floor(self, which: Sequence[Batch]) -> float:
        """The validation error that noise alone would cause."""
        noise = sum(float(b.noise.sum()) for b in which)
        power = sum(float((np.abs(b.measured) ** 2).sum()) for b in which)
        return float(np.sqrt(noise / power)) if power > 0 else float("nan")


def compared_harmonics(measured: Sequence[Harmonics], most: int = 6, least: int = 3) -> int:
    """How many harmonics to compare: those whose median signal is five times the noise.

    One number for the whole campaign: a choice coefficient by coefficient would select on the
    noise itself and bias χ².
    """
    forced = [h for h in measured if h.kind == "forced"] or list(measured)
    available = min(h.count for h in forced)
    chosen = 0
    for k in range(min(most, available)):
        ratio = np.median([np.abs(h.velocity[k]) / np.sqrt(h.variance[k] + 1e-300) for h in forced])
        if ratio < 5:
            break
        chosen = k + 1
    return max(min(least, available), chosen)


def build(
    measured: Sequence[Harmonics],
    medium: Medium,
    mics: Microphones | None,
    compared: int | None = None,
) -> Dataset:
    """Batches of a campaign from its measured harmonics."""
    if not any(h.kind == "forced" and h.role == "fit" for h in measured):
        raise ValueError(
            "no forced run with role 'fit' in the campaign; at least one is required to identify"
        )
    count = compared_harmonics(measured) if compared is None else compared
    span = max((h.started_s for h in measured), default=0.0)
    parts: dict[tuple[str, bool], list[tuple[int, Harmonics]]] = {}
    for i, h in enumerate(measured):
        parts.setdefault((h.role, h.kind == "free"), []).append((i, h))
    batches = {key: _batch(rows, key[1], count, span, medium, mics) for key, rows in parts.items()}
    free = [h.frequency_hz for h in measured if h.kind == "free"]
    forced = [h.frequency_hz for h in measured if h.kind == "forced"]
    return Dataset(
        tuple(batches[k] for k in (("fit", False), ("fit", True)) if k in batches),
        tuple(batches[k] for k in (("validation", False), ("validation", True)) if k in batches),
        float(np.mean(free)) if free else float(np.median(forced)),
    )


def _batch(
    rows: Sequence[tuple[int, Harmonics]],
    free: bool,
    count: int,
    span: float,
    medium: Medium,
    mics: Microphones | None,
) -> Batch:
    hs = [h for _, h in rows]
    available = min(h.count for h in hs)
    count = min(count, available)
    K = count + EXTRA_HARMONICS

    def pad(values: Sequence[ComplexArray | FloatArray]) -> ComplexArray:
        out = np.zeros((len(values), K), dtype=complex)
        for row, v in zip(out, values, strict=True):
            row[: min(K, v.size)] = v[:K]
        return out

    at = Conditions(
        omega=2 * np.pi * np.array([h.frequency_hz for h in hs]),
        drive=pad([h.drive for h in hs]),
        pressure=pad([h.pressure for h in hs]),
        velocity=pad([h.velocity[:count] for h in hs]),
        time=np.array([h.started_s / span if span > 0 else 0.0 for h in hs]),
        flame_on=np.array([0.0 if h.kind == "cold" else 1.0 for h in hs]),
        identity=np.array([i for i, _ in rows], dtype=np.int64),
        free=np.full(len(hs), free),
        spacing_m=np.full(len(hs), np.nan if mics is None else mics.spacing_m),
        density_kg_m3=medium.density_kg_m3,
        sound_speed_m_s=medium.sound_speed_m_s,
    )
    if mics is not None:
        at = replace(at, centre_m=mics.centre_m)
    limited = [h.limited(count) for h in hs]
    measured = np.stack([h.velocity for h in limited])
    covariance = np.stack([h.covariance for h in limited])
    stderr = np.array([h.frequency_stderr_hz for h in hs])
    if free:
        covariance = np.stack(
            [free_covariance(c, y, s) for c, y, s in zip(covariance, measured, stderr, strict=True)]
        )
    return Batch(
        names=tuple(h.name for h in hs),
        at=at,
        measured=measured,
        covariance=covariance,
        whitener=np.stack([whitener(c) for c in covariance]),
        noise=np.stack([h.variance for h in limited]),
        frequency_stderr_hz=stderr,
        cold=np.array([h.kind == "cold" for h in hs]),
        started_s=np.array([h.started_s for h in hs]),
        drive_noise=np.array([h.drive_variance for h in hs]),
        pressure_noise=pad([h.pressure_noise for h in hs]).real,
        shared_noise=pad([h.shared_noise for h in hs]),
    )


def free_covariance(covariance: FloatArray, y: ComplexArray, f_stderr: float) -> FloatArray:
    """Covariance of a free run's residual: [Re Y_1…K, (f), Im Y_2…K] after turning Y_1 real.

    With n the noise of the coefficients, turning by the fundamental's phase error Im n_1/|Y_1|
    adds −jk Y_k Im n_1/|Y_1| to harmonic k; Im Y_1 becomes 0 and its place is the frequency's.
    """
    K = y.size
    T = np.eye(2 * K)
    k = np.arange(1, K + 1)
    added = -1j * k * y / np.abs(y[0])
    T[:K, K] += added.real
    T[K:, K] += added.imag
    out = T @ covariance @ T.T
    out[K, :] = out[:, K] = 0.0
    out[K, K] = f_stderr**2
    return np.asarray(out)


def whitener(covariance: FloatArray) -> FloatArray:
    """W with Wᵀ W = C⁻¹: the inverse Cholesky factor."""
    scale = np.sqrt(np.diag(covariance)) + 1e-300
    correlation = covariance / np.outer(scale, scale)
    factor = np.linalg.cholesky(correlation + 1e-12 * np.eye(scale.size))
    return np.asarray(np.linalg.inv(factor) / scale)
