"""The report: one self-contained HTML file from a diagnosis or an identification.

Sections follow the reader's questions: what was found, how large the error was and is, what was
measured, where the residual sits, which candidates and which model, what to measure next. A
section whose material is missing is left out. What a simulated rig kept sealed stands at the very
end, apart from everything that was inferred.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from identify.record import Campaign
from identify.report import sections
from identify.report.controller import Steps
from identify.report.gallery import Result, figures
from identify.report.page import drawing, page, section


def write_html(
    path: Path | str,
    result: Result,
    campaign: Campaign | None = None,
    controller: Steps | None = None,
    truth: Mapping[str, Any] | None = None,
    drawings: bool = True,
) -> Path:
    """Write the report and return its path.

    Parameters
    ----------
    result : a `Diagnosis` or an `Identification`.
    campaign : its recordings, for the spectra.
    controller : the entrainment controller's steps: mappings with `frequency_hz`, `amplitude_v`,
        `suppression_db` (None while unknown) and `entrained`.
    truth : what a simulated rig kept sealed, shown last.
    drawings : False leaves the figures out: a few kilobytes of tables, in milliseconds.
    """
    target = Path(path)
    target.write_text(html(result, campaign, controller, truth, drawings), encoding="utf-8")
    return target


def html(
    result: Result,
    campaign: Campaign | None = None,
    controller: Steps | None = None,
    truth: Mapping[str, Any] | None = None,
    drawings: bool = True,
) -> str:
    """The report as text; parameters as for `write_html`."""
    drawn: dict[str, str] = {}
    for f in figures(result, campaign, controller) if drawings else ():
        drawn[f.section] = drawn.get(f.section, "") + drawing(f.figure, f.name, f.caption)

    def figure(name: str) -> str:
        return drawn.get(name, "")

    return page(
        f"entrain: {result.campaign}",
        sections.verdict(result),
        section(
            sections.errors_title(result), sections.errors(result), sections.limit_cycle(result)
        ),
        section(
            "Recordings",
            figure("recordings"),
            sections.quality(result),
            sections.calibration(campaign),
        ),
        section("Entrainment", figure("entrainment")),
        section("Measured and modelled harmonics", figure("harmonics")),
        section("Validation", sections.validation(result), figure("validation")),
        section("Residual", sections.residual(result), figure("residual")),
        section("Candidates", figure("candidates"), sections.candidates(result)),
        section("Model", sections.model(result), figure("model")),
        section("Parameters", sections.parameters(result)),
        section("Next experiment", sections.next_experiment(result)),
        section("Sealed truth", sections.truth(truth)),
    )
