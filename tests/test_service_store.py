"""The store over HTTP: campaigns and runs, exports and checksums, calibrations."""

import io
import json
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import httpx
import numpy as np
import pytest
import scipy.io

from daq.importers import import_folder
from daq.store import RunStore
from daq.store_upkeep import check_export
from tests.service_data import FRAMES, RATE_HZ, make_folder, pressure_pa
from tests.service_live import Running, running

# One step of a 16-bit converter of ±10 V behind 0.01 V/Pa; rounding is half of it.
STEP_PA = 10.0 / 32767 / 0.01


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("store")
    with running(folder / "data") as server:
        import_folder(make_folder(folder / "sines"), server.service.store)
        yield server


@pytest.fixture(scope="module")
def client(server: Running) -> Iterator[httpx.Client]:
    with server.client() as client:
        yield client


@pytest.fixture(scope="module")
def store(server: Running) -> RunStore:
    return server.service.store


@pytest.fixture(scope="module")
def campaign(client: httpx.Client) -> str:
    return str(client.get("/campaigns").json()["items"][0]["id"])


@pytest.fixture(scope="module")
def run(client: httpx.Client, campaign: str) -> str:
    rows = client.get("/runs", params={"max_frequency_hz": 165}).json()["items"]
    return f"/campaigns/{campaign}/runs/{rows[0]['name']}"


def test_a_campaign_lists_its_runs_and_is_not_sent_twice(
    client: httpx.Client, campaign: str
) -> None:
    answer = client.get(f"/campaigns/{campaign}")
    assert [run["role"] for run in answer.json()["runs"]] == ["fit", "fit", "validation"]
    again = client.get(f"/campaigns/{campaign}", headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_runs_come_in_pages_and_by_filter(client: httpx.Client) -> None:
    seen: list[str] = []
    after: str | None = None
    while True:
        page = client.get(
            "/runs", params={"limit": 2, **({"after": after} if after else {})}
        ).json()
        seen += [item["id"] for item in page["items"]]
        after = page["next"]
        if after is None:
            break
    assert len(seen) == len(set(seen)) == 3
    assert len(client.get("/runs", params={"role": "validation"}).json()["items"]) == 1
    assert client.get("/runs", params={"rig": "none"}).json() == {"items": [], "next": None}
    for since, count in (("2020-01-31", 3), ("2020-01-31T12:00:00+01:00", 3), ("2999-01-01", 0)):
        assert len(client.get("/runs", params={"since": since}).json()["items"]) == count
    for name in ("since", "until"):
        refused = client.get("/runs", params={name: "yesterday"})
        assert refused.status_code == 422
        assert f"{name}='yesterday' is neither a time nor a date" in refused.json()["detail"]


def test_samples_are_in_the_channels_unit(client: httpx.Client, run: str) -> None:
    body = client.get(f"{run}/samples", params={"start": 100, "stop": 300}).json()
    assert body["units"] == {"p1": "Pa", "p2": "Pa", "drive": "V"}
    np.testing.assert_allclose(body["channels"]["p1"], pressure_pa(160)[100:300], atol=STEP_PA)


@pytest.mark.parametrize("points", [1, 7, 500, 10_000])
def test_envelope_holds_the_extremes_of_each_bin(
    client: httpx.Client, run: str, points: int
) -> None:
    body = client.get(f"{run}/envelope", params={"points": points}).json()
    width, wave = body["frames_per_bin"], pressure_pa(160)
    assert len(body["time_s"]) <= points
    bins = [wave[at : at + width] for at in range(0, FRAMES, width)]
    np.testing.assert_allclose(body["channels"]["p1"]["max"], [b.max() for b in bins], atol=STEP_PA)
    np.testing.assert_allclose(body["channels"]["p1"]["min"], [b.min() for b in bins], atol=STEP_PA)


def test_spectrum_shows_the_line_and_thinning_keeps_it(client: httpx.Client, run: str) -> None:
    # A whole number of periods: the Hann window leaves the amplitude in its bin.
    for points in (4000, 20):
        body = client.get(f"{run}/spectrum", params={"points": points}).json()
        assert body["forcing_hz"] == 160.0
        assert max(body["channels"]["p1"]) == pytest.approx(200, abs=STEP_PA)
    at = int(np.argmax(client.get(f"{run}/spectrum").json()["channels"]["p1"]))
    assert at * RATE_HZ / FRAMES == 160.0


def test_downloads_in_every_format(client: httpx.Client, run: str) -> None:
    got = {
        form: client.get(f"{run}/download", params={"format": form}).content
        for form in ("hdf5", "csv", "npz", "mat")
    }
    with h5py.File(io.BytesIO(got["hdf5"])) as file:
        assert file.attrs["format"] == "entrain-run/1"
    table = np.loadtxt(io.BytesIO(got["csv"]), delimiter=",", skiprows=1)
    arrays = np.load(io.BytesIO(got["npz"]))
    matlab = scipy.io.loadmat(io.BytesIO(got["mat"]))
    for values in (table[:, 1], arrays["p1"], matlab["p1"][:, 0]):
        np.testing.assert_allclose(values, pressure_pa(160), atol=STEP_PA)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/campaigns/none", 404),
        ("/campaigns/..%2F..%2Fetc", 404),
        ("/campaigns/%2e%2e", 422),
        ("{campaign}/runs/none", 404),
        ("{campaign}/runs/..%5c..%5ckeys.json", 422),
        ("{run}/samples?start=5000", 422),
        ("{run}/samples?start=-1", 422),
        ("{run}/spectrum?channel=p9", 422),
        ("{run}/spectrum?max_hz=nan", 422),
        ("{run}/download?format=exe", 422),
        ("/runs?limit=100000", 422),
        ("/runs?after=%00", 200),
    ],
)
def test_what_is_not_there_is_refused(
    client: httpx.Client, campaign: str, run: str, path: str, status: int
) -> None:
    answer = client.get(path.format(campaign=f"/campaigns/{campaign}", run=run))
    assert answer.status_code == status, answer.text


def finished(client: httpx.Client, answer: httpx.Response) -> dict[str, Any]:
    """The result of the job that `answer` names."""
    assert answer.status_code == 202, answer.text
    job, end = answer.json()["id"], time.monotonic() + 60
    while client.get(f"/jobs/{job}").json()["state"] in ("queued", "running"):
        assert time.monotonic() < end
        time.sleep(0.02)  # polling, as a client would
    return {**client.get(f"/jobs/{job}/result").json(), "job": job}


def test_a_campaign_as_one_file_that_agrees_with_its_manifest(
    client: httpx.Client, campaign: str, tmp_path: Path
) -> None:
    made = finished(client, client.post(f"/campaigns/{campaign}/exports"))
    answer = client.get(f"/exports/{made['job']}")
    assert answer.headers["content-type"] == "application/zip"
    assert f'filename="{campaign}.zip"' in answer.headers["content-disposition"]
    archive = tmp_path / "campaign.zip"
    archive.write_bytes(answer.content)
    assert made["bytes"] == archive.stat().st_size
    assert check_export(archive) == []
    with zipfile.ZipFile(archive) as names:
        assert sum(name.endswith(".h5") for name in names.namelist()) == 3
    assert client.get("/exports/000000000000").status_code == 404
    assert client.post("/campaigns/none/exports").status_code == 404


def test_verifying_finds_the_run_that_was_changed(
    client: httpx.Client, campaign: str, store: RunStore
) -> None:
    fine = finished(client, client.post("/store/verify"))
    assert (fine["campaigns"], fine["findings"]) == (1, [])
    path = store.campaign_dir(campaign) / "runs" / "000-free.h5"
    before = path.read_bytes()
    with h5py.File(path, "r+") as file:
        file["entry/data/samples"][0, 0] += 1
    try:
        found = finished(client, client.post("/store/verify", params={"campaign": campaign}))
    finally:
        path.write_bytes(before)
    (row,) = found["findings"]
    assert (row["kind"], row["file"]) == ("checksum", f"campaigns/{campaign}/runs/000-free.h5")


CALIBRATION = {
    "subject": "p1",
    "method": "pistonphone",
    "value": 0.05,
    "uncertainty": 0.01,
    "unit": "V/Pa",
    "at": "2020-01-31T12:00:00+01:00",
    "data": {"level_db": 94.0},
}


def test_a_calibration_is_in_force_from_its_upload(client: httpx.Client) -> None:
    nominal = client.get("/rigs/simulated/calibrations").json()
    assert [row["in_force"] for row in nominal["channels"]] == [{}, {}, {}]
    assert "p1: no calibration of 'p1', nominal value used" in nominal["remarks"]
    old = client.post("/calibrations", json=CALIBRATION)
    assert old.status_code == 201, old.text
    assert old.json()["at"] == "2020-01-31T11:00:00Z"
    first = client.get("/rigs/simulated/calibrations").json()
    assert first["channels"][0]["volts_per_unit"] == 0.05
    assert first["channels"][0]["in_force"] == {"pistonphone": old.json()["id"]}
    assert "p1: pistonphone of 2020-01-31 is stale" in first["remarks"]
    assert "p1: calibrated at 0.05 V/Pa, 25 times the nominal 0.002" in first["remarks"][0]
    fresh = {key: value for key, value in CALIBRATION.items() if key != "at"}
    new = client.post("/calibrations", json={**fresh, "value": 0.06}).json()
    skew = {"subject": "p2", "method": "skew", "value": 2e-6, "uncertainty": 1e-7, "unit": "s"}
    client.post("/calibrations", json=skew)
    p1, p2, _ = client.get("/rigs/simulated/calibrations").json()["channels"]
    assert (p1["volts_per_unit"], p1["in_force"]) == (0.06, {"pistonphone": new["id"]})
    assert p2["skew_s"] == 2e-6
    page = client.get("/calibrations", params={"method": "pistonphone", "limit": 1}).json()
    assert [one["id"] for one in page["items"]] == [new["id"]]
    rest = client.get("/calibrations", params={"method": "pistonphone", "after": page["next"]})
    assert [(one["id"], one["stale"]) for one in rest.json()["items"]] == [(old.json()["id"], True)]
    assert client.get(f"/calibrations/{new['id']}").json()["value"] == 0.06


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"value": -0.05}, "value=-0.05 is not a pistonphone's"),
        ({"value": 1e300}, "value=1e+300 is not a pistonphone's"),
        ({"value": 2.0, "unit": "mV/Pa"}, "give unit 'V/Pa' and value=0.002"),
        ({"unit": "bananas"}, "unit='bananas' is not 'V/Pa'"),
        ({"method": "skew", "value": 1e6, "unit": "furlong"}, "unit='furlong' is not 's'"),
        ({"method": "skew", "value": 0.01, "unit": "s"}, "value=0.01 is not a skew's -0.001 to"),
        ({"method": "skew", "value": 2.0, "unit": "µs"}, "give unit 's' and value=2e-06"),
        ({"uncertainty": -1}, "uncertainty"),
        ({"uncertainty": 3}, "uncertainty=3.0 is not a number from 0 to 1"),
        ({"method": "guess"}, "method"),
        ({"subject": ""}, "subject"),
        ({"subject": "p\0"}, "subject='p\\x00' is not"),
        ({"subject": "../../x"}, "subject='../../x' is not"),
        ({"at": "2020-01-31T12:00:00"}, "at"),
        ({"at": "2999-01-31T12:00:00Z"}, "at"),
        ({"valid_days": 0}, "valid_days"),
        ({"data": {"x": "\ud800"}}, "body"),
        ({"certificate": "x"}, "certificate"),
    ],
)
def test_what_is_no_calibration_is_refused(
    client: httpx.Client, change: dict[str, Any], says: str
) -> None:
    before = client.get("/calibrations").json()
    body = json.dumps({**CALIBRATION, **change})
    headers = {"Content-Type": "application/json"}
    answer = client.post("/calibrations", content=body, headers=headers)
    assert answer.status_code == 422, answer.text
    assert says in answer.json()["detail"]
    assert client.get("/calibrations").json() == before


def test_rebuilding_the_catalogue_finds_the_same(client: httpx.Client) -> None:
    before = client.get("/runs").json()
    assert client.post("/store/rebuild").json() == {"left_out": []}
    assert client.get("/runs").json() == before
