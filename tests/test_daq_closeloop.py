"""The closed loop: how it ends, what it hands on, and once on a simulated rig from end to end."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import pytest

from daq.campaign import StopRequested, run_campaign
from daq.closeloop import Budget, Closed, Recorded, close_loop
from daq.designed import Design
from daq.errors import InputError
from daq.plan import Condition, Plan, parse_plan, read_plan
from daq.records import Kind, RunSummary
from daq.service import loop_work, rig_work
from daq.service.jobs import Cancelled, Link
from daq.service.laid import noted
from daq.service.loop_work import RigSteps, turn
from daq.service.rigs import SIMULATED, RigEntry, open_simulated
from daq.store import RunStore
from daq.supervise import Limit
from drivers.protocols import DuplexRig
from identify.load import load_campaign
from simulated_rig import build_rig

NEXT = {
    "conditions": [{"frequency_hz": 172.0, "amplitude_v": 1.0}],
    "cold": [],
    "record_s": 4.0,
    "title": "next",
}
FIRST = Plan(title="first", conditions=(Condition(offset=0.01),), limit_v=2.0, max_drift=0.1)


def diagnosis(verdict: str, plan: dict[str, Any] | None = None) -> dict[str, Any]:
    part = {"chi2_per_dof": 1.0, "validation_error": 1e-3}
    effects = [{"effect": "flame_delay", "location": "flame"}] if verdict == "traced" else []
    following = None if plan is None else {"rivals": ["a", "b"], "plan": plan}
    return {"verdict": verdict, "effects": effects, "before": part, "after": part,
            "noise_floor": 1e-3, "explanation": verdict, "next_experiment": following}  # fmt: skip


@dataclass
class Scripted:
    """Steps that only remember; each campaign takes ten minutes."""

    verdicts: list[dict[str, Any] | None]
    plans: list[tuple[str, Plan]] = field(default_factory=list)
    status: str = "complete"

    def expected_seconds(self, plan: Plan) -> float:
        return 600.0

    def run(self, run: str) -> RunSummary:
        campaign, _, name = run.partition("/")
        return RunSummary(
            campaign, name, DRIVEN[name], "validation", 172.0, 0.7, 0.0, "", "rig", 10_000.0,
            15_000, "success", "", "", 0,
        )  # fmt: skip

    def record(self, campaign: str, plan: Plan) -> Recorded:
        self.plans.append((campaign, plan))
        return Recorded(self.status, "interlock open", 600.0, 5)

    def diagnose(self, campaign: str) -> dict[str, Any] | None:
        return self.verdicts.pop(0)


AMBIGUOUS = diagnosis("ambiguous", NEXT)


@pytest.mark.parametrize(
    ("verdicts", "budget", "ending", "rounds"),
    [
        ([diagnosis("no_discrepancy")], Budget(), "adequate", 1),
        ([AMBIGUOUS, diagnosis("traced")], Budget(), "traced", 2),
        ([AMBIGUOUS, diagnosis("unexplained")], Budget(), "no_proposal", 2),
        ([AMBIGUOUS, AMBIGUOUS, AMBIGUOUS], Budget(rounds=3), "out_of_budget", 3),
        # ten minutes a round: the third would take the loop to thirty
        ([AMBIGUOUS, AMBIGUOUS, AMBIGUOUS], Budget(9, 25.0), "out_of_budget", 2),
        ([], Budget(9, 9.0), "out_of_budget", 0),
        ([AMBIGUOUS, None], Budget(), "stopped", 1),
    ],
)
def test_a_loop_ends_with_a_verdict_or_with_its_budget(
    verdicts: list[dict[str, Any] | None], budget: Budget, ending: str, rounds: int
) -> None:
    steps = Scripted(list(verdicts))
    closed = close_loop("loop", FIRST, steps, budget)
    assert (closed.ending, len(closed.rounds)) == (ending, rounds)
    # a campaign whose diagnosis was stopped took its ten minutes too
    assert closed.rig_seconds == closed.to_json()["rig_seconds"] == 600.0 * len(steps.plans)
    assert closed.reason


def test_each_round_continues_the_one_before_and_keeps_the_first_plans_care() -> None:
    steps = Scripted([AMBIGUOUS, AMBIGUOUS, diagnosis("traced")])
    close_loop("loop", FIRST, steps)
    assert [name for name, _ in steps.plans] == ["loop", "loop-2", "loop-3"]
    assert [plan.continues for _, plan in steps.plans] == [None, "loop", "loop-2"]
    second = steps.plans[1][1]
    assert second.conditions == (Condition(frequency_hz=172.0, amplitude_v=1.0),)
    assert (second.record_s, second.limit_v, second.max_drift) == (4.0, 2.0, 0.1)
    stopped = close_loop("loop", FIRST, Scripted([], status="stopped"))
    assert (stopped.ending, stopped.rounds, stopped.rig_seconds) == ("stopped", (), 600.0)
    assert "interlock open" in stopped.reason


def test_a_round_that_a_diagnosis_planned_is_of_no_design() -> None:
    """Else the precision that is expected of it would be reckoned from the design's campaign."""
    steps = Scripted([AMBIGUOUS, diagnosis("traced")])
    close_loop("loop", replace(FIRST, design=Design("known")), steps)
    assert [plan.design for _, plan in steps.plans] == [Design("known"), None]


DRIVEN: dict[str, Kind] = {"002-forced": "forced", "003-cold": "cold", "000-free": "free"}


def doubting(run: str) -> dict[str, Any]:
    flags = [{"run": run, "flag": "contradicts_alone", "detail": "", "severity": "warning"}]
    return {**diagnosis("unexplained"), "explanation": f"without {run}", "quality": flags}


def test_the_condition_of_a_run_that_alone_contradicts_is_recorded_once_more() -> None:
    """No experiment is proposed then, since none was looked for: not since none would tell."""
    driven = Condition(frequency_hz=172.0, amplitude_v=0.7, role="validation")
    steps = Scripted([doubting("002-forced"), diagnosis("no_discrepancy")])
    closed = close_loop("loop", FIRST, steps)
    assert (closed.ending, len(closed.rounds)) == ("adequate", 2)
    second = steps.plans[1][1]
    assert (second.conditions, second.cold, second.free_runs) == ((driven,), (), 1)
    assert (second.record_s, second.continues, second.limit_v) == (1.5, "loop", 2.0)

    # a run of an earlier campaign has that one's name before its own; nothing is repeated twice
    verdicts = [AMBIGUOUS, doubting("loop/003-cold"), doubting("loop/003-cold")]
    steps = Scripted(verdicts)
    closed = close_loop("loop", FIRST, steps)
    assert (closed.ending, len(closed.rounds)) == ("no_proposal", 3)
    third = steps.plans[2][1]
    assert (third.conditions, third.cold, third.continues) == ((), (driven,), "loop-2")
    assert closed.reason.startswith("without loop/003-cold Campaign loop-3 had its condition once")

    # a free run comes with every plan
    steps = Scripted([doubting("000-free"), diagnosis("traced")])
    assert close_loop("loop", FIRST, steps).ending == "traced"
    assert (steps.plans[1][1].conditions, steps.plans[1][1].cold) == ((), ())


def test_a_loop_without_a_proposal_ends_with_the_diagnosis_own_words() -> None:
    closed = close_loop("loop", FIRST, Scripted([diagnosis("unexplained")]))
    assert (closed.ending, closed.reason) == ("no_proposal", "unexplained")


SMALL = parse_plan(
    {
        "title": "small",
        "record_s": 1.0,
        "cold": [],
        "conditions": [
            {"offset": o, "over_threshold": f, "role": role}
            for o, f, role in (
                (-0.04, 1.5, "fit"), (-0.025, 2.5, "fit"), (-0.015, 2.0, "validation"),
                (0.015, 1.5, "fit"), (0.025, 2.5, "fit"), (0.04, 1.5, "fit"),
            )
        ],
    }
)  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Iterator[RunStore]:
    opened = RunStore(tmp_path / "store")
    yield opened
    opened.close()


def test_a_loop_on_a_rig_stops_goes_on_and_reaches_its_verdict(store: RunStore) -> None:
    """The rig is as declared: one campaign settles it. It is stopped on the way, and taken up."""
    windows: list[str] = []

    def impatient() -> None:
        if len(windows) > 25:
            raise StopRequested("enough for today")

    def heard(event: Any) -> None:
        windows.append(event.kind)

    with build_rig(seed=3, noise_db=40.0) as rig:
        first = turn("loop", SMALL, RigSteps(rig, store, impatient, heard), store, Budget())
        assert (first.ending, first.reason) == ("stopped", "campaign loop: enough for today")
        # a free run of a second, two looks of one before it, and a condition's windows
        assert 4.0 < first.rig_seconds < 60.0
        done = {run.name for run in store.campaign_runs("loop")}
        assert done
        closed: Closed = turn("loop", SMALL, RigSteps(rig, store, lambda: None), store, Budget())
    assert closed.ending == "adequate", closed.reason
    (only,) = closed.rounds
    assert only.runs == 7
    assert closed.rig_seconds == only.rig_seconds > first.rig_seconds
    assert done < {run.name for run in store.campaign_runs("loop")}
    assert store.card("loop").verdict == "no_discrepancy"
    kept = json.loads((store.campaign_dir("loop") / "loop.json").read_text("utf-8"))
    assert kept == json.loads(json.dumps(closed.to_json()))
    # everything is in the store: run once more, nothing is measured or fitted again
    assert turn("loop", SMALL, RigSteps(rig, store, _never), store, Budget()) == closed


def _never() -> None:
    raise AssertionError("the rig was asked again")


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[RigEntry]:
    """Every rig that a job opens."""
    seen: list[RigEntry] = []

    def open_rig(entry: RigEntry) -> DuplexRig:
        seen.append(entry)
        return open_simulated(entry)

    for module in (loop_work, rig_work):
        monkeypatch.setattr(module, "open_rig", open_rig)
    return seen


def test_a_loop_as_a_job_goes_on_with_the_options_that_it_began_with(
    store: RunStore, tmp_path: Path, opened: list[RigEntry]
) -> None:
    """Begun with ``--sealed --seed 5`` in a terminal, taken up over REST, stopped both times."""
    at_once = replace(SMALL, limits=(Limit("p1", high=1e-6, action="end"),))
    laid = {"seed": 5, "effects": "sealed"}
    with open_simulated(RigEntry("tube", SIMULATED, laid)) as rig:
        turn("loop", at_once, RigSteps(rig, store, lambda: None, rig_options=laid), store, Budget())
    ours, theirs = Pipe()
    with ours, theirs:
        tube = asdict(RigEntry("tube", SIMULATED, {"noise_db": 60.0}))
        report = str(tmp_path / "report.html")
        closed = loop_work.work(
            Link(theirs), tube, str(store.root), {}, "loop", 1, 60.0, report, resume=True
        )
    assert closed["ending"] == "stopped"
    assert [entry.options for entry in opened] == [{"noise_db": 60.0, **laid}]


def test_a_campaign_as_a_job_goes_on_with_the_options_that_it_began_with(
    store: RunStore, opened: list[RigEntry]
) -> None:
    at_once = replace(SMALL, limits=(Limit("p1", high=1e-6, action="end"),))
    with open_simulated(RigEntry("tube", SIMULATED, {"seed": 5})) as rig:
        run_campaign(rig, at_once, store, campaign_id="one", notes=noted({"seed": 5}))
    ours, theirs = Pipe()
    with ours, theirs:
        tube = asdict(RigEntry("tube", SIMULATED, {"noise_db": 60.0}))
        with pytest.raises(Cancelled) as stopped:
            rig_work.campaign(Link(theirs), tube, str(store.root), {}, "one", resume=True)
    assert stopped.value.result is not None
    assert stopped.value.result["status"] == "stopped"
    assert [entry.options for entry in opened] == [{"noise_db": 60.0, "seed": 5}]


def test_a_doubted_run_is_recorded_once_more_on_the_rig(store: RunStore) -> None:
    """Its diagnosis is written by hand: one run of the first campaign is doubted."""
    with build_rig(seed=3, noise_db=40.0) as rig:
        run_campaign(rig, SMALL, store, campaign_id="loop")
        (doubted,) = (r for r in store.campaign_runs("loop") if r.name.startswith("002-"))
        path = store.campaign_dir("loop") / "diagnosis.json"
        path.write_text(json.dumps(doubting(doubted.name)), "utf-8")
        closed = turn("loop", SMALL, RigSteps(rig, store, lambda: None), store, Budget())
    assert [(r.campaign, r.runs) for r in closed.rounds] == [("loop", 7), ("loop-2", 2)]
    free, again = store.campaign_runs("loop-2")
    assert (free.kind, again.kind, again.role) == ("free", doubted.kind, doubted.role)
    driven = ("frequency_hz", "amplitude_v", "samples")
    assert [getattr(again, n) for n in driven] == [getattr(doubted, n) for n in driven]
    assert closed.ending == "adequate", closed.reason


def test_a_campaign_that_continues_another_is_read_with_it(store: RunStore) -> None:
    short = replace(SMALL, conditions=SMALL.conditions[:2])
    with build_rig(seed=3) as rig:
        one = run_campaign(rig, short, store)
        two = run_campaign(rig, replace(short, continues=one.id, title="more"), store)
        three = run_campaign(rig, replace(short, continues=two.id, title="most"), store)
        with pytest.raises(InputError, match="entrain import"):
            run_campaign(rig, replace(short, continues="nowhere"), store)
    with (
        build_rig(seed=3, name="another rig") as other,
        pytest.raises(InputError, match="another rig"),
    ):
        run_campaign(other, replace(short, continues=one.id), store)
    campaign = load_campaign(three.directory)
    names = [run.name for run in campaign.runs]
    assert len(names) == len(set(names)) == 9
    assert [n.split("/")[0] for n in names[:6]] == [one.id] * 3 + [two.id] * 3
    # one clock: the rig's own, which ran through
    times = [run.started_s for run in campaign.runs]
    assert times == sorted(times)
    assert times[3] >= one.rig_seconds - 1.0
    assert times[6] >= one.rig_seconds + two.rig_seconds - 2.0
    # a 16-bit converter of ±10 V behind 2 mV/Pa, whose samples come as floating-point volts: unless
    # its step is known, a quiet sine's tops look clipped
    assert campaign.runs[0].signals["p1"].resolution == pytest.approx(10 / 2**15 / 2e-3, rel=1e-3)
    # what the rig can do is noted for whoever plans the next experiment
    assert campaign.runs[0].notes["rig"]["flame_switch"] is True
    assert campaign.runs[0].notes["rig"]["limit_v"] == rig.limits.max_amplitude_v


def test_a_diagnosis_is_a_plan_where_it_proposes_one(tmp_path: Path) -> None:
    path = tmp_path / "diagnosis.json"
    path.write_text(json.dumps({"format": "diagnosis/1", **AMBIGUOUS}), "utf-8")
    assert read_plan(path) == parse_plan(NEXT)
    path.write_text(json.dumps({"format": "diagnosis/1", **diagnosis("traced")}), "utf-8")
    with pytest.raises(InputError, match="no next experiment"):
        read_plan(path)
