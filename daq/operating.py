"""`[[operating_points]]`: the same conditions at one operating point after another.

A point sets quantities of the rig by name (flow and equivalence ratio of the simulated one, the
flows of mass-flow controllers), waits until the tube has settled, and measures the limit cycle
anew: relative frequencies, growth rate and couplings belong to the point. Every run's notes hold
the point and what the rig read back. Where no limit cycle stands at a point, its conditions end
as ``limit_cycle_lost``, and the script goes on with the next.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pydantic import Field

from daq.errors import CampaignError
from daq.tables import Table, Title


@dataclass(frozen=True)
class OperatingPoint:
    """Quantities and their values, in the units of their names; `settle_s` is waited after."""

    set: dict[str, float] = field(default_factory=dict)
    settle_s: float = 5.0
    name: str = ""


class OperatingPointTable(Table):
    """An operating point on the wire."""

    set: dict[str, float] = Field(min_length=1, max_length=20)
    settle_s: float = Field(default=5.0, ge=0, le=3600)
    name: Title = ""

    def point(self) -> OperatingPoint:
        """As the campaign uses it."""
        return OperatingPoint(**self.model_dump())


def problem(point: OperatingPoint, ranges: Mapping[str, tuple[float, float]]) -> str | None:
    """What the rig cannot do of a point; `ranges` are what it can set, empty where nothing."""
    for quantity, value in point.set.items():
        if quantity not in ranges:
            able = ", ".join(ranges) or "nothing"
            return f"operating point: this rig cannot set {quantity!r}; it sets {able}"
        low, high = ranges[quantity]
        if not low <= value <= high:
            return f"operating point: {quantity}={value:g} is outside {low:g} to {high:g}"
    return None


def require_operable(
    points: tuple[OperatingPoint, ...], ranges: Mapping[str, tuple[float, float]]
) -> None:
    """Raise `CampaignError` naming the first point that the rig cannot take."""
    for index, point in enumerate(points):
        if text := problem(point, ranges):
            raise CampaignError(f"operating_points[{index}]: {text.partition(': ')[2]}")
