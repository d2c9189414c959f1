"""What a new campaign is called, and the plan that a recorded one began with."""

import secrets
from datetime import UTC, datetime

from daq.campaign import load_plan
from daq.errors import InputError
from daq.plan import Plan
from daq.store import RunStore, slug


def new_name(title: str) -> str:
    """An id for a campaign that is to be named before it begins."""
    day = datetime.now(UTC).strftime("%Y-%m-%dT%H%M%S")
    return f"{day}-{slug(title)}-{secrets.token_hex(2)}"


def begun_with(store: RunStore, campaign: str) -> Plan:
    """The plan that a campaign began with; raises `InputError` for one that was imported."""
    path = store.campaign_dir(campaign) / "plan.json"
    if not path.is_file():
        raise InputError(f"campaign {campaign!r} has no plan: it was imported")
    return load_plan(path)
