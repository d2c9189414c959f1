"""Campaign, diagnosis, next experiment, and again: until the rig is understood, or time is up.

    plan ──> campaign ──> diagnosis ──┬── traced, no_discrepancy: done
      ^                               ├── ambiguous, unexplained: its next experiment is the plan
      └───────────────────────────────┘    (none proposed, or no rig time left: done, unanswered)

The loop is pure bookkeeping: how a campaign is recorded and diagnosed is injected (`Steps`), and
both must be repeatable: a round that is recorded is not recorded again, one that is diagnosed not
diagnosed again. So a loop that was interrupted goes on by being run once more under its name. Its
rounds are the campaigns NAME, NAME-2, NAME-3, …, each continuing the one before (`daq.continued`).
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, Protocol

from daq.plan import Plan, parse_plan

Ending = Literal["traced", "adequate", "no_proposal", "out_of_budget", "stopped"]
FORMAT = "close-loop/1"


@dataclass(frozen=True)
class Budget:
    """At most so many campaigns, and so much rig time; a campaign that would exceed it is not
    begun."""

    rounds: int = 4
    rig_minutes: float = 60.0


@dataclass(frozen=True)
class Recorded:
    """A campaign that was run, now or before; `status` ``complete`` or why not."""

    status: str
    reason: str
    rig_seconds: float
    runs: int


class Steps(Protocol):
    """What the loop does to the world; each step returns at once where it is done already."""

    def record(self, campaign: str, plan: Plan) -> Recorded:
        """Run the plan as the campaign of that id, or go on with it."""

    def diagnose(self, campaign: str) -> dict[str, Any] | None:
        """The campaign's diagnosis as ``diagnosis/1``, all it continues included; None when it was
        stopped on the way."""

    def expected_seconds(self, plan: Plan) -> float:
        """Rig time that a plan needs, about."""


@dataclass(frozen=True)
class Errors:
    """How far a model is off."""

    chi2_per_dof: float | None
    validation_error: float | None


@dataclass(frozen=True)
class Round:
    """One turn: what was recorded, what it was found to mean.

    `before` and `after`: χ²/dof and validation error of the declared model, and with the effects
    that explain the data best (claimed or not).
    """

    number: int
    campaign: str
    runs: int
    rig_seconds: float
    verdict: str
    effects: tuple[str, ...]
    rivals: tuple[str, ...]
    before: Errors
    after: Errors
    noise_floor: float | None
    explanation: str


@dataclass(frozen=True)
class Closed:
    """All rounds, how it ended and why."""

    name: str
    rounds: tuple[Round, ...]
    ending: Ending
    reason: str

    @property
    def rig_seconds(self) -> float:
        return sum(r.rig_seconds for r in self.rounds)

    def to_json(self) -> dict[str, Any]:
        """As ``close-loop/1``."""
        return {"format": FORMAT, **asdict(self), "rig_seconds": self.rig_seconds}


def campaign_of(name: str, number: int) -> str:
    """The id of the campaign of a round."""
    return name if number == 1 else f"{name}-{number}"


def close_loop(
    name: str,
    plan: Plan,
    steps: Steps,
    budget: Budget | None = None,
    tell: Callable[[Round], None] = lambda done: None,
) -> Closed:
    """Turn the loop until a verdict stands or the budget is spent.

    Parameters
    ----------
    name : id of the first campaign, and of the loop.
    plan : of the first campaign. Later ones take their conditions from the diagnosis, and
        everything else (limits, supervision, the controller's settings) from this one.
    tell : called with each round that is done.
    """
    most = budget or Budget()
    rounds: list[Round] = []

    def end(ending: Ending, reason: str) -> Closed:
        return Closed(name, tuple(rounds), ending, reason)

    wanted = plan
    for number in range(1, most.rounds + 1):
        spent = sum(r.rig_seconds for r in rounds)
        needed = steps.expected_seconds(wanted)
        if spent + needed > 60 * most.rig_minutes:
            return end(
                "out_of_budget",
                f"round {number} needs about {needed / 60:.1f} min of rig time; "
                f"{most.rig_minutes - spent / 60:.1f} of {most.rig_minutes:g} min are left",
            )
        campaign = campaign_of(name, number)
        recorded = steps.record(campaign, wanted)
        if recorded.status != "complete":
            return end("stopped", f"campaign {campaign}: {recorded.reason or recorded.status}")
        found = steps.diagnose(campaign)
        if found is None:
            return end("stopped", f"the diagnosis of campaign {campaign} was stopped")
        rounds.append(_round(number, campaign, recorded, found))
        tell(rounds[-1])
        if found["verdict"] == "traced":
            return end("traced", found["explanation"])
        if found["verdict"] == "no_discrepancy":
            return end("adequate", found["explanation"])
        proposed = (found["next_experiment"] or {}).get("plan")
        if proposed is None:
            return end("no_proposal", "no run within the rig's limits would tell much more")
        wanted = following(plan, parse_plan(proposed, "next_experiment"), campaign)
    return end("out_of_budget", f"{most.rounds} rounds are done")


def following(first: Plan, proposed: Plan, campaign: str) -> Plan:
    """The first plan's care of the rig with the proposed conditions, continuing `campaign`."""
    return replace(
        first,
        title=proposed.title,
        conditions=proposed.conditions,
        cold=proposed.cold,
        free_runs=proposed.free_runs,
        record_s=proposed.record_s,
        continues=campaign,
    )


def _round(number: int, campaign: str, recorded: Recorded, found: dict[str, Any]) -> Round:
    return Round(
        number=number,
        campaign=campaign,
        runs=recorded.runs,
        rig_seconds=recorded.rig_seconds,
        verdict=found["verdict"],
        effects=tuple(f"{e['effect']} ({e['location']})" for e in found["effects"]),
        rivals=tuple((found["next_experiment"] or {}).get("rivals", ())),
        before=_errors(found["before"]),
        after=_errors(found["after"]),
        noise_floor=found["noise_floor"],
        explanation=found["explanation"],
    )


def _errors(part: dict[str, Any]) -> Errors:
    return Errors(part["chi2_per_dof"], part["validation_error"])
