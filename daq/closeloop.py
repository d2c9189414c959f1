"""Campaign, diagnosis, next experiment, and again: until the rig is understood, or time is up.

    plan ──> campaign ──> diagnosis ──┬── traced, no_discrepancy: done
      ^                               ├── ambiguous, unexplained: its next experiment is the plan
      │                               ├── one run alone contradicts: its condition, once more
      └───────────────────────────────┘    (none of these, or no rig time left: done, unanswered)

The loop is pure bookkeeping: how a campaign is recorded and diagnosed is injected (`Steps`), and
both must be repeatable: a round that is recorded is not recorded again, one that is diagnosed not
diagnosed again. So a loop that was interrupted goes on by being run once more under its name. Its
rounds are the campaigns NAME, NAME-2, NAME-3, …, each continuing the one before (`daq.continued`).
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, Protocol

from daq.plan import Condition, Plan, parse_plan
from daq.records import RunSummary

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

    def run(self, run: str) -> RunSummary:
        """What was recorded as ``campaign/name``."""

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
    """All rounds, how it ended and why; `unfinished_seconds` of rig time went into a campaign that
    was stopped before its diagnosis stood."""

    name: str
    rounds: tuple[Round, ...]
    ending: Ending
    reason: str
    unfinished_seconds: float = 0.0

    @property
    def rig_seconds(self) -> float:
        return sum(r.rig_seconds for r in self.rounds) + self.unfinished_seconds

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
    again: dict[str, str] = {}  # doubted run -> campaign that has its condition once more

    def end(ending: Ending, reason: str, unfinished_s: float = 0.0) -> Closed:
        return Closed(name, tuple(rounds), ending, reason, unfinished_s)

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
            why = recorded.reason or recorded.status
            return end("stopped", f"campaign {campaign}: {why}", recorded.rig_seconds)
        found = steps.diagnose(campaign)
        if found is None:
            why = f"the diagnosis of campaign {campaign} was stopped"
            return end("stopped", why, recorded.rig_seconds)
        rounds.append(_round(number, campaign, recorded, found))
        tell(rounds[-1])
        if found["verdict"] == "traced":
            return end("traced", found["explanation"])
        if found["verdict"] == "no_discrepancy":
            return end("adequate", found["explanation"])
        proposed = (found["next_experiment"] or {}).get("plan")
        if proposed is not None:
            wanted = following(plan, parse_plan(proposed, "next_experiment"), campaign)
            continue
        doubted = doubted_run(found, campaign)
        if doubted is None:
            return end("no_proposal", found["explanation"])
        if doubted in again:
            return end(
                "no_proposal",
                f"{found['explanation']} Campaign {again[doubted]} had its condition once more; "
                "still it is the only one that contradicts.",
            )
        again[doubted] = campaign_of(name, number + 1)
        wanted = following(plan, once_more(steps.run(doubted)), campaign)
    return end("out_of_budget", f"{most.rounds} rounds are done")


def doubted_run(found: Mapping[str, Any], campaign: str) -> str | None:
    """The one run that alone contradicts the declared model, as ``campaign/name``."""
    flags = found.get("quality", ())
    runs = [str(flag["run"]) for flag in flags if flag["flag"] == "contradicts_alone"]
    if not runs:
        return None
    return runs[0] if "/" in runs[0] else f"{campaign}/{runs[0]}"


def once_more(run: RunSummary) -> Plan:
    """A run by itself, driven as it was; every plan begins with a free one, which needs no more."""
    condition = Condition(run.frequency_hz, amplitude_v=run.amplitude_v, role=run.role)
    return Plan(
        title=f"once more: {run.name}",
        conditions=(condition,) if run.kind == "forced" else (),
        cold=(condition,) if run.kind == "cold" else (),
        record_s=run.samples / run.sample_rate_hz,
    )


def following(first: Plan, proposed: Plan, campaign: str) -> Plan:
    """The first plan's care of the rig with the proposed conditions, continuing `campaign`."""
    return replace(
        first,
        title=proposed.title,
        conditions=proposed.conditions,
        cold=proposed.cold,
        free_runs=proposed.free_runs,
        record_s=proposed.record_s,
        design=None,
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
