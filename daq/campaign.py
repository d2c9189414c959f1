"""A campaign from its plan: free run, forced conditions, cold runs; journalled, resumable.

    free run      frequency, amplitude, harmonics of the limit cycle; recorded
    condition     the controller entrains it (`daq.conduct`); recorded on whole forcing periods
    cold run      flame off, driven; recorded, where the rig can put its flame out

A condition that cannot be entrained is recorded as such and the campaign goes on. Every way out
silences the speaker; the driver's own limits and dead-man timer lie below this. `daq.schedule`
makes the list of items, `daq.runner` carries it out.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from daq.continued import require_continuable
from daq.designed import Design
from daq.errors import CampaignError, CorruptFile
from daq.events import (
    CampaignResult,
    Control,
    Event,
    FlameSwitch,
    OnEvent,
    Review,
    Reviewer,
)
from daq.journal import Journal
from daq.online import Online
from daq.operating import OperatingPoint, require_operable
from daq.plan import Condition, Plan
from daq.runner import IGNITION_S, Runner
from daq.schedule import Item, Outcome, expand, finished_items
from daq.store import RunStore
from daq.store_upkeep import salvage
from daq.supervise import InterlockRule, Limit, SkipRequested, StopRequested
from drivers.protocols import DuplexRig, operating_ranges

__all__ = [
    "IGNITION_S",
    "CampaignResult",
    "Control",
    "Event",
    "FlameSwitch",
    "Item",
    "OnEvent",
    "Outcome",
    "Review",
    "Reviewer",
    "SkipRequested",
    "StopRequested",
    "expand",
    "finished_items",
    "load_plan",
    "run_campaign",
]


def run_campaign(
    rig: DuplexRig,
    plan: Plan,
    store: RunStore,
    on_event: OnEvent | None = None,
    *,
    control: Control | None = None,
    review: Reviewer | None = None,
    campaign: str | None = None,
    campaign_id: str = "",
    notes: Mapping[str, Any] | None = None,
) -> CampaignResult:
    """Run `plan` on `rig` into `store`.

    Parameters
    ----------
    on_event
        Told of every step, from this thread; must not take long.
    control
        Called between windows; may block (pause) and may raise `StopRequested` or
        `SkipRequested`.
    review
        Called after each run that can be used, with the campaign's folder and the outcome; what
        it returns is shown as a ``review`` event, and may end the campaign early (the wanted
        precision is reached). The place for a fit that is updated as the campaign goes.
    campaign
        The id of a campaign to go on with; its own plan is then used, `plan` is not.
    campaign_id
        The id that a new campaign shall have; made from the date and the title when empty.
    notes
        What a new campaign's card shall say beside what is known here.

    Raises
    ------
    CampaignError
        The campaign cannot start: no limit cycle, no pressure channel, an unusable plan.
    InputError
        The plan continues a campaign that is not in the store, or one of another rig.
    DriverError, StoreError
        The device or the disk failed on the way; the campaign is then marked ``failed`` and can
        be resumed.
    """
    if campaign is None:
        require_continuable(plan, rig.name, store)
        require_ready(plan, rig)
        card = store.create_campaign(
            plan.title,
            id=campaign_id,
            rig=rig.name,
            medium=plan.medium or {"density_kg_m3": 1.2, "sound_speed_m_s": 343.0},
            declared_model=plan.declared_model,
            status="running",
            documents={"plan.json": asdict(plan)},
            notes={**(notes or {}), **({"continues": plan.continues} if plan.continues else {})},
        )
        campaign = card.id
    else:
        plan = load_plan(store.campaign_dir(campaign) / "plan.json")
    with Journal(store.campaign_dir(campaign) / "journal.jsonl") as journal:
        store.set_status(campaign, status="running")
        try:
            salvage(store, campaign)  # what the recording that was cut off holds
            runner = Runner(rig, plan, store, campaign, journal, on_event, control, review)
        except BaseException:
            store.set_status(campaign, status="failed")
            raise
        try:
            return runner.run()
        except BaseException as error:
            runner.give_way(error)
            raise
        finally:
            rig.silence()


def require_ready(plan: Plan, rig: DuplexRig) -> None:
    """Raise `CampaignError` for a design without conditions, and points that `rig` cannot take."""
    if plan.design is not None and not (plan.conditions or plan.cold):
        raise CampaignError(
            f"the design from campaign {plan.design.campaign!r} has no conditions yet: "
            "`entrain campaign run` and `entrain close-loop` choose them, or list conditions"
        )
    require_operable(plan.operating_points, operating_ranges(rig))


def load_plan(path: Path) -> Plan:
    """The plan that a campaign was started with; raises `CorruptFile`."""
    try:
        content = json.loads(path.read_text("utf-8"))
        for key in ("conditions", "cold"):
            content[key] = tuple(Condition(**item) for item in content[key])
        points = content.get("operating_points", ())
        content["operating_points"] = tuple(OperatingPoint(**item) for item in points)
        if design := content.get("design"):
            content["design"] = Design(**{**design, "rivals": tuple(design["rivals"])})
        if online := content.get("online"):
            content["online"] = Online(**online)
        content["interlock"] = InterlockRule(**content.get("interlock", {}))
        content["limits"] = tuple(Limit(**item) for item in content["limits"])
        return Plan(**content)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise CorruptFile(f"{path}: not the plan of a campaign ({error})") from error
