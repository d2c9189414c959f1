"""The law of the tongue against a direct integration of the Stuart–Landau equation."""

import math

import numpy as np
import pytest

from daq.tongue import Law, law_from_relaxation, lock_from_drift


def integrate(
    law: Law, detuning: float, forcing: float, seconds: float, start: complex, step: float = 1e-3
) -> np.ndarray:
    """Fourth-order Runge–Kutta of ż = [ν g + j(Δω + B g)] z + ε, g = 1 − |z|²."""

    def slope(z: complex) -> complex:
        gain = 1 - abs(z) ** 2
        turn = detuning + law.twist_per_s * gain
        return (law.growth_rate_per_s * gain + 1j * turn) * z + forcing

    z, out = start, []
    for _ in range(round(seconds / step)):
        out.append(z)
        a = slope(z)
        b = slope(z + step / 2 * a)
        c = slope(z + step / 2 * b)
        d = slope(z + step * c)
        z += step / 6 * (a + 2 * b + 2 * c + d)
    return np.array(out)


def entrained(law: Law, detuning: float, forcing: float) -> bool:
    """Whether z stands still after a long time (a margin of 6 % decays at ≥ 0.1 ν)."""
    tail = integrate(law, detuning, forcing, 12.0, 1.0 + 0j)[-2000:]
    return float(np.std(tail)) < 0.03


@pytest.mark.parametrize("twist", [0.0, 4.0])
@pytest.mark.parametrize("detuning", [-30.0, -8.0, 2.0, 12.0, 40.0])
def test_threshold_separates_entrained_from_free(detuning: float, twist: float) -> None:
    law = Law(6.0, twist, 0.0)
    edge = law.threshold(detuning)
    assert entrained(law, detuning, 1.06 * edge)
    assert not entrained(law, detuning, 0.94 * edge)


def test_known_limits() -> None:
    law = Law(6.0, 0.0, 0.0)
    # far away: the closed form of van der Pol; near: phase locking at |Δω| (research.md), which
    # is the leading order only: amplitude changes lower it by up to 6 % at Δω = ν/2
    assert law.threshold(40.0) == pytest.approx(math.sqrt((9 + 1600) / 2), rel=1e-3)
    assert law.threshold(1.0) == pytest.approx(1.0, rel=0.03)
    assert law.near(1.0)
    assert not law.near(4.0)
    assert Law(6.0, 4.0, 0.0).threshold(20.0) > Law(6.0, 4.0, 0.0).threshold(-20.0)


def test_one_probe_predicts_the_lock() -> None:
    """Phase drift at 70 % of the locking drive; the formula's error is at most 3.7 % there."""
    law, detuning = Law(20.0, 0.0, 0.0), 2.0
    forcing = 0.7 * law.threshold(detuning)
    phase = np.unwrap(np.angle(integrate(law, detuning, forcing, 30.0, 1.0 + 0j)))
    drift = (phase[-1] - phase[5000]) / (len(phase) - 5000) / 1e-3
    predicted = lock_from_drift(forcing, detuning, drift)
    assert predicted == pytest.approx(law.threshold(detuning), rel=0.04)
    assert lock_from_drift(1.0, 1.0, 1.5) is None


@pytest.mark.parametrize("start", [1.4, 0.7])
def test_relaxation_gives_growth_rate_and_twist(start: float) -> None:
    law = Law(6.0, 3.7, 0.0)
    z = integrate(law, 0.0, 0.0, 0.8, start + 0j)[::12]
    rng = np.random.default_rng(1)
    noisy = z + 1e-3 * (rng.standard_normal(z.size) + 1j * rng.standard_normal(z.size))
    found = law_from_relaxation(noisy, 0.012, 1.0)
    assert found is not None
    assert found.growth_rate_per_s == pytest.approx(6.0, rel=0.05)
    assert found.twist_per_s == pytest.approx(3.7, rel=0.08)
    assert found.growth_rate_relative_sigma < 0.05
    assert law_from_relaxation(np.ones(60, complex), 0.012, 1.0) is None
