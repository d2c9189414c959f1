"""Errors as problem details (RFC 9457): one shape for every refusal and failure.

    {"type": "/problems/scope", "title": "...", "status": 403, "detail": "...", "request": "..."}

`detail` says parameter, value, requirement and remedy. What nobody foresaw becomes a 500 that
shows no internals; the log holds the trace under the same request number.
"""

import logging
from collections.abc import Iterable, Mapping
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException

from daq.errors import (
    CampaignError,
    CorruptFile,
    DaqError,
    InputError,
    StoreError,
    UnknownItem,
    told,
)
from daq.service.rigs import RigConflict
from drivers.errors import (
    DeviceNotFound,
    DriverError,
    InterlockOpen,
    MissingDependency,
    SettingError,
)

log = logging.getLogger("entrain.service")

TITLES = {
    400: "The request is not understood",
    401: "An API key is needed",
    403: "Not allowed",
    404: "Not found",
    405: "That method is not offered here",
    408: "Too slow",
    409: "Not possible in the present state",
    412: "The resource has changed",
    413: "Too large",
    415: "That media type is not accepted",
    422: "A value is not acceptable",
    423: "Someone else has control",
    429: "Too many requests",
    500: "The service failed",
    501: "Not available in this installation",
    502: "The device failed",
    503: "Not available now",
}


DRIVER_KINDS: tuple[tuple[type[DriverError], int, str], ...] = (
    (SettingError, 422, "setting"),
    (MissingDependency, 501, "missing-dependency"),
    (DeviceNotFound, 404, "device-not-found"),
    (InterlockOpen, 409, "interlock"),
)

DAQ_KINDS: tuple[tuple[type[DaqError], int, str], ...] = (
    (InputError, 422, "input"),
    (UnknownItem, 404, "not-found"),
    (CorruptFile, 409, "corrupt-file"),
    (CampaignError, 409, "campaign"),
    (StoreError, 503, "store"),
)


class Problem(Exception):
    """A refusal with status, machine-readable kind, and a sentence for people."""

    def __init__(
        self,
        status: int,
        kind: str,
        detail: str,
        headers: dict[str, str] | None = None,
        **extra: Any,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.kind = kind
        self.detail = detail
        self.headers = headers
        self.extra = extra

    def body(self, request: str | None = None) -> dict[str, Any]:
        """The JSON object of RFC 9457."""
        body: dict[str, Any] = {
            "type": f"/problems/{self.kind}",
            "title": TITLES.get(self.status, "The request failed"),
            "status": self.status,
            "detail": self.detail,
            **self.extra,
        }
        if request:
            body["request"] = request
        return body

    def response(self, request: str | None = None) -> Response:
        if self.status == 304:
            return Response(status_code=304, headers=self.headers)
        return JSONResponse(
            self.body(request),
            status_code=self.status,
            headers=self.headers,
            media_type="application/problem+json",
        )


def not_found(what: str, name: str, known: Iterable[str] = ()) -> Problem:
    """A 404 that says what was looked for, and what there is where that is short."""
    there = ", ".join(list(known)[:20])
    return Problem(
        404, "not-found", f"there is no {what} {name!r}" + (f"; there is {there}" if there else "")
    )


def request_id(request: Request) -> str | None:
    number: str | None = request.scope.get("state", {}).get("request_id")
    return number


def from_driver(error: DriverError) -> Problem:
    """A device's error in the words of HTTP."""
    for family, status, kind in DRIVER_KINDS:
        if isinstance(error, family):
            return Problem(status, kind, str(error))
    return Problem(502, "device", str(error))


def from_daq(error: DaqError, hide: str) -> Problem:
    """An error of acquisition or run store in the words of HTTP, without the path `hide`."""
    detail = str(error).replace(hide, "")
    for family, status, kind in DAQ_KINDS:
        if isinstance(error, family):
            return Problem(status, kind, detail)
    return Problem(500, "daq", detail)


def _given(error: Mapping[str, Any]) -> str:
    """``=value`` of what was refused, where that is plain; not of a header or an unknown field,
    which may hold a secret."""
    if error["loc"][0] == "header" or error["type"] in ("missing", "extra_forbidden"):
        return ""
    return told(error.get("input"))


def install(app: FastAPI) -> None:
    """Let `app` answer every error in this shape."""

    @app.exception_handler(Problem)
    async def _problem(request: Request, error: Problem) -> Response:
        return error.response(request_id(request))

    @app.exception_handler(DriverError)
    async def _driver(request: Request, error: DriverError) -> Response:
        return from_driver(error).response(request_id(request))

    @app.exception_handler(DaqError)
    async def _daq(request: Request, error: DaqError) -> Response:
        return from_daq(error, request.app.state.hide).response(request_id(request))

    @app.exception_handler(TimeoutError)
    async def _late(request: Request, error: TimeoutError) -> Response:
        detail = "a helper process did not answer in time: try again"
        return Problem(503, "late", detail).response(request_id(request))

    @app.exception_handler(RigConflict)
    async def _rig(request: Request, error: RigConflict) -> Response:
        return Problem(409, "rig", str(error)).response(request_id(request))

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> Response:
        kind = {404: "not-found", 405: "method"}.get(error.status_code, "http")
        detail = (
            error.detail if isinstance(error.detail, str) else TITLES.get(error.status_code, "")
        )
        headers = dict(error.headers) if error.headers else None
        return Problem(error.status_code, kind, detail, headers).response(request_id(request))

    @app.exception_handler(RequestValidationError)
    async def _validation(request: Request, error: RequestValidationError) -> Response:
        sent = request.headers.get("content-type", "")
        whole = any(tuple(e["loc"]) == ("body",) for e in error.errors())
        if whole and sent and "json" not in sent:
            detail = f"Content-Type={sent[:100]!r} is not application/json: send the body as JSON"
            return Problem(415, "content-type", detail).response(request_id(request))
        errors = [
            {"where": ".".join(str(part) for part in e["loc"]) + _given(e), "what": e["msg"]}
            for e in error.errors()
        ]
        detail = "; ".join(f"{e['where']}: {e['what']}" for e in errors[:3])
        return Problem(422, "validation", detail, errors=errors).response(request_id(request))

    @app.exception_handler(Exception)
    async def _unforeseen(request: Request, error: Exception) -> Response:
        number = request_id(request)
        log.error("request %s failed", number, exc_info=error)
        detail = "an unforeseen error; the service's log has the trace under this request's number"
        return Problem(500, "internal", detail).response(number)
