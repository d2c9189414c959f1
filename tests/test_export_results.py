"""Exports: state space against the assembled loop, MATLAB files, strict JSON."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from identify.effect import Effect, Known
from identify.effects import CATALOGUE
from identify.export import to_json, to_mat, to_state_space
from identify.fit import Fit
from identify.report.responses import closed_loop_poles, responses
from identify.statespace import pade
from identify.structure import Structure
from tests import report_material as material
from tests.test_report_responses import as_fit

F = np.array([10.0, 90.0, 168.0, 170.0, 281.0, 400.0, 900.0])
KNOWN = Known(
    169.0, (168.8, 281.3), (0.01, 0.05), (44.3, -16.2), (35.2, -34.0), 2e-4, 0.25, 1.0,
    (160.0, 900.0),
)  # fmt: skip
PLACES = ("forward", "flame", "actuator", "experiment")
LINEAR = [
    e.among(np.linspace(0.0, 1.0, 8), ())
    for e in CATALOGUE
    if e.location in PLACES and e.mode_count in (None, 2)
]
IRRATIONAL = "flame_dynamics:distributed_delay"
STRUCTURES = {
    "declared": Structure(),
    "delay": Structure(flame_delay=True),
    "two lags": Structure(flame_order=2),
    "no lag": Structure(flame_order=0),
    "one mode": Structure(mode_count=1),
}


def plain(structure: Structure) -> Fit:
    extra = {"flame.pole2_hz": 900.0}
    return as_fit(structure, material.tube(structure, **extra))


def with_effect(effect: Effect) -> Fit:
    own = [
        q.to_internal(v) for q, v in zip(effect.parameters, effect.starts(KNOWN)[0], strict=True)
    ]
    return as_fit(Structure().with_effects(effect), np.r_[material.tube(), own])


def assert_same_as_assembled(fit: Fit) -> None:
    """To 1e-10 of the loop's own transfer functions, up to four times the highest mode."""
    s = 2j * np.pi * F
    expected = responses(fit, F)
    forward = to_state_space(fit, "forward").frequency_response(s)
    flame = to_state_space(fit, "flame").frequency_response(s)
    np.testing.assert_allclose(forward[:, 0, 0], expected.from_drive.value, rtol=1e-10)
    np.testing.assert_allclose(forward[:, 0, 1], expected.from_flame.value, rtol=1e-10)
    np.testing.assert_allclose(flame[:, 0, 0], expected.flame.value, rtol=1e-10)
    closed = to_state_space(fit, "closed_loop").frequency_response(s)
    velocity = expected.from_drive.value / (1 - expected.loop.value)
    # the closed loop divides by 1 − L, which magnifies the parts' 1e-10 by up to |L|/|1 − L|
    loss = 1 + np.abs(expected.loop.value / (1 - expected.loop.value))
    assert np.all(np.abs(closed[:, 0, 0] / velocity - 1) < 2e-10 * loss)
    assert np.all(np.abs(closed[:, 1, 0] / (velocity * expected.flame.value) - 1) < 2e-10 * loss)


@pytest.mark.parametrize("name", STRUCTURES)
def test_state_space_is_the_assembled_loop(name: str) -> None:
    assert_same_as_assembled(plain(STRUCTURES[name]))


@pytest.mark.parametrize("effect", LINEAR, ids=lambda e: e.key)
def test_state_space_with_effects(effect: Effect) -> None:
    assert_same_as_assembled(with_effect(effect))


def test_state_space_refuses_what_is_not_rational() -> None:
    """A distributed delay is n equal lags only where n = τ²/σ² is whole: at its start it is."""
    (effect,) = (e for e in LINEAR if e.key == IRRATIONAL)
    fit = with_effect(effect)
    theta = fit.theta.copy()
    theta[-1] += 0.1
    with pytest.raises(ValueError, match=r"distributed_delay.*neither rational"):
        to_state_space(replace(fit, theta=theta), "flame")


def test_state_space_refuses_a_negative_delay() -> None:
    (effect,) = (e for e in CATALOGUE if e.key == "actuator_dynamics:delay")
    fit = with_effect(effect)
    theta = fit.theta.copy()
    theta[-1] = -theta[-1]
    with pytest.raises(ValueError, match=r"actuator_dynamics:delay.*negative"):
        to_state_space(replace(fit, theta=theta))


def test_state_space_of_a_failed_fit_is_refused() -> None:
    a = material.without_convergence(material.pair()[1])
    with pytest.raises(ValueError, match="did not converge"):
        to_state_space(a.fit)


@pytest.mark.parametrize("delay_s", [1e-5, 4e-4, 5e-3])
def test_pade_keeps_its_accuracy_in_the_band(delay_s: float) -> None:
    """1e-11 a section aimed at; rounding in a cascade stays below 1e-10."""
    f = np.linspace(1.0, 1000.0, 200)
    got = pade(delay_s, 2 * np.pi * 1000.0).frequency_response(2j * np.pi * f)[:, 0, 0]
    assert np.max(np.abs(got - np.exp(-2j * np.pi * f * delay_s))) < 1e-10


def test_closed_loop_eigenvalues_are_the_loops_poles() -> None:
    fit = plain(Structure(flame_delay=True))
    found = np.linalg.eigvals(to_state_space(fit, "closed_loop").A)
    for pole in closed_loop_poles(fit).value:
        # Padé's own error 1e-11 on the axis, larger off it: the pole may move a little
        assert np.min(np.abs(found - pole)) < 1e-6 * abs(pole)


def test_scipy_takes_it() -> None:
    fit = plain(Structure())
    system = to_state_space(fit, "flame").to_scipy()
    t, step = system.step(T=np.linspace(0, 0.02, 50))
    pole = 2 * np.pi * 100.0
    np.testing.assert_allclose(step, (1 - np.exp(-pole * t)) / pole, atol=1e-12)


def test_python_control_takes_it_or_is_named() -> None:
    space = to_state_space(plain(Structure()))
    if importlib.util.find_spec("control") is None:
        with pytest.raises(ImportError, match="pip install control"):
            space.to_control()
    else:
        assert space.to_control().ninputs == 2


def test_matlab_file_holds_the_result(tmp_path: Path) -> None:
    d = material.diagnosis()
    path = to_mat(tmp_path / "d.mat", d)
    back = loadmat(path, simplify_cells=True)["entrain"]
    assert back["verdict"] == "traced"
    assert json.loads(back["json"])["format"] == "diagnosis/1"
    after = back["after"]
    p = d.after.parameters["mode1.frequency_hz"]
    assert after["parameters"]["mode1_frequency_hz"]["value"] == p.value
    assert after["parameters"]["mode1_frequency_hz"]["stderr"] == p.stderr
    np.testing.assert_array_equal(after["forward"]["A"], to_state_space(d.after.fit).A)
    runs = after["runs"]
    assert list(runs["name"]) == [c.run for c in d.after.comparisons]
    np.testing.assert_array_equal(
        runs["measured"], np.array([c.measured for c in d.after.comparisons])
    )
    assert np.isnan(runs["amplitude_v"][[c.kind for c in d.after.comparisons].index("free")])


def test_matlab_file_of_a_failed_fit_has_no_parameters(tmp_path: Path) -> None:
    d = material.diagnosis("unexplained")
    failed = material.without_convergence(d.before)
    path = to_mat(tmp_path / "f.mat", replace(d, before=failed, after=failed))
    back = loadmat(path, simplify_cells=True)["entrain"]
    assert not back["before"]["converged"]
    assert "parameters" not in back["before"]


def test_json_is_strict_and_complete(tmp_path: Path) -> None:
    d = material.diagnosis("unexplained")
    failed = material.without_convergence(d.before)
    odd = replace(d, before=failed, next_experiment={"gain": np.float64(np.inf), "n": np.int64(3)})

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    path = tmp_path / "d.json"
    text = to_json(odd, path)
    back = json.loads(text, parse_constant=refuse)
    assert back["before"]["chi2_per_dof"] is None
    assert back["next_experiment"] == {"gain": None, "n": 3}
    assert json.loads(path.read_text("utf-8")) == back
    keys = {"format", "campaign", "declared_model", "seconds", "quality", "noise_floor", "before",
            "residual", "candidates", "verdict", "effects", "after", "next_experiment"}  # fmt: skip
    assert keys <= set(back)
