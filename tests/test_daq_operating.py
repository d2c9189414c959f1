"""Operating-point scripts and interlocks: what is set, waited for, logged, and gone on with."""

import json
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from daq.campaign import Event, load_plan, run_campaign
from daq.errors import CampaignError, InputError
from daq.journal import read_journal
from daq.online import Online
from daq.operating import OperatingPoint
from daq.plan import Condition, Plan, parse_plan, read_plan
from daq.schedule import expand
from daq.service.dry_run import dry_run
from daq.store import RunStore
from daq.supervise import InterlockRule, StopRequested
from drivers.errors import SettingError
from drivers.factory import open_device
from drivers.interlock import InterlockedRig
from drivers.operated import OperatedRig
from drivers.serial_devices import MassFlowController
from drivers.serialport import SerialPort
from identify.load import load_campaign, load_run
from identify.quality import inspect
from simulated_rig.build import build_config, build_rig
from simulated_rig.operating import REFERENCE, at_operating_point, growth_rate
from simulated_rig.operating import OperatingPoint as Set
from simulated_rig.plant import Turbulence
from simulated_rig.rig import SimulatedRig
from tests.test_drivers_serial import Alicat

SCRIPT = """
title = "flow and mixture"
record_s = 0.5
conditions = [{ offset = -0.02, over_threshold = 1.4 }]

[[operating_points]]
name = "reference"
set = { flow = 1.0, equivalence_ratio = 0.6 }
settle_s = 1.0

[[operating_points]]
name = "dead"
set = { equivalence_ratio = 0.35 }
settle_s = 1.0

[[operating_points]]
name = "strong"
set = { flow = 1.1, equivalence_ratio = 0.62 }
settle_s = 3.0
"""


@pytest.fixture
def store(tmp_path: Path) -> Iterator[RunStore]:
    made = RunStore(tmp_path / "store")
    yield made
    made.close()


def test_a_script_walks_its_points_and_every_run_says_where(
    store: RunStore, tmp_path: Path
) -> None:
    """At φ = 0.35 the loop is stable: no limit cycle, said, and the next point follows, where the
    cycle grows out of the flame's noise (1 mV of drive) and is larger, as the square root of the
    growth rate."""
    config = build_config(seed=1)
    config = replace(config, plant=replace(config.plant, turbulence=Turbulence(1e-3)))
    base = config.plant
    path = tmp_path / "plan.toml"
    path.write_text(SCRIPT)
    plan = read_plan(path)
    as_json = {
        "title": "flow and mixture",
        "record_s": 0.5,
        "conditions": [{"offset": -0.02, "over_threshold": 1.4}],
        "operating_points": [
            {"name": p.name, "set": p.set, "settle_s": p.settle_s} for p in plan.operating_points
        ],
    }
    assert parse_plan(json.loads(json.dumps(as_json))) == plan
    events: list[Event] = []
    with SimulatedRig(config, 1) as rig:
        result = run_campaign(rig, plan, store, events.append)
    assert growth_rate(at_operating_point(base, Set(1.0, 0.35))) < 0
    assert [o.status for o in result.outcomes] == [
        *("success", "entrained"),
        *("limit_cycle_lost", "limit_cycle_lost"),
        *("success", "entrained"),
    ]
    assert result.status == "complete"
    assert load_plan(result.directory / "plan.json") == plan
    runs = store.campaign_runs(result.id)
    notes = [load_run(store.run_path(run.id)).notes["operating_point"] for run in runs]
    assert [n["name"] for n in notes] == ["reference"] * 2 + ["strong"] * 2
    # what a point does not name stays as it was
    assert [(n["flow"], n["equivalence_ratio"]) for n in notes[::2]] == [(1.0, 0.6), (1.1, 0.62)]
    # an analysis is of one point, and says which runs are not at it
    recorded = load_campaign(result.directory)
    flagged = {f.run: f.flag for f in inspect(recorded).flags if f.flag == "other_operating_point"}
    assert sorted(flagged) == [run.id.split("/")[-1] for run in runs[2:]]
    strong = recorded.at_operating_point("strong")
    assert len(strong.runs) == 2
    assert not any(f.flag == "other_operating_point" for f in inspect(strong).flags)
    with pytest.raises(ValueError, match=r"'dead' is not one of \['reference', 'strong'\]"):
        recorded.at_operating_point("dead")
    walked = [e.data for e in events if e.kind == "operating_point"]
    assert walked[1] == {"point": 1, "name": "dead", "flow": 1.0, "equivalence_ratio": 0.35}
    frees = [e.data for e in events if e.kind == "free"]
    ratio = (frees[1]["amplitude"] / frees[0]["amplitude"]) ** 2
    rates = [growth_rate(at_operating_point(base, p)) for p in (REFERENCE, Set(1.1, 0.62))]
    # only the linear gain k grows: A² ∝ (k − k0), the growth rate likewise to first order
    assert ratio == pytest.approx(rates[1] / rates[0], rel=0.1)


def test_a_stopped_script_goes_on_at_its_point(store: RunStore) -> None:
    points = (OperatingPoint({"flow": 1.0}, 0.5), OperatingPoint({"flow": 1.1}, 0.5))
    plan = Plan(
        conditions=(Condition(offset=-0.02, over_threshold=1.4),),
        record_s=0.5,
        operating_points=points,
    )
    events: list[Event] = []

    def control() -> None:
        if [e.kind for e in events].count("free") == 2:  # the second point's
            raise StopRequested("enough for today")

    with build_rig(seed=1) as rig:
        first = run_campaign(rig, plan, store, events.append, control=control)
        assert first.status == "stopped"
    with build_rig(seed=1) as rig:
        second = run_campaign(rig, plan, store, campaign=first.id)
    assert [o.status for o in second.outcomes] == ["success", "entrained"] * 2
    lines = read_journal(second.directory / "journal.jsonl")
    assert [line["data"]["point"] for line in lines if line["kind"] == "operating_point"] == [
        *(0, 1),
        1,
    ]


def test_impossible_points_are_named(store: RunStore) -> None:
    with pytest.raises(InputError, match=r"operating_points\[0\]\.set"):
        parse_plan({"operating_points": [{"set": {}}]})
    plan = Plan(operating_points=(OperatingPoint({"flow": 1.0}), OperatingPoint({"swirl": 1.0})))
    with build_rig(seed=1) as rig:
        with pytest.raises(
            CampaignError, match=r"\[1\]: this rig cannot set 'swirl'; it sets flow"
        ):
            run_campaign(rig, plan, store)
        ranges = rig.operating_ranges()
        report = dry_run(plan, rig.limits, rig.sample_rate_hz, list(rig.channels), None, ranges)
        with pytest.raises(SettingError, match="flow=9"):
            rig.operate({"flow": 9.0})
    assert report["problems"] == [
        "condition 1: operating point: this rig cannot set 'swirl'; it sets flow, equivalence_ratio"
    ]
    # two free runs of 5 s and twice 5 s of settling
    assert report["rig_seconds"] == 20.0
    assert report["conditions"][0]["operating_point"] == {"flow": 1.0}
    assert [item.point for item in expand(plan)] == [0, 1]
    assert store.campaigns() == []


def test_mass_flow_controllers_set_the_point_and_are_read_for_every_run(store: RunStore) -> None:
    with Alicat() as device:
        controller = MassFlowController(SerialPort(device.name), max_slpm=50.0)
        plan = Plan(
            record_s=0.2,
            operating_points=(OperatingPoint({"air_flow_m3_per_s": 1e-4}, 0.1),),
        )
        with OperatedRig(build_rig(seed=1), {"air": controller}) as rig:
            assert rig.operating_ranges() == {"air_flow_m3_per_s": pytest.approx((0.0, 50e-3 / 60))}
            result = run_campaign(rig, plan, store)
        assert device.slpm == 6.0
        (run,) = store.campaign_runs(result.id)
        notes = load_run(store.run_path(run.id)).notes
        assert notes["operating_point"]["air_flow_m3_per_s"] == pytest.approx(1e-4)
        assert notes["air_set_point_m3_per_s"] == pytest.approx(1e-4)
        assert notes["air_gas"] == "Air"


class Door:
    """An interlock that the test opens and closes; counts how often it was asked."""

    def __init__(self) -> None:
        self.closed, self.answers = True, 0
        self.flutter: list[bool] = []

    def __call__(self) -> bool:
        self.answers += 1
        if self.flutter and not self.closed:
            return self.flutter.pop(0)
        return self.closed


def test_an_open_interlock_suspends_and_the_condition_is_repeated(store: RunStore) -> None:
    """The door opens while the first condition is recorded, and shuts for moments before it stays
    shut: the campaign goes on only after `clear_s` without a break, and repeats the condition."""
    door = Door()
    events: list[Event] = []
    plan = Plan(
        conditions=(Condition(offset=-0.02, over_threshold=1.4),),
        record_s=0.5,
        interlock=InterlockRule(clear_s=2.0),
    )
    with InterlockedRig(build_rig(seed=1), {"door": door}, period_s=3600.0) as rig:

        def tell(event: Event) -> None:
            events.append(event)
            if event.kind == "entrained" and not any(e.kind == "suspended" for e in events):
                # shut for 20 looks of 50 ms at most, open again, then shut for good
                door.closed, door.flutter = False, [False] * 5 + [True] * 20 + [False] * 5
                door.flutter += [True] * 10_000
                rig.interlock_open()

        result = run_campaign(rig, plan, store, tell)
        assert rig.interlock_tripped() is None
    assert [o.status for o in result.outcomes] == ["success", "entrained"]
    suspended = [e for e in events if e.kind == "suspended"]
    assert [e.data["reason"] for e in suspended] == ["interlock open: door"]
    again = next(e for e in events if e.kind == "free" and e.time_s > suspended[0].time_s)
    assert again.time_s - suspended[0].time_s > 2.0
    runs = store.campaign_runs(result.id)
    ended = sorted((r.name[:3], r.exit_status) for r in runs)
    assert ended == [("000", "success"), ("001", "failed"), ("001", "success")]


def test_options_of_flows_and_interlocks_are_looked_at_before_a_device_is_opened() -> None:
    options = {"limits": {"max_amplitude_v": 1.0}, "flows": {"air": {"adress": "/dev/null"}}}
    with pytest.raises(SettingError, match=r"rig 'c': flows: .*adress"):
        open_device("composed", "c", options)
    options = {"limits": {"max_amplitude_v": 1.0}, "interlocks": {"door": {"address": "x"}}}
    with pytest.raises(SettingError, match=r"rig 'c': interlocks: .*ask"):
        open_device("composed", "c", options, isolate=True)


def test_an_interlock_may_end_a_campaign_and_a_button_is_left_to_people(store: RunStore) -> None:
    door = Door()
    plan = parse_plan(
        {"conditions": [{"offset": -0.02}], "record_s": 0.5, "interlock": {"action": "end"}}
    )
    with InterlockedRig(build_rig(seed=1), {"door": door}, period_s=3600.0) as rig:

        def open_door(event: Event) -> None:
            if event.kind == "law":
                door.closed = False
                rig.interlock_open()

        result = run_campaign(rig, plan, store, open_door)
        assert rig.status().output_v == 0.0
        assert rig.interlock_tripped() == "interlock open: door"
    assert (result.status, result.reason) == ("stopped", "interlock open: door")
    assert result.outcomes[0].status == "success"


def test_the_plans_on_the_page_are_plans() -> None:
    """docs/plans.md, read as a user would copy it."""
    page = (Path(__file__).parent.parent / "docs" / "plans.md").read_text("utf-8")
    grid, designed, online = (block.partition("```")[0] for block in page.split("```toml\n")[1:])
    plan = parse_plan(tomllib.loads(grid))
    # 6 offsets × 2 drives × 2, a free run first and after every five, one cold run; at two points
    assert len(expand(plan)) == 2 * (24 + 1 + 4 + 1)
    assert [point.name for point in plan.operating_points] == ["lean", "rich"]
    design = parse_plan(tomllib.loads(designed)).design
    assert design is not None
    assert (design.aim, design.minutes) == ("precision", 5.0)
    assert parse_plan(tomllib.loads(online)).online == Online(relative_error=0.05)
