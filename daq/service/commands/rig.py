"""`entrain campaign run`, `dry-run` and `resume`: a campaign in this process, in this terminal."""

import contextlib
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from daq.service.commands.common import (
    JsonOption,
    StoreOption,
    config_file,
    number,
    open_store,
    out,
    positive,
    table,
    write_json,
)

if TYPE_CHECKING:
    from daq.campaign import CampaignResult, Event
    from daq.plan import Plan
    from daq.service.rigs import RigEntry

RigOption = Annotated[
    str | None, typer.Option("--rig", help="Configured rig; the only one where there is one.")
]
PlanArgument = Annotated[
    Path | None, typer.Argument(help="Plan (.toml or .json); else the default plan.")
]
SeedOption = Annotated[int | None, typer.Option(help="Seed, for a simulated rig.")]

HANG_UP: "signal.Signals | None" = getattr(signal, "SIGHUP", None)
RING_DOWN_S = 5.0  # a tube whose flame went out


def choose_rig(name: str | None) -> "RigEntry":
    """The configured rig of that name, or the only one."""
    from daq.service.rigs import Rigs
    from daq.service.settings import ConfigError, load

    settings = load(config_file())
    rigs = Rigs(settings.rigs, settings.data_dir / "rigs.json")
    names = rigs.names()
    if name is None and len(names) == 1:
        name = names[0]
    entry = rigs.get(name) if name else None
    if entry is None:
        raise ConfigError(f"--rig={name!r} is not one of the configured rigs: {', '.join(names)}")
    return entry


def read(plan: Path | None) -> "Plan":
    """The plan in a file, or the default one."""
    from daq.plan import parse_plan, read_plan

    return parse_plan({}) if plan is None else read_plan(plan)


def ready(plan: "Plan", store: Path | None) -> "Plan":
    """The plan with the conditions of its design, where it has one."""
    if plan.design is None:
        return plan
    from daq.service.commands.analysis import progress_bar
    from daq.service.designing import resolved

    with open_store(store) as source, progress_bar(quiet=False) as tell:
        return resolved(plan, source, tell)


def run(
    plan: PlanArgument = None,
    rig: RigOption = None,
    seed: SeedOption = None,
    store: StoreOption = None,
    json_: JsonOption = None,
) -> None:
    """Run a campaign on a rig. Keys: p pauses, s skips, q or Ctrl-C ends; `resume` goes on."""
    given = {} if seed is None else {"seed": seed}
    _campaign(ready(read(plan), store), choose_rig(rig), given, store, None, json_)


def resume(
    campaign: Annotated[str, typer.Argument(help="Campaign id.")],
    rig: RigOption = None,
    seed: SeedOption = None,
    store: StoreOption = None,
    json_: JsonOption = None,
) -> None:
    """Go on with a campaign that was stopped or interrupted."""
    from daq.service.campaign_names import begun_with
    from daq.service.laid import laid_over

    given = {} if seed is None else {"seed": seed}
    with open_store(store) as source:
        plan = begun_with(source, campaign)
        entry = choose_rig(rig or source.card(campaign).rig)
        laid = laid_over(entry, given, source, campaign)
    _campaign(plan, entry, laid, store, campaign, json_)


def rehearse(
    plan: PlanArgument = None,
    rig: RigOption = None,
    free_hz: Annotated[
        float | None,
        typer.Option(help="Limit cycle, to show relative frequencies.", callback=positive),
    ] = None,
    store: StoreOption = None,
    json_: JsonOption = None,
) -> None:
    """Show what a campaign would do, its limits, rig time and precision; moves nothing."""
    from daq.service.dry_run import dry_run, require_possible
    from daq.service.rig_work import reviewer_of
    from daq.service.rigs import open_rig
    from drivers.protocols import operating_ranges

    wanted = ready(read(plan), store)
    reviewer_of(wanted)  # refuses a precision of what is no parameter
    expected = precision(wanted, store)
    with open_rig(choose_rig(rig)) as device:
        report = dry_run(
            wanted,
            device.limits,
            device.sample_rate_hz,
            list(device.channels),
            free_hz,
            operating_ranges(device),
            expected,
        )
    write_json(json_, report)
    if str(json_) != "-":
        table(
            f"{report['title']}: {report['runs']} runs, about {report['rig_seconds']:.0f} s of rig "
            f"time, at most {report['limit_v']:g} V",
            ("#", "at", "kind", "role", "f (Hz)", "offset", "V", "× threshold", "problem"),
            (
                (
                    row["index"],
                    _place(row["operating_point"]),
                    row["kind"],
                    row["role"],
                    number(row["frequency_hz"], 6),
                    number(row["offset"]),
                    number(row["amplitude_v"]),
                    number(row["over_threshold"]),
                    row["problem"],
                )
                for row in report["conditions"]
            ),
        )
    if expected and str(json_) != "-":
        table(
            "expected precision",
            ("parameter", "value", "standard error now", "expected", "unit"),
            (
                (
                    row["name"],
                    number(row["value"], 6),
                    number(row["stderr"], 2),
                    number(row["expected_stderr"], 2),
                    row["unit"],
                )
                for row in expected
            ),
        )
    require_possible(report)


def precision(plan: "Plan", store: Path | None) -> "list[dict[str, Any]]":
    """What the plan would leave of each parameter's standard error, where something is known."""
    if plan.design is None and plan.continues is None:
        return []
    from daq.service.designing import expected_precision

    with open_store(store) as source:
        return expected_precision(plan, source)


def _place(point: "dict[str, float] | None") -> str:
    return "" if point is None else ", ".join(f"{k} {v:g}" for k, v in point.items())


class CampaignView:
    """A progress bar, and a line for every condition that is done."""

    def __init__(self, plan: "Plan", quiet: bool = False) -> None:
        from daq.campaign import expand

        self._progress = Progress(
            TextColumn("{task.description:<52}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=out,
            disable=quiet,
        )
        self._quiet = quiet
        self._bar = self._progress.add_task("starting", total=len(expand(plan)))

    def __enter__(self) -> "CampaignView":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def tell(self, event: "Event") -> None:
        """`run_campaign`'s `on_event`."""
        with contextlib.suppress(OSError):  # a terminal that is gone; its hang-up ends the campaign
            self._show(event)

    def _show(self, event: "Event") -> None:
        from daq.service.rig_work import describe

        if event.kind == "window":
            data = event.data
            text = (
                f"{data['frequency_hz']:.2f} Hz  {data['drive_v']:.3g} V  "
                f"limit cycle {data['suppression_db']:+.1f} dB  {data['phase']}"
            )
            self._progress.update(self._bar, description=text)
            return
        if event.kind == "started":
            self._progress.update(self._bar, completed=len(event.data.get("done", ())))
        done = event.kind in ("recorded", "not_entrained", "skipped")
        self._progress.update(self._bar, advance=1 if done else 0, description=describe(event))
        telling = (
            "operating_point",
            "review",
            "free",
            "entrained",
            "not_entrained",
            "skipped",
            "failed",
        )
        if event.kind in telling and not self._quiet:
            self._progress.console.print(describe(event), markup=False)


def _campaign(
    plan: "Plan",
    entry: "RigEntry",
    laid: "dict[str, Any]",
    store: Path | None,
    campaign: str | None,
    json_: Path | None,
) -> None:
    from daq.campaign import run_campaign
    from daq.service.commands.keyboard import HELP, Keyboard, single_keys
    from daq.service.dry_run import dry_run, require_possible
    from daq.service.laid import noted, over
    from daq.service.rig_work import reviewer_of, summary
    from daq.service.rigs import open_rig
    from drivers.protocols import operating_ranges

    stop: list[int] = []
    quiet = str(json_) == "-"
    with (
        open_store(store) as target,
        open_rig(over(entry, laid)) as device,
        interruptible(stop),
        single_keys() as typed,
        CampaignView(plan, quiet) as view,
    ):
        if campaign is None:
            limits, rate, channels = device.limits, device.sample_rate_hz, list(device.channels)
            ranges = operating_ranges(device)
            require_possible(dry_run(plan, limits, rate, channels, operating=ranges))
        if typed is not None and not quiet:
            out.print(HELP, markup=False)
        result = run_campaign(
            device,
            plan,
            target,
            view.tell,
            control=Keyboard(device, typed, stop).heed,
            review=reviewer_of(plan),
            campaign=campaign,
            notes=noted(laid),
        )
    write_json(json_, summary(result))
    if str(json_) != "-":
        show_result(result)
    if result.status != "complete":
        raise typer.Exit(1)


@contextmanager
def interruptible(pressed: list[int]) -> Iterator[None]:
    """Ctrl-C, SIGTERM and a terminal that hangs up fill the list instead of ending the process; a
    second Ctrl-C raises. A hang-up that `nohup` ignores stays ignored."""
    terminals = [fd for fd in (0, 1, 2) if os.isatty(fd)]

    def handle(number_: int, frame: FrameType | None) -> None:
        if number_ == signal.SIGINT and pressed:
            raise KeyboardInterrupt
        if number_ == HANG_UP:
            _leave(terminals)
        pressed.append(number_)

    heard = [signal.SIGINT, signal.SIGTERM]
    if HANG_UP is not None and signal.getsignal(HANG_UP) != signal.SIG_IGN:
        heard.append(HANG_UP)
    before = {one: signal.signal(one, handle) for one in heard}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _leave(terminals: list[int]) -> None:
    """What is still to be said goes nowhere: writing to a terminal that is gone is an error."""
    with open(os.devnull, "r+b") as nowhere:
        for descriptor in terminals:
            os.dup2(nowhere.fileno(), descriptor)


def show_result(result: "CampaignResult") -> None:
    """Print how a campaign ended."""
    table(
        "",
        ("#", "kind", "f (Hz)", "V", "threshold (V)", "limit cycle (dB)", "outcome", "reason"),
        (
            (
                row["index"],
                row["kind"],
                number(row["frequency_hz"], 6),
                number(row["amplitude_v"]),
                number(row["threshold_v"]),
                number(row["suppression_db"]),
                row["status"],
                row["reason"],
            )
            for row in map(asdict, result.outcomes)
        ),
    )
    reason = f" ({result.reason})" if result.reason else ""
    out.print(
        f"campaign {result.id}: {result.status}{reason}, {result.rig_seconds:.0f} s of rig time",
        markup=False,
    )


def devices(json_: Annotated[bool, typer.Option("--json", help="As JSON.")] = False) -> None:
    """List what is plugged in, and what is missing to see more."""
    import json

    from drivers.discovery import discover

    found = [asdict(device) for device in discover()]
    if json_:
        typer.echo(json.dumps(found, indent=1))
        return
    table(
        "",
        ("family", "device", "address", "capabilities", "missing"),
        (
            (
                d["family"],
                d["name"],
                d["address"],
                ", ".join(f"{key} {value}" for key, value in d["capabilities"].items()),
                d["missing"],
            )
            for d in found
        ),
    )
    if not found:
        out.print("nothing is plugged in; the simulated rig needs nothing")


def check(
    rig: Annotated[str | None, typer.Argument(help="Configured rig.")] = None,
    level_v: Annotated[
        float | None,
        typer.Option(help="Highest drive; else 2 % of the rig's limit.", callback=positive),
    ] = None,
    frequency_hz: Annotated[
        float, typer.Option(help="Frequency of the test tone.", callback=positive)
    ] = 170.0,
) -> None:
    """Look at a rig harmlessly, flame off: noise, margins, drive steps, round trip, silence."""
    from daq.campaign import FlameSwitch
    from daq.service.rigs import open_rig
    from drivers.check import check_rig

    with open_rig(choose_rig(rig)) as device:
        if isinstance(device, FlameSwitch):
            device.flame_off()
            device.clock.sleep(RING_DOWN_S)
        level = level_v or 0.02 * device.limits.max_amplitude_v
        found = check_rig(device, level, frequency_hz)
    marks = {True: "[green]good[/]", False: "[red]bad[/] ", None: "    "}
    for one in found:
        said = escape(f"{one.name:<28} {number(one.value)} {one.unit:<6} {one.text}")
        out.print(f"{marks[one.ok]} {said}", soft_wrap=True)
    if any(one.ok is False for one in found):
        raise typer.Exit(1)
