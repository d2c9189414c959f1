"""The noise of a velocity that is corrected for what its microphones do.

A sensor's effect is formed from the pressures as measured, so that the residual of a run holds
their noise as the correction passes it on: with the velocity Y and the mean pressure P as read,

    Y − Ŷ = (1 − ∂Ŷ/∂Y) n_Y − ∂Ŷ/∂P n_P      of each harmonic,

whose variance may be twice that of Y's own noise or half of it where two sensitivities differ by
much. The correlation of harmonics stays as recorded.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from identify.dataset import Batch, Dataset
from identify.effect import Conditions
from identify.fit import Fit, repeated
from identify.pieces import Values
from identify.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

NEGLIGIBLE = 0.03  # of a coefficient's variance
NUDGE = 1e-4  # of the largest harmonic: small to a microphone that bends


def refitted(fit: Fit, data: Dataset) -> tuple[Dataset, Fit]:
    """`data` with the noise of the velocity as `fit` corrects it, and `fit` repeated on them; the
    same objects where it is negligible, or where nothing comes of it."""
    return repeated(fit, data, with_corrected_noise(fit, data))


def with_corrected_noise(fit: Fit, data: Dataset) -> Dataset:
    """`data` with the correction in every covariance; the same object where it is negligible."""
    groups = (data.fit, data.validation)
    found = [[_variance(fit.structure, fit.values, b) for b in group] for group in groups]
    if all(np.max(np.abs(v - 1)) < NEGLIGIBLE for each in found for v in each):
        return data
    fitted, held_out = (
        tuple(_widened(b, v) for b, v in zip(group, each, strict=True))
        for group, each in zip(groups, found, strict=True)
    )
    return replace(data, fit=fitted, validation=held_out)


def growth(counted: Dataset, data: Dataset) -> float:
    """By how much ln det C of the fitted runs has grown from `data` to `counted`."""
    pairs = zip(counted.fit, data.fit, strict=True)
    return sum(float(2 * np.log(new.noise / old.noise).sum()) for new, old in pairs)


def _variance(structure: Structure, values: Values, batch: Batch) -> FloatArray:
    """Of each compared coefficient with the correction, over that without it, (runs, K)."""
    K = batch.compared
    if batch.pressure_noise is None or not structure.effects or not np.any(batch.at.pressure):
        return np.ones((batch.runs, K))
    at = replace(batch.at, free=np.zeros(batch.runs, dtype=bool))  # in the phase as recorded
    none = _read(structure, values, at)

    def slope(name: str) -> ComplexArray:
        x = getattr(at, name)
        nudge = NUDGE * np.max(np.abs(x))
        changed = replace(at, **{name: x + nudge})
        return np.asarray((_read(structure, values, changed) - none) / nudge)[:, :K]

    kept, leaked = 1.0 - slope("velocity"), -slope("pressure")
    found = np.abs(kept) ** 2 * batch.noise + np.abs(leaked) ** 2 * batch.pressure_noise[:, :K]
    if batch.shared_noise is not None:
        found += 2 * np.real(kept * leaked.conj() * batch.shared_noise[:, :K])
    found = found / batch.noise
    return np.where(np.isfinite(found) & (found > 0), found, 1.0)


def _read(structure: Structure, values: Values, at: Conditions) -> ComplexArray:
    """What the sensors' effects read where nothing moves."""
    y = np.zeros_like(at.velocity)
    for effect in structure.effects:
        y = effect.sensor(values, at, at.s, y)
    return np.asarray(y)


def _widened(batch: Batch, variance: FloatArray) -> Batch:
    size = np.sqrt(np.tile(variance, 2))
    if batch.free:
        size[:, batch.compared] = 1.0  # the frequency's place
    return replace(
        batch,
        covariance=batch.covariance * size[:, :, None] * size[:, None, :],
        whitener=batch.whitener / size[:, None, :],
        noise=batch.noise * variance,
    )
