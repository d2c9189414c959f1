"""What a campaign would do: every condition, its limits, the rig time; without touching the rig.

Frequencies relative to the limit cycle are shown against `free_hz` where that is known. The rig
time is an estimate: recording, plus what the controller usually needs to drive, check and settle.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from daq import supervise
from daq.campaign import IGNITION_S, expand
from daq.errors import InputError
from daq.operating import OperatingPoint, problem
from daq.plan import Condition, Plan, integer_bin
from drivers.types import Channel, OutputLimits

FREE_S = 3.0  # two looks of one second and the silence before them
APPROACH_S = 6.0  # a probe, a drive, a check and the settling, on the thesis's rig
SETTLE_COLD_S = 1.5


@dataclass(frozen=True)
class Planned:
    """One item of the expanded plan."""

    index: int
    kind: str
    role: str
    frequency_hz: float | None
    offset: float | None
    amplitude_v: float | None
    over_threshold: float | None
    seconds: float
    problem: str | None
    operating_point: dict[str, float] | None = None


def dry_run(
    plan: Plan,
    limits: OutputLimits,
    sample_rate_hz: float,
    channels: Sequence[Channel],
    free_hz: float | None = None,
    operating: Mapping[str, tuple[float, float]] | None = None,
    expected: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """The conditions in order, what is wrong with the plan and each of them, and the rig time in
    seconds.

    `operating`: what the rig can set of its operating point; `expected`: the precision of each
    parameter that the plan is expected to leave (`daq.service.designing`).
    """
    items = [
        _at_point(
            _planned(item.index, item.kind, item.condition, plan, limits, sample_rate_hz, free_hz),
            None if item.point is None else plan.operating_points[item.point],
            operating or {},
        )
        for item in expand(plan)
    ]
    settling = sum(point.settle_s for point in plan.operating_points)
    problems = [text for text in (_unwatched(plan, channels),) if text]
    problems += [f"condition {item.index}: {item.problem}" for item in items if item.problem]
    return {
        "title": plan.title,
        "conditions": [asdict(item) for item in items],
        "runs": len(items),
        "rig_seconds": settling + sum(item.seconds for item in items),
        "limit_v": min(plan.limit_v or limits.max_amplitude_v, limits.max_amplitude_v),
        "frequency_range_hz": [limits.min_frequency_hz, limits.max_frequency_hz],
        "free_frequency_hz": free_hz,
        "problems": problems,
        "expected_precision": [dict(row) for row in expected],
    }


def _unwatched(plan: Plan, channels: Sequence[Channel]) -> str | None:
    pressures = [channel.name for channel in channels if channel.quantity == "pressure"]
    if plan.control_channel is not None and plan.control_channel not in pressures:
        return (
            f"control_channel={plan.control_channel!r} is no pressure channel of the rig; it has "
            f"{', '.join(pressures) or 'none'}"
        )
    return supervise.problem(plan.limits, channels)


def _at_point(
    item: Planned, point: OperatingPoint | None, operating: Mapping[str, tuple[float, float]]
) -> Planned:
    if point is None:
        return item
    return replace(
        item, operating_point=point.set, problem=problem(point, operating) or item.problem
    )


def _planned(
    index: int,
    kind: str,
    condition: Condition | None,
    plan: Plan,
    limits: OutputLimits,
    rate: float,
    free_hz: float | None,
) -> Planned:
    if condition is None:
        return Planned(index, kind, "fit", None, None, None, None, FREE_S + plan.record_s, None)
    frequency = condition.frequency_hz
    if frequency is None and free_hz is not None:
        frequency = condition.target_hz(free_hz)
    if frequency is not None:
        frequency, _ = integer_bin(frequency, rate, plan.record_s)
    needed = APPROACH_S if kind == "forced" else SETTLE_COLD_S + IGNITION_S
    return Planned(
        index=index,
        kind=kind,
        role=condition.role,
        frequency_hz=frequency,
        offset=condition.offset,
        amplitude_v=condition.amplitude_v,
        over_threshold=condition.over_threshold,
        seconds=needed + plan.record_s,
        problem=_problem(condition, frequency, plan, limits, rate),
    )


def _problem(
    condition: Condition, frequency: float | None, plan: Plan, limits: OutputLimits, rate: float
) -> str | None:
    most = min(plan.limit_v or limits.max_amplitude_v, limits.max_amplitude_v)
    if condition.amplitude_v is not None and condition.amplitude_v > most:
        return f"amplitude_v={condition.amplitude_v:g} is above the limit of {most:g} V"
    low, high = limits.min_frequency_hz, min(limits.max_frequency_hz, rate / 2)
    if frequency is not None and not low <= frequency <= high:
        return f"frequency_hz={frequency:g} is outside {low:g} to {high:g} Hz"
    return None


def require_possible(report: dict[str, Any]) -> None:
    """Raise `InputError` naming the first conditions that cannot be run."""
    if report["problems"]:
        raise InputError("; ".join(report["problems"][:3]))
