"""The closed loop on a rig that is open: what `daq.closeloop` asks for, done with the run store.

Everything a loop leaves lies in the store: its campaigns, in each one's folder the diagnosis
(`diagnosis.json`), and in the first one's the account of the whole (`loop.json`).
"""

import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from daq.campaign import Event, run_campaign
from daq.closeloop import Budget, Closed, Recorded, Round, Steps, close_loop
from daq.events import Control, OnEvent
from daq.journal import read_journal
from daq.plan import Plan, parse_plan
from daq.records import RunSummary
from daq.schedule import elapsed
from daq.service import LONGEST_SEARCH_S
from daq.service.analysis_work import steps_in
from daq.service.campaign_names import begun_with
from daq.service.designing import resolved
from daq.service.dry_run import dry_run
from daq.service.jobs import Link
from daq.service.laid import laid_over, noted, over
from daq.service.observed import observe
from daq.service.plain import plain
from daq.service.rig_work import Helm, describe
from daq.service.rigs import RigEntry, open_rig
from daq.store import RunStore, write_json
from daq.store_file import read_summary
from daq.supervise import end_asked
from drivers.protocols import DuplexRig
from identify.diagnosis import diagnose
from identify.load import load_campaign
from identify.report import write_html
from identify.results import Diagnosis
from identify.trace import Cancelled

Progress = Callable[[float, str], None]


class RigSteps:
    """`daq.closeloop.Steps` on an open rig and a store.

    `control` is heeded between windows and asked during a diagnosis: when it raises
    `StopRequested`, the loop ends, and can go on later. `rig_options` are as of `daq.service.laid`.
    """

    def __init__(
        self,
        rig: DuplexRig,
        store: RunStore,
        control: Control,
        on_event: OnEvent | None = None,
        progress: Progress | None = None,
        rig_options: Mapping[str, Any] | None = None,
    ) -> None:
        self._rig = rig
        self._store = store
        self._control = control
        self._rig_options = dict(rig_options or {})
        self.on_event = on_event
        self.progress = progress
        self.last: Diagnosis | None = None

    def run(self, run: str) -> RunSummary:
        return read_summary(self._store.run_path(run), run.partition("/")[0])

    def expected_seconds(self, plan: Plan) -> float:
        rig = self._rig
        report = dry_run(plan, rig.limits, rig.sample_rate_hz, list(rig.channels))
        return float(report["rig_seconds"])

    def record(self, campaign: str, plan: Plan) -> Recorded:
        begun = (self._store.campaigns_dir / campaign / "campaign.json").is_file()
        status, reason = "complete", ""
        if not begun or self._store.card(campaign).status != "complete":
            result = run_campaign(
                self._rig,
                plan,
                self._store,
                self.on_event,
                control=self._control,
                campaign=campaign if begun else None,
                campaign_id="" if begun else campaign,
                notes=noted(self._rig_options),
            )
            status, reason = result.status, result.reason
        lines = read_journal(self._store.campaign_dir(campaign) / "journal.jsonl")
        seconds = elapsed(lines) - float(lines[0]["time_s"])
        return Recorded(status, reason, seconds, len(self._store.campaign_runs(campaign)))

    def diagnose(self, campaign: str) -> dict[str, Any] | None:
        folder = self._store.campaign_dir(campaign)
        path = folder / "diagnosis.json"
        if path.is_file():
            known: dict[str, Any] = json.loads(path.read_text("utf-8"))
            return known
        recorded = load_campaign(folder)
        try:
            found = diagnose(
                recorded,
                progress=self.progress,
                cancel=self._cancelled,
                within_s=LONGEST_SEARCH_S,
            )
        except Cancelled:
            return None
        self.last = found
        answer: dict[str, Any] = plain(found.to_json())
        write_json(path, answer)
        self._store.set_status(campaign, verdict=found.verdict)
        return answer

    def _cancelled(self) -> bool:
        return end_asked(self._control) is not None  # there is no condition to skip


def turn(
    name: str,
    plan: Plan,
    steps: Steps,
    store: RunStore,
    budget: Budget,
    tell: Callable[[Round], None] = lambda done: None,
) -> Closed:
    """`close_loop`, its account kept in the first campaign's folder."""
    closed = close_loop(name, plan, steps, budget, tell)
    if closed.rounds:
        write_json(store.campaign_dir(name) / "loop.json", closed.to_json())
    return closed


def sentence(done: Round) -> str:
    """A round in one line."""
    what = f": {', '.join(done.effects)}" if done.effects else ""
    return (
        f"round {done.number}: {done.verdict}{what}; {done.runs} runs, "
        f"{done.rig_seconds / 60:.1f} min of rig time"
    )


def work(
    link: Link,
    rig: dict[str, Any],
    store: str,
    plan: dict[str, Any],
    name: str,
    rounds: int,
    rig_minutes: float,
    report: str,
    resume: bool = False,
) -> dict[str, Any]:
    """A loop as a job of the service; returns its account (close-loop/1)."""
    budget = Budget(rounds, rig_minutes)
    with contextlib.closing(RunStore(Path(store))) as runs:
        entry = RigEntry(**rig)
        laid = laid_over(entry, {}, runs, name if resume else None)
        wanted = begun_with(runs, name) if resume else _ready(plan, runs, link)
        device = open_rig(over(entry, laid))
        with observe(device, link.event) as watched:
            helm = Helm(link, device)
            progress = Teller(link, budget)
            steps = RigSteps(
                watched, runs, helm.heed, progress.event, progress.diagnosis, rig_options=laid
            )
            closed = turn(name, wanted, steps, runs, budget, progress.round)
        write_report(Path(report), steps.last, runs)
    return closed.to_json()


def _ready(plan: dict[str, Any], runs: RunStore, link: Link) -> Plan:
    """The plan with the conditions of its design, chosen before the rig is opened."""
    return resolved(
        parse_plan(plan), runs, lambda share, text: link.progress(0.0, f"design: {text}")
    )


def write_report(path: Path, last: Diagnosis | None, store: RunStore) -> None:
    """The HTML report of the last diagnosis that was made; nothing where none was."""
    if last is None:
        return
    folder = store.campaign_dir(last.campaign)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_html(path, last, load_campaign(folder), steps_in(folder))


class Teller:
    """Passes a loop's events on, with progress in rounds."""

    def __init__(self, link: Link, budget: Budget) -> None:
        self._link = link
        self._rounds = budget.rounds
        self._done = 0

    def event(self, event: Event) -> None:
        data = {"kind": event.kind, "index": event.index, "time_s": event.time_s}
        self._link.event("campaign", {**data, "data": event.data}, None)
        if event.kind != "window":
            self._link.progress(self._done / self._rounds, describe(event))

    def diagnosis(self, share: float, text: str) -> None:
        self._link.progress((self._done + share) / self._rounds, f"diagnosis: {text}")

    def round(self, done: Round) -> None:
        self._done = done.number
        self._link.log(sentence(done))
