"""The plan as a fixed list of items, and what is known of each.

The list depends on the plan alone (its seed included), so a resumed campaign has the same one: an
item is done when a journal line or a successful run file says so.
"""

import random
from collections.abc import Sequence
from dataclasses import dataclass

from daq.journal import Line
from daq.lockin import FreeCycle
from daq.plan import Condition, Plan
from daq.records import Kind, RunSummary


@dataclass(frozen=True)
class Item:
    """One line of the expanded plan; free runs have no condition. `point` counts the plan's
    operating points."""

    index: int
    kind: Kind
    condition: Condition | None = None
    point: int | None = None


@dataclass(frozen=True)
class Outcome:
    """How one item ended.

    `status`: ``success`` (free and cold runs), ``entrained``, or why not: the controller's
    outcome (``not_entrained``, ``beating``, ``another_mode``, ``subharmonic``, ``overload``,
    ``timeout``), ``refused`` by the device's limits, ``limit_cycle_lost``, ``skipped``, or the
    recording's (``failed``). `threshold_v` is the smallest drive that entrains,
    `threshold_sigma_v` its standard error, `release_v` where the limit cycle came free on the way
    down.
    """

    index: int
    kind: Kind
    status: str
    reason: str = ""
    run: str | None = None
    frequency_hz: float | None = None
    amplitude_v: float | None = None
    threshold_v: float | None = None
    threshold_sigma_v: float | None = None
    suppression_db: float | None = None
    release_v: float | None = None

    @property
    def good(self) -> bool:
        """Whether it brought a run that can be used."""
        return self.status in ("success", "entrained")


def expand(plan: Plan) -> tuple[Item, ...]:
    """Free runs, conditions in the plan's order with reference runs between, cold runs; all of
    them at each operating point."""
    points = range(len(plan.operating_points)) if plan.operating_points else (None,)
    wanted = [(point, *item) for point in points for item in _at_one_point(plan, point or 0)]
    return tuple(
        Item(index, kind, condition, point) for index, (point, kind, condition) in enumerate(wanted)
    )


def _at_one_point(plan: Plan, point: int) -> list[tuple[Kind, Condition | None]]:
    conditions = list(plan.conditions)
    if plan.order == "random":
        random.Random(plan.seed + point).shuffle(conditions)
    wanted: list[tuple[Kind, Condition | None]] = [("free", None)] * plan.free_runs
    for number, condition in enumerate(conditions, start=1):
        wanted.append(("forced", condition))
        if plan.reference_every and number % plan.reference_every == 0:
            wanted.append(("free", None))
    return wanted + [("cold", condition) for condition in plan.cold]


def finished_items(lines: Sequence[Line], runs: Sequence[RunSummary]) -> dict[int, Outcome]:
    """What need not be done again: journalled outcomes, and run files that made it to the disk
    though the line after them did not."""
    done: dict[int, Outcome] = {}
    for line in lines:
        if line["kind"] in ("recorded", "not_entrained", "skipped"):
            done[int(line["index"])] = Outcome(**line["data"])
    for run in runs:
        index = int(run.name.partition("-")[0])
        if run.exit_status == "success" and index not in done:
            status = "entrained" if run.kind == "forced" else "success"
            done[index] = Outcome(
                index, run.kind, status, "", run.name, run.frequency_hz, run.amplitude_v
            )
    return done


def first_free(lines: Sequence[Line], point: int | None = None) -> FreeCycle | None:
    """The limit cycle that relative frequencies refer to: the first one journalled, of an
    operating point where the plan has such."""
    now: int | None = None
    for line in lines:
        if line["kind"] == "operating_point":
            now = line["data"]["point"]
        if line["kind"] == "free" and now == point:
            data = dict(line["data"])
            return FreeCycle(**{**data, "harmonics": tuple(data["harmonics"])})
    return None


def elapsed(lines: Sequence[Line]) -> float:
    """Rig time that a campaign has behind it."""
    return max((float(line["time_s"]) for line in lines), default=0.0)
