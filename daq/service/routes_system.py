"""Health, version, metrics, who am I, the audit trail."""

import platform
import time
from importlib.metadata import version
from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import PlainTextResponse

from daq.service.audit import utc_text
from daq.service.state import Admin, Parts, Reader
from daq.service.wire import Health, Identity, Version

router = APIRouter(tags=["system"])
STARTED = time.monotonic()


@router.get("/health")
async def health(service: Parts) -> Health:
    """Whether the service is fit for work. Needs no key."""
    return Health(
        status="closing" if service.closing else "ok",
        time=utc_text(),
        uptime_s=round(time.monotonic() - STARTED, 3),
        key_needed=service.settings.needs_key,
    )


@router.get("/version")
async def get_version() -> Version:
    """What runs here. Needs no key."""
    return Version(version=version("entrain"), python=platform.python_version())


@router.get("/me")
async def me(who: Reader) -> Identity:
    """The name and scopes of the key in use."""
    return Identity(name=who.name, scopes=sorted(who.scopes))


@router.get("/metrics", response_class=PlainTextResponse)
async def metrics(service: Parts, who: Reader) -> PlainTextResponse:
    """Counters and times in Prometheus' text format."""
    text = service.metrics.render()
    return PlainTextResponse(text, media_type="text/plain; version=0.0.4; charset=utf-8")


@router.get("/audit")
def audit(
    service: Parts, who: Admin, limit: Annotated[int, Query(ge=1, le=1000)] = 100
) -> list[dict[str, Any]]:
    """Who did what, newest first."""
    return service.audit.tail(limit)
