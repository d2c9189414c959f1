"""schemathesis over the whole schema, and hostile requests: no 5xx, no leak, no change unscoped.

The server is real and keyed; schemathesis asks as each of four askers: nobody, `read`, and (for
what changes things) a key that may everything. Responses must fit the published schema.
"""

import logging
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import Case
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import response_schema_conformance

from daq.importers import import_folder
from daq.service import document
from daq.service.app import PREFIX, create_api
from daq.service.keys import KeyStore
from daq.service.settings import RigSettings, ServerSettings, Settings
from daq.service.state import build
from tests.service_data import make_folder
from tests.service_live import Running, running

# Streams never end, uploads and campaigns take long: they have tests of their own.
LONG = (
    r"/(live/events|imports|characterisations|watch|resume|next-experiment|close-loops?"
    r"|identifications|diagnoses)$"
)
FUZZ = settings(
    max_examples=6,
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)
SECRETS = re.compile(r"Traceback|site-packages|/tmp/|\.py\"|line \d+, in")


def bare_schema(folder: Path) -> dict[str, Any]:
    return create_api(build(Settings(data_dir=folder))).openapi()


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Running, dict[str, str]]]:
    folder = tmp_path_factory.mktemp("schema")
    store = KeyStore(folder / "keys.json")
    keys = {scope: store.create(scope, [scope])[1] for scope in ("read", "admin")}
    limits = ServerSettings(require_key=True, requests_per_s=1e6, request_burst=10**6)
    rigs = {"simulated": RigSettings()}
    with running(folder, server=limits, rigs=rigs) as server:
        import_folder(make_folder(folder / "sines"), server.service.store)
        yield server, keys


LABELS = sorted(
    f"{min(route.methods or {'GET'})} {PREFIX}{route.path}"
    for route in document.routes()
    if not re.search(LONG, route.path)
)


@pytest.fixture(scope="module")
def operations(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    schema = schemathesis.openapi.from_dict(bare_schema(tmp_path_factory.mktemp("bare")))
    return {found.ok().label: found.ok() for found in schema.get_all_operations()}


@pytest.mark.parametrize("label", LABELS)
def test_no_request_breaks_the_service(
    label: str, keyed: tuple[Running, dict[str, str]], operations: dict[str, Any]
) -> None:
    server, keys = keyed

    @FUZZ
    @given(case=operations[label].as_strategy())
    def ask(case: Case) -> None:
        if label == f"POST {PREFIX}/campaigns" and isinstance(case.body, dict):
            case.body["rig"] = "none"  # refused after all checks of the body: no campaign runs
        for who in ("admin", "read", None):
            headers = {"Authorization": f"Bearer {keys[who]}"} if who else {}
            answer = case.call(base_url=server.url, headers=headers, timeout=30)
            case.validate_response(answer, checks=[not_a_server_error, response_schema_conformance])
            assert not SECRETS.search(answer.text), answer.text
            if who is None and label.rpartition("/")[2] not in ("health", "version"):
                assert answer.status_code in (400, 401, 404, 405, 413), answer.status_code

    ask()


def test_reading_keys_change_nothing(keyed: tuple[Running, dict[str, str]]) -> None:
    server, keys = keyed
    audit = server.service.audit
    with server.client(keys["read"]) as client:
        before = audit.tail(1000)
        for route in document.routes():
            method = min(route.methods or {"GET"})
            if method == "GET" or document.scope_of(route) in (None, "read"):
                continue
            path = route.path
            for name, value in {"name": "simulated", "job": "0" * 12, "campaign": "c"}.items():
                path = path.replace(f"{{{name}}}", value)
            answer = client.request(method, path, json={})
            assert answer.status_code == 403, (method, path, answer.text)
        assert audit.tail(1000) == before


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/../../../../etc/passwd", {}),
        ("/js/..%2f..%2fsettings.py", {}),
        ("/js/%2e%2e/%2e%2e/settings.py", {}),
        ("/api/v1/campaigns/..%2f..%2f..%2fkeys.json", {}),
        ("/api/v1/campaigns/x/runs/..%2f..%2f..%2fkeys.json/download", {}),
        ("/api/v1/identifications/..%2f..%2fkeys/report", {}),
        ("/api/v1/jobs/%00", {}),
        ("/api/v1/rigs/" + "a" * 5000, {}),
        ("/api/v1/rigs", {"X-API-Key": "ent_" + "a" * 4000}),
        ("/api/v1/rigs", {"Authorization": "Basic YTpi"}),
        ("/api/v1/rigs", {"Authorization": "Bearer \xff"}),
        ("/api/v1/live/events", {"Last-Event-ID": "9" * 19}),
        ("/api/v1/rigs", {"Host": "[::1"}),
        ("/api/v1/rigs", {"Host": "evil.example:80@127.0.0.1"}),
        ("/api/v1/rigs", {"X-Forwarded-For": "127.0.0.1", "X-Forwarded-Host": "127.0.0.1"}),
    ],
)
def test_hostile_requests_get_nothing(
    keyed: tuple[Running, dict[str, str]], path: str, headers: dict[str, str]
) -> None:
    server, _ = keyed
    url = httpx.URL(server.url)
    lines = {"Host": "127.0.0.1", "Connection": "close", **headers}
    raw = f"GET {path} HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in lines.items()) + "\r\n"
    with socket.create_connection((url.host, url.port), timeout=10) as sock:
        sock.sendall(raw.encode("latin-1"))
        answer = b"".join(iter(lambda: sock.recv(65536), b"")).decode("latin-1")
    assert answer.split()[1].startswith("4"), answer
    assert not SECRETS.search(answer)


def test_nothing_secret_in_logs(
    keyed: tuple[Running, dict[str, str]], caplog: pytest.LogCaptureFixture
) -> None:
    server, keys = keyed
    logger = logging.getLogger("entrain.access")
    logger.addHandler(caplog.handler)
    logger.setLevel(logging.INFO)
    try:
        with server.client(keys["read"]) as client:
            ticket = client.post("/live/ticket").json()["ticket"]
            client.get("/rigs", params={"ticket": ticket})
            client.get("/rigs", params={"password": "hunter2"})
            client.get("/rigs/%0d%0aforged")
    finally:
        logger.removeHandler(caplog.handler)
    text = caplog.text
    assert "/api/v1/rigs 200" in text
    for secret in (keys["read"], keys["read"].split("_", 2)[2], ticket, "hunter2"):
        assert secret not in text
    assert "\nforged" not in text
