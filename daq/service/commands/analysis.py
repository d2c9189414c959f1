"""`entrain identify`, `diagnose`: in this process, with a progress bar."""

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from daq.errors import InputError
from daq.service import LONGEST_SEARCH_S
from daq.service.commands import broadband
from daq.service.commands.common import (
    FigureOption,
    HtmlOption,
    JsonOption,
    StoreOption,
    number,
    open_store,
    out,
    positive,
    table,
    write_json,
)

if TYPE_CHECKING:
    from identify.parameters import Estimate
    from identify.record import Campaign
    from identify.results import Candidate, Diagnosis, Identification, QualityFlag

CampaignArgument = Annotated[str, typer.Argument(help="Campaign folder, or campaign id.")]
Tell = Callable[[float, str], None]


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Tell]:
    """A bar that `tell(fraction, text)` moves; drawn on standard error's terminal only."""
    from daq.service.commands.common import err

    bar = Progress(
        TextColumn("{task.description:<44.44}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
        console=err,
        transient=True,
        disable=quiet or not err.is_terminal,
    )
    with bar:
        task = bar.add_task("starting", total=1.0)

        def tell(fraction: float, text: str) -> None:
            bar.update(task, completed=fraction, description=text)

        yield tell


ProcessesOption = Annotated[
    int, typer.Option("--processes", min=0, help="Worker processes for the search; 0: one a core.")
]


PointOption = Annotated[
    str | None,
    typer.Option("--operating-point", help="Of a campaign that walked several: which (by name)."),
]


def load(
    campaign: str, store: Path | None, point: str | None = None
) -> "tuple[Campaign, list[dict[str, Any]]]":
    """The campaign's recordings (at one operating point, where asked for), and the controller's
    steps where it was recorded here."""
    recorded, steps = _load(campaign, store)
    if point is None:
        return recorded, steps
    try:
        return recorded.at_operating_point(point), steps
    except ValueError as error:
        raise InputError(f"--operating-point: {error}") from error


def _load(campaign: str, store: Path | None) -> "tuple[Campaign, list[dict[str, Any]]]":
    from daq.importers import open_campaign
    from daq.service.analysis_work import steps_in
    from identify.load import load_campaign

    # A folder is analysed as it lies there: it does not enter the store by being looked at.
    if Path(campaign).is_dir():
        folder = open_campaign(campaign)
        return load_campaign(folder), steps_in(folder)
    with open_store(store) as source:
        folder = open_campaign(campaign, source)
        return load_campaign(folder), steps_in(folder)


def identify(
    campaign: CampaignArgument,
    json_: JsonOption = None,
    html: HtmlOption = None,
    store: StoreOption = None,
    model: Annotated[
        Path | None, typer.Option(help="Model declared in TOML, instead of the campaign's own.")
    ] = None,
    operating_point: PointOption = None,
) -> None:
    """Fit the declared model to a campaign."""
    from identify.declare import described, read_model
    from identify.identification import identify as run

    structure = None if model is None else read_model(model)
    recorded, steps = load(campaign, store, operating_point)
    if structure is not None:
        recorded = replace(recorded, declared_model=described(structure))
    quiet = str(json_) == "-"
    with progress_bar(quiet) as tell:
        found = run(recorded, structure=structure, progress=tell)
    if not quiet:
        show_identification(found)
        show_calibration(recorded)
    write_json(json_, found.to_json())
    if html is not None:
        from identify.report import write_html

        write_html(html, found, recorded, steps)
    if not found.assessment.fit.converged:
        raise typer.Exit(1)


def diagnose(
    campaign: CampaignArgument,
    json_: JsonOption = None,
    html: HtmlOption = None,
    store: StoreOption = None,
    processes: ProcessesOption = 0,
    operating_point: PointOption = None,
    within: Annotated[
        float | None,
        typer.Option(
            show_default=f"{LONGEST_SEARCH_S / 60:g}",
            help="Minutes, 0.1 at least, after which the search for a cause goes no further.",
        ),
    ] = None,
) -> None:
    """Trace what the declared model lacks: verdict, effect, error before and after."""
    from daq.importers.broadband import is_broadband

    if is_broadband(campaign):
        if operating_point is not None:
            raise InputError(
                f"operating_point={operating_point!r}: a broadband recording has none; leave it out"
            )
        if within is not None:
            raise InputError(f"within={within:g}: a broadband search has no limit; leave it out")
        with progress_bar(str(json_) == "-") as tell:
            traced = broadband.diagnose(campaign, tell)
        if str(json_) != "-":
            broadband.show(traced)
        write_json(json_, traced.to_json())
        if html is not None:
            broadband.report(html, traced)
        return
    from identify.diagnosis import diagnose as run
    from identify.executor import executor

    if within is not None and not within >= 0.1:
        raise InputError(f"within={within}: give a number of minutes above zero, 0.1 at least")
    within_s = LONGEST_SEARCH_S if within is None else 60 * within
    recorded, steps = load(campaign, store, operating_point)
    quiet = str(json_) == "-"
    with executor(processes) as workers, progress_bar(quiet) as tell:
        found = run(recorded, progress=tell, executor=workers, within_s=within_s)
    if not quiet:
        show_diagnosis(found)
        show_calibration(recorded)
    write_json(json_, found.to_json())
    if html is not None:
        from identify.report import write_html

        write_html(html, found, recorded, steps)
    if not Path(campaign).is_dir():
        with open_store(store) as target:
            target.set_status(campaign, verdict=found.verdict)


def show_calibration(recorded: "Campaign") -> None:
    """Print what is missing or stale of the channels' calibration."""
    for text in recorded.calibration_remarks:
        out.print(f"calibration: {text}", markup=False)


def show_identification(found: "Identification") -> None:
    """Print an identification."""
    a = found.assessment
    if not a.fit.converged:
        out.print(
            f"the fit did not converge: {a.fit.reason}. Look at what is said of the recordings; "
            "`entrain diagnose` seeks what the declared model lacks.",
            markup=False,
        )
        show_quality(found)
        return
    show_parameters("parameters", a.parameters)
    show_errors(found)
    show_validation(found)
    show_quality(found)


def show_errors(found: "Identification | Diagnosis") -> None:
    """Print errors and the free limit cycle, before and after where there are two models."""
    from identify.report import sections

    heads = [name for name, _ in sections.columns(found)]
    table(sections.errors_title(found), ("", *heads), sections.error_rows(found))
    if rows := sections.cycle_rows(found):
        table("", sections.CYCLE_HEAD, rows)


def show_validation(found: "Identification") -> None:
    """Print what the model says of what it was not fitted to, and how sure its parameters are."""
    from identify.report import sections

    a = found.assessment
    if rows := sections.lock_in_rows(a):
        table("the model's own lock-in boundary", sections.LOCK_IN_HEAD, rows)
    if rows := sections.prediction_rows(a):
        table("predictions", sections.PREDICTION_HEAD, rows)
    if rows := sections.residual_test_rows(a):
        table("what the fit leaves", sections.RESIDUAL_TEST_HEAD, rows)
    notes = sections.interval_notes(found)
    notes += [f"not determined by these data: {text}" for text in found.undetermined]
    for note in notes:
        out.print(note, markup=False)


def show_parameters(title: str, parameters: "Mapping[str, Estimate]") -> None:
    """Print values with standard errors."""
    from identify.report.words import unit, with_error

    table(
        title,
        ("parameter", "value", "standard error", "unit"),
        ((name, *with_error(e), unit(e.unit)) for name, e in parameters.items()),
    )


def show_diagnosis(found: "Diagnosis") -> None:
    """Print errors before and after, the candidates, the verdict."""
    from identify.report.words import percent

    show_errors(found)
    if found.candidates:
        table(
            "candidates, best first",
            ("effects", "where", "χ²/dof", "validation", "objection"),
            (
                (
                    *in_lines(c),
                    number(c.chi2_per_dof, 3),
                    percent(c.validation_error),
                    c.objection or c.note,
                )
                for c in found.candidates[:8]
            ),
        )
    show_quality(found)
    out.print(f"[bold]verdict: {found.verdict}[/bold]   ({found.seconds:.1f} s)")
    for effect in found.effects:
        form = f", {effect.form}" if effect.form else ""
        if found.verdict == "ambiguous" and effect.effect != "interference":
            form += ", if it is that"
        show_parameters(f"{effect.effect}{form} ({effect.location})", effect.parameters)
    if found.explanation:
        out.print(found.explanation, markup=False)
    if found.next_experiment:
        out.print(f"next experiment: {found.next_experiment['reason']}", markup=False)
        out.print("run it: --json FILE, then `entrain campaign run FILE`", markup=False)
    elif any(q.flag == "contradicts_alone" for q in found.quality):
        out.print("next experiment: record the doubted run again")
    elif found.verdict == "ambiguous" or found.whereabouts is not None:
        out.print("next experiment: none is proposed")


def in_lines(c: "Candidate") -> tuple[str, str]:
    """Effects and their places, line by line: several in a row would leave the numbers no room."""
    effects = " +\n".join(c.named).replace(":", ":\n  ").split("\n")
    places = iter(c.locations)
    where = ["" if line.startswith(" ") else next(places) for line in effects]
    return "\n".join(effects), "\n".join(where)


def show_quality(found: "Identification | Diagnosis") -> None:
    """Print what is wrong with recordings, if anything is; what is alike in several runs once."""
    alike: dict[tuple[str, ...], list[QualityFlag]] = {}
    for q in found.quality:
        said, _, last = q.detail.rpartition(";")
        alike.setdefault((q.flag, q.severity, re.sub(r"[\d.]+", "#", said), last), []).append(q)
    if alike:
        table(
            "data quality",
            ("run", "flag", "detail", "consequence"),
            (
                (
                    first.run + (f"\nand {len(others)} more" if others else ""),
                    first.flag,
                    first.detail,
                    first.severity,
                )
                for first, *others in alike.values()
            ),
        )


def characterise(
    file: Annotated[
        Path, typer.Argument(help="A recording of an oscillation that nothing forces.")
    ],
    signal: Annotated[
        str | None, typer.Option(help="Channel to characterise; else the pressure.")
    ] = None,
    name: Annotated[
        list[str] | None, typer.Option(help="Name of each signal column, in order.")
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option(help="Sample rate where the file has none.", callback=positive)
    ] = None,
    json_: JsonOption = None,
    figure: FigureOption = None,
) -> None:
    """Regime, frequency, amplitude, harmonics, growth rate of an unforced oscillation."""
    from daq.service.words import read_unforced
    from identify.characterise import characterise_recording, primary
    from identify.characterise import figure as draw

    recording = read_unforced(file, name or [], rate_hz)
    try:
        found = characterise_recording(recording, signal)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from error
    if str(json_) != "-":
        show_characterisation(found.to_json())
    write_json(json_, found.to_json())
    if figure is not None:
        chosen = primary(recording, signal)
        draw(found, recording.signals[chosen], figure, title=f"{file.name}, {chosen}")


def show_characterisation(found: dict[str, Any]) -> None:
    """Print a characterisation."""

    from identify.parameters import Estimate
    from identify.report.words import estimate

    def pair(value: dict[str, Any] | None, unit: str) -> str:
        if value is None:
            return "–"
        stderr = math.nan if value["stderr"] is None else value["stderr"]
        return estimate(Estimate(value["value"], stderr, unit))

    rows = [
        ("signal", found["signal"]),
        ("regime", found["regime"]),
        ("frequency", pair(found["frequency_hz"], "Hz")),
        ("amplitude", pair(found["amplitude"], found["amplitude"]["unit"])),
        ("harmonics (dB)", "  ".join(f"{level:.1f}" for level in found["harmonics_db"])),
        ("growth rate", pair(found["growth_rate_per_s"], "1/s")),
        *((f"phase of {k}", pair(v, "°")) for k, v in found["phase_deg"].items()),
    ]
    table("", ("", ""), rows)
    for note in found["notes"]:
        out.print(f"note: {note}", markup=False)
