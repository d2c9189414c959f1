"""The model's own stability and lock-in boundary against the simulated rig's.

The rig steps the variational equation (monodromy matrix); `identify` counts the turns of Hill's
determinant and solves for the drive at which an exponent crosses the axis.
"""

from dataclasses import replace

import numpy as np
import pytest

from identify import balance
from identify.effects import CATALOGUE
from identify.lockin import boundary
from identify.stability import Disturbed, leading_exponent, unstable_exponents
from simulated_rig.orbits import forced_orbits, free_orbit
from simulated_rig.presets import thesis_two_mode
from simulated_rig.stability import lock_in_volts, stability
from tests.identify_coefficients import STRUCTURE, WIDE, clean, exact
from tests.identify_rig import STEADY
from tests.test_identify_balance import forced_conditions, free_conditions, theta

PLANT = thesis_two_mode()
VOLT = 1e10  # the table's unit of forcing in the preset's volts


def disturbed(factor: float = 1.0, free: bool = False) -> tuple[Disturbed, balance.Orbits]:
    at = free_conditions() if free else forced_conditions()
    drive, values = at.drive, theta(STRUCTURE)
    start = None  # weak forcing is followed down from strong forcing
    for share in np.linspace(1.0, factor, 1 if factor == 1 else 12):
        at = replace(at, drive=drive * share)
        orbits = balance.solve(STRUCTURE, values, at, start=start)
        assert orbits.converged.all()
        start = orbits.inputs
    plain = STRUCTURE.parameters.plain(values)
    return Disturbed.around(STRUCTURE, plain, at, orbits.omega, orbits.inputs), orbits


def test_the_free_cycle_is_stable_and_decays_as_the_rig_s_monodromy_says() -> None:
    cycle, _ = disturbed(free=True)
    assert unstable_exponents(cycle) == 0
    found = leading_exponent(cycle, free=True)
    orbit = free_orbit(PLANT)
    assert orbit is not None
    assert found is not None
    others = [m for m in stability(PLANT, orbit).multipliers if abs(m - 1) > 1e-6]
    expected = np.log(max(abs(m) for m in others)) * orbit.frequency_hz
    # their integrator errs by (1/64)⁴ of ω: 6e-8 · 1066/s; ours by the harmonics left out
    assert found.real == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("factor", [1.0, 0.3, 0.2, 0.17])
def test_forced_orbits_are_stable_where_the_rig_s_are(factor: float) -> None:
    ours, orbits = disturbed(factor)
    velocity = orbits.velocity[:, 0]
    for i, (f, force, *_) in enumerate(STEADY):
        theirs = forced_orbits(PLANT, f, factor * force / VOLT)
        near = min(theirs, key=lambda o: abs(o.amplitude / 1e-7 - abs(velocity[i])))
        assert near.amplitude / 1e-7 == pytest.approx(abs(velocity[i]), rel=1e-6)
        assert (unstable_exponents(ours, i) == 0) == stability(PLANT, near).stable, f


def test_lock_in_boundary_is_the_rig_s_own() -> None:
    data = clean(WIDE, 1e-4)
    some = data.fit[0].take(np.array([0, 3, 6]))
    rows = boundary(exact(data), some)
    assert len(rows) == 3
    for row in rows:
        # theirs is a bisection to 1e-3
        low, high = 0.9 * row.boundary_v / VOLT, 1.1 * row.boundary_v / VOLT
        theirs = lock_in_volts(PLANT, row.frequency_hz, low, high, 1e-3) * VOLT
        assert row.boundary_v == pytest.approx(theirs, rel=1.1e-3), row.frequency_hz


def test_its_uncertainty_is_the_parameters() -> None:
    data = clean(WIDE[:1], 1e-4)
    fit = exact(clean(WIDE, 1e-4))
    (row,) = boundary(fit, data.fit[0])
    # a covariance of rank one along a direction d: ln(boundary) then moves by its slope along d
    d = 1e-6 * np.cos(1.0 + np.arange(fit.theta.size)) * fit.theta
    along = replace(fit, covariance=np.outer(d, d))
    (told,) = boundary(along, data.fit[0])
    ends = [boundary(replace(fit, theta=fit.theta + q * d), data.fit[0])[0] for q in (-1, 1)]
    moved = abs(np.log(ends[1].boundary_v / ends[0].boundary_v)) / 2
    # a difference of 1e-6 of solutions good to 1e-12
    assert told.log_stderr == pytest.approx(moved, rel=1e-4)
    assert 0 < row.log_stderr < 0.1


def test_no_effect_of_the_catalogue_stands_in_the_way() -> None:
    at = free_conditions()
    base = leading_exponent(disturbed(free=True)[0], free=True)
    assert base is not None
    seen = 0
    for effect in CATALOGUE:
        neutral = effect.neutral()
        if neutral is None:
            continue
        structure = STRUCTURE.with_effects(effect)
        inner = [q.to_internal(v) for q, v in zip(effect.parameters, neutral, strict=True)]
        whole = np.r_[theta(STRUCTURE), inner]
        orbits = balance.solve(structure, whole, at)
        assert orbits.converged.all(), effect.key
        cycle = Disturbed.around(
            structure, structure.parameters.plain(whole), at, orbits.omega, orbits.inputs
        )
        assert unstable_exponents(cycle) == 0, effect.key
        found = leading_exponent(cycle, free=True)
        assert found is not None
        # where it vanishes an effect changes nothing: rounding, through a root's condition
        assert abs(found - base) < 1e-5 * abs(base), effect.key
        seen += 1
    assert seen > 10
