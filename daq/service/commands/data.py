"""`entrain import`, `entrain store`, `entrain campaign list` and `show`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.service.commands.common import StoreOption, number, open_store, out, table

if TYPE_CHECKING:
    from daq.store_upkeep import Finding

store_app = typer.Typer(
    help="The run store: rebuild, recover, verify, export.", no_args_is_help=True
)


def import_(
    path: Annotated[Path, typer.Argument(help="Campaign folder, or a single recording.")],
    more: Annotated[list[Path] | None, typer.Argument(help="Further recordings.")] = None,
    store: StoreOption = None,
    title: Annotated[str, typer.Option(help="Title, for single recordings.")] = "",
    channel: Annotated[
        list[str] | None,
        typer.Option(
            help="A channel of single recordings, in order: "
            "name:quantity:unit:volts_per_unit[:position_m], e.g. p1:pressure:Pa:0.0018:0.6"
        ),
    ] = None,
    column: Annotated[
        list[str] | None, typer.Option(help="Column number (from 0) or name of each channel.")
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option(help="Sample rate where the file has none.")
    ] = None,
    kind: Annotated[str, typer.Option(help="free, forced or cold.")] = "free",
    frequency_hz: Annotated[float | None, typer.Option(help="Forcing frequency.")] = None,
    amplitude_v: Annotated[float | None, typer.Option(help="Forcing amplitude.")] = None,
) -> None:
    """Bring recordings made elsewhere into the run store."""
    from daq.errors import InputError
    from daq.importers import import_folder, import_recordings
    from daq.service.words import recording_options

    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    with open_store(store) as target:
        if path.is_dir():
            card = import_folder(path, target)
        else:
            options = recording_options(
                channel or [], column or [], rate_hz, kind, frequency_hz, amplitude_v
            )
            card = import_recordings([path, *(more or [])], options, target, title)
        runs = target.campaign_runs(card.id)
    out.print(f"imported [bold]{card.id}[/bold]: {len(runs)} runs")


def list_campaigns(
    store: StoreOption = None,
    verdict: Annotated[str | None, typer.Option(help="Only campaigns of this verdict.")] = None,
    limit: Annotated[int, typer.Option(min=1, max=1000)] = 50,
    after: Annotated[str | None, typer.Option(help="Continue behind this id.")] = None,
) -> None:
    """List the campaigns of the run store."""
    with open_store(store) as source:
        rows = source.campaigns(after=after, limit=limit, verdict=verdict)
    if not rows:
        out.print("no campaigns; `entrain demo` makes one, `entrain import` brings one in")
        return
    table(
        "",
        ("id", "title", "rig", "created", "status", "verdict"),
        ((r.id, r.title, r.rig, r.created_at, r.status, r.verdict) for r in rows),
    )


def show_campaign(
    campaign: Annotated[str, typer.Argument(help="Campaign id or campaign folder.")],
    store: StoreOption = None,
) -> None:
    """Show a campaign's card and runs."""
    from daq.importers import open_campaign
    from daq.store import read_card
    from daq.store_file import read_summary

    with open_store(store) as source:
        folder = open_campaign(campaign, source)
        card = read_card(folder / "campaign.json")
        runs = [read_summary(path, card.id) for path in sorted((folder / "runs").glob("*.h5"))]
    out.print(f"[bold]{card.id}[/bold]  {card.title}")
    out.print(f"rig {card.rig or '–'}, created {card.created_at}, status {card.status}")
    out.print(f"verdict {card.verdict or 'not diagnosed yet'}")
    table(
        "",
        ("run", "kind", "role", "f (Hz)", "amplitude (V)", "seconds", "exit"),
        (
            (
                r.name,
                r.kind,
                r.role,
                number(r.frequency_hz, 6),
                number(r.amplitude_v),
                number(r.samples / r.sample_rate_hz),
                f"{r.exit_status}: {r.exit_reason}" if r.exit_reason else r.exit_status,
            )
            for r in runs
        ),
    )


@store_app.command("rebuild")
def rebuild(store: StoreOption = None) -> None:
    """Make the catalogue anew from the run files."""
    with open_store(store) as target:
        problems = target.rebuild()
        count = sum(1 for _ in target.folders())
    for problem in problems:
        out.print(f"[yellow]left out:[/yellow] {problem}", markup=True)
    out.print(f"catalogue rebuilt: {count} campaigns, {len(problems)} files left out")
    if problems:
        raise typer.Exit(1)


@store_app.command("recover")
def recover(store: StoreOption = None) -> None:
    """Put the store in order after a crash: salvage, index, mark; nothing is deleted."""
    from daq.store_upkeep import recover as run

    with open_store(store) as target:
        findings = run(target)
    _show(findings, "nothing was out of order")


@store_app.command("verify")
def verify(
    campaign: Annotated[str | None, typer.Argument(help="Only this campaign.")] = None,
    store: StoreOption = None,
) -> None:
    """Read every run and compare it with the checksum of its recording."""
    from daq.store_upkeep import verify as run

    with open_store(store) as source:
        findings = run(source, campaign)
    _show(findings, "every run agrees with its checksum")
    if findings:
        raise typer.Exit(1)


@store_app.command("export")
def export(
    campaign: Annotated[str, typer.Argument(help="Campaign id.")],
    target: Annotated[Path, typer.Argument(help="The zip file to write.")],
    store: StoreOption = None,
) -> None:
    """Write a campaign as one zip with a manifest of checksums."""
    from daq.store_upkeep import export_campaign

    with open_store(store) as source:
        made = export_campaign(source, campaign, target)
    out.print(f"wrote {made}", markup=False)


def _show(findings: "list[Finding]", fine: str) -> None:
    if not findings:
        out.print(fine)
        return
    table("", ("what", "file", "detail"), ((f.kind, f.path, f.detail) for f in findings))
