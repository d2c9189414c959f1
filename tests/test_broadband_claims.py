"""What is claimed of a broadband record, what is left open, and how its noise is known."""

import json

import numpy as np
import numpy.typing as npt
import pytest

from identify.broadband import (
    Excitation,
    Fit,
    Lines,
    Structure,
    Whitener,
    diagnose_broadband,
    fit,
)
from identify.broadband.model import FRICTION, LINEAR, physical
from identify.broadband.rest import follows_motion, noise_of
from tests.broadband_material import RATE, duffing_output, multisine

FloatArray = npt.NDArray[np.float64]
PERIOD = 2048
NOISE = 3e-4


def _noisy(y: FloatArray, seed: int = 8) -> FloatArray:
    return y + NOISE * np.random.default_rng(seed).standard_normal(y.size)


def _linear_fit(u: FloatArray, y: FloatArray, where: slice) -> tuple[Excitation, Fit]:
    record = Excitation.of(u, y, RATE)
    start = {"stiffness": -1.0, "damping": -0.1, "input": 1.0, "bias": 0.0}
    return record, fit(record, Structure(LINEAR), start, Whitener.plain(where))


@pytest.mark.parametrize("known", ["unknown", "repeated periods", "weakly excited stretch"])
def test_what_no_candidate_names_is_left_open(known: str) -> None:
    """A second mode beside the declared one: terms are added, since each takes up a little; none
    accounts for it, so none is claimed and none is kept."""
    repeated = known == "repeated periods"
    seeds = [1, 1, 1] if repeated else [1, 2, 3]
    u = np.concatenate([*(multisine(PERIOD, seed) for seed in seeds), 0.01 * multisine(PERIOD, 4)])
    y = _noisy(duffing_output(u, cubic=0.0) + 0.4 * duffing_output(u, cubic=0.0, hz=150.0))
    found = diagnose_broadband(
        u,
        y,
        RATE,
        declared="linear",
        estimation=slice(300, 2 * PERIOD),
        test=slice(2 * PERIOD, 3 * PERIOD),
        lines=Lines((PERIOD, 2 * PERIOD), PERIOD) if repeated else None,
        noise=slice(3 * PERIOD + 300, 4 * PERIOD) if known == "weakly excited stretch" else None,
    )
    assert found.verdict == "unexplained"
    assert found.claims == ()
    assert found.weighed
    assert all(not w.accounts for w in found.weighed)
    assert found.final.fit.structure == found.stages[0].fit.structure
    answer = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert answer["effects"] == []
    assert answer["next_experiment"] is not None
    if known == "unknown":
        assert found.remainder.noise_rms is None
        assert found.remainder.follows is not None
        assert found.remainder.follows > 0.9
    else:
        assert answer["remainder"]["noise_source"] == known


def test_noise_is_what_repeated_periods_do_not_repeat() -> None:
    """σ of white noise from three periods: 2·2048 degrees of freedom, so to 1.1 %; 5 % is asked.
    Periods of different excitations tell nothing."""
    u = np.tile(multisine(PERIOD, 1), 4)
    y = _noisy(duffing_output(u))
    lines = Lines((PERIOD, 2 * PERIOD, 3 * PERIOD), PERIOD)
    _, fitted = _linear_fit(u, y, slice(PERIOD, 4 * PERIOD))
    known = noise_of(fitted, u, lines, None)
    assert known is not None
    assert known.rms == pytest.approx(NOISE, rel=0.05)
    others = np.concatenate([multisine(PERIOD, seed) for seed in range(4)])
    assert noise_of(fitted, others, lines, None) is None


def test_noise_does_not_follow_the_motion_and_a_missing_term_does() -> None:
    """Coloured noise, ten times: never below p = 1e-3. A quadratic term's residual: predicted."""
    u = np.concatenate([multisine(PERIOD, seed) for seed in (1, 2)])
    where = slice(200, 2 * PERIOD)
    clean = duffing_output(u, cubic=0.0)
    for seed in range(10):
        white = np.random.default_rng(seed).standard_normal(u.size)
        colour = np.convolve(white, np.exp(-np.arange(60) / 12.0), mode="same")
        record, fitted = _linear_fit(u, clean + 3e-3 * colour / colour.std(), where)
        _, p = follows_motion(record, fitted, where)
        assert p > 1e-3
    record, fitted = _linear_fit(u, _noisy(duffing_output(u, cubic=0.0, quadratic=0.5)), where)
    share, p = follows_motion(record, fitted, where)
    assert p < 1e-3
    assert share > 0.5


def test_friction_is_the_same_with_both_signs_turned() -> None:
    """μ tanh(v/s): a step of the fit across s = 0 is no new law, and reads as the same."""
    u = multisine(PERIOD, 1)
    record = Excitation.of(u, duffing_output(u), RATE)
    structure = Structure((*LINEAR, *FRICTION))
    theta = np.array([-1.0, -0.1, 1.0, 0.0, -0.02, 0.3])
    turned = theta * np.array([1, 1, 1, 1, -1, -1])
    one, slopes = record.predict(structure, theta)
    other, turned_slopes = record.predict(structure, turned)
    np.testing.assert_array_equal(one, other)
    assert slopes.shape == turned_slopes.shape
    assert physical(structure, theta, record.scale) == physical(structure, turned, record.scale)


def test_a_start_that_runs_away_is_an_answer() -> None:
    """A spring that pushes: no motion exists, and the fit says so by an infinite misfit."""
    u = multisine(PERIOD, 1)
    record = Excitation.of(u, duffing_output(u), RATE)
    start = {"stiffness": 1.0, "damping": 0.5, "input": 1.0, "bias": 0.0}
    found = fit(record, Structure(LINEAR), start, Whitener.plain(slice(0, PERIOD)))
    assert not found.converged
    assert found.chi2 == np.inf
