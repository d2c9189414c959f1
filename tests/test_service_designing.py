"""Designed plans: conditions chosen by the fit of a recorded campaign, over REST and in a store."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from daq.campaign import load_plan, run_campaign
from daq.errors import CampaignError, InputError
from daq.importers import import_folder
from daq.plan import Plan, parse_plan
from daq.service import designing
from daq.service.settings import RigSettings
from simulated_rig.build import build_rig
from tests.service_live import Running, running
from tests.test_service_campaigns import ended, until

DATA = Path(__file__).parent / "data" / "b-flame-delay"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    rigs = {"delayed": RigSettings(options={"effects": {"flame_delay": {"delay_s": 4e-4}}})}
    with running(tmp_path_factory.mktemp("designing"), rigs=rigs) as running_server:
        yield running_server


@pytest.fixture(scope="module")
def known(server: Running) -> str:
    """A recorded campaign to design from."""
    return import_folder(DATA, server.service.store).id


def test_a_dry_run_over_rest_shows_the_chosen_conditions_and_what_they_bring(
    server: Running, known: str
) -> None:
    plan = {"record_s": 1.0, "design": {"campaign": known, "runs": 3, "minutes": 1.0}}
    with server.client() as client:
        answer = client.post(
            "/campaigns/dry-run", json={"rig": "delayed", "plan": plan}, timeout=90
        )
        wrong = {"rig": "delayed", "plan": {"design": {"campaign": "none"}}}
        refused = client.post("/campaigns/dry-run", json=wrong)
    assert answer.status_code == 200, answer.text
    report: dict[str, Any] = answer.json()
    assert [row["kind"] for row in report["conditions"]] == ["free"] + ["forced"] * 3
    assert report["problems"] == []
    assert report["rig_seconds"] <= 60.0
    # recorded on a rig of 170 Hz, driven between its thresholds and 2 V
    for row in report["conditions"][1:]:
        assert 155 < row["frequency_hz"] < 185
        assert 0.05 < row["amplitude_v"] <= 2.0
    told = {row["name"]: row for row in report["expected_precision"]}
    assert len(told) == 11
    # information only adds up: no parameter may lose, and three runs beside eight must tell
    ratios = [row["expected_stderr"] / row["stderr"] for row in told.values()]
    assert max(ratios) <= 1.0 + 1e-6
    assert min(ratios) < 0.9
    assert refused.status_code == 404, refused.text


def test_a_design_is_resolved_then_run_and_kept(
    server: Running, known: str, tmp_path: Path
) -> None:
    source = server.service.store
    plan = parse_plan({"record_s": 0.5, "design": {"campaign": known, "runs": 2}})
    with build_rig(seed=1) as rig, pytest.raises(CampaignError, match="no conditions yet"):
        run_campaign(rig, plan, source)
    found = designing.resolved(plan, source)
    assert len(found.conditions) == 2
    assert designing.resolved(found, source) is found
    assert designing.resolved(Plan(), source) == Plan()
    with build_rig(effects={"flame_delay": {"delay_s": 4e-4}}) as rig:
        result = run_campaign(rig, found, source)
    assert [o.status for o in result.outcomes] == ["success", "entrained", "entrained"]
    kept = load_plan(result.directory / "plan.json")
    assert kept == found
    assert kept.design is not None
    assert kept.design.campaign == known


def test_rivals_are_told_apart_where_they_differ(server: Running, known: str) -> None:
    """The declared model against the one with a delay, by names as a diagnosis uses them."""
    table = {"campaign": known, "aim": "discrimination", "rivals": ["declared", "flame_delay"]}
    plan = parse_plan({"design": table})
    found = designing.resolved(plan, server.service.store)
    assert 1 <= len(found.conditions) <= 6
    assert plan.design is not None
    wrong = replace(plan, design=replace(plan.design, rivals=("declared", "gremlin")))
    with pytest.raises(InputError, match="'gremlin' is not one of"):
        designing.resolved(wrong, server.service.store)


def test_a_loop_over_rest_begins_with_a_designs_conditions(server: Running, known: str) -> None:
    plan = {"record_s": 0.5, "design": {"campaign": known, "runs": 2}}
    with server.client() as client:
        # a free run is 3.5 s, each of the two conditions 6.5 s: without these it would begin
        body = {"rig": "delayed", "plan": plan, "rig_minutes": 0.25}
        job = client.post("/close-loops", json=body).json()
        done = until(client, job["id"], ended)
        assert done["state"] == "succeeded", done["error"]
        result = client.get(f"/jobs/{job['id']}/result").json()
    assert (result["ending"], result["rounds"]) == ("out_of_budget", [])
    assert "needs about 0.3 min" in result["reason"]


def proposal(forced: int, cold: int) -> SimpleNamespace:
    """A diagnosis whose next experiment has so many runs of a second, the cold ones last."""
    place = {"frequency_hz": 170.0, "amplitude_v": 1.0}
    rows = [{**place, "kind": kind, "record_s": 1.0, "for": "discrimination"}
            for kind in ["forced"] * forced + ["cold"] * cold]  # fmt: skip
    plan = {"conditions": [place] * forced, "cold": [place] * cold, "record_s": 1.0}
    return SimpleNamespace(to_json=lambda: {"next_experiment": {"conditions": rows, "plan": plan}})


@pytest.mark.parametrize(
    ("limits", "forced", "cold"),
    [
        ({}, 3, 2),
        ({"runs": 4}, 3, 1),
        ({"runs": 2}, 2, 0),
        # a free run is 4 s, a forced one 7 s, a cold one 5.5 s
        ({"minutes": 31 / 60}, 3, 1),
        ({"minutes": 30 / 60}, 3, 0),
        ({"minutes": 30 / 60, "runs": 1}, 1, 0),
    ],
)
def test_what_a_diagnosis_proposes_is_cut_to_the_runs_and_minutes_of_the_design(
    server: Running,
    known: str,
    monkeypatch: pytest.MonkeyPatch,
    limits: dict[str, Any],
    forced: int,
    cold: int,
) -> None:
    monkeypatch.setattr(designing, "diagnose", lambda campaign, progress, within_s: proposal(3, 2))
    table = {"campaign": known, "aim": "discrimination", **limits}
    found = designing.resolved(parse_plan({"design": table}), server.service.store)
    assert (len(found.conditions), len(found.cold)) == (forced, cold)


def test_a_diagnosis_without_a_proposal_says_why(
    server: Running, known: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"next_experiment": None, "explanation": "Without run 3 it explains all others."}
    silent = SimpleNamespace(to_json=lambda: found)
    monkeypatch.setattr(designing, "diagnose", lambda campaign, progress, within_s: silent)
    plan = parse_plan({"design": {"campaign": known, "aim": "discrimination"}})
    with pytest.raises(InputError, match=r"proposes no experiment\. Without run 3"):
        designing.resolved(plan, server.service.store)


@pytest.mark.slow
def test_rivals_that_no_run_tells_apart_in_the_minutes_of_the_design(
    server: Running, known: str
) -> None:
    """The least that can be done is a free run and a forced one of two seconds: 13 s."""
    table = {"campaign": known, "aim": "discrimination", "rivals": ["declared", "flame_delay"],
             "minutes": 0.2}  # fmt: skip
    with pytest.raises(InputError, match="allow more runs or minutes"):
        designing.resolved(parse_plan({"design": table}), server.service.store)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"conditions": [{"offset": 0.01}]}, "leave conditions, grid and cold out"),
        ({"operating_points": [{"set": {"flow": 1.0}}]}, "leave operating_points out"),
        ({"design": {"campaign": "c", "rivals": ["a", "b"]}}, "rivals belong to aim"),
        ({"design": {"campaign": "c", "aim": "discrimination", "rivals": ["a"]}}, "at least two"),
        ({"design": {"campaign": "c", "runs": 0}}, r"design\.runs"),
    ],
)
def test_wrong_designs_are_named(table: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        parse_plan({"design": {"campaign": "c"}, **table})
