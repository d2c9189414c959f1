"""Harmonic balance against the thesis's numbers, and its derivatives against differences."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from identify import balance
from identify.dual import Dual
from identify.effect import Conditions, Effect
from identify.effects import by_key
from identify.effects.shaped import Setting, ShapedMemory
from identify.pieces import Characteristic
from identify.polynomial import Polynomial
from identify.structure import Loop, Structure, declared_modes
from tests.identify_rig import FREE_HARMONICS, FREE_HZ, STEADY, true_values

K = 7


def theta(structure: Structure) -> np.ndarray:
    values = true_values()
    return structure.parameters.unknowns(values)


def forced_conditions() -> Conditions:
    n = len(STEADY)
    drive = np.zeros((n, K), dtype=complex)
    drive[:, 0] = [-1j * row[1] for row in STEADY]  # F sin ωt
    measured = np.zeros((n, K), dtype=complex)
    measured[:, 0] = [row[2][0] * np.exp(1j * np.radians(row[3])) for row in STEADY]
    return Conditions(
        omega=2 * np.pi * np.array([row[0] for row in STEADY]),
        drive=drive,
        pressure=np.zeros_like(drive),
        velocity=measured,
        time=np.linspace(0, 1, n),
        flame_on=np.ones(n),
        identity=np.arange(n),
        free=np.zeros(n, dtype=bool),
        spacing_m=np.full(n, 0.0508),
    )


def free_conditions() -> Conditions:
    measured = np.zeros((1, K), dtype=complex)
    measured[0, 0] = 2.3e6
    nothing = np.zeros((1, K), dtype=complex)
    return Conditions(
        omega=2 * np.pi * np.array([169.0]),
        drive=nothing,
        pressure=nothing,
        velocity=measured,
        time=np.zeros(1),
        flame_on=np.ones(1),
        identity=np.arange(1),
        free=np.ones(1, dtype=bool),
        spacing_m=np.full(1, 0.0508),
    )


def test_forced_orbits_are_the_thesis_steady_states() -> None:
    structure = Structure()
    orbits = balance.solve(structure, theta(structure), forced_conditions())
    assert orbits.converged.all()
    expected = np.array([row[2] for row in STEADY])
    # physics.md gives six digits: one unit of the last one
    np.testing.assert_allclose(np.abs(orbits.velocity[:, :3]), expected, rtol=1e-5)
    phases = np.degrees(np.angle(orbits.velocity[:, 0]))
    np.testing.assert_allclose(phases, [row[3] for row in STEADY], atol=1e-3)


def test_free_limit_cycle_is_the_thesis_one() -> None:
    structure = Structure()
    orbits = balance.solve(structure, theta(structure), free_conditions())
    assert orbits.converged.all()
    assert orbits.omega[0] / (2 * np.pi) == pytest.approx(FREE_HZ, abs=5e-4)
    np.testing.assert_allclose(np.abs(orbits.velocity[0, :3]), FREE_HARMONICS, rtol=3e-4)


def test_a_free_frequency_does_not_depend_on_where_its_search_starts() -> None:
    """A clean record of half a minute knows it to 1e-10, and a descent along a long valley must see
    what a hundredth of that brings."""
    structure, at = Structure(), free_conditions()
    starts = at.omega * (1 + np.array([0.0, 1e-3, 1e-4, 3e-5, 1e-5, 1e-6])[:, None])
    found = [balance.solve(structure, theta(structure), at, start_omega=w).omega for w in starts]
    assert np.ptp(found) < 3e-13 * found[0][0]


@pytest.mark.parametrize("free", [False, True])
def test_derivatives_agree_with_differences(free: bool) -> None:
    structure = Structure()
    at = free_conditions() if free else forced_conditions()
    t0 = theta(structure)
    exact = balance.solve(structure, t0, at, derivatives=True)
    assert exact.d_velocity is not None
    for j in range(t0.size):
        # a central difference errs by h²: 1e-10 relative here; rounding gives 1e-16/h = 1e-11
        h = np.zeros_like(t0)
        h[j] = 1e-5 * max(abs(t0[j]), 1e-7)
        up = balance.solve(structure, t0 + h, at, start=exact.inputs)
        down = balance.solve(structure, t0 - h, at, start=exact.inputs)
        difference = (up.velocity - down.velocity) / (2 * h[j])
        size = np.max(np.abs(difference)) + 1e-12 * np.max(np.abs(exact.velocity)) / abs(h[j])
        error = np.max(np.abs(difference - exact.d_velocity[:, :, j]))
        assert error < 2e-4 * size, structure.parameters.names[j]


def assert_slopes_agree_with_differences(effect: Effect, own: Sequence[float]) -> None:
    rng = np.random.default_rng(3)
    v = rng.normal(size=(2, K)) * 3000 / np.arange(1, K + 1) + 1j * rng.normal(size=(2, K)) * 300
    values = {**true_values(), **dict(zip((q.name for q in effect.parameters), own, strict=True))}
    (n,) = Structure(effects=(effect,)).characteristics(values, forced_conditions())
    exact = balance._force_jacobian(n, v, K)
    for j in range(2 * K):
        h = np.zeros(K, dtype=complex)
        h[j % K] = 1e-4 if j < K else 1e-4j
        up, down = balance._force(n, v + h, K), balance._force(n, v - h, K)
        # corners move by less than a sample of 1024: no sample changes sides but by chance
        np.testing.assert_allclose((up - down) / 2e-4, exact[:, :, j], atol=2e-6)


@pytest.mark.parametrize("form", ["dead_zone", "hysteresis", "tanh"])
def test_slopes_of_what_is_sampled_agree_with_differences(form: str) -> None:
    """Corners, and a play that holds its output for half of each period."""
    size = 1 / 4000 if form == "tanh" else 800.0
    assert_slopes_agree_with_differences(by_key(f"nonlinearity_shape:{form}"), [size])


def test_slopes_of_a_memory_of_several_plays_agree_with_differences() -> None:
    """At each moment its output follows the input of several."""
    assert_slopes_agree_with_differences(ShapedMemory(Setting(FREE_HZ, 2)), [800.0, 0.5, -0.7, 0.9])


@pytest.mark.parametrize(
    ("effect", "own"),
    [
        (by_key("nonlinearity_shape:dead_zone"), [800.0]),
        (by_key("nonlinearity_shape:hysteresis"), [800.0]),
        (ShapedMemory(Setting(FREE_HZ, 2)), [800.0, 0.5, -0.7, 0.9]),
    ],
)
def test_what_is_behind_an_operator_changes_with_its_parameters(
    effect: Effect, own: Sequence[float]
) -> None:
    """Exact derivatives by the operator's and the curve's parameters, against differences."""
    rng = np.random.default_rng(3)
    v = rng.normal(size=(2, K)) * 3000 / np.arange(1, K + 1) + 0j
    structure, at = Structure(effects=(effect,)), forced_conditions().take(np.arange(2))
    names, shaping = structure.parameters.names, structure.shaping
    values = {**true_values(), **dict(zip((q.name for q in effect.parameters), own, strict=True))}
    theta0 = structure.parameters.to_internal([values[n] for n in names])
    plain = structure.parameters.plain(theta0[None], 2)
    seeded = structure.parameters.seeded(theta0[None], 2, only=shaping)
    (n,) = structure.characteristics({**plain, **seeded}, at)
    exact = balance._force(n, v, K)
    for j, i in enumerate(shaping):
        sides = []
        step = 1e-6 * max(abs(theta0[i]), 1e-6)
        for sign in (1, -1):
            moved = theta0.copy()
            moved[i] += sign * step
            (n,) = structure.characteristics(structure.parameters.plain(moved[None], 2), at)
            sides.append(balance._force(n, v, K))
        difference = (sides[0] - sides[1]) / (2 * step)
        size = np.max(np.abs(difference))
        np.testing.assert_allclose(exact.d[..., j], difference, atol=1e-7 * size, err_msg=names[i])


def test_several_vectors_at_once_equal_one_by_one() -> None:
    structure = Structure()
    at = forced_conditions()
    vectors = theta(structure) * np.array([[1.0], [1.0001], [0.9999]])
    together = balance.solve(structure, vectors, at, derivatives=True)
    for i, vector in enumerate(vectors):
        alone = balance.solve(structure, vector, at, derivatives=True)
        part = together.take(np.arange(i * at.runs, (i + 1) * at.runs))
        np.testing.assert_allclose(part.velocity, alone.velocity, rtol=1e-9)
        assert part.d_velocity is not None
        assert alone.d_velocity is not None
        scale = np.max(np.abs(alone.d_velocity))
        assert np.max(np.abs(part.d_velocity - alone.d_velocity)) < 1e-8 * scale


class Opaque:
    """A characteristic that does not show that it is a polynomial."""

    def __init__(self, inner: Characteristic) -> None:
        self.inner = inner

    def __call__(self, w: Any) -> Any:
        return self.inner(w)


@pytest.mark.parametrize("free", [False, True])
def test_compiled_and_sampled_newton_find_the_same_orbits(
    free: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With two loops, a bent characteristic and a gain of its own in every row."""
    effect = by_key("nonlinear_damping:quadratic")
    structure = Structure().with_effects(effect)
    vector = np.r_[theta(Structure()), 1e-9]
    both = np.stack([vector, vector * np.r_[np.full(vector.size - 1, 1.0002), 2.0]])
    at = free_conditions() if free else forced_conditions()
    compiled = balance.solve(structure, both, at, derivatives=True)
    assemble, characteristics = Structure.assemble, Structure.characteristics

    def hidden(self: Structure, *arguments: Any) -> Loop:
        loop = assemble(self, *arguments)
        return replace(loop, N=tuple(Opaque(n) for n in loop.N))

    def hidden_too(self: Structure, *arguments: Any) -> tuple[Characteristic, ...]:
        return tuple(Opaque(n) for n in characteristics(self, *arguments))

    monkeypatch.setattr(Structure, "assemble", hidden)
    monkeypatch.setattr(Structure, "characteristics", hidden_too)
    sampled = balance.solve(structure, both, at, derivatives=True)
    assert compiled.converged.all()
    assert sampled.converged.all()
    np.testing.assert_allclose(compiled.velocity, sampled.velocity, rtol=1e-9, atol=1e-3)
    np.testing.assert_allclose(compiled.omega, sampled.omega, rtol=1e-11)
    assert compiled.d_velocity is not None
    scale = np.abs(sampled.d_velocity).max(axis=(0, 1))
    assert np.all(np.abs(compiled.d_velocity - sampled.d_velocity) <= 1e-7 * scale)


def test_a_row_that_finds_no_orbit_leaves_the_others_theirs() -> None:
    good = theta(Structure())
    lost = good + np.log(1.3) * (np.array(Structure().parameters.names) == "mode1.frequency_hz")
    alone = balance.solve(Structure(), good, free_conditions())
    both = balance.solve(Structure(), np.stack([good, lost]), free_conditions())
    assert both.converged.tolist() == [True, False]
    np.testing.assert_array_equal(both.velocity[0], alone.velocity[0])


def test_a_polynomial_is_its_powers_and_knows_its_derivatives() -> None:
    w = np.linspace(-2.0, 2.0, 9)[None]
    n = Polynomial((1.0, 0.0, -0.3), bent=0.2).plus((2, 5), (0.5, 0.01))
    powers = w + 0.5 * w**2 - 0.3 * w**3 + 0.01 * w**5 + 0.2 * w * np.abs(w)
    np.testing.assert_allclose(n(w), powers)
    slope = 1 + w - 0.9 * w**2 + 0.05 * w**4 + 0.4 * np.abs(w)
    np.testing.assert_allclose(balance.slope_along(n, w), slope)
    np.testing.assert_allclose(n.table(2), [[0.2, 1.0, 0.5, -0.3, 0.0, 0.01]] * 2)
    seed = Dual(np.full((1, 1), -0.3), np.ones((1, 1, 1)))
    np.testing.assert_allclose(Polynomial((1.0, 0.0, seed))(w).d[..., 0], w**3)


def test_a_mode_that_alone_is_damped_by_its_amplitude() -> None:
    """Its loss is of its own velocity, and acts on no other mode."""
    structure = Structure(3)
    loss = by_key("nonlinear_damping:cubic_mode")
    values = dict.fromkeys(structure.parameters.names, 1.0) | {"nonlinear_damping.coefficient": 2.0}
    modes = declared_modes(values, 3)
    found = loss.loss(values, None, modes)  # type: ignore[arg-type]
    assert found is not None
    assert found.coefficients == [2.0, 0.0, 0.0]
    assert found.weights == [1.0, 0.0, 0.0]
