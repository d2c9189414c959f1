"""`entrain import`, `entrain store`, `entrain campaign list` and `show`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer
from rich.markup import escape

from daq.service.commands.common import (
    StoreOption,
    number,
    open_store,
    out,
    positive,
    table,
    writable,
)

if TYPE_CHECKING:
    from daq.records import CampaignCard
    from daq.store import RunStore
    from daq.store_upkeep import Finding

store_app = typer.Typer(
    help="The run store: rebuild, recover, verify, export.", no_args_is_help=True
)


def import_(
    ctx: typer.Context,
    path: Annotated[Path, typer.Argument(help="Campaign folder, or a single recording.")],
    more: Annotated[
        list[Path] | None, typer.Argument(help="Further folders, or recordings of one campaign.")
    ] = None,
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
        float | None, typer.Option(help="Sample rate where the file has none.", callback=positive)
    ] = None,
    kind: Annotated[str, typer.Option(help="free, forced or cold.")] = "free",
    frequency_hz: Annotated[float | None, typer.Option(help="Forcing frequency.")] = None,
    amplitude_v: Annotated[float | None, typer.Option(help="Forcing amplitude.")] = None,
) -> None:
    """Bring recordings made elsewhere into the run store."""
    from daq.importers import import_folder, import_recordings
    from daq.service.words import recording_options

    paths = [path, *(more or [])]
    if _are_folders(paths):
        _require_no_options(ctx, path)
        with open_store(store) as target:
            for folder in paths:
                _tell(target, import_folder(folder, target))
        return
    options = recording_options(
        channel or [], column or [], rate_hz, kind, frequency_hz, amplitude_v
    )
    with open_store(store) as target:
        _tell(target, import_recordings(paths, options, target, title))


def _are_folders(paths: list[Path]) -> bool:
    """Whether all are folders; refuses what is missing, and folders beside files."""
    from daq.errors import InputError

    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
    folders = [path for path in paths if path.is_dir()]
    files = [path for path in paths if not path.is_dir()]
    if folders and files:
        raise InputError(
            f"{folders[0]} is a campaign folder and {files[0]} a single recording: "
            "import folders and recordings separately"
        )
    return bool(folders)


def _require_no_options(ctx: typer.Context, folder: Path) -> None:
    """Refuse the options of single recordings: a folder's campaign.toml says all that they say."""
    from daq.errors import InputError

    given = [
        f"--{name.replace('_', '-')}"
        for name in ctx.params
        if name not in ("path", "more", "store")
        and (source := ctx.get_parameter_source(name)) is not None
        and source.name == "COMMANDLINE"
    ]
    if given:
        raise InputError(
            f"{folder}: {', '.join(given)}: only for single recordings; the campaign.toml of a "
            "folder says what they say"
        )


def _tell(store: "RunStore", card: "CampaignCard") -> None:
    out.print(f"imported [bold]{escape(card.id)}[/bold]: {len(store.campaign_runs(card.id))} runs")


def list_campaigns(
    store: StoreOption = None,
    verdict: Annotated[str | None, typer.Option(help="Only campaigns of this verdict.")] = None,
    limit: Annotated[int, typer.Option(min=1, max=1000)] = 50,
    after: Annotated[str | None, typer.Option(help="Continue behind this id.")] = None,
) -> None:
    """List the campaigns of the run store."""
    from daq.errors import InputError
    from daq.records import Verdict

    if verdict is not None and verdict not in get_args(Verdict):
        raise InputError(f"--verdict={verdict!r} is not one of {', '.join(get_args(Verdict))}")
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
    out.print(f"[bold]{escape(card.id)}[/bold]  {escape(card.title)}")
    out.print(
        f"rig {card.rig or '–'}, created {card.created_at}, status {card.status}", markup=False
    )
    out.print(f"verdict {card.verdict or 'not diagnosed yet'}", markup=False)
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
        out.print(f"[yellow]left out:[/yellow] {escape(problem)}")
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
    target: Annotated[Path, typer.Argument(help="The zip file to write.", callback=writable)],
    store: StoreOption = None,
) -> None:
    """Write a campaign as one zip with a manifest of checksums."""
    from daq.store_upkeep import export_campaign

    with open_store(store) as source:
        made = export_campaign(source, campaign, target)
    out.print(f"wrote {made.path}", markup=False)
    for problem in made.problems:
        out.print(f"[yellow]not as it should be:[/yellow] {escape(problem)}")
    if made.problems:
        raise typer.Exit(1)


def _show(findings: "list[Finding]", fine: str) -> None:
    if not findings:
        out.print(fine)
        return
    table("", ("what", "file", "detail"), ((f.kind, f.path, f.detail) for f in findings))
