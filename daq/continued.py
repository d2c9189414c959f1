"""A campaign that goes on where another left off: the same rig, one clock, one analysis.

A plan that `continues` a campaign is a campaign of its own in the store; its card names the
earlier one (`notes.continues`), and analyses read the runs of both. So that drift is seen as
drift, its runs' `started_s` count from the start of the first campaign of the chain.
"""

from collections.abc import Sequence
from datetime import datetime

from daq.errors import InputError
from daq.journal import Line, read_journal
from daq.plan import Plan
from daq.records import CampaignCard
from daq.schedule import elapsed
from daq.store import RunStore


def require_continuable(plan: Plan, rig: str, store: RunStore) -> None:
    """Raise `InputError` unless what the plan continues is in the store and of the same rig."""
    if plan.continues is None:
        return
    if not (store.campaigns_dir / plan.continues / "campaign.json").is_file():
        raise InputError(
            f"continues={plan.continues!r} is not a campaign of {store.root}: "
            "give --store, `entrain import` its folder, or leave `continues` out"
        )
    before = store.card(plan.continues).rig
    if before and before != rig:
        raise InputError(
            f"continues={plan.continues!r} was recorded on rig {before!r}, not {rig!r}: "
            "one analysis needs one rig; leave `continues` out"
        )


def begins_at_s(plan: Plan, card: CampaignCard, store: RunStore) -> float:
    """Seconds from the start of the first campaign of the chain to that of this one.

    What the calendar says, and at least all the rig time recorded before: a simulated rig's clock
    runs ahead of the calendar.
    """
    if plan.continues is None:
        return 0.0
    lines = read_journal(store.campaign_dir(plan.continues) / "journal.jsonl")
    runs = store.campaign_runs(plan.continues)
    recorded = max((r.started_s + r.samples / r.sample_rate_hz for r in runs), default=0.0)
    between = _instant(card) - _instant(store.card(plan.continues))
    return max(elapsed(lines), recorded, _first(lines) + between)


def _first(lines: Sequence[Line]) -> float:
    return min((float(line["time_s"]) for line in lines), default=0.0)


def _instant(card: CampaignCard) -> float:
    return datetime.fromisoformat(card.created_at).timestamp()
