"""What breaks a campaign off, and what it does then: limits, drift, a lost flame, a pause."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.calibration import Calibration, CalibrationBook
from daq.campaign import CampaignResult, Event, Outcome, Review, run_campaign
from daq.errors import CampaignError, InputError
from daq.plan import Condition, Plan, parse_plan, record_seconds
from daq.schedule import expand
from daq.service.commands.keyboard import Keyboard
from daq.store import RunStore
from daq.supervise import Limit, LimitExceeded, StopRequested, Supervisor
from drivers.types import Block, Channel
from identify.load import load_run
from simulated_rig.build import build_config, build_rig
from simulated_rig.clocks import VirtualClock
from simulated_rig.config import Drift
from simulated_rig.rig import SimulatedRig

PLAN = Plan(
    conditions=(
        Condition(frequency_hz=166.0, over_threshold=1.4),
        Condition(frequency_hz=173.0, over_threshold=1.4),
    ),
    record_s=0.5,
)


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "store")


class Story:
    """Collects events, and acts on the first of a kind."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def __call__(self, event: Event) -> None:
        self.events.append(event)

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events if event.kind != "window"]


def statuses(result: CampaignResult) -> list[str]:
    return [outcome.status for outcome in result.outcomes]


def test_limit_with_hysteresis() -> None:
    channels = [Channel("p1", "pressure", "Pa", 0.002), Channel("t", "temperature", "K", 0.01)]
    supervisor = Supervisor(
        [Limit("p1", high=1000.0), Limit("t", low=280.0, high=340.0, statistic="mean")], channels
    )

    def block(pascal: float, kelvin: float) -> Block:
        return Block(0, np.array([[0.0, kelvin * 0.01], [-pascal * 0.002, kelvin * 0.01]]), 0.0)

    supervisor.check(block(999.0, 300.0))
    with pytest.raises(LimitExceeded, match=r"'p1': peak 1001 is not <= 1000"):
        supervisor.check(block(1001.0, 300.0))
    with pytest.raises(LimitExceeded, match=r"'t': mean 279 is not <= 340 and >= 280"):
        supervisor.check(block(0.0, 279.0))
    assert not supervisor.clear(block(960.0, 300.0))  # inside, but not by 5 %
    assert supervisor.clear(block(940.0, 300.0))
    with pytest.raises(CampaignError, match="'p9'"):
        Supervisor([Limit("p9", high=1.0)], channels)


def test_too_much_pressure_ends_the_campaign_silently(store: RunStore) -> None:
    """The free cycle has 346 Pa in p1 and 24 Pa at twice its frequency; a drive of 1 V, far above
    the threshold, brings twice as much."""
    loud = (Condition(frequency_hz=166.0, amplitude_v=1.0),)
    plan = replace(PLAN, conditions=loud, limits=(Limit("p1", high=420.0, action="end"),))
    with build_rig(seed=1) as rig:
        result = run_campaign(rig, plan, store)
        assert rig.status().output_v == 0.0
    assert result.status == "stopped"
    assert "'p1': peak" in result.reason
    assert statuses(result) == ["success"]


def test_a_limit_suspends_and_the_condition_is_repeated(store: RunStore) -> None:
    """Each suspension waits until the free cycle alone (346 Pa, inside 480 Pa less 5 %) is left;
    a condition that breaks the limit again and again is left out in the end."""
    story = Story()
    plan = replace(
        PLAN,
        limits=(Limit("p1", high=480.0, clear_s=0.2),),
        conditions=(Condition(frequency_hz=166.0, amplitude_v=1.0),),
    )
    with build_rig(seed=1) as rig:
        result = run_campaign(rig, plan, store, story)
    assert result.status == "complete"
    assert statuses(result) == ["success", "skipped"]
    assert story.kinds().count("suspended") == 20


def test_a_pause_repeats_the_condition(store: RunStore) -> None:
    """`control` blocks and silences the drive, as the service's does."""
    story = Story()
    with build_rig(seed=1) as rig:
        paused = 0

        def control() -> None:
            nonlocal paused
            entrained = story.kinds().count("entrained")
            if entrained == 1 and paused == 0:
                paused += 1
                rig.silence()
                rig.clock.sleep(1.0)

        result = run_campaign(rig, PLAN, store, story, control=control)
    assert paused == 1
    assert statuses(result) == ["success", "entrained", "entrained"]
    assert "suspended" in story.kinds()
    for run in store.campaign_runs(result.id):
        assert run.exit_status == "success"


def test_drift_of_the_free_frequency_ends_the_campaign(store: RunStore) -> None:
    config = build_config(seed=1)
    config = replace(config, drifts=(Drift("sound_speed", 0.05, over_s=100.0),))
    plan = replace(PLAN, reference_every=1, max_drift=0.002)
    with SimulatedRig(config, 1, VirtualClock()) as rig:
        result = run_campaign(rig, plan, store)
    assert result.status == "stopped"
    assert "drifted by" in result.reason


def test_a_flame_that_blows_off_is_named(store: RunStore) -> None:
    story = Story()
    plan = replace(PLAN, reference_every=1)
    with build_rig(seed=1) as rig:

        def control() -> None:
            if "entrained" in story.kinds() and rig.flame_lit:
                rig.flame_off()

        result = run_campaign(rig, plan, store, story, control=control)
    assert result.status == "stopped"
    assert "limit cycle lost" in result.reason
    assert store.card(result.id).status == "stopped"


def test_review_may_end_a_campaign_early(store: RunStore) -> None:
    def review(folder: Path, outcome: Outcome) -> Review | None:
        assert (folder / "runs" / f"{outcome.run}.h5").exists()
        return Review({"stderr": 0.01}, enough=outcome.index == 1)

    story = Story()
    with build_rig(seed=1) as rig:
        result = run_campaign(rig, PLAN, store, story, review=review)
    assert result.reason == "the wanted precision is reached"
    assert statuses(result) == ["success", "entrained"]
    assert "review" in story.kinds()


def test_hysteresis_is_measured_on_the_way_down(store: RunStore) -> None:
    """The tube's tongue has no hysteresis to speak of: release near the threshold (steps of 5 %,
    two windows each, so it is noticed up to two steps late)."""
    with build_rig(seed=1) as rig:
        plan = replace(PLAN, hysteresis=True, conditions=PLAN.conditions[:1])
        result = run_campaign(rig, plan, store)
    (_, forced) = result.outcomes
    assert forced.release_v is not None
    assert forced.threshold_v is not None
    assert 0.8 < forced.release_v / forced.threshold_v < 1.05


def test_grid_order_and_references() -> None:
    plan = parse_plan(
        {
            "grid": {"span": [-0.04, 0.04], "count": 5, "over_threshold": [1.3, 2.0], "repeats": 2},
            "order": "random",
            "seed": 3,
            "reference_every": 5,
            "free_runs": 2,
        }
    )
    items = expand(plan)
    forced = [item.condition for item in items if item.kind == "forced"]
    assert len(forced) == 20
    assert {c.offset for c in forced if c} == {-0.04, -0.02, 0.0, 0.02, 0.04}
    # a quarter of the ten points, and each point's repeats alike
    kept = {(c.offset, c.over_threshold) for c in forced if c and c.role == "validation"}
    assert len(kept) == 2
    assert sum(1 for c in forced if c and c.role == "validation") == 4
    assert [item.kind for item in items].count("free") == 2 + 4
    assert items == expand(plan)
    assert forced != list(plan.conditions)
    assert sorted(map(repr, forced)) == sorted(map(repr, plan.conditions))
    with pytest.raises(InputError, match="span, one of them"):
        parse_plan({"grid": {"over_threshold": [2.0]}})
    with pytest.raises(InputError, match=r"limits\[0\].*give high, low or both"):
        parse_plan({"limits": [{"channel": "p1"}]})


def test_precision_decides_the_length_of_a_record(store: RunStore) -> None:
    """n = 2 (σ/(p A))²: noise of 3 Pa beside a cycle of 346 Pa, to 4e-5: n = 2 (217)² = 94 000."""
    plan = Plan(precision=4e-5, record_s=0.5)
    assert record_seconds(plan, 346.0, 3.0, 1e4) == pytest.approx(9.4)
    assert record_seconds(Plan(record_s=0.5), 346.0, 3.0, 1e4) == 0.5
    assert record_seconds(plan, 346.0, 300.0, 1e4) == 60.0
    # the simulated rig's 0.2 Pa: 2 (0.2/(346 · 8e-6))² = 10 400 samples, 1.1 s
    wanted = replace(PLAN, precision=8e-6, conditions=PLAN.conditions[:1])
    with build_rig(seed=1) as rig:
        result = run_campaign(rig, wanted, store)
    assert {run.samples for run in store.campaign_runs(result.id)} == {11_000}


def test_what_costs_precision_is_said_before_recording(store: RunStore) -> None:
    """Spacing 50.8 mm at 170 Hz: k·s = 0.050π, below 0.1π; 20 µs of skew against 1.5 µs."""
    CalibrationBook(store.root / "calibrations").add(
        Calibration("p2", "skew", 2e-5, 1e-7, "s", at="2026-01-01T00:00:00Z", valid_days=1e5)
    )
    story = Story()
    with build_rig(seed=1) as rig:
        run_campaign(rig, replace(PLAN, conditions=()), store, story)
    said = [event.data["reason"] for event in story.events if event.kind == "remark"]
    assert any("outside 0.1π…0.8π at k=1 (k·s = 0.050π)" in text for text in said)
    assert any("p2 is sampled 20.0 µs off p1" in text for text in said)
    assert any("no calibration of 'p1'" in text for text in said)
    (run,) = store.campaign_runs(store.campaigns()[0].id)
    assert load_run(store.run_path(run.id)).notes["calibration"]


def test_keys_pause_skip_and_end(store: RunStore) -> None:
    """Typed into a pseudo-terminal: a pause that is taken back repeats the condition, s leaves it
    out, q ends the campaign, and the speaker is silent each time."""
    ours, theirs = pytest.importorskip("pty").openpty()
    pytest.importorskip("tty").setcbreak(theirs)
    story = Story()
    told: dict[str, bytes] = {"entrained": b"pp", "suspended": b"s", "skipped": b"q"}
    with build_rig(seed=1) as rig:
        keyboard = Keyboard(rig, theirs, [])

        def tell(event: Event) -> None:
            story(event)
            if typed := told.pop(event.kind, None):
                os.write(ours, typed)

        result = run_campaign(rig, PLAN, store, tell, control=keyboard.heed)
        assert rig.status().output_v == 0.0
    assert (result.status, result.reason) == ("stopped", "ended at the keyboard")
    assert statuses(result) == ["success", "skipped"]
    kinds = [kind for kind in story.kinds() if kind in ("entrained", "suspended", "skipped")]
    assert kinds == ["entrained", "suspended", "skipped"]
    with pytest.raises(StopRequested, match="interrupted"):
        Keyboard(rig, None, [2]).heed()
    os.close(ours)
    os.close(theirs)
