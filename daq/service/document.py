"""`docs/api.md` from the routes themselves: what each does, its scope, and a curl that works.

``python -m daq.service.document`` prints the page; a test keeps the file equal to it, so that no
route is undocumented.
"""

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fastapi.routing import APIRoute

from daq.service.app import PREFIX, ROUTERS, create_api
from daq.service.settings import Settings
from daq.service.state import Needs, build

HEAD = """# The REST API

Everything under `/api/v1`; made from the routes by `python -m daq.service.document`. The machine
form is `/api/v1/openapi.json` (OpenAPI 3.1). Numbers are SI with the unit in the name, times
RFC 3339 in UTC.

    export ENTRAIN=http://127.0.0.1:8000/api/v1
    export KEY=             # where keys are needed: KEY="Authorization: Bearer ent_..."
    export TOKEN=           # the lock's, while you hold one

- **Errors** are problem details (RFC 9457): `type`, `title`, `status`, `detail`, `request`.
- **Scopes**: `read` sees, `control` moves a rig and starts work, `configure` changes what others
  rely on, `admin` may everything; each includes `read`.
- **Long work** is a job: 202 with its number; then `/jobs/{job}`, `/jobs/{job}/log`,
  `/jobs/{job}/result`.
- **One master a rig**: take the lock, send its token as `X-Control-Token`. Who holds no lock is
  refused (423) while somebody else does; where nobody does, a command is free.
- **Once only**: a POST with an `Idempotency-Key` is answered again from memory when it is sent
  again (kept in memory; not for uploads).
- **Pages**: `after=` the `next` of the page before. **ETags** on campaigns and runs.
- **Live**: WebSocket `/live/ws?since=N&kinds=a,b` and server-sent events `/live/events`. Events
  have a `seq`; `since` (or `Last-Event-ID`) resumes. `hello` comes first: another `service` in it
  than before means a new start, and numbers from 1 on. Kinds: `job`, `progress`, `log`, `campaign`,
  `control`, `emergency_stop`, `reset`, and the pictures of the moment `levels`, `waveform`,
  `spectrum`, of which a newer one takes the place of one that still waits. Who lags loses its
  oldest events and is told how many (`dropped`). Over the
  WebSocket, events with samples are binary: `ENT1`, uint32 little-endian length of the header,
  the header (JSON with `seq`, `kind`, `time`, `shape`, ...), then float32 little-endian.
"""
VALUES = {
    "name": "simulated",
    "job": "3f2a9c01d4e5",
    "campaign": "a-clean-62eb5f012e",
    "calibration": "sn4711-pistonphone-2026-01-31T120000Z",
    "key": "9f86d081",
}
QUERY = {
    "/imports": "?name=campaign.zip",
    "/recordings/imports": "?name=free.wav&channel=p1:pressure:Pa:0.0018:0.6"
    "&channel=p2:pressure:Pa:0.0018:0.65&channel=drive:voltage:V:1",
    "/characterisations": "?name=p21.txt",
    "/campaigns/{campaign}/runs/{name}/samples": "?start=0&stop=1000",
    "/campaigns/{campaign}/runs/{name}/spectrum": "?channel=p1&max_hz=1000",
    "/campaigns/{campaign}/runs/{name}/download": "?format=csv",
    "/runs": "?kind=forced&min_frequency_hz=160",
    "/calibrations": "?subject=SN4711&method=pistonphone",
    "/live/events": "?kinds=job,progress,log",
}
UPLOADS = {
    "/imports": "campaign.zip",
    "/recordings/imports": "free.wav",
    "/characterisations": "p21.txt",
}
RUN = "001-forced-166.50Hz"


def routes() -> Iterator[APIRoute]:
    """Every route of the API."""
    for router in ROUTERS:
        for route in router.routes:
            if isinstance(route, APIRoute):
                yield route


def scope_of(route: APIRoute) -> str | None:
    """The scope that a route needs; None for a public one."""
    for dependency in route.dependant.dependencies:
        if isinstance(dependency.call, Needs):
            return dependency.call.scope
    return None


def example_body(schema: dict[str, Any], operation: dict[str, Any]) -> Any:
    """A request's example from its schema's examples and defaults; None without a JSON body."""
    content = operation.get("requestBody", {}).get("content", {}).get("application/json")
    if content is None:
        return None
    model = schema["components"]["schemas"][content["schema"]["$ref"].rpartition("/")[2]]
    return {
        name: field["examples"][0]
        for name, field in model["properties"].items()
        if field.get("examples")
    }


def curl(route: APIRoute, schema: dict[str, Any]) -> str:
    """A command line that asks for this route."""
    method = min(route.methods or {"GET"})
    path = route.path
    filled = path.replace("/runs/{name}", f"/runs/{RUN}")
    for name, value in VALUES.items():
        filled = filled.replace(f"{{{name}}}", value)
    words = ["curl", "-s"] if "live/events" not in path else ["curl", "-sN"]
    if scope_of(route):
        words += ['-H "$KEY"']
    if any(field.alias == "X-Control-Token" for field in route.dependant.header_params):
        words.append('-H "X-Control-Token: $TOKEN"')
    body = example_body(schema, schema["paths"][PREFIX + path][method.lower()])
    if method != "GET":
        words.append(f"-X {method}")
    if body is not None:
        words.append(f"-H 'Content-Type: application/json' -d {shlex.quote(json.dumps(body))}")
    elif path in UPLOADS:
        words.append(f"--data-binary @{UPLOADS[path]}")
    saved = {"/download": "-OJ", "/report": "-o report.html", "/exports/{job}": "-OJ"}
    words += [option for ending, option in saved.items() if path.endswith(ending)]
    query = QUERY.get(path, "") if method == "GET" or path in UPLOADS else ""
    return " ".join([*words, f'"$ENTRAIN{filled}{query}"'])


def page() -> str:
    """The whole of `docs/api.md`."""
    with TemporaryDirectory() as folder:
        schema = create_api(build(Settings(data_dir=Path(folder)))).openapi()
    groups: dict[str, list[str]] = {}
    for route in routes():
        method = min(route.methods or {"GET"})
        operation = schema["paths"][PREFIX + route.path][method.lower()]
        scope = scope_of(route)
        lines = [
            f"### {method} {route.path}",
            "",
            f"{operation['description']} *{f'Scope: {scope}.' if scope else 'Public.'}*",
            "",
            f"    {curl(route, schema)}",
            "",
        ]
        groups.setdefault(operation["tags"][-1], []).extend(lines)
    body = [
        line for tag, lines in groups.items() for line in (f"## {tag.capitalize()}", "", *lines)
    ]
    return "\n".join([HEAD, *body]).rstrip() + "\n"


if __name__ == "__main__":
    print(page(), end="")
