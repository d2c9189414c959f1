"""Campaigns over HTTP on a real simulated rig, in its own process: queue, steer, stop, resume."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from daq.service.settings import RigSettings
from tests.service_live import Running, running

PLAN = {
    "title": "two conditions",
    "record_s": 0.5,
    "conditions": [
        {"offset": -0.02, "over_threshold": 1.5},
        {"offset": 0.02, "over_threshold": 2.0, "role": "validation"},
    ],
}
# In real time the free run alone takes more than two seconds: time enough to interfere.
RIGS = {
    "quick": RigSettings(options={"clock": "virtual", "noise_db": 60}),
    "slow": RigSettings(options={"clock": "realtime", "noise_db": 60}),
}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("campaigns"), rigs=RIGS) as running_server:
        yield running_server


@pytest.fixture
def client(server: Running) -> Iterator[httpx.Client]:
    with server.client() as client:
        yield client


def until(client: httpx.Client, job: str, done: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    end = time.monotonic() + 60
    while True:
        seen: dict[str, Any] = client.get(f"/jobs/{job}").json()
        if done(seen):
            return seen
        assert time.monotonic() < end, seen
        time.sleep(0.02)  # polling, as a client would


def ended(job: dict[str, Any]) -> bool:
    return job["state"] in ("succeeded", "failed", "cancelled")


def event_kinds(server: Running, job: str) -> list[str]:
    history = list(server.service.bus._history)  # at once: the service goes on adding to it
    return [e.data["kind"] for e in history if e.kind == "campaign" and e.data["job"] == job]


def test_a_campaign_from_request_to_runs(server: Running, client: httpx.Client) -> None:
    answer = client.post("/campaigns", json={"rig": "quick", "plan": PLAN})
    assert answer.status_code == 202, answer.text
    job = answer.json()
    campaign = job["about"]["campaign"]
    final = until(client, job["id"], ended)
    assert (final["state"], final["error"]) == ("succeeded", None)
    result = client.get(f"/jobs/{job['id']}/result").json()
    assert result["status"] == "complete"
    # physics.md: the two-mode free limit cycle is at 169.713 Hz; one second resolves about 0.1 Hz.
    assert result["free"]["frequency_hz"] == pytest.approx(169.713, abs=0.1)
    detail = client.get(f"/campaigns/{campaign}").json()
    assert [run["kind"] for run in detail["runs"]] == ["free", "forced", "forced"]
    assert detail["status"] == "complete"
    kinds = event_kinds(server, job["id"])
    assert kinds[0] == "started"
    assert kinds[-1] == "finished"
    assert kinds.count("recorded") == 3
    said = [line.partition(" ")[2] for line in client.get(f"/jobs/{job['id']}/log").json()]
    assert "free run: 169.7" in " ".join(said)
    assert {"free run: recorded", "condition 1: recorded", "condition 2: recorded"} <= set(said)


def test_watching_shows_levels_waveform_and_spectrum(server: Running, client: httpx.Client) -> None:
    seen: dict[str, Any] = {}
    url = server.url.replace("http", "ws") + "/api/v1/live/ws?kinds=levels,waveform,spectrum"
    with connect(url) as ws:
        job = client.post("/rigs/quick/watch", json={"seconds": 2.0}).json()
        while len(seen) < 3:
            message = ws.recv(20)
            if isinstance(message, str):
                event = json.loads(message)
                if event["kind"] == "levels":
                    seen["levels"] = {row["name"]: row for row in event["data"]["channels"]}
            else:
                length = int.from_bytes(message[4:8], "little")
                head = json.loads(message[8 : 8 + length])
                samples = np.frombuffer(message[8 + length :], "<f4").reshape(head["shape"])
                seen[head["kind"]] = (head, samples)
    until(client, job["id"], ended)
    assert set(seen["levels"]) == {"p1", "p2", "drive"}
    assert seen["levels"]["drive"]["rms"] < 1e-3
    head, spectrum = seen["spectrum"]
    peak = np.argmax(spectrum[10:, 0]) + 10
    # Bins are at most 5 Hz wide after 0.2 s, the shortest record that is shown.
    assert peak * head["step_hz"] == pytest.approx(169.7, abs=5)
    assert seen["waveform"][1].shape[1] == 3


def test_dry_run_names_what_cannot_be_done(client: httpx.Client) -> None:
    plan = {**PLAN, "conditions": [*PLAN["conditions"], {"frequency_hz": 170, "amplitude_v": 1e6}]}
    body = {"rig": "quick", "plan": plan, "free_frequency_hz": 170.0}
    report = client.post("/campaigns/dry-run", json=body).json()
    assert report["runs"] == 4
    # 170 Hz less 2 % is 166.6 Hz; bins of a 0.5 s record are 2 Hz apart.
    assert report["conditions"][1]["frequency_hz"] == 166.0
    assert report["problems"] == [
        f"condition 3: amplitude_v=1e+06 is above the limit of {report['limit_v']:g} V"
    ]


@pytest.mark.parametrize(
    ("plan", "says"),
    [
        ({"limits": [{"channel": "no", "high": 1}]}, "limits name the channel 'no'"),
        (
            {"conditions": [{"frequency_hz": 170, "amplitude_v": 1e6}]},
            "condition 1: amplitude_v=1e+06 is above the limit",
        ),
    ],
)
def test_what_a_dry_run_finds_is_not_started(
    client: httpx.Client, plan: dict[str, Any], says: str
) -> None:
    body = {"rig": "quick", "plan": plan}
    (problem,) = client.post("/campaigns/dry-run", json=body).json()["problems"]
    assert says in problem
    before = client.get("/jobs").json()["items"]
    for path in ("/campaigns", "/close-loops"):
        refused = client.post(path, json=body)
        assert (refused.status_code, refused.json()["detail"]) == (422, problem)
    assert client.get("/jobs").json()["items"] == before


@pytest.mark.parametrize(
    ("body", "status", "says"),
    [
        ({"rig": "none"}, 404, "'none'"),
        ({"rig": "quick", "plan": {"conditions": [{"offset": 0.1, "x": 1}]}}, 422, "x=1"),
        ({"rig": "quick", "plan": {"record_s": -1}}, 422, "record_s=-1"),
        ({"rig": "quick", "plan": {"online": {"wanted": {"x": 0.1}}}}, 422, "'x' is not a param"),
        ({"rig": "quick", "speaker": "loud"}, 422, "speaker"),
    ],
)
def test_bad_campaigns_are_refused(
    client: httpx.Client, body: dict[str, Any], status: int, says: str
) -> None:
    for path in ("/campaigns", "/campaigns/dry-run"):
        answer = client.post(path, json=body)
        assert answer.status_code == status
        assert says in answer.json()["detail"]


@pytest.mark.parametrize("early", [True, False])
def test_emergency_stop_reaches_the_rigs_process_and_latches(
    server: Running, client: httpx.Client, early: bool
) -> None:
    """Also one whose process is only about to open the rig."""
    job = client.post("/campaigns", json={"rig": "slow", "plan": PLAN}).json()
    until(client, job["id"], lambda _: early or "free" in event_kinds(server, job["id"]))
    started = time.perf_counter()
    answer = client.post("/rigs/slow/emergency-stop").json()
    assert time.perf_counter() - started < 0.5
    assert answer["was_running"] == ["slow"]
    final = until(client, job["id"], ended)
    result = client.get(f"/jobs/{job['id']}/result").json()
    assert (final["state"], result["status"]) == ("cancelled", "stopped")
    assert final["progress"] < 1
    assert final["error"] == result["reason"]
    assert "emergency stop by local" in result["reason"]
    refused = client.post("/campaigns", json={"rig": "slow", "plan": PLAN})
    assert refused.json()["type"] == "/problems/stopped"
    assert client.post("/rigs/slow/reset").json()["state"] == "idle"


def test_a_skipped_condition_is_left_out(server: Running, client: httpx.Client) -> None:
    job = client.post("/campaigns", json={"rig": "slow", "plan": PLAN}).json()
    number, campaign = job["id"], job["about"]["campaign"]
    until(client, number, lambda _: "recorded" in event_kinds(server, number))  # the free run
    for count in (1, 2):
        assert client.post(f"/jobs/{number}/skip").status_code == 202
        until(client, number, lambda _, n=count: event_kinds(server, number).count("skipped") == n)
    until(client, number, ended)
    result = client.get(f"/jobs/{number}/result").json()
    assert [o["status"] for o in result["outcomes"]].count("skipped") == 2
    runs = client.get(f"/campaigns/{campaign}").json()["runs"]
    # a run that lost frames on a busy machine is kept beside the one that was recorded anew
    assert [r["kind"] for r in runs if r["exit_status"] == "success"] == ["free"]
    assert {r["kind"] for r in runs} == {"free"}


def test_pause_resume_stop_and_go_on(server: Running, client: httpx.Client) -> None:
    job = client.post("/campaigns", json={"rig": "slow", "plan": PLAN}).json()
    number, campaign = job["id"], job["about"]["campaign"]
    until(client, number, lambda seen: seen["state"] == "running")
    lock = client.post("/rigs/slow/lock", json={}).json()["token"]
    assert client.post(f"/jobs/{number}/pause").status_code == 423
    mine = {"X-Control-Token": lock}
    assert client.post(f"/jobs/{number}/pause", headers=mine).status_code == 202
    until(client, number, lambda seen: seen["hold"] == "paused")
    assert client.get("/rigs/slow").json()["state"] == "paused"
    assert "paused: the speaker is silent" in client.get(f"/jobs/{number}/log").json()[-1]
    assert client.post(f"/jobs/{number}/resume", headers=mine).status_code == 202
    until(client, number, lambda seen: seen["hold"] is None)
    until(client, number, lambda _: "free" in event_kinds(server, number))
    refused = client.delete(f"/jobs/{number}", headers=mine)
    assert f"POST /api/v1/jobs/{number}/stop" in refused.json()["detail"]
    assert client.post(f"/jobs/{number}/stop", headers=mine).status_code == 202
    until(client, number, ended)
    assert client.get(f"/jobs/{number}/result").json()["status"] == "stopped"
    assert client.get(f"/campaigns/{campaign}").json()["status"] == "stopped"
    assert client.post(f"/jobs/{number}/stop", headers=mine).status_code == 409
    # The plan and the rig's name are the campaign's own; configured anew, quicker, it goes on.
    quick = server.service.rigs._rigs["quick"]
    server.service.rigs._rigs["slow"] = replace(quick, name="slow")
    again = client.post(f"/campaigns/{campaign}/resume", headers=mine).json()
    until(client, again["id"], ended)
    detail = client.get(f"/campaigns/{campaign}").json()
    assert detail["status"] == "complete"
    # what the stop cut off, or lost frames on a busy machine, is kept beside them
    good = [run["kind"] for run in detail["runs"] if run["exit_status"] == "success"]
    assert good == ["free", "forced", "forced"]
    client.delete("/rigs/slow/lock", headers=mine)


def test_when_its_process_is_killed_what_was_recorded_is_kept(
    server: Running, client: httpx.Client
) -> None:
    plan = {**PLAN, "record_s": 4.0}
    job = client.post("/campaigns", json={"rig": "slow", "plan": plan}).json()
    folder = server.service.settings.store_dir / "campaigns" / job["about"]["campaign"] / "runs"
    until(
        client, job["id"], lambda _: any(p.stat().st_size > 30_000 for p in folder.glob(".*.h5.*"))
    )
    server.service.jobs._running[job["id"]].process.kill()
    final = until(client, job["id"], ended)
    assert final["state"] == "failed"
    assert f"POST /api/v1/campaigns/{folder.parent.name}/resume" in final["error"]
    detail = client.get(f"/campaigns/{folder.parent.name}").json()
    assert detail["status"] == "interrupted"
    assert detail["runs"][-1]["exit_status"] == "interrupted"
    assert list(folder.glob(".*")) == []


def test_sealed_rigs_keep_their_secret_until_asked(client: httpx.Client) -> None:
    body = {"name": "secret", "seed": 4, "effects": "sealed"}
    assert client.post("/simulated-rigs", json=body).status_code == 201
    assert client.post("/simulated-rigs", json=body).status_code == 409
    assert "effect" not in client.get("/rigs/secret").text
    truth = client.post("/simulated-rigs/secret/reveal").json()
    assert truth["effect"] is not None
    assert client.get("/audit").json()[0]["action"] == "reveal"
    assert client.delete("/simulated-rigs/secret").status_code == 204
    assert client.delete("/simulated-rigs/quick").status_code == 409
    for effects, says in (
        ({"gremlins": {}}, "effect='gremlins'"),
        ({"flame_delay": {"delay_s": 1e9}}, "delay_s=1000000000.0 is not a number from 0 to 0.1"),
    ):
        refused = client.post("/simulated-rigs", json={"name": "wrong", "effects": effects})
        assert (refused.status_code, says in refused.json()["detail"]) == (422, True), refused.text


def test_a_closed_loop_is_a_job_and_repeats_nothing(server: Running, client: httpx.Client) -> None:
    spent = client.post("/close-loops", json={"rig": "quick", "plan": PLAN, "rig_minutes": 0.01})
    assert spent.status_code == 202, spent.text
    until(client, spent.json()["id"], ended)
    result = client.get(f"/jobs/{spent.json()['id']}/result").json()
    assert (result["format"], result["ending"]) == ("close-loop/1", "out_of_budget")
    assert result["rounds"] == []
    # A loop whose first round is in the store, recorded and diagnosed, goes on behind it.
    job = client.post("/campaigns", json={"rig": "quick", "plan": PLAN}).json()
    name = job["about"]["campaign"]
    until(client, job["id"], ended)
    part = {"chi2_per_dof": 1.0, "validation_error": 1e-3}
    found = {"verdict": "no_discrepancy", "effects": [], "before": part, "after": part,
             "noise_floor": 1e-3, "explanation": "", "next_experiment": None}  # fmt: skip
    path = server.service.store.campaign_dir(name) / "diagnosis.json"
    path.write_text(json.dumps(found), "utf-8")
    more = client.post(f"/campaigns/{name}/close-loop", json={"rounds": 1}).json()
    final = until(client, more["id"], ended)
    assert final["state"] == "succeeded", final["error"]
    result = client.get(f"/jobs/{more['id']}/result").json()
    (only,) = result["rounds"]
    assert (result["ending"], only["campaign"], only["runs"]) == ("adequate", name, 3)
    log = client.get(f"/jobs/{more['id']}/log").json()
    assert "round 1: no_discrepancy; 3 runs" in log[-1]
    # no diagnosis was made, so there is no report of one
    assert client.get(f"/close-loops/{more['id']}/report").status_code == 404
