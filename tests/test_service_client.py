"""The Python client against a real server, and the documentation against the routes."""

import json
import subprocess
from pathlib import Path

import pytest

from daq.client import ApiError, Client, JobFailed
from daq.service import document, wire
from daq.service.keys import KeyStore
from daq.service.settings import RigSettings, ServerSettings
from tests.service_data import make_folder
from tests.service_live import running

ROOT = Path(__file__).parent.parent
PUBLIC = {"/health", "/version"}


def test_from_upload_to_download(tmp_path: Path) -> None:
    key = KeyStore(tmp_path / "keys.json").create("notebook", ["admin"])[1]
    rigs = {"tube": RigSettings()}
    settings = ServerSettings(require_key=True)
    with running(tmp_path, server=settings, rigs=rigs) as server, Client(server.url, key) as lab:
        assert lab.health().key_needed
        assert lab.version().api == "v1"
        job = lab.import_folder(make_folder(tmp_path / "sines"))
        seen: list[wire.JobSummary] = []
        lab.wait(job.id, 60, seen.append)
        assert seen[-1].progress == 1.0
        campaign = lab.result(job.id)["campaign"]
        assert [c.id for c in lab.campaigns()] == [campaign]
        assert len(lab.campaign(campaign).runs) == 3
        (run,) = lab.runs(role="validation")
        assert lab.samples(campaign, run.name, 0, 10).stop == 10
        assert lab.spectrum(campaign, run.name, "p1").forcing_hz == 175.0
        target = lab.download(campaign, run.name, tmp_path / "run.csv", "csv")
        assert target.read_text().startswith("time_s,p1 (Pa)")
        assert lab.take_control("tube").holder == "notebook"
        assert lab.rig("tube").holder == "notebook"
        lab.give_control_back("tube")
        assert lab.emergency_stop().rigs == ["tube"]
        assert lab.reset("tube").state == "idle"
        event = next(e for e in lab.live(since=0) if e["kind"] == "job")
        assert event["data"]["id"] == job.id


def test_refusals_and_failures_raise_with_the_services_words(tmp_path: Path) -> None:
    with running(tmp_path) as server, Client(server.url) as lab:
        with pytest.raises(ApiError, match="there is no rig 'none'") as caught:
            lab.rig("none")
        assert (caught.value.status, caught.value.kind) == (404, "/problems/not-found")
        folder = make_folder(tmp_path / "broken")
        (folder / "free.wav").write_bytes(b"RIFF")
        with pytest.raises(JobFailed, match=r"free\.wav"):
            lab.wait(lab.import_folder(folder).id, 60)


def test_every_route_is_documented() -> None:
    assert (ROOT / "docs" / "api.md").read_text(encoding="utf-8") == document.page(), (
        "run: python -m daq.service.document > docs/api.md"
    )


@pytest.mark.parametrize("keyed", [False, True])
def test_printed_commands_work(tmp_path: Path, keyed: bool) -> None:
    lines = [line.strip() for line in document.page().splitlines() if line.startswith("    ")]
    given = [line for line in lines if line.startswith("export")]
    asked = next(line for line in lines if line.endswith('"$ENTRAIN/me"'))
    moved = next(line for line in lines if line.endswith('"$ENTRAIN/rigs/simulated/reset"'))
    key = KeyStore(tmp_path / "keys.json").create("desk", ["control"])[1] if keyed else ""
    with running(tmp_path, server=ServerSettings(require_key=keyed)) as server:
        given.append(f"ENTRAIN={server.url}/api/v1")
        if keyed:
            given.append(f"KEY='Authorization: Bearer {key}'")
        script = "\n".join([*given, asked, "echo", moved])
        told = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=20)
    me, rig = map(json.loads, told.stdout.splitlines())
    assert me["name"] == ("desk" if keyed else "local")
    assert rig["state"] == "idle"


def test_every_route_but_the_public_ones_needs_a_scope() -> None:
    without = {route.path for route in document.routes() if document.scope_of(route) is None}
    assert without == PUBLIC


def test_whatever_changes_something_needs_more_than_read() -> None:
    harmless = {"/live/ticket", "/campaigns/dry-run", "/emergency-stop"}
    for route in document.routes():
        if route.methods != {"GET"} and route.path not in harmless:
            stop = route.path.endswith("/emergency-stop")
            assert stop or document.scope_of(route) in ("control", "configure", "admin"), route.path
