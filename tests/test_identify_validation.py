"""The fit judged by itself: residual tests, intervals, what is undetermined, uncertain drive."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from identify import drive
from identify.descent import Evaluated, FloatArray, IntArray, levenberg_marquardt
from identify.fit import Fit, covariance_of, failed, fit_orbits
from identify.harmonics import VARIANCE_DOF
from identify.identification import undetermined
from identify.profile import intervals
from identify.residual import OrbitResidual
from identify.results import Comparison
from identify.whiteness import residual_tests
from tests.identify_coefficients import STRUCTURE, WIDE, clean, drawn, exact
from tests.identify_rig import STEADY, true_values
from tests.test_identify_balance import theta


def test_residual_tests_have_the_false_alarm_rate_they_claim() -> None:
    data, rng = clean(WIDE, 3e-4), np.random.default_rng(11)
    found: dict[str, list[float]] = {}
    for _ in range(60):
        noisy = drawn(data, rng)
        fit = fit_orbits(STRUCTURE, noisy, theta(STRUCTURE), continuation=(0.0,))
        for t in residual_tests(fit, noisy):
            found.setdefault(t.name, []).append(t.p_value)
    assert set(found) == {"run_order", "harmonics", "amplitude", "frequency", "outlier"}
    for name, p in found.items():
        # at 20 % a binomial of 60 has a standard deviation of 5.2 %: three and a half of them
        assert abs(np.mean(np.array(p) < 0.2) - 0.2) < 0.18, name


def test_a_drift_is_seen_in_the_order_of_runs() -> None:
    noisy = drawn(clean(WIDE, 3e-4), np.random.default_rng(2), drift=0.02)
    fit = fit_orbits(STRUCTURE, noisy, theta(STRUCTURE), continuation=(0.0,))
    tests = {t.name: t.p_value for t in residual_tests(fit, noisy)}
    # seven runs less eleven parameters leave it little power: the null reaches 2.6 deviations
    assert tests["run_order"] < 0.05, tests


def test_intervals_are_profiled_where_the_likelihood_is_no_parabola() -> None:
    few = tuple((f, a) for f, a, *_ in STEADY)
    rng = np.random.default_rng(3)
    quiet = drawn(clean(few, 1e-5), rng)
    fit = fit_orbits(STRUCTURE, quiet, theta(STRUCTURE), continuation=(0.0,))
    assert {i.method for i in intervals(fit, quiet).values()} == {"gaussian"}
    loud = drawn(clean(few, 1.5e-3), rng)
    fit = fit_orbits(STRUCTURE, loud, theta(STRUCTURE), continuation=(0.0,))
    assert fit.converged
    found = intervals(fit, loud)
    name = "mode1.damping"
    assert found[name].method == "profile"
    # an end is where χ², minimised over all others, has risen by 1.96²; √Δχ² is met to 0.02
    j = STRUCTURE.parameters.names.index(name)
    for end in (found[name].lower, found[name].upper):
        assert end is not None
        low, high = STRUCTURE.parameters.bounds()
        low[j] = high[j] = np.log(end)
        (descent,) = levenberg_marquardt(
            OrbitResidual(STRUCTURE, loud.fit), fit.theta[None], iterations=80, bounds=(low, high)
        )
        assert descent is not None
        assert np.sqrt(descent.cost - fit.chi2) == pytest.approx(1.96, abs=0.03)


def test_a_descent_follows_a_curved_valley() -> None:
    """Rosenbrock's, a thousand times as steep: 972 iterations if every step is straight."""
    steep = 1e4

    def valley(thetas: FloatArray, which: IntArray, jacobian: bool) -> Evaluated:
        x, y = thetas.T
        residual = np.stack([steep * (y - x**2), 1 - x], axis=1)
        zero, one = np.zeros_like(x), np.ones_like(x)
        J = np.stack([[-2 * steep * x, steep * one], [-one, zero]]).transpose(2, 0, 1)
        return Evaluated(residual, J if jacobian else None, np.ones(x.size, dtype=bool))

    (descent,) = levenberg_marquardt(valley, np.array([[-1.2, 1.0]]), iterations=100)
    assert descent is not None
    assert descent.converged
    assert descent.theta == pytest.approx([1.0, 1.0], abs=3e-3)  # χ² within 1e-6 of its least


def test_what_the_data_do_not_determine_is_named() -> None:
    # one condition of eleven parameters' need: far too little
    data = clean(WIDE[:2], 1e-3)
    residual = OrbitResidual(STRUCTURE, data.fit)(theta(STRUCTURE)[None], np.zeros(1, int), True)
    assert residual.jacobian is not None
    J = residual.jacobian[0]
    fit = Fit(STRUCTURE, theta(STRUCTURE), 0.0, 13, covariance_of(J), residual.residual[0], J,
              True, "", 0)  # fmt: skip
    said = undetermined(fit, data)
    assert any("mode1.flame_residue" in s and "mode1.damping" in s for s in said), said
    assert undetermined(exact(clean(WIDE, 1e-5)), clean(WIDE, 1e-5)) == ()
    assert set(true_values()) == set(STRUCTURE.parameters.names)


def test_an_uncertain_drive_is_part_of_the_covariance() -> None:
    data, rng = clean(WIDE, 1e-4), np.random.default_rng(21)
    (b,) = data.fit
    variance = (4e-4 * np.abs(b.at.drive[:, 0])) ** 2  # E|n|², 2 to 12 times what the noise does
    before, after = [], []
    for _ in range(8):
        (noisy,) = drawn(data, rng).fit
        n = rng.standard_normal((2, *b.at.drive.shape)) * np.sqrt(variance / 2)[:, None]
        wrong = b.at.drive + np.where(b.at.drive != 0, n[0] + 1j * n[1], 0.0)
        told = replace(data, fit=(replace(
            noisy, at=replace(b.at, drive=wrong), drive_noise=variance),))  # fmt: skip
        fit = fit_orbits(STRUCTURE, told, theta(STRUCTURE), continuation=(0.0,))
        wider = drive.with_uncertain_drive(fit, told)
        again = fit_orbits(STRUCTURE, wider, fit.theta, continuation=(0.0,))
        before.append(fit.chi2_per_dof)
        after.append(again.chi2_per_dof)
    # χ² of 8 · 73 degrees of freedom: a standard deviation of 5.9 % (weights estimated: some more)
    assert np.mean(before) > 2
    assert np.mean(after) == pytest.approx(VARIANCE_DOF / (VARIANCE_DOF - 2), abs=0.2)
    quiet = replace(data, fit=(replace(b, drive_noise=variance * 1e-6),))
    assert drive.with_uncertain_drive(fit, quiet) is quiet


def test_a_fit_that_is_lost_with_an_uncertain_drive_is_kept_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = clean(WIDE, 1e-4)
    (b,) = data.fit
    variance = (4e-4 * np.abs(b.at.drive[:, 0])) ** 2
    told = replace(data, fit=(replace(b, drive_noise=variance),))
    fit = fit_orbits(STRUCTURE, told, theta(STRUCTURE), continuation=(0.0,))
    counted, again = drive.refitted(fit, told)
    assert counted is not told
    assert again is not fit
    lost = "identify.fit.fit_orbits"
    monkeypatch.setattr(lost, lambda s, d, t, **_: failed(s, d, t, "lost"))
    kept = drive.refitted(fit, told)
    assert kept[0] is told
    assert kept[1] is fit


def test_a_run_without_a_steady_state_is_infinitely_far_and_warns_of_nothing() -> None:
    unsolved = Comparison(
        "a", "free", "fit", 170.0, 170.0, None, 0.0, np.array([1 + 2j]), np.full(1, np.inf + 0j),
        np.ones(1),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isinf(np.abs(unsolved.normalised)).all()


@pytest.mark.parametrize(("times", "exists"), [(1e60, True), (1e160, False)])
def test_a_misfit_beyond_numbers_is_none(times: float, exists: bool) -> None:
    """Its square overflowed, with a warning (a speaker's high-pass beside a step, 9115)."""
    data = clean(WIDE, 3e-4)
    away = theta(STRUCTURE) * 1.001
    batches = tuple(replace(b, whitener=b.whitener * times) for b in data.fit)
    residual = OrbitResidual(STRUCTURE, batches, newton_steps=2)
    assert residual(away[None, :], np.arange(1), True).exists.all() == exists
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (descent,) = levenberg_marquardt(residual, away[None, :], iterations=3)
    assert (descent is not None) == exists
