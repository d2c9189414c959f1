"""What a plan comes to, asked in a process aside: the service itself loads no identification."""

from pathlib import Path
from typing import Any

from daq.plan import Plan, parse_plan
from daq.store import RunStore


def planned(plan: dict[str, Any], store: str) -> tuple[Plan, list[dict[str, Any]]]:
    """A plan with its design's conditions, and the precision that is expected of it."""
    from daq.service.designing import expected_precision, resolved

    target = RunStore(Path(store))
    try:
        found = resolved(parse_plan(plan), target)
        return found, expected_precision(found, target)
    finally:
        target.close()


def require_parameters(plan: Plan) -> None:
    """Refuse a wanted precision of what is no parameter of the declared model: `InputError`."""
    from daq.service.rig_work import reviewer_of

    reviewer_of(plan)
