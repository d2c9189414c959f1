"""Models declared in TOML: what they become, what is refused, and that they are what is fitted."""

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from typer.testing import CliRunner

from daq import records
from daq.cli import app
from daq.importers import open_campaign
from daq.importers.folder import Flame, Nonlinearity
from identify.chances import beta_tail, chi2_points, chi2_tail, f_tail, rank_correlation
from identify.declare import ModelError, described, read_model, structure_of
from identify.descent import levenberg_marquardt
from identify.effects import CATALOGUE
from identify.harmonics import RecordError
from identify.identification import declared_structure, fit_prepared, fit_structure, prepare
from identify.load import load_campaign
from identify.profile import intervals
from identify.record import DeclaredModel
from identify.residual import OrbitResidual
from identify.results import Verdict
from identify.trace.usable import usable
from tests.identify_coefficients import WIDE, clean, drawn

CASE = Path(__file__).parent / "data" / "b-flame-delay"


def test_a_bare_declaration_is_the_default_model() -> None:
    structure = structure_of({"format": "model/1"})
    assert structure == declared_structure(described(structure))
    assert len(structure.parameters) == 11


def test_every_element_can_be_declared_at_its_place() -> None:
    for effect in CATALOGUE:
        modes = effect.mode_count or 2
        table = {"elements": [effect.key]}
        found = structure_of({"format": "model/1", "modes": modes, effect.location: table})
        assert found.effects == (effect,)
        assert effect.key in described(found).options["elements"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('format = "model/2"', ["'model/2'", "'model/1'"]),
        ("modes = 2", ["format=None", "'model/1'"]),
        ('format = "model/1"\nmodes = 0', ["modes=0", "integer >= 1"]),
        ('format = "model/1"\nmode = 2', ["unknown key mode=2", "'modes'"]),
        ('format = "model/1"\n[flame]\norder = 1.5', ["flame.order=1.5", "integer >= 0"]),
        ('format = "model/1"\n[flame]\ndelay = 0.1', ["flame.delay=0.1", "true or false"]),
        ('format = "model/1"\n[flame]\npole = 3', ["unknown key flame.pole=3", "'order'"]),
        ('format = "model/1"\nflame = 1', ["flame=1 is not a table", "[flame]"]),
        ('format = "model/1"\n[nonlinearity]\nform = "cubic"', ["'cubic'", "'polynomial'"]),
        ('format = "model/1"\n[nonlinearity]\nform = "linear"\ndegree = 3', ["leave it out"]),
        ('format = "model/1"\n[nonlinearity]\nform = "lagrange"\nnodes = [0.0]', ["nodes=[0.0]"]),
        ('format = "model/1"\n[sensor]\nelements = ["flame_delay"]', ["channel_mismatch:gain"]),
        ('format = "model/1"\n[actuator]\nelements = "delay"', ["is not a list"]),
        (
            'format = "model/1"\n[sensor]\n'
            'elements = ["channel_mismatch:gain", "channel_mismatch:gain_skew"]',
            ["channel_mismatch.gain", "declare one of them"],
        ),
        ("format = model", ["not TOML"]),
        (f"a = {5000 * '['}", ["not TOML"]),
        ('\ufeffformat = "model/2"', ["'model/2'", "'model/1'"]),
    ],
)
def test_what_is_wrong_is_named_with_the_file(text: str, words: list[str], tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ModelError) as refused:
        read_model(file)
    for word in ["mine.toml", *words]:
        assert word in str(refused.value)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (DeclaredModel(flame="n_tau"), r"declared_model.flame='n_tau' is not one of \['first_"),
        (DeclaredModel(nonlinearity="cubic"), "declared_model.nonlinearity='cubic' is not one of"),
        (DeclaredModel(nonlinearity_degree=0), "declared_model.nonlinearity_degree=0 is not an"),
        (DeclaredModel(modes=0), "declared_model.modes=0 is not an integer >= 1"),
    ],
)
def test_what_a_campaign_declares_wrongly_is_named(model: DeclaredModel, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        declared_structure(model)


def test_every_word_that_a_campaign_may_declare_is_a_model() -> None:
    words = [get_args(Flame), get_args(Nonlinearity)]
    for flame, nonlinearity in itertools.product(*words):
        structure = declared_structure(DeclaredModel(flame=flame, nonlinearity=nonlinearity))
        assert described(structure).flame == flame
        assert structure.nonlinearity == nonlinearity


def test_the_verdicts_that_lists_are_filtered_by_are_those_there_are() -> None:
    assert get_args(records.Verdict) == get_args(Verdict)


def test_a_flame_without_a_pole_has_none_that_drifts() -> None:
    """Such a declaration had ended every diagnosis with a KeyError."""
    measured = load_campaign(open_campaign(CASE))
    at_once = declared_structure(replace(measured.declared_model, flame="none"))
    ready = prepare(measured, at_once)
    drifts = [
        e for e in CATALOGUE if e.name == "parameter_drift" and usable(e, ready.data, at_once)
    ]
    forms = {e.form for e in drifts}
    assert "flame_input" in forms
    assert not forms & {"flame_pole", "flame_rate"}


def test_nothing_usable_says_why() -> None:
    """Every run that is excluded, and for what."""
    measured = load_campaign(open_campaign(CASE))
    dead = tuple(
        replace(r, signals={n: replace(s, values=0 * s.values) for n, s in r.signals.items()})
        for r in measured.runs
    )
    with pytest.raises(RecordError, match=r"no usable forced run to fit on; excluded are .*dead"):
        prepare(replace(measured, runs=dead))


def test_two_lagrange_nodes_are_the_cubic_in_other_words() -> None:
    noisy = drawn(clean(WIDE, 3e-4), np.random.default_rng(8))
    largest = 7e6 / (2 * np.pi * 200)  # of w, in table units
    nodes = [-0.6 * largest, 0.8 * largest]
    shape = {"form": "lagrange", "nodes": nodes}
    cubic = fit_structure(structure_of({"format": "model/1"}), noisy)
    other = fit_structure(structure_of({"format": "model/1", "nonlinearity": shape}), noisy)
    assert cubic.converged
    assert other.converged
    # the same model: both end within the descent's tolerance of one minimum
    assert other.chi2 == pytest.approx(cubic.chi2, abs=1e-3)
    for j, node in enumerate(nodes, start=1):
        v = cubic.values
        told = node + v["nonlinearity.c2"] * node**2 + v["nonlinearity.c3"] * node**3
        assert other.values[f"nonlinearity.value{j}"] == pytest.approx(told, rel=1e-4)


def test_the_command_fits_the_file_s_model(tmp_path: Path) -> None:
    file, out = tmp_path / "model.toml", tmp_path / "out.json"
    file.write_text('format = "model/1"\n[flame]\nelements = ["flame_delay"]\n', encoding="utf-8")
    words = ["identify", str(CASE), "--model", str(file), "--json", str(out)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    told = json.loads(out.read_text(encoding="utf-8"))
    assert told["declared_model"]["elements"] == ["flame_delay"]
    delay = told["parameters"]["flame_delay.delay_s"]
    # physics.md §4: 0.400 ms to its third digit, and the misfit is gone
    assert delay["value"] == pytest.approx(4.0e-4, abs=5e-7 + 4 * delay["stderr"])
    assert told["chi2_per_dof"] < 1.6


def test_an_element_at_its_limit_leaves_the_others_bounded() -> None:
    """A speaker's resonance that these runs do not show: every other interval has two ends, each
    where χ² has risen by 1.96²."""
    structure = structure_of(
        {
            "format": "model/1",
            "flame": {"delay": True},
            "actuator": {"elements": ["actuator_dynamics:resonance"]},
            "sensor": {"elements": ["channel_mismatch:gain"]},
        }
    )
    campaign = replace(load_campaign(open_campaign(CASE)), declared_model=described(structure))
    fit, data = fit_prepared(prepare(campaign, structure=structure))
    found = intervals(fit, data)
    at_limit = "actuator_dynamics.damping"
    assert found.pop(at_limit).lower is None
    assert fit.values[at_limit] == pytest.approx(0.005)
    found.pop("actuator_dynamics.frequency_hz")  # above all that is heard, however far
    assert all(i.lower is not None and i.upper is not None for i in found.values()), found
    name = "mode1.frequency_hz"
    assert found[name].method == "profile"
    j = fit.structure.parameters.names.index(name)
    for end in (found[name].lower, found[name].upper):
        low, high = fit.structure.parameters.bounds()
        low[j] = high[j] = np.log(end)
        (descent,) = levenberg_marquardt(
            OrbitResidual(fit.structure, data.fit),
            fit.theta[None], iterations=80, bounds=(low, high),
        )  # fmt: skip
        assert descent is not None
        assert np.sqrt(descent.cost - fit.chi2) == pytest.approx(1.96, abs=0.03)


def test_tails_and_ranks_are_scipy_s() -> None:
    from scipy import stats

    for x, k in ((0.4, 3.0), (88.2, 61.4), (900.0, 5.0), (-1.0, 2.0)):
        assert chi2_tail(x, k) == pytest.approx(stats.chi2.sf(x, k), rel=1e-10)
    assert f_tail(2.2, 3, 40) == pytest.approx(stats.f.sf(2.2, 3, 40), rel=1e-10)
    assert beta_tail(0.8, 0.5, 4.5) == pytest.approx(stats.beta.sf(0.8, 0.5, 4.5), rel=1e-10)
    dof = np.array([1, 2, 7])
    assert chi2_points(1e-4, dof) == pytest.approx(stats.chi2.isf(1e-4, dof), rel=1e-10)
    a, b = [1.0, 2.0, 2.0, 3.0, 5.0, 5.0, 7.0, 0.0], [2.0, 1.0, 4.0, 4.0, 3.0, 8.0, 9.0, 7.0]
    assert rank_correlation(a, b) == pytest.approx(tuple(stats.spearmanr(a, b)), rel=1e-10)


def test_few_values_in_order_are_as_improbable_as_their_orders_are_many() -> None:
    """Student's t calls six in order impossible; of their orders two of 720 are as extreme."""
    from scipy import stats

    assert rank_correlation(range(6), [1.0, 2.5, 3.0, 8.0, 9.0, 9.5]) == pytest.approx((1, 2 / 720))
    a, b = [1.0, 2.0, 2.0, 3.0, 5.0], [4.0, 1.0, 4.0, 2.0, 3.0]

    def rho(x: object) -> float:
        return float(stats.spearmanr(x, b)[0])

    exact = stats.permutation_test((a,), rho, permutation_type="pairings", n_resamples=np.inf)
    assert rank_correlation(a, b) == pytest.approx((rho(a), exact.pvalue))
