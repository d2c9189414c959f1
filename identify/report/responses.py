"""Transfer functions, characteristic and poles of a fitted loop, each with its uncertainty.

The fitted parameters' covariance is carried through by exact derivatives: the structure's
equations are assembled with Duals at any frequency, amplitude or pole, so that a band needs no
formula of its own. For a value G(θ), complex as (Re, Im):  Cov = J Σ Jᵀ,  J = ∂(Re, Im)/∂θ. A
pole λ solves 1 − N′ L(λ) = 0, so that ∂λ/∂θ = −(∂/∂θ)/(∂/∂s) of the left side.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.dual import Dual
from identify.effect import Conditions
from identify.fit import Fit
from identify.results import Assessment
from identify.statespace import linear_poles, standing_still
from identify.structure import Loop

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

SAMPLES = 64  # a period of the describing function: exact for polynomials below degree 63


@dataclass(frozen=True)
class Response:
    """Complex values (F,) with the covariance (F, 2, 2) of their real and imaginary parts."""

    value: ComplexArray
    covariance: FloatArray

    @property
    def log_magnitude_stderr(self) -> FloatArray:
        """Standard error of ln |G|."""
        return self._along(self.value / np.abs(self.value) ** 2)

    @property
    def phase_stderr(self) -> FloatArray:
        """Standard error of the phase, rad."""
        return self._along(1j * self.value / np.abs(self.value) ** 2)

    def _along(self, direction: ComplexArray) -> FloatArray:
        d = np.stack([direction.real, direction.imag], axis=-1)
        variance = np.einsum("fi,fij,fj->f", d, self.covariance, d)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


@dataclass(frozen=True)
class Curve:
    """A real function of x, (N,), with its standard error."""

    x: FloatArray
    y: FloatArray
    stderr: FloatArray


@dataclass(frozen=True)
class Responses:
    """Frequency responses (F,): drive and flame output to velocity, flame path, open loop."""

    frequency_hz: FloatArray
    from_drive: Response
    from_flame: Response
    flame: Response
    loop: Response


def responses(fit: Fit, frequency_hz: FloatArray) -> Responses:
    """Frequency responses at the velocity of the flame, the loop with N′(0) in it."""
    s = np.asarray(2j * np.pi * frequency_hz[:, None], dtype=complex)
    loop, at = _seeded(fit, s)
    slope = _slope(loop, frequency_hz.size)
    from_flame = loop.P[0][0] / loop.H
    from_drive = loop.Q[0] / loop.H / at.drive
    parts = (from_drive, from_flame, loop.H, loop.P[0][0] * slope)
    return Responses(frequency_hz, *(_response(fit, x, frequency_hz.size) for x in parts))


def characteristic(fit: Fit, w: FloatArray) -> Curve:
    """N(w) with its standard error."""
    loop, _ = _seeded(fit, np.array([[1j]]))
    return _curve(fit, w, loop.N[0](w[None]), (1, w.size), lambda x: x[0])


def describing_function(fit: Fit, amplitude: FloatArray) -> Curve:
    """Gain of the characteristic to the fundamental of a cos τ, in phase, at amplitudes a > 0."""
    tau = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
    loop, _ = _seeded(fit, np.full((amplitude.size, 1), 1j))
    wave = amplitude[:, None] * np.cos(tau)
    share = 2.0 / SAMPLES * np.cos(tau)

    def gain(x: FloatArray) -> FloatArray:
        return np.asarray(np.tensordot(x, share, axes=([1], [0])).T / amplitude).T

    return _curve(fit, amplitude, loop.N[0](wave), wave.shape, gain)


@dataclass(frozen=True)
class Poles:
    """Closed-loop poles (n,) in rad/s with the covariance (n, 2, 2) of their parts."""

    value: ComplexArray
    covariance: FloatArray

    @property
    def frequency_hz(self) -> FloatArray:
        """|λ|/2π."""
        return np.asarray(np.abs(self.value) / (2 * np.pi))

    @property
    def damping(self) -> FloatArray:
        """−Re λ/|λ|."""
        return np.asarray(-self.value.real / np.abs(self.value))


def closed_loop_poles(fit: Fit, gain: float | None = None) -> Poles:
    """Poles of the loop with the nonlinearity replaced by a gain, those with Im λ ≥ 0.

    `gain` None is N′(0): the growth of small oscillations. With the describing function at the
    limit cycle's amplitude, one pair lies on the imaginary axis.
    """
    found: list[complex] = []
    for pole in _polished(fit, linear_poles(fit.structure, fit.values, gain), gain):
        if all(abs(pole - q) > 1e-6 * abs(q) for q in found):
            found.append(complex(pole))
    found.sort(key=abs)
    value = np.array(found, dtype=complex)
    if not found:
        return Poles(value, np.zeros((0, 2, 2)))
    _, by_theta, by_s = _characteristic_equation(fit, value, gain)
    return Poles(value, _covariance(fit, -by_theta / by_s[:, None]))


def limit_cycle_input(a: Assessment) -> float | None:
    """Amplitude of the flame's input w (m) on the model's own free limit cycle."""
    cycle = a.model_cycle
    if cycle is None:
        return None
    H = responses(a.fit, np.array([cycle.frequency_hz])).flame.value[0]
    return float(abs(H)) * cycle.amplitude


def largest_input(a: Assessment) -> float:
    """Largest amplitude of the flame's input that the measured fundamentals reach (m)."""
    rows = [c for c in a.comparisons if c.kind != "cold"]
    f = np.array([c.frequency_hz for c in rows])
    y = np.array([abs(c.measured[0]) for c in rows])
    return float(np.max(np.abs(responses(a.fit, f).flame.value) * y))


def _seeded(fit: Fit, s: ComplexArray) -> tuple[Loop, Conditions]:
    at = _at(s)
    values = fit.structure.parameters.seeded(fit.theta[None], s.shape[0])
    # the acoustics are asked for: a distortion of the drive stands before them
    return fit.structure.undistorted.assemble(values, at, s), at


def _at(s: ComplexArray) -> Conditions:
    still = standing_still(s.shape[0])
    return replace(still, omega=s[:, 0].imag, drive=np.ones(s.shape, dtype=complex))


def _slope(loop: Loop, rows: int) -> Any:
    """N′(0) with its derivatives, from N(h)/h at a small h: exact to the size of c₂ h."""
    h = 1e-12
    return (loop.N[0](np.full((rows, 1), h)) - loop.N[0](np.full((rows, 1), -h))) * (0.5 / h)


def _response(fit: Fit, x: Any, rows: int) -> Response:
    value = np.broadcast_to(dual.value(x), (rows, 1))[:, 0]
    slopes = dual.derivative(x, (rows, 1), fit.theta.size)[:, 0]
    return Response(np.asarray(value, dtype=complex), _covariance(fit, slopes))


def _covariance(fit: Fit, slopes: ComplexArray) -> FloatArray:
    """(F, 2, 2) from complex derivatives (F, p)."""
    J = np.stack([slopes.real, slopes.imag], axis=1)
    return np.asarray(J @ fit.covariance @ np.swapaxes(J, 1, 2))


def _curve(fit: Fit, x: FloatArray, y: Any, shape: tuple[int, ...], reduce: Any) -> Curve:
    value = reduce(np.broadcast_to(dual.value(y), shape))
    J = reduce(np.asarray(dual.derivative(y, shape, fit.theta.size)))
    variance = np.einsum("np,pq,nq->n", J, fit.covariance, J)
    return Curve(x, value, np.sqrt(np.maximum(variance, 0.0)))


def _characteristic_equation(
    fit: Fit, s: ComplexArray, gain: float | None
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """1 − N′ L(s) at points (n,), its derivatives (n, p) by θ and (n,) by s."""
    p, n = fit.theta.size, s.size
    values = fit.structure.parameters.seeded(fit.theta[None], n, extra=1)
    d = np.zeros((n, 1, p + 1), dtype=complex)
    d[..., p] = 1.0
    loop = fit.structure.assemble(values, _at(s[:, None]), Dual(s[:, None], d))
    f = loop.P[0][0] * (_slope(loop, n) if gain is None else gain)
    slopes = -dual.derivative(f, (n, 1), p + 1)[:, 0]
    value = np.asarray(1.0 - dual.value(f)[:, 0], dtype=complex)
    return value, np.asarray(slopes[:, :p]), np.asarray(slopes[:, p])


def _polished(fit: Fit, starts: ComplexArray, gain: float | None) -> ComplexArray:
    """Newton from the poles of the finite state space; those that lead far away are dropped."""
    pole = starts.copy()
    if not pole.size:
        return pole
    step = np.full(pole.shape, np.inf, dtype=complex)
    with np.errstate(all="ignore"):
        for _ in range(20):
            value, _, by_s = _characteristic_equation(fit, pole, gain)
            step = value / by_s
            pole = pole - step
            if np.all((np.abs(step) < 1e-12 * np.abs(pole)) | ~np.isfinite(pole)):
                break
        settled = (np.abs(step) < 1e-9 * np.abs(pole)) & (np.abs(pole - starts) < 0.2 * abs(starts))
    return np.asarray(pole[settled & (pole.imag > -1e-9 * np.abs(pole))], dtype=complex)
