"""The HTML report: one file, well-formed, complete, and saying what the result says."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from identify.export import summary_text
from identify.parameters import Estimate
from identify.profile import Interval
from identify.report import figures, html, save_figures, write_html
from identify.report.compared import harmonics_figure
from identify.report.misfit import heat_map, in_noise_units
from identify.report.theme import INK, power_of_ten, to_svg
from identify.report.words import interval, percent, scientific, with_error
from identify.results import Diagnosis, Identification, QualityFlag, TracedEffect
from tests import report_material as material

VOID = {"meta", "br", "hr", "img", "link", "input"}
STEPS = (
    {"frequency_hz": 166.0, "amplitude_v": 0.2, "suppression_db": 3.0, "entrained": False},
    {"frequency_hz": 166.0, "amplitude_v": 0.4, "suppression_db": 26.0, "entrained": True},
    {"frequency_hz": 172.0, "amplitude_v": 0.1, "suppression_db": None, "entrained": False},
    {"frequency_hz": 172.0, "amplitude_v": 0.3, "suppression_db": 22.0, "entrained": True},
)
TRUTH = {"effect": "sealed_delay", "parameters": {"delay_s": 4e-4}}


class Reader(HTMLParser):
    """Collects text, headings, identifiers and references; fails on tags that do not nest."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.headings: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.text = ""
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        for key, value in attrs:
            assert (
                value is None
                or not re.match(r"(?i)\s*(https?:|//|javascript:)", value)
                or (key.startswith("xmlns"))
            ), f"<{tag} {key}={value!r}> leads out of the file"
            if key == "id":
                self.ids.append(value or "")
            if key in ("href", "xlink:href"):
                assert (value or "").startswith(("#", "data:image/png")), f"<{tag} {key}={value!r}>"
            self.references += re.findall(r"#([\w-]+)", value or "") if key != "style" else []
            self.references += re.findall(r"url\(#([\w-]+)\)", value or "")
        if tag not in VOID:
            self.open.append(tag)
            if tag == "h2":
                self.headings.append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data
        if self.open and self.open[-1] == "h2":
            self.headings[-1] += data


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return reader


@pytest.fixture(scope="module")
def full() -> str:
    return html(material.diagnosis(), material.recorded(), STEPS, TRUTH)


def tables(result: Diagnosis | Identification) -> str:
    """The page without drawings: what is said does not depend on them."""
    return html(result, drawings=False)


def test_is_one_wellformed_file_without_network_or_script(full: str) -> None:
    page = read(full)
    assert "script" not in page.tags
    assert "link" not in page.tags
    assert "@import" not in full
    assert len(page.ids) == len(set(page.ids)), "identifiers of two figures collide"
    assert set(page.references) <= set(page.ids)


def test_has_every_section_with_truth_last(full: str) -> None:
    page = read(full)
    assert page.headings == [
        "Error before and after",
        "Recordings",
        "Entrainment",
        "Measured and modelled harmonics",
        "Validation",
        "Residual",
        "Candidates",
        "Model",
        "Parameters",
        "Sealed truth",
    ]
    assert page.text.index("sealed_delay") > page.text.index("Sealed truth")
    assert "svg" in page.tags
    assert "math" in page.tags


def test_shows_the_model_s_own_boundary_predictions_and_residual_tests(full: str) -> None:
    page = read(full)
    for words in ("drive/boundary", "predicted s.e. (%)", "independence of the drive's amplitude"):
        assert words in page.text
    assert any(name.startswith("lock-in") for name in page.ids)
    told = material.identification().to_json()
    for row in told["lock_in_boundary"]:
        assert 0 < row["boundary_v"] < row["drive_v"]  # the material's runs are entrained
        assert row["boundary_stderr_v"] > 0


def test_leaves_out_what_it_was_not_given() -> None:
    page = read(tables(material.diagnosis()))
    assert "Sealed truth" not in page.headings
    assert "Entrainment" not in page.headings
    assert "sealed_delay" not in page.text


def test_says_what_is_missing_or_stale_of_the_calibration() -> None:
    result, campaign = material.diagnosis(), material.recorded()
    assert (
        "Calibration: nothing is known of it" in read(html(result, campaign, drawings=False)).text
    )
    runs = [replace(r, notes={"calibration": []}) for r in campaign.runs]
    asked = replace(campaign, runs=tuple(runs))
    assert (
        "every pressure channel had one in force" in read(html(result, asked, drawings=False)).text
    )
    stale = {"calibration": ["p1: pistonphone of 2024-01-01 is stale"]}
    runs = [replace(r, notes=stale) for r in campaign.runs[:-1]]
    foreign = replace(campaign.runs[-1], notes={"imported_from": "r7.wav"})
    said = read(html(result, replace(campaign, runs=(*runs, foreign)), drawings=False)).text
    assert said.count("p1: pistonphone of 2024-01-01 is stale") == 1
    assert "no record of a calibration came with them" in said


def test_says_the_numbers_of_the_result(full: str) -> None:
    d = material.diagnosis()
    text = read(full).text
    for a in (d.before, d.after):
        for error in (a.fit_error, a.validation_error, a.noise_floor, a.expected_error):
            assert percent(error) in text
        assert scientific(a.chi2_per_dof) in text
        for e in a.parameters.values():
            value, stderr = with_error(e)
            assert value in text
            assert stderr in text
    assert "Traced: flame_delay (n-tau), flame" in text
    assert "clipped" in text
    assert "sensor_offset" in text  # equivalent_to


def test_escapes_what_comes_from_outside(full: str) -> None:
    assert "tube <b> & co" not in full
    assert "tube &lt;b&gt; &amp; co" in full


def test_colours_follow_the_readers_theme(full: str) -> None:
    drawings = re.findall(r"<svg.*?</svg>", full, flags=re.DOTALL)
    assert len(drawings) == 11
    for colour in INK.values():
        assert not any(colour in d.lower() for d in drawings)
    assert all("var(--ink)" in d for d in drawings)
    assert "prefers-color-scheme:dark" in full
    assert "size:A4" in full


@pytest.mark.parametrize("verdict", ["no_discrepancy", "ambiguous", "unexplained"])
def test_claims_no_effect_unless_traced(verdict: str) -> None:
    page = read(tables(material.diagnosis(verdict)))
    assert "Traced" not in page.text
    assert "Added to the model" not in page.text
    assert "Next experiment" in page.headings
    said = {
        "no_discrepancy": "explains the data to within noise",
        "ambiguous": "explain the data equally well",
        "unexplained": "is not claimed",
    }
    assert said[verdict] in page.text


def test_best_of_the_unexplained_is_not_called_after() -> None:
    before, after = material.pair()
    d = replace(material.diagnosis("unexplained"), before=before, after=after)
    heads = re.findall(r"<th[^>]*>([^<]*)</th>", tables(d))
    assert "best, not claimed" in heads
    assert "after" not in heads


def test_a_fit_that_failed_shows_no_parameters() -> None:
    d = material.diagnosis()
    failed = material.without_convergence(d.before)
    page = read(tables(replace(d, before=failed, after=failed, effects=(), verdict="unexplained")))
    assert "did not converge" in page.text
    assert "168." not in page.text.split("Parameters")[1]


def test_an_identification_has_one_column() -> None:
    result = material.identification()
    page = read(tables(result))
    assert "Identified" in page.text
    assert "Candidates" not in page.headings
    assert "before" not in re.findall(r"<th[^>]*>([^<]*)</th>", tables(result))


def test_a_run_without_a_steady_state_does_not_stop_the_report() -> None:
    d = material.diagnosis()
    rows = d.before.comparisons
    lost = replace(rows[2], predicted=np.full(rows[2].measured.size, np.inf + 0j))
    before = replace(d.before, comparisons=(*rows[:2], lost, *rows[3:]))
    rows_shown, sizes = in_noise_units(before)
    assert np.isnan(sizes[[c.run for c in rows_shown].index(lost.run)]).all()
    for figure in (heat_map(before, d.after), harmonics_figure(before, d.after)):
        assert "nan" not in to_svg(figure, "x").lower()


def test_runs_that_are_excluded_do_not_stop_the_report() -> None:
    """A run without its channel had ended the page, and with it the answer, in an error."""
    found, campaign = material.identification(), material.recorded()
    *others, last = campaign.runs
    lost = replace(last, signals={"drive": last.signals["drive"]})
    flags = (QualityFlag(last.name, "missing_channel", "no velocity", "excluded"),)
    spoilt = replace(campaign, runs=(*others, lost))
    assert "Fig" not in html(replace(found, quality=flags), spoilt, drawings=False)
    names = [d.name for d in figures(replace(found, quality=flags), spoilt)]
    assert "spectra" in names
    every = tuple(replace(flags[0], run=r.name) for r in campaign.runs)
    assert "spectra" not in [d.name for d in figures(replace(found, quality=every), campaign)]


def test_every_foreign_tone_is_listed() -> None:
    """All of them go by the same names: only the last had been shown."""
    found = material.diagnosis()
    tones = [
        TracedEffect(
            "interference",
            "sensor",
            "tone",
            {"interference.frequency_hz": Estimate(hz, 0.01, "Hz")},
        )
        for hz in (50.0, 150.0)
    ]
    both = replace(
        found,
        effects=(*found.effects, *tones),
        residual=replace(found.residual, significant=True, p_value=0.43),
    )
    said = read(html(both, drawings=False)).text
    assert "50.000 ± 0.010 Hz" in said
    assert "150.000 ± 0.010 Hz" in said
    assert "residual is within the noise (p = 0.43), beside the foreign tones" in said


def test_every_axis_is_named_with_its_unit() -> None:
    dimensionless = {"harmonic", "χ² per degree of freedom", "gain N(a)", "Re L", "Im L", ""}
    for drawn in figures(material.diagnosis(), None, STEPS):
        axes = [ax for ax in drawn.figure.axes if ax.get_visible()]
        assert any(ax.get_xlabel() for ax in axes)
        for ax in axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                # a column's unit may stand in its title
                named = "(" in label or label in dimensionless or "(" in ax.get_title("left")
                assert named, f"{drawn.name}: axis {label!r} has no unit"


def test_writes_files(tmp_path: Path) -> None:
    path = write_html(tmp_path / "report.html", material.identification(), drawings=False)
    assert path.read_text("utf-8").startswith("<!doctype html>")
    saved = save_figures(tmp_path / "figures", material.identification())
    assert {p.name for p in saved} >= {"heat-map.png", "responses.png", "nyquist-poles.png"}
    assert all(p.read_bytes()[:4] == b"\x89PNG" for p in saved)


def test_summary_says_the_same_in_plain_text() -> None:
    d = material.diagnosis()
    text = summary_text(d, TRUTH)
    assert text.startswith("Traced: flame_delay (n-tau), flame")
    for a in (d.before, d.after):
        assert percent(a.validation_error) in text
    for c in d.candidates:
        assert c.effects[0] in text
    assert text.index("sealed_delay") > text.index("Sealed truth") > text.index("Model")
    assert "\x1b" not in text
    assert "<" not in text.replace("< 1e", "")


@pytest.mark.parametrize(
    ("value", "stderr", "expected"),
    [
        (168.79034, 0.0103, ("168.790", "0.010")),
        (-1.2522e7, 8.3e4, ("−1.2522e7", "0.0083e7")),
        (4.0e-4, 2.2e-6, ("0.0004000", "0.0000022")),
        (0.5, np.inf, ("0.5", "not determined")),
        (-0.12, 3e110, ("−0.12", "not determined")),
        (np.nan, 1.0, ("—", "—")),
        (-12502.4, 92.0, ("−12502", "92")),
        (3.0, 250.0, ("3", "250")),
    ],
)
def test_values_have_the_digits_their_error_justifies(
    value: float, stderr: float, expected: tuple[str, str]
) -> None:
    assert with_error(Estimate(value, stderr, "1")) == expected


@pytest.mark.parametrize(
    ("lower", "upper", "expected"),
    [
        (168.78921, 168.80604, "168.7892 … 168.8060 Hz"),  # four digits would make both ends one
        (None, 168.80604, "not bounded … 168.8060 Hz"),
        (-3.7721e-4, 2.1e-5, "−0.00038 … 0.00002 Hz"),
    ],
)
def test_an_intervals_ends_differ_as_printed(
    lower: float | None, upper: float, expected: str
) -> None:
    shown = interval(Interval(lower, upper, "profile"), Estimate(168.8, 0.0043, "Hz"))
    assert shown == expected


def test_powers_of_ten_are_plain() -> None:
    ticks = (0.0, 1e-5, 2e-5, 0.01, 0.5, 1.0, 2000.0, 1e6)
    assert [power_of_ten(x) for x in ticks] == [
        "", "10⁻⁵", "2·10⁻⁵", "0.01", "0.5", "1", "2000", "10⁶",
    ]  # fmt: skip
