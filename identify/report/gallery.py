"""All figures of a result, each with its name and caption: for the page, or as files."""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from matplotlib.figure import Figure

from identify.record import Campaign
from identify.report import theme
from identify.report.compared import harmonics_figure
from identify.report.controller import Steps, controller_steps
from identify.report.misfit import heat_map, residual_trends
from identify.report.ranking import places, ranking
from identify.report.response_figures import (
    frequency_responses,
    models,
    nonlinearity,
    nyquist_and_poles,
)
from identify.report.spectra import free_frequency, spectra
from identify.report.tongue import lock_in_boundary
from identify.results import Assessment, Diagnosis, Identification

Result = Diagnosis | Identification
COLUMNS = 3  # harmonics side by side in one figure


class Drawn(NamedTuple):
    """A figure, the section of the report that it belongs to, and its caption."""

    name: str
    section: str
    figure: Figure
    caption: str


def assessments(result: Result) -> tuple[Assessment, Assessment | None]:
    """(the declared model, the model with effects or None where nothing was added)."""
    if isinstance(result, Identification):
        return result.assessment, None
    same = result.after is result.before or result.after.structure == result.before.structure
    return result.before, None if same else result.after


def figures(
    result: Result, campaign: Campaign | None = None, controller: Steps | None = None
) -> Iterator[Drawn]:
    """Every figure that the material allows; a fit that failed has none of its own."""
    before, after = assessments(result)
    excluded = {q.run for q in result.quality if q.severity == "excluded"}
    highest = max((c.measured.size for c in before.comparisons), default=3)
    recorded = None if campaign is None else spectra(campaign, highest, excluded)
    if recorded is not None:
        yield Drawn(
            "spectra",
            "recordings",
            recorded,
            "Amplitude spectra of the velocity (Hann window). Dashed: the free limit cycle's "
            "frequency; triangles: the forcing frequencies. An entrained run has one line, at the "
            "forcing frequency, and nothing at the limit cycle's.",
        )
    if controller:
        yield Drawn(
            "controller",
            "entrainment",
            controller_steps(controller, _free_hz(before, campaign, excluded)),
            "Left: how far the limit-cycle line fell below its free level at each step. Right: "
            "the lock-in tongue; its boundary lies in the shaded band.",
        )
    shown = before if before.comparisons else after
    if shown is not None and shown.comparisons:
        later = after if shown is before else None
        yield from _of_comparisons(shown, later)
        if models(shown, later):
            yield from _of_models(shown, later)
    if before.lock_in or (after is not None and after.lock_in):
        yield Drawn(
            "lock-in",
            "validation",
            lock_in_boundary(before, after, campaign, result.quality),
            "Lock-in: the model's own boundary, below which its entrained state is unstable, with "
            "its 95 % band, and the forcing levels recorded. It was never fitted.",
        )
    if isinstance(result, Diagnosis) and result.candidates:
        yield Drawn(
            "ranking",
            "candidates",
            ranking(result),
            "Candidates, best first, each refitted. Dashed: what noise alone gives. Blue: claimed; "
            "green: adequate and plausible; grey: neither.",
        )
    if isinstance(result, Diagnosis) and result.whereabouts and result.whereabouts.left:
        yield Drawn(
            "places",
            "candidates",
            places(result.whereabouts),
            "Where it lies: what is left with a free shape or one known effect in each place. "
            "Blue: where it may lie; grey: ruled out, or too little taken up.",
        )


def _of_comparisons(before: Assessment, after: Assessment | None) -> Iterator[Drawn]:
    count = min(c.measured.size for c in before.comparisons)
    for first in range(1, count + 1, COLUMNS):
        orders = range(first, min(first + COLUMNS, count + 1))
        span = f"s {orders[0]} to {orders[-1]}" if len(orders) > 1 else f" {orders[0]}"
        yield Drawn(
            f"harmonics-{first}",
            "harmonics",
            harmonics_figure(before, after, orders),
            f"Harmonic{span} of the velocity, run by run (* validation run). Phases are "
            "relative to the drive; a free run's to its own fundamental.",
        )
    yield Drawn(
        "heat-map",
        "residual",
        heat_map(before, after),
        "|measured − predicted| of every Fourier coefficient in units of its own noise "
        "(* validation run). About one: nothing is left but noise.",
    )
    yield Drawn(
        "trends",
        "residual",
        residual_trends(before, after),
        "Root mean square of the residual, in noise units: by run against frequency, drive "
        "amplitude (free runs at 0 V) and run order; by harmonic, odd and even apart.",
    )


def _of_models(before: Assessment, after: Assessment | None) -> Iterator[Drawn]:
    yield Drawn(
        "nonlinearity",
        "model",
        nonlinearity(before, after),
        "The nonlinearity over the amplitudes that were measured, and its gain to the "
        "fundamental, with 95 % bands.",
    )
    yield Drawn(
        "responses",
        "model",
        frequency_responses(before, after),
        "Frequency responses of the forward path from drive and from flame output, and of the "
        "open loop with the nonlinearity's slope at zero; 95 % bands. Shaded: where harmonics "
        "were measured; elsewhere the model extrapolates.",
    )
    yield Drawn(
        "nyquist-poles",
        "model",
        nyquist_and_poles(before, after),
        "Left: the open loop with 95 % regions; the feedback is positive, so that the limit cycle "
        "sits where L meets 1/N(a). Right: the closed loop's poles with 95 % regions, and those "
        "with the describing function at the free limit cycle's amplitude.",
    )


def _free_hz(a: Assessment, campaign: Campaign | None, excluded: Collection[str]) -> float | None:
    if a.measured_cycle is not None:
        return a.measured_cycle.frequency_hz
    return None if campaign is None else free_frequency(campaign, excluded)


def save_figures(
    folder: Path | str,
    result: Result,
    campaign: Campaign | None = None,
    controller: Steps | None = None,
    kind: Literal["png", "svg", "pdf"] = "png",
) -> list[Path]:
    """Every figure as a file of its own, on white; returns the paths."""
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    paths = []
    for drawn in figures(result, campaign, controller):
        path = target / f"{drawn.name}.{kind}"
        theme.to_file(drawn.figure, str(path), kind)
        paths.append(path)
    return paths
