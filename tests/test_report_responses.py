"""Transfer functions, characteristic and poles of a fitted loop, and their bands."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from identify.effects import by_key
from identify.fit import Fit
from identify.report.responses import (
    characteristic,
    closed_loop_poles,
    describing_function,
    largest_input,
    limit_cycle_input,
    responses,
)
from identify.structure import Structure
from tests import report_material as material

F = np.array([60.0, 168.0, 169.5, 281.0, 505.0])


def as_fit(structure: Structure, theta: npt.NDArray[np.float64], scale: float = 1e-6) -> Fit:
    """A fit with the given values and a correlated covariance of that size."""
    p = theta.size
    rng = np.random.default_rng(1)
    root = scale * (np.eye(p) + 0.3 * rng.standard_normal((p, p)))
    nothing = np.zeros((0, p))
    return Fit(
        structure, theta, 0.0, 1, root @ root.T, nothing[:, 0], nothing, True, "converged", 0
    )


def thesis_tube() -> Fit:
    """The thesis's tube: r_i = k_f 22.5 ψ_i(xf) D_i, a_i = ψ_i(xa) D_i (physics.md §1)."""
    structure = Structure()
    psi_flame, D, psi_speaker = (-0.41, -0.24), (-0.16, 0.10), (-0.22, -0.34)
    values = {"flame.pole_hz": 100.0, "nonlinearity.c2": 0.0, "nonlinearity.c3": -1e-12}
    for i, (f, zeta) in enumerate(((168.79, 0.010), (281.33, 0.050))):
        values[f"mode{i + 1}.frequency_hz"] = f
        values[f"mode{i + 1}.damping"] = zeta
        values[f"mode{i + 1}.flame_residue"] = 30 * 22.5 * psi_flame[i] * D[i]
        values[f"mode{i + 1}.speaker_residue"] = psi_speaker[i] * D[i]
    return as_fit(structure, structure.parameters.unknowns(values))


def test_poles_of_the_thesis_tube() -> None:
    """physics.md §1: 170.3145 Hz/−0.005609, 280.948 Hz/0.05422, a real pole at −98.485 Hz.

    Tolerances: half of the last digit given there.
    """
    poles = closed_loop_poles(thesis_tube())
    order = np.argsort(poles.frequency_hz)
    f, zeta = poles.frequency_hz[order], poles.damping[order]
    assert f == pytest.approx([98.485, 170.3145, 280.948], abs=5e-4)
    assert zeta[1] == pytest.approx(-0.005609, abs=5e-7)
    assert zeta[2] == pytest.approx(0.05422, abs=5e-6)
    assert poles.value[order][0] == pytest.approx(-2 * np.pi * 98.485, abs=2 * np.pi * 5e-4)


def test_responses_are_the_loops_own_formulae() -> None:
    """Y/U = Σ a s/(s² + 2ζωs + ω²), H = e^{−sτ}/(s + ω_f), L = Σ r s² / (…) · H, by hand."""
    structure = Structure(flame_delay=True)
    fit = as_fit(structure, material.tube(structure))
    p = fit.values
    s = 2j * np.pi * F
    drive = flame = np.zeros(F.size, dtype=complex)
    for i in (1, 2):
        w = 2 * np.pi * p[f"mode{i}.frequency_hz"]
        b = s / (s**2 + 2 * p[f"mode{i}.damping"] * w * s + w**2)
        drive = drive + p[f"mode{i}.speaker_residue"] * b
        flame = flame + p[f"mode{i}.flame_residue"] * s * b
    H = np.exp(-s * p["flame.delay_s"]) / (s + 2 * np.pi * p["flame.pole_hz"])
    r = responses(fit, F)
    np.testing.assert_allclose(r.from_drive.value, drive, rtol=1e-12)
    np.testing.assert_allclose(r.from_flame.value, flame, rtol=1e-12)
    np.testing.assert_allclose(r.flame.value, H, rtol=1e-12)
    np.testing.assert_allclose(r.loop.value, flame * H, rtol=1e-12)


def slopes(fit: Fit, function: object) -> npt.NDArray[np.complex128]:
    """∂/∂θ by central differences, (…, p); relative error about (step/ζ)², 3e-7 here."""
    columns = []
    for j in range(fit.theta.size):
        step = 1e-6 * max(abs(fit.theta[j]), 1e-3)
        both = []
        for sign in (1, -1):
            theta = fit.theta.copy()
            theta[j] += sign * step
            both.append(function(replace(fit, theta=theta)))  # type: ignore[operator]
        columns.append((both[0] - both[1]) / (2 * step))
    return np.stack(columns, axis=-1)


def from_slopes(fit: Fit, J: npt.NDArray[np.complex128]) -> npt.NDArray[np.float64]:
    real = np.stack([J.real, J.imag], axis=-2)
    return np.asarray(real @ fit.covariance @ np.swapaxes(real, -1, -2))


def test_bands_are_the_covariance_carried_through() -> None:
    """Against finite differences of the values themselves; 1e-5 covers their truncation."""
    structure = Structure(flame_delay=True)
    fit = as_fit(structure, material.tube(structure))
    r = responses(fit, F)
    for name in ("from_drive", "from_flame", "flame", "loop"):
        expected = from_slopes(
            fit, slopes(fit, lambda g, n=name: getattr(responses(g, F), n).value)
        )
        got = getattr(r, name).covariance
        scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(got / scale, expected / scale, atol=1e-5)
    poles = closed_loop_poles(fit)
    expected = from_slopes(fit, slopes(fit, lambda g: closed_loop_poles(g).value))
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(poles.covariance / scale, expected / scale, atol=1e-5)
    w = np.array([1e-4, 3e-4])
    for curve in (characteristic, describing_function):
        J = slopes(fit, lambda g, c=curve: c(g, w).y)
        variance = np.einsum("np,pq,nq->n", J.real, fit.covariance, J.real)
        np.testing.assert_allclose(curve(fit, w).stderr, np.sqrt(variance), rtol=1e-5)


def test_magnitude_and_phase_errors_of_a_known_covariance() -> None:
    """For G = 2j with σ_Re = 0.01, σ_Im = 0.04: σ(ln|G|) = 0.04/2, σ(phase) = 0.01/2."""
    from identify.report.responses import Response

    r = Response(np.array([2j]), np.diag([1e-4, 16e-4])[None])
    assert r.log_magnitude_stderr == pytest.approx([0.02], rel=1e-12)
    assert r.phase_stderr == pytest.approx([0.005], rel=1e-12)


def test_describing_function_of_a_cubic_is_one_plus_three_quarters() -> None:
    fit = as_fit(Structure(), material.tube())
    a = np.array([1e-4, 2e-4, 4e-4])
    c3 = fit.values["nonlinearity.c3"]
    np.testing.assert_allclose(describing_function(fit, a).y, 1 + 0.75 * c3 * a**2, rtol=1e-12)


def test_on_the_limit_cycle_a_pole_lies_on_the_axis() -> None:
    """The describing function drops the quadratic term, which acts through harmonics of some per
    cent: so much of the growth may remain."""
    _, after = material.pair()
    at = limit_cycle_input(after)
    assert at is not None
    assert at < largest_input(after)
    gain = float(describing_function(after.fit, np.array([at])).y[0])
    small, large = closed_loop_poles(after.fit), closed_loop_poles(after.fit, gain)
    growing = small.value[np.argmin(np.abs(small.frequency_hz - 169))]
    sustained = large.value[np.argmin(np.abs(large.frequency_hz - 169))]
    assert growing.real > 0
    assert abs(sustained.real) < 0.1 * growing.real
    assert after.model_cycle is not None
    assert sustained.imag / (2 * np.pi) == pytest.approx(after.model_cycle.frequency_hz, abs=0.1)


@pytest.mark.parametrize("key", ["flame_dynamics:distributed_delay", "acoustic_mode"])
def test_poles_satisfy_the_exact_equation(key: str) -> None:
    """1 = L(λ) also where no finite state space exists, by the response itself at complex s."""
    effect = by_key(key)
    structure = Structure().with_effects(effect)
    start = {"acoustic_mode": (394.0, 0.05, 20.0, -10.0)}.get(key, (2e-4, 1e-4))
    own = [q.to_internal(v) for q, v in zip(effect.parameters, start, strict=True)]
    fit = as_fit(structure, np.r_[material.tube(), own])
    poles = closed_loop_poles(fit)
    assert poles.value.size >= 3
    for pole in poles.value:
        at = responses(fit, np.array([pole / (2j * np.pi)]))
        assert abs(at.loop.value[0] - 1) < 1e-8
