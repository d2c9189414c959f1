"""`entrain close-loop`: campaign, diagnosis, next experiment, and again, in this terminal."""

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.service.commands.analysis import progress_bar, show_diagnosis
from daq.service.commands.common import (
    HtmlOption,
    JsonOption,
    StoreOption,
    finite,
    number,
    open_store,
    out,
    table,
    write_json,
)
from daq.service.commands.demo import show_truth
from daq.service.commands.rig import (
    CampaignView,
    PlanArgument,
    RigOption,
    SeedOption,
    choose_rig,
    interruptible,
    read,
    ready,
)

if TYPE_CHECKING:
    from daq.closeloop import Closed, Recorded, Round
    from daq.plan import Plan
    from daq.records import RunSummary
    from daq.service.loop_work import RigSteps

ENDINGS = {
    "traced": "what the model lacked is found",
    "adequate": "the declared model explains the data to within noise",
    "no_proposal": "the cause is open, and the diagnosis proposes no further experiment",
    "out_of_budget": "the budget is spent",
    "stopped": "stopped; `entrain close-loop --resume {name}` goes on",
}


class Shown:
    """Steps that show what they do: a bar a campaign, a bar a diagnosis."""

    def __init__(self, steps: "RigSteps", quiet: bool) -> None:
        self._steps = steps
        self._quiet = quiet

    def run(self, run: str) -> "RunSummary":
        return self._steps.run(run)

    def expected_seconds(self, plan: "Plan") -> float:
        return self._steps.expected_seconds(plan)

    def record(self, campaign: str, plan: "Plan") -> "Recorded":
        with CampaignView(plan, self._quiet) as view:
            self._steps.on_event = view.tell
            return self._steps.record(campaign, plan)

    def diagnose(self, campaign: str) -> dict[str, Any] | None:
        with progress_bar(self._quiet) as tell:
            self._steps.progress = tell
            return self._steps.diagnose(campaign)


def close_loop(
    plan: PlanArgument = None,
    rig: RigOption = None,
    seed: SeedOption = None,
    sealed: Annotated[
        bool,
        typer.Option(
            "--sealed", help="A simulated rig carries what --seed draws, told at the end."
        ),
    ] = False,
    rounds: Annotated[int, typer.Option(min=1, max=50, help="At most so many campaigns.")] = 4,
    minutes: Annotated[
        float, typer.Option(min=0.0, help="At most so much rig time.", callback=finite)
    ] = 60.0,
    resume: Annotated[
        str | None, typer.Option(help="Go on with the loop that began with this campaign.")
    ] = None,
    store: StoreOption = None,
    json_: JsonOption = None,
    html: HtmlOption = None,
) -> None:
    """Measure, diagnose, measure what tells most next, until the verdict stands. Ctrl-C ends."""
    from daq.campaign import StopRequested
    from daq.closeloop import Budget
    from daq.errors import InputError
    from daq.service import loop_work
    from daq.service.campaign_names import begun_with, new_name
    from daq.service.commands.keyboard import why_ended
    from daq.service.laid import laid_over, over
    from daq.service.rig_facts import truth
    from daq.service.rigs import SIMULATED, open_rig

    quiet = str(json_) == "-"

    def tell(done: "Round") -> None:
        if not quiet:
            out.print(loop_work.sentence(done), markup=False)

    stop: list[int] = []

    def heed() -> None:
        if stop:
            raise StopRequested(why_ended(stop))

    given: dict[str, Any] = {} if seed is None else {"seed": seed}
    if sealed:
        given["effects"] = "sealed"
    with open_store(store) as target:
        first = ready(read(plan), store) if resume is None else begun_with(target, resume)
        entry = choose_rig(rig or (target.card(resume).rig if resume else None))
        if sealed and entry.driver != SIMULATED:
            raise InputError(f"--sealed: rig {entry.name!r} is not a simulated one")
        laid = laid_over(entry, given, target, resume)
        entry = over(entry, laid)
        with open_rig(entry) as device, interruptible(stop):
            steps = loop_work.RigSteps(device, target, heed, rig_options=laid)
            name = resume or new_name(first.title)
            closed = loop_work.turn(
                name, first, Shown(steps, quiet), target, Budget(rounds, minutes), tell
            )
        if html is not None:
            loop_work.write_report(html, steps.last, target)
    write_json(json_, closed.to_json())
    if not quiet:
        if steps.last is not None:
            show_diagnosis(steps.last)
        show_rounds(closed)
        if laid.get("effects") == "sealed":
            if closed.rounds:
                show_truth(truth(entry.options))
            else:
                out.print("what is sealed stays so: no verdict stands yet", markup=False)
    if closed.ending not in ("traced", "adequate"):
        raise typer.Exit(1)


def show_rounds(closed: "Closed") -> None:
    """Print what each round came to, and how the loop ended."""
    from identify.report.words import percent

    def share(error: float | None) -> str:
        return percent(math.nan if error is None else error)

    table(
        f"closed loop {closed.name}",
        ("#", "verdict", "found, or rivals", "χ²/dof", "validation error", "runs", "rig min"),
        (
            (
                r.number,
                r.verdict,
                " + ".join(r.effects) if r.verdict == "traced" else " or ".join(r.rivals),
                f"{number(r.before.chi2_per_dof, 3)} → {number(r.after.chi2_per_dof, 3)}",
                f"{share(r.before.validation_error)} → {share(r.after.validation_error)}"
                f" (floor {share(r.noise_floor)})",
                r.runs,
                f"{r.rig_seconds / 60:.1f}",
            )
            for r in closed.rounds
        ),
    )
    meaning = ENDINGS[closed.ending].format(name=closed.name)
    out.print(
        f"{closed.ending}: {meaning}; {closed.rig_seconds / 60:.1f} min of rig time in all. "
        f"{closed.reason}",
        markup=False,
    )
