"""Deviations that wander in time are told from ones drawn anew for each run."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy import optimize

from identify import start
from identify.effects.scatter import SCATTERS
from identify.executor import InProcess
from identify.scatter import fit_scatter
from identify.trace.spreads import try_scatters
from identify.wander import likelier
from tests.trace_material import thesis_campaign

FloatArray = npt.NDArray[np.float64]
RUNS, EACH, SHARED, STEP = 10, 4, 3, 30.0
TOLD = 1e4  # how finely a run tells what it deviates by, in units of one
SIZE = 8.0 / TOLD
DRIFT = next(s for s in SCATTERS if s.name == "parameter_drift")


def rows(rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """J, one tangent a run, and when the runs began: not in order, nor evenly."""
    jacobian = rng.normal(size=(RUNS * EACH, SHARED))
    tangent = np.zeros((RUNS * EACH, RUNS))
    for run in range(RUNS):
        tangent[run * EACH : (run + 1) * EACH, run] = TOLD * rng.normal(size=EACH)
    # what is common to all runs is one of the shared parameters
    jacobian[:, 0] = tangent.sum(axis=1)
    return jacobian, tangent, rng.permutation(RUNS) * STEP + rng.uniform(0, 5, RUNS)


def deviance(
    residual: FloatArray, jacobian: FloatArray, tangent: FloatArray, C: FloatArray
) -> float:
    """χ² + ln det V at the σ² of the restricted likelihood, by the definition."""

    def both(log_variance: float) -> tuple[float, float]:
        V = np.eye(residual.size) + np.exp(log_variance) * tangent @ C @ tangent.T
        inverse = np.linalg.inv(V)
        normal = jacobian.T @ inverse @ jacobian
        step = np.linalg.solve(normal, jacobian.T @ inverse @ residual)
        rest = residual - jacobian @ step
        found = float(rest @ inverse @ rest) + float(np.linalg.slogdet(V)[1])
        return found + float(np.linalg.slogdet(normal)[1]), found

    tried = np.linspace(-30.0, 0.0, 75)
    near = tried[np.argmin([both(v)[0] for v in tried])]
    best = optimize.minimize_scalar(
        lambda v: both(v)[0], bounds=(near - 0.5, near + 0.5), method="bounded"
    )
    return both(float(best.x))[1]


def test_the_likelihood_is_that_of_the_definition() -> None:
    rng = np.random.default_rng(3)
    gains = []
    for _ in range(15):
        jacobian, tangent, started_s = rows(rng)
        since = started_s - started_s.min()
        C = np.minimum.outer(since, since) / since.max()
        walk = rng.multivariate_normal(np.zeros(RUNS), C)
        residual = rng.normal(size=RUNS * EACH) + SIZE * tangent @ walk
        anew = deviance(residual, jacobian, tangent, np.eye(RUNS))
        gains.append(likelier(residual, jacobian, tangent, started_s, anew))
        less = anew - deviance(residual, jacobian, tangent, C)
        assert gains[-1] == pytest.approx(max(less, 0.0), abs=0.01)
    assert np.median(gains) > 4.0


def test_what_is_drawn_anew_does_not_wander() -> None:
    """A likelihood ten times as great comes about in less than one case of ten."""
    rng = np.random.default_rng(5)
    gains = []
    for _ in range(100):
        jacobian, tangent, started_s = rows(rng)
        residual = rng.normal(size=RUNS * EACH) + SIZE * tangent @ rng.normal(size=RUNS)
        anew = deviance(residual, jacobian, tangent, np.eye(RUNS))
        gains.append(likelier(residual, jacobian, tangent, started_s, anew))
    assert np.median(gains) == 0.0
    assert np.mean(np.array(gains) > 2 * np.log(10.0)) < 0.1


def test_runs_at_one_time_tell_nothing_of_it() -> None:
    jacobian, tangent, started_s = rows(np.random.default_rng(1))
    residual = 1e-3 * tangent[:, 0]
    assert likelier(residual, jacobian, tangent, np.full_like(started_s, 7.0), 1e9) == 0.0


def test_a_frequency_that_walks_is_likelier_so(tmp_path: Path) -> None:
    """The rig's own walk, and the evidence of what it is tried as."""
    ready = thesis_campaign(tmp_path, 5, {"parameter_drift": {"frequency_walk": 1e-3}})
    base = start.fit_from_data(ready.structure, ready.data)
    (t,) = try_scatters(ready.structure, ready.data, base, [DRIFT], InProcess())
    assert t.spread is not None
    assert t.spread.wandering > 3.0
    assert t.deviance == t.fit.chi2 + t.spread.penalty - t.spread.wandering


def test_a_drive_does_not_wander(tmp_path: Path) -> None:
    """Its deviations are drawn anew by what they are."""
    ready = thesis_campaign(tmp_path, 5, {"drive_scatter": {"gain_rms": 0.01, "phase_rms_rad": 0}})
    base = start.fit_from_data(ready.structure, ready.data)
    drive = next(s for s in SCATTERS if s.name == "drive_scatter")
    spread = fit_scatter(ready.structure, ready.data, base, drive)
    assert spread is not None
    assert spread.wandering == 0.0
