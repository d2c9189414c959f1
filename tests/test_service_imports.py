"""Uploads: what a zip may hold, and what becomes of hostile ones."""

import io
import stat
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from daq.errors import InputError
from daq.service import unpack
from tests.service_data import make_folder
from tests.service_live import Running, running


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("imports")) as running_server:
        yield running_server


@pytest.fixture
def client(server: Running) -> Iterator[httpx.Client]:
    with server.client() as client:
        yield client


def packed(folder: Path, prefix: str = "") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for path in folder.iterdir():
            file.write(path, prefix + path.name)
    return buffer.getvalue()


def ended(client: httpx.Client, answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 202, answer.text
    until = time.monotonic() + 60
    while True:
        job: dict[str, Any] = client.get(f"/jobs/{answer.json()['id']}").json()
        if job["state"] not in ("queued", "running"):
            return job
        assert time.monotonic() < until
        time.sleep(0.02)  # polling, as a client would


@pytest.mark.parametrize("prefix", ["", "sines/"])
def test_a_zipped_campaign_folder_is_imported(
    client: httpx.Client, tmp_path: Path, prefix: str
) -> None:
    content = packed(make_folder(tmp_path / "sines"), prefix)
    answer = client.post("/imports", params={"name": "sines.zip"}, content=content)
    job = ended(client, answer)
    assert job["error"] is None
    result = client.get(f"/jobs/{job['id']}/result").json()
    assert result["runs"] == 3
    assert client.get(f"/campaigns/{result['campaign']}").json()["title"] == "three sines"


def test_a_single_recording_is_imported(
    server: Running, client: httpx.Client, tmp_path: Path
) -> None:
    folder = make_folder(tmp_path / "sines")
    channels = ["p1:pressure:Pa:0.01:0.7", "p2:pressure:Pa:0.01:0.8", "drive:voltage:V:1"]
    params = {"name": "free.wav", "channel": channels}
    content = (folder / "free.wav").read_bytes()
    job = ended(client, client.post("/recordings/imports", params=params, content=content))
    assert job["error"] is None
    assert list((server.service.settings.data_dir / "uploads").iterdir()) == []


def test_an_import_that_fails_says_what_and_leaves_nothing(
    server: Running, client: httpx.Client, tmp_path: Path
) -> None:
    folder = make_folder(tmp_path / "broken")
    (folder / "forced-1.wav").unlink()
    before = client.get("/campaigns").json()
    answer = client.post("/imports", params={"name": "broken.zip"}, content=packed(folder))
    job = ended(client, answer)
    assert job["state"] == "failed"
    assert "forced-1.wav" in job["error"]
    assert client.get("/campaigns").json() == before
    assert list((server.service.settings.data_dir / "uploads").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "content", "status"),
    [
        ("a.zip", b"", 422),
        ("a.tar", b"x", 422),
        ("../a.zip", b"x", 422),
        ("a.zip\n", b"x", 422),
    ],
)
def test_bad_uploads_are_refused_at_once(
    client: httpx.Client, name: str, content: bytes, status: int
) -> None:
    assert client.post("/imports", params={"name": name}, content=content).status_code == status


def test_uploads_are_limited_while_they_stream(tmp_path: Path) -> None:
    from daq.service.settings import ServerSettings

    def endless() -> Iterator[bytes]:
        for _ in range(1000):
            yield b"x" * 1000

    limits = ServerSettings(max_upload_bytes=10_000)
    with running(tmp_path, server=limits) as server, server.client() as client:
        answer = client.post("/imports", params={"name": "a.zip"}, content=endless())
        assert answer.status_code == 413
        assert list((tmp_path / "uploads").iterdir()) == []


def archive(path: Path, name: str, content: bytes = b"x", mode: int = 0) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        entry = zipfile.ZipInfo(name)
        entry.external_attr = mode << 16
        entry.compress_type = zipfile.ZIP_DEFLATED
        file.writestr(entry, content)
    return path


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("../evil.txt", 0),
        ("/etc/passwd", 0),
        ("a/b/c/d.txt", 0),
        ("a/../../b", 0),
        ("..", 0),
        ("c:evil", 0),
        ("back\\slash", 0),
        ("link", stat.S_IFLNK | 0o777),
        ("pipe", stat.S_IFIFO | 0o600),
    ],
)
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, name: str, mode: int) -> None:
    path = archive(tmp_path / "a.zip", name, mode=mode)
    with pytest.raises(InputError, match="refused"), unpack.unpack(path, "a.zip"):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.zip"]


def test_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unpack, "PIECE", 1000)  # so that a small bomb is one already
    path = archive(tmp_path / "a.zip", "zeros.bin", bytes(1_000_000))
    with pytest.raises(InputError, match="200 to one"), unpack.unpack(path, "a.zip"):
        pass
    monkeypatch.setattr(unpack, "MOST_BYTES", 500_000)
    monkeypatch.setattr(unpack, "MOST_RATIO", 10**9)
    with pytest.raises(InputError, match="more than 500000 bytes"), unpack.unpack(path, "a.zip"):
        pass
    monkeypatch.setattr(unpack, "MOST_FILES", 0)
    with pytest.raises(InputError, match="more than 0"), unpack.unpack(path, "a.zip"):
        pass


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"x" * 1000])
def test_what_is_no_zip_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.zip"
    path.write_bytes(content)
    with pytest.raises(InputError, match="zip"), unpack.unpack(path, "a.zip"):
        pass
