"""The page of the thesis made again: numbers beside the thesis's, and nothing left out silently."""

import re
from pathlib import Path

import numpy as np
import pytest

from daq.service import reproduce as page
from daq.service.reproduction import (
    experiment,
    identification,
    material,
    model,
    residuals,
    theory,
    tracing,
)
from daq.service.reproduction.item import Item, share
from identify.assess import lack_of_fit_p
from identify.effects import by_key
from identify.fit import fit_orbits
from identify.identification import prepare
from identify.report.words import percent, scientific
from identify.start import reseated
from identify.structure import Structure
from simulated_rig.presets import thesis_two_mode
from tests.report_material import diagnosis
from tests.test_cli_data import entrain


@pytest.fixture(scope="module")
def items() -> list[Item]:
    return [identification.table_4_5(), identification.table_4_6(), model.tables()]


def text_of(html: str) -> str:
    return re.sub(r"<[^>]+>", " ", html)


def test_closed_loop_truth_is_the_sheets() -> None:
    """../shared/physics.md §1: 170.3145 Hz / −0.005609 and 280.948 Hz / 0.05422, to its digits."""
    (f1, z1), (f2, z2) = identification.closed_loop_truth()
    assert (f1, f2) == pytest.approx((170.3145, 280.948), abs=6e-4)
    assert (z1, z2) == pytest.approx((-0.005609, 0.05422), abs=6e-6)


def test_every_parameter_from_noise_free_data_to_1e_6() -> None:
    """Issue 3, point 6: gain and flame pole included, nothing specified."""
    fit = identification.likelihood(None)
    truth = material.true_parameters(thesis_two_mode())
    assert fit.converged
    assert set(fit.values) == set(truth)
    for name, value in truth.items():
        assert fit.values[name] == pytest.approx(value, rel=1e-6), name


def test_tables_hold_both_sides(items: list[Item]) -> None:
    closed, opened, model_tables = (text_of(i.body) for i in items)
    for value in ("170.44", "281.47", "170.37", "281.32", "280.95"):
        assert value in closed
    for value in ("168.8337", "282.6604", "282.48", "0.04711"):
        assert value in opened
    assert "sign: an erratum" in model_tables
    assert "1.8858e-05" in model_tables


def test_the_page_says_what_is_missing(items: list[Item]) -> None:
    made = {chapter: [] for chapter, _ in page.CHAPTERS}
    made["Chapter 4: identification of the model"] = items
    html = page.html(made, 1.0)
    assert "Fig. 5.6" in text_of(html).split("Not on this page:")[1][:900]
    assert set(page.missing(items)) == set(page.WANTED) - {
        *("Table 4.1", "Table 4.2", "Table 4.4", "Table 4.5", "Table 4.6", "Table 4.7"),
        *("Fig. 4.9", "Fig. 4.10"),
    }
    for item in items:
        assert f'href="#{item.name}"' in html
        assert f'id="{item.name}"' in html


def test_the_page_is_one_file(items: list[Item], tmp_path: Path) -> None:
    """No script, no address to fetch from."""
    html = page.html({"Chapter": items}, 1.0)
    assert not re.search(r"<script|<link|<img[^>]+src=.?http|@import", html)
    ids = re.findall(r' id="([^"]+)"', html)
    assert len(ids) == len(set(ids))


def test_progress_and_path(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The composition itself, with two cheap items; and as a user calls it."""
    monkeypatch.setattr(page, "CHAPTERS", (("One", (theory.sinusoids, theory.lagrange)),))
    told: list[tuple[float, str]] = []
    path = page.reproduce(tmp_path / "new", lambda a, b: told.append((a, b)))
    assert path == tmp_path / "new" / "reproduction.html"
    assert [a for a, _ in told] == [0.0, 0.5, 1.0]
    assert "Fig. 3.3" in path.read_text("utf-8")
    code, out, err = entrain(capfd, "reproduce", "--out", tmp_path / "by-command")
    assert (code, err) == (0, "")
    assert (tmp_path / "by-command" / "reproduction.html").exists()
    assert "reproduction.html" in out


def test_every_wanted_number_has_a_maker() -> None:
    """The text of each module names what it covers; all wanted are among them."""
    folder = Path(page.__file__).parent / "reproduction"
    code = " ".join(p.read_text("utf-8") for p in folder.glob("*.py"))
    for name in page.WANTED:
        assert f'"{name}"' in code, name


def test_van_der_pol_cycle_is_the_known_one() -> None:
    """μ = 1: amplitude 2.00862, period 6.66329 (textbook values); 400 steps a period."""
    path = theory._trajectory((0.1, 0.0))
    assert np.max(np.abs(path[-800:, 0])) == pytest.approx(2.00862, abs=2e-4)


def test_duffings_one_harmonic_folds() -> None:
    """F = 0.03 has no jump. For 0.06 the backbone ω² = 1 − ¾ μ A² meets A = F/(c ω) on the response
    at ω² = ¾; the fold lies below it, by a term of order c² = 3.6e-3."""
    assert theory._single_harmonic_folds(0.03) == []
    low, high = sorted(theory._single_harmonic_folds(0.06))
    assert np.sqrt(0.75) - 3.6e-3 < low < np.sqrt(0.75)
    assert low < high < 1


def test_the_stand_in_is_entrained_where_the_thesis_was() -> None:
    found = experiment.recorded()
    assert found.runs.frequency_hz.tolist() == [f for f, _ in experiment.TABLE_5_2]
    assert found.volts[0] == pytest.approx(1.5, abs=0.05)  # scaled, bisection to 1 %
    assert found.volts[0] > found.volts[1] > found.volts[2] < found.volts[3]  # a V


def test_the_search_chooses_a_filter_that_further_runs_refute() -> None:
    """Four runs: the least error of each place is below that of no filter. All twelve: the filter
    that was chosen leaves more error than none. And the second pole was never found."""
    found = experiment.recorded()
    bare = residuals.plain(found.runs)
    places = residuals.searched()[: len(residuals.PLACES)]
    assert [s.name.partition(":")[0] for s in places] == ["forward", "actuation", "feedback"]
    for s in places:
        assert s.fit.error == s.surface.errors.min() < bare.error
        assert len(s.fit.modes) < 2 or abs(s.fit.modes[1][0] / 291.88 - 1) > 0.1
    chosen = min(places, key=lambda s: s.fit.error)
    kept = residuals.filtered(found.all_runs, chosen.dynamics(*chosen.surface.best))
    assert kept.error > residuals.plain(found.all_runs).error


def test_the_stand_in_lacks_a_speaker_and_an_offset() -> None:
    """What tracing is to find, without its search: four modes do not explain the campaign even
    from the true values; with the two effects they do, and where the truth is. The coil has no
    place in the catalogue's resonance: the cone's numbers take it up, to a tenth."""
    campaign, plant = experiment.recorded().campaign, experiment.stand_in()
    structure = Structure(mode_count=4)
    data = prepare(campaign, structure).data
    true = material.true_parameters(plant)
    bare = fit_orbits(structure, data, structure.parameters.unknowns(true))
    assert bare.chi2_per_dof > 100
    larger = structure.with_effects(
        by_key("actuator_dynamics:resonance"), by_key("sensor_offset:mode_shapes")
    )
    true |= {
        "actuator_dynamics.frequency_hz": 240.0,
        "actuator_dynamics.damping": 0.25,
        "sensor_offset.distance_m": experiment.OFFSET_M,
    }
    fit = fit_orbits(larger, data, larger.parameters.unknowns(true))
    assert fit.converged
    assert lack_of_fit_p(fit.chi2, fit.dof) > 1e-3
    for name, tolerance in (
        ("mode1.frequency_hz", 2e-3),
        ("mode4.frequency_hz", 2e-3),
        ("flame.pole_hz", 1e-2),
        ("sensor_offset.distance_m", 0.1),
        ("actuator_dynamics.frequency_hz", 0.1),
        ("actuator_dynamics.damping", 0.1),
    ):
        assert fit.values[name] == pytest.approx(true[name], rel=tolerance), name


def test_an_idle_mode_is_put_where_one_is_missing() -> None:
    """Those two effects sought at once: the speaker's resonance takes the place of one of the four
    modes, whose shares vanish, and none is left for that at 526 Hz, which coarse noise hides."""
    ready = prepare(experiment.recorded().campaign, Structure(mode_count=4))
    both = by_key("actuator_dynamics:resonance"), by_key("sensor_offset:mode_shapes")
    larger, highest = ready.structure.with_effects(*both), experiment.stand_in().modes[3]
    true = material.true_parameters(experiment.stand_in()) | {
        "actuator_dynamics.frequency_hz": 240.0,
        "actuator_dynamics.damping": 0.25,
        "sensor_offset.distance_m": experiment.OFFSET_M,
        "mode4.frequency_hz": 240.0,
        "mode4.damping": 0.3,
        "mode4.flame_residue": 0.0,
        "mode4.speaker_residue": 0.0,
    }
    theta = larger.parameters.unknowns(true)
    astray = fit_orbits(larger, ready.data, theta, continuation=(0.003, 0.0))
    assert astray.chi2_per_dof > 100
    fit = reseated(astray, ready.data)
    assert lack_of_fit_p(fit.chi2, fit.dof) > 1e-3
    assert fit.values["mode4.frequency_hz"] == pytest.approx(highest.frequency_hz, rel=2e-3)
    assert reseated(fit, ready.data) is fit


def test_tracing_stands_beside_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """The item with another campaign's diagnosis in its place: verdict, errors before and after,
    the thesis's three rows, and the truth of the stand-in."""
    other = diagnosis()
    monkeypatch.setattr(tracing, "diagnosis", lambda: other)
    item = tracing.tracing()
    said = text_of(item.body)
    for words in ("search on all runs", "opened after the verdict", "4000", "−0.0762"):
        assert words in said
    assert item.verdict.startswith(f"{other.verdict}: ")
    assert scientific(other.before.chi2_per_dof) in said
    assert percent(other.after.validation_error) in said


def test_share_reads_as_a_difference() -> None:
    assert share(100.0, 100.0) == "0 %"
    assert share(200.0, 190.0) == "-5 %"
