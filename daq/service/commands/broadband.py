"""`entrain diagnose` of a campaign with broadband excitation."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from daq.errors import InputError
from daq.service.commands.common import number, out, table

if TYPE_CHECKING:
    from identify.broadband import BroadbandDiagnosis


def diagnose(folder: str, progress: Callable[[float, str], None]) -> "BroadbandDiagnosis":
    """Add effects to the declared oscillator as long as the residual asks for them."""
    from daq.importers.broadband import read_broadband
    from identify.broadband import Lines, diagnose_broadband

    record = read_broadband(folder)
    lines = None
    if record.period_samples is not None and record.period_starts:
        lines = Lines(record.period_starts, record.period_samples)
    try:
        return diagnose_broadband(
            record.drive,
            record.response,
            record.sample_rate_hz,
            declared=record.feedback,
            estimation=record.estimation,
            test=record.test,
            lines=lines,
            noise=record.noise,
            title=record.title,
            units=record.units,
            progress=progress,
        )
    except ValueError as error:  # stretches and samples that cannot be used
        raise InputError(f"{folder}: {error}") from error


def report(path: Path, found: "BroadbandDiagnosis") -> None:
    """Write the HTML report."""
    from identify.report.broadband import write_broadband_html

    write_broadband_html(path, found)


def show(found: "BroadbandDiagnosis") -> None:
    """Print the errors term by term, what each term is worth, and the verdict with its evidence."""
    from identify.report.broadband import WEIGHED_HEAD, evidence, headline, weighed_rows

    kept = [name for name in ("odd_excited", "even") if name in found.stages[0].lines_rms]
    table(
        f"simulation error, RMS ({found.unit})",
        ("model", "parameters", "estimation", "test", *(f"{n.split('_')[0]} lines" for n in kept)),
        [
            (
                found.declared if s.added is None else f"+ {s.added.candidate.kind}",
                s.fit.theta.size,
                number(s.fit_rms, 4),
                number(s.test_rms, 4),
                *(number(s.lines_rms[name], 3) for name in kept),
            )
            for s in found.stages
        ],
    )
    table(
        "what was added, and what exceeds the noise without it", WEIGHED_HEAD, weighed_rows(found)
    )
    for flag in found.quality:
        out.print(f"{flag.flag} ({flag.severity}): {flag.detail}", markup=False)
    out.print(f"{headline(found)} ({found.seconds:.0f} s)", markup=False)
    for line in evidence(found):
        out.print(f"  {line}", markup=False)
    following = found.to_json()["next_experiment"]
    if following is not None:
        out.print(f"next experiment: {following['excitation']}: {following['why']}", markup=False)
