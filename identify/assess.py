"""One fitted model against the data: errors, adequacy, and its own free limit cycle.

Errors are relative, over the compared harmonics: √(Σ|Ŷ − Y|² / Σ|Y|²), Ŷ the model's own steady
state at the measured forcing. Adequacy is judged against noise: with variances estimated from a
finite number of neighbouring bins, the sum of squares is wider than χ², and is matched to a scaled
χ² by mean and variance (each |error|² over its estimated variance is F-distributed).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify import balance
from identify.chances import chi2_tail
from identify.dataset import Batch, Dataset
from identify.descent import levenberg_marquardt
from identify.fit import Fit
from identify.harmonics import VARIANCE_DOF
from identify.lockin import LockIn, boundary
from identify.residual import OrbitResidual, compare
from identify.results import Assessment, Comparison, LimitCycle
from identify.stability import Disturbed, leading_exponent, unstable_exponents
from identify.structure import Structure
from identify.whiteness import residual_tests

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


def noise_misfit(dof: int) -> float:
    """The weighted sum of squares that noise alone leaves on average."""
    return dof * VARIANCE_DOF / (VARIANCE_DOF - 2)


def lack_of_fit_p(sum_of_squares: float, dof: int) -> float:
    """Probability that noise alone leaves at least this weighted sum of squares."""
    if dof < 1:
        return float("nan")
    if not np.isfinite(sum_of_squares):
        return 0.0
    nu, mean = VARIANCE_DOF, noise_misfit(dof)
    variance = dof * nu**3 / ((nu - 2) ** 2 * (nu - 4))
    scale = variance / mean
    return chi2_tail(sum_of_squares / scale, mean**2 / variance)


@dataclass(frozen=True)
class Prediction:
    """A batch under a model: orbits and the whitened residuals (None where unsolved)."""

    batch: Batch
    orbits: balance.Orbits
    residual: FloatArray
    jacobian: FloatArray


def predict(structure: Structure, theta: FloatArray, batch: Batch) -> Prediction:
    """Steady states of a batch with derivatives, followed from the measurement."""
    batch = batch.balanced(structure)
    with np.errstate(all="ignore"):
        orbits = balance.solve(structure, theta, batch.at, derivatives=True)
        residual, jacobian = compare(batch, orbits)
    assert jacobian is not None
    return Prediction(batch, orbits, residual, jacobian)


def relative_error(predictions: Sequence[Prediction]) -> float:
    """√(Σ|Ŷ − Y|²/Σ|Y|²) over the compared harmonics of all runs; infinite where unsolved.

    Free runs are compared after both fundamentals are turned real.
    """
    error = power = 0.0
    for p in predictions:
        for row in comparisons([p]):
            error += float(np.sum(np.abs(row.predicted - row.measured) ** 2))
            power += float(np.sum(np.abs(row.measured) ** 2))
    return float(np.sqrt(error / power)) if power > 0 else float("nan")


def comparisons(
    predictions: Sequence[Prediction], role: str = "fit", covariance: FloatArray | None = None
) -> list[Comparison]:
    """Every compared coefficient of every run; `covariance` of the parameters gives each
    prediction its own standard error."""
    rows = []
    for p in predictions:
        b = p.batch
        spread = None if covariance is None else _prediction_stderr(p, covariance)
        K = b.compared
        k = np.arange(1, K + 1)
        for i, name in enumerate(b.names):
            measured, predicted = b.measured[i], p.orbits.velocity[i, :K]
            if b.free:
                measured = measured * np.exp(-1j * np.angle(measured[0]) * k)
                predicted = predicted * np.exp(-1j * np.angle(predicted[0]) * k)
            solved = bool(p.orbits.converged[i]) and bool(np.isfinite(predicted).all())
            rows.append(
                Comparison(
                    run=name,
                    kind="free" if b.free else ("cold" if b.cold[i] else "forced"),
                    role=role,
                    frequency_hz=float(b.at.omega[i] / (2 * np.pi)),
                    predicted_hz=float(p.orbits.omega[i] / (2 * np.pi)),
                    amplitude_v=float(np.abs(b.at.drive[i, 0])) if not b.free else None,
                    started_s=float(b.started_s[i]),
                    measured=measured,
                    predicted=predicted if solved else np.full(K, np.inf + 0j),
                    stderr=np.sqrt(b.noise[i]),
                    predicted_stderr=None if spread is None else spread[i],
                )
            )
    return rows


def _prediction_stderr(p: Prediction, covariance: FloatArray) -> FloatArray:
    """√E|δŶ|² of each predicted coefficient from the parameters' covariance, (runs, K)."""
    b = p.batch
    d = np.linalg.solve(b.whitener, p.jacobian.reshape(b.runs, 2 * b.compared, -1))
    variance = np.einsum("rip,pq,riq->ri", d, np.nan_to_num(covariance, posinf=1e12), d)
    both = variance.reshape(b.runs, 2, b.compared)
    if b.free:
        both[:, 1, 0] = 0.0  # the frequency's place
    return np.asarray(np.sqrt(np.maximum(both.sum(axis=1), 0.0)))


def held_out_misfit(predictions: Sequence[Prediction], covariance: FloatArray) -> tuple[float, int]:
    """χ² of runs never used, the parameters' own uncertainty included, and of how many residuals.

    Cov(ρ) = I + J Σ Jᵀ for whitened residuals ρ of new runs. With the χ² of the fitted runs it is
    what a fit to all of them would leave (recursive least squares), to first order.
    """
    total, count = 0.0, 0
    for p in predictions:
        count += p.residual.size
        if not np.isfinite(p.residual).all():
            return np.inf, count
        spread = p.jacobian @ np.nan_to_num(covariance, posinf=1e12) @ p.jacobian.T
        if not np.isfinite(spread).all():
            return np.inf, count
        # by eigenvalues: where the data leave a parameter open, the spread is beyond rounding
        size, axes = np.linalg.eigh(0.5 * (spread + spread.T))
        total += float(np.sum((axes.T @ p.residual) ** 2 / (1.0 + np.maximum(size, 0.0))))
    return total, count


def validation_p(predictions: Sequence[Prediction], covariance: FloatArray) -> float:
    """Lack-of-fit p-value on runs never used, the parameters' own uncertainty included; NaN where
    there are none."""
    return lack_of_fit_p(*held_out_misfit(predictions, covariance))


def assess(fit: Fit, data: Dataset) -> Assessment:
    """Errors, limit cycles and every coefficient of a fitted model, without its `lock_in`."""
    fitted = [predict(fit.structure, fit.theta, b) for b in data.fit]
    held_out = [predict(fit.structure, fit.theta, b) for b in data.validation]
    covariance = fit.covariance if fit.converged else None
    rows = comparisons(fitted, "fit", covariance)
    rows += comparisons(held_out, "validation", covariance)
    if data.validation:
        validation, floor = relative_error(held_out), data.noise_floor(data.validation)
    else:
        validation, floor = cross_validation_error(fit, data), data.noise_floor(data.fit)
    return Assessment(
        structure=fit.structure,
        fit=fit,
        fit_error=relative_error(fitted),
        validation_error=validation,
        noise_floor=floor,
        comparisons=tuple(rows),
        measured_cycle=_measured_cycle(data),
        model_cycle=_model_cycle(fit, data, fitted),
        cross_validated=not data.validation,
        residual_tests=residual_tests(fit, data),
        fit_p=lack_of_fit_p(fit.chi2, fit.dof),
    )


def lock_in(fitted: tuple[Fit, Dataset]) -> tuple[LockIn, ...]:
    """The model's lock-in boundary at every forced condition, by frequency; it takes seconds."""
    fit, data = fitted
    if not fit.converged:
        return ()
    found = [row for b in (*data.fit, *data.validation) for row in boundary(fit, b)]
    return tuple(sorted(found, key=lambda row: row.frequency_hz))


def cross_validation_error(fit: Fit, data: Dataset) -> float:
    """Relative error of each forced run predicted by a fit without it, one at a time."""
    error = power = 0.0
    for j, batch in enumerate(data.fit):
        if batch.free or batch.runs < 2:
            continue
        for i in range(batch.runs):
            rest = np.delete(np.arange(batch.runs), i)
            others = [b if n != j else batch.take(rest) for n, b in enumerate(data.fit)]
            (descent,) = levenberg_marquardt(
                OrbitResidual(fit.structure, others),
                fit.theta[None],
                iterations=20,
                bounds=fit.structure.parameters.bounds(),
            )
            theta = fit.theta if descent is None else descent.theta
            one = batch.take(np.array([i]))
            y = predict(fit.structure, theta, one).orbits.velocity[:, : batch.compared]
            error += float(np.sum(np.abs(y - one.measured) ** 2))
            power += float(np.sum(np.abs(one.measured) ** 2))
    return float(np.sqrt(error / power)) if power > 0 else float("nan")


def _measured_cycle(data: Dataset) -> LimitCycle | None:
    for b in (*data.fit, *data.validation):
        if b.free:
            y = np.abs(b.measured[0])
            size = np.sqrt(b.noise[0] / 2)  # of the noise along each coefficient
            ratio = y / y[0]
            spread = np.hypot(size, ratio * size[0]) / y[0]
            return LimitCycle(
                float(b.at.omega[0] / (2 * np.pi)),
                float(y[0]),
                tuple(float(q) for q in ratio),
                float(b.frequency_stderr_hz[0]),
                float(size[0]),
                harmonics_stderr=(0.0, *(float(q) for q in spread[1:])),
            )
    return None


def _model_cycle(fit: Fit, data: Dataset, fitted: Sequence[Prediction]) -> LimitCycle | None:
    """The model's own free limit cycle, from the free run's orbit, or searched for without one."""
    for p in fitted:
        if p.batch.free and p.orbits.converged[0]:
            orbits, batch = p.orbits, p.batch
            break
    else:
        free = _free_batch(data)
        if free is None:
            return None
        found = predict(fit.structure, fit.theta, free)
        orbits, batch = found.orbits, found.batch
        if not orbits.converged[0]:
            return None
    y = np.abs(orbits.velocity[0, : batch.compared])
    if not y[0] > 0 or not np.isfinite(y).all():
        return None
    assert orbits.d_omega is not None
    assert orbits.d_velocity is not None
    covariance = np.nan_to_num(fit.covariance, posinf=0.0)
    df = orbits.d_omega[0] / (2 * np.pi)
    # d|Y_k| and the ratios' derivatives, (K, p)
    turned = np.exp(-1j * np.angle(orbits.velocity[0, : batch.compared]))[:, None]
    da = (orbits.d_velocity[0, : batch.compared] * turned).real
    ratio = (y / y[0])[:, None]
    dr = (da - ratio * da[0]) / y[0]

    def stderr(slope: FloatArray) -> float:
        return float(np.sqrt(max(float(slope @ covariance @ slope), 0.0)))

    one = orbits.take(np.array([0]))
    values = fit.structure.parameters.plain(fit.theta)
    at = batch.at.take(np.array([0]))
    disturbed = Disturbed.around(fit.structure, values, at, one.omega, one.inputs)
    count = unstable_exponents(disturbed)
    lead = leading_exponent(disturbed, free=True)
    return LimitCycle(
        float(orbits.omega[0] / (2 * np.pi)),
        float(y[0]),
        tuple(float(q) for q in y / y[0]),
        stderr(df),
        stderr(da[0]),
        None if count is None else count == 0,
        tuple(stderr(row) for row in dr),
        None if lead is None else lead.real,
    )


def _free_batch(data: Dataset) -> Batch | None:
    """A stand-in for a free run that was not recorded: half the smallest forced velocity."""
    forced = next((b for b in data.fit if not b.free), None)
    if forced is None:
        return None
    i = int(np.argmin(np.abs(forced.measured[:, 0])))
    one = forced.take(np.array([i]))
    return one.as_free(2 * np.pi * data.free_hz)
