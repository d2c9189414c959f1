"""The fit that goes with a campaign: shown after each condition, and the campaign's early end."""

from pathlib import Path

import pytest

from daq.campaign import Event, run_campaign
from daq.errors import InputError
from daq.plan import parse_plan
from daq.service.online import reviewer
from daq.service.rig_work import describe
from daq.store import RunStore
from simulated_rig.build import build_rig

GRID = {"span": [-0.05, 0.05], "count": 6, "over_threshold": [1.4, 2.2], "validation_share": 0.0}
# physics.md §1: the table's modes, and the flame's pole at 2π·100 rad/s
TRUTH = {"mode1.frequency_hz": 168.79, "mode1.damping": 0.010, "flame.pole_hz": 100.0}


def test_the_fit_is_shown_until_it_is_precise_enough(tmp_path: Path) -> None:
    """4 runs leave more than 1 %, a few more less: the campaign ends before its 12 conditions."""
    plan = parse_plan(
        {
            "record_s": 1.0,
            "cold": [],
            "grid": GRID,
            "online": {"relative_error": 0.01, "after_runs": 4},
        }
    )
    events: list[Event] = []
    store = RunStore(tmp_path / "store")
    with build_rig(seed=1) as rig:
        result = run_campaign(rig, plan, store, events.append, review=reviewer(plan))
    store.close()
    assert (result.status, result.reason) == ("complete", "the wanted precision is reached")
    seen = [event.data for event in events if event.kind == "review"]
    assert [data["runs"] for data in seen] == list(range(4, 4 + len(seen)))
    assert 2 <= len(seen) <= 7
    assert all(data["missing"] for data in seen[:-1])
    assert seen[-1]["missing"] == {}
    assert max(seen[-1]["relative_error"].values()) <= 0.01
    # every run adds information, so that the least known parameter becomes known better
    worst = [max(data["relative_error"].values()) for data in seen]
    assert worst == sorted(worst, reverse=True)
    for name, value in TRUTH.items():
        found = seen[-1]["parameters"][name]
        assert abs(found["value"] - value) < 4 * found["stderr"], name
    line = describe(next(event for event in events if event.kind == "review"))
    assert "fit after 4 runs" in line
    assert "not precise enough" in line


def test_a_parameter_that_the_model_lacks_is_named() -> None:
    plan = parse_plan(
        {
            "record_s": 0.5,
            "conditions": [{"offset": -0.03}, {"offset": 0.03}],
            "online": {"wanted": {"mode9.damping": 0.1}, "after_runs": 1},
        }
    )
    with pytest.raises(InputError, match=r"'mode9\.damping' is not a"):
        reviewer(plan)  # before anything has moved
    assert reviewer(parse_plan({})) is None
