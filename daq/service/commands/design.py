"""`entrain campaign design`: the conditions that fix a model's parameters best, as a plan."""

from typing import Annotated

import typer

from daq.service.commands.analysis import CampaignArgument, load, progress_bar, show_quality
from daq.service.commands.common import (
    PlanOption,
    StoreOption,
    finite,
    number,
    out,
    table,
    write_json,
)


def design(
    campaign: CampaignArgument,
    plan: PlanOption,
    runs: Annotated[int, typer.Option(min=1, max=100, help="At most so many conditions.")] = 10,
    minutes: Annotated[
        float | None,
        typer.Option(min=0.1, help="At most so much rig time; else as it takes.", callback=finite),
    ] = None,
    store: StoreOption = None,
) -> None:
    """Choose the conditions that tell most about the declared model's parameters (D-optimal)."""
    from identify import design as choice
    from identify.identification import identify, prepare

    recorded, _ = load(campaign, store)
    quiet = str(plan) == "-"
    with progress_bar(quiet) as tell:
        found = identify(recorded, progress=tell)
    fit = found.assessment.fit
    if not fit.converged:
        out.print(f"the fit did not converge: {fit.reason}", markup=False)
        raise typer.Exit(1)
    ready = prepare(recorded)
    reach = choice.reach_in(ready)
    budget = float("inf") if minutes is None else 60 * minutes
    chosen = choice.sharpen(fit, ready, reach, runs=runs, budget_s=budget)
    if not chosen.options:
        out.print("no condition fits into that rig time", markup=False)
        raise typer.Exit(1)
    told = choice.plan_of(
        chosen, ready, f"D-optimal: {recorded.title}"[:100], reach.record_s,
        choice.continued(recorded),
    )  # fmt: skip
    write_json(plan, told)
    if quiet:
        return
    after = choice.expected_estimates(fit, ready, chosen)
    table(
        f"{len(chosen.options)} conditions, about {chosen.seconds / 60:.1f} min of rig time",
        ("condition", "nats gained"),
        (
            (o.words(), number(0.5 * g, 3))
            for o, g in zip(chosen.options, chosen.gains, strict=True)
        ),
    )
    table(
        "expected precision",
        ("parameter", "value", "standard error now", "expected", "unit"),
        (
            (name, number(e.value, 6), number(e.stderr, 2), number(after[name].stderr, 2), e.unit)
            for name, e in fit.estimates.items()
        ),
    )
    show_quality(found)
    if found.assessment.chi2_per_dof > 2:
        out.print(
            f"χ²/dof {found.assessment.chi2_per_dof:.3g}: the declared model does not explain "
            "these data, and what is best for it need not be for the rig; `entrain diagnose` first",
            markup=False,
        )
    out.print(f"wrote {plan}; `entrain campaign run {plan}` measures it", markup=False)
    if "continues" not in told:
        out.print(
            "this campaign was recorded elsewhere: for one analysis of all runs, add the new ones "
            "to its folder",
            markup=False,
        )
