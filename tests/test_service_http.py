"""The service over a real socket: who may do what, what is refused, and how it says so."""

import asyncio
import json
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.asyncio import client as asyncio_client
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from daq.service.keys import KeyStore
from daq.service.server import make_server
from daq.service.settings import ConfigError, ServerSettings, Settings
from daq.store import RunStore
from tests.service_live import Running, running
from tests.small_disk import fill, small_disk


@pytest.fixture(scope="module")
def open_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("open")) as server:
        yield server


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Running, dict[str, str]]]:
    folder = tmp_path_factory.mktemp("keyed")
    store = KeyStore(folder / "keys.json")
    keys = {scope: store.create(scope, [scope])[1] for scope in ("read", "control", "admin")}
    with running(folder, server=ServerSettings(require_key=True)) as server:
        yield server, keys


def problem(answer: httpx.Response) -> dict[str, object]:
    assert answer.headers["content-type"] == "application/problem+json"
    body: dict[str, object] = answer.json()
    assert body["status"] == answer.status_code
    assert body["request"] == answer.headers["x-request-id"]
    return body


def test_health_version_metrics(open_server: Running) -> None:
    with open_server.client() as client:
        assert client.get("/health").json()["status"] == "ok"
        assert client.get("/version").json()["name"] == "entrain"
        text = client.get("/metrics").text
        again = client.get("/metrics").text
    assert 'entrain_requests_total{method="GET",route="/health",status="200"}' in text
    assert 'entrain_jobs{state="running"} 0' in text
    assert int(re.search(r"entrain_disk_free_bytes (\d+)", text)[1]) > 10**6  # type: ignore[index]
    assert 'entrain_requests_total{method="GET",route="/metrics",status="200"} 1' in again


def test_every_answer_carries_the_security_headers(open_server: Running) -> None:
    with open_server.client() as client:
        for path in ("/health", "/no-such-thing"):
            headers = client.get(path).headers
            assert headers["x-content-type-options"] == "nosniff"
            assert "default-src 'self'" in headers["content-security-policy"]
            assert "server" not in headers


def test_unknown_route_method_and_value_are_problems(open_server: Running) -> None:
    with open_server.client() as client:
        assert problem(client.get("/nothing"))["type"] == "/problems/not-found"
        assert problem(client.put("/health"))["type"] == "/problems/method"
        assert (
            problem(client.get("/rigs/none"))["detail"]
            == "there is no rig 'none'; there is simulated"
        )
        wrong = problem(client.post("/rigs/simulated/lock", json={"takeover": True, "x": 1}))
        assert wrong["errors"] == [{"where": "body.x", "what": "Extra inputs are not permitted"}]


@pytest.mark.parametrize(
    ("method", "path", "body", "says"),
    [
        ("GET", "/campaigns?bogus=1", None, "query parameter 'bogus' is not known here; there are"),
        ("GET", "/health?bogus=1", None, "'bogus' is not known here; there are none"),
        (
            "POST",
            "/campaigns/x/diagnoses?within_minutes=nan",
            None,
            "'within_minutes' is not known",
        ),
        ("POST", "/campaigns/x/diagnoses", {"within": -1}, "body: this request takes none"),
        ("GET", "/runs?kind=zz", None, "query.kind='zz': Input should be 'free', 'forced' or"),
        (
            "GET",
            "/runs?min_frequency_hz=nan",
            None,
            "query.min_frequency_hz='nan': Input should be",
        ),
        ("GET", "/jobs?state=zz", None, "query.state='zz': Input should be 'queued'"),
        ("GET", "/jobs?kind=zz", None, "query.kind='zz': Input should be 'campaign'"),
        ("GET", "/campaigns?verdict=zz", None, "query.verdict='zz': Input should be 'no_discre"),
        ("GET", "/campaigns?limit=0", None, "query.limit='0': Input should be greater than or"),
        ("POST", "/rigs/simulated/watch", {"seconds": -1}, "body.seconds=-1: Input should be gre"),
        ("POST", "/rigs/simulated/watch", {"password": "x"}, "body.password: Extra inputs are"),
    ],
)
def test_what_would_be_passed_over_is_refused(
    open_server: Running, method: str, path: str, body: dict[str, object] | None, says: str
) -> None:
    with open_server.client() as client:
        refused = problem(client.request(method, path, json=body))
    assert refused["status"] == 422
    assert says in str(refused["detail"])


def test_a_body_that_is_no_json_is_named(open_server: Running) -> None:
    with open_server.client() as client:
        headers = {"Content-Type": "text/plain"}
        refused = problem(client.post("/rigs/simulated/watch", content="{}", headers=headers))
    assert refused["status"] == 415
    assert "Content-Type='text/plain' is not application/json" in str(refused["detail"])


def test_scopes(keyed: tuple[Running, dict[str, str]]) -> None:
    server, keys = keyed
    with server.client() as client:
        assert client.get("/health").json()["key_needed"] is True
        answer = client.get("/rigs")
        assert problem(answer)["type"] == "/problems/key-needed"
        assert answer.headers["www-authenticate"] == "Bearer"
        wrong = client.get("/rigs", headers={"X-API-Key": "ent_00000000_x"})
        assert problem(wrong)["type"] == "/problems/key"
    with server.client(keys["read"]) as client:
        assert client.get("/me").json() == {"name": "read", "scopes": ["read"]}
        refused = client.post("/rigs/simulated/lock", json={})
        assert problem(refused)["type"] == "/problems/scope"
        assert client.get("/audit").status_code == 403
        assert client.post("/emergency-stop").status_code == 200
        assert client.get("/rigs").json()[0]["stopped_by"] == "read"
        assert client.post("/rigs/simulated/reset").status_code == 403
    with server.client(keys["control"]) as client:
        assert client.post("/rigs/simulated/reset").json()["state"] == "idle"
    with server.client(keys["admin"]) as client:
        trail = client.get("/audit").json()
    assert [(line["who"], line["action"]) for line in trail] == [
        ("control", "reset"),
        ("read", "emergency_stop"),
    ]


def test_keys_over_http(keyed: tuple[Running, dict[str, str]]) -> None:
    """Only `admin` may; the text is told once, works at once, and not after it is revoked."""
    server, keys = keyed
    body = {"name": "night shift", "scopes": ["control"], "expires_days": 1}
    with server.client(keys["control"]) as client:
        assert client.get("/keys").status_code == 403
        assert client.post("/keys", json=body).status_code == 403
    with server.client(keys["admin"]) as client:
        made = client.post("/keys", json=body).json()
        assert client.post("/keys", json={**body, "scopes": ["root"]}).status_code == 422
        assert client.post("/keys", json={**body, "name": "a\nb"}).status_code == 422
        listed = {row["id"]: row for row in client.get("/keys").json()}
        assert listed[made["id"]]["state"] == "active"
        assert made["key"] not in client.get("/keys").text
        with server.client(made["key"]) as other:
            assert other.get("/me").json() == {"name": "night shift", "scopes": ["control"]}
            assert client.delete(f"/keys/{made['id']}").json()["state"] == "revoked"
            assert other.get("/me").status_code == 401
        assert client.delete("/keys/00000000").status_code == 404
        trail = client.get("/audit", params={"limit": 2}).json()
    assert [line["action"] for line in trail] == ["revoke key", "create key"]
    assert made["key"].split("_", 2)[2] not in str(trail)


def test_listening_elsewhere_needs_a_key(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, server=ServerSettings(host="0.0.0.0"))
    with pytest.raises(ConfigError, match="entrain keys create"):
        make_server(settings)


async def first_message(address: str, trusted: ssl.SSLContext) -> Any:
    """What a live stream says first. From one thread: the client of two may hang, one in reading
    what comes after the handshake while the other writes (Python's ssl is not made for both)."""
    async with asyncio_client.connect(address, ssl=trusted) as ws:
        return json.loads(await asyncio.wait_for(ws.recv(), 5))


@pytest.mark.component("openssl")
def test_with_a_certificate_everything_is_encrypted(tmp_path: Path) -> None:
    """A self-made one, checked by the clients: page, API and live stream, and nothing in clear."""
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2"
    names = ["-subj", "/CN=lab", "-addext", "subjectAltName=IP:127.0.0.1"]
    files = ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*command.split(), *names, *files], check=True, capture_output=True)
    trusted = ssl.create_default_context(cafile=str(certificate))
    limits = ServerSettings(tls_certificate=certificate, tls_key=key)
    with running(tmp_path / "data", server=limits) as server:
        assert server.url.startswith("https://")
        with server.client(verify=trusted) as client:
            assert client.get("/health").json()["status"] == "ok"
            assert "<title>entrain" in client.get(server.url).text
            own = {"Origin": server.url}
            assert client.post("/rigs/simulated/lock", json={}, headers=own).status_code == 200
        address = server.url.replace("https", "wss") + "/api/v1/live/ws"
        assert asyncio.run(first_message(address, trusted))["kind"] == "hello"
        with server.client() as stranger, pytest.raises(httpx.ConnectError, match="CERTIFICATE"):
            stranger.get("/health")
        with httpx.Client(trust_env=False) as plain, pytest.raises(httpx.RemoteProtocolError):
            plain.get(server.url.replace("https", "http"))


def test_foreign_pages_and_rebound_names_change_nothing(open_server: Running) -> None:
    with open_server.client() as client:
        path, host = "/rigs/simulated/lock", httpx.URL(open_server.url).netloc.decode()
        for headers in (
            {"Origin": "http://evil.example"},
            {"Origin": "null"},
            {"Sec-Fetch-Site": "cross-site"},
        ):
            answer = client.post(path, json={}, headers=headers)
            assert problem(answer)["type"] == "/problems/origin"
        assert problem(client.get("/rigs", headers={"Host": "evil.example"}))["type"] == (
            "/problems/host"
        )
        assert client.get("/rigs").json()[0]["holder"] is None
        own = client.post(path, json={}, headers={"Origin": f"http://{host}"})
        assert own.status_code == 200
        token = own.json()["token"]
        assert client.delete(path, headers={"X-Control-Token": token}).status_code == 204
    address = open_server.url.replace("http", "ws") + "/api/v1/live/ws"
    with pytest.raises(InvalidStatus, match="403"):
        connect(address, origin=Origin("http://evil.example")).__enter__()


def test_control_lock_and_takeover(open_server: Running) -> None:
    with open_server.client() as client:
        path = "/rigs/simulated/lock"
        first = client.post(path, json={}).json()["token"]
        assert problem(client.post(path, json={}))["type"] == "/problems/control"
        again = client.post(path, json={}, headers={"X-Control-Token": first})
        assert again.json()["token"] == first
        second = client.post(path, json={"takeover": True}).json()["token"]
        old = client.post("/rigs/simulated/reset", headers={"X-Control-Token": first})
        assert old.status_code == 423
        assert client.delete(path, headers={"X-Control-Token": second}).status_code == 204
        assert client.get("/rigs/simulated").json()["holder"] is None


def test_bodies_are_limited_whether_declared_or_not(tmp_path: Path) -> None:
    limits = ServerSettings(max_body_bytes=1000)
    with running(tmp_path, server=limits) as server, server.client() as client:
        big = b"{" + b" " * 2000 + b"}"
        assert client.post("/rigs/simulated/lock", content=big).status_code == 413

        def chunks() -> Iterator[bytes]:
            for _ in range(30):
                yield b" " * 100

        answer = client.post("/rigs/simulated/lock", content=chunks())
        assert problem(answer)["type"] == "/problems/too-large"


def test_rate_limit_spares_the_emergency_stop(tmp_path: Path) -> None:
    limits = ServerSettings(requests_per_s=0.1, request_burst=3)
    with running(tmp_path, server=limits) as server, server.client() as client:
        codes = [client.get("/health").status_code for _ in range(5)]
        assert codes == [200, 200, 200, 429, 429]
        assert client.post("/emergency-stop").status_code == 200


def test_idempotency_key_replays_the_first_answer(open_server: Running) -> None:
    with open_server.client() as client:
        path, headers = "/rigs/simulated/lock", {"Idempotency-Key": "one"}
        first = client.post(path, json={"takeover": True}, headers=headers)
        second = client.post(path, json={"takeover": True}, headers=headers)
        assert second.json()["token"] == first.json()["token"]
        assert second.headers["idempotency-replayed"] == "true"
        assert client.post(path, json={}, headers=headers).status_code == 422
        token = first.json()["token"]
        client.delete(path, headers={"X-Control-Token": token})


def test_live_socket_resumes_and_carries_binary(open_server: Running) -> None:
    bus = open_server.service.bus
    address = open_server.url.replace("http", "ws") + "/api/v1/live/ws"
    since = bus.seq
    bus.publish("level", {"rms_v": 0.1})
    with connect(f"{address}?since={since}&kinds=level,wave") as ws:
        hello = json.loads(ws.recv(5))
        assert hello["kind"] == "hello"
        event = json.loads(ws.recv(5))
        assert (event["seq"], event["data"]) == (since + 1, {"rms_v": 0.1})
        bus.publish("wave", {"rate_hz": 1.0}, [[1.0]])  # type: ignore[arg-type]
        frame = ws.recv(5)
    assert isinstance(frame, bytes)
    assert frame[:4] == b"ENT1"


def test_server_sent_events_resume_by_last_event_id(open_server: Running) -> None:
    bus = open_server.service.bus
    since = bus.seq
    bus.publish("level", {"rms_v": 0.2})
    headers = {"Last-Event-ID": str(since)}
    path = "/live/events?kinds=level"
    with open_server.client() as client, client.stream("GET", path, headers=headers) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        lines = answer.iter_lines()
        seen = [next(lines) for _ in range(7)]
    assert f"id: {since + 1}" in seen
    assert "event: level" in seen


def test_a_ticket_opens_one_live_stream(keyed: tuple[Running, dict[str, str]]) -> None:
    server, keys = keyed
    address = server.url.replace("http", "ws") + "/api/v1/live/ws"
    with pytest.raises(InvalidStatus, match="403"), connect(address):
        pass
    with server.client(keys["read"]) as client:
        ticket = client.post("/live/ticket").json()["ticket"]
    with connect(f"{address}?ticket={ticket}") as ws:
        assert json.loads(ws.recv(5))["kind"] == "hello"
    with pytest.raises(InvalidStatus, match="403"), connect(f"{address}?ticket={ticket}"):
        pass


def test_shutdown_ends_live_streams(tmp_path: Path) -> None:
    path = "/api/v1/live/ws"
    with running(tmp_path) as server, connect(server.url.replace("http", "ws") + path) as ws:
        ws.recv(5)
        server.server.silence("test")
        with pytest.raises(ConnectionClosed):
            list(iter(lambda: ws.recv(5), None))


def stops_ms(client: httpx.Client, path: str) -> list[float]:
    """Times of twenty stops, in order of length."""
    times = []
    for _ in range(20):
        start = time.perf_counter()
        assert client.post(path).status_code == 200
        times.append(1e3 * (time.perf_counter() - start))
    return sorted(times)


def answered(client: httpx.Client, path: str, timeout_s: float) -> bool:
    try:
        return client.get(path, timeout=timeout_s).status_code == 200
    except httpx.TimeoutException:
        return False


@pytest.mark.no_cover  # measuring coverage doubles the times
def test_emergency_stop_answers_at_once_even_when_nothing_else_does(tmp_path: Path) -> None:
    """The process that knows the rigs hangs, and so does every thread that waits for it.

    Meanwhile a hundred live streams are served. The issue asks for 50 ms; the median leaves the
    machine's hiccups aside.
    """
    with running(tmp_path) as server, server.client() as client, ExitStack() as opened:
        assert client.get("/simulated-rigs/options").status_code == 200
        address = server.url.replace("http", "ws") + "/api/v1/live/ws"
        for _ in range(100):
            opened.enter_context(connect(address, max_queue=None))
        assert server.service.aside._pool is not None
        (aside,) = server.service.aside._pool._processes
        os.kill(aside, signal.SIGSTOP)
        try:
            with ThreadPoolExecutor(45) as crowd:
                answers = crowd.map(client.get, ["/simulated-rigs/options"] * 45)
                while answered(client, "/campaigns", 0.3):
                    pass  # until routes that need one of the common threads wait for their turn
                for _ in range(50):
                    server.service.bus.publish("waveform", {}, np.zeros((400, 8)))
                times = stops_ms(client, "/rigs/simulated/emergency-stop")
                os.kill(aside, signal.SIGCONT)
                assert {answer.status_code for answer in answers} == {200}
        finally:
            os.kill(aside, signal.SIGCONT)
    print("stops: median", times[10], "worst", times[-1])
    assert times[10] < 50


@pytest.mark.parametrize(
    "raw",
    [
        b"GET /api/v1/health HTTP/1.1\r\n\r\n",
        b"POST /api/v1/emergency-stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: x\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"GET /" + b"a" * 200_000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
)
def test_broken_requests_get_a_4xx_or_nothing(open_server: Running, raw: bytes) -> None:
    url = httpx.URL(open_server.url)
    with socket.create_connection((url.host, url.port), timeout=5) as sock:
        sock.sendall(raw)
        try:
            answer = sock.recv(200)
        except ConnectionResetError:
            answer = b""
    assert not answer or answer.split()[1].startswith(b"4")


@contextmanager
def process(data_dir: Path) -> Iterator[subprocess.Popen[str]]:
    """`entrain serve` in a session of its own."""
    child = subprocess.Popen(
        [sys.executable, "-m", "daq.cli", "serve", "--port", "0"],
        cwd=Path(__file__).parent.parent,
        env={**os.environ, "ENTRAIN_DATA_DIR": str(data_dir), "XDG_CONFIG_HOME": str(data_dir)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def address(child: subprocess.Popen[str]) -> str:
    assert child.stdout is not None
    found = re.search(r"http://\S+", child.stdout.readline())
    assert found is not None, child.communicate()
    return found[0]


@pytest.mark.skipif(sys.platform != "linux", reason="reads the processes of a session")
def test_nothing_outlives_a_killed_service_and_one_service_has_the_data(tmp_path: Path) -> None:
    with process(tmp_path) as child:
        url = address(child)
        with process(tmp_path) as second:
            said = second.communicate(timeout=60)[1]
            assert second.returncode == 2
            assert f"data_dir={str(tmp_path)!r} is served by another process" in said
            assert said.count("\n") == 1
        facts = httpx.get(f"{url}/api/v1/rigs/simulated/facts", timeout=60, trust_env=False)
        assert facts.status_code == 200
        child.kill()
        child.wait()
        end = time.monotonic() + 20
        while (
            subprocess.run(["ps", "-s", str(child.pid)], stdout=subprocess.DEVNULL).returncode == 0
        ):
            assert time.monotonic() < end, "something of the service is left"
            time.sleep(0.05)
    with process(tmp_path) as third:  # the lock is gone with its process
        address(third)


def test_a_full_disk_is_one_clear_error(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk") as place:
        RunStore(place / "store").close()
        fill(place)
        with process(place) as child:
            out, err = child.communicate(timeout=60)
        assert (child.returncode, out) == (1, "")
        assert err.count("\n") == 1
        assert "the disk is full: make room" in err
