"""Designed plans, and the precision that a plan promises: identification put to work for planning.

`resolved` turns a `[design]` (`daq.designed`) into conditions: the recorded campaign is fitted, and
the runs are chosen that add most information per minute of rig time (`identify.design`), or that
tell the named rivals apart. `expected_precision` says what a plan's runs would leave of each
parameter's standard error, beside the runs of the campaign that it is designed from or continues.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from daq.designed import Design
from daq.errors import InputError
from daq.plan import Condition, Plan
from daq.schedule import expand
from daq.service import LONGEST_SEARCH_S
from daq.store import RunStore
from identify import design
from identify.diagnosis import diagnose
from identify.fit import Fit
from identify.identification import Prepared, fit_prepared, prepare
from identify.load import load_campaign
from identify.reach import Cost, Option, Reach
from identify.record import Campaign, DeclaredModel

Progress = Callable[[float, str], None]
DECLARED = "declared"


def resolved(plan: Plan, store: RunStore, progress: Progress | None = None) -> Plan:
    """The plan with the conditions of its design; one without a design is returned as it is.

    Raises `InputError` where the campaign cannot be fitted, a rival is not known, or nothing that
    the rig can do would tell anything.
    """
    wanted = plan.design
    if wanted is None or plan.conditions or plan.cold:
        return plan
    campaign = _campaign(plan, store)
    try:
        told = (
            _sharpened(plan, campaign, progress)
            if wanted.aim == "precision"
            else _told_apart(plan, campaign, progress)
        )
    except ValueError as error:
        raise InputError(f"design: campaign {wanted.campaign!r}: {error}") from error
    if not (told["conditions"] or told["cold"]):
        raise InputError(
            f"design: nothing within the limits of campaign {wanted.campaign!r} would tell more: "
            "allow more runs or minutes, or list conditions"
        )
    return replace(
        plan,
        conditions=tuple(Condition(**row) for row in told["conditions"]),
        cold=tuple(Condition(**row) for row in told["cold"]),
        record_s=told["record_s"],
        continues=plan.continues or told.get("continues"),
    )


def expected_precision(plan: Plan, store: RunStore) -> list[dict[str, Any]]:
    """Value, standard error now and after the plan's runs, and unit of each parameter.

    Empty where the plan neither is designed from a campaign nor continues one: nothing is known
    of the rig then; with operating points, where the parameters are others; and where the fit did
    not converge.
    """
    if plan.operating_points or (plan.design is None and plan.continues is None):
        return []
    campaign = _campaign(plan, store)
    fit, ready = _fitted(campaign)
    if not fit.converged:
        return []
    options = _options(plan, design.reach_in(ready))
    after = design.expected_estimates(fit, ready, design.Chosen(options))
    return [
        {
            "name": name,
            "value": found.value,
            "stderr": found.stderr,
            "expected_stderr": after[name].stderr,
            "unit": found.unit,
        }
        for name, found in fit.estimates.items()
    ]


def _campaign(plan: Plan, store: RunStore) -> Campaign:
    """What is known of the rig, with the model that the plan declares."""
    source = plan.design.campaign if plan.design else str(plan.continues)
    campaign = load_campaign(store.campaign_dir(source))
    if plan.design is not None and plan.design.model is not None:
        campaign = replace(campaign, declared_model=DeclaredModel(**plan.design.model))
    return campaign


_LAST: list[tuple[str, Fit, Prepared]] = []


def _fitted(campaign: Campaign, progress: Progress | None = None) -> tuple[Fit, Prepared]:
    """The declared model's fit; of the last campaign it is kept, since whoever asks for a design
    asks what it is expected to bring as well."""
    runs = [(run.name, run.exit_status) for run in campaign.runs]
    key = repr((campaign.identifier, campaign.declared_model, runs))
    if not _LAST or _LAST[0][0] != key:
        ready = prepare(campaign)
        if progress is not None:
            progress(0.2, "fitting the declared model")
        _LAST[:] = [(key, fit_prepared(ready)[0], ready)]
    return _LAST[0][1:]


def _sharpened(plan: Plan, campaign: Campaign, progress: Progress | None) -> dict[str, Any]:
    assert plan.design is not None
    fit, ready = _fitted(campaign, progress)
    if not fit.converged:
        raise ValueError(f"the fit did not converge: {fit.reason}")
    chosen = design.sharpen(
        fit,
        ready,
        design.reach_in(ready),
        record_s=plan.record_s,
        runs=plan.design.runs,
        budget_s=float("inf") if plan.design.minutes is None else 60 * plan.design.minutes,
    )
    return design.plan_of(chosen, ready, plan.title, plan.record_s, design.continued(campaign))


def _told_apart(plan: Plan, campaign: Campaign, progress: Progress | None) -> dict[str, Any]:
    assert plan.design is not None
    if not plan.design.rivals:
        found = diagnose(campaign, progress=progress, within_s=LONGEST_SEARCH_S).to_json()
        if found["next_experiment"] is None:
            raise ValueError(f"its diagnosis proposes no experiment. {found['explanation']}")
        return _proposed(found["next_experiment"], plan.design)
    ready = prepare(campaign)
    named = [(name, _with_rival(ready, name)) for name in plan.design.rivals]
    rivals = []
    for i, (name, one) in enumerate(named):
        if progress is not None:
            progress(i / len(named), f"fitting {name}")
        rivals.append(design.Rival(name, fit_prepared(one)[0]))
    reach = design.reach_in(ready)
    told = design.tell_apart(rivals, ready, reach).options
    chosen = design.Chosen(_within(told, plan.design, reach.cost))
    record_s = told[0].record_s if told else plan.record_s
    return design.plan_of(chosen, ready, plan.title, record_s, design.continued(campaign))


def _proposed(found: dict[str, Any], wanted: Design) -> dict[str, Any]:
    """The plan of a diagnosis's next experiment, its first conditions only where few are wanted."""
    names = ("kind", "record_s", "frequency_hz", "amplitude_v")
    told = [Option(**{name: row[name] for name in names}) for row in found["conditions"]]
    kinds = [option.kind for option in _within(told, wanted, Cost())]
    plan = found["plan"]
    return {
        **plan,
        "conditions": plan["conditions"][: kinds.count("forced")],
        "cold": plan["cold"][: kinds.count("cold")],
    }


def _within(options: Sequence[Option], wanted: Design, cost: Cost) -> tuple[Option, ...]:
    """The first of the options that the design's runs and minutes have room for, after the free
    run. They come in the order of choice, each the most telling beside those before it, so that
    the first ones are what would have been chosen of so many."""
    left = float("inf") if wanted.minutes is None else 60 * wanted.minutes
    kept: list[Option] = []
    for option in options[: wanted.runs]:
        free = [] if kept else [Option("free", option.record_s)]
        left -= sum(map(cost.seconds, [*free, option]))
        if left < 0:
            break
        kept.append(option)
    return tuple(kept)


def _with_rival(ready: Prepared, name: str) -> Prepared:
    """The campaign with the named effect in its declared structure; as it is, where that is its
    name. Raises ValueError listing the names that are known."""
    from identify.effects import CATALOGUE

    if name == DECLARED:
        return ready
    fitting = [effect for effect in CATALOGUE if name in (effect.key, effect.name)]
    if not fitting:
        known = sorted({effect.key for effect in CATALOGUE})
        raise ValueError(f"rivals: {name!r} is not one of {[DECLARED, *known]}")
    effects = ready.data.among((*ready.structure.effects, fitting[0]))
    return replace(ready, structure=replace(ready.structure, effects=effects))


def _options(plan: Plan, reach: Reach) -> tuple[Option, ...]:
    """The plan's runs as identification sees them; a multiple of the threshold by the reach's."""
    found = []
    for item in expand(plan):
        if item.condition is None:
            found.append(Option("free", plan.record_s))
            continue
        frequency = item.condition.target_hz(reach.free_hz)
        amplitude = item.condition.amplitude_v
        if amplitude is None:
            side = int(frequency > reach.free_hz)
            edge = reach.per_hz_v[side] * abs(frequency - reach.free_hz)
            amplitude = min((item.condition.over_threshold or 1.5) * edge, reach.limit_v)
        found.append(Option(item.kind, plan.record_s, frequency, amplitude))
    return tuple(found)
